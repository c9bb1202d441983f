//! Products of gains that are solved while data arrive: written after passes and at the end.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::calibrate_products::write_products;
use super::found_solutions::{CalibrateSummary, FoundSolutions};
use crate::calibration::SolvedGains;
use crate::calibration::solver::SolverConfig;
use crate::pipeline::config::{Config, PipelineError};

/// Least time between two writings, in units of the last one's duration: products grow with the mission.
const REWRITE_INTERVAL: u32 = 20;

pub(in crate::pipeline) struct GainsWriter {
    out: PathBuf,
    solver: SolverConfig,
    pictures: bool,
    /// End and duration of the last writing.
    last: Option<(Instant, Duration)>,
}

impl GainsWriter {
    pub(in crate::pipeline) fn new(config: &Config, out: &Path) -> Self {
        let (out, solver, pictures) = (out.to_owned(), config.calibrate.clone(), config.products.pictures);
        Self { out, solver, pictures, last: None }
    }

    /// Writes the products after a pass, unless the last writing is recent. Errors are ignored: a later pass or the end
    /// writes again.
    pub(in crate::pipeline) fn update(&mut self, gains: &SolvedGains) {
        if self.last.is_none_or(|(ended, took)| ended.elapsed() >= took * REWRITE_INTERVAL) {
            let started = Instant::now();
            let _ = self.write(gains);
            self.last = Some((Instant::now(), started.elapsed()));
        }
    }

    pub(in crate::pipeline) fn write(&self, gains: &SolvedGains) -> Result<CalibrateSummary, PipelineError> {
        let found = FoundSolutions::from_gains(gains);
        let summary = found.single_round_summary(&self.solver, !self.solver.model_files.is_empty());
        write_products(&self.out, &found, &summary, self.pictures)?;
        Ok(summary)
    }
}
