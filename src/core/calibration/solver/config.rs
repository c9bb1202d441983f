//! Configuration of the solver.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::circle::NSIDE_MAX;
use super::reach::reach_note;
use crate::calibration::CalibrationError;
use crate::response::beacon::Beacon;
use crate::sky::SkyMap;
use crate::sky::fits::{ReadOptions, read_known_sky};
use crate::units::{Checks, InvalidValue, keys};

/// The signal whose visibilities are known.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CalibrationMode {
    /// The sky, from a map.
    #[default]
    Sky,
    /// An artificial signal, in the integrations flagged for it. The sky under it counts as an error.
    Beacon,
    /// Both: the sky everywhere, and the artificial signal where it is on.
    Joint,
}

/// What fixes the common amplitude of all daughters.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum AmplitudeScale {
    /// The model, whose flux scale is taken as true.
    #[default]
    Model,
    /// A geometric mean of one over the daughters: the sky keeps its scale.
    UnitMean,
}

/// Method of computing the visibilities of the known sky.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SkyModel {
    /// Harmonics for maps of nside 64 to 256 whose pixels are not split, without positions to solve for, in passes with enough
    /// visibilities on one circle (100 at nside 64); else direct sums.
    #[default]
    Auto,
    /// Sums over the map's pixels.
    Direct,
    /// Spherical harmonics to degree 5/2 nside for pairs on the circle of their pass, up to 2.5 nside wavelengths; sums over pixels
    /// for others.
    Harmonic,
}

/// Smallest nside for which harmonics are chosen: sums over fewer pixels are fast enough.
const HARMONIC_NSIDE_MIN: usize = 64;

keys! {
    /// The `[calibrate]` section, for `lunarray calibrate` and `calibration.hook = "solve"`. Standard deviations are those of what is expected before the
    /// data are seen; a parameter with 0 is not solved for.
    pub struct SolverConfig {
        /// The known signal: the "sky" of a map, a "beacon", or both, "joint".
        everyday mode: CalibrationMode = CalibrationMode::default();
        /// What fixes the common amplitude: the "model", or "unit-mean": the sky keeps its scale.
        expert amplitude_scale: AmplitudeScale = AmplitudeScale::default();
        /// Daughter, from 1, whose phase, clock and position are the reference.
        expert reference_daughter: u32 = 1;
        /// Prior standard deviation of the natural logarithm of a gain's amplitude.
        everyday amplitude_sigma: f64 = 0.3;
        /// Prior standard deviation of a gain's phase.
        everyday phase_sigma_deg: f64 = 120.0;
        /// Prior standard deviation of a clock, for all channels.
        everyday clock_sigma_ns: f64 = 0.0;
        /// Prior standard deviation of a position along each axis.
        everyday position_sigma_m: f64 = 0.0;
        /// Solutions of equal length in a pass, smoothed as a random walk.
        expert solutions_per_pass: u32 = 1;
        /// Time without data after which a new pass begins.
        expert pass_gap_s: f64 = 900.0;
        /// Residual beyond which a visibility is left out of a solution, over the spread of its pair and channel.
        expert outlier_sigma: f64 = 6.0;
        /// Maximum number of Gauss-Newton iterations in a round.
        expert iterations_max: u32 = 50;
        /// Maximum number of rounds, each with the model at the positions found before. Only positions take more than one.
        expert position_rounds: u32 = 3;
        /// Maximum part of a daughter's signal that a solution may leave unexplained; with more, its data are left out of maps.
        expert unexplained_max: f64 = 0.15;
        /// Maximum standard deviation of a phase; with more, a daughter's data are left out of maps.
        expert phase_sigma_deg_max: f64 = 15.0;
        /// Gain amplitude below which a receiver counts as dead.
        expert dead_amplitude: f64 = 0.05;
        /// Maps of the known sky (K, FITS), one per channel of the downlink.
        everyday model_files: Vec<PathBuf> = Vec::new();
        /// HEALPix nside to which the model map's pixels are split; 0 for its own.
        expert model_nside: usize = 0;
        /// How visibilities of the known sky are computed: "direct" sums over pixels, "harmonic" on the circle of a pass to
        /// degree 5/2 nside, or "auto", by nside and number of visibilities.
        expert sky_model: SkyModel = SkyModel::default();
        /// Power of the artificial signal at a daughter.
        expert beacon_k_sr: f64 = 0.0;
        /// Ecliptic longitude and latitude that the artificial signal comes from.
        expert beacon_direction_deg: [f64; 2] = [0.0, 0.0];
        /// Maximum number of rounds of map and calibration; 0 for the given model alone.
        everyday map_rounds: u32 = 0;
        /// Rms relative change of the gains below which rounds of map and calibration end.
        expert settled: f64 = 1e-3;
        /// Leave every n-th pass out of the maps that calibrate, to test them; 0 for none.
        expert hold_out_every: u32 = 0;
    }
}

impl SolverConfig {
    /// The artificial signal.
    #[must_use]
    pub fn beacon(&self) -> Beacon {
        Beacon { k_sr: self.beacon_k_sr, direction_deg: self.beacon_direction_deg }
    }

    /// Checks that `sky_model` accepts maps of the known sky.
    ///
    /// # Errors
    /// A map is too fine for harmonics.
    pub(super) fn can_model(&self, maps: &[SkyMap]) -> Result<(), InvalidValue> {
        let nside = maps.iter().map(SkyMap::nside).max().unwrap_or(0);
        if self.sky_model != SkyModel::Harmonic || nside <= NSIDE_MAX {
            return Ok(());
        }
        Err(InvalidValue {
            key: "calibrate.sky_model".to_owned(),
            value: "harmonic".to_owned(),
            expected: format!(
                "\"direct\" or \"auto\" with a map of nside {nside}: harmonics are made to nside {NSIDE_MAX}"
            )
            .into(),
        })
    }

    /// Whether the sky of a map of this nside is computed by harmonics.
    #[must_use]
    pub fn is_harmonic(&self, nside: usize) -> bool {
        match self.sky_model {
            SkyModel::Direct => false,
            SkyModel::Harmonic => true,
            SkyModel::Auto => {
                let is_plain = self.position_sigma_m == 0.0 && self.model_nside == 0;
                is_plain && (HARMONIC_NSIDE_MIN..=NSIDE_MAX).contains(&nside)
            }
        }
    }

    /// The known signal, with or without maps of the sky: joint mode without a map is beacon mode.
    #[must_use]
    pub fn known_signal(&self, has_maps: bool) -> CalibrationMode {
        match (self.mode, has_maps) {
            (CalibrationMode::Joint, false) => CalibrationMode::Beacon,
            (mode, _) => mode,
        }
    }

    /// Reads the maps of the known sky.
    ///
    /// # Errors
    /// A map cannot be read.
    pub fn models(&self) -> Result<Vec<SkyMap>, CalibrationError> {
        let read = |path: &PathBuf| Ok(read_known_sky(path, &ReadOptions::default())?);
        self.model_files.iter().map(read).collect()
    }

    /// All settings that cannot be used while the data arrive; empty if there are none.
    #[must_use]
    pub fn problems_of_hook(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("calibrate");
        let has_signal = self.mode != CalibrationMode::Sky || !self.model_files.is_empty();
        let expected = "maps of the sky, one for each channel, with calibration.hook = \"solve\" and calibrate.mode = \"sky\"";
        checks.require("model_files", "[]", has_signal, expected);
        let rounds = self.map_rounds;
        let expected =
            "0 with calibration.hook = \"solve\": data are not kept for calibration with a later map";
        checks.require("map_rounds", rounds, rounds == 0, expected);
        checks.finish()
    }

    /// Note for the user if positions may be further off than the search in channels of these frequencies extends.
    #[must_use]
    pub fn reach_note(&self, frequencies_hz: &[f64]) -> Option<String> {
        let lowest_hz = frequencies_hz.iter().copied().reduce(f64::min)?;
        reach_note(self.position_sigma_m, lowest_hz)
    }

    /// Notes for the user on what the data of channels of these frequencies do not determine, and how it is fixed.
    #[must_use]
    pub fn conventions(&self, frequencies_hz: &[f64]) -> Vec<String> {
        let mut notes = vec![format!(
            "phases, clocks and positions are relative to daughter {}: a phase that all have leaves no trace, and a shift of all \
             positions only a rotation of the sky",
            self.reference_daughter
        )];
        notes.push(match self.amplitude_scale {
            AmplitudeScale::Model => {
                "the common amplitude is that of the model: a sky of other strength gives other gains"
                    .to_owned()
            }
            AmplitudeScale::UnitMean => {
                "the geometric mean of the amplitudes is one: what all gains share goes into the map"
                    .to_owned()
            }
        });
        if self.clock_sigma_ns > 0.0 && self.phase_sigma_deg > 0.0 {
            notes.push(
                "a clock and the phases of its channels differ by their priors alone; their sum is what is measured".to_owned(),
            );
        }
        notes.extend(self.reach_note(frequencies_hz));
        notes
    }

    /// All invalid values; empty if there are none.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("calibrate");
        for (key, value, most) in [
            ("amplitude_sigma", self.amplitude_sigma, 10.0),
            ("phase_sigma_deg", self.phase_sigma_deg, 1e4),
            ("clock_sigma_ns", self.clock_sigma_ns, 1e9),
            ("position_sigma_m", self.position_sigma_m, 1e6),
        ] {
            let expected = format!("0 (not solved for) to {most:e}");
            checks.number(key, value, (0.0..=most).contains(&value), expected);
        }
        for (key, value, least, most) in [
            ("reference_daughter", self.reference_daughter, 1, 64),
            ("solutions_per_pass", self.solutions_per_pass, 1, 1000),
            ("iterations_max", self.iterations_max, 1, 1000),
            ("position_rounds", self.position_rounds, 1, 20),
            ("map_rounds", self.map_rounds, 0, 100),
            ("hold_out_every", self.hold_out_every, 0, 1_000_000),
        ] {
            checks.require(key, value, (least..=most).contains(&value), format!("{least} to {most}"));
        }
        let period = self.hold_out_every;
        checks.require(
            "hold_out_every",
            period,
            period != 1,
            "0 or at least 2: some passes have to make the map",
        );
        let gap_s = self.pass_gap_s;
        checks.number("pass_gap_s", gap_s, (1.0..=1e6).contains(&gap_s), "1 s to 1e6 s");
        let cut = self.outlier_sigma;
        checks.number("outlier_sigma", cut, (3.0..=1e6).contains(&cut), "3 to 1e6");
        let most = self.phase_sigma_deg_max;
        checks.number("phase_sigma_deg_max", most, most > 0.0, "degrees, above 0");
        let part = self.unexplained_max;
        checks.number("unexplained_max", part, part > 0.0 && part <= 1.0, "above 0 to 1");
        let dead = self.dead_amplitude;
        checks.number("dead_amplitude", dead, (0.0..1.0).contains(&dead), "0 to below 1");
        let solves = [self.amplitude_sigma, self.phase_sigma_deg, self.clock_sigma_ns, self.position_sigma_m];
        let expected = "something to solve for: a positive sigma of amplitude, phase, clock or position";
        checks.require(
            "phase_sigma_deg",
            "0, as the others",
            solves.iter().any(|sigma| *sigma > 0.0),
            expected,
        );
        let single = self.position_sigma_m == 0.0 || self.solutions_per_pass == 1;
        checks.require("solutions_per_pass", self.solutions_per_pass, single, "1 with position_sigma_m");
        checks.number("settled", self.settled, self.settled > 0.0, "above 0");
        let nside = self.model_nside;
        let good = nside == 0 || (nside.is_power_of_two() && nside <= 1024);
        checks.require("model_nside", nside, good, "0, or a power of two up to 1024");
        let is_harmonic = self.sky_model == SkyModel::Harmonic;
        let expected = "0 with sky_model = \"harmonic\", which has no pixels";
        checks.require("model_nside", nside, !is_harmonic || nside == 0, expected);
        let expected = "\"direct\" or \"auto\" with position_sigma_m: its derivatives are sums over pixels";
        checks.require("sky_model", "harmonic", !is_harmonic || self.position_sigma_m == 0.0, expected);
        self.beacon().check("beacon", &mut checks);
        let has_power = self.mode == CalibrationMode::Sky || self.beacon_k_sr > 0.0;
        let expected = "the power of the artificial signal, K sr, for mode = \"beacon\" and \"joint\"";
        checks.number("beacon_k_sr", self.beacon_k_sr, has_power, expected);
        checks.finish()
    }
}
