//! Division of channels into groups that fit into memory, for the simulation and for the maps.

use std::collections::BTreeMap;
use std::fmt;

use serde::Serialize;

use super::estimate::memory_bytes;
use crate::frames::Instrument;
use crate::imaging::cost::{ChannelData, EngineCost};
use crate::imaging::{ChannelGroup, MapConfig};
use crate::mother::Fidelity;
use crate::pipeline::config::{Config, MemoryLimit, PipelineError, Plan};
use crate::units::ChannelId;

/// Number of channels per group.
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
    /// The channels.
    pub channels: ChannelGroup,
    /// Number of parts in which the sums are accumulated, with one reading of the downlink and a file for each; 1 for sums in memory.
    pub parts: usize,
}

/// Groups of channels of a whole run.
#[derive(Clone, Debug, Serialize)]
pub struct RunGroups {
    /// Groups of channels that are simulated together.
    pub simulated: Vec<ChannelGroup>,
    /// Groups of channels that are mapped together.
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
        writeln!(
            f,
            "simulated        in groups of channels ({}): {}",
            simulated.len(),
            simulated.join(", ")
        )?;
        write!(f, "mapped           in groups of channels ({}): {}", mapped.len(), mapped.join(", "))
    }
}

impl Plan {
    /// Divides the channels into groups of the given size, or into groups that fit into memory.
    ///
    /// # Errors
    /// A simulation of samples; joint maps; a single channel that does not fit into memory.
    #[doc(hidden)]
    pub fn run_groups(
        &self,
        size: GroupSize,
        limit: Option<MemoryLimit>,
    ) -> Result<RunGroups, PipelineError> {
        if self.config.joint.on {
            return Err(PipelineError::NotJoint { with: "--groups" });
        }
        let mapped = map_groups(&self.instrument, &self.config, size, limit)?;
        Ok(RunGroups { simulated: self.simulation_groups(size, limit)?, mapped })
    }

    /// Divides the channels into groups for the simulation, in order.
    ///
    /// # Errors
    /// A simulation of samples, which has to include all channels; a single channel that does not fit into memory.
    #[doc(hidden)]
    pub fn simulation_groups(
        &self,
        size: GroupSize,
        limit: Option<MemoryLimit>,
    ) -> Result<Vec<ChannelGroup>, PipelineError> {
        if self.config.spacecraft.fidelity == Fidelity::Samples {
            return Err(PipelineError::NotInGroups {
                found: "spacecraft.fidelity = \"samples\"",
                expected: "\"visibilities\": samples hold all channels together",
            });
        }
        let (shared_bytes, channel_bytes) = self.simulation_bytes_by_channel();
        let needed_bytes = |group: &[ChannelId]| {
            let bytes = group.iter().filter_map(|channel| channel_bytes.get(usize::from(channel.0)));
            shared_bytes + bytes.sum::<f64>()
        };
        let channels = (0..).map(ChannelId).take(channel_bytes.len());
        partition(channels, size, limit, needed_bytes)
    }
}

/// Divides the mapped channels of an instrument into groups. A channel whose sums do not fit into memory is a group of its own, with
/// sums in parts.
///
/// # Errors
/// A single channel that does not fit into memory.
pub(in crate::pipeline) fn map_groups(
    instrument: &Instrument,
    config: &Config,
    size: GroupSize,
    limit: Option<MemoryLimit>,
) -> Result<Vec<MapGroup>, PipelineError> {
    let map = &config.map;
    let costs = complete_costs(instrument, map, config.calibration.known_error_draws());
    let group_bytes = |costs: &[EngineCost]| memory_bytes(0.0, costs, memory_solutions(map));
    // Sums in parts have no snapshots before the end.
    let parts = |channel: &ChannelId| {
        let needed = |cost| match cost == costs[channel] {
            true => group_bytes(&[cost]),
            false => memory_bytes(0.0, &[cost], 1),
        };
        limit.map_or(Some(1), |limit| costs[channel].parts_within(map, limit.bytes as f64, needed))
    };
    let needed = |group: &[ChannelId]| match group {
        [only] if parts(only).is_some_and(|parts| parts > 1) => 0.0,
        _ => group_bytes(&group.iter().filter_map(|channel| costs.get(channel)).copied().collect::<Vec<_>>()),
    };
    let groups = partition(costs.keys().copied(), size, limit, needed)?;
    let with_parts = |channels: ChannelGroup| {
        let single = channels.first().filter(|_| channels.len() == 1);
        MapGroup { parts: single.and_then(parts).unwrap_or(1), channels }
    };
    Ok(groups.into_iter().map(with_parts).collect())
}

/// Cost of each mapped channel at the end of a mission of unlimited length.
pub(in crate::pipeline) fn complete_costs(
    instrument: &Instrument,
    map: &MapConfig,
    error_draws: usize,
) -> BTreeMap<ChannelId, EngineCost> {
    let channels = (0..).map(ChannelId).zip(&instrument.channels);
    let cost = |frequency_hz: f64| {
        let (visibilities, solutions) = (map.refine.visibilities_max as f64, memory_solutions(map));
        let unlimited = f64::INFINITY;
        map.cost(ChannelData {
            frequency_hz,
            visibilities,
            windows: unlimited,
            // The whole matrix of a short mission counts.
            node_turns: 0.0,
            duration_s: unlimited,
            every_nth: 1.0,
            solutions,
            limb_range_rad: unlimited,
            error_draws,
        })
    };
    channels
        .filter(|(channel, _)| map.is_mapped(*channel))
        .map(|(id, channel)| (id, cost(channel.frequency_hz)))
        .collect()
}

/// Number of solutions for estimates of memory: 2 stands for any number of snapshots.
pub(in crate::pipeline) fn memory_solutions(map: &MapConfig) -> u64 {
    if map.snapshot_every_s > 0.0 { 2 } else { 1 }
}

/// Divides channels into groups of consecutive channels, of the given size or as large as `limit` permits.
///
/// # Errors
/// A single channel that does not fit into memory.
pub(in crate::pipeline) fn partition(
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
                GroupSize::Channels(count) => group.len() <= count,
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::ConfigSource;

    fn grouped(size: GroupSize, limit_gb: u64, sets: &[&str]) -> Result<Vec<Vec<u16>>, PipelineError> {
        let mut overrides = vec!["spacecraft.channels_hz=[1e6, 3e6, 10e6, 20e6, 30e6]".to_owned()];
        overrides.extend(sets.iter().map(|set| (*set).to_owned()));
        let config = ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap();
        let plan = crate::pipeline::Plan::new(config).unwrap();
        let limit = Some(MemoryLimit::of_user(limit_gb * 1_000_000_000));
        let groups = map_groups(&plan.instrument, &plan.config, size, limit)?;
        Ok(groups
            .into_iter()
            .map(|group| group.channels.into_iter().map(|channel| channel.0).collect())
            .collect())
    }

    #[test]
    fn groups_are_as_large_as_memory_permits() {
        // Half of a symmetric matrix of 49152 pixels: 9.7 GB per channel.
        let fine = ["map.nside=64", "map.snapshot_every_s=0", "map.engine=pixel"];
        let automatic = |limit_gb| grouped(GroupSize::Automatic, limit_gb, &fine);
        assert_eq!(automatic(1000).unwrap(), [vec![0, 1, 2, 3, 4]]);
        assert_eq!(automatic(24).unwrap(), [vec![0, 1], vec![2, 3], vec![4]]);
        assert_eq!(automatic(12).unwrap(), [[0], [1], [2], [3], [4]]);
        assert!(matches!(automatic(8), Err(PipelineError::Memory { .. })));
        let by_three = grouped(GroupSize::Channels(3), 1000, &fine).unwrap();
        assert_eq!(by_three, [vec![0, 1, 2], vec![3, 4]]);
        // The user chooses the size, but a single channel has to fit.
        assert!(grouped(GroupSize::Channels(1), 8, &fine).is_err());
        let some =
            grouped(GroupSize::Channels(2), 1000, &["map.channels=[4, 0, 3]", "map.snapshot_every_s=0"])
                .unwrap();
        assert_eq!(some, [vec![0, 3], vec![4]]);
        // The harmonic engine's sums are estimated at their full size.
        let harmonic = ["map.nside=64", "map.snapshot_every_s=0", "map.engine=harmonic", "map.l_max=160"];
        let groups = grouped(GroupSize::Automatic, 20, &harmonic).unwrap();
        assert!(groups.len() > 1 && groups.concat() == [0, 1, 2, 3, 4], "{groups:?}");
    }
}
