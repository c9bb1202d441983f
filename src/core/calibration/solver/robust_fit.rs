//! Robust fit: rounds of Gauss-Newton and outlier rejection, with the daughters that deliver signal.

use rayon::prelude::*;

use super::config::SolverConfig;
use super::detect::{
    DroppedGains, OwnGain, SignalPresence, best_reference, dropped_gains, is_pair_used, solve_own_gains,
};
use super::layout::{ParameterLayout, ParameterValues};
use super::newton::NewtonFit;
use super::robust::mark_outliers;
use super::stability::Residuals;
use super::sums::{ModelledBlock, PairSums};

/// Relative change of a pair's variance factor below which a round has converged.
const VARIANCE_FACTOR_TOLERANCE: f64 = 0.02;

/// Maximum number of rounds of outlier rejection.
const OUTLIER_ROUNDS: u32 = 3;

/// Maximum number of changes of the set of gains that are solved for.
const SET_CHANGES_MAX: usize = 3;

/// An interval, with the settings for fitting its data.
#[derive(Clone, Copy)]
pub(super) struct Interval<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) frequencies_hz: &'a [f64],
    pub(super) satellites: usize,
    pub(super) span_s: [f64; 2],
    /// Initial position offsets of the daughters, m.
    pub(super) position_m: &'a [[f64; 3]],
}

/// Result of a robust fit.
pub(super) struct RobustFit {
    pub(super) layout: ParameterLayout,
    pub(super) newton: NewtonFit,
    /// Sums of all blocks.
    pub(super) sums: Vec<PairSums>,
    /// Variance factor of each block: reduced chi-square where above one, else one.
    pub(super) variance_factors: Vec<f64>,
    /// Whether each block is used: both of its gains are in the solution.
    pub(super) is_pair_used: Vec<bool>,
    /// Whether each gain is left out of the solution; by channel, then daughter.
    pub(super) dropped_gains: DroppedGains,
    /// Each gain by itself, from its own data and the gains of the other daughters.
    pub(super) own_gains: Vec<OwnGain>,
    /// Sum of squared residuals and their number, by block.
    pub(super) chi_squares: Vec<(f64, f64)>,
}

impl Interval<'_> {
    /// Fits the blocks and marks their outliers. Phases are relative to daughter `wanted_reference`, by default to
    /// the configured reference unless another daughter is detected in more channels.
    pub(super) fn fit(&self, blocks: &mut [ModelledBlock], wanted_reference: Option<usize>) -> RobustFit {
        let Self { config, span_s, position_m, .. } = *self;
        let mut layout = ParameterLayout::new(config, self.satellites, self.frequencies_hz);
        let mut variance_factors = vec![1.0; blocks.len()];
        blocks.par_iter_mut().for_each(|block| block.is_out.fill(false));
        let mut sums = sums_of(blocks, span_s, &layout, &variance_factors);
        let mut values = layout.starting_values(&sums, position_m);
        let mut is_dropped = vec![false; layout.satellites * layout.channels()];
        let mut own_gains = solve_own_gains(config, &layout, &values, &sums, &is_dropped);
        // Once more without the gains that are not detected.
        is_dropped = dropped_gains(&layout, &own_gains);
        own_gains = solve_own_gains(config, &layout, &values, &sums, &is_dropped);
        is_dropped = dropped_gains(&layout, &own_gains);
        let configured = layout.reference;
        layout.reference =
            wanted_reference.unwrap_or_else(|| best_reference(&layout, &own_gains, configured));
        if layout.reference != configured {
            values = layout.starting_values(&sums, position_m);
        }
        let mut set_changes = 0;
        loop {
            reset_dropped(&mut values, &is_dropped);
            let (newton, chi_squares) =
                self.rounds(&layout, values, (&mut *blocks, &mut sums, &mut variance_factors), &is_dropped);
            own_gains = solve_own_gains(config, &layout, &newton.values, &sums, &is_dropped);
            let next_dropped = dropped_gains(&layout, &own_gains);
            set_changes += 1;
            if next_dropped == is_dropped || set_changes == SET_CHANGES_MAX {
                let is_pair_used = sums.iter().map(|sums| is_pair_used(&layout, &is_dropped, sums)).collect();
                let dropped_gains = is_dropped;
                return RobustFit {
                    layout,
                    newton,
                    sums,
                    variance_factors,
                    is_pair_used,
                    dropped_gains,
                    own_gains,
                    chi_squares,
                };
            }
            values = newton.values;
            for (k, own_gain) in
                own_gains.iter().enumerate().filter(|(k, _)| is_dropped[*k] && !next_dropped[*k])
            {
                values.amplitude[k] = own_gain.gain.norm().max(config.dead_amplitude).ln();
                values.phase[k] = own_gain.gain.arg();
            }
            is_dropped = next_dropped;
        }
    }

    fn rounds(
        &self,
        layout: &ParameterLayout,
        values: ParameterValues,
        (blocks, sums, variance_factors): (&mut [ModelledBlock], &mut Vec<PairSums>, &mut Vec<f64>),
        dropped_gains: &[bool],
    ) -> (NewtonFit, Vec<(f64, f64)>) {
        let Self { config, span_s, .. } = *self;
        let used_sums = |sums: &[PairSums]| -> Vec<PairSums> {
            sums.iter().filter(|sums| is_pair_used(layout, dropped_gains, sums)).copied().collect()
        };
        let iterations_max = config.iterations_max as usize;
        let mut newton = layout.minimise(values, &used_sums(sums), None, iterations_max);
        let mut chi_squares = vec![(0.0, 0.0); blocks.len()];
        for round in 0..=OUTLIER_ROUNDS {
            let mark_outliers =
                |((block, variance_factor), sums): ((&mut ModelledBlock, &mut f64), &PairSums)| {
                    if !is_pair_used(layout, dropped_gains, sums) {
                        return ((0.0, 0.0), false);
                    }
                    let before = (block.is_out.clone(), *variance_factor);
                    let (gain, u) = layout.pair(&newton.values, sums.channel, sums.pair);
                    let chi_square =
                        mark_outliers(block, span_s, config.outlier_sigma, gain, &u, variance_factor);
                    let changed = block.is_out != before.0
                        || (*variance_factor / before.1 - 1.0).abs() > VARIANCE_FACTOR_TOLERANCE;
                    (chi_square, changed)
                };
            let judged: Vec<((f64, f64), bool)> =
                blocks.par_iter_mut().zip(&mut *variance_factors).zip(&*sums).map(mark_outliers).collect();
            let changed = judged.iter().any(|(_, changed)| *changed);
            chi_squares = judged.into_iter().map(|(chi_square, _)| chi_square).collect();
            if !changed || round == OUTLIER_ROUNDS {
                break;
            }
            *sums = sums_of(blocks, span_s, layout, variance_factors);
            newton = layout.minimise(newton.values, &used_sums(sums), None, iterations_max);
        }
        (newton, chi_squares)
    }

    /// Residuals of a fit; with a `cut` outliers are included.
    pub(super) fn residuals(
        &self,
        fitted: &RobustFit,
        blocks: &[ModelledBlock],
        cut: Option<f64>,
    ) -> Residuals {
        let RobustFit { layout, newton, variance_factors, is_pair_used, .. } = fitted;
        Residuals::of(layout, &newton.values, blocks, (variance_factors, is_pair_used), self.span_s, cut)
    }
}

impl RobustFit {
    /// Sums of the pairs that are used.
    pub(super) fn used_sums(&self) -> Vec<PairSums> {
        let chosen = self.sums.iter().zip(&self.is_pair_used).filter(|(_, is_pair_used)| **is_pair_used);
        chosen.map(|(sums, _)| *sums).collect()
    }

    /// Whether the gain of a daughter is detected in a channel and is in the solution.
    pub(super) fn is_detected(&self, channel: usize, daughter: usize) -> bool {
        let k = channel * self.layout.satellites + daughter;
        !self.dropped_gains[k] && self.own_gains[k].presence == SignalPresence::Detected
    }
}

/// Sets the gains that are not in the solution to one.
fn reset_dropped(values: &mut ParameterValues, dropped_gains: &[bool]) {
    for k in (0..dropped_gains.len()).filter(|&k| dropped_gains[k]) {
        (values.amplitude[k], values.phase[k]) = (0.0, 0.0);
    }
}

pub(super) fn sums_of(
    blocks: &[ModelledBlock],
    span_s: [f64; 2],
    layout: &ParameterLayout,
    variance_factors: &[f64],
) -> Vec<PairSums> {
    let sums_of_block = |(block, variance_factor): (&ModelledBlock, &f64)| {
        PairSums::of(block, span_s, layout.model_terms(), *variance_factor)
    };
    blocks.par_iter().zip(variance_factors).map(sums_of_block).collect()
}
