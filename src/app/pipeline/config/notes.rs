//! Notes on configurations that are valid but probably unintended.

use std::f64::consts::TAU;
use std::path::PathBuf;

use super::plan::Plan;
use super::sections::Config;
use crate::array::{NodeMotion, ObservingWindows};
use crate::calibration::{CORRELATED_MAX, CalibrationHook, GainsFile, VanVleck};
use crate::imaging::{EVEN_SHARE, Method, RegulariserChoice, WHOLE_UNKNOWNS_MAX};
use crate::mother::{Fidelity, largest_gap};
use crate::units::Dimension;
use crate::units::constants::{DAY_S, MOON_GM_M3_S2, MOON_RADIUS_M, SIDEREAL_MONTH_S};

/// Angle, deg, by which baselines between corrected positions may lie off the common circular orbit.
const CORRECTED_DEG: f64 = 2.0;

/// Fraction of a period that thinning may leave without a window, beyond the gaps of the full mission. A map from 17 windows with gaps of
/// 0.3 had rho_2 = 0.74 and a mean 12 % too low; one from 122 windows with gaps of 0.1 had rho_2 = 1.00 and a mean within 0.1 %.
const GAP_MAX: f64 = 0.15;

/// J2 of the Moon and the radius to which it refers (GRAIL).
const MOON_J2: f64 = 2.033e-4;
const MOON_J2_RADIUS_M: f64 = 1.738e6;

/// Accepted difference of the node's rate from that by J2, in units of the rate of an equatorial orbit; the paper's is 0.04.
const PRECESSION_TOLERANCE: f64 = 0.1;

/// Accepted relative difference of the orbital period from Kepler's third law; the paper's is 2e-4.
const PERIOD_TOLERANCE: f64 = 0.01;

impl Config {
    /// Notes on values that are valid but probably unintended.
    #[must_use]
    #[doc(hidden)]
    pub fn notes(&self) -> Vec<String> {
        let notes = [
            self.period_note(),
            self.precession_note(),
            self.coverage_note(),
            self.quantiser_note(),
            self.positions_note(),
            self.reach_note(),
            self.rate_note(),
            self.gain_errors_note(),
        ];
        notes.into_iter().flatten().collect()
    }

    /// A note that the rate does not limit the last pass.
    fn rate_note(&self) -> Option<String> {
        (self.downlink.rate_bits_per_s_max > 0.0).then(|| {
            "downlink.rate_bits_per_s_max does not limit the last pass, which sends everything that is left on board".to_owned()
        })
    }

    /// A note if errors of gains are asked for, and none will be known.
    #[must_use]
    #[doc(hidden)]
    pub fn gain_errors_note(&self) -> Option<String> {
        let (calibration, draws) = (&self.calibration, self.calibration.error_draws);
        let reason = match calibration.hook {
            CalibrationHook::Solve if self.array.satellites > CORRELATED_MAX => {
                format!("solutions for more than {CORRELATED_MAX} satellites")
            }
            CalibrationHook::AntennaGains if calibration.known_error_draws() == 0 => {
                "the gains of calibration.gains_file".to_owned()
            }
            _ => return None,
        };
        (draws > 0).then(|| {
            format!(
                "calibration.error_draws = {draws} does nothing: {reason} have no stated errors, and errors of maps leave them out"
            )
        })
    }

    /// A note if position errors may exceed the range that is searched while the data arrive.
    fn reach_note(&self) -> Option<String> {
        let solves = self.calibration.hook == CalibrationHook::Solve;
        solves.then(|| self.calibrate.reach_note(&self.spacecraft.channels_hz)).flatten()
    }

    /// A note if positions are corrected, but the limits of the harmonic engine refuse the corrected baselines.
    #[must_use]
    #[doc(hidden)]
    pub fn positions_note(&self) -> Option<String> {
        let limits = &self.map.limits;
        let is_refused = self.map.method() == Method::Harmonic && self.has_narrow_limits();
        (is_refused && self.corrects_positions()).then(|| {
            format!(
                "errors of corrected positions put them off the common circle (3.5 m are {CORRECTED_DEG} deg of a baseline of 100 m), \
                 and the harmonic engine refuses baselines beyond map.limits.out_of_track_deg_max = {} and \
                 map.limits.radial_deg_max = {}: set both to {CORRECTED_DEG}, or map.refine.passes_max above 0",
                limits.out_of_track_deg_max, limits.radial_deg_max
            )
        })
    }

    /// Whether the harmonic engine refuses short baselines between positions that are metres off the circle.
    pub(super) fn has_narrow_limits(&self) -> bool {
        let limits = &self.map.limits;
        limits.out_of_track_deg_max.min(limits.radial_deg_max) < CORRECTED_DEG
    }

    /// Whether calibration changes positions.
    pub(super) fn corrects_positions(&self) -> bool {
        let has_positions =
            |path: &PathBuf| GainsFile::read(path).is_ok_and(|file| !file.positions.is_empty());
        let is_read = self.calibration.hook == CalibrationHook::AntennaGains;
        // `lunarray calibrate` solves for them, whatever the hook.
        self.calibrate.position_sigma_m > 0.0
            || is_read && self.calibration.gains_file.as_ref().is_some_and(has_positions)
    }

    /// A note if the orbital period does not fit the altitude.
    fn period_note(&self) -> Option<String> {
        let array = &self.array;
        let radius_m = array.moon_radius_m + array.altitude_m;
        let kepler_s = TAU * (radius_m.powi(3) / MOON_GM_M3_S2).sqrt();
        let differs = (array.orbital_period_s / kepler_s - 1.0).abs() > PERIOD_TOLERANCE;
        // Kepler's law is checked for the mass of the Moon only.
        let is_formation = !array.has_own_orbits();
        (differs && is_formation && array.moon_radius_m == MOON_RADIUS_M).then(|| {
            format!(
                "array.orbital_period_s = {}, but an orbit {} above the Moon takes {kepler_s:.2} s",
                array.orbital_period_s,
                Dimension::Length.show(array.altitude_m)
            )
        })
    }

    /// A note if the node does not turn as the Moon's flattening turns it.
    fn precession_note(&self) -> Option<String> {
        let array = &self.array;
        if array.has_own_orbits() || array.moon_radius_m != MOON_RADIUS_M {
            return None;
        }
        let (radius_m, inclination_rad) =
            (array.moon_radius_m + array.altitude_m, array.inclination_deg.to_radians());
        let motion = (MOON_GM_M3_S2 / radius_m.powi(3)).sqrt();
        let fastest = 1.5 * motion * MOON_J2 * (MOON_J2_RADIUS_M / radius_m).powi(2)
            / (1.0 - array.eccentricity.powi(2)).powi(2);
        let rate = -fastest * inclination_rad.cos();
        let sign = if array.node_motion == NodeMotion::Regress { -1.0 } else { 1.0 };
        let given = sign * TAU / array.precession_period_s;
        // Relative to the rate of an equatorial orbit, as that at 90 degrees is 0.
        ((given - rate).abs() > PRECESSION_TOLERANCE * fastest).then(|| {
            let turns = match TAU / rate.abs() {
                period_s if rate.abs() < 1e-3 * fastest || !period_s.is_finite() => "hardly turns the node".to_owned(),
                period_s => format!(
                    "turns the node once in {period_s:.3e} s (array.node_motion = {})",
                    if rate < 0.0 { "\"regress\"" } else { "\"advance\"" }
                ),
            };
            format!(
                "array.precession_period_s = {:e}, but the Moon's flattening (J2) {turns} at an inclination of {} deg and an altitude of {}",
                array.precession_period_s,
                array.inclination_deg,
                Dimension::Length.show(array.altitude_m)
            )
        })
    }

    /// A note if the node turns too little for C_l and errors of maps of pixels, and of harmonic maps that are too large for their whole
    /// matrix, or joint.
    fn coverage_note(&self) -> Option<String> {
        let Self { array, map, spacecraft, joint, .. } = self;
        let turn = spacecraft.duration_s / array.precession_period_s;
        // Orbits of their own turn otherwise, and stations have no node.
        if map.regulariser() != RegulariserChoice::Data || turn >= EVEN_SHARE || array.has_own_orbits() {
            return None;
        }
        let is_large = (map.degree() + 1).pow(2) > WHOLE_UNKNOWNS_MAX || joint.on;
        let is_harmonic = match map.method() {
            Method::Harmonic if !is_large || map.refine.is_on() || !array.is_circle() => return None,
            method => method == Method::Harmonic,
        };
        let maps = match (is_harmonic, joint.on) {
            (false, _) => "maps of pixels",
            (true, false) => "harmonic maps",
            (true, true) => "joint maps",
        };
        let figures = match is_harmonic {
            false => "3 to 5 after a month at nside 8, means up to 5 sigma off",
            true => {
                "3 after 200 days, 5 after a month, 300 after a week; of single maps of nside 16 they hold"
            }
        };
        let (duration_s, turn_deg) = (spacecraft.duration_s, 360.0 * turn);
        Some(format!(
            "in spacecraft.duration_s = {duration_s} the node turns by {turn_deg:.1} of 360 deg: errors, mask and C_l of {maps} with R from the \
             data may be far from true (mean squares of (map - sky) / sigma {figures})"
        ))
    }

    /// A note if samples are coarsely quantised and the correlations are not corrected.
    fn quantiser_note(&self) -> Option<String> {
        let bits = self.daughters.bits;
        let is_coarse = self.spacecraft.fidelity == Fidelity::Samples && VanVleck::new(bits).is_ok();
        (is_coarse && self.calibration.quantiser_bits == 0).then(|| {
            format!(
                "daughters.bits = {bits}: correlations of such samples are too small; calibration.quantiser_bits = {bits} \
                 corrects them"
            )
        })
    }
}

impl Plan {
    /// Notes on periods that `spacecraft.every_nth_window` does not sample evenly.
    #[must_use]
    #[doc(hidden)]
    pub fn thinning_notes(&self) -> Vec<String> {
        let (spacecraft, array) = (&self.config.spacecraft, &self.config.array);
        let every_nth = spacecraft.every_nth_window;
        if every_nth == 1 {
            return Vec::new();
        }
        let all: Vec<f64> = ObservingWindows::new(&self.array, 0.0, spacecraft.duration_s)
            .map(|window| window.start.seconds())
            .collect();
        let mut periods = vec![("month", SIDEREAL_MONTH_S)];
        if let Some(formation) = self.array.formation() {
            periods.push(("breathing of the formation", formation.period_s()));
            periods.push(("precession of the orbit", array.precession_period_s));
        }
        let kept = || self.windows.iter().map(|window| window.start.seconds());
        let note = |&(name, period_s): &(&str, f64)| {
            let gap = largest_gap(kept(), period_s);
            (gap > largest_gap(all.iter().copied(), period_s) + GAP_MAX).then(|| {
                format!(
                    "spacecraft.every_nth_window = {every_nth} beats with the {name} of {:.1} days: no window lies in {:.0} % of it, \
                     which biases large scales; spacecraft.thin in place of every_nth_window and every_nth_integration spreads \
                     windows over all phases",
                    period_s / DAY_S,
                    100.0 * gap
                )
            })
        };
        periods.iter().filter_map(note).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::EngineKind;

    #[test]
    fn the_default_has_no_notes_and_a_low_orbit_has() {
        let mut config = Config::default();
        assert_eq!(config.notes(), Vec::<String>::new());
        config.array.altitude_m = 50e3;
        // 2 pi sqrt((1787.1 km)^3 / (4902.8 km^3/s^2)).
        assert!(
            config.notes()[0].contains("an orbit 50 km above the Moon takes 6779"),
            "{:?}",
            config.notes()
        );
        config.array.orbital_period_s = 6779.0;
        // 2 pi / (1.5 n J2 (1738 km / 1787.1 km)^2 cos 30 deg), n = 2 pi / 6779 s.
        assert!(config.notes()[0].contains("once in 2.71"), "{:?}", config.notes());
        config.array.precession_period_s = 2.7e7;
        assert_eq!(config.notes(), Vec::<String>::new());
        config.array.inclination_deg = 90.0;
        assert!(config.notes()[0].contains("hardly turns the node"), "{:?}", config.notes());
        config.array.inclination_deg = 150.0;
        assert!(config.notes()[0].contains("array.node_motion = \"advance\""), "{:?}", config.notes());
        config.array.node_motion = NodeMotion::Advance;
        assert_eq!(config.notes(), Vec::<String>::new());
        config.spacecraft.fidelity = Fidelity::Samples;
        config.daughters.bits = 1;
        assert!(config.notes()[0].contains("calibration.quantiser_bits = 1"), "{:?}", config.notes());
        config.calibration.quantiser_bits = 1;
        assert_eq!(config.notes(), Vec::<String>::new());
    }

    #[test]
    fn errors_of_short_missions_are_named_where_they_do_not_hold() {
        let notes = |set: &dyn Fn(&mut Config)| {
            let mut config = Config::default();
            config.spacecraft.duration_s = 7.0 * DAY_S;
            set(&mut config);
            config.choose_engine(true);
            assert_eq!(config.map.engine, EngineKind::Harmonic);
            config.notes()
        };
        assert_eq!(notes(&|_| ()), Vec::<String>::new());
        // 7 of 474.8 days.
        let notes_at_32 = notes(&|config| config.map.nside = 32);
        assert!(
            notes_at_32.len() == 1 && notes_at_32[0].contains("the node turns by 5.3 of 360 deg"),
            "{notes_at_32:?}"
        );
        let whole =
            |config: &mut Config| (config.map.nside, config.spacecraft.duration_s) = (32, 400.0 * DAY_S);
        assert_eq!(notes(&whole), Vec::<String>::new());
        // Pixels of an ellipse, of its whole turn, and of orbits of their own.
        let mut config = Config::default();
        (config.spacecraft.duration_s, config.array.eccentricity) = (7.0 * DAY_S, 0.02);
        config.choose_engine(true);
        assert_eq!(config.map.engine, EngineKind::Pixel);
        assert!(config.coverage_note().unwrap().contains("of maps of pixels with R from the data"));
        config.spacecraft.duration_s = 400.0 * DAY_S;
        assert_eq!(config.coverage_note(), None);
        config.spacecraft.duration_s = 7.0 * DAY_S;
        config.array.oem = vec!["one.oem".into()];
        assert_eq!(config.coverage_note(), None);
    }

    #[test]
    fn positions_beyond_the_search_are_named() {
        let mut config = Config::default();
        config.calibration.hook = CalibrationHook::Solve;
        config.spacecraft.channels_hz = vec![30e6, 10e6];
        // 15 rad at a wavelength of 29.979 m: 15 / (2 pi) * 29.979 m = 71.57 m = 3 * 23.86 m.
        config.calibrate.position_sigma_m = 23.8;
        assert_eq!(config.reach_note(), None);
        config.calibrate.position_sigma_m = 30.0;
        let note = config.reach_note().unwrap();
        // 10 MHz * 23.86 / 30 = 7.952 MHz.
        for part in ["71.6 m at 10.000 MHz", "up to 90.0 m", "7.952 MHz or below", "known to 23.9 m"] {
            assert!(note.contains(part), "{part}: {note}");
        }
        assert!(config.notes().contains(&note));
        config.spacecraft.channels_hz = vec![3e6, 30e6];
        assert_eq!(config.notes(), config.positions_note().into_iter().collect::<Vec<String>>());
    }

    #[test]
    fn limits_that_refuse_corrected_positions_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = |positions: &str| {
            let path = folder.path().join("gains.json");
            let gains = r#"{"channels": [{"frequency_hz": 1e7, "solutions": [{"time_s": 0, "gains": [[1, 0], [1, 0]]}]}]"#;
            std::fs::write(&path, format!("{gains}, \"positions\": [{positions}]}}")).unwrap();
            path
        };
        let position = r#"{"from_s": 0, "until_s": 9, "normals_hat": [[0, 0, 1], [0, 0, 1]], "offsets_m": [[0, 0, 0], [1, 2, 3]]}"#;
        let mut config = Config::default();
        config.map.engine = EngineKind::Harmonic;
        config.calibration.hook = CalibrationHook::AntennaGains;
        config.calibration.gains_file = Some(file(""));
        assert_eq!(config.positions_note(), None);
        config.calibration.gains_file = Some(file(position));
        let note = config.positions_note().unwrap();
        assert!(note.contains("map.limits.out_of_track_deg_max = 0.1"), "{note}");
        let mut wide = config.clone();
        (wide.map.limits.out_of_track_deg_max, wide.map.limits.radial_deg_max) = (2.0, 2.0);
        assert_eq!(wide.positions_note(), None);
        let mut refined = config.clone();
        refined.map.refine.passes_max = 5;
        assert_eq!(refined.positions_note(), None);
        config.map.engine = EngineKind::Pixel;
        assert_eq!(config.positions_note(), None);
    }

    #[test]
    fn gains_without_errors_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = |errors: &str| {
            let path = folder.path().join("gains.json");
            let solution = format!(r#"{{"time_s": 0, "gains": [[1, 0], [1, 0]]{errors}}}"#);
            let gains = format!(r#"{{"channels": [{{"frequency_hz": 1e7, "solutions": [{solution}]}}]}}"#);
            std::fs::write(&path, gains).unwrap();
            path
        };
        let mut config = Config::default();
        config.calibration.hook = CalibrationHook::AntennaGains;
        config.calibration.gains_file = Some(file(""));
        config.calibration.error_draws = 8;
        assert!(config.notes().join("").contains("gains_file have no stated errors"), "{:?}", config.notes());
        config.calibration.gains_file =
            Some(file(r#", "errors": {"solution_s": 0, "sigma": [[0.1, 0.1], [0.1, 0.1]]}"#));
        assert_eq!(config.notes(), Vec::<String>::new());
        config.calibration.hook = CalibrationHook::Solve;
        assert_eq!(config.notes(), Vec::<String>::new());
        config.array.satellites = 17;
        assert!(config.notes().join("").contains("more than 16 satellites"), "{:?}", config.notes());
        config.calibration.error_draws = 0;
        assert_eq!(config.notes(), Vec::<String>::new());
    }

    #[test]
    fn thinning_that_beats_with_a_period_is_named() {
        let notes = |every_nth: u64, thin: u64| {
            let mut config = Config::default();
            (config.spacecraft.every_nth_window, config.spacecraft.thin) = (every_nth, thin);
            Plan::new(config).unwrap().thinning_notes().join("\n")
        };
        // A month has 286.2 orbits: 300 orbits are nearly a month, 143 half a month, and 146 the 14 days of breathing.
        for (every_nth, period) in [
            (300, "month of 27.3 days"),
            (143, "month of 27.3 days"),
            (146, "breathing of the formation of 14.0 days"),
        ] {
            assert!(notes(every_nth, 1).contains(period), "{every_nth}: {}", notes(every_nth, 1));
        }
        for (every_nth, thin) in [(1, 1), (41, 1), (1, 300), (1, 600)] {
            assert_eq!(notes(every_nth, thin), "", "{every_nth} {thin}");
        }
    }
}
