//! A hook that sees every map as it is published.

use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::summary::SnapshotSummary;
use crate::imaging::Solution;
use crate::sky::fits::Card;
use crate::sky::{Comparison, SkyMap};

/// A map that has just been published.
#[derive(Clone, Copy)]
pub struct PublishedMap<'a> {
    /// The map and its noise-only companion.
    pub solution: &'a Solution,
    /// Its figures.
    pub figures: &'a SnapshotSummary,
    /// Header cards of its file.
    pub cards: &'a [Card],
    /// Spectra of the map, and of the truth if it is known.
    pub comparison: Option<&'a Comparison>,
    /// The true sky in the pixels of the map, if it is known.
    pub input: Option<&'a SkyMap>,
}

/// Sees maps on the publisher's thread, which waits: it takes a copy and returns.
pub trait MapViewer: Send + Sync {
    /// A map was published.
    fn view(&self, map: PublishedMap<'_>);
}

/// Where viewers may join; clones share them. Without one nothing is done.
#[derive(Clone, Default)]
pub struct MapWatch(Arc<Mutex<Vec<Box<dyn MapViewer>>>>);

impl MapWatch {
    fn viewers(&self) -> MutexGuard<'_, Vec<Box<dyn MapViewer>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Shows every map from now on to `viewer`, too.
    pub fn join(&self, viewer: Box<dyn MapViewer>) {
        self.viewers().push(viewer);
    }

    /// Shows what `map` makes, to each who looks on.
    pub(super) fn offer(&self, show: impl Fn(&dyn MapViewer)) {
        self.viewers().iter().for_each(|viewer| show(viewer.as_ref()));
    }
}

impl fmt::Debug for MapWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MapWatch").field("viewers", &self.viewers().len()).finish()
    }
}
