//! Joint maps of the channels of a run, from its sums in memory.

use std::path::Path;

use crate::frames::{AntennaResponse, AutoPower, Instrument};
use crate::ground::GroundError;
use crate::imaging::joint::{JointChannel, PowerSample, solve_jointly};
use crate::imaging::{KeptSums, SolveError, SolveWatch};
use crate::pipeline::config::{Config, MemoryLimit, PipelineError, Plan};
use crate::products::{JOINT, JointReport, create_folder, write_joint};
use crate::runtime::Cancel;
use crate::units::vector::Vec3;
use crate::units::{ChannelId, PerChannel};

/// Part of the memory limit for sums; the rest is for the blocks of all channels, tables and samples.
const SUMS_SHARE: f64 = 0.6;

/// Where the sums of a joint solution are kept.
#[derive(Clone, Copy, Debug)]
pub struct SumsStorage<'a> {
    /// Limit of the memory; `None` if it is not known, and all sums stay in memory.
    pub limit: Option<MemoryLimit>,
    /// Folder of the sums that memory does not hold.
    pub folder: &'a Path,
}

/// The channels so far of a joint solution, whose sums are on disk where memory does not hold them.
pub(in crate::pipeline) struct KeptChannels<'a> {
    pub(in crate::pipeline) channels: Vec<JointChannel>,
    /// Bytes of the sums in memory.
    held_bytes: u64,
    /// Bytes of the largest sums since it was last set to 0.
    pub(in crate::pipeline) largest_bytes: u64,
    bytes_max: Option<u64>,
    /// Memory that the next sums need while they are read, in units of their own.
    reading: u64,
    folder: &'a Path,
}

impl<'a> KeptChannels<'a> {
    pub(in crate::pipeline) fn new(place: SumsStorage<'a>, reading: u64) -> Self {
        let SumsStorage { limit, folder } = place;
        let bytes_max = limit.map(|limit| (SUMS_SHARE * limit.bytes as f64) as u64);
        Self { channels: Vec::new(), held_bytes: 0, largest_bytes: 0, bytes_max, reading, folder }
    }

    /// Number of channels to read at once: the first of a state alone, and then as many as memory holds if they are like the largest before.
    pub(in crate::pipeline) fn next_count(&self) -> usize {
        let largest = self.largest_bytes;
        match self.bytes_max {
            None => usize::MAX,
            Some(_) if largest == 0 => 1,
            Some(bytes_max) => {
                let free = bytes_max.saturating_sub(self.held_bytes);
                usize::try_from(free / (self.reading * largest).max(1)).unwrap_or(usize::MAX).max(1)
            }
        }
    }

    pub(in crate::pipeline) fn keep(&mut self, channel: JointChannel) -> Result<(), PipelineError> {
        let bytes = channel.sums_bytes();
        self.largest_bytes = self.largest_bytes.max(bytes);
        // The next channel needs memory to be read.
        let needed = self.held_bytes + bytes + self.reading * bytes;
        let is_held = self.bytes_max.is_none_or(|bytes_max| needed <= bytes_max);
        self.channels.push(match is_held {
            true => channel,
            false => channel.with_sums_on_disk(self.folder).map_err(GroundError::from)?,
        });
        self.held_bytes += if is_held { bytes } else { 0 };
        Ok(())
    }
}

/// The total powers of the daughters at a frequency.
pub(in crate::pipeline) fn powers_of(
    all: &[(AutoPower, Vec3)],
    instrument: &Instrument,
    frequency_hz: f64,
) -> Result<Vec<PowerSample>, SolveError> {
    let of_daughters = all
        .iter()
        .filter(|(power, _)| power.frequency_hz == frequency_hz && power.daughter < instrument.satellites);
    let receivers = f64::from(instrument.response.receivers());
    let sample = |&(power, r_m): &(AutoPower, Vec3)| {
        let AutoPower { daughter, width_hz, time_s, power_k_sr, sigma_k_sr, .. } = power;
        // The radiometer equation.
        let duration_s = (power_k_sr / sigma_k_sr).powi(2) / (receivers * width_hz);
        PowerSample { daughter, time_s, duration_s, r_m, power_k_sr, sigma_k_sr }
    };
    let powers: Vec<PowerSample> = of_daughters.map(sample).collect();
    let has_pattern = instrument.response == AntennaResponse::DipoleNormal;
    if has_pattern && !powers.is_empty() {
        return Err(SolveError::PowersOfDipoles { frequency_hz });
    }
    Ok(powers)
}

/// The data of joint maps that a run keeps.
pub(super) struct JointData {
    pub(super) sums: KeptSums,
    pub(super) powers: Vec<(AutoPower, Vec3)>,
}

impl JointData {
    /// Solves for the joint maps and writes them into the folder of joint maps in `out`; `None` if that is interrupted.
    ///
    /// # Errors
    /// As [`solve_jointly`]; a file that cannot be written.
    pub(super) fn map(
        self,
        plan: &Plan,
        out: &Path,
        cancel: &Cancel,
        watch: &SolveWatch,
    ) -> Result<Option<JointReport>, PipelineError> {
        let Plan { config, instrument, .. } = plan;
        let folder = out.join(JOINT);
        create_folder(&folder)?;
        let frequency_hz = |channel: ChannelId| {
            instrument.channels.get(usize::from(channel.0)).map_or(0.0, |channel| channel.frequency_hz)
        };
        let mut sums = self.sums.take();
        sums.sort_by(|(a, ..), (b, ..)| frequency_hz(*a).total_cmp(&frequency_hz(*b)));
        let constants = &config.joint.power_constant_k_sr;
        let constant_k_sr = match constants {
            PerChannel::All(constant) => vec![*constant],
            PerChannel::Each(_) => {
                sums.iter().filter_map(|(channel, ..)| constants.get(usize::from(channel.0))).collect()
            }
        };
        let request = config.joint.request(config.stopping_rule(), !self.powers.is_empty(), constant_k_sr);
        let held: u64 = sums.iter().map(|(.., sums)| sums.weight_bytes()).sum();
        // What the sums take is not available any more, but theirs.
        let limit = MemoryLimit::of_machine()
            .map(|limit| MemoryLimit { bytes: limit.bytes.saturating_add(held), ..limit });
        let mut kept = KeptChannels::new(SumsStorage { limit, folder: &folder }, 0);
        for (channel, nside, sums) in sums {
            if cancel.is_cancelled() {
                return Ok(None);
            }
            let frequency_hz = frequency_hz(channel);
            let powers = match request.powers {
                Some(_) => powers_of(&self.powers, instrument, frequency_hz)?,
                None => Vec::new(),
            };
            let channel = JointChannel::new((frequency_hz, nside), sums, powers, request.rule, watch);
            // A solution that was cut short may fail.
            if cancel.is_cancelled() {
                return Ok(None);
            }
            kept.keep(channel?)?;
        }
        let solved = solve_jointly(kept.channels, &request, watch);
        if cancel.is_cancelled() {
            return Ok(None);
        }
        let solved = solved?;
        let pictures = config.products.pictures.then_some(config.products.frame);
        Ok(Some(write_joint(&folder, &solved, request.powers, pictures)?))
    }
}

impl Config {
    /// Requires settings with which this number of ranks can share a whole run.
    ///
    /// # Errors
    /// As [`Config::require_shareable`]; joint maps.
    #[doc(hidden)]
    pub fn require_shareable_run(&self, ranks: usize) -> Result<(), PipelineError> {
        match self.joint.on && ranks > 1 {
            true => Err(PipelineError::NotJoint { with: "--mpi" }),
            false => self.require_shareable(ranks),
        }
    }
}
