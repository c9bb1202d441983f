//! Estimates of what a map on one circular orbit takes, and of its sums that are shared or made in parts.

use super::grid::ERROR_PAIR_MULTIPLY_ADDS;
use super::setup::error_pair_share;
use super::whole::{EVEN_SHARE, WHOLE_UNKNOWNS_MAX};
use super::{MONTH_S, MONTHS_MAX, SPREAD_MULTIPLY_ADDS, application_size, memory, shared_size};
use crate::imaging::cost::{
    BASIS_VECTORS, ChannelData, EngineCost, ITERATIONS, iterations, over_maps, solved_together,
};
use crate::imaging::rates::{HARMONIC_VISIBILITIES_PER_S, TRANSFORM_MULTIPLY_ADDS_PER_S, cores};
use crate::imaging::{MapConfig, Method, RegulariserChoice};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Products of a final map with R from the data in units of those with a given R: rounds for the sky's power, its errors and their samples.
/// Intermediate maps take about as many as with a given R.
const DATA_PRODUCTS: f64 = 2.0;

/// Maps with products of their own in each iteration: the map and its noise map.
const SOLVED: f64 = 2.0;

/// Products with BtN^-1B for one random probe of the traces (at most 300): a guess for epsilon = 1e-4, not measured.
const PROBE_APPLICATIONS: f64 = 40.0;

/// Alphas that the weights of one observation window reach, of those that no other has reached: 2.5 to 7.5, from the peak memory of 17 to 121
/// windows at nside 8, 16 and 32.
const WINDOW_ALPHAS: f64 = 4.5;

/// Time of all work on a line of phases in one product with BtN^-1B, in units of a Fourier transform: two transforms, the products with the
/// weights, and copying from and to the matrix products (benches/harmonic).
const TRANSFORMS_PER_LINE: f64 = 4.0;

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
        let is_divisible = map.method() == Method::Harmonic;
        let parts_max = if is_divisible { shared_size(map.degree()).blocks } else { 1 };
        let counts = (0..).map(|k| 1_usize << k).take_while(|parts| *parts <= parts_max);
        counts.into_iter().find(|&parts| needed(self.in_parts(parts, map)) <= limit_bytes)
    }

    /// Bytes that a rank sends to the others in all solutions.
    pub fn reduced_bytes(&self, map: &MapConfig) -> f64 {
        self.products * shared_size(map.degree()).product_bytes as f64
    }
}

/// Products for a column of the whole matrix beside the share of alphas that have data: spreading makes some of them more, and the rest is
/// factorisations. Processor times of the matrix at nside 16 and 10 MHz, a quiet Xeon with AVX-512: 13 s for 7 days, 33 for 91, 41 for 182.
const COLUMN_SHARE: f64 = 0.1;

/// Matrices of this size in memory at once: the matrix, its eigenvectors, what is made of both, a factor and its inverse.
const MATRICES: f64 = 6.0;

/// Months of a mission in which bodies that move have columns.
fn mover_months(duration_s: f64) -> f64 {
    (duration_s / MONTH_S).ceil().clamp(1.0, MONTHS_MAX as f64)
}

/// Products for bodies that move, if the map and its noise map take `last`, and the whole matrix `whole`: columns, data and noise are solved for,
/// and each column is projected; the largest eigenvalue, or the sky's power and the matrix, are found once more.
fn mover_products(map: &MapConfig, (duration_s, last): (f64, f64), whole: f64) -> f64 {
    if map.movers.is_empty() {
        return 0.0;
    }
    let columns = map.movers.len() as f64 * mover_months(duration_s);
    let rounds = if map.regulariser() == RegulariserChoice::Data { 2.0 } else { 1.0 };
    columns + rounds * (last + (columns + SOLVED) / SOLVED * last) + whole
}

/// The cost of sums on one circular orbit.
pub(in crate::imaging) fn harmonic_cost(map: &MapConfig, data: ChannelData) -> EngineCost {
    let ChannelData { frequency_hz, windows, node_turns, error_draws, duration_s, .. } = data;
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
    let share = reached.min(node_turns);
    let application_s = application_multiply_adds / (TRANSFORM_MULTIPLY_ADDS_PER_S * cores());
    let of_map =
        |fraction: f64| ITERATIONS + SOLVED * iterations(fraction * windows).min(map.iterations_max as f64);
    let [intermediate, last] = over_maps(data, of_map);
    let from_data = map.regulariser() == RegulariserChoice::Data;
    let unknowns = ((l_max + 1) as f64).powi(2);
    let is_whole = from_data && share < EVEN_SHARE && unknowns <= WHOLE_UNKNOWNS_MAX as f64;
    // A product takes the time of the alphas that have data.
    let columns = if is_whole { unknowns * (share + COLUMN_SHARE).min(1.0) } else { 0.0 };
    let draws = if from_data { error_draws as f64 } else { 0.0 };
    let products = columns
        + intermediate
        + if from_data { DATA_PRODUCTS } else { 1.0 } * last
        + map.trace_probes as f64 * PROBE_APPLICATIONS
        // A beam takes half as many as the map and its noise map.
        + 0.5 * last * map.beams_deg.len() as f64
        // A draw takes as many as the map.
        + draws / SOLVED * last
        + mover_products(map, (duration_s, last), columns);
    let pairs = 0.5 * error_draws as f64;
    let of_movers = if map.movers.is_empty() { 0.0 } else { 1.0 };
    // Of the alphas that two months reach both have a row.
    let month_rows = reached + mover_months(duration_s) * WINDOW_ALPHAS / points;
    let of_pairs = error_pair_share(l_max, u_max) * (pairs * reached + of_movers * month_rows);
    let sums_bytes = memory.sums as f64 * (reached + of_pairs);
    let visibility_multiply_adds = SPREAD_MULTIPLY_ADDS + (pairs + of_movers) * ERROR_PAIR_MULTIPLY_ADDS;
    let vector_bytes = 8.0 * unknowns;
    let matrix_bytes = if is_whole { MATRICES * vector_bytes * unknowns } else { 0.0 };
    // Right-hand sides and solutions.
    let column_vectors = 2.0 * (map.movers.len() as f64 * mover_months(duration_s) + SOLVED);
    let vectors = BASIS_VECTORS[usize::from(map.trace_probes > 0)];
    EngineCost {
        sums_bytes,
        // The final map is solved in the memory of the sums, whose integers are freed node by node.
        copy_bytes: sums_bytes,
        other_bytes: (memory.tables + memory.workspace) as f64
            + (vectors + draws + of_movers * column_vectors) * vector_bytes
            + matrix_bytes,
        visibility_s: visibility_multiply_adds
            / SPREAD_MULTIPLY_ADDS
            / (HARMONIC_VISIBILITIES_PER_S * cores()),
        solving_s: products * application_s,
        visibility_multiply_adds,
        solving_multiply_adds: products * size.matrix_multiply_adds,
        products,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::{EngineKind, MapConfig};

    /// Processor times of runs less those of the same with the identity (which takes no matrix, 5 s), on a quiet Xeon with AVX-512: the rates are those
    /// of any machine, so within a factor of two.
    #[test]
    fn the_matrix_of_a_short_mission_takes_what_it_took() {
        let map = MapConfig { engine: EngineKind::Harmonic, ..MapConfig::default() };
        for (days, windows, measured_s) in [(7.0, 73.0, 13.4), (91.0, 95.0, 33.0), (182.0, 190.0, 41.0)] {
            let of_turns = |node_turns: f64| {
                let data = ChannelData {
                    frequency_hz: 1e7,
                    visibilities: 29_000.0,
                    windows,
                    node_turns,
                    duration_s: days * 86_400.0,
                    every_nth: 1.0,
                    solutions: 1,
                    limb_range_rad: 0.0,
                    error_draws: 0,
                };
                harmonic_cost(&map, data).solving_s * cores()
            };
            let matrix_s = of_turns(days / 474.8) - of_turns(1.0);
            assert!((0.5..2.0).contains(&(matrix_s / measured_s)), "{days} d: {matrix_s} {measured_s}");
        }
    }
}
