//! Joint maps of the channels of one or more states.

use std::path::Path;

use crate::frames::{AntennaResponse, AutoPower, Instrument};
use crate::ground::{Ground, GroundConfig, GroundError, WAIT_BYTES};
use crate::imaging::joint::{JointChannel, JointRequest, JointSolution, PowerSample, solve_jointly};
use crate::imaging::{ChannelGroup, Snapshot, SolveError, SolveWatch, StoppingRule};
use crate::pipeline::config::{Config, MemoryLimit, PipelineError};
use crate::units::ChannelId;
use crate::units::vector::Vec3;

/// Part of the memory limit for sums; the rest is for the blocks of all channels, tables and samples.
const SUMS_SHARE: f64 = 0.6;

/// Memory of sums while they are read, in units of that of sums to be solved: both exist for a while.
const READING: u64 = 2;

/// Where the sums of a joint solution are kept.
#[derive(Clone, Copy, Debug)]
pub struct SumsPlace<'a> {
    /// Limit of the memory; `None` if it is not known, and all sums stay in memory.
    pub limit: Option<MemoryLimit>,
    /// Folder of the sums that memory does not hold.
    pub folder: &'a Path,
}

/// Solves for the maps of several channels jointly, from one or more states. `request` makes the joint request from the first state's
/// stopping rule. The states are unchanged.
///
/// # Errors
/// As [`joint_channels`] and [`solve_jointly`].
pub fn solve_states_jointly(
    states: &[(&Path, Config)],
    request: &dyn Fn(StoppingRule) -> JointRequest,
    place: SumsPlace<'_>,
    watch: &SolveWatch,
) -> Result<JointSolution, PipelineError> {
    let (_, first) = states.first().ok_or(SolveError::NoData)?;
    let request = request(first.solver(watch.clone())?.rule);
    let channels = joint_channels(states, &request, place, watch)?;
    Ok(solve_jointly(channels, &request, watch)?)
}

/// The channels of one or more states, each with its own solution, and with their total powers if the request has priors for them.
///
/// A state is read several times if memory does not hold the sums of all its channels; those that do not fit are moved to disk.
///
/// # Errors
/// As [`super::solve_state`]; sums of another engine than the harmonic one; total powers of dipoles; a full disk.
pub fn joint_channels(
    states: &[(&Path, Config)],
    request: &JointRequest,
    place: SumsPlace<'_>,
    watch: &SolveWatch,
) -> Result<Vec<JointChannel>, PipelineError> {
    let mut of_states = Vec::new();
    for (folder, config) in states {
        of_states.push(MappedChannels::new(Ground::channels_in(folder)?, config));
    }
    // Two channels of one frequency are an error if both have sums. Powers are not known yet: with them one channel suffices.
    let mut frequencies_hz: Vec<f64> =
        of_states.iter().flat_map(|state| state.hz_with_sums.clone()).collect();
    for hz in of_states.iter().flat_map(|state| &state.other_hz) {
        if !frequencies_hz.contains(hz) {
            frequencies_hz.push(*hz);
        }
    }
    request.check(&frequencies_hz, request.powers.is_some())?;
    let bytes_max = place.limit.map(|limit| (SUMS_SHARE * limit.bytes as f64) as u64);
    let mut kept = KeptChannels {
        channels: Vec::new(),
        held_bytes: 0,
        largest_bytes: 0,
        bytes_max,
        folder: place.folder,
    };
    for ((folder, config), MappedChannels { with_sums, others, .. }) in states.iter().zip(of_states) {
        let ground = config.ground(WAIT_BYTES);
        kept.largest_bytes = 0;
        let mut left = &with_sums[..];
        loop {
            let (group, later) = left.split_at(kept.next_count().min(left.len()));
            left = later;
            let mut group: ChannelGroup = group.iter().copied().collect();
            if left.is_empty() {
                group.extend(&others);
            }
            kept.read(folder, &GroundConfig { group: Some(group), ..ground.clone() }, request, watch)?;
            if left.is_empty() {
                break;
            }
        }
    }
    Ok(kept.channels)
}

/// The channels of a state that are mapped.
struct MappedChannels {
    hz_with_sums: Vec<f64>,
    other_hz: Vec<f64>,
    with_sums: Vec<ChannelId>,
    /// Those without sums in the checkpoint; packets of the raw archive may still add some.
    others: Vec<ChannelId>,
}

impl MappedChannels {
    fn new(found: Option<(Instrument, Vec<bool>)>, config: &Config) -> Self {
        let (channels, has_sums) = found
            .map_or_else(Default::default, |(instrument, has_sums)| (instrument.frequencies_hz(), has_sums));
        let mapped: Vec<(ChannelId, f64)> =
            (0..).map(ChannelId).zip(channels).filter(|(number, _)| config.map.is_mapped(*number)).collect();
        let has = |number: &ChannelId| has_sums.get(usize::from(number.0)).copied().unwrap_or(false);
        let (with_sums, others): (Vec<_>, Vec<_>) = mapped.into_iter().partition(|(number, _)| has(number));
        let (with_sums, hz_with_sums) = with_sums.into_iter().unzip();
        let (others, other_hz) = others.into_iter().unzip();
        Self { hz_with_sums, other_hz, with_sums, others }
    }
}

/// The channels read so far.
struct KeptChannels<'a> {
    channels: Vec<JointChannel>,
    /// Bytes of the sums in memory.
    held_bytes: u64,
    /// Bytes of the largest sums of the state that is read.
    largest_bytes: u64,
    bytes_max: Option<u64>,
    folder: &'a Path,
}

impl KeptChannels<'_> {
    /// Number of channels to read at once: the first of a state alone, and then as many as memory holds if they are like the largest before.
    fn next_count(&self) -> usize {
        let largest = self.largest_bytes;
        match self.bytes_max {
            None => usize::MAX,
            Some(_) if largest == 0 => 1,
            Some(bytes_max) => {
                let free = bytes_max.saturating_sub(self.held_bytes);
                usize::try_from(free / (READING * largest)).unwrap_or(usize::MAX).max(1)
            }
        }
    }

    /// Reads the channels of a group from a state, and solves for the map of each alone.
    fn read(
        &mut self,
        folder: &Path,
        ground: &GroundConfig,
        request: &JointRequest,
        watch: &SolveWatch,
    ) -> Result<(), PipelineError> {
        let (sums, all_powers) = Ground::sums_and_powers_in(folder, ground)?;
        for Snapshot { instrument, channel, nside, data, .. } in sums {
            let channel = instrument.channels.get(usize::from(channel.0));
            let frequency_hz = channel.map_or(0.0, |channel| channel.frequency_hz);
            let not_harmonic = |found| SolveError::NotHarmonic { frequency_hz, found };
            let sums = data.into_harmonic().map_err(not_harmonic)?;
            let powers = match request.powers {
                Some(_) => powers_of(&all_powers, &instrument, frequency_hz)?,
                None => Vec::new(),
            };
            let channel = JointChannel::new((frequency_hz, nside), *sums, powers, request.rule, watch)?;
            self.keep(channel)?;
        }
        Ok(())
    }

    fn keep(&mut self, channel: JointChannel) -> Result<(), PipelineError> {
        let bytes = channel.sums_bytes();
        self.largest_bytes = self.largest_bytes.max(bytes);
        // The next channel needs memory to be read.
        let needed = self.held_bytes + bytes + READING * bytes;
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
fn powers_of(
    all: &[(AutoPower, Vec3)],
    instrument: &Instrument,
    frequency_hz: f64,
) -> Result<Vec<PowerSample>, SolveError> {
    let of_daughters = all
        .iter()
        .filter(|(power, _)| power.frequency_hz == frequency_hz && power.daughter < instrument.satellites);
    let sample = |&(AutoPower { daughter, time_s, power_k_sr, sigma_k_sr, .. }, r_m): &(AutoPower, Vec3)| {
        PowerSample { daughter, time_s, r_m, power_k_sr, sigma_k_sr }
    };
    let powers: Vec<PowerSample> = of_daughters.map(sample).collect();
    let has_pattern = instrument.response == AntennaResponse::DipoleNormal;
    if has_pattern && !powers.is_empty() {
        return Err(SolveError::PowersOfDipoles { frequency_hz });
    }
    Ok(powers)
}
