//! Where the satellites are, how long their baselines, and how long the correlator may integrate.

use std::error::Error;

use lunarray::array::{IntegrationRule, integration_time_s};
use lunarray::prelude::*;
use lunarray::units::all_pairs;
use lunarray::units::vector::{norm, sub};

fn main() -> Result<(), Box<dyn Error>> {
    let array = Array::new(&ArrayConfig::default())?;
    let (t_s, frequency_hz) = (86_400.0, 10e6);
    println!("a day after the epoch the array {}", if array.observing(t_s) { "observes" } else { "waits" });
    let mut longest = (0.0, Pair::default());
    for pair in all_pairs(array.satellites()) {
        let [i, j] = [pair.i, pair.j].map(|n| array.state(usize::from(n), t_s));
        let length_m = norm(sub(i.position_m, j.position_m));
        if length_m > longest.0 {
            longest = (length_m, pair);
        }
        if pair.i == 0 {
            let dt_s =
                integration_time_s(IntegrationRule::default(), frequency_hz, i.velocity_m_s, j.velocity_m_s);
            println!("{}-{}: {length_m:9.1} m, integrates {dt_s:.2} s at 10 MHz", pair.i + 1, pair.j + 1);
        }
    }
    let (length_m, pair) = longest;
    println!("longest baseline: {length_m:.1} m, satellites {} and {}", pair.i + 1, pair.j + 1);
    // The paper's baselines reach 100 km.
    if (1e4..=1.1e5).contains(&length_m) { Ok(()) } else { Err("not the paper's array".into()) }
}
