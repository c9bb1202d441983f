//! Joint maps of the channels of one or more states.

use std::path::{Path, PathBuf};

use crate::frames::Instrument;
use crate::ground::{Ground, GroundConfig, WAIT_BYTES};
use crate::imaging::joint::{JointChannel, JointRequest, JointSolution, solve_jointly};
use crate::imaging::{ChannelGroup, Snapshot, SolveError, SolveWatch, StoppingRule};
use crate::pipeline::config::{Config, PipelineError};
use crate::pipeline::graph::SumsStorage;
use crate::pipeline::graph::joint::{KeptChannels, powers_of};
use crate::units::ChannelId;

/// Memory of sums while they are read, in units of that of sums to be solved: both exist for a while.
const READING: u64 = 2;

/// Solves for the maps of several channels jointly, from one or more states. `request` makes the joint request from the first state's
/// stopping rule. The states are unchanged.
///
/// # Errors
/// As [`joint_channels`] and [`solve_jointly`].
pub fn solve_states_jointly(
    states: &[(&Path, Config)],
    request: &dyn Fn(StoppingRule) -> JointRequest,
    place: SumsStorage<'_>,
    watch: &SolveWatch,
) -> Result<JointSolution, PipelineError> {
    let (_, first) = states.first().ok_or(SolveError::NoData)?;
    let request = request(first.solver(watch.clone())?.rule);
    let channels = joint_channels(states, &request, place, watch)?;
    Ok(solve_jointly(channels, &request, watch)?)
}

/// Whether any of some states holds total powers of the daughters.
///
/// # Errors
/// A folder without a usable state, or in use.
pub fn has_powers(states: &[PathBuf]) -> Result<bool, PipelineError> {
    for folder in states {
        if Ground::channels_in(folder)?.is_some_and(|(.., has_powers)| has_powers) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// The channels of one or more states, each with its own solution, and with their total powers if the request has priors for them.
///
/// A state is read several times if memory does not hold the sums of all its channels; those that do not fit are moved to disk.
///
/// # Errors
/// As [`super::solve_state`]; a prior map, or a share of reflected power to divide by; sums of another engine than the harmonic one; total powers of dipoles; a full disk.
pub fn joint_channels(
    states: &[(&Path, Config)],
    request: &JointRequest,
    place: SumsStorage<'_>,
    watch: &SolveWatch,
) -> Result<Vec<JointChannel>, PipelineError> {
    let mut of_states = Vec::new();
    for (folder, config) in states {
        require_joint_settings(folder, config)?;
        of_states.push(MappedChannels::new(Ground::channels_in(folder)?, config));
    }
    require_different_frequencies(states, &of_states)?;
    // Two channels of one frequency are an error if both have sums. Powers are not known yet: with them one channel suffices.
    let mut frequencies_hz: Vec<f64> =
        of_states.iter().flat_map(|state| state.hz_with_sums.clone()).collect();
    for hz in of_states.iter().flat_map(|state| &state.other_hz) {
        if !frequencies_hz.contains(hz) {
            frequencies_hz.push(*hz);
        }
    }
    request.check(&frequencies_hz, request.powers.is_some())?;
    let with_sums: usize = of_states.iter().map(|state| state.with_sums.len()).sum();
    request.check_constants(with_sums..=frequencies_hz.len())?;
    let mut kept = KeptChannels::new(place, READING);
    for ((folder, config), MappedChannels { with_sums, others, .. }) in states.iter().zip(of_states) {
        let ground = config.ground(WAIT_BYTES);
        kept.largest_bytes = 0;
        let channels = [with_sums, others].concat();
        let mut left = &channels[..];
        loop {
            if watch.is_cancelled() {
                return Err(SolveError::Interrupted.into());
            }
            let (group, later) = left.split_at(kept.next_count().min(left.len()));
            left = later;
            let group: ChannelGroup = group.iter().copied().collect();
            read(&mut kept, folder, &GroundConfig { group: Some(group), ..ground.clone() }, request, watch)?;
            if left.is_empty() {
                break;
            }
        }
    }
    Ok(kept.channels)
}

/// Requires that no frequency has sums in two states.
fn require_different_frequencies(
    states: &[(&Path, Config)],
    of_states: &[MappedChannels],
) -> Result<(), PipelineError> {
    let folder =
        |number: usize| states.get(number).map_or_else(PathBuf::new, |(folder, _)| folder.to_path_buf());
    for (number, state) in of_states.iter().enumerate() {
        for &frequency_hz in &state.hz_with_sums {
            let before =
                of_states[..number].iter().position(|other| other.hz_with_sums.contains(&frequency_hz));
            if let Some(before) = before {
                let states = [before, number].map(folder);
                return Err(PipelineError::SameFrequency { frequency_hz, states });
            }
        }
    }
    Ok(())
}

/// Requires that nothing is set for the maps of a state that joint maps would leave out.
fn require_joint_settings(folder: &Path, Config { map, .. }: &Config) -> Result<(), PipelineError> {
    let settings = [
        ("map.prior_k", map.prior_k.values().iter().any(|&level_k| level_k != 0.0), "0"),
        ("map.prior_files", !map.prior_files.is_empty(), "[]"),
        ("map.moon_reflection", map.moon_reflection != 0.0, "0"),
    ];
    match settings.into_iter().find(|(_, is_set, _)| *is_set) {
        Some((key, _, none)) => Err(PipelineError::JointWithout { state: folder.to_path_buf(), key, none }),
        None => Ok(()),
    }
}

/// Reads the channels of a group from a state, and solves for the map of each alone.
fn read(
    kept: &mut KeptChannels<'_>,
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
        if watch.is_cancelled() {
            return Err(SolveError::Interrupted.into());
        }
        kept.keep(JointChannel::new((frequency_hz, nside), *sums, powers, request.rule, watch)?)?;
    }
    Ok(())
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
    fn new(found: Option<(Instrument, Vec<bool>, bool)>, config: &Config) -> Self {
        let (channels, has_sums) = found.map_or_else(Default::default, |(instrument, has_sums, _)| {
            (instrument.frequencies_hz(), has_sums)
        });
        let mapped: Vec<(ChannelId, f64)> =
            (0..).map(ChannelId).zip(channels).filter(|(number, _)| config.map.is_mapped(*number)).collect();
        let has = |number: &ChannelId| has_sums.get(usize::from(number.0)).copied().unwrap_or(false);
        let (with_sums, others): (Vec<_>, Vec<_>) = mapped.into_iter().partition(|(number, _)| has(number));
        let (with_sums, hz_with_sums) = with_sums.into_iter().unzip();
        let (others, other_hz) = others.into_iter().unzip();
        Self { hz_with_sums, other_hz, with_sums, others }
    }
}
