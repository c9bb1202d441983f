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

/// Products with BtN^-1B in one harmonic solution: some 15 for W_max, and 25 each for the map and the noise map, which take nearly twice as
/// long together as one (benches/harmonic).
const APPLICATIONS: f64 = 65.0;

/// Columns that are solved together: a map and its noise map, or, with R from the data, the errors of mean and dipole.
fn solved_together(map: &MapConfig) -> usize {
    if map.regulariser() == RegulariserChoice::Data { 4 } else { 2 }
}

/// Products for W_max over pixels, from a random start vector.
const W_MAX_PRODUCTS: f64 = 30.0;

/// Products with BtN^-1B for one random probe of the traces (at most 300): a guess for epsilon = 1e-4, not measured.
const PROBE_APPLICATIONS: f64 = 40.0;

/// Alphas that the weights of one observation window reach: the width of their kernel, and the drift of the plane.
const WINDOW_ALPHAS: f64 = 16.0;

/// Memory of a visibility while the circle's sums for a refinement are made, bytes: position, data, noise.
const SUMMED_VISIBILITY_BYTES: f64 = 120.0;

/// Vectors of unknowns that a solution holds: the Lanczos basis for W_max, and that for a probe.
const BASIS_VECTORS: [f64; 2] = [60.0, 120.0];

/// Time of all work on a line of phases in one product with BtN^-1B, in units of a Fourier transform: two transforms, the products with the
/// weights, and copying from and to the matrix products (benches/harmonic).
const TRANSFORMS_PER_LINE: f64 = 4.0;

/// The cost of one channel's engine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct EngineCost {
    /// Memory of the sums, bytes.
    pub(crate) sums_bytes: f64,
    /// Memory of a floating-point copy of the sums, from which a map is solved, bytes.
    pub(crate) copy_bytes: f64,
    /// Whether the final map is solved from a copy as well, not in the memory of the sums.
    pub(crate) copies_final: bool,
    /// Memory of tables and workspace, bytes.
    pub(crate) other_bytes: f64,
    /// Estimated time per visibility, s.
    pub(crate) visibility_s: f64,
    /// Estimated time per solution, s.
    pub(crate) solution_s: f64,
    /// Estimated time of the random probes of the final solution, s.
    pub(crate) probes_s: f64,
    pub(crate) visibility_multiply_adds: f64,
    pub(crate) solution_multiply_adds: f64,
}

/// The data of a channel as planned, before its sums exist.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ChannelData {
    pub(crate) frequency_hz: f64,
    /// Visibilities within the map's longest baseline.
    pub(crate) visibilities: f64,
    /// Number of observation windows.
    pub(crate) windows: f64,
}

impl EngineCost {
    /// The cost for the rank with the largest share when ranks share the harmonic sums.
    pub(crate) fn with_ranks(self, ranks: usize, map: &MapConfig) -> Self {
        let blocks = shared_size(map.degree()).blocks;
        let share = blocks.div_ceil(ranks.max(1)) as f64 / blocks as f64;
        Self {
            sums_bytes: share * self.sums_bytes,
            copy_bytes: share * self.copy_bytes,
            visibility_s: share * self.visibility_s,
            solution_s: share * self.solution_s,
            probes_s: share * self.probes_s,
            ..self
        }
    }

    /// The cost of sums that are accumulated in `parts` readings of the data and kept on disk. Memory holds one part, and later one block per
    /// reading thread.
    pub(crate) fn in_parts(self, parts: usize, map: &MapConfig) -> Self {
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
            copies_final: false,
            other_bytes: 0.0,
            ..self
        }
    }

    /// The smallest number of parts (a power of two) with which the memory `needed` for a channel is within `limit_bytes`; `None` if there is
    /// none.
    pub(crate) fn parts_within(
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

    /// Bytes that a rank sends to the others in one solution.
    pub(crate) fn reduced_bytes(map: &MapConfig) -> f64 {
        APPLICATIONS * shared_size(map.degree()).product_bytes as f64
    }

    /// Estimates the cost of a channel's engine.
    pub(crate) fn estimate(map: &MapConfig, data: ChannelData) -> Self {
        match map.engine {
            EngineKind::Pixel | EngineKind::Auto if map.is_matrix_free() => Self::matrix_free(map, data),
            EngineKind::Pixel | EngineKind::Auto => Self::pixel(map),
            EngineKind::Harmonic if map.refine.is_on() => Self::refined(map, data),
            EngineKind::Harmonic => Self::harmonic(map, data),
        }
    }

    fn pixel(map: &MapConfig) -> Self {
        let nside = map.nside;
        let pixels = pixel_count(nside) as f64;
        // Two real rows of B per visibility, and half of a symmetric matrix.
        let visibility_multiply_adds = pixels * pixels;
        let solution_multiply_adds = pixels.powi(3) / 6.0;
        Self {
            sums_bytes: PixelEngine::memory_bytes(nside) as f64,
            copy_bytes: PixelEngine::memory_bytes(nside) as f64,
            copies_final: false,
            other_bytes: 0.0,
            visibility_s: visibility_multiply_adds / (RANK_K_MULTIPLY_ADDS_PER_S * cores()),
            solution_s: solution_multiply_adds / (CHOLESKY_MULTIPLY_ADDS_PER_S * cores()),
            // Factorised sums have no traces.
            probes_s: 0.0,
            visibility_multiply_adds,
            solution_multiply_adds,
        }
    }

    /// Stored visibilities and the maximum number of matrix products, each of which computes a row per visibility for the map and its noise map
    /// together.
    fn matrix_free(map: &MapConfig, data: ChannelData) -> Self {
        let pixels = pixel_count(map.nside) as f64;
        let visibilities = data.visibilities.min(map.refine.visibilities_max as f64);
        let element_s = match map.rows {
            PixelMethod::Centre => CENTRE_ELEMENT_S,
            PixelMethod::Average => AVERAGE_ELEMENT_S,
            PixelMethod::AverageExact => EXACT_ELEMENT_S,
        };
        let products = W_MAX_PRODUCTS + map.iterations_max as f64;
        let elements = products * visibilities * pixels;
        let threads = rayon::current_num_threads();
        let held = visibilities * REFINED_VISIBILITY_BYTES as f64;
        Self {
            sums_bytes: held,
            // An intermediate map is solved from a copy.
            copy_bytes: held,
            copies_final: false,
            other_bytes: RowProducts::memory_bytes(map.nside, solved_together(map), threads) as f64
                + 8.0 * pixels * BASIS_VECTORS[0],
            visibility_s: 0.0,
            solution_s: elements * element_s / cores(),
            probes_s: 0.0,
            visibility_multiply_adds: 0.0,
            // Real and imaginary parts, two vectors, forward and back.
            solution_multiply_adds: 8.0 * elements,
        }
    }

    /// The circle's sums, solved once per iteration; visibilities in memory; and tables of the true rows.
    fn refined(map: &MapConfig, data: ChannelData) -> Self {
        let ChannelData { frequency_hz, visibilities, .. } = data;
        let circle = Self::harmonic(map, data);
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
        let rows = row_tables_bytes(map.degree(), u_max, rayon::current_num_threads(), degree) as f64;
        // Intermediate maps are solved from circle sums and a copy of them.
        let has_snapshots = map.snapshot_every_s > 0.0;
        let snapshot_bytes = if has_snapshots { circle.sums_bytes + circle.copy_bytes } else { 0.0 };
        Self {
            sums_bytes: held,
            copy_bytes: 0.0,
            copies_final: true,
            other_bytes: circle.other_bytes
                + circle.sums_bytes
                + while_summed.max(0.0)
                + rows
                + snapshot_bytes,
            // Each iteration takes a product and an inner solution, for the map and its noise map.
            solution_s: (iterations + 1.0) * (INNER_SOLUTION_FRACTION * circle.solution_s + iteration_s)
                + visibilities * circle.visibility_s,
            visibility_s: if has_snapshots { circle.visibility_s } else { 0.0 },
            solution_multiply_adds: (iterations + 1.0)
                * INNER_SOLUTION_FRACTION
                * circle.solution_multiply_adds,
            ..circle
        }
    }

    fn harmonic(map: &MapConfig, ChannelData { frequency_hz, windows, .. }: ChannelData) -> Self {
        let l_max = map.degree();
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let memory = memory(l_max, u_max, rayon::current_num_threads(), solved_together(map));
        let size = application_size(l_max, u_max);
        let points = size.points as f64;
        // A complex transform takes 5 n log2(n) operations, and a multiply-add is two.
        let transform_multiply_adds = 2.5 * points * points.log2();
        let application_multiply_adds = size.lines as f64 * TRANSFORMS_PER_LINE * transform_multiply_adds;
        // All pairs of a window share a plane, so its weights reach few alphas; the others take no memory.
        let reached = (WINDOW_ALPHAS * windows / points).min(1.0);
        let application_s = application_multiply_adds / (TRANSFORM_MULTIPLY_ADDS_PER_S * cores());
        let vector_bytes = 8.0 * ((l_max + 1) as f64).powi(2);
        let vectors = BASIS_VECTORS[usize::from(map.trace_probes > 0)];
        Self {
            sums_bytes: memory.sums as f64 * reached,
            copy_bytes: memory.sums as f64 * reached,
            // Integers are freed node by node, in pieces too small to be returned to the system.
            copies_final: true,
            other_bytes: (memory.tables + memory.workspace) as f64 + vectors * vector_bytes,
            visibility_s: 1.0 / (HARMONIC_VISIBILITIES_PER_S * cores()),
            solution_s: APPLICATIONS * application_s,
            // A beam takes half the time of the map and its noise map.
            probes_s: (map.trace_probes as f64 * PROBE_APPLICATIONS
                + 0.5 * APPLICATIONS * map.beams_deg.len() as f64)
                * application_s,
            visibility_multiply_adds: SPREAD_MULTIPLY_ADDS,
            solution_multiply_adds: APPLICATIONS * size.matrix_multiply_adds,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::MatrixKind;

    #[test]
    fn auto_costs_what_pixels_do_and_r_from_the_data_takes_more_memory() {
        let data = ChannelData { frequency_hz: 1e7, visibilities: 25_000.0, windows: 100.0 };
        let free = |engine: EngineKind| {
            let map = MapConfig { engine, matrix: MatrixKind::Free, ..MapConfig::default() };
            EngineCost::estimate(&map, data)
        };
        assert_eq!(free(EngineKind::Auto), free(EngineKind::Pixel));
        let harmonic = |regulariser: RegulariserChoice| {
            let regulariser = Some(regulariser);
            let map = MapConfig { engine: EngineKind::Harmonic, regulariser, ..MapConfig::default() };
            EngineCost::estimate(&map, data)
        };
        let [two, four] = [RegulariserChoice::Identity, RegulariserChoice::Data].map(harmonic);
        assert!(four.other_bytes > two.other_bytes, "{four:?} {two:?}");
    }

    #[test]
    fn matrix_free_cost_is_products_times_rows_times_pixels() {
        let data = ChannelData { frequency_hz: 1e7, visibilities: 25_000.0, windows: 100.0 };
        let cost = |nside, iterations_max, rows| {
            let map =
                MapConfig { nside, rows, matrix: MatrixKind::Free, iterations_max, ..MapConfig::default() };
            EngineCost::estimate(&map, data)
        };
        let (few, many) = (cost(64, 70, PixelMethod::Centre), cost(64, 170, PixelMethod::Centre));
        // With those for W_max, twice as many products take twice the time.
        assert!((many.solution_s / few.solution_s - 2.0).abs() < 1e-9);
        assert!((few.solution_s / cost(32, 70, PixelMethod::Centre).solution_s - 4.0).abs() < 1e-9);
        assert!(cost(64, 70, PixelMethod::Average).solution_s > few.solution_s);
        // 9.7 GB of matrix (`PIXEL_ENGINE_NSIDE_MAX`) against 400 bytes per visibility.
        let stored = EngineCost::estimate(&MapConfig { nside: 64, ..MapConfig::default() }, data);
        assert!(stored.sums_bytes > 9e9 && few.sums_bytes < 2e7 && few.other_bytes < 1e9);
    }
}
