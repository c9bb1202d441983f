//! The sink of the ground segment: writes maps, pictures and summaries into a folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use super::channel::ChannelFolder;
use super::config::ProductsConfig;
use super::error::ProductsError;
use super::provenance::Provenance;
use super::summary::ChannelSummary;
use super::truth::Truth;
use super::viewer::MapWatch;
use crate::imaging::Solution;
use crate::runtime::{Sink, Units};
use crate::units::ChannelId;

/// Writes the solver's solutions, channel by channel.
pub struct Publisher {
    config: ProductsConfig,
    folder: PathBuf,
    truth: Truth,
    provenance: Provenance,
    channels: BTreeMap<ChannelId, ChannelFolder>,
    summaries: Arc<Mutex<Vec<ChannelSummary>>>,
    published: u64,
    viewers: MapWatch,
}

impl Publisher {
    /// A publisher to `folder`, which is created if necessary. At the end it stores the summaries of all channels in
    /// `summaries`.
    ///
    /// # Errors
    /// A folder that cannot be created.
    pub fn new(
        config: ProductsConfig,
        folder: &Path,
        truth: Truth,
        provenance: Provenance,
        summaries: Arc<Mutex<Vec<ChannelSummary>>>,
    ) -> Result<Self, ProductsError> {
        std::fs::create_dir_all(folder)
            .map_err(|source| ProductsError::Write { path: folder.to_owned(), source })?;
        let (folder, viewers) = (folder.to_owned(), MapWatch::default());
        Ok(Self {
            config,
            folder,
            truth,
            provenance,
            channels: BTreeMap::new(),
            summaries,
            published: 0,
            viewers,
        })
    }

    /// Shows every map to `viewers`, once its files are written.
    #[must_use]
    pub fn shown_to(self, viewers: MapWatch) -> Self {
        Self { viewers, ..self }
    }
}

impl Sink for Publisher {
    type In = Solution;
    type Error = ProductsError;

    fn take(&mut self, solution: Solution) -> Result<(), ProductsError> {
        let channel = solution.channel;
        if !self.channels.contains_key(&channel) {
            let truth = self.truth.channel(channel);
            let opened = ChannelFolder::open(&self.folder, &self.config, truth, &solution)?;
            self.channels.insert(channel, opened);
        }
        if let Some(folder) = self.channels.get_mut(&channel) {
            folder.publish(&solution, &self.provenance, &self.viewers)?;
            self.published += 1;
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), ProductsError> {
        let channels = std::mem::take(&mut self.channels).into_values();
        let finished: Vec<ChannelSummary> = channels.filter_map(ChannelFolder::into_summary).collect();
        *self.summaries.lock().unwrap_or_else(PoisonError::into_inner) = finished;
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.published, "maps")
    }
}
