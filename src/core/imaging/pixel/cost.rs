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

/// Iterations without a matrix in units of those of the harmonic engine: with the identity they lack its preconditioner (55 to 90 with 31
/// windows), with R from the data there are rounds, draws and errors.
const FREE_ITERATIONS: f64 = 2.0;

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
pub(super) fn stored(map: &MapConfig, solutions: u64) -> EngineCost {
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

/// Stored visibilities and matrix products, each of which computes a row per visibility for the map and its noise map together.
pub(super) fn matrix_free(map: &MapConfig, data: ChannelData) -> EngineCost {
    let pixels = pixel_count(map.nside) as f64;
    let visibilities = data.visibilities.min(map.refine.visibilities_max as f64);
    // The time of a product is proportional to the data that there are.
    let of_map = |fraction: f64| {
        let iterations = FREE_ITERATIONS * iterations(fraction * data.windows);
        fraction * (W_MAX_PRODUCTS + iterations.min(map.iterations_max as f64))
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
        let circle = harmonic_cost(map, ChannelData { solutions: 1, ..data });
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
