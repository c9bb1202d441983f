//! Notes on valid configurations that are probably not meant.

use std::f64::consts::TAU;

use super::config::Config;
use crate::calibration::VanVleck;
use crate::mother::Fidelity;
use crate::units::Dimension;
use crate::units::constants::{MOON_GM_M3_S2, MOON_RADIUS_M};

/// Relative difference of the orbital period from Kepler's that is accepted; the paper's is 2e-4.
const PERIOD_PART: f64 = 0.01;

impl Config {
    /// Notes on values that are valid and probably not meant.
    #[must_use]
    pub fn notes(&self) -> Vec<String> {
        [self.period_note(), self.quantiser_note()].into_iter().flatten().collect()
    }

    /// An orbital period that does not fit the altitude.
    fn period_note(&self) -> Option<String> {
        let array = &self.array;
        let radius_m = array.moon_radius_m + array.altitude_m;
        let kepler_s = TAU * (radius_m.powi(3) / MOON_GM_M3_S2).sqrt();
        let differs = (array.orbital_period_s / kepler_s - 1.0).abs() > PERIOD_PART;
        // Another body than the Moon has another mass.
        let is_formation = !array.has_own_orbits();
        (differs && is_formation && array.moon_radius_m == MOON_RADIUS_M).then(|| {
            format!(
                "array.orbital_period_s = {}, but an orbit {} above the Moon takes {kepler_s:.2} s; \
                 array.precession_period_s does not follow the altitude, either",
                array.orbital_period_s,
                Dimension::Length.show(array.altitude_m)
            )
        })
    }

    /// Coarse samples without a correction of their correlations.
    fn quantiser_note(&self) -> Option<String> {
        let bits = self.daughters.bits;
        let coarse = self.spacecraft.fidelity == Fidelity::Samples && VanVleck::new(bits).is_ok();
        (coarse && self.calibration.quantiser_bits == 0).then(|| {
            format!(
                "daughters.bits = {bits}: correlations of such samples are too small; calibration.quantiser_bits = {bits} \
                 corrects them"
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_has_no_notes_and_a_low_orbit_has() {
        let mut config = Config::default();
        assert_eq!(config.notes(), Vec::<String>::new());
        config.array.altitude_m = 50e3;
        // Two pi times the root of 1787.1 km cubed over 4902.8 km^3/s^2.
        assert!(
            config.notes()[0].contains("an orbit 50 km above the Moon takes 6779"),
            "{:?}",
            config.notes()
        );
        config.array.orbital_period_s = 6779.0;
        assert_eq!(config.notes(), Vec::<String>::new());
        config.spacecraft.fidelity = Fidelity::Samples;
        config.daughters.bits = 1;
        assert!(config.notes()[0].contains("calibration.quantiser_bits = 1"), "{:?}", config.notes());
        config.calibration.quantiser_bits = 1;
        assert_eq!(config.notes(), Vec::<String>::new());
    }
}
