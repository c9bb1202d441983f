//! Shows every map to viewers when it is published.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::summary::SnapshotSummary;
use crate::imaging::Solution;
use crate::sky::fits::Card;
use crate::sky::{Comparison, SkyMap};

/// A map that has just been published.
#[derive(Clone, Copy)]
pub struct PublishedMap<'a> {
    /// The solution with the map and its noise-only map.
    pub solution: &'a Solution,
    /// Figures of the map.
    pub figures: &'a SnapshotSummary,
    /// Header cards of the map.
    pub cards: &'a [Card],
    /// Comparison with the true sky, if known.
    pub comparison: Option<&'a Comparison>,
    /// The true sky in the pixels of the map, if known.
    pub input: Option<&'a SkyMap>,
}

/// Gets maps on the thread of the publisher, which waits. It should only take a copy and return.
pub trait MapViewer: Send + Sync {
    /// Takes a map that has just been published.
    fn view(&self, map: PublishedMap<'_>);
}

/// The list of viewers. Clones share it.
#[derive(Clone, Default)]
pub struct MapWatch(Arc<Mutex<Vec<Box<dyn MapViewer>>>>);

impl MapWatch {
    fn viewers(&self) -> MutexGuard<'_, Vec<Box<dyn MapViewer>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a viewer, which gets every map from now on.
    pub fn add_viewer(&self, viewer: Box<dyn MapViewer>) {
        self.viewers().push(viewer);
    }

    pub(super) fn offer(&self, show: impl Fn(&dyn MapViewer)) {
        self.viewers().iter().for_each(|viewer| show(viewer.as_ref()));
    }
}

impl fmt::Debug for MapWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MapWatch").field("viewers", &self.viewers().len()).finish()
    }
}
