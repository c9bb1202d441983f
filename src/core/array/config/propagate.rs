//! Configuration of orbit propagation.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue, keys};

/// Maximum number of satellite-days: 1.6 GB of states.
const DAYS_MAX: f64 = 40_000.0;

/// Target of station keeping.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StationKeeping {
    /// The followers' positions behind satellite 1, whose orbit is not corrected.
    #[default]
    Formation,
    /// Also satellite 1's semi-major axis, eccentricity, inclination and argument of the periapsis; its node stays.
    Orbit,
}

keys! {
    /// Orbits by numerical integration of the forces, from the formation's state at the epoch or from `array.kepler`.
    pub struct PropagateConfig {
        /// Days for which orbits are integrated in the Moon's field; 0 for none.
        everyday days: f64 = 0.0;
        /// Degree and order of the Moon's field: 0, or 2 to 16.
        #[only_with("array.propagate.days > 0")]
        expert degree: usize = 12;
        /// Attraction by the Earth.
        #[only_with("array.propagate.days > 0")]
        expert earth: bool = true;
        /// Time between corrections of station keeping; 0 for none. Followers are put back on daughter 1's track when the Earth
        /// is next high above her.
        #[only_with("array.propagate.days > 0")]
        expert keep_every_days: f64 = 0.0;
        /// What a correction restores: the "formation", or with the "orbit" also daughter 1's ellipse, at the node of that
        /// time.
        #[only_with("array.propagate.keep_every_days > 0")]
        expert keep: StationKeeping = StationKeeping::Formation;
    }
}

impl PropagateConfig {
    /// Greatest degree and order of the table of the Moon's field.
    pub(in crate::array) const DEGREE_MAX: usize = 16;

    /// Whether orbits are propagated.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.days != 0.0
    }

    /// Whether the section has its default values.
    pub(in crate::array) fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// All invalid values; empty if there are none.
    pub(in crate::array) fn problems(&self, satellites: usize, from_elements: bool) -> Vec<InvalidValue> {
        const DEGREE_MAX: usize = PropagateConfig::DEGREE_MAX;
        let mut checks = Checks::new("array.propagate");
        let days_max = DAYS_MAX / satellites.max(1) as f64;
        let expected =
            format!("0 to {days_max:.0} for {satellites} satellites, whose states take 40 kB a day each");
        checks.number("days", self.days, (0.0..=days_max).contains(&self.days), expected);
        let degree = self.degree;
        let expected = format!("0, or 2 to {DEGREE_MAX}, as far as the table of the Moon's field goes");
        checks.number("degree", degree as f64, degree != 1 && degree <= DEGREE_MAX, expected);
        let every = self.keep_every_days;
        let good = every == 0.0 || (0.25..=3660.0).contains(&every);
        checks.number("keep_every_days", every, good, "0, or 0.25 to 3660");
        let expected = "0 with array.kepler: station keeping restores a formation";
        checks.number("keep_every_days", every, every == 0.0 || !from_elements, expected);
        checks.finish()
    }
}
