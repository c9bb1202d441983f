//! What the normal equations of a channel cost, measured on this machine with a small engine of the same kind.

use std::time::Instant;

use num_complex::{Complex32, Complex64};
use rustfft::FftPlanner;

use super::plan::Plan;
use crate::accumulation::harmonic::{
    HarmonicEngine, HarmonicSetup, SPREAD_MULTIPLY_ADDS, application_size, memory, orbit_of,
};
use crate::accumulation::{EngineKind, NormalEngine, PixelEngine, PixelSetup};
use crate::frames::PlacedVisibilities;
use crate::sky::healpix::pixel_count;
use crate::units::Pair;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Visibilities that are timed.
const SAMPLES: usize = 512;
/// Greatest nside that is measured in a fraction of a second and a fraction of a gigabyte.
const NSIDE_MEASURED: usize = 16;
/// Greatest degree likewise.
const DEGREE_MEASURED: usize = 24;
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
    /// Memory besides the sums, bytes: tables and what threads work in.
    pub(super) other_bytes: f64,
    /// Time of a visibility, s.
    pub(super) visibility_s: f64,
    /// Time of a solution, s.
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
            EngineKind::Pixel => self.pixel_cost(frequency_hz),
            EngineKind::Harmonic => self.harmonic_cost(frequency_hz),
        }
    }

    /// A few visibilities of the shortest pair.
    fn samples(&self, frequency_hz: f64) -> PlacedVisibilities {
        let time_s = self.windows.first().map_or(0.0, |window| window.start.seconds());
        let at = |k: usize| time_s + k as f64;
        let positions = |n| (0..SAMPLES).map(|k| self.array.position_m(n, at(k))).collect::<Vec<_>>();
        PlacedVisibilities {
            frequency_hz,
            pair: Pair { i: 0, j: 1 },
            time_s: (0..SAMPLES).map(at).collect(),
            r_i_m: positions(0),
            r_j_m: positions(1),
            value_k_sr: vec![Complex64::ONE; SAMPLES],
            weight: vec![1.0; SAMPLES],
            ..PlacedVisibilities::default()
        }
    }

    fn pixel_cost(&self, frequency_hz: f64) -> EngineCost {
        let map = &self.config.map;
        let nside = map.nside.min(NSIDE_MEASURED);
        let setup = PixelSetup {
            nside,
            frequency_hz,
            method: map.rows,
            moon_radius_m: self.instrument.moon_radius_m,
            response: self.instrument.response,
            companion_seed: 0,
            weight_max: 1.0,
        };
        let placed = self.samples(frequency_hz);
        let measured_s = PixelEngine::new(setup).map_or(f64::NAN, |mut engine| time_of(&mut engine, &placed));
        let pixels = pixel_count(map.nside) as f64;
        // The work of a visibility grows as the number of pixels squared.
        let growth = (pixels / pixel_count(nside) as f64).powi(2);
        let visibility_s = measured_s * growth / SAMPLES as f64;
        let solution_multiply_adds = pixels.powi(3) / 6.0;
        EngineCost {
            sums_bytes: PixelEngine::memory_bytes(map.nside) as f64,
            other_bytes: 0.0,
            visibility_s,
            // A Cholesky factorisation runs at about the rate of the rank-k updates, one core of it at half.
            solution_s: 2.0 * solution_multiply_adds * visibility_s / (pixels * pixels),
            visibility_multiply_adds: pixels * pixels,
            solution_multiply_adds,
        }
    }

    fn harmonic_cost(&self, frequency_hz: f64) -> EngineCost {
        let map = &self.config.map;
        let l_max = map.degree();
        let u_max = map.baseline_m_max(frequency_hz) * frequency_hz / SPEED_OF_LIGHT_M_S;
        let memory = memory(l_max, u_max, rayon::current_num_threads());
        let placed = self.samples(frequency_hz);
        let measured = l_max.min(DEGREE_MEASURED);
        let engine = orbit_of(&placed, map.limits).and_then(|orbit| {
            let setup = HarmonicSetup {
                l_max: measured,
                frequency_hz,
                baseline_m_max: map.baseline_m_max(frequency_hz),
                moon_radius_m: self.instrument.moon_radius_m,
                response: self.instrument.response,
                orbit,
                companion_seed: 0,
                weight_max: 1.0,
            };
            HarmonicEngine::new(setup).ok()
        });
        let visibility_s =
            engine.map_or(f64::NAN, |mut engine| time_of(&mut engine, &placed) / SAMPLES as f64);
        let size = application_size(l_max, u_max);
        let application_s = size.lines as f64 * TRANSFORMS_PER_LINE * transform_s(size.points)
            / rayon::current_num_threads() as f64;
        EngineCost {
            sums_bytes: memory.sums as f64,
            other_bytes: (memory.tables + memory.workspace) as f64,
            visibility_s,
            solution_s: APPLICATIONS * application_s,
            visibility_multiply_adds: SPREAD_MULTIPLY_ADDS,
            solution_multiply_adds: APPLICATIONS * size.matrix_multiply_adds,
        }
    }
}

/// Time of one transform of `points`, s, on one core.
fn transform_s(points: usize) -> f64 {
    const REPEATS: usize = 400;
    let plan = FftPlanner::<f32>::new().plan_fft_forward(points);
    let mut line = vec![Complex32::ONE; points];
    let mut scratch = vec![Complex32::ZERO; plan.get_inplace_scratch_len()];
    let since = Instant::now();
    for _ in 0..REPEATS {
        plan.process_with_scratch(&mut line, &mut scratch);
        line.fill(Complex32::ONE);
    }
    since.elapsed().as_secs_f64() / REPEATS as f64
}

/// Time to add, s, the second time: the first makes tables and touches memory.
fn time_of<E: NormalEngine>(engine: &mut E, placed: &PlacedVisibilities) -> f64 {
    let warmed = engine.add(placed).is_ok();
    engine.flush();
    let since = Instant::now();
    let added = warmed && engine.add(placed).is_ok();
    engine.flush();
    if added { since.elapsed().as_secs_f64() } else { f64::NAN }
}
