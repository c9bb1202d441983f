//! Rate of the response kernels on one core, and its ratio to the required rate.
//!
//! `cargo bench --bench response`
#![allow(clippy::unwrap_used)] // A program for people at a terminal.

use std::hint::black_box;
use std::time::Instant;

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::AntennaResponse;
use lunarray::response::pixel::{
    Directions, PairGeometry, PixelMethod, RowMaker, RowProducts, exact, sky_sums,
};
use lunarray::sky::healpix::{pixel_area_sr, pixel_directions};

/// Required pixel-fringes a second and core.
const LIMIT_PER_S: f64 = 5e8;

/// Least time of several runs, s, which is the least disturbed by other programs.
fn best(runs: usize, mut run: impl FnMut()) -> f64 {
    let mut least_s = f64::INFINITY;
    for _ in 0..runs {
        let start = Instant::now();
        run();
        least_s = least_s.min(start.elapsed().as_secs_f64());
    }
    least_s
}

/// Pairs 1-2 to 1-4 at many times, at frequencies that make their baselines `pixels_long` pixels of `nside` long.
fn pairs(count: usize, nside: usize, pixels_long: f64) -> Vec<PairGeometry> {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let width_rad = pixel_area_sr(nside).sqrt();
    let pair = |k: usize| {
        let t_s = 2e4 * k as f64;
        let mut pair = PairGeometry {
            r_i_m: array.position_m(0, t_s),
            r_j_m: array.position_m(1 + k % 3, t_s),
            frequency_hz: 1.0,
            moon_radius_m: array.moon_radius_m(),
            response: AntennaResponse::Isotropic,
        };
        let [x, y, z] = pair.baseline_wavelengths();
        pair.frequency_hz = pixels_long / width_rad / (x * x + y * y + z * z).sqrt();
        pair
    };
    (0..count).map(pair).collect()
}

fn report(what: &str, fringes: usize, seconds: f64) {
    let rate = fringes as f64 / seconds;
    println!("{what:<56} {:8.3} G/s  {:6.2} x limit", rate / 1e9, rate / LIMIT_PER_S);
}

fn sums(nside: usize) {
    let directions = Directions::from(pixel_directions(nside).as_slice());
    let sky_k = vec![3e5_f32; directions.len()];
    let pairs = pairs(64, nside, 2.0);
    let area_sr = pixel_area_sr(nside);
    let seconds = best(7, || {
        black_box(sky_sums(black_box(&pairs), &directions, &sky_k, area_sr).unwrap());
    });
    report(&format!("direct sums over a sky, nside {nside}"), pairs.len() * directions.len(), seconds);
}

fn rows(nside: usize, method: PixelMethod, pixels_long: f64) {
    let maker = RowMaker::new(nside, method).unwrap();
    let pairs = pairs(64, nside, pixels_long);
    let (mut re, mut im) = (vec![0.0_f64; maker.pixels()], vec![0.0_f64; maker.pixels()]);
    let seconds = best(7, || {
        for pair in &pairs {
            maker.fill(black_box(pair), 1.0, &mut re, &mut im);
            black_box((&re, &im));
        }
    });
    let name = format!("rows in f64, {method:?}, nside {nside}, b = {pixels_long} b_p");
    report(&name, pairs.len() * maker.pixels(), seconds);
}

/// `Bt W B x` for two maps, rows made for it and not kept (`map.matrix = "free"`), and how much of the time making them once takes.
fn products(nside: usize, method: PixelMethod, pixels_long: f64) {
    let (maker, products) = (RowMaker::new(nside, method).unwrap(), RowProducts::new(nside, method).unwrap());
    let pairs = pairs(256, nside, pixels_long);
    let weights = vec![1.0; pairs.len()];
    let x: [Vec<f64>; 2] =
        [0.7, 1.9].map(|f: f64| (0..maker.pixels()).map(|p| (f * p as f64).sin()).collect());
    let (mut re, mut im) = (vec![0.0_f32; maker.pixels()], vec![0.0_f32; maker.pixels()]);
    // In pairs, so that what else the machine does falls on both.
    let (mut product_s, mut rows_s) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..5 {
        product_s = product_s.min(best(1, || {
            black_box(products.normal(black_box(&pairs), &weights, &[&x[0], &x[1]]));
        }));
        rows_s = rows_s.min(best(1, || {
            for pair in &pairs {
                maker.fill(black_box(pair), 1.0, &mut re, &mut im);
                black_box((&re, &im));
            }
        }));
    }
    let name = format!("products for two maps, {method:?}, nside {nside}, b = {pixels_long} b_p");
    let fringes = pairs.len() * maker.pixels();
    report(&name, fringes, product_s);
    println!("{:<56} {:8.2} x the time of the rows alone", "", product_s / rows_s);
}

fn exactly(nside: usize) {
    let directions = pixel_directions(nside);
    let pairs = pairs(2, nside, 2.0);
    let seconds = best(3, || {
        for pair in &pairs {
            black_box(exact::centre_row(black_box(pair), &directions));
        }
    });
    report(&format!("rows one by one in f64, nside {nside}"), pairs.len() * directions.len(), seconds);
}

fn main() {
    println!("pixel-fringes a second on one core; limit {LIMIT_PER_S:e} (averages: pixels, not children)");
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| {
        for nside in [64, 256] {
            sums(nside);
        }
        for nside in [16, 64] {
            rows(nside, PixelMethod::Centre, 1.9);
            for pixels_long in [0.4, 0.9, 1.9, 3.9] {
                rows(nside, PixelMethod::Average, pixels_long);
            }
        }
        for pixels_long in [0.4, 0.9, 1.9] {
            products(64, PixelMethod::Centre, pixels_long);
            products(64, PixelMethod::Average, pixels_long);
        }
        exactly(64);
    });
}
