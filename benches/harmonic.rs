//! Rates of the harmonic engine.

use std::time::Instant;

use lunarray::array::harmonic::{NodeGrid, PatternGeometry, PatternTable};
use lunarray::frames::AntennaResponse;
use lunarray::units::constants::{MOON_RADIUS_M, SPEED_OF_LIGHT_M_S};

fn geometry(frequency_hz: f64) -> PatternGeometry {
    PatternGeometry {
        orbit_radius_m: MOON_RADIUS_M + 300e3,
        moon_radius_m: MOON_RADIUS_M,
        wavelength_m: SPEED_OF_LIGHT_M_S / frequency_hz,
        response: AntennaResponse::Isotropic,
    }
}

fn main() {
    let started = Instant::now();
    let table = PatternTable::<f64>::new(geometry(1e7), 191, NodeGrid { first: -4.0, step: 0.2, count: 665 });
    println!("pattern l 191, f64, 665 nodes: {:.2} s {}", started.elapsed().as_secs_f64(), table.order(3)[7]);
    let started = Instant::now();
    let table =
        PatternTable::<f32>::new(geometry(1e7), 1024, NodeGrid { first: -2.0, step: 1.0 / 3.0, count: 390 });
    println!(
        "pattern l 1024, f32, 390 nodes: {:.2} s {}",
        started.elapsed().as_secs_f64(),
        table.order(3)[7]
    );
}
