//! The ground segment as a graph: packets, placed and calibrated visibilities, sums, maps, products.

use std::path::Path;
use std::sync::{Arc, Mutex};

use super::config::Config;
use super::error::PipelineError;
use crate::accumulation::{Accumulator, Snapshot};
use crate::calibration::{CalibrationError, Calibrator};
use crate::downlink::ReceptionCounters;
use crate::frames::{AutoPower, VisibilityReason};
use crate::ground::Reception;
use crate::ground::archive::Keeper;
use crate::products::{ChannelSummary, Provenance, Publisher, Truth};
use crate::runtime::{Graph, Ledger, Link};
use crate::sky::fits::{ReadOptions, read_whole_map};
use crate::solve::{SolveWatch, Solver, SolverSetup, StoppingRule};

/// Bytes of visibilities that wait for their positions, if nothing else is said: a week of thirty channels.
pub const WAIT_BYTES: u64 = 1 << 28;

/// Segments of which positions are kept: more than two years of windows.
const SEGMENTS_MAX: usize = 8192;

/// How packets are taken.
pub enum Receiving {
    /// Every packet once, from one sender or several; visibilities when their positions have come.
    Once {
        /// Bytes of visibilities that may wait for positions.
        wait_bytes: u64,
    },
    /// As [`Receiving::Once`], and kept for later sessions.
    Kept(Box<Keeper>),
}

/// What the ground segment leaves behind besides its files.
#[derive(Clone, Debug, Default)]
pub struct GroundOutcome {
    /// What became of every visibility.
    pub ledger: Ledger<VisibilityReason>,
    /// What was received, and what was wrong with it.
    pub reception: Arc<Mutex<ReceptionCounters>>,
    /// The daughters' own powers, by channel, daughter and time.
    pub autos: Arc<Mutex<Vec<AutoPower>>>,
    /// Final map of each channel, in figures.
    pub channels: Arc<Mutex<Vec<ChannelSummary>>>,
}

/// Adds the ground segment to `graph`. It takes the bytes of a downlink and nothing else from space;
/// `truth`, if any, only serves to compare the maps with; `watch` follows solutions.
///
/// # Errors
/// Calibration or prior maps that cannot be read.
pub fn add(
    graph: &mut Graph,
    bytes: Link<Vec<u8>>,
    config: &Config,
    out: &Path,
    (truth, watch): (Truth, SolveWatch),
    receiving: Receiving,
) -> Result<GroundOutcome, PipelineError> {
    let outcome = match &receiving {
        Receiving::Kept(keeper) => keeper.outcome(),
        _ => GroundOutcome::default(),
    };
    let setup = SolverSetup {
        epsilon: config.map.epsilon.clone(),
        prior_k: config.map.prior_k.clone(),
        prior_maps: prior_maps(config)?,
        rule: StoppingRule {
            residual_max: config.map.residual_max,
            iterations_max: config.map.iterations_max,
        },
        trace_probes: config.map.trace_probes,
        watch,
    };
    let publisher = Publisher::new(
        config.products.clone(),
        out,
        truth,
        Provenance { ground_hash: config.ground_hash() },
        Arc::clone(&outcome.channels),
    )?;
    // Sums are large: one waits while another is solved.
    let sums = match receiving {
        Receiving::Kept(keeper) => graph.stage("keep", 1, bytes, *keeper),
        Receiving::Once { wait_bytes } => add_sums(graph, bytes, config, &outcome, wait_bytes)?,
    };
    let maps = graph.stage("solve", 1, sums, Solver::new(setup));
    graph.sink("publish", maps, publisher);
    Ok(outcome)
}

/// The stages from bytes to sums, when nothing is kept.
pub(crate) fn add_sums(
    graph: &mut Graph,
    bytes: Link<Vec<u8>>,
    config: &Config,
    outcome: &GroundOutcome,
    wait_bytes: u64,
) -> Result<Link<Snapshot>, PipelineError> {
    let capacity = config.runtime.queue_capacity;
    let frames =
        graph.stage("receive", capacity, bytes, reception(wait_bytes, Arc::clone(&outcome.reception)));
    let (calibrator, accumulator) = stages(config, &outcome.ledger, outcome)?;
    let placed = graph.stage("calibrate", capacity, frames, calibrator);
    Ok(graph.stage("accumulate", 1, placed, accumulator))
}

/// Reception that knows as many positions as calibration keeps.
pub(crate) fn reception(wait_bytes: u64, account: Arc<Mutex<ReceptionCounters>>) -> Reception {
    Reception::new(wait_bytes, SEGMENTS_MAX, account)
}

/// Calibration and sums that know nothing yet.
pub(crate) fn stages(
    config: &Config,
    ledger: &Ledger<VisibilityReason>,
    outcome: &GroundOutcome,
) -> Result<(Calibrator, Accumulator), CalibrationError> {
    let calibration = config.calibration.build(Path::new(""))?;
    let calibrator = Calibrator::new(calibration, ledger.clone())
        .with_van_vleck(config.calibration.van_vleck()?)
        .with_autos(Arc::clone(&outcome.autos))
        .with_segments(SEGMENTS_MAX);
    Ok((calibrator, Accumulator::new(config.map.clone(), ledger.clone())))
}

fn prior_maps(config: &Config) -> Result<Vec<Vec<f64>>, PipelineError> {
    let map = &config.map;
    let read = |path: &std::path::PathBuf| {
        let prior = read_whole_map(path, &ReadOptions::default())?.to_ecliptic();
        let smooth = prior.smoothed(map.prior_fwhm_deg.to_radians())?;
        Ok(smooth.resized(map.nside)?.into_values())
    };
    map.prior_files.iter().map(read).collect()
}
