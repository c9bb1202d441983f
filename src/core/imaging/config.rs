//! Configuration of maps.

use std::collections::BTreeSet;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::frames::Instrument;
use crate::imaging::antennas::AntennasConfig;
use crate::imaging::anywhere::AssumedInstrument;
use crate::imaging::circle::L_MAX;
use crate::imaging::pixel::POWER_NSIDE_MAX;
use crate::imaging::{AccumulationError, PixelEngine};
use crate::response::harmonic::GeometryLimits;
use crate::response::pixel::PixelMethod;
use crate::response::{MeasuredAntennas, MeasuredAntennasError};
use crate::sky::fits::{ReadOptions, check_frequency};
use crate::sky::healpix::{is_valid_nside, pixel_area_sr};
use crate::sky::{Frame, TEMPERATURE_K_MAX};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::{ChannelId, Checks, InvalidValue, PerChannel, keys};

/// Maximum nside of the pixel engine: 49152 pixels, 9.7 GB of sums per channel (half of a symmetric matrix, f64).
pub const PIXEL_ENGINE_NSIDE_MAX: usize = 64;

/// Maximum nside of the matrix-free pixel engine: one product with the rows of a million visibilities takes hours.
pub const MATRIX_FREE_NSIDE_MAX: usize = 256;

/// Maximum nside of maps from the harmonic engine: pixels ten times finer than its maximum degree.
pub const HARMONIC_ENGINE_NSIDE_MAX: usize = 1024;

/// Default epsilon.
const EPSILON: f64 = 1e-4;

/// Default number of degrees of a harmonic map per nside: those that pixels represent to 1e-6.
const DEGREES_PER_NSIDE: f64 = 2.5;

/// Maximum number of beam directions, each of which takes a solution.
const BEAMS_MAX: usize = 100;

/// Channels whose sums are in memory at the same time.
pub type ChannelGroup = BTreeSet<ChannelId>;

/// The basis of the normal equations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
#[non_exhaustive]
pub enum EngineKind {
    /// Pixels: exact, for any orbit; N_pix^2 operations per visibility.
    #[default]
    Pixel,
    /// Spherical harmonics: thousands of operations per visibility; needs satellites on one circular orbit.
    Harmonic,
    /// The cheaper one that the orbits of `[array]` allow: replaced by it when a pipeline is read, and otherwise the same as [`Self::Pixel`].
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
        /// What a map is made of: "pixel", exact on any orbit; "harmonic", far cheaper, for satellites on one circle or with
        /// map.refine; or "auto": "harmonic" if the orbits of section `array` allow it.
        everyday engine: EngineKind = EngineKind::Pixel;
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
        /// Regularisation epsilon; one value, or one a channel. Alone it asks for R = epsilon W_max I, the paper's; "degree" and
        /// "file" take 1e-4 without it.
        #[only_with(r#"no map.regulariser = "data""#)]
        #[serde(skip_serializing_if = "Option::is_none")]
        everyday epsilon: Option<PerChannel<f64>> = None;
        /// Regulariser R: "data", 1 / C_l as found from the data (default); "identity", epsilon W_max I, the paper's (default
        /// with epsilon, map.refine, matrix = "free" or pixels beyond nside 32); with the engine "harmonic" also { degree =
        /// 2.0 }, epsilon W_max (l + 1)^2, or { file = ["cl.csv"] }, epsilon / C_l from tables of l and C_l (K^2), one a
        /// channel. W_max is the largest eigenvalue of the normal matrix.
        #[serde(skip_serializing_if = "Option::is_none")]
        everyday regulariser: Option<RegulariserChoice> = None;
        /// Tables of the sky's C_l (K^2), one a channel, such as sky-power.csv of an earlier map: what the sky has beyond the
        /// map's degrees then counts as noise, more on some baselines than on others. A table goes on beyond its last degree
        /// as it ends.
        #[serde(skip_serializing_if = "Vec::is_empty")]
        expert beyond_files: Vec<PathBuf> = Vec::new();
        /// Ecliptic longitudes and latitudes of points whose effective beam is computed, such as `[[0.0, 90.0]]`.
        #[serde(skip_serializing_if = "Vec::is_empty")]
        everyday beams_deg: Vec<[f64; 2]> = Vec::new();
        /// Uniform prior map; 0 for none; one value, or one a channel.
        everyday prior_k: PerChannel<f64> = PerChannel::All(0.0);
        /// Prior maps: HEALPix FITS files, one a channel, in K.
        everyday prior_files: Vec<PathBuf> = Vec::new();
        /// Frame of prior maps without COORDSYS, as sky.frame. Without it they are refused.
        #[only_with("map.prior_files")]
        #[serde(skip_serializing_if = "Option::is_none")]
        expert prior_frame: Option<Frame> = None;
        /// FWHM to which prior maps are smoothed.
        #[only_with("map.prior_files")]
        expert prior_fwhm_deg: f64 = 5.0;
        /// Share xi_R of the sky's power that the Moon is taken to reflect: visibilities are divided by one plus this.
        expert moon_reflection: f64 = 0.0;
        /// Mission time between snapshot maps; 0 for a final map only.
        everyday snapshot_every_s: f64 = 0.0;
        /// Maximum weight of a visibility, (K sr)^-2, which sets the resolution of the sums; 0 for 1024 times that of 25 s under
        /// the mean sky of the channel's frequency.
        expert weight_max: f64 = 0.0;
        /// Seed of the noise-only companion map.
        expert companion_seed: u64 = 1;
        /// Residual at which an iterative solution stops, relative to the right-hand side, in the preconditioner's norm.
        #[only_with(r#"map.engine = "harmonic" or map.matrix = "free""#)]
        expert residual_max: f64 = 1e-4;
        /// Maximum number of iterations of a solution.
        #[only_with(r#"map.engine = "harmonic" or map.matrix = "free""#)]
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
    /// The choice of R: from the data unless set otherwise. The default is the identity if epsilon is set, if visibilities are stored, or if
    /// there are too many pixels for an R from the data.
    #[must_use]
    #[doc(hidden)]
    pub fn regulariser(&self) -> RegulariserChoice {
        let is_large = self.engine != EngineKind::Harmonic && self.nside > POWER_NSIDE_MAX;
        let is_identity = self.holds_visibilities() || self.epsilon.is_some() || is_large;
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
        self.engine != EngineKind::Harmonic && self.matrix == MatrixKind::Free
    }

    /// Whether individual visibilities are stored instead of sums.
    #[must_use]
    #[doc(hidden)]
    pub fn holds_visibilities(&self) -> bool {
        self.refine.is_on() || self.is_matrix_free()
    }

    /// All invalid settings.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("map");
        let is_harmonic = self.engine == EngineKind::Harmonic;
        let nside_max = match self.engine {
            EngineKind::Harmonic => HARMONIC_ENGINE_NSIDE_MAX,
            _ if self.is_matrix_free() => MATRIX_FREE_NSIDE_MAX,
            EngineKind::Pixel | EngineKind::Auto => PIXEL_ENGINE_NSIDE_MAX,
        };
        let good = is_valid_nside(self.nside) && self.nside <= nside_max;
        let expected = format!("a power of two from 1 to {nside_max} for this engine");
        checks.require("nside", self.nside, good, expected);
        let channels = self.channels_max;
        checks.require("channels_max", channels, (1..=4096).contains(&channels), "1 to 4096");
        let longest = self.baseline_bp_max;
        // The shortest baselines of any array are longer than the lower bound.
        let expected = "1e-6 to 1e12, in units of b_p";
        checks.number("baseline_bp_max", longest, (1e-6..=1e12).contains(&longest), expected);
        // What is beyond is tabulated up to this length, with all degrees that it reaches.
        let is_tabulated = self.beyond_files.is_empty() || longest <= 100.0;
        checks.number("baseline_bp_max", longest, is_tabulated, "at most 100 with map.beyond_files");
        // Less is lost in the rounding of the normal matrix.
        let expected = "1e-16 to 1";
        checks.numbers("epsilon", self.epsilon().values(), |e| (1e-16..=1.0).contains(&e), expected);
        let is_temperature = |k| (0.0..=TEMPERATURE_K_MAX).contains(&k);
        checks.numbers("prior_k", self.prior_k.values(), is_temperature, "0 to 1e16 K");
        let fwhm = self.prior_fwhm_deg;
        checks.number("prior_fwhm_deg", fwhm, (0.0..=180.0).contains(&fwhm), "0 to 180");
        let share = self.moon_reflection;
        checks.number("moon_reflection", share, (0.0..=1.0).contains(&share), "0 to 1");
        if is_harmonic {
            let l_max = self.l_max as f64;
            checks.number("l_max", l_max, self.l_max < 3 * self.nside, "0, or 1 to 3 nside - 1");
            let degree = self.degree() as f64;
            checks.number("l_max", degree, self.degree() <= L_MAX, "at most 1024; 0 stands for 2.5 nside");
        }
        let residual = self.residual_max;
        checks.number("residual_max", residual, residual > 0.0 && residual < 1.0, "above 0 and below 1");
        let iterations = self.iterations_max as f64;
        checks.number("iterations_max", iterations, self.iterations_max > 0, "at least 1");
        for (key, value) in self.limits.values() {
            checks.number(key, value, value >= 0.0, "not negative");
        }
        self.check_refinement(&mut checks);
        self.check_regularisation(&mut checks);
        let weight = self.weight_max;
        checks.number(
            "weight_max",
            weight,
            weight == 0.0 || (1e-60..=1e60).contains(&weight),
            "0, or 1e-60 to 1e60",
        );
        let every = self.snapshot_every_s;
        checks.number("snapshot_every_s", every, every >= 0.0, "seconds, or 0 for a final map only");
        let is_single = self.prior_files.is_empty() || self.prior_k.values().iter().all(|&k| k == 0.0);
        let files = self.prior_files.len();
        checks.require(
            "prior_files",
            format!("({files} files)"),
            is_single,
            "none where map.prior_k is given",
        );
        checks.finish()
    }

    /// Checks the refinement, and that no setting is incompatible with it.
    fn check_refinement(&self, checks: &mut Checks) {
        let RefineConfig { residual_max, visibilities_max, .. } = self.refine;
        checks.number(
            "refine.residual_max",
            residual_max,
            residual_max > 0.0 && residual_max < 1.0,
            "above 0 and below 1",
        );
        checks.require("refine.visibilities_max", visibilities_max, visibilities_max > 0, "at least 1");
        self.antennas.check(checks);
        if self.is_matrix_free() {
            let probes = self.trace_probes;
            let expected = "0 with map.matrix = \"free\": traces need the matrix";
            checks.require("trace_probes", probes, probes == 0, expected);
        }
        if self.refine.is_on() {
            let probes = self.trace_probes;
            checks.require(
                "trace_probes",
                probes,
                probes == 0,
                "0 with map.refine: traces would be those of the circle",
            );
        }
    }

    /// Checks R, and that traces are requested only for multiples of the identity.
    fn check_regularisation(&self, checks: &mut Checks) {
        let regulariser = self.regulariser();
        if let RegulariserChoice::Degree(exponent) = regulariser {
            checks.number("regulariser.degree", exponent, (-10.0..=10.0).contains(&exponent), "-10 to 10");
        }
        if let RegulariserChoice::File(files) = &regulariser {
            checks.require("regulariser.file", "[]", !files.is_empty(), "at least one table");
        }
        let is_identity = regulariser == RegulariserChoice::Identity;
        let is_by_degree = !is_identity && regulariser != RegulariserChoice::Data;
        let found = match &regulariser {
            RegulariserChoice::Data => "data",
            RegulariserChoice::Identity => "identity",
            RegulariserChoice::Degree(_) => "degree",
            RegulariserChoice::File(_) => "file",
        };
        checks.require(
            "regulariser",
            found,
            is_identity || !self.is_matrix_free(),
            "\"identity\", or no such key, with map.matrix = \"free\"",
        );
        checks.require(
            "regulariser",
            found,
            !is_by_degree || self.engine == EngineKind::Harmonic,
            "\"data\" or \"identity\" without map.engine = \"harmonic\"",
        );
        let is_small = self.engine == EngineKind::Harmonic || self.nside <= POWER_NSIDE_MAX;
        checks.require(
            "regulariser",
            found,
            regulariser != RegulariserChoice::Data || is_small,
            "\"identity\" with the pixel engine beyond nside 32; or map.engine = \"harmonic\"",
        );
        let beams = self.beams_deg.len();
        let is_valid = beams <= BEAMS_MAX && (beams == 0 || !self.holds_visibilities());
        checks.require(
            "beams_deg",
            format!("({beams} directions)"),
            is_valid,
            "at most 100, and none with map.refine or map.matrix = \"free\"",
        );
        for &[longitude_deg, latitude_deg] in &self.beams_deg {
            let good = longitude_deg.abs() <= 360.0 && latitude_deg.abs() <= 90.0;
            let found = format!("[{longitude_deg}, {latitude_deg}]");
            checks.require("beams_deg", found, good, "ecliptic longitude and latitude, degrees");
        }
        if !is_identity {
            let expected = "0 unless map.regulariser = \"identity\": traces are those of R = epsilon W_max I";
            checks.require("trace_probes", self.trace_probes, self.trace_probes == 0, expected);
        }
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
            refine,
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
        match engine {
            EngineKind::Pixel | EngineKind::Auto => {
                settings.push(("map.rows", format!("{rows:?}")));
                if self.is_matrix_free() {
                    settings.push(("map.matrix", format!("{matrix:?}")));
                }
            }
            EngineKind::Harmonic => {
                settings.push(("map.l_max", self.degree().to_string()));
                settings.push(("map.limits", format!("{limits:?}")));
                if refine.is_on() {
                    // The stored visibilities do not depend on how a map is refined.
                    settings.push(("map.refine.passes_max", REFINED.to_owned()));
                }
            }
        }
        settings
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

    /// Requires that the sums of the mapped channels of a group take at most `limit_bytes`; the instrument has `channels` channels. Harmonic sums
    /// grow with the data and are not counted.
    ///
    /// # Errors
    /// [`AccumulationError::Memory`].
    #[doc(hidden)]
    pub fn require_memory(
        &self,
        channels: usize,
        limit_bytes: Option<u64>,
        group: Option<&ChannelGroup>,
    ) -> Result<(), AccumulationError> {
        let each = match self.engine {
            EngineKind::Harmonic => 0,
            _ if self.is_matrix_free() => 0,
            EngineKind::Pixel | EngineKind::Auto => PixelEngine::memory_bytes(self.nside),
        };
        let is_summed = |channel: &ChannelId| {
            self.is_mapped(*channel) && group.is_none_or(|group| group.contains(channel))
        };
        let channels = (0..channels as u16).map(ChannelId).filter(is_summed).count();
        let needed_bytes = each.saturating_mul(channels as u64);
        match limit_bytes {
            Some(limit_bytes) if needed_bytes > limit_bytes => {
                Err(AccumulationError::Memory { channels, needed_bytes, limit_bytes })
            }
            _ => Ok(()),
        }
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

    /// Per-channel settings that do not match an instrument of `channels` channels.
    #[must_use]
    #[doc(hidden)]
    pub fn mismatches(&self, channels: usize) -> Vec<InvalidValue> {
        let epsilon = self.epsilon();
        let mut checks = Checks::new("map");
        let expected =
            format!("at least the {channels} channels of the instrument, each of which needs memory");
        checks.require("channels_max", self.channels_max, channels <= self.channels_max, expected);
        for (index, &channel) in self.channels.iter().enumerate() {
            let expected = format!("a channel of the instrument, 0 to {}", channels.saturating_sub(1));
            let key = format!("channels[{index}]");
            checks.require(&key, channel, usize::from(channel) < channels, expected);
            checks.require(key, channel, !self.channels[..index].contains(&channel), "every channel once");
        }
        for (key, values) in [("epsilon", &epsilon), ("prior_k", &self.prior_k)] {
            let expected = format!("a single value, or a list of one for each of the {channels} channels");
            checks.require(
                key,
                format!("({} values)", values.values().len()),
                values.fits(channels),
                expected,
            );
        }
        for (key, files) in [
            ("prior_files", self.prior_files.len()),
            ("regulariser.file", self.power_files().len()),
            ("beyond_files", self.beyond_files.len()),
        ] {
            let expected = format!("one file for each of the {channels} channels");
            checks.require(key, format!("({files} files)"), files == 0 || files == channels, expected);
        }
        checks.finish()
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

    #[test]
    fn files_are_one_a_channel() {
        let files = vec![PathBuf::from("one"); 2];
        for (key, map) in [
            ("prior_files", MapConfig { prior_files: files.clone(), ..MapConfig::default() }),
            ("beyond_files", MapConfig { beyond_files: files.clone(), ..MapConfig::default() }),
            (
                "regulariser.file",
                MapConfig {
                    regulariser: Some(RegulariserChoice::File(files.clone())),
                    ..MapConfig::default()
                },
            ),
        ] {
            assert_eq!(map.mismatches(2), vec![]);
            let [found] = &map.mismatches(3)[..] else { panic!("{key}") };
            let expected = format!("map.{key} = (2 files): expected one file for each of the 3 channels");
            assert_eq!(found.to_string(), expected);
        }
    }

    #[test]
    fn values_with_which_no_map_is_possible_are_refused() {
        for (map, expected) in [
            (MapConfig { epsilon: Some(PerChannel::All(1e-320)), ..MapConfig::default() }, "map.epsilon"),
            (MapConfig { baseline_bp_max: 1e-300, ..MapConfig::default() }, "map.baseline_bp_max"),
        ] {
            let found: Vec<String> = map.problems().iter().map(ToString::to_string).collect();
            assert!(found.len() == 1 && found[0].starts_with(expected), "{found:?}");
        }
        let map = MapConfig { channels: vec![1, 0, 1], ..MapConfig::default() };
        let [found] = &map.mismatches(2)[..] else { panic!() };
        assert_eq!(found.to_string(), "map.channels[2] = 1: expected every channel once");
    }

    #[test]
    fn what_is_beyond_ends_with_the_baselines() {
        for (files, baseline_bp_max, good) in [(0, 1e9, true), (1, 100.0, true), (1, 101.0, false)] {
            let beyond_files = vec![PathBuf::from("one"); files];
            let map = MapConfig { beyond_files, baseline_bp_max, ..MapConfig::default() };
            let found: Vec<String> = map.problems().iter().map(ToString::to_string).collect();
            assert!(found.is_empty() == good, "{found:?}");
            assert!(found.iter().all(|problem| problem.contains("at most 100 with map.beyond_files")));
        }
    }
}
