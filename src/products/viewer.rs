//! The hook for those who look on: every map, as it is published.

use std::fmt;
use std::sync::{Arc, OnceLock};

use super::summary::SnapshotSummary;
use crate::sky::fits::Card;
use crate::sky::{Comparison, SkyMap};
use crate::solve::Solution;

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

/// Where a viewer may join; clones share it. Without one nothing is done.
#[derive(Clone, Default)]
pub struct MapWatch(Arc<OnceLock<Box<dyn MapViewer>>>);

impl MapWatch {
    /// Shows every map from now on to `viewer`; the first who joins stays.
    pub fn join(&self, viewer: Box<dyn MapViewer>) {
        let _ = self.0.set(viewer);
    }

    /// Shows what `map` makes, if anybody looks on.
    pub(super) fn offer<'a>(&self, show: impl FnOnce(&dyn MapViewer) + 'a) {
        if let Some(viewer) = self.0.get() {
            show(viewer.as_ref());
        }
    }
}

impl fmt::Debug for MapWatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("MapWatch").field("viewed", &self.0.get().is_some()).finish()
    }
}
