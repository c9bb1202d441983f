//! Writes the files of a figure.

use std::path::{Path, PathBuf};

use serde::Serialize;
use serde_json::Value;

use super::error::FigureError;
use crate::products::pictures::Picture;
use crate::products::{ProductsError, write_product};

/// A figure that has been written.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FigureFiles {
    /// Name of the figure.
    pub figure: String,
    /// The numbers of the figure, as they are written.
    pub numbers: Value,
    /// Paths of the files.
    pub files: Vec<PathBuf>,
}

/// A figure before it is written.
pub(super) struct FigureParts {
    pub numbers: Value,
    pub csv: String,
    pub picture: Picture,
    /// Paths of files that have been written already.
    pub extra_files: Vec<PathBuf>,
}

impl FigureParts {
    /// A figure of one picture and one table. The numbers must be serialisable as JSON.
    pub fn new(numbers: &impl Serialize, csv: String, picture: Picture) -> Self {
        Self {
            numbers: serde_json::to_value(numbers).unwrap_or_default(),
            csv,
            picture,
            extra_files: Vec::new(),
        }
    }

    /// Writes picture, table and numbers into `folder`.
    pub fn write(self, name: &str, folder: &Path) -> Result<FigureFiles, FigureError> {
        let path = |ending: &str| folder.join(format!("{name}.{ending}"));
        let encoded = |error: serde_json::Error| ProductsError::Encode {
            path: path("json"),
            reason: error.to_string(),
        };
        let json = serde_json::to_vec_pretty(&self.numbers).map_err(encoded)?;
        write_product(&path("csv"), self.csv)?;
        write_product(&path("json"), json)?;
        self.picture.write(&path("png"))?;
        self.picture.write(&path("svg"))?;
        let files = ["png", "svg", "csv", "json"].map(path).into_iter().chain(self.extra_files).collect();
        Ok(FigureFiles { figure: name.to_owned(), numbers: self.numbers, files })
    }
}
