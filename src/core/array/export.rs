//! Orbits of an array as CCSDS Orbit Ephemeris Messages.

use std::fmt::Write;

use super::axes::to_equatorial;
use super::oem::TableSpan;
use super::orbit::Array;
use super::state::SatelliteState;
use crate::units::time_scales::{Tai, TimeScale};
use crate::units::{Checks, InvalidValue};

/// Minimum number of states of a stretch: as many as interpolation needs.
const STATES_MIN: f64 = 4.0;

/// Settings for writing orbits as OEM files.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OemExport {
    epoch: Tai,
    until_s: f64,
    step_s: f64,
}

/// Accepted dates, TAI since 1970, s: 1972 to 2200. UTC starts with 1972.
const DATES_1958_S: [f64; 2] = [4.42e8, 7.64e9];

impl OemExport {
    /// Creates the settings of a mission whose epoch is `epoch_tai_s` (TAI since 1958-01-01). Files end `until_s`
    /// later, with states at most `step_s` apart.
    ///
    /// # Errors
    /// The first value that is not accepted.
    pub fn new(epoch_tai_s: f64, until_s: f64, step_s: f64) -> Result<Self, InvalidValue> {
        let mut checks = Checks::new("");
        let [from_s, to_s] = DATES_1958_S;
        let expected = "TAI since 1958, s, of the years 1972 to 2200";
        checks.number("epoch", epoch_tai_s, (from_s..to_s).contains(&epoch_tai_s), expected);
        checks.number(
            "--duration",
            until_s,
            until_s > 0.0 && until_s <= 3.2e8,
            "s, above 0 and up to ten years",
        );
        checks.number("--step", step_s, (1.0..=600.0).contains(&step_s), "1 s to 600 s");
        match checks.finish().into_iter().next() {
            Some(problem) => Err(problem),
            None => Ok(Self { epoch: Tai::from_seconds_since_1958(epoch_tai_s), until_s, step_s }),
        }
    }

    /// A date of the mission, UTC.
    fn date(&self, time_s: f64) -> String {
        self.epoch.plus_s(time_s).text(TimeScale::Utc, 9)
    }

    /// Text of the file of one satellite (from 0), and the number of its states.
    ///
    /// Positions are written to a micrometre and velocities to a nanometre per second, on the axes of EME2000, in
    /// stretches between which the velocity jumps: at turnarounds of a formation, and at station keeping. Tabulated
    /// orbits are written at their own states, as long as they last. Dates are UTC to a nanosecond; a comment says so
    /// if the Earth of the mission is idealised.
    #[must_use]
    pub fn text(&self, array: &Array, satellite: usize) -> (String, usize) {
        let stretches = array.table_spans(satellite).unwrap_or_else(|| self.sampled(array, satellite));
        let epoch = self.date(0.0);
        let idealised = match array.epoch_tai_s() {
            Some(_) => "",
            None => {
                "COMMENT Idealised mission: its windows are those of an Earth on a circle in the ecliptic, whatever the dates.\n"
            }
        };
        let mut text =
            format!("CCSDS_OEM_VERS = 2.0\n{idealised}CREATION_DATE = {epoch}\nORIGINATOR = LUNARRAY\n\n");
        let mut count = 0;
        for stretch in stretches {
            let (Some(first_s), Some(last_s)) = (stretch.times_s().first(), stretch.times_s().last()) else {
                continue;
            };
            // Writing to a String cannot fail.
            let _ = write!(
                text,
                "META_START\nOBJECT_NAME = SATELLITE {}\nOBJECT_ID = {}-001{}\nCENTER_NAME = MOON\nREF_FRAME = EME2000\n\
                 TIME_SYSTEM = UTC\nSTART_TIME = {}\nSTOP_TIME = {}\nINTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 7\nMETA_STOP\n",
                satellite + 1,
                &epoch[..4],
                letters(satellite),
                self.date(*first_s),
                self.date(*last_s),
            );
            for (time_s, state) in stretch.states() {
                let [x, y, z] = to_equatorial(state.position_m).map(|m| m / 1e3);
                let [vx, vy, vz] = to_equatorial(state.velocity_m_s).map(|m_s| m_s / 1e3);
                let time = self.date(time_s);
                let _ = writeln!(text, "{time} {x:.9} {y:.9} {z:.9} {vx:.12} {vy:.12} {vz:.12}");
                count += 1;
            }
            text.push('\n');
        }
        (text, count)
    }

    /// States at equal steps between turnarounds of the formation.
    fn sampled(&self, array: &Array, satellite: usize) -> Vec<TableSpan> {
        let mut stretches = Vec::new();
        let mut from_s = 0.0;
        while from_s < self.until_s {
            let turnaround_s =
                array.formation_of_any_shape().map(|formation| formation.next_turnaround_s(from_s));
            let to_s = turnaround_s.map_or(self.until_s, |turn_s| turn_s.min(self.until_s));
            let steps = ((to_s - from_s) / self.step_s).ceil().max(STATES_MIN - 1.0);
            let mut stretch = TableSpan::default();
            for k in 0..=steps as usize {
                let time_s =
                    if k as f64 == steps { to_s } else { from_s + (to_s - from_s) * k as f64 / steps };
                let mut state = array.state(satellite, time_s);
                if k as f64 == steps {
                    // The velocity before the jump.
                    state = SatelliteState {
                        velocity_m_s: array.state(satellite, time_s - 1e-6).velocity_m_s,
                        ..state
                    };
                }
                stretch.push(time_s, state);
            }
            stretches.push(stretch);
            from_s = to_s;
        }
        stretches
    }
}

/// Letters A .. Z, AA, AB, .. for numbers from 0.
fn letters(number: usize) -> String {
    let letter = |k: usize| char::from(b'A' + (k % 26) as u8);
    let high = if number < 26 { String::new() } else { letter(number / 26 - 1).to_string() };
    format!("{high}{}", letter(number))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{ArrayConfig, PropagateConfig};
    use crate::units::constants::DAY_S;
    use crate::units::vector::{norm, sub};

    /// 2030-12-31T00:00:00 TAI, s since 1958: 26,662 days.
    const EPOCH_TAI_S: f64 = 26_662.0 * DAY_S;

    #[test]
    fn written_files_are_read_again_to_a_millimetre() {
        let formation = ArrayConfig { satellites: 3, arcs_m: vec![2e3, 9e3], ..ArrayConfig::default() };
        let shaped = ArrayConfig { eccentricity: 0.02, cross_track_ratio: 0.1, ..formation.clone() };
        let propagate = PropagateConfig { days: 10.0, keep_every_days: 3.0, ..PropagateConfig::default() };
        let propagated = ArrayConfig { propagate, ..shaped.clone() };
        for config in [formation, shaped, propagated] {
            let array = Array::new(&config).unwrap();
            // The epoch is half a minute before midnight UTC, 37 s behind TAI.
            assert!(
                OemExport::new(EPOCH_TAI_S, DAY_S, 120.0)
                    .unwrap()
                    .text(&array, 0)
                    .0
                    .contains("TIME_SYSTEM = UTC\nSTART_TIME = 2030-12-30T23:59:23.000000000\n")
            );
            let export = OemExport::new(EPOCH_TAI_S, 10.0 * DAY_S, 120.0).unwrap();
            let folder = tempfile::tempdir().unwrap();
            let oem: Vec<_> = (0..3).map(|n| folder.path().join(format!("sat{n}.oem"))).collect();
            for (n, path) in oem.iter().enumerate() {
                let (text, states) = export.text(&array, n);
                assert!(states > 3_600, "{states}");
                std::fs::write(path, text).unwrap();
            }
            let read = ArrayConfig { satellites: 3, oem, ..ArrayConfig::default() };
            let again = Array::new(&read).unwrap();
            let span = again.known_s().unwrap();
            assert!(span[0] == 0.0 && span[1] >= 10.0 * DAY_S && span[1] < 10.01 * DAY_S, "{span:?}");
            assert_eq!((array.epoch_tai_s(), again.epoch_tai_s()), (None, Some(EPOCH_TAI_S)));
            for k in 0..2_000 {
                // The times include a turnaround after seven days, and station keeping.
                let t_s = 431.7 * f64::from(k);
                for n in 0..3 {
                    let [was, is] = [&array, &again].map(|array| array.state(n, t_s));
                    assert!(norm(sub(was.position_m, is.position_m)) < 1e-3, "{n} {t_s}");
                    assert!(norm(sub(was.velocity_m_s, is.velocity_m_s)) < 1e-6, "{n} {t_s}");
                }
            }
        }
    }

    #[test]
    fn values_that_cannot_be_written_are_refused() {
        for (epoch_tai_s, until_s, step_s, told) in [
            (0.0, 1e5, 60.0, "epoch"),
            (f64::NAN, 1e5, 60.0, "epoch"),
            (EPOCH_TAI_S, 0.0, 60.0, "--duration"),
            (EPOCH_TAI_S, f64::NAN, 60.0, "--duration"),
            (EPOCH_TAI_S, 1e5, 6e3, "--step"),
        ] {
            assert!(OemExport::new(epoch_tai_s, until_s, step_s).unwrap_err().to_string().contains(told));
        }
        assert_eq!([0, 25, 26, 63].map(letters), ["A", "Z", "AA", "BL"]);
    }
}
