//! Maps of many channels, group by group: the downlink is read once a group, so that the sums of a few channels are in memory
//! at a time. Maps and ledger are those of all channels at once.

use std::fs;
use std::path::{Path, PathBuf};

use super::config::Config;
use super::cost::memory_bytes;
use super::engine_cost::{ChannelData, EngineCost};
use super::error::PipelineError;
use super::memory::MemoryLimit;
use super::run::{Watched, finish, ground_alone, lock_folder, summarise};
use super::summary::{RunScope, RunSummary};
use crate::accumulation::ChannelGroup;
use crate::downlink::FileSource;
use crate::frames::Instrument;
use crate::ground::{Collector, Ground, GroundConfig, WAIT_BYTES};
use crate::products::Truth;
use crate::runtime::Cancel;
use crate::units::ChannelId;

/// How many channels are mapped at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupSize {
    /// As many as memory allows.
    Automatic,
    /// This many.
    Channels(usize),
}

/// Receives the number of a group, from 0, and the handles of its graph, which is about to run.
pub type GroupWatcher<'a> = &'a mut dyn FnMut(usize, Watched);

/// Groups of the channels that the first of `files` describes, in their order.
///
/// Nothing is known of the length of the mission, so that the sums of the harmonic engine count as complete.
///
/// # Errors
/// A file that cannot be read twice, or describes no instrument; settings that do not fit it; a channel for which alone
/// there is too little memory.
pub fn channel_groups(
    files: &[PathBuf],
    config: &Config,
    size: GroupSize,
    limit: Option<MemoryLimit>,
) -> Result<Vec<ChannelGroup>, PipelineError> {
    if let Some(path) = files.iter().find(|path| !path.is_file()) {
        return Err(PipelineError::NotRepeatable { path: path.clone() });
    }
    let mut described = None;
    for path in files {
        described = Collector::instrument_of(path)?;
        if described.is_some() {
            break;
        }
    }
    let Some(described) = described else {
        let path = files.first().cloned().unwrap_or_default();
        return Err(PipelineError::NoInstrument { path });
    };
    let settings = config.ground(WAIT_BYTES);
    settings.fits(&described)?;
    groups_of(&settings.described(&described)?, config, size, limit)
}

fn groups_of(
    instrument: &Instrument,
    config: &Config,
    size: GroupSize,
    limit: Option<MemoryLimit>,
) -> Result<Vec<ChannelGroup>, PipelineError> {
    let map = &config.map;
    let solutions = if map.snapshot_every_s > 0.0 { 2 } else { 1 };
    let channels = (0..).map(ChannelId).zip(&instrument.channels);
    let mut groups: Vec<(ChannelGroup, Vec<EngineCost>)> = Vec::new();
    for (channel, described) in channels.filter(|(channel, _)| map.maps(*channel)) {
        let visibilities = map.refine.visibilities_max as f64;
        let data = ChannelData { frequency_hz: described.frequency_hz, visibilities, windows: f64::INFINITY };
        let cost = EngineCost::of(map, data);
        let needed_bytes = |costs: &[EngineCost]| memory_bytes(0.0, costs, solutions);
        let exceeded = |costs: &[EngineCost]| limit.filter(|limit| needed_bytes(costs) > limit.bytes as f64);
        if let Some(limit) = exceeded(&[cost]) {
            return Err(PipelineError::Memory { needed_bytes: needed_bytes(&[cost]), limit });
        }
        if let Some((group, costs)) = groups.last_mut() {
            costs.push(cost);
            let has_room = match size {
                GroupSize::Automatic => exceeded(costs).is_none(),
                GroupSize::Channels(most) => group.len() < most,
            };
            if has_room {
                group.insert(channel);
                continue;
            }
        }
        groups.push((ChannelGroup::from([channel]), vec![cost]));
    }
    Ok(groups.into_iter().map(|(group, _)| group).collect())
}

/// As [`replay`](super::replay) of files, group by group. When it is cancelled, the maps of the groups before stay, and those
/// of a first group.
///
/// # Errors
/// Those of a replay; files that change on the way.
pub fn replay_in_groups(
    files: &[PathBuf],
    config: &Config,
    groups: &[ChannelGroup],
    out: &Path,
    cancel: &Cancel,
    watch: GroupWatcher<'_>,
) -> Result<RunSummary, PipelineError> {
    let _lock = lock_folder(out)?;
    let mut pass = |number: usize| {
        let settings = GroundConfig { group: groups.get(number).cloned(), ..config.ground(WAIT_BYTES) };
        let (source, ground) = (FileSource::open(files)?, Ground::new(&settings)?);
        let ended = ground_alone(Truth::unknown(), source, config, ground, out, cancel, &mut |watched| {
            watch(number, watched);
        })?;
        summarise(RunScope::Ground, config, out, ended)
    };
    let mut whole = pass(0)?;
    for number in 1..groups.len() {
        if whole.cancelled {
            break;
        }
        let part = pass(number)?;
        if part.cancelled {
            // Its maps hold less data than those before, and no ledger could be common to both.
            part.channels.iter().flat_map(|channel| &channel.files).for_each(|file| {
                let _ = fs::remove_file(out.join(file));
            });
            whole.cancelled = true;
            break;
        }
        let sampled = [whole.ledger.sampled, part.ledger.sampled];
        if sampled[0] != sampled[1] {
            return Err(PipelineError::FilesChanged { before: sampled[0], now: sampled[1] });
        }
        whole = whole.and(part);
    }
    finish(whole, out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::ConfigSource;

    fn planned(size: GroupSize, limit_gb: u64, sets: &[&str]) -> Result<Vec<Vec<u16>>, PipelineError> {
        let mut overrides = vec!["spacecraft.channels_hz=[1e6, 3e6, 10e6, 20e6, 30e6]".to_owned()];
        overrides.extend(sets.iter().map(|set| (*set).to_owned()));
        let config = ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap();
        let plan = crate::pipeline::Plan::new(config).unwrap();
        let limit = Some(MemoryLimit::of_user(limit_gb * 1_000_000_000));
        let groups = groups_of(&plan.instrument, &plan.config, size, limit)?;
        Ok(groups.into_iter().map(|group| group.into_iter().map(|channel| channel.0).collect()).collect())
    }

    #[test]
    fn as_many_channels_as_memory_holds_are_a_group() {
        // Half of a symmetric matrix of 49152 pixels, 9.7 GB a channel.
        let fine = ["map.nside=64", "map.snapshot_every_s=0"];
        let automatic = |limit_gb| planned(GroupSize::Automatic, limit_gb, &fine);
        assert_eq!(automatic(1000).unwrap(), [vec![0, 1, 2, 3, 4]]);
        assert_eq!(automatic(24).unwrap(), [vec![0, 1], vec![2, 3], vec![4]]);
        assert_eq!(automatic(12).unwrap(), [[0], [1], [2], [3], [4]]);
        assert!(matches!(automatic(8), Err(PipelineError::Memory { .. })));
        let by_three = planned(GroupSize::Channels(3), 1000, &fine).unwrap();
        assert_eq!(by_three, [vec![0, 1, 2], vec![3, 4]]);
        // A number is the user's to choose; what cannot be at all is refused.
        assert!(planned(GroupSize::Channels(1), 8, &fine).is_err());
        let some =
            planned(GroupSize::Channels(2), 1000, &["map.channels=[4, 0, 3]", "map.snapshot_every_s=0"])
                .unwrap();
        assert_eq!(some, [vec![0, 3], vec![4]]);
        // The sums of the harmonic engine count as complete.
        let harmonic = ["map.nside=64", "map.snapshot_every_s=0", "map.engine=harmonic", "map.l_max=160"];
        let groups = planned(GroupSize::Automatic, 20, &harmonic).unwrap();
        assert!(groups.len() > 1 && groups.concat() == [0, 1, 2, 3, 4], "{groups:?}");
    }
}
