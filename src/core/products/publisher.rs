//! The sink of the ground segment, which writes maps, pictures and summaries into a folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use serde::Serialize;

use super::channel::ChannelFolder;
use super::config::ProductsConfig;
use super::error::{ProductsError, create_folder};
use super::provenance::Provenance;
use super::summary::ChannelSummary;
use super::truth::Truth;
use super::viewer::MapWatch;
use crate::imaging::Solution;
use crate::runtime::{Sink, Units};
use crate::units::ChannelId;

/// Writes the products of solutions into one folder per channel.
pub struct Publisher {
    config: ProductsConfig,
    folder: PathBuf,
    truth: Truth,
    provenance: Provenance,
    channels: BTreeMap<ChannelId, ChannelFolder>,
    written: Arc<Mutex<WrittenProducts>>,
    published: u64,
    viewers: MapWatch,
    /// Report on failures, if these do not end the run.
    watch: Option<ProductsWatch>,
    /// The last map of each channel whose files could not be written.
    unwritten: BTreeMap<ChannelId, Solution>,
}

/// What a publisher has written so far.
#[derive(Clone, Debug, Default)]
pub struct WrittenProducts {
    /// Summaries of the channels with a final map.
    pub channels: Vec<ChannelSummary>,
    /// Files of the other channels, relative to the folder.
    pub intermediate_files: Vec<String>,
}

const RETRY_AFTER: Duration = Duration::from_secs(5);

/// Pauses between attempts to write the remaining files at the end.
const FINAL_PAUSES: [Duration; 3] = [Duration::ZERO, Duration::from_millis(200), Duration::from_secs(1)];

/// Report on the writing of product files.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ProductsReport {
    /// Number of failed attempts.
    pub failed: u64,
    /// Why the last attempt failed; `None` if it did not.
    pub unwritten: Option<String>,
}

/// The report on the product files of a running ground segment. Clones share it.
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
    /// A publisher that writes into `folder`, which it creates if needed. After each map it lists in `written` what there is, as a run that is
    /// ended early may leave no time for more.
    ///
    /// # Errors
    /// A folder that cannot be created.
    pub fn new(
        config: ProductsConfig,
        folder: &Path,
        truth: Truth,
        provenance: Provenance,
        written: Arc<Mutex<WrittenProducts>>,
    ) -> Result<Self, ProductsError> {
        create_folder(folder)?;
        let (folder, viewers) = (folder.to_owned(), MapWatch::default());
        Ok(Self {
            config,
            folder,
            truth,
            provenance,
            channels: BTreeMap::new(),
            written,
            published: 0,
            viewers,
            watch: None,
            unwritten: BTreeMap::new(),
        })
    }

    /// Shows every map to `viewers` after its files are written.
    #[must_use]
    pub fn with_viewers(self, viewers: MapWatch) -> Self {
        Self { viewers, ..self }
    }

    /// Continues if files cannot be written, reports failures to `watch`, and tries again after a pause, with the next map, and at the end.
    #[must_use]
    pub fn with_retries(self, watch: &ProductsWatch) -> Self {
        Self { watch: Some(watch.clone()), ..self }
    }

    fn publish(&mut self, solution: &Solution, viewers: &MapWatch) -> Result<(), ProductsError> {
        let channel = solution.channel;
        if !self.channels.contains_key(&channel) {
            let truth = self.truth.channel(channel);
            let opened = ChannelFolder::open(&self.folder, &self.config, truth, solution)?;
            let opened = if self.watch.is_some() { opened.with_free_disk() } else { opened };
            self.channels.insert(channel, opened);
        }
        if let Some(folder) = self.channels.get_mut(&channel) {
            folder.publish(solution, &self.provenance, viewers)?;
            self.published += 1;
        }
        self.list();
        Ok(())
    }

    fn list(&self) {
        let (mut channels, mut intermediate_files) = (Vec::new(), Vec::new());
        for folder in self.channels.values() {
            match folder.summary() {
                Some(summary) => channels.push(summary),
                None => intermediate_files.extend_from_slice(folder.files()),
            }
        }
        let written = WrittenProducts { channels, intermediate_files };
        *self.written.lock().unwrap_or_else(PoisonError::into_inner) = written;
    }

    fn retry_unwritten(&mut self) -> Result<(), ProductsError> {
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
        let Some(watch) = self.watch.clone() else { return self.publish(&solution, &viewers) };
        // A newer map replaces one that could not be written.
        self.unwritten.remove(&solution.channel);
        let written = self.publish(&solution, &viewers);
        let failure = match written {
            Err(error) => {
                self.unwritten.insert(solution.channel, solution);
                Some(error)
            }
            Ok(()) => self.retry_unwritten().err(),
        };
        watch.update(failure.as_ref());
        Ok(())
    }

    fn finish(&mut self) -> Result<(), ProductsError> {
        let mut last = Ok(());
        for pause in FINAL_PAUSES {
            std::thread::sleep(pause);
            last = self.retry_unwritten();
            if last.is_ok() {
                break;
            }
        }
        last
    }

    fn retry_after(&self) -> Option<Duration> {
        (!self.unwritten.is_empty()).then_some(RETRY_AFTER)
    }

    fn retry(&mut self) {
        let failure = self.retry_unwritten().err();
        if let Some(watch) = &self.watch {
            watch.update(failure.as_ref());
        }
    }

    fn units(&self) -> Units {
        Units::of(self.published, "maps")
    }
}
