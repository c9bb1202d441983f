//! Configuration of products.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue};

/// The `[products]` section: products besides the final maps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProductsConfig {
    /// Whether pictures are drawn.
    pub pictures: bool,
    /// Whether every snapshot is written as a FITS map, too.
    pub snapshot_maps: bool,
    /// FWHM to which the final map, with split pixels, is smoothed, degrees; 0 for none.
    pub smooth_fwhm_deg: f64,
}

impl Default for ProductsConfig {
    fn default() -> Self {
        Self { pictures: true, snapshot_maps: false, smooth_fwhm_deg: 0.0 }
    }
}

impl ProductsConfig {
    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::of("products");
        let fwhm_deg = self.smooth_fwhm_deg;
        checks.require("smooth_fwhm_deg", fwhm_deg, (0.0..=90.0).contains(&fwhm_deg), "0 to 90 degrees");
        checks.finish()
    }
}
