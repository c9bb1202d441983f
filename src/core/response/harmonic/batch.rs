//! Batches of runs: groups of runs that share alphas, their projection, and their visibilities.

use std::f64::consts::{FRAC_PI_2, TAU};

use num_complex::{Complex32, Complex64};
use rayon::prelude::*;

use super::HarmonicError;
use super::PairState;
use super::blocked::{BLOCK_NODES, PATTERN_LANES};
use super::forward::{
    ALPHAS_MAX, AlphaPart, ORDER_LANES, OrderBlock, Projection, RunGroup, RunPlan, project,
};
use super::gridding_kernel::LANES;
use super::model::{ALPHA_BLOCK, ALPHA_TOLERANCE, BLOCKS_KEPT, HarmonicModel, TERMS};
use super::rotation::order_count;
use super::runs::{Run, split};
use crate::numerics::chebyshev;
use crate::units::arithmetic::sinc;

/// Maximum number of runs in a batch, which bounds its memory.
const RUNS_MAX: usize = 256;
const ALPHAS_TARGET: usize = 4;

/// Groups of runs and their plans; runs are indexed within the batch.
pub(super) struct Batch {
    runs: Vec<Run>,
    groups: Vec<RunGroup>,
    plans: Vec<RunPlan>,
    /// Blocks of alphas that the groups need.
    blocks: Vec<usize>,
}

#[derive(Clone, Copy)]
struct AlphaRange {
    low: f64,
    high: f64,
}

impl Batch {
    /// Forms a batch from the first runs of `order` (sorted by alpha), and returns it with their number.
    pub(super) fn new(model: &HarmonicModel, runs: &[Run], order: &[usize]) -> (Self, usize) {
        let mut batch = Self { runs: Vec::new(), groups: Vec::new(), plans: Vec::new(), blocks: Vec::new() };
        let mut taken = 0;
        while taken < order.len() && taken < RUNS_MAX {
            let (range, count) = next_range(model, runs, &order[taken..]);
            let (mut group, needed) = batch.new_group(model, range);
            if needed.len() > BLOCKS_KEPT && taken > 0 {
                break;
            }
            batch.blocks = needed;
            for &run in &order[taken..taken + count] {
                let plan = plan_run(model, &runs[run], range, group.alphas.len());
                group.runs.push(batch.runs.len());
                group.blocks.extend(plan.first_block..plan.first_block + plan.blocks);
                batch.plans.push(plan);
                batch.runs.push(runs[run]);
            }
            group.blocks.sort_unstable();
            group.blocks.dedup();
            batch.groups.push(group);
            taken += count;
        }
        (batch, taken)
    }

    /// Creates a group without runs, and lists the blocks of alphas that the batch then needs.
    fn new_group(&self, model: &HarmonicModel, range: AlphaRange) -> (RunGroup, Vec<usize>) {
        let mut needed = self.blocks.clone();
        let half = 0.5 * (range.high - range.low);
        let terms = alpha_terms(model, half);
        let per_radian = model.alpha.count as f64 / TAU;
        let alphas = chebyshev::points(terms)
            .into_iter()
            .map(|t| {
                let x = (0.5 * (range.high + range.low) + half * t).rem_euclid(TAU) * per_radian;
                let (first, lanes) = model.alpha.kernel.spread(x);
                let mut parts: Vec<AlphaPart> = Vec::new();
                for (k, &weight) in (first..).zip(&lanes[..model.alpha.kernel.width()]) {
                    let place = k.rem_euclid(model.alpha.count as i64) as usize;
                    let (block, first) = (place / ALPHA_BLOCK, place % ALPHA_BLOCK);
                    match parts.last_mut().filter(|part| part.block == block && first > 0) {
                        Some(part) => part.weights.push(weight),
                        None => parts.push(AlphaPart { block, first, weights: vec![weight] }),
                    }
                    if !needed.contains(&block) {
                        needed.push(block);
                    }
                }
                parts
            })
            .collect();
        (RunGroup { alphas, runs: Vec::new(), blocks: Vec::new() }, needed)
    }
}

/// Number of alphas that interpolate over an interval of this half width.
fn alpha_terms(model: &HarmonicModel, half: f64) -> usize {
    let tolerance = ALPHA_TOLERANCE * model.settings().tolerance;
    let h = half * model.sky.l_max() as f64;
    chebyshev::terms_for(h, tolerance).unwrap_or(ALPHAS_MAX).min(ALPHAS_MAX)
}

/// Finds how many of the first runs of `order` can share alphas, and the interval that they cover.
fn next_range(model: &HarmonicModel, runs: &[Run], order: &[usize]) -> (AlphaRange, usize) {
    let reach = chebyshev::h_max(ALPHAS_TARGET, ALPHA_TOLERANCE * model.settings().tolerance)
        / model.sky.l_max().max(1) as f64;
    let range = |k: usize| {
        let run = &runs[k];
        let middle = (run.node.centre - FRAC_PI_2).rem_euclid(TAU);
        AlphaRange { low: middle - run.node.half.abs(), high: middle + run.node.half.abs() }
    };
    let mut whole = range(order[0]);
    let mut count = 1;
    for &k in order[1..].iter().take(RUNS_MAX / 4) {
        let next = range(k);
        let joined = AlphaRange { low: whole.low.min(next.low), high: whole.high.max(next.high) };
        if joined.high - joined.low > 2.0 * reach {
            break;
        }
        whole = joined;
        count += 1;
    }
    (whole, count)
}

fn plan_run(model: &HarmonicModel, run: &Run, range: AlphaRange, alphas: usize) -> RunPlan {
    let tolerance = model.settings().tolerance;
    let fringe_phase = TAU * run.u.half.abs() + model.sky.l_max() as f64 * run.node.half.abs();
    let terms = chebyshev::terms_for(fringe_phase, tolerance).unwrap_or(TERMS).min(TERMS);
    let grid = model.patterns.grid;
    let node = |u: f64| (u - grid.first) / grid.step;
    let reach = 0.5 * model.u_kernel.width() as f64;
    let first_node = (node(run.u.centre - run.u.half.abs()) - reach).ceil().max(0.0) as usize;
    let last_node = (node(run.u.centre + run.u.half.abs()) + reach).floor().max(0.0) as usize;
    let first_block = first_node / BLOCK_NODES;
    let blocks = last_node.min(grid.count - 1) / BLOCK_NODES + 1 - first_block;
    let middle = 0.5 * (range.high + range.low);
    let half = (0.5 * (range.high - range.low)).max(1e-300);
    let run_middle = (run.node.centre - FRAC_PI_2).rem_euclid(TAU);
    let mut weights = vec![[0.0_f64; PATTERN_LANES]; terms * blocks * alphas];
    let analysis = chebyshev::analysis(terms);
    for (k, tau) in chebyshev::points(terms).into_iter().enumerate() {
        let u = node(run.u.centre + run.u.half * tau) - (first_block * BLOCK_NODES) as f64;
        let kernel: Vec<f64> =
            (0..blocks * BLOCK_NODES).map(|n| model.u_kernel.value(n as f64 - u)).collect();
        let at = ((run_middle + run.node.half * tau - middle) / half).clamp(-1.0, 1.0);
        for (a, lagrange) in chebyshev::weights_at(alphas, at).into_iter().enumerate() {
            for (n, row) in analysis.iter().enumerate() {
                for (block, kernel) in kernel.chunks_exact(BLOCK_NODES).enumerate() {
                    let factor = row[k] * lagrange;
                    let weights = &mut weights[(n * blocks + block) * alphas + a];
                    for (lane, weight) in weights.iter_mut().enumerate() {
                        *weight += factor * kernel[lane / 2];
                    }
                }
            }
        }
    }
    let weights = weights.into_iter().map(|row| row.map(|w| w as f32)).collect();
    RunPlan { first_block, blocks, terms, weights }
}

impl HarmonicModel {
    /// Predicts the visibilities (K sr) of `states`, in order.
    ///
    /// States may be in any order. Consecutive integrations of a pair are fast, and many pairs over several observing windows
    /// in one call are fastest. At a baseline of zero the result is the auto-correlation power `Int T S A dn`.
    ///
    /// # Errors
    /// [`HarmonicError::NotFinite`], [`HarmonicError::Baseline`] beyond the longest baseline,
    /// [`HarmonicError::Lengths`].
    pub fn visibilities(
        &mut self,
        states: &[PairState],
        values: &mut [Complex64],
    ) -> Result<(), HarmonicError> {
        if states.len() != values.len() {
            return Err(HarmonicError::Lengths { states: states.len(), values: values.len() });
        }
        self.check_states(states)?;
        let runs = split(states, self.run_limits());
        let mut order: Vec<usize> = (0..runs.len()).collect();
        let alpha = |k: &usize| (runs[*k].node.centre - FRAC_PI_2).rem_euclid(TAU);
        order.sort_by(|a, b| alpha(a).total_cmp(&alpha(b)).then(a.cmp(b)));
        let mut rest = &order[..];
        while !rest.is_empty() {
            let (batch, taken) = Batch::new(self, &runs, rest);
            for (run, piece) in rest[..taken].iter().zip(self.evaluate(states, &batch)) {
                let first = runs[*run].first;
                values[first..first + piece.len()].copy_from_slice(&piece);
            }
            rest = &rest[taken..];
        }
        Ok(())
    }

    /// Predicts the visibilities of each run of a batch.
    pub(super) fn evaluate(&mut self, states: &[PairState], batch: &Batch) -> Vec<Vec<Complex64>> {
        self.rotate_sky(&batch.blocks);
        let l_max = self.sky.l_max();
        let groups: Vec<RunGroup> = batch.groups.iter().map(|group| self.with_sky_indices(group)).collect();
        let mut offsets = vec![0];
        for plan in &batch.plans {
            offsets.push(offsets[offsets.len() - 1] + plan.terms);
        }
        let tasks: Vec<OrderBlock> = (0..order_count(l_max))
            .step_by(ORDER_LANES)
            .flat_map(|first| [0, 1].map(|parity| OrderBlock { parity, first }))
            .filter(|block| block.order(0) <= l_max)
            .collect();
        let inputs = Projection {
            l_max,
            skies: &self.skies,
            patterns: &self.patterns,
            groups: &groups,
            plans: &batch.plans,
            offsets: &offsets,
        };
        let projected: Vec<Vec<f32>> = tasks.par_iter().map(|&task| project(task, &inputs)).collect();
        batch
            .runs
            .par_iter()
            .zip(&batch.plans)
            .enumerate()
            .map(|(k, (run, plan))| {
                let rows = self.gamma_rows(&tasks, &projected, offsets[k], plan.terms, run.span);
                self.interpolate(&rows, plan.terms, run, &states[run.first..run.first + run.len])
            })
            .collect()
    }

    /// Replaces the blocks of alphas of a group by their indices among the rotated skies.
    fn with_sky_indices(&self, group: &RunGroup) -> RunGroup {
        let mut group = group.clone();
        for alpha in group.alphas.iter_mut().flatten() {
            alpha.block = self.blocks.iter().position(|b| *b == alpha.block).unwrap_or_default();
        }
        group
    }

    /// Transforms Chebyshev coefficients to the grid in gamma: one row per term, with its first values repeated at its end.
    fn gamma_rows(
        &self,
        tasks: &[OrderBlock],
        projected: &[Vec<f32>],
        offset: usize,
        terms: usize,
        span: f64,
    ) -> Vec<Complex32> {
        let (l_max, count) = (self.sky.l_max(), self.gamma.count);
        let mut rows = vec![Complex32::ZERO; terms * (count + LANES)];
        let mut scratch = vec![Complex32::ZERO; self.fft.get_inplace_scratch_len()];
        for (term, row) in rows.chunks_exact_mut(count + LANES).enumerate() {
            for (task, values) in tasks.iter().zip(projected) {
                let place = 4 * ORDER_LANES * (offset + term);
                let lanes = values[place..place + 4 * ORDER_LANES].chunks_exact(4);
                for (lane, value) in lanes.enumerate() {
                    let mu = task.order(lane);
                    if mu > l_max {
                        break;
                    }
                    let factor = (self.gamma.correction[mu] * sinc(0.5 * mu as f64 * span)) as f32;
                    row[mu] = Complex32::new(value[0], value[1]) * factor;
                    if mu > 0 {
                        row[count - mu] = Complex32::new(value[2], -value[3]) * factor;
                    }
                }
            }
            let (circle, repeated) = row.split_at_mut(count);
            self.fft.process_with_scratch(circle, &mut scratch);
            repeated.copy_from_slice(&circle[..LANES]);
        }
        rows
    }

    /// Interpolates the visibilities of a run's states from its rows.
    fn interpolate(
        &self,
        rows: &[Complex32],
        terms: usize,
        run: &Run,
        states: &[PairState],
    ) -> Vec<Complex64> {
        let count = self.gamma.count;
        let per_radian = count as f64 / TAU;
        states
            .iter()
            .map(|state| {
                let x = (state.phase_rad + FRAC_PI_2) * per_radian;
                let (first, lanes) = self.gamma.kernel.spread(x);
                let first = first.rem_euclid(count as i64) as usize;
                let polynomials = chebyshev::polynomials(terms, run.tau(state.phase_rad));
                let mut sums = [Complex32::ZERO; LANES];
                for (row, t) in rows.chunks_exact(count + LANES).zip(polynomials) {
                    let t = t as f32;
                    for (sum, value) in sums.iter_mut().zip(&row[first..first + LANES]) {
                        *sum += value * t;
                    }
                }
                let total: Complex32 = sums.iter().zip(lanes).map(|(s, w)| s * w).sum();
                Complex64::new(f64::from(total.re), f64::from(total.im))
            })
            .collect()
    }
}
