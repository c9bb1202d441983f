//! Radius of the search for positions: as large as their errors may be, up to what a search can cover.

use std::f64::consts::TAU;

use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Phase of one standard deviation of an offset in the lowest channel, rad, above which all offsets are searched.
const SEARCH_RADIANS: f64 = 0.8;

/// Radius of the search in standard deviations.
const REACH_SIGMAS: f64 = 3.0;

/// Maximum radius of the search, rad: 400 harmonics, and some 25,000 offsets on the grid.
const RADIANS_MAX: f64 = 15.0;

/// Phase per metre of an offset, rad.
fn radians_per_m(frequency_hz: f64) -> f64 {
    TAU * frequency_hz / SPEED_OF_LIGHT_M_S
}

/// Whether the offsets are searched in a channel.
pub(super) fn is_searched(position_sigma_m: f64, frequency_hz: f64) -> bool {
    radians_per_m(frequency_hz) * position_sigma_m > SEARCH_RADIANS
}

/// Radius of the search in a channel, as a phase, rad.
pub(super) fn reach_radians(position_sigma_m: f64, frequency_hz: f64) -> f64 {
    (REACH_SIGMAS * position_sigma_m * radians_per_m(frequency_hz)).min(RADIANS_MAX)
}

/// Note for the user if the search ends before the prior of the offsets does.
pub(super) fn reach_note(position_sigma_m: f64, lowest_hz: f64) -> Option<String> {
    let reach_m = RADIANS_MAX / radians_per_m(lowest_hz);
    let sigma_m_max = reach_m / REACH_SIGMAS;
    let (mhz, needed_mhz) = (lowest_hz / 1e6, lowest_hz / 1e6 * sigma_m_max / position_sigma_m);
    (position_sigma_m > sigma_m_max).then(|| {
        format!(
            "positions are searched up to {RADIANS_MAX} rad of phase in the lowest channel, {reach_m:.1} m at {mhz:.3} MHz, and \
             calibrate.position_sigma_m = {position_sigma_m} expects up to {:.1} m (three standard deviations): positions further off are \
             not found, and are told as \"poor-fit\", \"ambiguous\" or not at all; a channel at {needed_mhz:.3} MHz or below, or positions \
             known to {sigma_m_max:.1} m, reach all of them",
            REACH_SIGMAS * position_sigma_m
        )
    })
}
