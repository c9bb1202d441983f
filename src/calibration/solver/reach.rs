//! How far positions are searched: as far as they may be off, and not beyond what a search can hold.

use std::f64::consts::TAU;

use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Phase of one standard deviation of an offset in the lowest channel, rad, from which on all offsets are searched.
const SEARCH_RADIANS: f64 = 0.8;

/// Standard deviations within which offsets are searched.
const REACH: f64 = 3.0;

/// Longest offset that is searched, rad: 400 harmonics, and some 25,000 offsets on the grid.
const RADIANS_MAX: f64 = 15.0;

/// Phase of an offset of a metre, rad.
fn radians_per_m(frequency_hz: f64) -> f64 {
    TAU * frequency_hz / SPEED_OF_LIGHT_M_S
}

/// Whether the offsets of a channel have to be searched.
pub(super) fn is_searched(position_sigma_m: f64, frequency_hz: f64) -> bool {
    radians_per_m(frequency_hz) * position_sigma_m > SEARCH_RADIANS
}

/// Longest offset that is searched in a channel, as its phase, rad.
pub(super) fn reach_radians(position_sigma_m: f64, frequency_hz: f64) -> f64 {
    (REACH * position_sigma_m * radians_per_m(frequency_hz)).min(RADIANS_MAX)
}

/// Says where the search for offsets ends before their prior does, if it does.
pub(super) fn reach_note(position_sigma_m: f64, lowest_hz: f64) -> Option<String> {
    let reach_m = RADIANS_MAX / radians_per_m(lowest_hz);
    let most_m = reach_m / REACH;
    let (mhz, needed_mhz) = (lowest_hz / 1e6, lowest_hz / 1e6 * most_m / position_sigma_m);
    (position_sigma_m > most_m).then(|| {
        format!(
            "positions are searched up to {RADIANS_MAX} rad of phase in the lowest channel, {reach_m:.1} m at {mhz:.3} MHz, and \
             calibrate.position_sigma_m = {position_sigma_m} expects up to {:.1} m (three standard deviations): positions further off are \
             not found, and are told as \"poor-fit\", \"ambiguous\" or not at all; a channel at {needed_mhz:.3} MHz or below, or positions \
             known to {most_m:.1} m, reach all of them",
            REACH * position_sigma_m
        )
    })
}
