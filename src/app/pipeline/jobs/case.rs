//! Summary of a finished case of a study, and the step that makes it.

use std::path::Path;

use serde::Serialize;

use super::step::Step;
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

/// Name of the marker of a finished case.
const MARKER: &str = "case.json";

/// Content of the marker of a finished case: everything that decides its result. If it differs, the case is run again.
#[derive(Serialize)]
struct CaseMarker {
    space_hash: u64,
    ground_hash: u64,
    /// All settings except `[runtime]`, which changes no result.
    config: serde_json::Value,
}

/// The step that makes the products of a case.
pub(super) fn step_of(case: &StudyCase, out: &Path) -> Step<'static> {
    Step::Marked(out.join(case.folder()).join(MARKER), marker_of(case))
}

fn marker_of(case: &StudyCase) -> Vec<u8> {
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
    let (space_hash, ground_hash) = (config.space_hash(), config.ground_hash());
    serde_json::to_vec_pretty(&CaseMarker { space_hash, ground_hash, config: value }).unwrap_or_default()
}
