//! A finished case of a study, and what decides whether it has to be made again.

use serde::{Deserialize, Serialize};

use super::study_file::StudyCase;
use crate::products::RunFigures;

/// A finished case.
#[derive(Clone, Debug, Serialize)]
pub struct CaseSummary {
    /// Folder of its products.
    pub folder: String,
    /// Its overrides of the pipeline.
    pub overrides: Vec<String>,
    /// Realisations of its noise-only map.
    pub realisations: usize,
    /// Its figures.
    pub figures: RunFigures,
}

/// Key of a case: if it changes, the case is made again.
#[derive(PartialEq, Serialize, Deserialize)]
pub(in crate::pipeline) struct CaseMarker {
    space_hash: u64,
    ground_hash: u64,
    /// All settings but those of the runtime, which change no result.
    config: serde_json::Value,
}

impl CaseMarker {
    pub(in crate::pipeline) fn of(case: &StudyCase) -> Self {
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

/// Name of the file in a case's folder that says that it is finished.
pub(in crate::pipeline) const MARKER: &str = "case.json";
