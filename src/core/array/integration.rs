//! Adaptive integration time.

use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, norm, sub};

/// Limits of the integration time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct IntegrationRule {
    /// Maximum integration time, s.
    pub duration_s_max: f64,
    /// Maximum motion of the baseline in one integration, wavelengths.
    pub motion_wavelengths_max: f64,
}

impl Default for IntegrationRule {
    /// The paper's rule: `dt = min(lambda / (8 |v_ij|), 25 s)`; a motion of lambda/8 costs at most
    /// a factor sinc(pi/8) = 0.974.
    fn default() -> Self {
        Self { duration_s_max: 25.0, motion_wavelengths_max: 0.125 }
    }
}

/// Integration time of a pair with the given satellite velocities (m/s), s.
#[must_use]
pub fn integration_time_s(rule: IntegrationRule, frequency_hz: f64, v_i: Vec3, v_j: Vec3) -> f64 {
    let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
    let speed_m_s = norm(sub(v_i, v_j));
    (rule.motion_wavelengths_max * wavelength_m / speed_m_s).min(rule.duration_s_max)
}
