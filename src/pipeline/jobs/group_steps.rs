//! Steps of a run in groups of channels, for progress.

use std::fmt;

use crate::pipeline::graph::Watched;
use crate::units::ChannelId;

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

/// The next step of a run in groups.
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
