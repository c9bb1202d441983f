//! Robust rounds about Gauss-Newton, among the daughters that deliver signal.

use rayon::prelude::*;

use super::config::SolverConfig;
use super::detect::{DroppedDaughters, OwnGain, SignalPresence, dropped, own_gains, reference, takes_part};
use super::layout::{ParameterLayout, Values};
use super::newton::NewtonFit;
use super::robust::judge;
use super::stability::Residuals;
use super::sums::{ModelledBlock, PairSums};

/// Change of a pair's spread below which a round settles.
const SPREAD_SETTLED: f64 = 0.02;

/// Most rounds of leaving out outliers.
const OUTLIER_ROUNDS: u32 = 3;

/// Most changes of who takes part.
const CHANGES_MAX: usize = 3;

/// What is fitted: blocks of an interval.
#[derive(Clone, Copy)]
pub(super) struct Interval<'a> {
    pub(super) config: &'a SolverConfig,
    pub(super) frequencies_hz: &'a [f64],
    pub(super) satellites: usize,
    pub(super) span_s: [f64; 2],
    /// Offsets of the daughters to begin with, m.
    pub(super) position_m: &'a [[f64; 3]],
}

/// A solution with its residuals and counts.
pub(super) struct Fitted {
    pub(super) layout: ParameterLayout,
    pub(super) found: NewtonFit,
    /// Sums of all blocks.
    pub(super) sums: Vec<PairSums>,
    /// Mean squared residual of each block in units of its noise, where above one.
    pub(super) spreads: Vec<f64>,
    /// Blocks of two daughters that take part.
    pub(super) takes_part: Vec<bool>,
    /// By channel, then daughter.
    pub(super) dropped: DroppedDaughters,
    /// The gain of each as its own data have it.
    pub(super) own: Vec<OwnGain>,
    /// Sum of squared residuals, and number, by block.
    pub(super) chi_squares: Vec<(f64, f64)>,
}

impl Interval<'_> {
    /// Fits; marks outliers in the blocks. Phases are relative to `reference`, or to that of the settings if it is seen.
    pub(super) fn fit(&self, blocks: &mut [ModelledBlock], wanted: Option<usize>) -> Fitted {
        let Self { config, span_s, position_m, .. } = *self;
        let mut layout = ParameterLayout::new(config, self.satellites, self.frequencies_hz);
        let mut spreads = vec![1.0; blocks.len()];
        blocks.par_iter_mut().for_each(|block| block.is_out.fill(false));
        let mut sums = sums_of(blocks, span_s, &layout, &spreads);
        let mut values = layout.start(&sums, position_m);
        let mut left_out = vec![false; layout.satellites * layout.channels()];
        let mut own = own_gains(config, &layout, &values, &sums, &left_out);
        // Once more without those that are not seen.
        left_out = dropped(&layout, &own);
        own = own_gains(config, &layout, &values, &sums, &left_out);
        left_out = dropped(&layout, &own);
        let set = layout.reference;
        layout.reference = wanted.unwrap_or_else(|| reference(&layout, &own, set));
        if layout.reference != set {
            values = layout.start(&sums, position_m);
        }
        let mut changes = 0;
        loop {
            silence(&mut values, &left_out);
            let (found, chi_squares) =
                self.rounds(&layout, values, (&mut *blocks, &mut sums, &mut spreads), &left_out);
            own = own_gains(config, &layout, &found.values, &sums, &left_out);
            let now = dropped(&layout, &own);
            changes += 1;
            if now == left_out || changes == CHANGES_MAX {
                let takes_part = sums.iter().map(|sums| takes_part(&layout, &left_out, sums)).collect();
                let dropped = left_out;
                return Fitted { layout, found, sums, spreads, takes_part, dropped, own, chi_squares };
            }
            values = found.values;
            for (k, own) in own.iter().enumerate().filter(|(k, _)| left_out[*k] && !now[*k]) {
                values.amplitude[k] = own.gain.norm().max(config.dead_amplitude).ln();
                values.phase[k] = own.gain.arg();
            }
            left_out = now;
        }
    }

    fn rounds(
        &self,
        layout: &ParameterLayout,
        values: Values,
        (blocks, sums, spreads): (&mut [ModelledBlock], &mut Vec<PairSums>, &mut Vec<f64>),
        dropped: &[bool],
    ) -> (NewtonFit, Vec<(f64, f64)>) {
        let Self { config, span_s, .. } = *self;
        let used = |sums: &[PairSums]| -> Vec<PairSums> {
            sums.iter().filter(|sums| takes_part(layout, dropped, sums)).copied().collect()
        };
        let most = config.iterations_max as usize;
        let mut found = layout.minimise(values, &used(sums), None, most);
        let mut chi_squares = vec![(0.0, 0.0); blocks.len()];
        for round in 0..=OUTLIER_ROUNDS {
            let judge = |((block, spread), sums): ((&mut ModelledBlock, &mut f64), &PairSums)| {
                if !takes_part(layout, dropped, sums) {
                    return ((0.0, 0.0), false);
                }
                let before = (block.is_out.clone(), *spread);
                let (gain, u) = layout.pair(&found.values, sums.channel, sums.pair);
                let chi_square = judge(block, span_s, config.outlier_sigma, gain, &u, spread);
                let changed = block.is_out != before.0 || (*spread / before.1 - 1.0).abs() > SPREAD_SETTLED;
                (chi_square, changed)
            };
            let judged: Vec<((f64, f64), bool)> =
                blocks.par_iter_mut().zip(&mut *spreads).zip(&*sums).map(judge).collect();
            let changed = judged.iter().any(|(_, changed)| *changed);
            chi_squares = judged.into_iter().map(|(chi_square, _)| chi_square).collect();
            if !changed || round == OUTLIER_ROUNDS {
                break;
            }
            *sums = sums_of(blocks, span_s, layout, spreads);
            found = layout.minimise(found.values, &used(sums), None, most);
        }
        (found, chi_squares)
    }

    /// Residuals of a fit; with a cut also of outliers.
    pub(super) fn residuals(&self, fitted: &Fitted, blocks: &[ModelledBlock], cut: Option<f64>) -> Residuals {
        let Fitted { layout, found, spreads, takes_part, .. } = fitted;
        Residuals::of(layout, &found.values, blocks, (spreads, takes_part), self.span_s, cut)
    }
}

impl Fitted {
    /// What takes part.
    pub(super) fn used(&self) -> Vec<PairSums> {
        let chosen = self.sums.iter().zip(&self.takes_part).filter(|(_, takes_part)| **takes_part);
        chosen.map(|(sums, _)| *sums).collect()
    }

    /// Whether the gain of a daughter is seen in a channel, and is in the solution.
    pub(super) fn is_seen(&self, channel: usize, daughter: usize) -> bool {
        let k = channel * self.layout.satellites + daughter;
        !self.dropped[k] && self.own[k].presence == SignalPresence::Seen
    }
}

/// Daughters that take no part have no errors.
fn silence(values: &mut Values, dropped: &[bool]) {
    for k in (0..dropped.len()).filter(|&k| dropped[k]) {
        (values.amplitude[k], values.phase[k]) = (0.0, 0.0);
    }
}

pub(super) fn sums_of(
    blocks: &[ModelledBlock],
    span_s: [f64; 2],
    layout: &ParameterLayout,
    spreads: &[f64],
) -> Vec<PairSums> {
    let of = |(block, spread): (&ModelledBlock, &f64)| PairSums::of(block, span_s, layout.terms(), *spread);
    blocks.par_iter().zip(spreads).map(of).collect()
}
