//! An artificial signal of known direction and power.

use std::f64::consts::TAU;

use num_complex::Complex64;

use crate::units::Checks;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, dot, sub};

/// A plane wave that every daughter receives with the same power, even behind the Moon: the mother's calibration signal.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Beacon {
    /// Power at a daughter, K sr, in every channel; 0 for no signal.
    pub k_sr: f64,
    /// Ecliptic longitude and latitude of the source, deg.
    pub direction_deg: [f64; 2],
}

impl Beacon {
    /// Whether there is a signal.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.k_sr > 0.0
    }

    /// Direction of the source, a unit vector on ecliptic axes.
    #[must_use]
    pub fn source_hat(&self) -> Vec3 {
        let [longitude, latitude] = self.direction_deg.map(f64::to_radians);
        let cos_latitude = latitude.cos();
        [cos_latitude * longitude.cos(), cos_latitude * longitude.sin(), latitude.sin()]
    }

    /// Visibility of the beacon, K sr: `P exp(-2 pi i (nu / c) n . (r_i - r_j))`.
    #[must_use]
    pub fn visibility_k_sr(&self, r_i_m: Vec3, r_j_m: Vec3, frequency_hz: f64) -> Complex64 {
        plane_wave(self.k_sr, self.source_hat(), sub(r_i_m, r_j_m), frequency_hz)
    }

    /// Adds the problems of the values in section `name` to `checks`.
    pub fn check(&self, name: &str, checks: &mut Checks) {
        let power = self.k_sr;
        checks.number(format!("{name}.k_sr"), power, power >= 0.0, "K sr, not negative; 0 for no signal");
        let [longitude, latitude] = self.direction_deg;
        let good = longitude.is_finite() && (-90.0..=90.0).contains(&latitude);
        let expected = "ecliptic longitude and latitude, -90 to 90 degrees";
        checks.require(format!("{name}.direction_deg"), format!("[{longitude}, {latitude}]"), good, expected);
    }
}

/// Visibility of a plane wave of this power from direction `source_hat`, K sr.
#[must_use]
pub fn plane_wave(power_k_sr: f64, source_hat: Vec3, baseline_m: Vec3, frequency_hz: f64) -> Complex64 {
    let turns = dot(source_hat, baseline_m) * frequency_hz / SPEED_OF_LIGHT_M_S;
    Complex64::from_polar(power_k_sr, -TAU * turns.fract())
}
