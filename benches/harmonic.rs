//! Rates of the harmonic engine on the paper's array.

use std::f64::consts::TAU;
use std::time::Instant;

use lunarray::array::harmonic::{HarmonicModel, ModelSettings, PairState, PatternGeometry};
use lunarray::array::{Array, ArrayConfig, ObservingWindows};
use lunarray::frames::{AntennaResponse, ObservingWindow};
use lunarray::sky::harmonics::Alm;
use lunarray::units::all_pairs;
use lunarray::units::constants::SPEED_OF_LIGHT_M_S;
use num_complex::Complex64;

fn geometry(array: &Array, frequency_hz: f64) -> PatternGeometry {
    PatternGeometry {
        orbit_radius_m: array.orbit_radius_m(),
        moon_radius_m: array.moon_radius_m(),
        wavelength_m: SPEED_OF_LIGHT_M_S / frequency_hz,
        response: AntennaResponse::Isotropic,
    }
}

/// The states of every pair below `u_max` over a window, pair after pair.
fn states(array: &Array, window: ObservingWindow, wavelength_m: f64, u_max: f64, out: &mut Vec<PairState>) {
    let (radius, formation) = (array.orbit_radius_m(), array.formation());
    let rate = TAU / array.orbital_period_s();
    for pair in all_pairs(array.satellites()) {
        let mut t = window.start.seconds();
        while t < window.end.seconds() {
            let arcs = [pair.i, pair.j].map(|n| formation.arc_m(usize::from(n), t).0 / radius);
            let u = 2.0 * radius * (0.5 * (arcs[1] - arcs[0])).sin() / wavelength_m;
            if u > u_max {
                break;
            }
            let dt = (1.0 / (8.0 * u * rate)).min(25.0);
            let turns = (t / array.orbital_period_s()).fract();
            out.push(PairState {
                node_rad: -TAU * t / (1.3 * 365.25 * 86_400.0),
                phase_rad: TAU * turns - 0.5 * (arcs[0] + arcs[1]),
                baseline_wavelengths: u,
                span_rad: rate * dt,
            });
            t += dt;
        }
    }
}

fn falling_sky(l_max: usize) -> Alm {
    let mut alm = Alm::zeros(l_max);
    for m in 0..=l_max {
        for l in m..=l_max {
            let size = 1e5 / (l as f64 + 1.0).powf(1.35);
            let angle = (l * 7919 + m * 104_729) as f64;
            *alm.get_mut(l, m) =
                Complex64::new(size * angle.cos(), if m == 0 { 0.0 } else { size * angle.sin() });
        }
    }
    alm
}

fn forward(array: &Array, windows: &[ObservingWindow], l_max: usize, u_max: f64, at_once: usize) {
    let geometry = geometry(array, 1e7);
    let started = Instant::now();
    let settings = ModelSettings::new(geometry, 30_f64.to_radians(), u_max);
    let mut model = HarmonicModel::new(falling_sky(l_max), settings).expect("settings in range");
    let set_up = started.elapsed().as_secs_f64();
    let started = Instant::now();
    let mut count = 0;
    for windows in windows.chunks(at_once) {
        let mut batch = Vec::new();
        for window in windows {
            states(array, *window, geometry.wavelength_m, u_max, &mut batch);
        }
        let mut values = vec![Complex64::ZERO; batch.len()];
        model.visibilities(&batch, &mut values).expect("states in range");
        count += values.len();
    }
    let seconds = started.elapsed().as_secs_f64();
    let rate = count as f64 / seconds;
    let mission = 2.6e7 / (set_up + 2.6e7 / rate);
    println!(
        "forward l {l_max}, u < {u_max}, {at_once} windows at once: set-up {set_up:.2} s, {count} visibilities in \
         {seconds:.2} s, {rate:.3e}/s; over 2.6e7 with set-up {mission:.3e}/s"
    );
}

fn main() {
    let array = Array::new(&ArrayConfig::default()).expect("the fiducial array");
    let day = 86_400.0;
    let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 7.0 * day).collect();
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let runs = |name: &str| wanted.is_empty() || wanted.iter().any(|w| name.contains(w.as_str()));
    for (l_max, u_max) in [(64, 125.0), (191, 125.0), (1024, 125.0)] {
        if runs(&format!("forward-{l_max}")) {
            forward(&array, &windows, l_max, u_max, 8);
        }
    }
}
