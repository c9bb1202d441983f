//! What can be chosen about products.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// What is written beside the final maps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProductsConfig {
    /// Whether pictures are drawn.
    pub pictures: bool,
    /// Whether every snapshot is written as a FITS map too.
    pub snapshot_maps: bool,
    /// FWHM to which the final map is smoothed after its pixels were split, degrees; 0 for none.
    pub smooth_fwhm_deg: f64,
}

impl Default for ProductsConfig {
    fn default() -> Self {
        Self { pictures: true, snapshot_maps: false, smooth_fwhm_deg: 0.0 }
    }
}

/// A setting of the products that cannot be.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("products.{key} = {value}: expected {expected}")]
pub struct ProductsConfigError {
    /// Key.
    pub key: &'static str,
    /// Value found.
    pub value: f64,
    /// Range that is accepted.
    pub expected: &'static str,
}

impl ProductsConfig {
    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<ProductsConfigError> {
        let value = self.smooth_fwhm_deg;
        if (0.0..=90.0).contains(&value) {
            return Vec::new();
        }
        vec![ProductsConfigError { key: "smooth_fwhm_deg", value, expected: "0 to 90 degrees" }]
    }
}
