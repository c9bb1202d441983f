//! Rows of B at any positions, at the paper's full size (10 MHz, nside 64, l_max 160), for fifty orbits of an eccentric formation with all
//! integrations: time of the products that a refined map consists of, their ratio to direct sums in the same run, and their error.
//!
//! `cargo bench --bench general`
#![allow(clippy::unwrap_used)] // A program for people at a terminal.

use std::f64::consts::TAU;
use std::time::Instant;

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::AntennaResponse;
use lunarray::response::general::{GeneralRows, ObservationDetails, PairResponse, RowsSetup, TimedPair};
use lunarray::response::pixel::{Directions, PairGeometry, SatelliteAntenna, sky_sums};
use lunarray::sky::harmonics::Alm;
use lunarray::sky::healpix::{pixel_area_sr, pixel_directions};
use lunarray::units::Pair;
use lunarray::units::vector::{Vec3, add, cross, norm, scale, sub, unit};
use num_complex::Complex64;

const L_MAX: usize = 160;
const WAVELENGTH_M: f64 = 29.979_245_8;
const ORBITS: usize = 50;
/// Of 2.3 h, in which the Earth is hidden.
const PASS_S: f64 = 3000.0;
const BASELINE_MAX: f64 = 125.0;

/// Altitudes that differ by +-20 km along the orbit, and cross-track offsets of 2 % of the distance to daughter 1.
fn position_m(array: &Array, n: usize, t_s: f64) -> Vec3 {
    let circle_m = array.position_m(n, t_s);
    let behind_m = norm(sub(circle_m, array.position_m(0, t_s)));
    let phase = TAU * t_s / array.orbital_period_s() - behind_m / array.orbit_radius_m();
    let across_m = 0.02 * behind_m * (phase + 0.4).sin();
    add(scale(1.0 + 20e3 / 2037.1e3 * phase.cos(), circle_m), scale(across_m, array.normal_hat(n, t_s)))
}

fn day(array: &Array) -> Vec<TimedPair> {
    let mut out = Vec::new();
    for i in 0..8_u8 {
        for j in i + 1..8 {
            for orbit in 0..ORBITS {
                let start_s = 2e5 + array.orbital_period_s() * orbit as f64;
                let mut t_s = start_s;
                while t_s < start_s + PASS_S {
                    let [r_i_m, r_j_m] = [i, j].map(|n| position_m(array, usize::from(n), t_s));
                    let wavelengths = norm(sub(r_i_m, r_j_m)) / WAVELENGTH_M;
                    if wavelengths > BASELINE_MAX {
                        break;
                    }
                    let pair = Pair { i, j };
                    out.push(TimedPair { pair, time_s: t_s, r_i_m, r_j_m });
                    // As far as a fringe at the horizon turns by an eighth of its wavelength.
                    t_s += (0.125 * 8248.68 / TAU / wavelengths).clamp(0.5, 60.0);
                }
            }
        }
    }
    out
}

fn seconds<T>(run: impl FnOnce() -> T) -> (f64, T) {
    let start = Instant::now();
    let out = run();
    (start.elapsed().as_secs_f64(), out)
}

fn rms(values: impl Iterator<Item = Complex64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), v| (sum + v.norm_sqr(), count + 1.0));
    (sum / f64::max(count, 1.0)).sqrt()
}

/// Products for a map and its noise map with averages over integrations and with antennas that differ, against those without, in turn.
fn what_more_costs(at: &[TimedPair], setup: RowsSetup, skies: &[Alm]) {
    let duration_s: Vec<f32> = at
        .iter()
        .map(|at| {
            let wavelengths = norm(sub(at.r_i_m, at.r_j_m)) / WAVELENGTH_M;
            (0.125 * 8248.68 / TAU / wavelengths).clamp(0.5, 60.0) as f32
        })
        .collect();
    // Antennas that lean from daughter to daughter.
    let antenna = |elements: AntennaResponse, distortion: f64, satellite: u8, r_m: Vec3| {
        let k = f64::from(satellite);
        let axis = unit(add(scale(0.1 * k, unit(r_m)), [0.1, -0.2, 1.0]));
        let axes_hat = [axis, unit(cross(axis, r_m))];
        SatelliteAntenna::new(elements, axes_hat, distortion * (k + 1.0))
    };
    let weight = vec![1.0; at.len()];
    let mut plain_s = Vec::new();
    for (what, degree, averages, elements, distortion) in [
        ("averages", 0, true, AntennaResponse::Isotropic, 0.0),
        ("dipoles", 2, false, AntennaResponse::DipoleNormal, 0.0),
        ("three dipoles", 2, false, AntennaResponse::ThreeDipoles, 0.0),
        ("patterns", 4, false, AntennaResponse::Isotropic, 0.05),
        ("averages of dipoles with patterns", 6, true, AntennaResponse::DipoleNormal, 0.05),
    ] {
        let response = |k: usize| {
            let TimedPair { pair, r_i_m, r_j_m, .. } = at[k];
            let pair = [(pair.i, r_i_m), (pair.j, r_j_m)];
            let [a, b] = pair.map(|(satellite, r_m)| antenna(elements, distortion, satellite, r_m));
            PairResponse::of_antennas([&a, &b])
        };
        let observed = ObservationDetails {
            duration_s: if averages { &duration_s } else { &[] },
            response: if degree > 0 { Some(&response) } else { None },
        };
        let rows = GeneralRows::new(setup);
        let plan = rows.plan(at).unwrap();
        let more = GeneralRows::new(RowsSetup { polynomial_degree: degree, ..setup });
        let more_plan = more.plan_with(at, &observed).unwrap();
        let mut ratios = Vec::new();
        let mut more_s = Vec::new();
        for _ in 0..3 {
            let (without_s, _) = seconds(|| rows.normal(&plan, skies, &weight));
            let (with_s, _) = seconds(|| more.normal(&more_plan, skies, &weight));
            ratios.push(with_s / without_s);
            plain_s.push(without_s);
            more_s.push(with_s);
        }
        println!(
            "{what}: {:.2} s, {:.2} times the products without, median of three pairs",
            median(&mut more_s),
            median(&mut ratios)
        );
    }
    println!("without: {:.2} s, {} visibilities", median(&mut plain_s), at.len());
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn main() {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let at = day(&array);
    let setup = RowsSetup {
        l_max: L_MAX,
        wavelength_m: WAVELENGTH_M,
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
        polynomial_degree: 0,
    };
    let rows = GeneralRows::new(setup);
    let (plan_s, plan) = seconds(|| rows.plan(&at).unwrap());
    println!("{} visibilities, {} rows computed; plan {plan_s:.2} s", plan.rows(), plan.computed());
    // Coefficients that fall as those of the sky do.
    let mut sky = Alm::zeros(L_MAX);
    let mut state = 1_u64;
    let mut random = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
    };
    for l in 0..=L_MAX {
        for m in 0..=l {
            let im = if m == 0 { 0.0 } else { random() };
            *sky.get_mut(l, m) = Complex64::new(random(), im) / (1.0 + l as f64).powf(1.2);
        }
    }
    let skies = [sky];
    let (forward_s, values) = seconds(|| rows.forward(&plan, &skies));
    let (adjoint_s, _) = seconds(|| rows.adjoint(&plan, &[&values[0]]));
    let weight = vec![1.0; plan.rows()];
    // Map and noise map together.
    let two = [skies[0].clone(), skies[0].clone()];
    let mut both_s: Vec<f64> = (0..3).map(|_| seconds(|| rows.normal(&plan, &two, &weight)).0).collect();
    let both_s = median(&mut both_s);
    let per_row = |s: f64| 1e3 * s / plan.computed() as f64;
    let per_visibility = |s: f64| 1e6 * s / plan.rows() as f64;
    for (what, s) in [
        ("forward", forward_s),
        ("adjoint", adjoint_s),
        ("both at once, of two skies, median of three", both_s),
    ] {
        println!(
            "{what}: {s:.2} s, {:.2} ms a row computed, {:.1} us a visibility",
            per_row(s),
            per_visibility(s)
        );
    }
    // A pass as it is turned: every 50th visibility, each row for itself.
    let some: Vec<usize> = (0..at.len()).step_by(50).collect();
    let few: Vec<TimedPair> = some.iter().map(|&k| at[k]).collect();
    let direct = rows.plan_direct(&few).unwrap();
    let (_, exact) = seconds(|| rows.forward(&direct, &skies));
    let error = rms(some.iter().zip(&exact[0]).map(|(&k, exact)| values[0][k] - exact));
    println!(
        "rms error of interpolation: {:.1e} of the rms visibility",
        error / rms(exact[0].iter().copied())
    );
    let nside = 64;
    let directions = Directions::from(pixel_directions(nside).as_slice());
    let sky_k = vec![3e5_f32; directions.len()];
    let pairs: Vec<PairGeometry> = few
        .iter()
        .map(|at| PairGeometry {
            r_i_m: at.r_i_m,
            r_j_m: at.r_j_m,
            frequency_hz: 299_792_458.0 / WAVELENGTH_M,
            moon_radius_m: array.moon_radius_m(),
            response: AntennaResponse::Isotropic,
        })
        .collect();
    let (direct_s, _) = seconds(|| sky_sums(&pairs, &directions, &sky_k, pixel_area_sr(nside)).unwrap());
    let direct_us = 1e6 * direct_s / pairs.len() as f64;
    println!(
        "direct sums over the pixels of nside {nside}: {direct_us:.1} us a visibility; as many times forward: {:.2}",
        direct_us / per_visibility(forward_s)
    );
    what_more_costs(&at[..at.len() / 5], setup, &two);
}
