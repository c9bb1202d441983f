//! What a run leaves in `summary.json` and prints at its end.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use super::config::Config;
use super::sample_summary::SampleSummary;
use crate::downlink::ReceptionCounters;
use crate::downlink::socket::ListenAccount;
use crate::files::write_atomically;
use crate::products::{ChannelSummary, ProductsError};
use crate::runtime::{LedgerReport, Report};

/// Which part of the chain ran.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Segment {
    /// Space and ground in one process.
    Whole,
    /// The ground alone, from files.
    Ground,
}

/// A run in figures.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Version of the program.
    pub version: &'static str,
    /// Name of the pipeline.
    pub name: String,
    /// Which part of the chain ran.
    pub segment: Segment,
    /// Whether it was ended early.
    pub cancelled: bool,
    /// Seed of the space segment, as the instrument description has it.
    pub seed: Option<u64>,
    /// Hash of the space segment's configuration, as the instrument description has it.
    pub space_hash: Option<String>,
    /// Hash of the ground's configuration.
    pub ground_hash: String,
    /// The maps, channel by channel.
    pub channels: Vec<ChannelSummary>,
    /// What became of every visibility.
    pub ledger: LedgerReport,
    /// What became of samples; absent without sample fidelity.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub samples: Option<SampleSummary>,
    /// What was received, and what was wrong with it.
    pub reception: ReceptionCounters,
    /// The senders, if the ground listened.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub listening: Option<ListenAccount>,
    /// Stages: throughput, times, queues.
    pub report: Report,
}

impl Summary {
    /// Puts the parts together.
    #[must_use]
    pub(super) fn new(
        segment: Segment,
        config: &Config,
        report: Report,
        ledger: LedgerReport,
        reception: ReceptionCounters,
        channels: Vec<ChannelSummary>,
    ) -> Self {
        Self {
            version: env!("CARGO_PKG_VERSION"),
            name: config.name.clone(),
            segment,
            cancelled: report.cancelled,
            seed: channels.first().map(|channel| channel.seed),
            space_hash: channels.first().map(|channel| channel.space_hash.clone()),
            ground_hash: format!("{:016x}", config.ground_hash()),
            channels,
            ledger,
            samples: None,
            reception,
            listening: None,
            report,
        }
    }

    /// Writes `summary.json` into `folder`.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub(super) fn write(&self, folder: &Path) -> Result<(), ProductsError> {
        let path = folder.join("summary.json");
        let text = serde_json::to_vec_pretty(self)
            .map_err(|error| ProductsError::Encode { path: path.clone(), reason: error.to_string() })?;
        write_atomically(&path, &text).map_err(|source| ProductsError::Write { path, source })
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "Stages\n{}\n", self.report)?;
        writeln!(f, "Ledger of visibilities\n{}\n", self.ledger)?;
        if let Some(samples) = &self.samples {
            writeln!(f, "Samples\n{samples}\n")?;
        }
        writeln!(f, "Reception\n{}\n", self.reception)?;
        if let Some(listening) = &self.listening {
            writeln!(f, "Senders\n{listening}\n")?;
        }
        writeln!(f, "Maps")?;
        for channel in &self.channels {
            writeln!(f, "{channel}")?;
        }
        if self.cancelled {
            write!(f, "Ended early: all products hold the data so far.")?;
        }
        Ok(())
    }
}
