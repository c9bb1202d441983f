//! Configuration of products.

use serde::Serialize;

use crate::sky::harmonics::Alm;
use crate::sky::spectra::{gaussian_beam, multiply_degrees};
use crate::sky::{Frame, MapError, SkyMap};
use crate::units::{Checks, InvalidValue, keys};

keys! {
    /// The `[products]` section: products besides the final maps.
    pub struct ProductsConfig {
        /// Draw pictures.
        everyday pictures: bool = true;
        /// Write final pictures as SVG, too.
        #[only_with("products.pictures = true")]
        expert svg: bool = false;
        /// Write every snapshot as a FITS map, too.
        expert snapshot_maps: bool = false;
        /// Frame of pictures: "galactic", "ecliptic" or "equatorial"; maps are always on ecliptic axes.
        #[only_with("products.pictures = true")]
        everyday frame: Frame = Frame::Galactic;
        /// FWHM to which maps, noise and input are smoothed, on finer pixels, before they are compared and drawn; 0 for none.
        everyday smooth_fwhm_deg: f64 = 0.0;
    }
}

/// Processing of maps before they are compared and drawn. Pixels are split, and smoothed with a Gaussian beam (the paper,
/// Sect. 4.2: nside 64 to 256, FWHM 1 deg).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct PostProcessing {
    /// Number of parts into which the side of a pixel is split.
    pub split: usize,
    /// FWHM of the beam, degrees.
    pub fwhm_deg: f64,
}

impl PostProcessing {
    /// nside of a processed map whose nside was `nside`.
    #[must_use]
    pub fn nside(self, nside: usize) -> usize {
        self.split * nside
    }

    /// FWHM of the beam, rad.
    #[must_use]
    pub fn fwhm_rad(self) -> f64 {
        self.fwhm_deg.to_radians()
    }

    /// Processes a map.
    ///
    /// # Errors
    /// Errors of [`SkyMap::refined`].
    pub fn apply(self, map: &SkyMap) -> Result<SkyMap, MapError> {
        map.refined(self.split, self.fwhm_rad())
    }

    /// Smooths harmonic coefficients with the beam.
    pub fn smooth(self, alm: &mut Alm) {
        let beam = gaussian_beam(self.fwhm_rad(), alm.l_max());
        multiply_degrees(alm, &beam);
    }
}

impl ProductsConfig {
    /// The processing of maps; `None` without smoothing.
    #[must_use]
    pub fn processing(&self) -> Option<PostProcessing> {
        let fwhm_deg = self.smooth_fwhm_deg;
        (fwhm_deg > 0.0).then_some(PostProcessing { split: 4, fwhm_deg })
    }

    /// All problems of the configuration; empty if it is valid.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("products");
        let fwhm_deg = self.smooth_fwhm_deg;
        checks.require("smooth_fwhm_deg", fwhm_deg, (0.0..=90.0).contains(&fwhm_deg), "0 to 90 degrees");
        checks.finish()
    }
}
