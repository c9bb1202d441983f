//! Estimates of what a map over pixels takes.

use super::solve_with_power::POWER_NSIDE_MAX;
use crate::imaging::anywhere::REFINED_VISIBILITY_BYTES;
use crate::imaging::circle::harmonic_cost;
use crate::imaging::cost::{BASIS_VECTORS, ChannelData, EngineCost, iterations, over_maps, solved_together};
use crate::imaging::rates::{
    AVERAGE_ELEMENT_S, CENTRE_ELEMENT_S, CHOLESKY_MULTIPLY_ADDS_PER_S, EXACT_ELEMENT_S,
    RANK_K_MULTIPLY_ADDS_PER_S, cores,
};
use crate::imaging::{MapConfig, PixelEngine, RegulariserChoice};
use crate::response::pixel::{PixelMethod, RowProducts};
use crate::sky::healpix::pixel_count;

/// Iterations without a matrix in units of those of the harmonic engine, whose preconditioner they lack: 55 to 90 with 31 windows.
const FREE_ITERATIONS: f64 = 2.0;

/// Products of a final map with R from the data (rounds for the sky's power with draws, the map, its noise map and errors) by frequency,
/// MHz: the longer the shortest baselines are in wavelengths, the longer the first round takes. With the default array, from 17 and 121
/// windows at nside 8: 73 at 1 MHz, 130 to 250 at 3, 306 at 5, 664 at 7, 816 to 992 at 10 and 1507 at 30 MHz; at nside 16: 149 and 270 at 3,
/// 898 and 1080 at 10 MHz. No solution of a round exceeds `map.iterations_max`.
const DATA_PRODUCTS_BY_MHZ: f64 = 70.0;
const DATA_SOLUTIONS_MAX: f64 = 5.0;

/// Planes of the orbit below which they grow, as the fewer data differ: 204 products from 17 windows of a precession, 518 from 32 of a month,
/// whose node turns by 23 deg, the planes of 5.7 windows (nside 8, 3 MHz).
const DATA_PLANES: f64 = 17.0;

/// Fraction of them that an intermediate map takes, which has no draws: 55 to 70 products at 3 MHz.
const DATA_INTERMEDIATE: f64 = 0.35;

/// Multiply-adds of a dense solution with R from the data in units of the cube of the number of pixels, and full matrices that it holds.
const DATA_CUBES: f64 = 1.0;
const DATA_MATRICES: f64 = 4.0;

/// Products for W_max over pixels, from a random start vector (14 to 31).
const W_MAX_PRODUCTS: f64 = 20.0;

/// Time of an element of a row of B, s.
fn element_s(map: &MapConfig) -> f64 {
    match map.rows {
        PixelMethod::Centre => CENTRE_ELEMENT_S,
        PixelMethod::Average => AVERAGE_ELEMENT_S / map.nside as f64,
        PixelMethod::AverageExact => EXACT_ELEMENT_S,
    }
}

/// The cost of sums over pixels whose matrix is stored and factorised.
pub(in crate::imaging) fn pixel_cost(map: &MapConfig, solutions: u64) -> EngineCost {
    let nside = map.nside;
    let pixels = pixel_count(nside) as f64;
    // Two real rows of B per visibility, and half of a symmetric matrix.
    let visibility_multiply_adds = pixels * pixels;
    // Beyond that nside products are iterated.
    let is_dense = map.regulariser() == RegulariserChoice::Data && nside <= POWER_NSIDE_MAX;
    let from_data = f64::from(u8::from(is_dense));
    let [factorised, inverted] = [pixels.powi(3) / 6.0, from_data * DATA_CUBES * pixels.powi(3)];
    let solution_s = factorised / CHOLESKY_MULTIPLY_ADDS_PER_S + inverted / RANK_K_MULTIPLY_ADDS_PER_S;
    EngineCost {
        sums_bytes: PixelEngine::memory_bytes(nside) as f64,
        copy_bytes: PixelEngine::memory_bytes(nside) as f64,
        other_bytes: from_data * DATA_MATRICES * 8.0 * pixels.powi(2),
        visibility_s: (visibility_multiply_adds / RANK_K_MULTIPLY_ADDS_PER_S + pixels * element_s(map))
            / cores(),
        // Factorised sums have no traces.
        solving_s: solutions as f64 * solution_s / cores(),
        visibility_multiply_adds,
        solving_multiply_adds: solutions as f64 * (factorised + inverted),
        products: 0.0,
    }
}

/// Longest baseline for which blocks are estimated, b_p.
const BLOCKS_BP_MAX: f64 = 100.0;

/// Products of a final map with R from the data.
fn data_products(data: ChannelData, iterations_max: f64) -> f64 {
    let grown = (DATA_PLANES / data.planes().max(1.0)).max(1.0);
    let products = DATA_PRODUCTS_BY_MHZ * (data.frequency_hz / 1e6).max(1.0) * grown;
    products.min(DATA_SOLUTIONS_MAX * iterations_max)
}

/// Stored visibilities and matrix products, each of which computes a row per visibility for the map and its noise map together.
pub(in crate::imaging) fn matrix_free_cost(map: &MapConfig, data: ChannelData) -> EngineCost {
    let pixels = pixel_count(map.nside) as f64;
    let visibilities = data.visibilities.min(map.refine.visibilities_max as f64);
    let from_data = map.regulariser() == RegulariserChoice::Data;
    // The time of a product is proportional to the data that there are.
    let iterations_max = map.iterations_max as f64;
    let of_map = |fraction: f64| match from_data {
        true if fraction < 1.0 => fraction * DATA_INTERMEDIATE * data_products(data, iterations_max),
        true => data_products(data, iterations_max),
        false => {
            let iterations = FREE_ITERATIONS * iterations(fraction * data.windows);
            fraction * (W_MAX_PRODUCTS + iterations.min(iterations_max))
        }
    };
    let products: f64 = over_maps(data, of_map).iter().sum();
    let elements = products * visibilities * pixels;
    let threads = rayon::current_num_threads();
    // The sums of the nearest circle, whose blocks precondition, before rows are computed.
    let circle_bytes = if map.regulariser() == RegulariserChoice::Identity {
        0.0
    } else {
        // Blocks reach as far as the data; a limit far beyond them says nothing.
        let map = &MapConfig { baseline_bp_max: map.baseline_bp_max.min(BLOCKS_BP_MAX), ..map.clone() };
        let circle =
            harmonic_cost(map, ChannelData { solutions: 1, error_draws: 0, node_turns: 1.0, ..data });
        circle.sums_bytes + circle.copy_bytes + circle.other_bytes
    };
    let held = visibilities * REFINED_VISIBILITY_BYTES as f64;
    EngineCost {
        sums_bytes: held,
        // An intermediate map is solved from a copy.
        copy_bytes: held,
        other_bytes: circle_bytes.max(
            RowProducts::memory_bytes(map.nside, solved_together(map), threads) as f64
                + 8.0 * pixels * BASIS_VECTORS[0],
        ),
        visibility_s: 0.0,
        solving_s: elements * element_s(map) / cores(),
        visibility_multiply_adds: 0.0,
        // Real and imaginary parts, two vectors, forward and back.
        solving_multiply_adds: 8.0 * elements,
        products,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use num_complex::Complex64;
    use rand_distr::{Distribution, StandardNormal};

    use super::*;
    use crate::array::{Array, ArrayConfig, ObservingWindows};
    use crate::frames::{AntennaResponse, PlacedVisibilities};
    use crate::imaging::anywhere::{RefinedSetup, VisibilityArchive};
    use crate::imaging::circle::HarmonicRequest;
    use crate::imaging::pixel::projected::degree_max;
    use crate::imaging::pixel::solve_by_degree::PixelEquations;
    use crate::imaging::pixel::{MatrixFreeSums, MatrixFreeVisibilities};
    use crate::imaging::{
        Accuracy, MatrixKind, NormalSums, Regulariser, Samples, SolveWatch, StoppingRule, SumCounts,
    };
    use crate::response::harmonic::GeometryLimits;
    use crate::response::pixel::{Directions, PairGeometry, sky_sums};
    use crate::sky::generated::{GeneratedSky, generate};
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::units::constants::YEAR_S;
    use crate::units::vector::{norm, sub};
    use crate::units::{ChannelId, StreamKind, all_pairs, random_stream};

    /// Every so many windows are observed, at some instants, under a sky of this nside.
    const EVERY: usize = 41;
    const INSTANTS: usize = 6;
    const SKY_NSIDE: usize = 16;

    /// Sums that count their products.
    struct Counted {
        sums: MatrixFreeSums,
        products: AtomicUsize,
    }

    impl NormalSums for Counted {
        fn unknowns(&self) -> usize {
            self.sums.unknowns()
        }
        fn apply(&self, x: &[f64], y: &mut [f64]) {
            self.products.fetch_add(1, Ordering::Relaxed);
            self.sums.apply(x, y);
        }
        fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
            self.products.fetch_add(1, Ordering::Relaxed);
            self.sums.apply_all(x)
        }
        fn right_hand_side(&self) -> &[f64] {
            self.sums.right_hand_side()
        }
        fn noise_right_hand_side(&self) -> &[f64] {
            self.sums.noise_right_hand_side()
        }
        fn counts(&self) -> SumCounts {
            self.sums.counts()
        }
        fn accuracy(&self) -> Accuracy {
            self.sums.accuracy()
        }
    }

    /// The archive of a mission over a precession, with baselines up to 2 b_p and the noise of a receiver under this sky, and its number of
    /// windows.
    fn observed(map: &MapConfig, frequency_hz: f64) -> (VisibilityArchive, usize) {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let sky = generate(&GeneratedSky::default(), frequency_hz, SKY_NSIDE, 5).unwrap();
        let directions = Directions::from(pixel_directions(SKY_NSIDE).as_slice());
        let mean_k = sky.iter().sum::<f64>() / sky.len() as f64;
        let sky: Vec<f32> = sky.into_iter().map(|t| t as f32).collect();
        // 25 s of 10 kHz.
        let sigma_k_sr = 4.0 * std::f64::consts::PI * mean_k / 2.5e5_f64.sqrt();
        let weight = sigma_k_sr.powi(-2);
        let setup = RefinedSetup {
            channel: ChannelId(0),
            l_max: 0,
            frequency_hz,
            baseline_m_max: map.baseline_m_max(frequency_hz),
            moon_radius_m: array.moon_radius_m(),
            response: AntennaResponse::Isotropic,
            companion_seed: 1,
            weight_max: 1024.0 * weight,
            limits: GeometryLimits::default(),
            visibilities_max: 1 << 20,
        };
        let longest_m = MapConfig { baseline_bp_max: 2.0, ..map.clone() }.baseline_m_max(frequency_hz);
        let mut archive = VisibilityArchive::new(setup).unwrap();
        let mut stream = random_stream(7, StreamKind::Probe, [frequency_hz as u64, 0]);
        let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 1.3 * YEAR_S).step_by(EVERY).collect();
        for (window, k) in windows.iter().flat_map(|window| (0..INSTANTS).map(move |k| (window, k))) {
            let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
            let time_s = start_s + (k as f64 + 0.5) / INSTANTS as f64 * (end_s - start_s);
            for pair in all_pairs(8) {
                let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| array.position_m(usize::from(n), time_s));
                if norm(sub(r_i_m, r_j_m)) > longest_m {
                    continue;
                }
                let RefinedSetup { moon_radius_m, response, .. } = setup;
                let geometry = PairGeometry { r_i_m, r_j_m, frequency_hz, moon_radius_m, response };
                let area_sr = pixel_area_sr(SKY_NSIDE);
                let seen = sky_sums(&[geometry], &directions, &sky, area_sr).unwrap()[0].visibility_k_sr;
                let mut noise = || -> f64 { StandardNormal.sample(&mut stream) };
                let noise_k_sr = Complex64::new(noise(), noise()) * sigma_k_sr;
                let placed = PlacedVisibilities {
                    frequency_hz,
                    pair,
                    time_s: vec![time_s],
                    r_i_m: vec![r_i_m],
                    r_j_m: vec![r_j_m],
                    value_k_sr: vec![seen + noise_k_sr],
                    weight: vec![weight],
                    ..PlacedVisibilities::default()
                };
                assert_eq!(archive.add(&placed).unwrap().visibilities, 1);
            }
        }
        (archive, windows.len())
    }

    /// What `check` estimates follows the products that a map with R from the data takes, at low frequencies and at high ones.
    #[test]
    fn estimated_products_are_those_that_a_map_with_r_from_the_data_takes() {
        let map = MapConfig {
            nside: 8,
            matrix: MatrixKind::Free,
            rows: PixelMethod::Centre,
            ..MapConfig::default()
        };
        for frequency_hz in [3e6, 10e6] {
            let (mut archive, windows) = observed(&map, frequency_hz);
            let visibilities = archive.counts().visibilities as f64;
            let order_blocks = archive.order_blocks(degree_max(map.nside)).unwrap();
            let visible = MatrixFreeVisibilities { nside: map.nside, method: map.rows, archive };
            let sums = Counted { sums: visible.into_sums().unwrap(), products: AtomicUsize::new(0) };
            let rule = StoppingRule { residual_max: map.residual_max, iterations_max: map.iterations_max };
            let settings = HarmonicRequest {
                epsilon: 1.0,
                nside: map.nside,
                rule,
                samples: Samples::default(),
                probes: 0,
            };
            let watch = SolveWatch::default();
            PixelEquations { sums: &sums, blocks: &order_blocks.blocks() }
                .solve(settings, &Regulariser::Data, None, None, &[], watch.named("counted"))
                .unwrap();
            let data = ChannelData {
                frequency_hz,
                visibilities,
                windows: windows as f64,
                node_turns: 1.0,
                duration_s: 4.1e7,
                every_nth: 1.0,
                solutions: 1,
                limb_range_rad: 0.0,
                error_draws: 0,
            };
            let estimated = matrix_free_cost(&map, data).products;
            let counted = sums.products.into_inner();
            let ratio = estimated / counted as f64;
            // Whole missions from 1 to 30 MHz have 0.7 to 1.7; without the rounds it would be 0.05 to 0.3.
            assert!((0.5..2.0).contains(&ratio), "{frequency_hz}: {estimated} estimated, {counted} counted");
        }
    }

    /// Tables of the circle are those of the baselines that there are, whatever `map.baseline_bp_max` allows, and so is their estimate.
    #[test]
    fn tables_of_the_circle_are_sized_by_what_is_used() {
        let [near, far] = [2.0, 1e9].map(|baseline_bp_max| {
            let map = MapConfig {
                nside: 4,
                matrix: MatrixKind::Free,
                rows: PixelMethod::Centre,
                baseline_bp_max,
                ..MapConfig::default()
            };
            let (mut archive, windows) = observed(&map, 3e6);
            let visibilities = archive.counts().visibilities as f64;
            // A circle takes no table of baselines of 1e9 b_p.
            let blocks = archive.order_blocks(degree_max(map.nside)).unwrap();
            let diagonal: Vec<f64> = blocks.blocks().iter().map(|block| block.matrix[(0, 0)]).collect();
            let (windows, frequency_hz) = (windows as f64, 3e6);
            let data = ChannelData {
                frequency_hz,
                visibilities,
                windows,
                node_turns: 1.0,
                duration_s: 4.1e7,
                every_nth: 1.0,
                solutions: 1,
                limb_range_rad: 0.0,
                error_draws: 0,
            };
            (diagonal, matrix_free_cost(&map, data).other_bytes)
        });
        assert!(!near.0.is_empty() && near.0.len() == far.0.len());
        let largest = near.0.iter().copied().fold(0.0, f64::max);
        for (near, far) in near.0.iter().zip(&far.0) {
            // Tables that end a little further have other points; their sums err by some 1e-6 of the largest.
            assert!((near - far).abs() < 1e-4 * largest, "{near} {far}");
        }
        // 1e9 b_p would be beyond any memory.
        assert!(far.1 < 1e10, "{}", far.1);
    }
}
