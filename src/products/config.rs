//! Configuration of products.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// The `[products]` section: what is written beside the final maps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProductsConfig {
    /// Whether pictures are drawn.
    pub pictures: bool,
    /// Whether every snapshot is also written as a FITS map.
    pub snapshot_maps: bool,
    /// FWHM of the smoothed copy of the final map, which has four times its nside, degrees; 0 for none.
    pub smooth_fwhm_deg: f64,
}

impl Default for ProductsConfig {
    fn default() -> Self {
        Self { pictures: true, snapshot_maps: false, smooth_fwhm_deg: 0.0 }
    }
}

/// An invalid setting of the products.
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
    /// All problems of the section; empty if it is valid.
    #[must_use]
    pub fn problems(&self) -> Vec<ProductsConfigError> {
        let value = self.smooth_fwhm_deg;
        if (0.0..=90.0).contains(&value) {
            return Vec::new();
        }
        vec![ProductsConfigError { key: "smooth_fwhm_deg", value, expected: "0 to 90 degrees" }]
    }
}
