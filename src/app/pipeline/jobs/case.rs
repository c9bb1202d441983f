//! Summary of a finished case of a study, and the markers that tell which steps of a job are done.

use std::fs;
use std::path::Path;

use serde::Serialize;

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
pub(super) const MARKER: &str = "case.json";

/// Content of the marker of a finished case: everything that decides its result. If it differs, the case is run again.
#[derive(Serialize)]
struct CaseMarker {
    space_hash: u64,
    ground_hash: u64,
    /// All settings except `[runtime]`, which changes no result.
    config: serde_json::Value,
}

/// The text of the marker of a case.
pub(super) fn marker_of(case: &StudyCase) -> Vec<u8> {
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

/// Whether a step of a job is done: its marker is there, with the text of what decides its result.
pub(super) fn is_marked(marker: &Path, text: impl AsRef<[u8]>) -> bool {
    fs::read(marker).is_ok_and(|found| found == text.as_ref())
}

/// Hash of what decides the result of a step.
pub(super) fn key_of(text: impl AsRef<[u8]>) -> u64 {
    crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, text.as_ref())
}
