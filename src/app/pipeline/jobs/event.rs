//! What a job of several graphs does next, for progress.

use std::fmt;

use super::calibrate::CalibrateProgress;
use crate::pipeline::graph::RunView;
use crate::units::ChannelId;

/// One reading of the downlink, for a group of channels, a part of its sums, or a case of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MapStep {
    /// Number of the group or case, from 0.
    pub number: usize,
    /// Part of the sums, from 0.
    pub part: usize,
    /// Number of parts of the sums.
    pub parts: usize,
}

impl MapStep {
    /// The only reading for a group or case.
    #[must_use]
    pub fn whole(number: usize) -> Self {
        Self { number, part: 0, parts: 1 }
    }
}

impl fmt::Display for MapStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.parts {
            1 => Ok(()),
            parts => write!(f, ", part {} of {parts} of the sums", self.part + 1),
        }
    }
}

/// What a job does next. Numbers of groups and cases count from 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum JobEvent {
    /// Generate or read the sky of a channel.
    Sky(ChannelId),
    /// Simulate a group of channels, or the downlink that a case shares with others.
    Simulate(usize),
    /// Merge the simulated groups into one downlink.
    Merge,
    /// Calibrate the data for a case: told again whenever there is progress.
    Calibrate(usize, CalibrateProgress),
    /// Read the downlink for a group or case, and map it.
    Map(MapStep),
    /// Map additional noise realisations of a case.
    Realise(usize),
}

/// Callback that receives each event before it happens, with the view of its graph; [`JobEvent::Sky`] and [`JobEvent::Calibrate`]
/// have none.
pub type JobWatcher<'a> = &'a mut dyn FnMut(JobEvent, Option<RunView>);
