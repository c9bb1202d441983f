//! Steps of a run in groups of channels, for progress.

use std::fmt;

use crate::pipeline::graph::RunView;
use crate::units::ChannelId;

/// One reading of the downlink, for a group or a part of its sums.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MapStep {
    /// Number of the group, from 0.
    pub group: usize,
    /// Part of the group's sums, from 0.
    pub part: usize,
    /// Number of parts of the group's sums.
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

/// The next step of a run in groups.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GroupStep {
    /// Generate or read the sky of a channel.
    Sky(ChannelId),
    /// Simulate the group of this number, from 0.
    Simulate(usize),
    /// Merge the simulated groups into one downlink.
    Merge,
    /// Read the downlink for a group, and map it.
    Map(MapStep),
}

/// Callback that receives each step before it runs, with the handles of its graph; [`GroupStep::Sky`] has none.
pub type GroupStepWatcher<'a> = &'a mut dyn FnMut(GroupStep, Option<RunView>);
