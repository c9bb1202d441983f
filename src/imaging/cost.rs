//! What the normal equations of a channel cost: memory, operations, and an estimate of the time.

use std::f64::consts::TAU;

use super::circle::{SPREAD_MULTIPLY_ADDS, application_size, memory, shared_size};
use super::rates::{
    AVERAGE_ELEMENT_S, AVERAGE_INSTANTS, CENTRE_ELEMENT_S, CHOLESKY_MULTIPLY_ADDS_PER_S, EXACT_ELEMENT_S,
    HARMONIC_VISIBILITIES_PER_S, INNER_SOLUTION, INTERPOLATION_S, RANK_K_MULTIPLY_ADDS_PER_S, REFINED_PASSES,
    ROW_S, TRANSFORM_MULTIPLY_ADDS_PER_S, VISIBILITIES_PER_ROW, cores,
};
use crate::imaging::anywhere::REFINED_VISIBILITY_BYTES;
use crate::imaging::{EngineKind, MapConfig, PixelEngine};
use crate::response::general::row_tables_bytes;
use crate::response::pixel::{PixelMethod, RowProducts};
use crate::sky::healpix::pixel_count;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Products with BtN^-1B in one harmonic solution: some 15 for W_max, 25 each for the map and the noise map, which in memory take
/// nearly twice as long together as one (benches/harmonic).
const APPLICATIONS: f64 = 65.0;

/// A map and its noise map.
const SOLVED_TOGETHER: usize = 2;

/// Products for W_max over pixels, from a random vector.
const W_MAX_PRODUCTS: f64 = 30.0;

/// Products with BtN^-1B for one random probe of the traces, of at most 300: a guess for epsilon = 1e-4, not measured.
const PROBE_APPLICATIONS: f64 = 40.0;

/// Alphas that the weights of one window reach: as many as their kernel, and those that the plane passes on its way.
const WINDOW_ALPHAS: f64 = 16.0;

/// Memory of a visibility that is summed on the circle for a refinement: position, data, noise.
const SUMMED_VISIBILITY_BYTES: f64 = 120.0;

/// Vectors of the unknowns that a solution holds: the basis for W_max, and that of a probe.
const BASIS_VECTORS: [f64; 2] = [60.0, 120.0];

/// Transforms that take as long as all that is done to a line of phases in one product with BtN^-1B: two of them, the
/// products with the weights, and the way from the matrix products and back (benches/harmonic).
const TRANSFORMS_PER_LINE: f64 = 4.0;

/// Cost of one channel's engine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct EngineCost {
    /// Memory of the sums, bytes.
    pub(crate) sums_bytes: f64,
    /// Memory of a copy of the sums as numbers, from which a map is solved, bytes.
    pub(crate) copy_bytes: f64,
    /// Whether the final map is solved from a copy, too, or in the memory of the sums.
    pub(crate) copies_last: bool,
    /// Memory besides the sums, bytes: tables and workspace.
    pub(crate) other_bytes: f64,
    /// Estimated time of a visibility, s.
    pub(crate) visibility_s: f64,
    /// Estimated time of a solution, s.
    pub(crate) solution_s: f64,
    /// Estimated time of the random probes of the final solution, s.
    pub(crate) probes_s: f64,
    /// Multiply-adds of a visibility.
    pub(crate) visibility_multiply_adds: f64,
    /// Multiply-adds of a solution.
    pub(crate) solution_multiply_adds: f64,
}

/// What is known of a channel before its sums are made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ChannelData {
    /// Centre frequency, Hz.
    pub(crate) frequency_hz: f64,
    /// Visibilities within the map's longest baseline.
    pub(crate) visibilities: f64,
    /// Windows in which they are observed.
    pub(crate) windows: f64,
}

impl EngineCost {
    /// The cost for one of some ranks that share the sums of the harmonic engine: for the one that has most of them.
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

    /// The cost of sums that are made in so many parts and wait on disk: a part in memory, then for each thread the block that it reads.
    pub(crate) fn in_parts(self, parts: usize, map: &MapConfig) -> Self {
        if parts < 2 {
            return self;
        }
        let blocks = shared_size(map.degree()).blocks;
        let part = blocks.div_ceil(parts) as f64 / blocks as f64;
        // Each thread keeps the memory of a block that it reads.
        let read = rayon::current_num_threads() as f64 / blocks as f64 * self.copy_bytes;
        let solving = read + self.other_bytes;
        Self {
            sums_bytes: (part * self.sums_bytes).max(solving),
            copy_bytes: 0.0,
            copies_last: false,
            other_bytes: 0.0,
            ..self
        }
    }

    /// The least number of parts, of those that halve each other, with which a channel fits `limit_bytes` by `needed`; `None` if none does.
    pub(crate) fn parts_within(
        self,
        map: &MapConfig,
        limit_bytes: f64,
        needed: impl Fn(Self) -> f64,
    ) -> Option<usize> {
        let can_wait = map.engine == EngineKind::Harmonic && !map.refine.is_on();
        let most = if can_wait { shared_size(map.degree()).blocks } else { 1 };
        let counts = (0..).map(|k| 1_usize << k).take_while(|parts| *parts <= most);
        counts.into_iter().find(|&parts| needed(self.in_parts(parts, map)) <= limit_bytes)
    }

    /// Bytes that a rank gives to the others in one solution.
    pub(crate) fn reduced_bytes(map: &MapConfig) -> f64 {
        APPLICATIONS * shared_size(map.degree()).product_bytes as f64
    }

    /// The cost of the engine for a channel.
    pub(crate) fn of(map: &MapConfig, data: ChannelData) -> Self {
        match map.engine {
            EngineKind::Pixel if map.is_matrix_free() => Self::matrix_free(map, data),
            EngineKind::Pixel | EngineKind::Auto => Self::pixel(map),
            EngineKind::Harmonic if map.refine.is_on() => Self::refined(map, data),
            EngineKind::Harmonic => Self::harmonic(map, data),
        }
    }

    fn pixel(map: &MapConfig) -> Self {
        let nside = map.nside;
        let pixels = pixel_count(nside) as f64;
        // Two rows of B for each visibility, and half of a symmetric matrix.
        let visibility_multiply_adds = pixels * pixels;
        let solution_multiply_adds = pixels.powi(3) / 6.0;
        Self {
            sums_bytes: PixelEngine::memory_bytes(nside) as f64,
            copy_bytes: PixelEngine::memory_bytes(nside) as f64,
            copies_last: false,
            other_bytes: 0.0,
            visibility_s: visibility_multiply_adds / (RANK_K_MULTIPLY_ADDS_PER_S * cores()),
            solution_s: solution_multiply_adds / (CHOLESKY_MULTIPLY_ADDS_PER_S * cores()),
            // Factorised sums have no traces.
            probes_s: 0.0,
            visibility_multiply_adds,
            solution_multiply_adds,
        }
    }

    /// Visibilities in memory, and as many products with their rows as there may be: each makes a row for each visibility, for the map
    /// and its noise map together.
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
            // A map on the way has a copy of them.
            copy_bytes: held,
            copies_last: false,
            other_bytes: RowProducts::memory_bytes(map.nside, SOLVED_TOGETHER, threads) as f64
                + 8.0 * pixels * BASIS_VECTORS[0],
            visibility_s: 0.0,
            solution_s: elements * element_s / cores(),
            probes_s: 0.0,
            visibility_multiply_adds: 0.0,
            // Real and imaginary part, of two vectors, there and back.
            solution_multiply_adds: 8.0 * elements,
        }
    }

    /// The circle's sums and their solution, once a pass; visibilities in memory, and tables of the true rows.
    fn refined(map: &MapConfig, data: ChannelData) -> Self {
        let ChannelData { frequency_hz, visibilities, .. } = data;
        let circle = Self::harmonic(map, data);
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let most = visibilities.min(map.refine.visibilities_max as f64);
        let held = most * REFINED_VISIBILITY_BYTES as f64;
        // While they are summed on the circle, integers and numbers are there together, but not yet all that is made of each visibility.
        let while_summed = circle.sums_bytes - (held - most * SUMMED_VISIBILITY_BYTES);
        let passes = (map.refine.passes_max as f64).min(REFINED_PASSES);
        let l_max = map.degree() as f64;
        let row_s = ROW_S * l_max * (l_max + TAU * u_max);
        // Skies that are seen for each: times the monomials of the antennas' responses; instants of averages.
        let degree = map.antennas.degree();
        let skies = ((degree + 1) * (degree + 2) / 2) as f64;
        let instants = if map.refine.smear_integrations { AVERAGE_INSTANTS } else { 1.0 };
        let interpolation_s = INTERPOLATION_S * skies * instants;
        let pass_s = visibilities * (row_s / VISIBILITIES_PER_ROW + interpolation_s) / cores();
        let coefficients = if degree > 0 { 4.0 * skies } else { 0.0 };
        let held = held + visibilities * coefficients;
        let rows = row_tables_bytes(map.degree(), u_max, rayon::current_num_threads(), degree) as f64;
        // Maps on the way are made from sums on a circle, and a copy of them.
        let is_watched = map.snapshot_every_s > 0.0;
        let on_the_way = if is_watched { circle.sums_bytes + circle.copy_bytes } else { 0.0 };
        Self {
            sums_bytes: held,
            copy_bytes: 0.0,
            copies_last: true,
            other_bytes: circle.other_bytes + circle.sums_bytes + while_summed.max(0.0) + rows + on_the_way,
            // Forth and back, for the map and its noise, and an inner solution of each.
            solution_s: (passes + 1.0) * (INNER_SOLUTION * circle.solution_s + pass_s)
                + visibilities * circle.visibility_s,
            visibility_s: if is_watched { circle.visibility_s } else { 0.0 },
            solution_multiply_adds: (passes + 1.0) * INNER_SOLUTION * circle.solution_multiply_adds,
            ..circle
        }
    }

    fn harmonic(map: &MapConfig, ChannelData { frequency_hz, windows, .. }: ChannelData) -> Self {
        let l_max = map.degree();
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let memory = memory(l_max, u_max, rayon::current_num_threads(), SOLVED_TOGETHER);
        let size = application_size(l_max, u_max);
        let points = size.points as f64;
        // A complex transform takes 5 n log2(n) operations, of which two make a multiply-add.
        let transform_multiply_adds = 2.5 * points * points.log2();
        let application_multiply_adds = size.lines as f64 * TRANSFORMS_PER_LINE * transform_multiply_adds;
        // A window's pairs share a plane, and so the alphas that its weights are spread to; others take no memory.
        let reached = (WINDOW_ALPHAS * windows / points).min(1.0);
        let application_s = application_multiply_adds / (TRANSFORM_MULTIPLY_ADDS_PER_S * cores());
        let vector_bytes = 8.0 * ((l_max + 1) as f64).powi(2);
        let vectors = BASIS_VECTORS[usize::from(map.trace_probes > 0)];
        Self {
            sums_bytes: memory.sums as f64 * reached,
            copy_bytes: memory.sums as f64 * reached,
            // Integers are freed node by node, in pieces too small to go back to the system.
            copies_last: true,
            other_bytes: (memory.tables + memory.workspace) as f64 + vectors * vector_bytes,
            visibility_s: 1.0 / (HARMONIC_VISIBILITIES_PER_S * cores()),
            solution_s: APPLICATIONS * application_s,
            // A beam takes half of what the map and its noise take.
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
    fn rows_made_again_cost_products_times_rows_times_pixels() {
        let data = ChannelData { frequency_hz: 1e7, visibilities: 25_000.0, windows: 100.0 };
        let of = |nside, iterations_max, rows| {
            let map =
                MapConfig { nside, rows, matrix: MatrixKind::Free, iterations_max, ..MapConfig::default() };
            EngineCost::of(&map, data)
        };
        let (few, many) = (of(64, 70, PixelMethod::Centre), of(64, 170, PixelMethod::Centre));
        // With those for W_max, twice as many: all is products.
        assert!((many.solution_s / few.solution_s - 2.0).abs() < 1e-9);
        assert!((few.solution_s / of(32, 70, PixelMethod::Centre).solution_s - 4.0).abs() < 1e-9);
        assert!(of(64, 70, PixelMethod::Average).solution_s > few.solution_s);
        // 9.7 GB of matrix (`PIXEL_ENGINE_NSIDE_MAX`) against 400 bytes a visibility.
        let held = EngineCost::of(&MapConfig { nside: 64, ..MapConfig::default() }, data);
        assert!(held.sums_bytes > 9e9 && few.sums_bytes < 2e7 && few.other_bytes < 1e9);
    }
}
