//! Which channels fit into memory together: groups for the simulation and for the maps.

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

/// Groups of channels in which a run is made.
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

    /// Groups of the channels for a simulation, in their order.
    ///
    /// # Errors
    /// Samples, which are simulated for all channels together; a channel for which alone there is too little memory.
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
        let (shared, each) = self.simulation_bytes_by_channel();
        let needed = |group: &[ChannelId]| {
            shared + group.iter().filter_map(|channel| each.get(usize::from(channel.0))).sum::<f64>()
        };
        let channels = (0..).map(ChannelId).take(each.len());
        partition(channels, size, limit, needed)
    }
}

pub(in crate::pipeline) fn groups_of(
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

/// Memory of a channel's sums at the end of a mission of any length.
pub(in crate::pipeline) fn complete_costs(
    instrument: &Instrument,
    map: &MapConfig,
) -> BTreeMap<ChannelId, EngineCost> {
    let channels = (0..).map(ChannelId).zip(&instrument.channels);
    let cost = |frequency_hz: f64| {
        let visibilities = map.refine.visibilities_max as f64;
        EngineCost::estimate(map, ChannelData { frequency_hz, visibilities, windows: f64::INFINITY })
    };
    channels
        .filter(|(channel, _)| map.is_mapped(*channel))
        .map(|(channel, described)| (channel, cost(described.frequency_hz)))
        .collect()
}

/// Solutions that matter to memory.
pub(in crate::pipeline) fn solutions_of(map: &MapConfig) -> u64 {
    if map.snapshot_every_s > 0.0 { 2 } else { 1 }
}

/// Divides channels into groups of neighbours of this size, or of as many as `limit` has room for.
///
/// # Errors
/// A channel for which alone there is too little memory.
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
        let fine = ["map.nside=64", "map.snapshot_every_s=0", "map.engine=pixel"];
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
