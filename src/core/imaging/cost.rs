//! Estimates of the memory, operations and time that the normal equations of a channel take.

use std::f64::consts::TAU;

use super::circle::{SPREAD_MULTIPLY_ADDS, application_size, memory, shared_size};
use super::rates::{
    AVERAGE_ELEMENT_S, AVERAGE_INSTANTS, CENTRE_ELEMENT_S, CHOLESKY_MULTIPLY_ADDS_PER_S, EXACT_ELEMENT_S,
    HARMONIC_VISIBILITIES_PER_S, INNER_SOLUTION_FRACTION, INTERPOLATION_S, RANK_K_MULTIPLY_ADDS_PER_S,
    REFINED_ITERATIONS, ROW_S, TRANSFORM_MULTIPLY_ADDS_PER_S, VISIBILITIES_PER_ROW, cores,
};
use crate::imaging::anywhere::REFINED_VISIBILITY_BYTES;
use crate::imaging::{EngineKind, MapConfig, PixelEngine, RegulariserChoice};
use crate::response::general::row_tables_bytes;
use crate::response::pixel::{PixelMethod, RowProducts};
use crate::sky::healpix::pixel_count;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Iterations of a harmonic solution whose windows cover the planes of the orbit: for W_max, the map and its noise map each (`lunarray run`
/// of the quicklook with `map.epsilon = 1e-4`: 9 to 16, 11 to 13 and 10 to 13).
const ITERATIONS: f64 = 11.0;

/// Number of windows below which iterations grow, and the power of the fraction by which they do: 24 with 50 windows, 75 to 183 with 17.
const WINDOWS_COVERED: f64 = 90.0;
const COVERAGE_EXPONENT: f64 = 1.4;

/// Maximum number of iterations of a solution from few windows, which determine few harmonics.
const ITERATIONS_FEW: f64 = 180.0;

/// Iterations without a matrix in units of those of the harmonic engine, whose preconditioner they lack (55 to 90 with 31 windows).
const FREE_ITERATIONS: f64 = 2.0;

/// Products of a final map with R from the data in units of those with a given R: rounds for the sky's power, its errors and their samples.
/// Intermediate maps take about as many as with a given R.
const DATA_PRODUCTS: f64 = 2.0;

/// Multiply-adds of a dense solution with R from the data in units of the cube of the number of pixels, and full matrices that it holds.
const DATA_CUBES: f64 = 1.0;
const DATA_MATRICES: f64 = 4.0;

/// Columns that are solved together: a map and its noise map, or, with R from the data, the errors of mean and dipole.
fn solved_together(map: &MapConfig) -> usize {
    if map.regulariser() == RegulariserChoice::Data { 4 } else { 2 }
}

/// Products for W_max over pixels, from a random start vector (14 to 31).
const W_MAX_PRODUCTS: f64 = 20.0;

/// Maps with products of their own in each iteration: the map and its noise map.
const SOLVED: f64 = 2.0;

/// Products with BtN^-1B for one random probe of the traces (at most 300): a guess for epsilon = 1e-4, not measured.
const PROBE_APPLICATIONS: f64 = 40.0;

/// Alphas that the weights of one observation window reach, of those that no other has reached: 2.5 to 7.5, from the peak memory of 17 to 121
/// windows at nside 8, 16 and 32.
const WINDOW_ALPHAS: f64 = 4.5;

/// Maximum number of intermediate maps whose products are counted one by one.
const MAPS_COUNTED: u64 = 100;

/// Memory of a visibility while the circle's sums for a refinement are made, bytes: position, data, noise.
const SUMMED_VISIBILITY_BYTES: f64 = 120.0;

/// Vectors of unknowns that a solution holds: the Lanczos basis for W_max, and that for a probe.
const BASIS_VECTORS: [f64; 2] = [60.0, 120.0];

/// Time of all work on a line of phases in one product with BtN^-1B, in units of a Fourier transform: two transforms, the products with the
/// weights, and copying from and to the matrix products (benches/harmonic).
const TRANSFORMS_PER_LINE: f64 = 4.0;

/// Time of an element of a row of B, s.
fn element_s(map: &MapConfig) -> f64 {
    match map.rows {
        PixelMethod::Centre => CENTRE_ELEMENT_S,
        PixelMethod::Average => AVERAGE_ELEMENT_S / map.nside as f64,
        PixelMethod::AverageExact => EXACT_ELEMENT_S,
    }
}

/// The cost of one channel's engine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct EngineCost {
    /// Memory of the sums, bytes.
    pub sums_bytes: f64,
    /// Memory of a floating-point copy of the sums, from which a map is solved, bytes.
    pub copy_bytes: f64,
    /// Memory of tables and workspace, bytes.
    pub other_bytes: f64,
    /// Estimated time per visibility, s.
    pub visibility_s: f64,
    /// Estimated time of all solutions, with the random probes and beams of the final one, s.
    pub solving_s: f64,
    pub visibility_multiply_adds: f64,
    /// Multiply-adds of all solutions.
    pub solving_multiply_adds: f64,
    /// Number of products with the normal matrix in all solutions; 0 for a factorisation.
    pub products: f64,
}

/// The data of a channel as planned, before its sums exist.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChannelData {
    pub frequency_hz: f64,
    /// Visibilities within the map's longest baseline.
    pub visibilities: f64,
    /// Number of observation windows.
    pub windows: f64,
    /// Number of maps: intermediate ones and the final one.
    pub solutions: u64,
    /// Range of the angle between nadir and limb over the mission, rad.
    pub limb_range_rad: f64,
}

/// Usual number of iterations of a map from this many windows.
fn iterations(windows: f64) -> f64 {
    let grown = (WINDOWS_COVERED / windows.max(1.0)).max(1.0).powf(COVERAGE_EXPONENT);
    (ITERATIONS * grown).min(ITERATIONS_FEW)
}

/// Sum over all intermediate maps, and the value of the final one, of a cost by the fraction of the data that a map has.
fn over_maps(data: ChannelData, cost: impl Fn(f64) -> f64) -> [f64; 2] {
    let intermediate = data.solutions.saturating_sub(1);
    let counted = intermediate.min(MAPS_COUNTED);
    let at = |k: u64| cost(k as f64 / (counted + 1) as f64);
    let mean = (1..=counted).map(at).sum::<f64>() / counted.max(1) as f64;
    [intermediate as f64 * mean, cost(1.0)]
}

impl EngineCost {
    /// The cost for the rank with the largest share when ranks share the harmonic sums.
    pub fn with_ranks(self, ranks: usize, map: &MapConfig) -> Self {
        let blocks = shared_size(map.degree()).blocks;
        let share = blocks.div_ceil(ranks.max(1)) as f64 / blocks as f64;
        Self {
            sums_bytes: share * self.sums_bytes,
            copy_bytes: share * self.copy_bytes,
            visibility_s: share * self.visibility_s,
            solving_s: share * self.solving_s,
            ..self
        }
    }

    /// The cost of sums that are accumulated in `parts` readings of the data and kept on disk. Memory holds one part, and later one block per
    /// reading thread.
    pub fn in_parts(self, parts: usize, map: &MapConfig) -> Self {
        if parts < 2 {
            return self;
        }
        let blocks = shared_size(map.degree()).blocks;
        let part = blocks.div_ceil(parts) as f64 / blocks as f64;
        let block_bytes = rayon::current_num_threads() as f64 / blocks as f64 * self.copy_bytes;
        let solving_bytes = block_bytes + self.other_bytes;
        Self {
            sums_bytes: (part * self.sums_bytes).max(solving_bytes),
            copy_bytes: 0.0,
            other_bytes: 0.0,
            ..self
        }
    }

    /// The smallest number of parts (a power of two) with which the memory `needed` for a channel is within `limit_bytes`; `None` if there is
    /// none.
    pub fn parts_within(
        self,
        map: &MapConfig,
        limit_bytes: f64,
        needed: impl Fn(Self) -> f64,
    ) -> Option<usize> {
        let is_divisible = map.engine == EngineKind::Harmonic && !map.refine.is_on();
        let parts_max = if is_divisible { shared_size(map.degree()).blocks } else { 1 };
        let counts = (0..).map(|k| 1_usize << k).take_while(|parts| *parts <= parts_max);
        counts.into_iter().find(|&parts| needed(self.in_parts(parts, map)) <= limit_bytes)
    }

    /// Bytes that a rank sends to the others in all solutions.
    pub fn reduced_bytes(&self, map: &MapConfig) -> f64 {
        self.products * shared_size(map.degree()).product_bytes as f64
    }

    /// Estimates the cost of a channel's engine.
    pub fn estimate(map: &MapConfig, data: ChannelData) -> Self {
        match map.engine {
            EngineKind::Pixel | EngineKind::Auto if map.is_matrix_free() => Self::matrix_free(map, data),
            EngineKind::Pixel | EngineKind::Auto => Self::pixel(map, data.solutions),
            EngineKind::Harmonic if map.refine.is_on() => Self::refined(map, data),
            EngineKind::Harmonic => Self::harmonic(map, data),
        }
    }

    fn pixel(map: &MapConfig, solutions: u64) -> Self {
        let nside = map.nside;
        let pixels = pixel_count(nside) as f64;
        // Two real rows of B per visibility, and half of a symmetric matrix.
        let visibility_multiply_adds = pixels * pixels;
        let from_data = f64::from(u8::from(map.regulariser() == RegulariserChoice::Data));
        let [factorised, inverted] = [pixels.powi(3) / 6.0, from_data * DATA_CUBES * pixels.powi(3)];
        let solution_s = factorised / CHOLESKY_MULTIPLY_ADDS_PER_S + inverted / RANK_K_MULTIPLY_ADDS_PER_S;
        Self {
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

    /// Stored visibilities and matrix products, each of which computes a row per visibility for the map and its noise map together.
    fn matrix_free(map: &MapConfig, data: ChannelData) -> Self {
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
        let held = visibilities * REFINED_VISIBILITY_BYTES as f64;
        Self {
            sums_bytes: held,
            // An intermediate map is solved from a copy.
            copy_bytes: held,
            other_bytes: RowProducts::memory_bytes(map.nside, solved_together(map), threads) as f64
                + 8.0 * pixels * BASIS_VECTORS[0],
            visibility_s: 0.0,
            solving_s: elements * element_s(map) / cores(),
            visibility_multiply_adds: 0.0,
            // Real and imaginary parts, two vectors, forward and back.
            solving_multiply_adds: 8.0 * elements,
            products,
        }
    }

    /// The circle's sums, solved once per iteration; visibilities in memory; and tables of the true rows.
    fn refined(map: &MapConfig, data: ChannelData) -> Self {
        let ChannelData { frequency_hz, visibilities, limb_range_rad, .. } = data;
        let circle = Self::harmonic(map, data);
        // Intermediate maps are solved on the nearest circle.
        let circle_final = Self::harmonic(map, ChannelData { solutions: 1, ..data });
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let stored = visibilities.min(map.refine.visibilities_max as f64);
        let held = stored * REFINED_VISIBILITY_BYTES as f64;
        // While the circle's sums are made, integers and floats are both in memory, but each visibility takes less than later.
        let while_summed = circle.sums_bytes - (held - stored * SUMMED_VISIBILITY_BYTES);
        let iterations = (map.refine.passes_max as f64).min(REFINED_ITERATIONS);
        let l_max = map.degree() as f64;
        let row_s = ROW_S * l_max * (l_max + TAU * u_max);
        // The sky times each monomial of the antennas' responses, at each instant of an average.
        let degree = map.antennas.degree();
        let skies = ((degree + 1) * (degree + 2) / 2) as f64;
        let instants = if map.refine.smear_integrations { AVERAGE_INSTANTS } else { 1.0 };
        let interpolation_s = INTERPOLATION_S * skies * instants;
        let iteration_s = visibilities * (row_s / VISIBILITIES_PER_ROW + interpolation_s) / cores();
        let coefficients = if degree > 0 { 4.0 * skies } else { 0.0 };
        let held = held + visibilities * coefficients;
        let rows = row_tables_bytes(map.degree(), u_max, limb_range_rad, rayon::current_num_threads(), degree)
            as f64;
        // Intermediate maps are solved from circle sums and a copy of them.
        let has_snapshots = map.snapshot_every_s > 0.0;
        let snapshot_bytes = if has_snapshots { circle.sums_bytes + circle.copy_bytes } else { 0.0 };
        Self {
            sums_bytes: held,
            copy_bytes: 0.0,
            other_bytes: circle.other_bytes
                + circle.sums_bytes
                + while_summed.max(0.0)
                + rows
                + snapshot_bytes,
            // Each iteration takes a product and an inner solution, for the map and its noise map.
            solving_s: circle.solving_s - circle_final.solving_s
                + (iterations + 1.0) * (INNER_SOLUTION_FRACTION * circle_final.solving_s + iteration_s)
                + visibilities * circle.visibility_s,
            visibility_s: if has_snapshots { circle.visibility_s } else { 0.0 },
            ..circle
        }
    }

    fn harmonic(map: &MapConfig, data: ChannelData) -> Self {
        let ChannelData { frequency_hz, windows, .. } = data;
        let l_max = map.degree();
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let memory = memory(l_max, u_max, rayon::current_num_threads(), solved_together(map));
        let size = application_size(l_max, u_max);
        let points = size.points as f64;
        // A complex transform takes 5 n log2(n) operations, and a multiply-add is two.
        let transform_multiply_adds = 2.5 * points * points.log2();
        let application_multiply_adds = size.lines as f64 * TRANSFORMS_PER_LINE * transform_multiply_adds;
        // All pairs of a window share a plane, so its weights reach few alphas, and some twice; the others take no memory.
        let reached = 1.0 - (-WINDOW_ALPHAS * windows / points).exp();
        let application_s = application_multiply_adds / (TRANSFORM_MULTIPLY_ADDS_PER_S * cores());
        let of_map = |fraction: f64| {
            ITERATIONS + SOLVED * iterations(fraction * windows).min(map.iterations_max as f64)
        };
        let [intermediate, last] = over_maps(data, of_map);
        let from_data = map.regulariser() == RegulariserChoice::Data;
        let products = intermediate
            + if from_data { DATA_PRODUCTS } else { 1.0 } * last
            + map.trace_probes as f64 * PROBE_APPLICATIONS
            // A beam takes half as many as the map and its noise map.
            + 0.5 * last * map.beams_deg.len() as f64;
        let vector_bytes = 8.0 * ((l_max + 1) as f64).powi(2);
        let vectors = BASIS_VECTORS[usize::from(map.trace_probes > 0)];
        Self {
            sums_bytes: memory.sums as f64 * reached,
            // The final map is solved in the memory of the sums, whose integers are freed node by node.
            copy_bytes: memory.sums as f64 * reached,
            other_bytes: (memory.tables + memory.workspace) as f64 + vectors * vector_bytes,
            visibility_s: 1.0 / (HARMONIC_VISIBILITIES_PER_S * cores()),
            solving_s: products * application_s,
            visibility_multiply_adds: SPREAD_MULTIPLY_ADDS,
            solving_multiply_adds: products * size.matrix_multiply_adds,
            products,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::MatrixKind;

    /// Data that cover the orbit's planes, without intermediate maps.
    const DATA: ChannelData = ChannelData {
        frequency_hz: 1e7,
        visibilities: 25_000.0,
        windows: 200.0,
        solutions: 1,
        limb_range_rad: 0.05,
    };

    fn harmonic(regulariser: RegulariserChoice) -> MapConfig {
        MapConfig { engine: EngineKind::Harmonic, regulariser: Some(regulariser), ..MapConfig::default() }
    }

    #[test]
    fn auto_costs_what_pixels_do_and_r_from_the_data_takes_more_of_all() {
        let free = |engine: EngineKind| {
            let map = MapConfig { engine, matrix: MatrixKind::Free, ..MapConfig::default() };
            EngineCost::estimate(&map, DATA)
        };
        assert_eq!(free(EngineKind::Auto), free(EngineKind::Pixel));
        let dense = |regulariser| MapConfig { engine: EngineKind::Pixel, ..harmonic(regulariser) };
        for map in [harmonic, dense] {
            let [given, from_data] = [RegulariserChoice::Identity, RegulariserChoice::Data]
                .map(|regulariser| EngineCost::estimate(&map(regulariser), DATA));
            assert!(from_data.other_bytes > given.other_bytes, "{from_data:?} {given:?}");
            assert!(from_data.solving_s > given.solving_s, "{from_data:?} {given:?}");
        }
    }

    #[test]
    fn matrix_free_cost_is_products_times_rows_times_pixels() {
        let cost = |nside, iterations_max, rows| {
            let map =
                MapConfig { nside, rows, matrix: MatrixKind::Free, iterations_max, ..MapConfig::default() };
            EngineCost::estimate(&map, DATA)
        };
        let (few, many) = (cost(64, 1, PixelMethod::Centre), cost(64, 22, PixelMethod::Centre));
        // With the 20 for W_max, twice as many products take twice the time.
        assert!((many.solving_s / few.solving_s - 2.0).abs() < 1e-9);
        assert!((few.solving_s / cost(32, 1, PixelMethod::Centre).solving_s - 4.0).abs() < 1e-9);
        assert!(cost(64, 1, PixelMethod::Average).solving_s > few.solving_s);
        // 9.7 GB of matrix (`PIXEL_ENGINE_NSIDE_MAX`) against 400 bytes per visibility.
        let stored = EngineCost::estimate(&MapConfig { nside: 64, ..MapConfig::default() }, DATA);
        assert!(stored.sums_bytes > 9e9 && few.sums_bytes < 2e7 && few.other_bytes < 1e9);
    }

    #[test]
    fn snapshots_cost_as_much_as_their_data_need() {
        let of = |map: &MapConfig, windows, solutions| {
            EngineCost::estimate(map, ChannelData { windows, solutions, ..DATA })
        };
        let map = harmonic(RegulariserChoice::Identity);
        let [one, six] = [1, 6].map(|solutions| of(&map, 200.0, solutions).solving_s);
        // The first two have fewer windows than cover the planes, and take more iterations; none of them is free.
        assert!(six > 6.0 * one, "{six} {one}");
        assert!(of(&map, 17.0, 1).solving_s > of(&map, 200.0, 1).solving_s);
        // Without a matrix, a map of half the data takes half the time of a product.
        let free = MapConfig { matrix: MatrixKind::Free, iterations_max: 1, ..MapConfig::default() };
        let [one, two] = [1, 2].map(|solutions| of(&free, 1e6, solutions).solving_s);
        assert!((two / one - 1.5).abs() < 1e-9);
    }

    #[test]
    fn only_the_final_map_is_refined() {
        let mut map = harmonic(RegulariserChoice::Identity);
        let of = |map: &MapConfig, solutions| {
            EngineCost::estimate(map, ChannelData { solutions, ..DATA }).solving_s
        };
        let on_circle = of(&map, 6) - of(&map, 1);
        map.refine.passes_max = 3;
        let [one, six] = [1, 6].map(|solutions| of(&map, solutions));
        assert!(((six - one) / on_circle - 1.0).abs() < 1e-9, "{six} {one} {on_circle}");
        assert!(one > of(&harmonic(RegulariserChoice::Identity), 1));
    }

    #[test]
    fn memory_follows_windows_and_limbs() {
        let mut map = harmonic(RegulariserChoice::Identity);
        let of = |map: &MapConfig, data| EngineCost::estimate(map, data);
        let [few, many, all] =
            [10.0, 100.0, f64::INFINITY].map(|windows| of(&map, ChannelData { windows, ..DATA }).sums_bytes);
        assert!(few < 0.5 * many && many < all, "{few} {many} {all}");
        // A circular orbit has limbs at one angle, an ellipse needs tables for many.
        map.refine.passes_max = 3;
        let [circle, ellipse] =
            [0.0, 0.5].map(|limb_range_rad| of(&map, ChannelData { limb_range_rad, ..DATA }).other_bytes);
        assert!(circle < ellipse, "{circle} {ellipse}");
    }
}
