//! Configuration of maps.

mod checks;

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::frames::Instrument;
use crate::imaging::AccumulationError;
use crate::imaging::antennas::AntennasConfig;
use crate::imaging::assumed_instrument::AssumedInstrument;
use crate::response::harmonic::GeometryLimits;
use crate::response::pixel::PixelMethod;
use crate::response::{MeasuredAntennas, MeasuredAntennasError};
use crate::sky::fits::{ReadOptions, check_frequency};
use crate::sky::healpix::pixel_area_sr;
use crate::sky::{Body, Frame};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::{ChannelId, PerChannel, keys};

/// Maximum degree of harmonic sums. They take 0.5 GB per wavelength, so that all but short baselines need many ranks.
pub(in crate::imaging) const L_MAX: usize = 1024;

/// Maximum nside of the pixel engine: 49152 pixels, 9.7 GB of sums per channel (half of a symmetric matrix, f64).
pub const PIXEL_ENGINE_NSIDE_MAX: usize = 64;

/// Default epsilon.
const EPSILON: f64 = 1e-4;

/// Default number of degrees of a harmonic map per nside: those that pixels represent to 1e-6.
const DEGREES_PER_NSIDE: f64 = 2.5;

/// Channels whose sums are in memory at the same time.
pub type ChannelGroup = BTreeSet<ChannelId>;

/// The basis of the normal equations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum EngineKind {
    /// Pixels: exact, for any orbit; N_pix^2 operations per visibility.
    Pixel,
    /// Spherical harmonics: thousands of operations per visibility; needs satellites on one circular orbit.
    Harmonic,
    /// The cheaper one that the pipeline allows: replaced by it when a pipeline is read, and otherwise the same as [`Self::Pixel`].
    #[default]
    Auto,
}

/// Storage of the pixel engine's matrix.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum MatrixKind {
    /// Forms the normal matrix in memory and factorises it (Cholesky).
    #[default]
    Stored,
    /// Stores the visibilities instead, and computes rows of B again in each iteration.
    Free,
}

/// A map method: what `map.engine`, `map.matrix` and `map.refine` choose together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Method {
    /// Sums over pixels; the matrix is stored and factorised.
    Pixel,
    /// Visibilities whose rows over pixels are computed again for each product.
    MatrixFree,
    /// Sums over harmonics, for satellites on one circular orbit.
    Harmonic,
    /// Visibilities whose rows over harmonics are those of the true positions.
    Refined,
}

/// The choice of R.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum RegulariserChoice {
    /// `R_l = 1 / C_l` with the sky's angular power C_l estimated from the data.
    Data,
    /// `R = epsilon W_max I`, as in the paper.
    Identity,
    /// `R_l = epsilon W_max (l + 1)^exponent`.
    Degree(f64),
    /// `R_l = epsilon / C_l` from tables of l and C_l (K^2), one per channel.
    File(Vec<PathBuf>),
}

keys! {
    /// Configuration of map making.
    pub struct MapConfig {
        /// HEALPix nside of the maps: a power of two up to 64 (engine "pixel"), 256 (with matrix = "free") or 1024 (engine
        /// "harmonic").
        everyday nside: usize = 16;
        /// Map method: "pixel", exact on any orbit; "harmonic", far cheaper, for satellites on one circle or with map.refine; or
        /// "auto": "harmonic" for a circle of section `array`, unless positions are solved for or a key of pixel maps is set.
        everyday engine: EngineKind = EngineKind::Auto;
        /// Maximum number of channels of an instrument: each takes memory for a map, so a forged description is refused.
        expert channels_max: usize = 64;
        /// Channels to map, from 0; all if empty.
        everyday channels: Vec<u16> = Vec::new();
        /// Rows of B: the "average" over a pixel, or its "centre".
        #[only_with(r#"map.engine = "pixel""#)]
        expert rows: PixelMethod = PixelMethod::Average;
        /// The matrix of the pixel engine: "stored" in memory and factorised, or "free": rows of B are computed again for each
        /// product of an iteration.
        #[only_with(r#"map.engine = "pixel""#)]
        #[serde(skip_serializing_if = "is_usual")]
        everyday matrix: MatrixKind = MatrixKind::Stored;
        /// Maximum degree of a map; 0 for 2.5 nside.
        #[only_with(r#"map.engine = "harmonic""#)]
        expert l_max: usize = 0;
        /// Maximum baseline used, in units of b_p = wavelength / sqrt(4 pi / N_pix).
        everyday baseline_bp_max: f64 = 2.0;
        /// Regularisation epsilon; one value, or one per channel. Alone it selects R = epsilon W_max I, the paper's; "degree" and
        /// "file" take 1e-4 without it.
        #[only_with(r#"no map.regulariser = "data""#)]
        #[serde(skip_serializing_if = "Option::is_none")]
        everyday epsilon: Option<PerChannel<f64>> = None;
        /// Regulariser R: "data", 1 / C_l estimated from the data (default); "identity", epsilon W_max I, the paper's (default
        /// with epsilon); { degree = 2.0 }, epsilon W_max (l + 1)^2; or { file = ["cl.csv"] }, epsilon / C_l from tables of l
        /// and C_l (K^2), one per channel. W_max is the largest eigenvalue of the normal matrix.
        #[serde(skip_serializing_if = "Option::is_none")]
        everyday regulariser: Option<RegulariserChoice> = None;
        /// Tables of the sky's C_l (K^2), one per channel, such as sky-power.csv of an earlier map: what the sky has beyond the
        /// map's degrees then counts as noise, more on some baselines than on others. A table goes on beyond its last degree
        /// as it ends.
        #[serde(skip_serializing_if = "Vec::is_empty")]
        expert beyond_files: Vec<PathBuf> = Vec::new();
        /// Bodies that move, "sun" and "jupiter", whose flux in each month of 30 days is solved for beside a final map, which is then
        /// without them. Not with a saved state or several ranks.
        #[only_with("map.engine = \"harmonic\" and no map.refine.passes_max")]
        #[serde(skip_serializing_if = "Vec::is_empty")]
        expert movers: Vec<Body> = Vec::new();
        /// Ecliptic longitudes and latitudes of points whose effective beam is computed, such as `[[0.0, 90.0]]`.
        #[serde(skip_serializing_if = "Vec::is_empty")]
        everyday beams_deg: Vec<[f64; 2]> = Vec::new();
        /// Uniform prior map; 0 for none; one value, or one per channel.
        everyday prior_k: PerChannel<f64> = PerChannel::All(0.0);
        /// Prior maps: HEALPix FITS files, one per channel, in K.
        everyday prior_files: Vec<PathBuf> = Vec::new();
        /// Frame of prior maps without COORDSYS, as sky.frame. Without it they are refused.
        #[only_with("map.prior_files")]
        #[serde(skip_serializing_if = "Option::is_none")]
        expert prior_frame: Option<Frame> = None;
        /// FWHM to which prior maps are smoothed.
        #[only_with("map.prior_files")]
        expert prior_fwhm_deg: f64 = 5.0;
        /// Fraction xi_R of the sky's power that the Moon is taken to reflect: visibilities are divided by one plus this.
        expert moon_reflection: f64 = 0.0;
        /// Mission time between snapshot maps; 0 for a final map only.
        everyday snapshot_every_s: f64 = 0.0;
        /// Maximum weight of a visibility, (K sr)^-2, which sets the resolution of the sums; 0 for 1024 times that of 25 s under
        /// the mean sky of the channel's frequency.
        expert weight_max: f64 = 0.0;
        /// Seed of the noise-only companion map.
        expert companion_seed: u64 = 1;
        /// Residual at which an iterative solution stops, relative to the right-hand side, in the preconditioner's norm.
        #[only_with(
            "map.engine = \"harmonic\" or map.matrix = \"free\" or map.regulariser.degree or map.regulariser.file or \
             map.nside > 32 and no map.epsilon and no map.regulariser = \"identity\""
        )]
        expert residual_max: f64 = 1e-4;
        /// Maximum number of iterations of a solution.
        #[only_with(
            "map.engine = \"harmonic\" or map.matrix = \"free\" or map.regulariser.degree or map.regulariser.file or \
             map.nside > 32 and no map.epsilon and no map.regulariser = \"identity\""
        )]
        expert iterations_max: usize = 300;
        /// Random probes for the traces of a final map's covariances; 0 for no traces. Up to 3072 unknowns (nside 16, or l_max
        /// 54) traces are exact, with any number above 0.
        everyday trace_probes: usize = 0;
        /// Maximum departures from the common circle; visibilities beyond are refused.
        #[only_with(r#"map.engine = "harmonic""#)]
        section limits: GeometryLimits = GeometryLimits::default();
        /// Refinement of a harmonic map with the true rows of B, on any orbit.
        section refine: RefineConfig = RefineConfig::default();
        /// Antennas that a refined map assumes, one value a daughter.
        #[only_with("map.refine.passes_max > 0")]
        #[serde(skip_serializing_if = "AntennasConfig::is_default")]
        section antennas: AntennasConfig = AntennasConfig::default();
    }
}

/// Value recorded for `map.refine.passes_max` in the settings of sums that store visibilities for refinement.
pub const REFINED: &str = "above 0";

keys! {
    /// Refinement of a harmonic map: conjugate gradients with the rows of B of the true positions, preconditioned by the sums of the
    /// nearest circle. Nothing is refused for its geometry then.
    #[derive(Copy)]
    pub struct RefineConfig {
        /// Maximum number of products with the true matrix; 0 for no refinement; four to ten are usual.
        #[only_with(r#"map.engine = "harmonic""#)]
        everyday passes_max: usize = 0;
        /// Residual at which it stops, relative to the right-hand side, in the preconditioner's norm.
        #[only_with("map.refine.passes_max > 0")]
        expert residual_max: f64 = 1e-3;
        /// Maximum number of visibilities of a channel held in memory, here and with matrix = "free"; further ones are left out
        /// and counted.
        #[only_with(r#"map.refine.passes_max > 0 or map.matrix = "free""#)]
        expert visibilities_max: u64 = 30_000_000;
        /// Average rows of B over integrations, instead of taking the middle.
        #[only_with("map.refine.passes_max > 0")]
        #[serde(skip_serializing_if = "is_off")]
        everyday smear_integrations: bool = false;
    }
}

impl RefineConfig {
    /// Whether maps are refined.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.passes_max > 0
    }
}

/// Whether a value is the default, which is not serialised so that it does not change configuration hashes.
#[allow(clippy::trivially_copy_pass_by_ref)] // As serde calls it.
fn is_off(value: &bool) -> bool {
    !*value
}

/// Whether a value is the default, as [`is_off`].
fn is_usual(matrix: &MatrixKind) -> bool {
    *matrix == MatrixKind::Stored
}

impl MapConfig {
    /// The map method.
    #[must_use]
    #[doc(hidden)]
    pub fn method(&self) -> Method {
        match (self.engine, self.matrix) {
            (EngineKind::Harmonic, _) if self.refine.is_on() => Method::Refined,
            (EngineKind::Harmonic, _) => Method::Harmonic,
            (_, MatrixKind::Free) => Method::MatrixFree,
            _ => Method::Pixel,
        }
    }

    /// Whether the unknowns are harmonics rather than pixels.
    #[must_use]
    #[doc(hidden)]
    pub fn is_harmonic(&self) -> bool {
        self.engine == EngineKind::Harmonic
    }

    /// The choice of R: from the data unless set otherwise. The default is the identity if epsilon is set.
    #[must_use]
    #[doc(hidden)]
    pub fn regulariser(&self) -> RegulariserChoice {
        let is_identity = self.epsilon.is_some();
        let default = if is_identity { RegulariserChoice::Identity } else { RegulariserChoice::Data };
        self.regulariser.clone().unwrap_or(default)
    }

    /// The value of epsilon, or its default.
    #[must_use]
    #[doc(hidden)]
    pub fn epsilon(&self) -> PerChannel<f64> {
        self.epsilon.clone().unwrap_or(PerChannel::All(EPSILON))
    }

    /// Paths of the tables of the sky's angular power, one per channel.
    #[must_use]
    #[doc(hidden)]
    pub fn power_files(&self) -> &[PathBuf] {
        match &self.regulariser {
            Some(RegulariserChoice::File(files)) => files,
            _ => &[],
        }
    }

    /// Whether the pixel engine computes rows of B again for each product.
    #[must_use]
    #[doc(hidden)]
    pub fn is_matrix_free(&self) -> bool {
        self.method() == Method::MatrixFree
    }

    /// Whether individual visibilities are stored instead of sums.
    #[must_use]
    #[doc(hidden)]
    pub fn holds_visibilities(&self) -> bool {
        self.refine.is_on() || self.is_matrix_free()
    }

    /// Maximum degree of a map from the harmonic engine.
    #[must_use]
    #[doc(hidden)]
    pub fn degree(&self) -> usize {
        if self.l_max > 0 { self.l_max } else { (DEGREES_PER_NSIDE * self.nside as f64) as usize }
    }

    /// The settings that determine the sums, by key; all others affect only solutions.
    #[must_use]
    #[doc(hidden)]
    pub fn sum_settings(&self) -> Vec<(&'static str, String)> {
        // Every field is named, so that whoever adds a key must decide whether a state depends on it.
        let Self {
            nside,
            engine,
            rows,
            matrix,
            baseline_bp_max,
            companion_seed,
            limits,
            weight_max,
            channels,
            channels_max: _,
            epsilon: _,
            regulariser: _,
            beyond_files: _, // By their contents.
            movers: _,       // No state has them.
            beams_deg: _,
            prior_k: _,
            prior_files: _,
            prior_frame: _,
            prior_fwhm_deg: _,
            moon_reflection: _,
            snapshot_every_s: _,
            residual_max: _,
            iterations_max: _,
            trace_probes: _,
            l_max: _, // See `degree`.
            antennas: _,
            refine: _, // See `method`.
        } = self;
        let engine = if *engine == EngineKind::Auto { EngineKind::Pixel } else { *engine };
        let mut settings = vec![
            ("map.nside", nside.to_string()),
            ("map.engine", format!("{engine:?}")),
            ("map.baseline_bp_max", format!("{baseline_bp_max:?}")),
            ("map.companion_seed", companion_seed.to_string()),
            ("map.weight_max", format!("{weight_max:?}")),
        ];
        if !channels.is_empty() {
            settings.push(("map.channels", format!("{channels:?}")));
        }
        let method = self.method();
        match method {
            Method::Pixel | Method::MatrixFree => settings.push(("map.rows", format!("{rows:?}"))),
            Method::Harmonic | Method::Refined => {
                settings.push(("map.l_max", self.degree().to_string()));
                settings.push(("map.limits", format!("{limits:?}")));
            }
        }
        match method {
            Method::Pixel | Method::Harmonic => {}
            Method::MatrixFree => settings.push(("map.matrix", format!("{matrix:?}"))),
            // The stored visibilities do not depend on how a map is refined.
            Method::Refined => settings.push(("map.refine.passes_max", REFINED.to_owned())),
        }
        settings
    }

    /// Whether something is set that only maps over pixels have.
    #[must_use]
    #[doc(hidden)]
    pub fn has_pixel_settings(&self) -> bool {
        self.matrix != MatrixKind::default() || self.rows != PixelMethod::default()
    }

    /// What the rows of a refined map are made with.
    ///
    /// # Errors
    /// Files of antennas that cannot be used.
    #[doc(hidden)]
    pub fn assumed(&self) -> Result<AssumedInstrument, MeasuredAntennasError> {
        let AntennasConfig { pattern_by_frequency, files, .. } = &self.antennas;
        Ok(AssumedInstrument {
            smear_integrations: self.refine.smear_integrations,
            antennas: self.antennas.assumed(),
            patterns: pattern_by_frequency.clone(),
            measured: MeasuredAntennas::read(files)?,
            ..AssumedInstrument::default()
        })
    }

    /// The longest baseline used at a frequency, m.
    ///
    /// b_p = wavelength / sqrt(4 pi / N_pix) is the baseline that a pixel just resolves (the paper, Sect. 4.2).
    #[must_use]
    #[doc(hidden)]
    pub fn baseline_m_max(&self, frequency_hz: f64) -> f64 {
        let pixel_rad = pixel_area_sr(self.nside).sqrt();
        self.baseline_bp_max * SPEED_OF_LIGHT_M_S / frequency_hz / pixel_rad
    }

    /// Whether a channel is mapped.
    #[must_use]
    #[doc(hidden)]
    pub fn is_mapped(&self, channel: ChannelId) -> bool {
        self.channels.is_empty() || self.channels.contains(&channel.0)
    }

    /// Requires that prior maps which state a frequency have that of their channel.
    ///
    /// # Errors
    /// [`AccumulationError::Prior`].
    #[doc(hidden)]
    pub fn check_priors(&self, instrument: &Instrument) -> Result<(), AccumulationError> {
        let frequencies_hz = instrument.frequencies_hz();
        let mut priors = self.prior_files.iter().zip(&frequencies_hz).enumerate();
        match self.prior_files.len() == frequencies_hz.len() {
            true => Ok(priors.try_for_each(|(channel, (path, &hz))| {
                check_frequency(path, hz, &self.prior_options(&frequencies_hz, channel))
            })?),
            false => Ok(()),
        }
    }

    /// Returns the options for reading the prior map of a channel: of its columns, the one of the channel's frequency.
    #[must_use]
    #[doc(hidden)]
    pub fn prior_options(&self, channels_hz: &[f64], channel: usize) -> ReadOptions {
        let frequency_hz =
            channels_hz.get(channel).copied().filter(|_| channels_hz.len() == self.prior_files.len());
        ReadOptions { frame_if_missing: self.prior_frame, frequency_hz, ..ReadOptions::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_auto_are_those_of_pixels() {
        let settings = |engine: EngineKind| MapConfig { engine, ..MapConfig::default() }.sum_settings();
        assert_eq!(settings(EngineKind::Auto), settings(EngineKind::Pixel));
    }
}
