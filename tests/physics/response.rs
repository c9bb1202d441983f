//! Rows of B and visibilities against values computed by independent code.

use crate::common;

use lunarray::array::{Array, ArrayConfig, hidden_by_moon};
use lunarray::frames::AntennaResponse;
use lunarray::response::pixel::{Directions, PairGeometry, PixelMethod, RowMaker, exact, sky_sums};
use lunarray::sky::healpix;
use lunarray::units::vector::{Vec3, dot, scale, unit};
use serde_json::Value;

fn read(file: &str) -> Value {
    serde_json::from_slice(&std::fs::read(common::shared(file)).unwrap()).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

/// The pair of a record with one-based `i`, `j`, `t_s` and `nu_hz`, for the fiducial array.
fn pair_of(array: &Array, record: &Value) -> PairGeometry {
    let t_s = record["t_s"].as_f64().unwrap();
    let position = |key: &str| array.position_m(record[key].as_u64().unwrap() as usize - 1, t_s);
    PairGeometry {
        r_i_m: position("i"),
        r_j_m: position("j"),
        frequency_hz: record["nu_hz"].as_f64().unwrap(),
        moon_radius_m: array.moon_radius_m(),
        response: AntennaResponse::Isotropic,
    }
}

/// The sky of the reference data's README.
fn test_sky(n: Vec3) -> f64 {
    let [x, y, z] = n;
    let spot = |s: Vec3, width: f64| ((dot(n, s) - 1.0) / width).exp();
    let smooth = 1.0 + 0.3 * x - 0.2 * y * z + 0.1 * (7.0 * z + 3.0 * x).sin();
    3e5 * (smooth + 2.0 * spot([0.36, 0.48, 0.8], 0.01) + 1.5 * spot([-0.6, 0.64, -0.48], 0.004))
}

/// Whether a limb hides some children of a pixel but not others.
fn is_cut(pair: &PairGeometry, nside: usize, pixel: usize) -> bool {
    let (face, ix, iy) = healpix::nested_to_face(nside, healpix::ring_to_nested(nside, pixel));
    let seen = |k: usize| {
        let place = |whole: usize, k: usize| (whole as f64 + (k as f64 + 0.5) / 16.0) / nside as f64;
        let n = healpix::face_direction(face, place(ix, k / 16), place(iy, k % 16));
        [pair.r_i_m, pair.r_j_m].map(|r_m| !hidden_by_moon(r_m, n, pair.moon_radius_m))
    };
    let first = seen(0);
    (1..256).any(|k| seen(k) != first)
}

/// Root mean square of the differences of complex numbers, inside and outside a selection.
fn rms(pairs: impl Iterator<Item = ([f64; 2], [f64; 2], bool)>) -> [f64; 2] {
    let mut sums = [[0.0; 2]; 2];
    for (a, b, selected) in pairs {
        let sum = &mut sums[usize::from(selected)];
        sum[0] += (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
        sum[1] += 1.0;
    }
    sums.map(|[squares, count]| (squares / f64::max(count, 1.0)).sqrt())
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn rows_agree_with_independent_rows() {
    let rows = read("reference/beam_rows.json");
    let array = Array::new(&ArrayConfig::default()).unwrap();
    for record in rows.as_array().unwrap() {
        let nside = record["nside"].as_u64().unwrap() as usize;
        let children = record["nfine"].as_u64().unwrap() as usize / nside;
        let pair = pair_of(&array, record);
        let read = |key: &str| numbers(&record[key]);
        let (centre_re, centre_im) = (read("centre_re"), read("centre_im"));
        let (average_re, average_im) = (read("average_re"), read("average_im"));
        let name = format!("nside {nside}, pair {}-{}", record["i"], record["j"]);

        let directions = healpix::pixel_directions(nside);
        let centre = exact::centre_row(&pair, &directions);
        let average = exact::average_row(&pair, nside, children);
        for p in 0..directions.len() {
            // Phases of some 100 rad at 1e-16 each, in both codes.
            assert!((centre[p].re - centre_re[p]).abs() < 1e-10, "{name}, pixel {p}");
            assert!((centre[p].im - centre_im[p]).abs() < 1e-10, "{name}, pixel {p}");
            assert!((average[p].re - average_re[p]).abs() < 1e-10, "{name}, pixel {p}");
            assert!((average[p].im - average_im[p]).abs() < 1e-10, "{name}, pixel {p}");
        }

        let (mut re, mut im) = (vec![0.0_f64; directions.len()], vec![0.0_f64; directions.len()]);
        RowMaker::new(nside, PixelMethod::Centre).unwrap().fill(&pair, 1.0, &mut re, &mut im);
        for p in 0..directions.len() {
            // Sines in f32 of phases reduced in f64; 1e-4 rad is required.
            assert!((re[p] - centre_re[p]).abs() < 2e-6, "{name}, pixel {p}");
            assert!((im[p] - centre_im[p]).abs() < 2e-6, "{name}, pixel {p}");
        }

        RowMaker::new(nside, PixelMethod::Average).unwrap().fill(&pair, 1.0, &mut re, &mut im);
        let compared = (0..directions.len())
            .map(|p| ([re[p], im[p]], [average_re[p], average_im[p]], is_cut(&pair, nside, p)));
        let [away, on_edge] = rms(compared);
        eprintln!("{name}: averaged rows differ by {away:.1e} rms away from the limb, {on_edge:.1e} on it");
        // The required accuracy; the closed form neglects curvature beyond first order.
        assert!(away < 1e-3, "{name}: {away}");
        assert!(on_edge < 2e-2, "{name}: {on_edge}");
    }
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn visibilities_agree_with_independent_sums() {
    let file = read("reference/visibilities_nside64.json");
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let centres = healpix::pixel_directions(64);
    let sky: Vec<f64> = centres.iter().map(|&n| test_sky(n)).collect();
    let sky_f32: Vec<f32> = sky.iter().map(|&t| t as f32).collect();
    let directions = Directions::from(centres.as_slice());
    let area_sr = healpix::pixel_area_sr(64);
    let values = file["values"].as_array().unwrap();
    assert_eq!(values.len(), 24);
    let pairs: Vec<PairGeometry> = values.iter().map(|value| pair_of(&array, value)).collect();
    let fast = sky_sums(&pairs, &directions, &sky_f32, area_sr).unwrap();
    for ((value, pair), fast) in values.iter().zip(&pairs).zip(fast) {
        let (re, im) = (value["re"].as_f64().unwrap(), value["im"].as_f64().unwrap());
        let sum = exact::visibility(pair, &centres, &sky, area_sr);
        let off = (sum.visibility_k_sr.re - re).hypot(sum.visibility_k_sr.im - im);
        assert!(off < 1e-9 * re.hypot(im), "{value}: {:?}", sum.visibility_k_sr);
        let off = (fast.visibility_k_sr - sum.visibility_k_sr).norm();
        // Of the zero-spacing sum, which the noise scales with; documented as below 1e-6.
        assert!(off < 1e-7 * sum.zero_spacing_k_sr, "{value}: {off} of {}", sum.zero_spacing_k_sr);
        let off = (fast.zero_spacing_k_sr / sum.zero_spacing_k_sr - 1.0).abs();
        assert!(off < 1e-7, "{value}: {off}");
    }
}

/// Two satellites of the fiducial orbit, `length_m` apart.
fn pair_apart(length_m: f64, frequency_hz: f64, response: AntennaResponse) -> PairGeometry {
    let radius_m = 2_037_100.0;
    let at = |phase: f64| {
        let (sin, cos) = phase.sin_cos();
        scale(radius_m, unit([cos, 0.8 * sin, 0.6 * sin]))
    };
    let phase = 2.0 * (0.5 * length_m / radius_m).asin();
    PairGeometry {
        r_i_m: at(0.9),
        r_j_m: at(0.9 - phase),
        frequency_hz,
        moon_radius_m: 1_737_100.0,
        response,
    }
}

#[test]
fn fast_rows_keep_the_phase_of_the_longest_baseline() {
    let pair = pair_apart(100e3, 30e6, AntennaResponse::DipoleNormal);
    let directions = healpix::pixel_directions(32);
    let expected = exact::centre_row(&pair, &directions);
    let (mut re, mut im) = (vec![0.0_f64; directions.len()], vec![0.0_f64; directions.len()]);
    RowMaker::new(32, PixelMethod::Centre).unwrap().fill(&pair, 1.0, &mut re, &mut im);
    for (p, value) in expected.iter().enumerate() {
        let off = (re[p] - value.re).hypot(im[p] - value.im);
        // f32 sines and one f32 product; 1e-4 rad is required.
        assert!(off < 2e-6, "pixel {p}: {off}");
    }
}

#[test]
fn fast_averages_agree_with_exact_ones_for_any_length_and_antenna() {
    for response in [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal] {
        for nside in [4, 16] {
            let width_rad = healpix::pixel_area_sr(nside).sqrt();
            for pixels_long in [0.1, 0.45, 0.9, 1.9, 3.9, 7.9, 15.9, 40.0] {
                let length_m = pixels_long * 29.979_245_8 / width_rad;
                let pair = pair_apart(length_m, 10e6, response);
                let expected = exact::average_row(&pair, nside, 16);
                let count = expected.len();
                let (mut re, mut im) = (vec![0.0_f64; count], vec![0.0_f64; count]);
                RowMaker::new(nside, PixelMethod::Average).unwrap().fill(&pair, 1.0, &mut re, &mut im);
                let compared = (0..count)
                    .map(|p| ([re[p], im[p]], [expected[p].re, expected[p].im], is_cut(&pair, nside, p)));
                let [away, on_edge] = rms(compared);
                eprintln!("{response:?} nside {nside}, {pixels_long} pixels: {away:.1e} {on_edge:.1e}");
                assert!(away < 1e-3, "nside {nside}, {pixels_long} pixels, {response:?}: {away}");
                assert!(on_edge < 2e-2, "nside {nside}, {pixels_long} pixels, {response:?}: {on_edge}");
            }
        }
    }
}
