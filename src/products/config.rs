//! Configuration of products.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue};

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

impl ProductsConfig {
    /// All problems of the section; empty if it is valid.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::of("products");
        let fwhm_deg = self.smooth_fwhm_deg;
        checks.require("smooth_fwhm_deg", fwhm_deg, (0.0..=90.0).contains(&fwhm_deg), "0 to 90 degrees");
        checks.finish()
    }
}
