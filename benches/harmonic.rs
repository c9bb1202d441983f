//! Rates of the harmonic engine on the paper's array.
#![allow(clippy::expect_used)] // Settings are the bench's own.

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

/// Wall-clock and processor time; the second is what a busy machine leaves comparable.
struct Clock(Instant, f64);

impl Clock {
    fn start() -> Self {
        Self(Instant::now(), processor_seconds())
    }

    /// Wall-clock and processor seconds since the start.
    fn read(&self) -> (f64, f64) {
        (self.0.elapsed().as_secs_f64(), processor_seconds() - self.1)
    }
}

/// User and system time of this process where /proc tells it (in its ticks of 10 ms), else zero.
fn processor_seconds() -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else { return 0.0 };
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    [11, 12].iter().filter_map(|k| fields.get(*k)?.parse::<f64>().ok()).sum::<f64>() / 100.0
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
    let clock = Clock::start();
    let settings = ModelSettings::new(geometry, 30_f64.to_radians(), u_max);
    let mut model = HarmonicModel::new(falling_sky(l_max), settings).expect("settings in range");
    let set_up = clock.read();
    let clock = Clock::start();
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
    let run = clock.read();
    let mission = 2.6e7 / (set_up.0 + 2.6e7 * run.0 / count as f64);
    println!(
        "forward l {l_max}, u < {u_max}, {at_once} windows at once: set-up {:.1} s ({:.1} s of processor), {count} \
         visibilities in {:.2} s ({:.2} s), {:.3e}/s; over 2.6e7 with set-up {mission:.3e}/s",
        set_up.0,
        set_up.1,
        run.0,
        run.1,
        count as f64 / run.0,
    );
}

fn main() {
    let array = Array::new(&ArrayConfig::default()).expect("the fiducial array");
    let day = 86_400.0;
    let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 7.0 * day).collect();
    let wanted: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with('-')).collect();
    let runs = |name: &str| wanted.is_empty() || wanted.iter().any(|w| name.contains(w.as_str()));
    for (l_max, u_max) in [(64, 125.0), (191, 125.0), (1023, 21.0), (1024, 125.0)] {
        if runs(&format!("forward-{l_max}")) {
            for at_once in [4, 16, 41] {
                forward(&array, &windows, l_max, u_max, at_once);
            }
        }
    }
}
