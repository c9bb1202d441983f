//! The sink of the ground segment: writes maps, pictures and summaries into a folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::Serialize;

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
    /// Where failures are told, if they end nothing.
    trouble: Option<ProductsWatch>,
    /// The last map of a channel whose files could not be written.
    unwritten: BTreeMap<ChannelId, Solution>,
}

/// Time after which files that could not be written are tried again.
const AGAIN: Duration = Duration::from_secs(5);

/// Waits before files that could not be written are tried a last time.
const LAST_WAITS: [Duration; 3] = [Duration::ZERO, Duration::from_millis(200), Duration::from_secs(1)];

/// How the files of products went.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ProductsReport {
    /// Attempts that failed.
    pub failed: u64,
    /// Why the last attempt failed; `None` if it did not.
    pub unwritten: Option<String>,
}

/// The report on the products of a ground at work; clones share it.
#[derive(Clone, Debug, Default)]
pub struct ProductsWatch(Arc<Mutex<ProductsReport>>);

impl ProductsWatch {
    /// The report so far.
    #[must_use]
    pub fn report(&self) -> ProductsReport {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn update(&self, failure: Option<&ProductsError>) {
        let mut report = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        report.failed += u64::from(failure.is_some());
        report.unwritten = failure.map(ToString::to_string);
    }
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
            trouble: None,
            unwritten: BTreeMap::new(),
        })
    }

    /// Shows every map to `viewers`, once its files are written.
    #[must_use]
    pub fn shown_to(self, viewers: MapWatch) -> Self {
        Self { viewers, ..self }
    }

    /// Goes on if files cannot be written, says so to `watch`, and tries again after a while, with the next map, and at the end.
    #[must_use]
    pub fn persisting(self, watch: &ProductsWatch) -> Self {
        Self { trouble: Some(watch.clone()), ..self }
    }

    fn publish(&mut self, solution: &Solution, viewers: &MapWatch) -> Result<(), ProductsError> {
        let channel = solution.channel;
        if !self.channels.contains_key(&channel) {
            let truth = self.truth.channel(channel);
            let opened = ChannelFolder::open(&self.folder, &self.config, truth, solution)?;
            let opened = if self.trouble.is_some() { opened.leaving_room() } else { opened };
            self.channels.insert(channel, opened);
        }
        if let Some(folder) = self.channels.get_mut(&channel) {
            folder.publish(solution, &self.provenance, viewers)?;
            self.published += 1;
        }
        Ok(())
    }

    /// Tries to write what could not be written.
    fn write_again(&mut self) -> Result<(), ProductsError> {
        while let Some((channel, solution)) = self.unwritten.pop_first() {
            if let Err(error) = self.publish(&solution, &MapWatch::default()) {
                self.unwritten.insert(channel, solution);
                return Err(error);
            }
        }
        Ok(())
    }
}

impl Sink for Publisher {
    type In = Solution;
    type Error = ProductsError;

    fn take(&mut self, solution: Solution) -> Result<(), ProductsError> {
        let viewers = self.viewers.clone();
        let Some(trouble) = self.trouble.clone() else { return self.publish(&solution, &viewers) };
        // A newer map takes the place of one that could not be written.
        self.unwritten.remove(&solution.channel);
        let written = self.publish(&solution, &viewers);
        let failure = match written {
            Err(error) => {
                self.unwritten.insert(solution.channel, solution);
                Some(error)
            }
            Ok(()) => self.write_again().err(),
        };
        trouble.update(failure.as_ref());
        Ok(())
    }

    fn finish(&mut self) -> Result<(), ProductsError> {
        let mut last = Ok(());
        for wait in LAST_WAITS {
            std::thread::sleep(wait);
            last = self.write_again();
            if last.is_ok() {
                break;
            }
        }
        last?;
        let channels = std::mem::take(&mut self.channels).into_values();
        let finished: Vec<ChannelSummary> = channels.filter_map(ChannelFolder::into_summary).collect();
        *self.summaries.lock().unwrap_or_else(PoisonError::into_inner) = finished;
        Ok(())
    }

    fn tries_again_after(&self) -> Option<Duration> {
        (!self.unwritten.is_empty()).then_some(AGAIN)
    }

    fn try_again(&mut self) {
        let failure = self.write_again().err();
        if let Some(trouble) = &self.trouble {
            trouble.update(failure.as_ref());
        }
    }

    fn units(&self) -> Units {
        Units::of(self.published, "maps")
    }
}
