//! Refined maps: against a dense solution by other code, on a circle, and whatever the order of arrival.

mod power;

use crate::common;
use crate::engines::solve_harmonics;

use std::f64::consts::TAU;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use faer::linalg::solvers::{DenseSolveCore, Solve};
use faer::{Mat, Side};
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::anywhere::{
    AssumedInstrument, RefineRule, RefineSteps, RefinedSetup, RefinedSums, Refinement, VisibilityArchive,
    solve_refined,
};
use lunarray::imaging::circle::{coefficients, degrees};
use lunarray::imaging::{
    HarmonicRequest, HarmonicSolution, Refusal, Regulariser, Samples, SolveError, SolveWatch, StoppingRule,
};
use lunarray::response::general::{GeneralRows, RowsSetup, TimedPair};
use lunarray::response::harmonic::{GeometryLimits, GeometryRefusal};
use lunarray::runtime::Cancel;
use lunarray::sky::harmonics::Alm;
use lunarray::sky::healpix::pixel_area_sr;
use lunarray::units::constants::{MOON_RADIUS_M, SPEED_OF_LIGHT_M_S};
use lunarray::units::vector::Vec3;
use lunarray::units::{ChannelId, Pair};
use num_complex::Complex64;

const RADIUS_M: f64 = MOON_RADIUS_M + 300e3;
const WAVELENGTH_M: f64 = 30.0;
const PERIOD_S: f64 = 8248.68;
const NSIDE: usize = 8;
const L_MAX: usize = 12;
const EPSILON: f64 = 1e-4;

/// Lengths of the baselines, m: for all degrees up to 12, and beyond.
const BASELINES_M: [f64; 5] = [30.0, 55.0, 95.0, 160.0, 290.0];

/// Thirds of orbits, all nodes of the plane: one satellite of a pair trails the other and swings out of its plane.
fn geometry(altitude_m: f64, cross: f64, step_s: f64, orbits: usize, baselines_m: &[f64]) -> Vec<TimedPair> {
    geometry_over(altitude_m, cross, step_s, orbits, baselines_m, TAU)
}

/// As [`geometry`], while the plane turns by an angle.
fn geometry_over(
    altitude_m: f64,
    cross: f64,
    step_s: f64,
    orbits: usize,
    baselines_m: &[f64],
    turn_rad: f64,
) -> Vec<TimedPair> {
    let eccentricity = altitude_m / RADIUS_M;
    let mut all = Vec::new();
    for (k, baseline_m) in baselines_m.iter().enumerate() {
        let pair = Pair { i: 0, j: k as u8 + 1 };
        let lag_s = baseline_m / (TAU * RADIUS_M / PERIOD_S);
        for orbit in 0..orbits {
            let node = turn_rad * (orbit as f64 + 0.1 * k as f64) / orbits as f64;
            let at = |t_s: f64, tilt: f64| -> Vec3 {
                let mean = TAU * t_s / PERIOD_S;
                let anomaly = (0..30).fold(mean, |e, _| mean + eccentricity * e.sin());
                let x = RADIUS_M * (anomaly.cos() - eccentricity);
                let y = RADIUS_M * (1.0 - eccentricity * eccentricity).sqrt() * anomaly.sin();
                let (si, ci) = (30_f64.to_radians() + tilt).sin_cos();
                let (so, co) = node.sin_cos();
                [x * co - y * so * ci, x * so + y * co * ci, y * si]
            };
            let start_s = PERIOD_S * (orbit as f64 * 13.0 + 0.29 * ((orbit * 7 + k * 3) % 11) as f64);
            let count = (PERIOD_S / 3.0 / step_s) as usize;
            all.extend((0..count).map(|n| start_s + step_s * n as f64).map(|time_s| TimedPair {
                pair,
                time_s,
                r_i_m: at(time_s, cross * baseline_m / RADIUS_M),
                r_j_m: at(time_s - lag_s, 0.0),
            }));
        }
    }
    all
}

fn weight(at: &TimedPair) -> f64 {
    1e-8 * (1.0 + f64::from(at.pair.j % 3))
}

/// Blocks of up to `size` visibilities of one pair.
fn blocks(at: &[TimedPair], values: &[Complex64], size: usize) -> Vec<PlacedVisibilities> {
    blocks_at(WAVELENGTH_M, at, values, size)
}

fn blocks_at(
    wavelength_m: f64,
    at: &[TimedPair],
    values: &[Complex64],
    size: usize,
) -> Vec<PlacedVisibilities> {
    let frequency_hz = SPEED_OF_LIGHT_M_S / wavelength_m;
    let mut blocks: Vec<PlacedVisibilities> = Vec::new();
    for (at, value) in at.iter().zip(values) {
        if blocks.last().is_none_or(|block| block.pair != at.pair || block.len() == size) {
            let pair = at.pair;
            blocks.push(PlacedVisibilities { frequency_hz, pair, ..PlacedVisibilities::default() });
        }
        let block = blocks.last_mut().unwrap();
        block.time_s.push(at.time_s);
        block.r_i_m.push(at.r_i_m);
        block.r_j_m.push(at.r_j_m);
        block.value_k_sr.push(*value);
        block.weight.push(weight(at));
    }
    blocks
}

fn archive(l_max: usize, visibilities_max: u64) -> VisibilityArchive {
    archive_at(WAVELENGTH_M, l_max, visibilities_max)
}

fn archive_at(wavelength_m: f64, l_max: usize, visibilities_max: u64) -> VisibilityArchive {
    VisibilityArchive::new(RefinedSetup {
        channel: ChannelId(0),
        l_max,
        frequency_hz: SPEED_OF_LIGHT_M_S / wavelength_m,
        baseline_m_max: 5000.0,
        moon_radius_m: MOON_RADIUS_M,
        response: AntennaResponse::Isotropic,
        companion_seed: 3,
        weight_max: 1e-4,
        limits: GeometryLimits::default(),
        visibilities_max,
    })
    .unwrap()
}

fn sums(l_max: usize, blocks: &[PlacedVisibilities]) -> RefinedSums {
    sums_of(archive(l_max, 1 << 30), blocks)
}

fn sums_of(mut archive: VisibilityArchive, blocks: &[PlacedVisibilities]) -> RefinedSums {
    for block in blocks {
        let added = archive.add(block).unwrap();
        assert!(added.refused.is_empty() && added.visibilities == block.len() as u64);
    }
    archive.into_sums(&AssumedInstrument::default()).unwrap()
}

fn request(nside: usize) -> HarmonicRequest {
    let rule = StoppingRule { residual_max: 1e-6, iterations_max: 300 };
    HarmonicRequest { epsilon: EPSILON, nside, rule, samples: Samples::default(), probes: 0 }
}

/// From the beginning, and telling nobody.
fn solve(
    sums: &RefinedSums,
    request: HarmonicRequest,
    rule: RefineRule,
    watch: &SolveWatch,
) -> Result<(HarmonicSolution, Refinement), SolveError> {
    let steps = RefineSteps { start: None, save: &mut |_| {} };
    solve_refined(sums, request, (rule, &Regulariser::default()), None, steps, watch.named("test"))
}

fn refined(sums: &RefinedSums, nside: usize, residual_max: f64) -> (HarmonicSolution, Refinement) {
    let rule = RefineRule { passes_max: 20, residual_max };
    solve(sums, request(nside), rule, &SolveWatch::default()).unwrap()
}

fn difference(found: &[f64], expected: &[f64]) -> f64 {
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    assert_eq!(found.len(), expected.len());
    square(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / square(&mut expected.iter().copied())
}

/// Relative difference of one degree.
fn degree_change(found: &[f64], expected: &[f64], l: usize) -> f64 {
    let of = |x: &[f64]| {
        let alm = coefficients(x, L_MAX);
        (0..=l).flat_map(|m| [alm.get(l, m).re, alm.get(l, m).im]).collect::<Vec<f64>>()
    };
    difference(&of(found), &of(expected))
}

fn rows(wavelength_m: f64, l_max: usize) -> GeneralRows {
    GeneralRows::new(RowsSetup {
        l_max,
        wavelength_m,
        moon_radius_m: MOON_RADIUS_M,
        response: AntennaResponse::Isotropic,
        polynomial_degree: 0,
    })
}

/// A month of orbits: the plane turns by 23 deg.
const MONTH_RAD: f64 = 0.4;

/// Coefficients of these sizes by degree.
fn sky(l_max: usize, size: impl Fn(f64) -> f64) -> Alm {
    let mut sky = Alm::zeros(l_max);
    for l in 0..=l_max {
        for m in 0..=l {
            let angle = (l * l + 3 * m) as f64;
            let im = if m == 0 { 0.0 } else { angle.sin() };
            *sky.get_mut(l, m) = Complex64::new(angle.cos(), im) * size(l as f64);
        }
    }
    sky
}

/// Data of a sky with degrees beyond the map's, which no map fits.
fn seen_sky(wavelength_m: f64, at: &[TimedPair], l_max: usize) -> Vec<Complex64> {
    let l_max = l_max + 8;
    let rows = rows(wavelength_m, l_max);
    rows.forward(&rows.plan(at).unwrap(), &[sky(l_max, |l| 1e6 / (l + 1.0).powf(1.35))]).remove(0)
}

/// The solution of `(Bt N^-1 B + R) x = Bt N^-1 V` with the matrix in memory: of the same rows, which other tests hold against other code.
fn dense_solution(sums: &RefinedSums, l_max: usize, r: &dyn Fn(usize) -> f64) -> (Vec<f64>, Mat<f64>) {
    let unknowns = (l_max + 1) * (l_max + 1);
    let unit = |k: usize| {
        let x: Vec<f64> = (0..unknowns).map(|n| f64::from(u8::from(n == k))).collect();
        coefficients(&x, l_max)
    };
    let mut columns: Vec<Vec<Complex64>> = Vec::new();
    for first in (0..unknowns).step_by(32) {
        let skies: Vec<Alm> = (first..unknowns.min(first + 32)).map(unit).collect();
        columns.extend(sums.rows.forward(&sums.plan, &skies));
    }
    // Real and imaginary parts are numbers of their own.
    let part = |v: Complex64, row: usize| if row.is_multiple_of(2) { v.re } else { v.im };
    let root = |row: usize| sums.data.weight[row / 2].sqrt();
    let count = 2 * sums.at.len();
    let b = Mat::from_fn(count, unknowns, |row, k| root(row) * part(columns[k][row / 2], row));
    let v = Mat::from_fn(count, 1, |row, _| root(row) * part(sums.data.value_k_sr[row / 2], row));
    let mut matrix = b.transpose() * &b;
    degrees(l_max).enumerate().for_each(|(k, l)| matrix[(k, k)] += r(l));
    let factor = matrix.llt(Side::Lower).unwrap();
    let solved = factor.solve(b.transpose() * &v);
    ((0..unknowns).map(|k| solved[(k, 0)]).collect(), factor.inverse())
}

/// Errors of the circle's map and of the refined one against the dense solution, without the mean.
fn errors_of(sums: &RefinedSums, nside: usize, l_max: usize, rule: RefineRule) -> ([f64; 2], Refinement) {
    let watch = SolveWatch::default();
    let (found, refinement) = solve(sums, request(nside), rule, &watch).unwrap();
    let circle = solve_harmonics(&sums.circle, request(nside), None, None, watch.named("test")).unwrap();
    let level = EPSILON * found.diagnostics.w_max.unwrap() / pixel_area_sr(nside);
    let (dense, _) = dense_solution(sums, l_max, &|_| level);
    let error = |x: &[f64]| difference(&x[1..], &dense[1..]);
    ([error(&circle.unknowns[0]), error(&found.unknowns[0])], refinement)
}

#[test]
fn a_month_of_any_orbit_is_refined_to_the_dense_solution() {
    for (altitude_m, cross) in [(1e3, 0.02), (60e3, 0.2)] {
        let at = geometry_over(altitude_m, cross, 75.0, 9, &BASELINES_M, MONTH_RAD);
        let sums = sums(L_MAX, &blocks(&at, &seen_sky(WAVELENGTH_M, &at, L_MAX), 1000));
        let rule = RefineRule { passes_max: 20, residual_max: 1e-5 };
        let ([circle, error], refinement) = errors_of(&sums, NSIDE, L_MAX, rule);
        eprintln!(
            "+-{} km, {cross}: circle {circle:.2}, refined {error:.1e}; {refinement}",
            altitude_m / 1e3
        );
        assert!(refinement.convergence.converged, "{refinement}");
        // A residual of 1e-5 in the norm of the inverse, times the root of W_max / R = 1e4 at most.
        assert!(error < 1e-3 && error < 0.01 * circle, "{error} {circle}");
    }
}

#[test]
fn a_map_that_has_not_converged_says_so() {
    let at = geometry_over(60e3, 0.2, 150.0, 6, &BASELINES_M, MONTH_RAD);
    let sums = sums(L_MAX, &blocks(&at, &seen_sky(WAVELENGTH_M, &at, L_MAX), 1000));
    // No number is solved to this.
    let rule = RefineRule { passes_max: 2, residual_max: 1e-60 };
    let (_, refinement) = solve(&sums, request(NSIDE), rule, &SolveWatch::default()).unwrap();
    assert!(!refinement.convergence.converged);
    assert!(refinement.to_string().contains(": not converged, more passes"), "{refinement}");
}

/// R may depend on the degree: of one that stops degrees above 4 nothing is left of them.
#[test]
fn a_refined_map_takes_an_r_of_the_degree() {
    let at = geometry_over(20e3, 0.05, 120.0, 8, &BASELINES_M[..3], TAU);
    let sums = sums(10, &blocks(&at, &seen_sky(WAVELENGTH_M, &at, 10), 1000));
    let rule = RefineRule { passes_max: 20, residual_max: 1e-6 };
    let solved = |regulariser: &Regulariser| {
        let steps = RefineSteps { start: None, save: &mut |_| {} };
        let (rule, watch) = ((rule, regulariser), SolveWatch::default());
        solve_refined(&sums, request(4), rule, None, steps, watch.named("test")).unwrap().0
    };
    let plain = solved(&Regulariser::default());
    let level = EPSILON * plain.diagnostics.w_max.unwrap() / pixel_area_sr(4);
    // epsilon / C_l, equal to the plain R up to l = 4.
    let power: Vec<f64> = (0..=10).map(|l| EPSILON / level * if l > 4 { 1e-12 } else { 1.0 }).collect();
    let stopped = solved(&Regulariser::Wiener(power));
    let size = |x: &[f64], l: usize| {
        let alm = coefficients(x, 10);
        (0..=l).map(|m| alm.get(l, m).norm_sqr()).sum::<f64>().sqrt()
    };
    for l in 0..=10 {
        let ratio = size(&stopped.unknowns[0], l) / size(&plain.unknowns[0], l);
        assert!(if l > 4 { ratio < 1e-3 } else { ratio > 0.1 }, "{l}: {ratio}");
    }
}

/// Errors over coverage, orbits and frequencies. Takes long: only by its name.
#[test]
#[ignore = "takes long: a table for people"]
fn long_the_table_of_refined_maps() {
    // By wavelength: as many fringes, from baselines and shadows of another size.
    let lengths = [0.7, 1.3, 2.3, 4.0, 6.7, 10.0, 14.7];
    let orbits = [(1e3, 0.02), (20e3, 0.02), (20e3, 0.2), (60e3, 0.2)];
    let coverage = [
        ("month", 0.4, 12, 75.0),
        ("quarter", 1.2, 36, 75.0),
        ("whole", TAU, 64, 75.0),
        ("thinned", TAU, 8, 150.0),
    ];
    for (nside, mhz) in [(8, 10.0), (8, 3.0), (16, 10.0)] {
        let wavelength_m = SPEED_OF_LIGHT_M_S / (1e6 * mhz);
        let l_max = 5 * nside / 2;
        let lengths = lengths.map(|u| u * wavelength_m * nside as f64 / 8.0);
        for (altitude_m, cross) in orbits {
            for (name, turn_rad, orbits, step_s) in coverage {
                if nside > 8 && name != "month" {
                    continue;
                }
                let at = geometry_over(altitude_m, cross, step_s, orbits, &lengths, turn_rad);
                let values = seen_sky(wavelength_m, &at, l_max);
                let archive = archive_at(wavelength_m, l_max, 1 << 30);
                let sums = sums_of(archive, &blocks_at(wavelength_m, &at, &values, 1000));
                let rule = RefineRule { passes_max: 20, residual_max: 1e-3 };
                let begun = std::time::Instant::now();
                let ([circle, error], refinement) = errors_of(&sums, nside, l_max, rule);
                eprintln!(
                    "| {nside} | {mhz} | {:.0} | {:.0} | {name} | {} | {circle:.3} | {error:.1e} | {} | {} | {:.1e} | {:.0} s",
                    altitude_m / 1e3,
                    100.0 * cross,
                    at.len(),
                    refinement.convergence.iterations,
                    refinement.direct,
                    refinement.convergence.residual,
                    begun.elapsed().as_secs_f64()
                );
            }
        }
    }
}

fn write(path: &Path, values: impl Iterator<Item = f64>) {
    fs::write(path, values.flat_map(f64::to_le_bytes).collect::<Vec<u8>>()).unwrap();
}

fn read(path: &Path) -> Vec<f64> {
    fs::read(path).unwrap().as_chunks::<8>().0.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect()
}

/// Rows, sky, visibilities and the map by `tests/python/general_rows.py`.
#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn refined_maps_are_the_dense_solution_of_other_code() {
    let python = common::python();
    // Where planes hardly turn passes converge; where the baseline swings by 11 deg the matrix is formed. The rows' own error is 4e-7.
    let residuals_max = [0.2, 1e-3, 1e-8];
    for (cross, error_max) in [(0.02, 1e-5), (0.2, 1e-4)] {
        let altitude_m = 20e3;
        let at = geometry(altitude_m, cross, 130.0, 9, &BASELINES_M);
        let nothing = vec![Complex64::ZERO; at.len()];
        let w_max =
            refined(&sums(L_MAX, &blocks(&at, &nothing, 50)), NSIDE, 0.9).0.diagnostics.w_max.unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        write(&path("positions"), at.iter().flat_map(|at| [at.r_i_m, at.r_j_m]).flatten());
        write(&path("weights"), at.iter().map(weight));
        let regularisation = EPSILON * w_max / pixel_area_sr(NSIDE);
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/general_rows.py");
        let output = Command::new(&python)
            .arg(script)
            .arg(folder.path())
            .args([L_MAX.to_string(), WAVELENGTH_M.to_string(), MOON_RADIUS_M.to_string()])
            .arg(regularisation.to_string())
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let (sky, dense) = (read(&path("sky")), read(&path("map")));
        let values: Vec<Complex64> = read(&path("visibilities"))
            .as_chunks::<2>()
            .0
            .iter()
            .map(|v| Complex64::new(v[0], v[1]))
            .collect();

        // Rows: the visibilities of that sky.
        let rows = rows(WAVELENGTH_M, L_MAX);
        let alm: Alm = coefficients(&sky, L_MAX);
        let seen = rows.forward(&rows.plan_direct(&at).unwrap(), &[alm]).remove(0);
        let parts = |v: &[Complex64]| v.iter().flat_map(|v| [v.re, v.im]).collect::<Vec<f64>>();
        let error = difference(&parts(&seen), &parts(&values));
        // Both have quadrature errors below 1e-6; altitudes within a class share points, which costs some 1e-6.
        eprintln!("+-{} km, {} %: rows {error:.1e}", altitude_m / 1e3, cross * 100.0);
        assert!(error < 3e-5, "{error:e}");

        let sums = sums(L_MAX, &blocks(&at, &values, 50));
        assert_eq!(sums.departures.on_the_circle + sums.departures.by_refinement, at.len() as u64);
        assert!(sums.departures.by_refinement > at.len() as u64 / 2);
        // Without refinement the circle's sums give garbage.
        let circle =
            solve_harmonics(&sums.circle, request(NSIDE), None, None, SolveWatch::default().named("test"))
                .unwrap();
        let first = difference(&circle.unknowns[0][1..], &dense[1..]);
        let found = residuals_max.map(|residual_max| refined(&sums, NSIDE, residual_max));
        let errors = found.each_ref().map(|found| difference(&found.0.unknowns[0], &dense));
        let shown = errors.map(|error| format!("{error:.1e}")).join(" ");
        eprintln!("circle {first:.2}; residuals {residuals_max:?}: {shown}");
        assert!(errors[2] < error_max && errors[2] <= errors[1] && errors[1] < errors[0], "{errors:?}");
        assert!(first > 0.1 && errors[2] < 0.01 * first, "{first} {errors:?}");
        let refinement = &found[2].1;
        assert_eq!(refinement.chi_square.by_pair.len(), BASELINES_M.len());
        // No noise was added: nothing remains but what the regularisation holds back.
        assert!(refinement.chi_square.all < 1.0, "{:?}", refinement.chi_square);
    }
}

#[test]
fn refinement_leaves_a_map_of_a_circle_as_it_is() {
    let at = geometry(0.0, 0.0, 60.0, 48, &BASELINES_M);
    let rows = rows(WAVELENGTH_M, L_MAX);
    let alm = sky(L_MAX, |l| 1e5 / (l + 1.0));
    let values = rows.forward(&rows.plan(&at).unwrap(), &[alm]).remove(0);
    let sums = sums(L_MAX, &blocks(&at, &values, 1000));
    assert_eq!(sums.departures.by_refinement, 0);
    let watch = SolveWatch::default();
    let plain = solve_harmonics(&sums.circle, request(NSIDE), None, None, watch.named("test")).unwrap();
    let rule = RefineRule { passes_max: 2, residual_max: 1e-3 };
    let (map, refinement) = solve(&sums, request(NSIDE), rule, &watch).unwrap();
    assert!(refinement.convergence.converged, "{refinement}");
    let change = difference(&map.map_k, &plain.map_k);
    eprintln!("{refinement}: changed by {change:.1e}");
    let by_degree: Vec<String> = (0..=L_MAX)
        .map(|l| format!("{:.1e}", degree_change(&map.unknowns[0], &plain.unknowns[0], l)))
        .collect();
    eprintln!("by degree: {}", by_degree.join(" "));
    // What the fast sums' own approximations, 1e-3 of an eigenvalue, make of a map: refinement takes them away.
    assert!(change < 3e-3, "{change:e}");
    let noise = difference(&map.noise_k, &plain.noise_k);
    // Noise is strongest where the sums are least exact.
    assert!(noise < 1e-2, "{noise:e}");
}

#[test]
fn maps_do_not_depend_on_the_order_of_arrival_or_on_threads() {
    let at = geometry(20e3, 0.05, 120.0, 8, &BASELINES_M[..3]);
    let values: Vec<Complex64> = (0..at.len()).map(|k| Complex64::cis(k as f64) * 1e4).collect();
    let map = |blocks: &[PlacedVisibilities], threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| refined(&sums(10, blocks), 4, 1e-3))
    };
    let in_order = map(&blocks(&at, &values, 40), 1);
    let mut mixed = blocks(&at, &values, 7);
    mixed.reverse();
    mixed.sort_by_key(|block| (block.len() * 31 + block.time_s[0] as usize) % 17);
    assert_eq!(in_order, map(&mixed, 3));
}

#[test]
fn what_has_no_row_or_no_room_is_refused_and_counted() {
    let at = geometry(20e3, 0.02, 300.0, 2, &BASELINES_M[..1]);
    let values = vec![Complex64::ONE; at.len()];
    let mut bad = at.clone();
    bad[0].r_i_m = [f64::NAN; 3];
    bad[1].r_i_m = bad[1].r_j_m;
    bad[2].r_i_m = bad[2].r_i_m.map(|x| 0.8 * x);
    let mut archive = archive(4, at.len() as u64 - 5);
    let added: Vec<_> = blocks(&bad, &values, 1000).iter().map(|block| archive.add(block).unwrap()).collect();
    let refused = |reason: Refusal| added.iter().filter_map(|added| added.refused.get(&reason)).sum::<u64>();
    assert_eq!(refused(Refusal::Geometry(GeometryRefusal::NotFinite)), 1);
    assert_eq!(refused(Refusal::Geometry(GeometryRefusal::Degenerate)), 1);
    assert_eq!(refused(Refusal::Geometry(GeometryRefusal::Altitude)), 1);
    assert_eq!(refused(Refusal::Full), 2);
    assert_eq!(archive.counts().visibilities, at.len() as u64 - 5);
}

#[test]
fn an_earlier_solution_saves_the_passes_that_led_to_it() {
    let at = geometry(20e3, 0.05, 120.0, 8, &BASELINES_M[..3]);
    let values: Vec<Complex64> = (0..at.len()).map(|k| Complex64::cis(0.1 * k as f64) * 1e4).collect();
    let sums = sums(10, &blocks(&at, &values, 40));
    let rule = RefineRule { passes_max: 30, residual_max: 1e-5 };
    let watch = SolveWatch::default();
    let mut passes = Vec::new();
    let mut keep = |x: [&[f64]; 2]| passes.push(x.map(<[f64]>::to_vec));
    let steps = RefineSteps { start: None, save: &mut keep };
    let (whole, refinement) =
        solve_refined(&sums, request(4), (rule, &Regulariser::default()), None, steps, watch.named("test"))
            .unwrap();
    let count = refinement.convergence.iterations;
    assert!(count >= 4 && passes.len() >= count, "{count}");
    assert_eq!(passes.last(), Some(&whole.unknowns));
    // The matrix tells errors in x from residuals by its condition, as far as that is measured: a prior of 1e-4 of W_max.
    let go_on = |start: [Vec<f64>; 2]| {
        let steps = RefineSteps { start: Some(start), save: &mut |_| {} };
        solve_refined(&sums, request(4), (rule, &Regulariser::default()), None, steps, watch.named("test"))
            .unwrap()
    };
    let (again, refinement) = go_on(passes[count - 3].clone());
    // Conjugate gradients forget their directions, so that a pass more may be needed.
    assert!(refinement.convergence.converged && refinement.convergence.iterations <= 4, "{refinement}");
    let change = difference(&again.map_k, &whole.map_k);
    assert!(change < 1e-2, "{change:e}");
    // A solution is its own beginning, and residuals are those of the data.
    let (same, refinement) = go_on(whole.unknowns.clone());
    assert!(refinement.convergence.converged && refinement.convergence.iterations <= 1, "{refinement}");
    assert!(difference(&same.map_k, &whole.map_k) < 1e-2);
    let chi_square = solve(&sums, request(4), rule, &watch).unwrap().1.chi_square.all;
    assert!(
        (refinement.chi_square.all / chi_square - 1.0).abs() < 1e-3,
        "{} {chi_square}",
        refinement.chi_square.all
    );
    // What is of another size is no beginning.
    let (fresh, _) = go_on([vec![1.0; 3], vec![1.0; 3]]);
    assert_eq!(fresh, whole);
}

/// Before its first pass a map is nothing.
#[test]
fn interrupted_before_its_first_pass_there_is_no_map() {
    let at = geometry(20e3, 0.02, 300.0, 2, &BASELINES_M[..1]);
    let sums = sums(4, &blocks(&at, &vec![Complex64::ONE; at.len()], 1000));
    let cancel = Cancel::new();
    let watch = SolveWatch::new(cancel.clone()).with_grace(Duration::ZERO);
    let rule = RefineRule { passes_max: 2, residual_max: 1e-9 };
    assert!(solve(&sums, request(2), rule, &watch).is_ok());
    cancel.cancel();
    let found = solve(&sums, request(2), rule, &watch);
    assert!(matches!(found, Err(SolveError::Interrupted)));
}
