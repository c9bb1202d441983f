//! Light curves and dynamic spectra of bursts, from downlink files.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::calibration::{
    BurstChoice, BurstEvent, BurstSearch, FoundBurst, PassCounts, SearchedPasses, find_events,
};
use crate::frames::VisibilityReason;
use crate::ground::{WAIT_BYTES, read_passes};
use crate::pipeline::config::{Config, PipelineError};
use crate::pipeline::graph::calibrate_products::write_json;
use crate::pipeline::graph::run::lock_folder;
use crate::products::{create_folder, remove_event, write_event};
use crate::runtime::{Ledger, LedgerReport};

/// What was found in downlink files.
#[derive(Clone, Debug, Serialize)]
pub struct BurstsReport {
    /// All visibilities; those accumulated were searched, but for the passes that `searched` counts as not.
    pub ledger: LedgerReport<VisibilityReason>,
    /// The passes of each channel that were searched.
    pub searched: Vec<SearchedPasses>,
    /// The events, in the order of their passes.
    pub events: Vec<EventReport>,
}

/// A burst in one or more channels.
#[derive(Clone, Debug, Serialize)]
pub struct EventReport {
    /// Number, from 1, as in the names of files.
    pub event: usize,
    /// Start of the light curves, s since the epoch.
    pub from_s: f64,
    /// Their end, s.
    pub until_s: f64,
    /// Number of channels with a light curve.
    pub light_curves: usize,
    /// The burst in each channel in which it was found.
    pub bursts: Vec<FoundBurst>,
}

/// Finds bursts in downlink files, and writes the light curves and the dynamic spectrum of each, and `summary.json`.
///
/// # Errors
/// Files that cannot be read or written.
pub fn bursts_of_downlink(
    config: &Config,
    files: &[PathBuf],
    out: &Path,
) -> Result<BurstsReport, PipelineError> {
    create_folder(out)?;
    let _lock = lock_folder(out)?;
    let earlier = events_of(&out.join("summary.json"));
    let ledger = Ledger::new();
    let (mut events, mut failure, mut counts) = (Vec::new(), None, PassCounts::default());
    let mut write = |event: BurstEvent| {
        let number = events.len() + 1;
        failure = failure.take().or_else(|| write_event(out, number, &event).err());
        events.push(EventReport {
            event: number,
            from_s: event.from_s,
            until_s: event.until_s,
            light_curves: event.curves.iter().filter(|curve| !curve.points.is_empty()).count(),
            bursts: event.bursts,
        });
    };
    read_passes(&config.ground(WAIT_BYTES), files, &ledger, &mut |instrument, channels| {
        let (moon_radius_m, epoch_tai_s) = (instrument.moon_radius_m, instrument.epoch_tai_s);
        let search = BurstSearch { moon_radius_m, epoch_tai_s, choice: BurstChoice::Keep };
        find_events(search, channels, &mut counts).into_iter().for_each(&mut write);
    })?;
    if let Some(error) = failure {
        return Err(error.into());
    }
    (events.len() + 1..=earlier).for_each(|number| remove_event(out, number));
    let report = BurstsReport { ledger: ledger.balanced_report()?, searched: counts.list(), events };
    write_json(&out.join("summary.json"), &report)?;
    Ok(report)
}

/// Number of events of an earlier command in this folder; 0 if there is none.
fn events_of(summary: &Path) -> usize {
    let read = || serde_json::from_slice::<serde_json::Value>(&std::fs::read(summary).ok()?).ok();
    read().and_then(|summary| Some(summary.get("events")?.as_array()?.len())).unwrap_or(0)
}
