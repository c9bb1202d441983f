//! Summary of a finished case of a study, and the marker file that tells whether it is up to date.

use serde::{Deserialize, Serialize};

use super::study_file::StudyCase;
use crate::products::RunFigures;

/// Summary of a finished case.
#[derive(Clone, Debug, Serialize)]
pub struct CaseSummary {
    /// Folder of the products.
    pub folder: String,
    /// Overrides of the pipeline.
    pub overrides: Vec<String>,
    /// Number of realisations of the noise-only map.
    pub realisations: usize,
    /// Figures of merit of the maps.
    pub figures: RunFigures,
}

/// Content of the marker file: everything that decides the result of a case. If it differs, the case is run again.
#[derive(PartialEq, Serialize, Deserialize)]
pub(in crate::pipeline) struct CaseMarker {
    space_hash: u64,
    ground_hash: u64,
    /// All settings except `[runtime]`, which changes no result.
    config: serde_json::Value,
}

impl CaseMarker {
    pub(in crate::pipeline) fn new(case: &StudyCase) -> Self {
        let config = &case.plan.config;
        let mut value = serde_json::to_value(config).unwrap_or_default();
        if let Some(sections) = value.as_object_mut() {
            sections.remove("runtime");
            if case.calibrated {
                sections.insert("calibrated_with".to_owned(), case.models_hash.into());
            }
            if !case.noise_seeds.is_empty() {
                sections.insert("realisations".to_owned(), case.noise_seeds.len().into());
            }
        }
        Self { space_hash: config.space_hash(), ground_hash: config.ground_hash(), config: value }
    }
}

pub(in crate::pipeline) const MARKER: &str = "case.json";
