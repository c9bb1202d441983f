//! Which settings of maps are valid, alone and with an instrument.

use super::{EngineKind, L_MAX, MapConfig, Method, PIXEL_ENGINE_NSIDE_MAX, RefineConfig, RegulariserChoice};
use crate::sky::TEMPERATURE_K_MAX;
use crate::sky::healpix::is_valid_nside;
use crate::units::{Checks, InvalidValue};

/// Maximum nside of the matrix-free pixel engine: one product with the rows of a million visibilities takes hours.
pub const MATRIX_FREE_NSIDE_MAX: usize = 256;

/// Maximum nside of maps from the harmonic engine: pixels ten times finer than its maximum degree.
pub const HARMONIC_ENGINE_NSIDE_MAX: usize = 1024;

/// Maximum number of beam directions, each of which takes a solution.
const BEAMS_MAX: usize = 100;

impl MapConfig {
    /// All invalid settings.
    #[must_use]
    #[doc(hidden)]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("map");
        let is_harmonic = self.engine == EngineKind::Harmonic;
        let nside_max = match self.method() {
            Method::Pixel => PIXEL_ENGINE_NSIDE_MAX,
            Method::MatrixFree => MATRIX_FREE_NSIDE_MAX,
            Method::Harmonic | Method::Refined => HARMONIC_ENGINE_NSIDE_MAX,
        };
        let good = is_valid_nside(self.nside) && self.nside <= nside_max;
        let engine = if is_harmonic { "harmonic" } else { "pixel" };
        let expected = format!("a power of two from 1 to {nside_max} for map.engine = \"{engine}\"");
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
        for (index, body) in self.movers.iter().enumerate() {
            let is_new = !self.movers[..index].contains(body);
            checks.require(format!("movers[{index}]"), format!("{body:?}"), is_new, "every body once");
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
        if !is_identity && !self.holds_visibilities() {
            let expected = "0 unless map.regulariser = \"identity\": traces are those of R = epsilon W_max I";
            checks.require("trace_probes", self.trace_probes, self.trace_probes == 0, expected);
        }
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
    use std::path::PathBuf;

    use super::*;
    use crate::units::PerChannel;

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
