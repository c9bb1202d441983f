//! An artificial signal of known direction and strength.

use std::f64::consts::TAU;

use num_complex::Complex64;

use crate::units::Checks;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, dot, sub};

/// A plane wave that every daughter receives with the same power, whatever is between: the mother's signal for
/// calibration.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Beacon {
    /// Power at a daughter, K sr, in every channel; 0 for no signal.
    pub k_sr: f64,
    /// Ecliptic longitude and latitude that it comes from, deg.
    pub direction_deg: [f64; 2],
}

impl Beacon {
    /// Whether there is a signal.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.k_sr > 0.0
    }

    /// Direction that it comes from, a unit vector on ecliptic axes.
    #[must_use]
    pub fn from_hat(&self) -> Vec3 {
        let [longitude, latitude] = self.direction_deg.map(f64::to_radians);
        let across = latitude.cos();
        [across * longitude.cos(), across * longitude.sin(), latitude.sin()]
    }

    /// Its visibility, K sr: `P exp(-2 pi i (nu / c) n . (r_i - r_j))`.
    #[must_use]
    pub fn visibility_k_sr(&self, r_i_m: Vec3, r_j_m: Vec3, frequency_hz: f64) -> Complex64 {
        plane_wave(self.k_sr, self.from_hat(), sub(r_i_m, r_j_m), frequency_hz)
    }

    /// Keeps what is wrong with the values below the section's `name`.
    pub fn check(&self, name: &str, checks: &mut Checks) {
        let power = self.k_sr;
        checks.number(format!("{name}.k_sr"), power, power >= 0.0, "K sr, not negative; 0 for no signal");
        let [longitude, latitude] = self.direction_deg;
        let good = longitude.is_finite() && (-90.0..=90.0).contains(&latitude);
        let expected = "ecliptic longitude and latitude, -90 to 90 degrees";
        checks.require(format!("{name}.direction_deg"), format!("[{longitude}, {latitude}]"), good, expected);
    }
}

/// Visibility of a plane wave of a power from direction `from_hat` on a baseline.
#[must_use]
pub fn plane_wave(power_k_sr: f64, from_hat: Vec3, baseline_m: Vec3, frequency_hz: f64) -> Complex64 {
    let turns = dot(from_hat, baseline_m) * frequency_hz / SPEED_OF_LIGHT_M_S;
    Complex64::from_polar(power_k_sr, -TAU * turns.fract())
}
