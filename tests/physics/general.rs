//! Rows of B for any positions: against the harmonic model on a circle, against direct sums elsewhere, the fast way against
//! row by row, and the transpose.

use std::f64::consts::TAU;

use lunarray::frames::AntennaResponse;
use lunarray::response::general::{
    GeneralRows, ObservationDetails, PairResponse, RowsRefusal, RowsSetup, TimedPair,
};
use lunarray::response::harmonic::{HarmonicModel, ModelSettings, PairState, PatternGeometry};
use lunarray::response::pixel::{Directions, PairGeometry, SatelliteAntenna, antenna_sums, sky_sums};
use lunarray::sky::harmonics::{Alm, AnalysisOptions, Method, analysis, synthesis};
use lunarray::sky::healpix::{pixel_area_sr, pixel_directions};
use lunarray::units::Pair;
use lunarray::units::constants::{MOON_RADIUS_M, SPEED_OF_LIGHT_M_S};
use lunarray::units::vector::{Vec3, cross, unit};
use num_complex::Complex64;

const RADIUS_M: f64 = MOON_RADIUS_M + 300e3;
const WAVELENGTH_M: f64 = 30.0;
const PERIOD_S: f64 = 8248.68;

struct Random(u64);

impl Random {
    /// Uniform in -0.5 .. 0.5.
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (self.0 >> 33) as f64 / (1_u64 << 31) as f64 - 0.5
    }
}

/// Random coefficients with `C_l` falling as the diffuse sky's do, and a monopole.
fn sky(l_max: usize) -> Alm {
    let mut random = Random(5);
    let mut alm = Alm::zeros(l_max);
    for m in 0..=l_max {
        for l in m..=l_max {
            let size = 1e5 / (l as f64 + 1.0).powf(1.35);
            let im = if m == 0 { 0.0 } else { random.next() };
            *alm.get_mut(l, m) = Complex64::new(random.next() * size, im * size);
        }
    }
    *alm.get_mut(0, 0) = Complex64::new(1e6, 0.0);
    alm
}

fn setup(l_max: usize, response: AntennaResponse) -> RowsSetup {
    RowsSetup {
        l_max,
        wavelength_m: WAVELENGTH_M,
        moon_radius_m: MOON_RADIUS_M,
        response,
        polynomial_degree: 0,
    }
}

/// Shape of an orbit: altitude +- `altitude_m`, cross-track offsets of `cross` of the baseline, inclination.
#[derive(Clone, Copy)]
struct Shape {
    altitude_m: f64,
    cross: f64,
    inclination_deg: f64,
}

/// A third of each of several orbits of a pair: one trails the other by `baseline_m` and swings out of its plane.
fn passes(shape: Shape, pair: Pair, baseline_m: f64, step_s: f64, orbits: usize) -> Vec<TimedPair> {
    let of_orbit = |orbit: usize| {
        let node = TAU * (orbit as f64 + 0.3) / orbits as f64;
        let start_s = PERIOD_S * (13 * orbit) as f64 + 1000.0 * orbit as f64;
        let mut times_s = Vec::new();
        let mut t_s = start_s;
        while t_s < start_s + PERIOD_S / 3.0 {
            times_s.push(t_s);
            t_s += step_s;
        }
        places(shape, pair, baseline_m, node, &times_s)
    };
    (0..orbits).flat_map(of_orbit).collect()
}

/// Positions at some times of the first of one orbit of [`passes`].
fn passes_at(shape: Shape, pair: Pair, baseline_m: f64, times_s: &[f64]) -> Vec<TimedPair> {
    places(shape, pair, baseline_m, TAU * 0.3, times_s)
}

/// Positions at some times of an orbit with this node.
fn places(shape: Shape, pair: Pair, baseline_m: f64, node: f64, times_s: &[f64]) -> Vec<TimedPair> {
    let axis_m = RADIUS_M;
    let eccentricity = shape.altitude_m / axis_m;
    let lag_s = baseline_m / (TAU * axis_m / PERIOD_S);
    let at = |t_s: f64, node: f64, tilt: f64| -> Vec3 {
        let mean = TAU * t_s / PERIOD_S;
        let mut e = mean;
        for _ in 0..30 {
            e = mean + eccentricity * e.sin();
        }
        let (x, y) = (
            axis_m * (e.cos() - eccentricity),
            axis_m * (1.0 - eccentricity * eccentricity).sqrt() * e.sin(),
        );
        let (si, ci) = (shape.inclination_deg.to_radians() + tilt).sin_cos();
        let (so, co) = node.sin_cos();
        [x * co - y * so * ci, x * so + y * co * ci, y * si]
    };
    let tilt = shape.cross * baseline_m / axis_m;
    let place = |&time_s: &f64| TimedPair {
        pair,
        time_s,
        r_i_m: at(time_s, node, tilt),
        r_j_m: at(time_s - lag_s, node, 0.0),
    };
    times_s.iter().map(place).collect()
}

fn rms(values: &[Complex64]) -> f64 {
    (values.iter().map(Complex64::norm_sqr).sum::<f64>() / values.len() as f64).sqrt()
}

fn difference(a: &[Complex64], b: &[Complex64]) -> f64 {
    let difference: Vec<_> = a.iter().zip(b).map(|(a, b)| a - b).collect();
    rms(&difference) / rms(b)
}

#[test]
fn on_a_circle_rows_are_those_of_the_harmonic_model() {
    const L_MAX: usize = 48;
    let sky = sky(L_MAX);
    for response in [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal] {
        let rows = GeneralRows::new(setup(L_MAX, response));
        let geometry = PatternGeometry {
            orbit_radius_m: RADIUS_M,
            moon_radius_m: MOON_RADIUS_M,
            wavelength_m: WAVELENGTH_M,
            response,
        };
        let inclination_rad = 30_f64.to_radians();
        let mut model =
            HarmonicModel::new(sky.clone(), ModelSettings::new(geometry, inclination_rad, 40.0)).unwrap();
        let mut random = Random(2);
        let mut states: Vec<PairState> = (0..200)
            .map(|_| PairState {
                node_rad: TAU * random.next(),
                phase_rad: TAU * random.next(),
                baseline_wavelengths: 3.0 + 36.0 * (random.next() + 0.5),
                span_rad: 0.0,
            })
            .collect();
        states.sort_by(|a, b| a.phase_rad.total_cmp(&b.phase_rad));
        let pairs: Vec<TimedPair> = states
            .iter()
            .enumerate()
            .map(|(k, state)| {
                let (so, co) = state.node_rad.sin_cos();
                let (si, ci) = inclination_rad.sin_cos();
                let half = (0.5 * state.baseline_wavelengths * WAVELENGTH_M / RADIUS_M).asin();
                let [r_i_m, r_j_m] = [half, -half].map(|off| {
                    let (s, c) = (state.phase_rad + off).sin_cos();
                    [c * co - s * so * ci, c * so + s * co * ci, s * si].map(|v| RADIUS_M * v)
                });
                TimedPair { pair: Pair { i: 0, j: 1 }, time_s: k as f64, r_i_m, r_j_m }
            })
            .collect();
        let mut expected = vec![Complex64::ZERO; states.len()];
        model.visibilities(&states, &mut expected).unwrap();
        let plan = rows.plan_direct(&pairs).unwrap();
        let found = rows.forward(&plan, std::slice::from_ref(&sky)).remove(0);
        // The model's own error, 1e-5, of a sum whose larger terms cancel.
        let error = difference(&found, &expected);
        assert!(error < 3e-5, "{response:?}: {error:e}");
    }
}

#[test]
fn off_a_circle_rows_are_direct_sums() {
    const L_MAX: usize = 24;
    const NSIDE: usize = 256;
    let sky = sky(L_MAX);
    let values = synthesis(&sky, NSIDE).unwrap();
    let directions = Directions::from(pixel_directions(NSIDE).as_slice());
    let values: Vec<f32> = values.iter().map(|v| *v as f32).collect();
    for (shape, pair) in [
        (Shape { altitude_m: 20e3, cross: 0.02, inclination_deg: 30.0 }, Pair { i: 0, j: 1 }),
        (Shape { altitude_m: 40e3, cross: 0.2, inclination_deg: 85.0 }, Pair { i: 2, j: 5 }),
        (Shape { altitude_m: 100e3, cross: 1.0, inclination_deg: 0.0 }, Pair { i: 0, j: 1 }),
    ] {
        let mut pairs = passes(shape, pair, 400.0, 600.0, 3);
        // The other way round: the conjugate.
        let turned: Vec<TimedPair> =
            pairs.iter().map(|at| TimedPair { r_i_m: at.r_j_m, r_j_m: at.r_i_m, ..*at }).collect();
        pairs.extend(turned.into_iter().map(|at| TimedPair { pair: Pair { i: 6, j: 7 }, ..at }));
        let rows = GeneralRows::new(setup(L_MAX, AntennaResponse::Isotropic));
        let found = rows.forward(&rows.plan_direct(&pairs).unwrap(), std::slice::from_ref(&sky)).remove(0);
        let geometries: Vec<PairGeometry> = pairs
            .iter()
            .map(|at| PairGeometry {
                r_i_m: at.r_i_m,
                r_j_m: at.r_j_m,
                frequency_hz: SPEED_OF_LIGHT_M_S / WAVELENGTH_M,
                moon_radius_m: MOON_RADIUS_M,
                response: AntennaResponse::Isotropic,
            })
            .collect();
        let expected: Vec<Complex64> = sky_sums(&geometries, &directions, &values, pixel_area_sr(NSIDE))
            .unwrap()
            .iter()
            .map(|sum| sum.visibility_k_sr)
            .collect();
        // Direct sums count pixels on the limb whole: some 800 of 4e-6 sr each miss by a third, at random, 1.2e-4 sr K of a
        // sky of 3e5 K; visibilities are of the order of 1e4 K sr.
        let error = difference(&found, &expected);
        assert!(error < 1e-2, "{} {}: {error:e}", shape.altitude_m, shape.cross);
        let half = found.len() / 2;
        let conjugate: Vec<Complex64> = found[half..].iter().map(Complex64::conj).collect();
        // Patterns are rounded to f32, and the two pitches differ in sign.
        let error = difference(&found[..half], &conjugate);
        assert!(error < 1e-6, "{error:e}");
    }
}

#[test]
fn interpolated_rows_are_those_computed_one_by_one() {
    const L_MAX: usize = 30;
    let skies = [sky(L_MAX)];
    let rows = GeneralRows::new(setup(L_MAX, AntennaResponse::Isotropic));
    for shape in [
        Shape { altitude_m: 0.0, cross: 0.0, inclination_deg: 30.0 },
        Shape { altitude_m: 20e3, cross: 0.02, inclination_deg: 30.0 },
        Shape { altitude_m: 40e3, cross: 0.05, inclination_deg: 30.0 },
        Shape { altitude_m: 20e3, cross: 0.2, inclination_deg: 30.0 },
        Shape { altitude_m: 20e3, cross: 0.02, inclination_deg: 0.5 },
        Shape { altitude_m: 60e3, cross: 0.5, inclination_deg: 150.0 },
    ] {
        // The second is hardly denser than the rows that are needed.
        for step_s in [11.0, 55.0] {
            let mut pairs = Vec::new();
            for (j, baseline_m) in [(1, 150.0), (2, 940.0)] {
                pairs.extend(passes(shape, Pair { i: 0, j }, baseline_m, step_s, 1));
            }
            let direct = rows.plan_direct(&pairs).unwrap();
            let plan = rows.plan(&pairs).unwrap();
            let computed = plan.computed();
            // Where a pair turns fastest, each row of the sparse data is computed.
            let most = if step_s < 20.0 { plan.rows() / 3 } else { plan.rows() - 1 };
            assert!(computed <= most || shape.cross > 0.3, "{computed} of {}", plan.rows());
            let expected = rows.forward(&direct, &skies).remove(0);
            let found = rows.forward(&plan, &skies).remove(0);
            for (j, pair) in [1, 2].into_iter().enumerate() {
                let of_pair = pairs.len() / 2 * j..pairs.len() / 2 * (j + 1);
                let error = difference(&found[of_pair.clone()], &expected[of_pair]);
                let what = format!("{} {} {step_s} {pair}", shape.altitude_m, shape.cross);
                eprintln!("{what}: {error:.1e}, {computed} of {} rows", plan.rows());
                assert!(error < 1e-4, "{what}: {error:e}");
            }
        }
    }
}

/// Many passes, whose frames are combined of a few, and in one of them a satellite that begins to drift away at an instant.
#[test]
fn rows_hold_over_many_orbits_and_where_a_satellite_changes_its_velocity() {
    const L_MAX: usize = 30;
    const DRIFT_M_S: f64 = 0.2;
    let skies = [sky(L_MAX)];
    let rows = GeneralRows::new(setup(L_MAX, AntennaResponse::Isotropic));
    let shape = Shape { altitude_m: 20e3, cross: 0.02, inclination_deg: 30.0 };
    let mut pairs = Vec::new();
    for (j, baseline_m) in [(1, 200.0), (2, 940.0)] {
        pairs.extend(passes(shape, Pair { i: 0, j }, baseline_m, 9.0, 12));
    }
    // In the middle of the sixth pass.
    let from_s = PERIOD_S * (13.0 * 5.0) + 5000.0 + PERIOD_S / 6.0 + 1.3;
    let is_pass = |at: &TimedPair| (at.time_s - from_s).abs() < PERIOD_S / 3.0;
    for at in pairs.iter_mut().filter(|at| is_pass(at) && at.time_s > from_s) {
        let away: Vec3 = std::array::from_fn(|k| at.r_j_m[k] - at.r_i_m[k]);
        let length_m = away.iter().map(|x| x * x).sum::<f64>().sqrt();
        let part = DRIFT_M_S * (at.time_s - from_s) / length_m;
        at.r_j_m = std::array::from_fn(|k| at.r_j_m[k] + part * away[k]);
    }
    let plan = rows.plan(&pairs).unwrap();
    assert!(plan.computed() < plan.rows() / 4, "{} of {}", plan.computed(), plan.rows());
    let found = rows.forward(&plan, &skies).remove(0);
    let expected = rows.forward(&rows.plan_direct(&pairs).unwrap(), &skies).remove(0);
    let of = |values: &[Complex64], inside: bool| -> Vec<Complex64> {
        values.iter().zip(&pairs).filter(|(_, at)| is_pass(at) == inside).map(|(v, _)| *v).collect()
    };
    for inside in [false, true] {
        let error = difference(&of(&found, inside), &of(&expected, inside));
        // Polynomials through the kink would be off by 0.2 m/s x 600 s over some 10 nodes' squares: a tenth.
        assert!(error < 1e-4, "{inside}: {error:e}");
    }
}

#[test]
fn the_adjoint_is_the_transpose() {
    const L_MAX: usize = 30;
    let rows = GeneralRows::new(setup(L_MAX, AntennaResponse::Isotropic));
    let shape = Shape { altitude_m: 20e3, cross: 0.2, inclination_deg: 30.0 };
    let mut pairs = passes(shape, Pair { i: 0, j: 1 }, 600.0, 15.0, 3);
    // A few alone, too sparse for interpolation.
    pairs.extend(passes(shape, Pair { i: 0, j: 2 }, 300.0, 800.0, 3));
    let mut random = Random(9);
    for plan in [rows.plan(&pairs).unwrap(), rows.plan_direct(&pairs).unwrap()] {
        let mut alm = Alm::zeros(L_MAX);
        for m in 0..=L_MAX {
            for l in m..=L_MAX {
                let im = if m == 0 { 0.0 } else { random.next() };
                *alm.get_mut(l, m) = Complex64::new(random.next(), im);
            }
        }
        let values: Vec<Complex64> =
            pairs.iter().map(|_| Complex64::new(random.next(), random.next())).collect();
        let zeros = vec![Complex64::ZERO; values.len()];
        let seen = rows.forward(&plan, &[alm.clone(), alm.clone()]);
        assert_eq!(seen[0], seen[1]);
        let back = rows.adjoint(&plan, &[&values, &zeros]);
        assert!(back[1].values().iter().all(|x| x.norm() == 0.0));
        let of_data: f64 = seen[0].iter().zip(&values).map(|(a, b)| (a.conj() * b).re).sum();
        let of_sky: f64 =
            alm.values().iter().zip(back[0].values()).map(|(x, g)| x.re * g.re + x.im * g.im).sum();
        let size = rms(&seen[0]) * rms(&values) * values.len() as f64;
        // Both directions turn and sum in f32, but not in the same order: 6e-8 a rounding, at random over some hundred rows.
        assert!((of_data - of_sky).abs() < 1e-6 * size, "{of_data} {of_sky} {size}");
        // Both at once are the same operations.
        let weight: Vec<f64> = pairs.iter().map(|_| random.next().abs()).collect();
        let weighted: Vec<Complex64> = seen[0].iter().zip(&weight).map(|(v, w)| v * *w).collect();
        let product = rows.normal(&plan, &[alm], &weight);
        assert_eq!(product[0], rows.adjoint(&plan, &[&weighted])[0]);
    }
}

#[test]
fn results_do_not_depend_on_threads() {
    const L_MAX: usize = 12;
    let skies = [sky(L_MAX)];
    let rows = GeneralRows::new(setup(L_MAX, AntennaResponse::Isotropic));
    let shape = Shape { altitude_m: 20e3, cross: 0.05, inclination_deg: 30.0 };
    let pairs = passes(shape, Pair { i: 0, j: 1 }, 500.0, 20.0, 12);
    let plan = rows.plan(&pairs).unwrap();
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let seen = rows.forward(&plan, &skies).remove(0);
            let back = rows.adjoint(&plan, &[&seen]).remove(0);
            (seen, back)
        })
    };
    assert_eq!(run(1), run(3));
}

/// Antennas of a satellite that turn slowly.
fn antenna(elements: AntennaResponse, satellite: u8, time_s: f64) -> SatelliteAntenna {
    let k = f64::from(satellite) + 1e-4 * time_s;
    let axis_hat = unit([0.3 * k.sin(), -0.5 + 0.1 * k.cos(), 0.9]);
    let axes_hat = [axis_hat, unit(cross(axis_hat, [0.2, k.cos(), k.sin()]))];
    SatelliteAntenna::new(elements, axes_hat, 0.02 * f64::from(satellite))
}

fn antennas_of(elements: AntennaResponse, at: &TimedPair) -> [SatelliteAntenna; 2] {
    [at.pair.i, at.pair.j].map(|satellite| antenna(elements, satellite, at.time_s))
}

#[test]
fn antennas_that_differ_see_what_direct_sums_of_them_see() {
    antennas_that_differ(AntennaResponse::DipoleNormal);
}

#[test]
fn three_dipoles_that_differ_see_what_direct_sums_of_them_see() {
    antennas_that_differ(AntennaResponse::ThreeDipoles);
}

fn antennas_that_differ(elements: AntennaResponse) {
    const L_MAX: usize = 24;
    const NSIDE: usize = 256;
    let sky = sky(L_MAX);
    let map = synthesis(&sky, NSIDE).unwrap();
    let directions = Directions::from(pixel_directions(NSIDE).as_slice());
    let values: Vec<f32> = map.iter().map(|v| *v as f32).collect();
    let shape = Shape { altitude_m: 20e3, cross: 0.2, inclination_deg: 60.0 };
    let pairs = passes(shape, Pair { i: 1, j: 4 }, 300.0, 40.0, 2);
    let rows =
        GeneralRows::new(RowsSetup { polynomial_degree: 6, ..setup(L_MAX, AntennaResponse::Isotropic) });
    let response = |k: usize| {
        let [a, b] = antennas_of(elements, &pairs[k]);
        PairResponse::of_antennas([&a, &b])
    };
    let plan = rows
        .plan_with(&pairs, &ObservationDetails { response: Some(&response), ..ObservationDetails::default() })
        .unwrap();
    assert!(plan.computed() < pairs.len());
    let found = rows.forward(&plan, std::slice::from_ref(&sky)).remove(0);
    let geometries: Vec<_> = pairs
        .iter()
        .map(|at| {
            let geometry = PairGeometry {
                r_i_m: at.r_i_m,
                r_j_m: at.r_j_m,
                frequency_hz: SPEED_OF_LIGHT_M_S / WAVELENGTH_M,
                moon_radius_m: MOON_RADIUS_M,
                response: AntennaResponse::Isotropic,
            };
            (geometry, antennas_of(elements, at))
        })
        .collect();
    let expected: Vec<Complex64> = antenna_sums(&geometries, &directions, &values, pixel_area_sr(NSIDE))
        .unwrap()
        .iter()
        .map(|sum| sum.visibility_k_sr)
        .collect();
    // As of isotropic antennas: pixels on the limb.
    let error = difference(&found, &expected);
    assert!(error < 1e-2, "{error:e}");

    // A response that does not change is a factor of the sky, here of its pixels: rows of that sky, one by one.
    let [a, b] = [antenna(elements, 1, 0.0), antenna(elements, 4, 5e3)];
    let constant = PairResponse::of_antennas([&a, &b]);
    let product: Vec<f64> =
        pixel_directions(NSIDE).iter().zip(&map).map(|(n, t)| constant.value(*n) * t).collect();
    let product = analysis(&product, L_MAX + 6, &AnalysisOptions { method: Method::ACCURATE }).unwrap().alm;
    let same = |_: usize| constant.clone();
    // Rows of lower degrees do not hold it.
    let most = constant.degree() - 2;
    let lower =
        GeneralRows::new(RowsSetup { polynomial_degree: most, ..setup(L_MAX, AntennaResponse::Isotropic) });
    let refused = lower
        .plan_with(&pairs, &ObservationDetails { response: Some(&same), ..ObservationDetails::default() });
    let error = refused.map(|plan| plan.rows()).unwrap_err();
    assert_eq!(error.refusal, RowsRefusal::Degree { degree: most + 2, degree_max: most });
    let plan = rows
        .plan_with(&pairs, &ObservationDetails { response: Some(&same), ..ObservationDetails::default() })
        .unwrap();
    let found = rows.forward(&plan, std::slice::from_ref(&sky)).remove(0);
    let plain = GeneralRows::new(setup(L_MAX + 6, AntennaResponse::Isotropic));
    let expected = plain.forward(&plain.plan_direct(&pairs).unwrap(), &[product]).remove(0);
    // Interpolation's, as below.
    let error = difference(&found, &expected);
    assert!(error < 1e-4, "{error:e}");
}

#[test]
fn averages_over_integrations_are_those_of_many_instants() {
    const L_MAX: usize = 60;
    let skies = [sky(L_MAX)];
    let rows = GeneralRows::new(setup(L_MAX, AntennaResponse::Isotropic));
    for (shape, baseline_m, step_s) in [
        // A quarter of a wavelength of motion, twice the longest of the mission's; then its longest integrations.
        (Shape { altitude_m: 20e3, cross: 0.02, inclination_deg: 30.0 }, 900.0, 11.0),
        (Shape { altitude_m: 40e3, cross: 0.2, inclination_deg: 85.0 }, 300.0, 16.0),
        (Shape { altitude_m: 20e3, cross: 0.02, inclination_deg: 30.0 }, 60.0, 60.0),
    ] {
        const INSTANTS: usize = 32;
        let pair = Pair { i: 0, j: 1 };
        let pairs = passes(shape, pair, baseline_m, step_s, 1);
        // Midpoints of as many parts of each integration, at their own positions.
        let fine = passes_at(shape, pair, baseline_m, &{
            let part_s = step_s / INSTANTS as f64;
            let of = |at: &TimedPair| {
                let start_s = at.time_s - 0.5 * step_s;
                (0..INSTANTS).map(move |k| start_s + (k as f64 + 0.5) * part_s)
            };
            pairs.iter().flat_map(of).collect::<Vec<f64>>()
        });
        let each = rows.forward(&rows.plan(&fine).unwrap(), &skies).remove(0);
        let expected: Vec<Complex64> = each
            .chunks(INSTANTS)
            .map(|instants| instants.iter().sum::<Complex64>() / INSTANTS as f64)
            .collect();
        let duration_s = vec![step_s as f32; pairs.len()];
        let observed = ObservationDetails { duration_s: &duration_s, ..ObservationDetails::default() };
        let plan = rows.plan_with(&pairs, &observed).unwrap();
        assert_eq!(plan.instants(), 0);
        let found = rows.forward(&plan, &skies).remove(0);
        let middle = rows.forward(&rows.plan(&pairs).unwrap(), &skies).remove(0);
        let (error, left_out) = (difference(&found, &expected), difference(&middle, &expected));
        assert!(error < 1e-4, "{baseline_m} {}: {error:e}, {left_out:e}", shape.altitude_m);
        assert!(left_out > 10.0 * error, "{baseline_m}: {error:e}, {left_out:e}");

        // Without others about it nobody knows how a pair moves.
        let alone: Vec<TimedPair> = pairs.iter().step_by(pairs.len() / 3).copied().collect();
        let observed =
            ObservationDetails { duration_s: &duration_s[..alone.len()], ..ObservationDetails::default() };
        assert_eq!(rows.plan_with(&alone, &observed).unwrap().instants(), alone.len());
    }
}

#[test]
fn adjoint_and_normal_products_of_averages_with_antennas_are_the_transposes() {
    const L_MAX: usize = 20;
    let shape = Shape { altitude_m: 20e3, cross: 0.2, inclination_deg: 60.0 };
    let pairs = passes(shape, Pair { i: 1, j: 4 }, 300.0, 14.0, 2);
    let rows =
        GeneralRows::new(RowsSetup { polynomial_degree: 2, ..setup(L_MAX, AntennaResponse::Isotropic) });
    let response = |k: usize| {
        let [a, b] = antennas_of(AntennaResponse::DipoleNormal, &pairs[k]);
        PairResponse::of_dipoles(a.axes[0], b.axes[0])
    };
    let duration_s = vec![14.0; pairs.len()];
    let plan = rows
        .plan_with(&pairs, &ObservationDetails { duration_s: &duration_s, response: Some(&response) })
        .unwrap();
    let skies = [sky(L_MAX), {
        let mut other = sky(L_MAX);
        *other.get_mut(3, 2) = Complex64::new(3e5, -1e5);
        other
    }];
    let seen = rows.forward(&plan, &skies);
    let mut random = Random(3);
    let values: Vec<Complex64> =
        seen[0].iter().map(|_| Complex64::new(random.next(), random.next())).collect();
    let gradient = rows.adjoint(&plan, &[&values]).remove(0);
    assert_eq!(gradient.l_max(), L_MAX);
    let of_data: f64 = seen[0].iter().zip(&values).map(|(a, b)| (a * b.conj()).re).sum();
    let inner = |a: &Alm, b: &Alm| -> f64 {
        a.values().iter().zip(b.values()).map(|(a, b)| a.re * b.re + a.im * b.im).sum()
    };
    let of_sky = inner(&skies[0], &gradient);
    // As the plain operator's: patterns and turned skies are in f32.
    assert!((of_data - of_sky).abs() < 1e-5 * of_data.abs(), "{of_data} {of_sky}");

    let weight: Vec<f64> = (0..pairs.len()).map(|k| 1.0 + 0.5 * (k as f64).sin()).collect();
    let products = rows.normal(&plan, &skies, &weight);
    for (sky, seen) in products.iter().zip(&seen) {
        let weighted: Vec<Complex64> = seen.iter().zip(&weight).map(|(v, w)| v * w).collect();
        let expected = rows.adjoint(&plan, &[&weighted]).remove(0);
        let size = inner(&expected, &expected).sqrt();
        let off: f64 =
            sky.values().iter().zip(expected.values()).map(|(a, b)| (a - b).norm_sqr()).sum::<f64>().sqrt();
        // The same numbers, in f32 vectors of other lengths.
        assert!(off < 1e-5 * size, "{off:e} of {size:e}");
    }
}
