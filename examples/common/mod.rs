//! A mission to look at: two channels, a few windows, seconds to simulate.

use std::error::Error;
use std::path::Path;

use lunarray::prelude::*;

/// A small mission.
pub fn small_mission() -> Mission {
    Mission::dsl()
        .channels(&[3e6, 10e6])
        .nside(4)
        .set("sky.nside", 8)
        .set("spacecraft.every_nth_window", 41)
        .set("spacecraft.every_nth_integration", 40)
        .set("spacecraft.baseline_wavelengths_max", 16)
        .set("map.epsilon", 1e-4)
}

/// Simulates it and writes its downlink to `file`.
#[allow(dead_code, reason = "examples that simulate it themselves")]
pub fn small_downlink(file: &Path) -> Result<(), Box<dyn Error>> {
    small_mission().simulate(file)?;
    Ok(())
}
