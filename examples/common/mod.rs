//! A downlink to look at: two channels, a few windows, seconds to simulate.

use std::error::Error;
use std::path::Path;

use lunarray::pipeline::{ConfigSource, Plan, simulate};
use lunarray::runtime::Cancel;

/// Simulates a small mission and writes its downlink to `file`; returns what was simulated.
pub fn small_downlink(file: &Path) -> Result<Plan, Box<dyn Error>> {
    let overrides = [
        "sky.nside=8",
        "spacecraft.channels_hz=[3e6, 10e6]",
        "spacecraft.every_nth_window=41",
        "spacecraft.every_nth_integration=40",
        "spacecraft.baseline_wavelengths_max=16.0",
        "map.nside=4",
        "map.epsilon=1e-4",
    ];
    let source = ConfigSource { overrides: overrides.map(str::to_owned).to_vec(), ..ConfigSource::default() };
    let plan = Plan::new(source.load()?)?;
    simulate(&plan, &file, &Cancel::new(), &mut |_| {})?;
    Ok(plan)
}
