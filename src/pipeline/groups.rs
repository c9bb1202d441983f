//! Maps of many channels, group by group: the downlink is read once a group, so that the sums of a few channels are in memory
//! at a time. Maps and ledger are those of all channels at once. A group that is mapped stays mapped: a run that was cancelled goes
//! on with the next one.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use serde::Serialize;

use super::config::Config;
use super::cost::memory_bytes;
use super::error::PipelineError;
use super::memory::MemoryLimit;
use super::plan::Plan;
use super::run::{Watched, downlink_file, finish, ground_alone, lock_products, summarise, write_settings};
use super::simulation_groups::simulate_in_groups;
use super::space_segment;
use super::summary::{PassRecord, RunScope, RunSummary};
use crate::downlink::FileSource;
use crate::files::write_atomically;
use crate::frames::Instrument;
use crate::ground::{Collector, Ground, GroundConfig, WAIT_BYTES};
use crate::imaging::circle::SumPart;
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::{ChannelGroup, MapConfig};
use crate::products::{ProductsError, Truth};
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

/// Channels that are mapped together.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct MapGroup {
    /// Channels.
    pub channels: ChannelGroup,
    /// Parts in which their sums are made, each by reading the downlink, to wait on disk for the solution; 1 for sums in memory.
    pub parts: usize,
}

/// A reading of the downlink that is about to begin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MapStep {
    /// Number of the group, from 0.
    pub group: usize,
    /// Part of its sums, from 0.
    pub part: usize,
    /// Parts of its sums.
    pub parts: usize,
}

impl fmt::Display for MapStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.parts {
            1 => Ok(()),
            parts => write!(f, ", part {} of {parts} of the sums", self.part + 1),
        }
    }
}

/// Receives what is about to be read, and the handles of its graph, which is about to run.
pub type GroupWatcher<'a> = &'a mut dyn FnMut(MapStep, Watched);

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
) -> Result<Vec<MapGroup>, PipelineError> {
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
) -> Result<Vec<MapGroup>, PipelineError> {
    let map = &config.map;
    let costs = complete_costs(instrument, map);
    let of_costs = |costs: &[EngineCost]| memory_bytes(0.0, costs, solutions_of(map));
    // Of a channel alone: what its sums in parts need, which have no snapshots on the way.
    let parts = |channel: &ChannelId| {
        let needed = |cost| match cost == costs[channel] {
            true => of_costs(&[cost]),
            false => memory_bytes(0.0, &[cost], 1),
        };
        limit.map_or(Some(1), |limit| costs[channel].parts_within(map, limit.bytes as f64, needed))
    };
    let needed = |group: &[ChannelId]| match group {
        [only] if parts(only).is_some_and(|parts| parts > 1) => 0.0,
        _ => of_costs(&group.iter().filter_map(|channel| costs.get(channel)).copied().collect::<Vec<_>>()),
    };
    let groups = partition(costs.keys().copied(), size, limit, needed)?;
    let with_parts = |channels: ChannelGroup| {
        let alone = channels.first().filter(|_| channels.len() == 1);
        MapGroup { parts: alone.and_then(parts).unwrap_or(1), channels }
    };
    Ok(groups.into_iter().map(with_parts).collect())
}

/// What a channel's sums cost at the end of a mission of any length.
fn complete_costs(instrument: &Instrument, map: &MapConfig) -> BTreeMap<ChannelId, EngineCost> {
    let channels = (0..).map(ChannelId).zip(&instrument.channels);
    let cost = |frequency_hz: f64| {
        let visibilities = map.refine.visibilities_max as f64;
        EngineCost::of(map, ChannelData { frequency_hz, visibilities, windows: f64::INFINITY })
    };
    channels
        .filter(|(channel, _)| map.maps(*channel))
        .map(|(channel, described)| (channel, cost(described.frequency_hz)))
        .collect()
}

/// Solutions that matter to memory.
fn solutions_of(map: &MapConfig) -> u64 {
    if map.snapshot_every_s > 0.0 { 2 } else { 1 }
}

/// What a ground should know before the sums of its channels grow beyond the memory that there is.
#[derive(Clone, Debug, PartialEq)]
pub struct MemoryAdvice {
    /// Channels that are mapped.
    pub channels: usize,
    /// nside of their maps.
    pub nside: usize,
    /// Estimated memory of the complete sums of all of them, bytes.
    pub needed_bytes: f64,
    /// What is available.
    pub limit: MemoryLimit,
    /// A smaller nside whose sums fit, and their memory, bytes.
    pub fitting: Option<(usize, f64)>,
}

impl MemoryAdvice {
    /// Advice for a ground with these settings; `None` if the complete sums fit.
    #[must_use]
    pub fn of(config: &Config, instrument: &Instrument, limit: MemoryLimit) -> Option<Self> {
        let needed = |map: &MapConfig| {
            let costs: Vec<EngineCost> = complete_costs(instrument, map).into_values().collect();
            (costs.len(), memory_bytes(0.0, &costs, solutions_of(map)))
        };
        let (channels, needed_bytes) = needed(&config.map);
        if needed_bytes <= limit.bytes as f64 {
            return None;
        }
        let halves = std::iter::successors(Some(config.map.nside / 2), |nside| Some(nside / 2));
        let fitting = halves.take_while(|nside| *nside > 0).find_map(|nside| {
            let map = MapConfig { nside, l_max: 0, ..config.map.clone() };
            Some((nside, needed(&map).1)).filter(|(_, bytes)| *bytes <= limit.bytes as f64)
        });
        Some(Self { channels, nside: config.map.nside, needed_bytes, limit, fitting })
    }
}

impl fmt::Display for MemoryAdvice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let gigabytes = |bytes: f64| format!("{:.1} GB", bytes / 1e9);
        write!(
            f,
            "the sums of {} channels at map.nside = {} grow to an estimated {} over a mission, and {} are available ({})",
            self.channels,
            self.nside,
            gigabytes(self.needed_bytes),
            gigabytes(self.limit.bytes as f64),
            self.limit.source
        )?;
        if let Some((nside, bytes)) = self.fitting {
            write!(f, "; at map.nside = {nside} they take {}", gigabytes(bytes))?;
        }
        write!(
            f,
            "; --channels maps some of them, and replay --groups auto of files as many at a time as fit"
        )
    }
}

/// Divides channels into groups of neighbours of this size, or of as many as `limit` has room for.
///
/// # Errors
/// A channel for which alone there is too little memory.
pub(super) fn partition(
    channels: impl Iterator<Item = ChannelId>,
    size: GroupSize,
    limit: Option<MemoryLimit>,
    needed_bytes: impl Fn(&[ChannelId]) -> f64,
) -> Result<Vec<ChannelGroup>, PipelineError> {
    let exceeded = |group: &[ChannelId]| limit.filter(|limit| needed_bytes(group) > limit.bytes as f64);
    let mut groups: Vec<Vec<ChannelId>> = Vec::new();
    for channel in channels {
        if let Some(limit) = exceeded(&[channel]) {
            return Err(PipelineError::Memory { needed_bytes: needed_bytes(&[channel]), limit });
        }
        if let Some(group) = groups.last_mut() {
            group.push(channel);
            let has_room = match size {
                GroupSize::Automatic => exceeded(group).is_none(),
                GroupSize::Channels(most) => group.len() <= most,
            };
            if has_room {
                continue;
            }
            group.pop();
        }
        groups.push(vec![channel]);
    }
    Ok(groups.into_iter().map(ChannelGroup::from_iter).collect())
}

/// As [`replay`](super::replay) of files, group by group. When it is cancelled, the maps of the groups before stay, and those
/// of a first group; a later call with the same files, settings and folder goes on with the next group.
///
/// # Errors
/// Those of a replay; files that change on the way.
pub fn replay_in_groups(
    files: &[PathBuf],
    config: &Config,
    groups: &[MapGroup],
    out: &Path,
    cancel: &Cancel,
    watch: GroupWatcher<'_>,
) -> Result<RunSummary, PipelineError> {
    let _lock = lock_products(config, out)?;
    let passes = Passes { scope: RunScope::Ground, files, config, groups, out };
    let summary = passes.run(&|_| Ok(Truth::unknown()), cancel, watch)?;
    finish(summary, out)
}

/// Settings for maps, group by group, of the same files.
struct Passes<'a> {
    scope: RunScope,
    files: &'a [PathBuf],
    config: &'a Config,
    groups: &'a [MapGroup],
    out: &'a Path,
}

impl Passes<'_> {
    /// Maps the groups that no earlier call has.
    fn run(
        &self,
        truth: &dyn Fn(&ChannelGroup) -> Result<Truth, PipelineError>,
        cancel: &Cancel,
        watch: GroupWatcher<'_>,
    ) -> Result<RunSummary, PipelineError> {
        let Self { scope, files, config, groups, out } = *self;
        let mut done: Vec<PassRecord> = Vec::new();
        let mut last: Option<RunSummary> = None;
        for (number, MapGroup { channels: group, parts }) in groups.iter().enumerate() {
            let (path, key) = (out.join(record_name(group)), self.key(group));
            let is_last = number + 1 == groups.len();
            // The summary is that of the last pass, which is always made.
            if let Some(record) = PassRecord::read(&path, key, out).filter(|_| !is_last) {
                done.push(record);
                continue;
            }
            let mut step = MapStep { group: number, part: 0, parts: *parts };
            let mut part = (*parts > 1).then(|| SumPart::first(*parts, out));
            let ended = loop {
                let next = part.as_ref().and_then(SumPart::next);
                let settings = GroundConfig {
                    group: Some(group.clone()),
                    part: part.take(),
                    ..config.ground(WAIT_BYTES)
                };
                let (source, ground) = (FileSource::open(files)?, Ground::new(&settings)?);
                // Only with the last part there is a map.
                let truth = if next.is_some() { Truth::unknown() } else { truth(group)? };
                let mut watch = |watched| watch(step, watched);
                let ended = ground_alone(truth, source, config, ground, out, cancel, &mut watch)?;
                if next.is_none() || cancel.is_cancelled() {
                    break ended;
                }
                part = next;
                step.part += 1;
            };
            let powers = ended.powers();
            let mut pass = summarise(scope, config, out, ended)?;
            if number > 0 {
                // Each pass takes the auto-correlations of all channels; they count in the first.
                pass.ledger.accumulated = pass.ledger.accumulated.saturating_sub(powers);
            }
            let is_cut = pass.cancelled;
            if let Some(before) = done.pop_if(|_| is_cut) {
                // Its maps hold less data than those before, and no ledger could be common to both.
                pass.channels.iter().flat_map(|channel| &channel.files).for_each(|file| {
                    let _ = fs::remove_file(out.join(file));
                });
                (pass.ledger, pass.channels) = (before.ledger, before.channels);
            }
            let sampled = done.last().map(|before| before.ledger.sampled);
            if let Some(before) = sampled.filter(|before| *before != pass.ledger.sampled) {
                return Err(PipelineError::FilesChanged { before, now: pass.ledger.sampled });
            }
            if let Some(before) = last.take() {
                pass.earlier_reports = before.earlier_reports;
                pass.earlier_reports.push(before.report);
            }
            if !is_cut && !is_last {
                let record = PassRecord::of(&pass, out)?;
                record.write(&path, key)?;
                done.push(record);
            }
            last = Some(pass);
            if is_cut {
                break;
            }
        }
        let Some(mut summary) = last else {
            return Err(PipelineError::NotInGroups { found: "no channel", expected: "at least one" });
        };
        for record in done.into_iter().rev() {
            summary = summary.after(record);
        }
        if !summary.cancelled {
            // Whoever repeats the command wants all of it again.
            groups.iter().for_each(|group| {
                let _ = fs::remove_file(out.join(record_name(&group.channels)));
            });
        }
        Ok(summary)
    }

    /// A number that calls share of which one can go on where the other was cancelled.
    fn key(&self, group: &ChannelGroup) -> u64 {
        let Self { files, config, .. } = self;
        let file = |path: &PathBuf| {
            let found = fs::metadata(path).ok();
            let changed = found.as_ref().and_then(|found| found.modified().ok());
            let since = changed.and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
            (path.clone(), found.map(|found| found.len()), since)
        };
        let files: Vec<_> = files.iter().map(file).collect();
        let channels: Vec<u16> = group.iter().map(|channel| channel.0).collect();
        let hashes = (config.space_hash(), config.ground_hash());
        let text =
            format!("{} {hashes:?} {files:?} {channels:?} {:?}", env!("CARGO_PKG_VERSION"), config.products);
        crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, text.as_bytes())
    }
}

/// Groups of channels in which a run is made.
#[derive(Clone, Debug, Serialize)]
pub struct RunGroups {
    /// Those that are simulated together.
    pub simulated: Vec<ChannelGroup>,
    /// Those that are mapped together.
    pub mapped: Vec<MapGroup>,
}

impl fmt::Display for RunGroups {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let range = |group: &ChannelGroup| match (group.first(), group.last()) {
            (Some(first), Some(last)) if first != last => format!("{first}-{last}"),
            (Some(only), _) => only.to_string(),
            _ => String::new(),
        };
        let mapped = |group: &MapGroup| match group.parts {
            1 => range(&group.channels),
            parts => format!("{} (sums on disk, in {parts} parts)", range(&group.channels)),
        };
        let simulated: Vec<String> = self.simulated.iter().map(range).collect();
        let mapped: Vec<String> = self.mapped.iter().map(mapped).collect();
        writeln!(f, "simulated        in {} groups of channels: {}", simulated.len(), simulated.join(", "))?;
        write!(f, "mapped           in {} groups of channels: {}", mapped.len(), mapped.join(", "))
    }
}

impl Plan {
    /// The groups of a run: of this size, or as many channels as memory has room for.
    ///
    /// # Errors
    /// Samples; a channel for which alone there is too little memory.
    #[doc(hidden)]
    pub fn run_groups(
        &self,
        size: GroupSize,
        limit: Option<MemoryLimit>,
    ) -> Result<RunGroups, PipelineError> {
        let mapped = groups_of(&self.instrument, &self.config, size, limit)?;
        Ok(RunGroups { simulated: self.simulation_groups(size, limit)?, mapped })
    }
}

/// Simulates the channels and maps them in `out`, group by group: first all visibilities, then the maps.
///
/// What [`run`](super::run()) leaves, byte for byte but for times and the number of passes in the summary; `None` if it was cancelled
/// before there was a downlink. After a cancellation the same call goes on: groups that are simulated or mapped stay as they are.
///
/// # Errors
/// Those of a run.
pub fn run_in_groups(
    plan: &Plan,
    groups: &RunGroups,
    out: &Path,
    cancel: &Cancel,
    watch: GroupStepWatcher<'_>,
) -> Result<Option<RunSummary>, PipelineError> {
    let config = &plan.config;
    let _lock = lock_products(config, out)?;
    write_settings(config, out)?;
    let RunGroups { simulated, mapped } = groups;
    let file = out.join(downlink_file(config.downlink.format));
    let marker = out.join(SIMULATED);
    let is_made = |key: String| fs::read(&marker).is_ok_and(|found| found == key.as_bytes());
    if !is_made(downlink_key(plan, &file)) {
        let reports = simulate_in_groups(plan, simulated, &file, cancel, watch)?;
        if reports.last().is_some_and(|report| report.cancelled) {
            return Ok(None);
        }
        write_atomically(&marker, downlink_key(plan, &file).as_bytes())
            .map_err(|source| ProductsError::Write { path: marker.clone(), source })?;
    }
    let watch = RefCell::new(watch);
    let truth = |group: &ChannelGroup| {
        group.iter().try_fold(Truth::unknown(), |truth, &channel| {
            (watch.borrow_mut())(GroupStep::Sky(channel), None);
            Ok(truth.with(channel, &space_segment::sky(plan, channel)?, config.map_shape())?)
        })
    };
    let files = [file];
    let passes = Passes { scope: RunScope::Whole, files: &files, config, groups: mapped, out };
    let summary = passes.run(&truth, cancel, &mut |step, watched| {
        (watch.borrow_mut())(GroupStep::Mapped(step), Some(watched));
    })?;
    let summary = finish(summary, out)?;
    if !summary.cancelled {
        let _ = fs::remove_file(&marker);
    }
    Ok(Some(summary))
}

/// What a run in groups is about to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupStep {
    /// Make the sky of a channel.
    Sky(ChannelId),
    /// Simulate the group of this number, from 0.
    Simulated(usize),
    /// Make the downlink of all that was simulated.
    Merged,
    /// Read the downlink for a group, and map it.
    Mapped(MapStep),
}

/// Receives what is about to be done, and the handles of its graph; a sky is made without one.
pub type GroupStepWatcher<'a> = &'a mut dyn FnMut(GroupStep, Option<Watched>);

/// Name of the file that says that the downlink of a run in groups is whole, and of what.
const SIMULATED: &str = ".simulated";

/// What a downlink was made of, and how long it is.
fn downlink_key(plan: &Plan, file: &Path) -> String {
    let config = &plan.config;
    let bytes = fs::metadata(file).map_or(0, |found| found.len());
    format!("{} {:016x} {:?} {bytes}", env!("CARGO_PKG_VERSION"), config.space_hash(), config.downlink)
}

/// Name of the file that keeps what a summary says of a group that is mapped.
fn record_name(group: &ChannelGroup) -> String {
    let channels: Vec<String> = group.iter().map(ToString::to_string).collect();
    let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, channels.join(",").as_bytes());
    format!(".group-{crc:08x}")
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
        Ok(groups
            .into_iter()
            .map(|group| group.channels.into_iter().map(|channel| channel.0).collect())
            .collect())
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
