//! The gains that a ground finds while data arrive: their products, after each pass and at the end.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use super::calibrate_products::write;
use super::found_solutions::{CalibrateSummary, FoundSolutions};
use crate::calibration::SolvedGains;
use crate::calibration::solver::SolverConfig;
use crate::pipeline::config::{Config, PipelineError};

/// Products grow with the mission: they are written again once this many times as long has passed as the last time took.
const PATIENCE: u32 = 20;

/// Writes the products of gains into a folder.
pub(in crate::pipeline) struct GainsWriter {
    out: PathBuf,
    solver: SolverConfig,
    pictures: bool,
    /// When they were written last, and how long that took.
    last: Option<(Instant, Duration)>,
}

impl GainsWriter {
    pub(in crate::pipeline) fn new(config: &Config, out: &Path) -> Self {
        let (out, solver, pictures) = (out.to_owned(), config.calibrate.clone(), config.products.pictures);
        Self { out, solver, pictures, last: None }
    }

    /// A pass is closed. What cannot be written now is written after another pass, or at the end.
    pub(in crate::pipeline) fn update(&mut self, gains: &SolvedGains) {
        if self.last.is_none_or(|(at, took)| at.elapsed() >= took * PATIENCE) {
            let begun = Instant::now();
            let _ = self.write(gains);
            self.last = Some((Instant::now(), begun.elapsed()));
        }
    }

    /// Writes all of them.
    pub(in crate::pipeline) fn write(&self, gains: &SolvedGains) -> Result<CalibrateSummary, PipelineError> {
        let found = FoundSolutions::of(gains);
        let summary = found.of_one_round(&self.solver, !self.solver.model_files.is_empty());
        write(&self.out, &found, &summary, self.pictures)?;
        Ok(summary)
    }
}
