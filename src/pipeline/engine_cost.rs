//! What the normal equations of a channel cost: memory, operations, and an estimate of the time.

use super::plan::Plan;
use super::rates::{
    CHOLESKY_MULTIPLY_ADDS_PER_S, HARMONIC_VISIBILITIES_PER_S, RANK_K_MULTIPLY_ADDS_PER_S,
    TRANSFORM_MULTIPLY_ADDS_PER_S, cores,
};
use crate::accumulation::harmonic::{SPREAD_MULTIPLY_ADDS, application_size, memory};
use crate::accumulation::{EngineKind, PixelEngine};
use crate::sky::healpix::pixel_count;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Products with BtN^-1B in one harmonic solution: some 15 for W_max, 25 each for the map and the noise map.
const APPLICATIONS: f64 = 65.0;

/// Transforms that take as long as all that is done to a line of phases in one product with BtN^-1B: two of them, the
/// products with the weights, and the way from the matrix products and back (benches/harmonic).
const TRANSFORMS_PER_LINE: f64 = 4.0;

/// Cost of one channel's engine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct EngineCost {
    /// Memory of the sums, bytes.
    pub(super) sums_bytes: f64,
    /// Memory besides the sums, bytes: tables and workspace.
    pub(super) other_bytes: f64,
    /// Estimated time of a visibility, s.
    pub(super) visibility_s: f64,
    /// Estimated time of a solution, s.
    pub(super) solution_s: f64,
    /// Multiply-adds of a visibility.
    pub(super) visibility_multiply_adds: f64,
    /// Multiply-adds of a solution.
    pub(super) solution_multiply_adds: f64,
}

impl Plan {
    /// The cost of the engine for a channel at `frequency_hz`.
    pub(super) fn engine_cost(&self, frequency_hz: f64) -> EngineCost {
        match self.config.map.engine {
            EngineKind::Pixel => self.pixel_cost(),
            EngineKind::Harmonic => self.harmonic_cost(frequency_hz),
        }
    }

    fn pixel_cost(&self) -> EngineCost {
        let nside = self.config.map.nside;
        let pixels = pixel_count(nside) as f64;
        // Two rows of B for each visibility, and half of a symmetric matrix.
        let visibility_multiply_adds = pixels * pixels;
        let solution_multiply_adds = pixels.powi(3) / 6.0;
        EngineCost {
            sums_bytes: PixelEngine::memory_bytes(nside) as f64,
            other_bytes: 0.0,
            visibility_s: visibility_multiply_adds / (RANK_K_MULTIPLY_ADDS_PER_S * cores()),
            solution_s: solution_multiply_adds / (CHOLESKY_MULTIPLY_ADDS_PER_S * cores()),
            visibility_multiply_adds,
            solution_multiply_adds,
        }
    }

    fn harmonic_cost(&self, frequency_hz: f64) -> EngineCost {
        let map = &self.config.map;
        let l_max = map.degree();
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let memory = memory(l_max, u_max, rayon::current_num_threads());
        let size = application_size(l_max, u_max);
        let points = size.points as f64;
        // A complex transform takes 5 n log2(n) operations, of which two make a multiply-add.
        let transform_multiply_adds = 2.5 * points * points.log2();
        let application_multiply_adds = size.lines as f64 * TRANSFORMS_PER_LINE * transform_multiply_adds;
        EngineCost {
            sums_bytes: memory.sums as f64,
            other_bytes: (memory.tables + memory.workspace) as f64,
            visibility_s: 1.0 / (HARMONIC_VISIBILITIES_PER_S * cores()),
            solution_s: APPLICATIONS * application_multiply_adds / (TRANSFORM_MULTIPLY_ADDS_PER_S * cores()),
            visibility_multiply_adds: SPREAD_MULTIPLY_ADDS,
            solution_multiply_adds: APPLICATIONS * size.matrix_multiply_adds,
        }
    }
}
