//! Rounds of solution and power, until neither changes.

use faer::Mat;

use super::blocks::{Block, Factors};
use super::draws::{Covariance, Drawn, TRACE_SETTLED};
use super::knots::FREE;
use super::{BlockData, PowerFit, SkyPower};
use crate::imaging::NormalSums;
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{NamedWatch, SolveError, StoppingRule, System, dot};

/// Most rounds, and the change of ln C_l at a knot at which they end: a tenth in C_l changes a map by far less than its error. Maps on the
/// way are content with more.
const ROUNDS_MAX: usize = 6;
const SETTLED: f64 = 0.1;
const SETTLED_ON_THE_WAY: f64 = 0.5;
/// Error of a map on the way in units of what the data leave open of it.
const SOLVED: f64 = 0.1;
/// The draws for the traces, always the same; samples have others. One is enough where the blocks are near: it tells what traces differ by.
const TRACES: [u64; 4] = [1 << 32, (1 << 32) + 1, (1 << 32) + 2, (1 << 32) + 3];
/// How far the logarithm of a trace may be from that of the blocks for one draw to be enough.
const NEAR: f64 = 0.2;
/// By how much traces may differ from those of the blocks.
const RATIO_MAX: f64 = 30.0;
/// Change of the logarithm of the noise's factor at which it is found.
const FACTOR_SETTLED: f64 = 0.03;

/// Normal equations for which R is to be found from the data.
pub(in crate::imaging) struct PowerProblem<'a> {
    pub(in crate::imaging) sums: &'a dyn NormalSums,
    /// Blocks near the normal matrix, with which it is preconditioned.
    pub(in crate::imaging) blocks: &'a [Block<'a>],
    /// Degree of each unknown.
    pub(in crate::imaging) degrees: &'a [usize],
    pub(in crate::imaging) right: &'a [f64],
    /// `V'N^-1V` of the data that these are the right-hand side of.
    pub(in crate::imaging) power: f64,
    /// Real numbers in them.
    pub(in crate::imaging) numbers: f64,
}

/// What was found.
pub(in crate::imaging) struct FoundPower {
    /// R by degree.
    pub(in crate::imaging) regularisation: Vec<f64>,
    /// The last solution: of an R near this one.
    pub(in crate::imaging) solution: Vec<f64>,
    pub(in crate::imaging) power: SkyPower,
    /// Traces of `(A + R)^-1` over those of the blocks, by degree.
    pub(in crate::imaging) ratio: Vec<f64>,
    /// The curve, with which further rounds begin.
    pub(in crate::imaging) fit: PowerFit,
    /// Covariance of its parameters.
    pub(super) covariance: Mat<f64>,
    /// Degree of each unknown.
    pub(super) degrees: Vec<usize>,
}

impl FoundPower {
    /// By which the standard deviations of `(A + R)^-1` are multiplied.
    pub(in crate::imaging) fn noise_factor(&self) -> f64 {
        self.power.noise_factor
    }
}

impl PowerProblem<'_> {
    fn l_max(&self) -> usize {
        self.degrees.iter().copied().max().unwrap_or(0)
    }

    /// Of blocks that are the normal matrix.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub(in crate::imaging) fn found_in_blocks(&self) -> Result<FoundPower, SolveError> {
        let l_max = self.l_max();
        let tilt = vec![0.0; l_max + 1];
        let mut fit = PowerFit::begin(self.blocks, l_max, self.right)?;
        let mut factor = 1.0;
        for round in 1.. {
            let right = self.right_over(factor);
            let data = BlockData { blocks: self.blocks, right: &right, tilt: &tilt };
            fit = fit.maximised(data)?;
            let regularisation = fit.regularisation();
            let factors = Factors::new(self.blocks, &regularisation);
            let mut solution = self.right.to_vec();
            factors.solve(&mut solution);
            let next = self.noise_factor(&solution, &regularisation);
            if round >= ROUNDS_MAX || (next / factor).ln().abs() < FACTOR_SETTLED {
                let (power, covariance) = fit.estimate(data, &factors.traces(l_max))?;
                return Ok(FoundPower {
                    regularisation,
                    solution,
                    power: power.of_data_divided_by(factor),
                    ratio: vec![1.0; l_max + 1],
                    fit,
                    covariance,
                    degrees: self.degrees.to_vec(),
                });
            }
            factor = next;
        }
        Err(SolveError::NoPower)
    }

    fn right_over(&self, factor: f64) -> Vec<f64> {
        self.right.iter().map(|b| b / factor).collect()
    }

    /// Scatter of what a solution leaves of the data, in units of their noise; 1 if it is less.
    fn noise_factor(&self, x: &[f64], r: &[f64]) -> f64 {
        // |V - B x|^2 = V'N^-1V - 2 x.b + x.A x, and A x = b - R x.
        let regularised: f64 = x.iter().zip(self.degrees).map(|(x, l)| r[*l] * x * x).sum();
        let left = self.power - dot(x, self.right) - regularised;
        // As many numbers as the solution decides are no noise of it, but they are few.
        (left / self.numbers).max(1.0).sqrt()
    }

    /// In rounds, from the solution `start`.
    ///
    /// # Errors
    /// Likewise.
    pub(in crate::imaging) fn found(
        &self,
        start: Option<&[f64]>,
        rule: StoppingRule,
        watch: NamedWatch<'_>,
    ) -> Result<FoundPower, SolveError> {
        let l_max = self.l_max();
        let mut fit = PowerFit::begin(self.blocks, l_max, self.right)?;
        let mut x = [match start {
            Some(start) if start.len() == self.right.len() => start.to_vec(),
            _ => vec![0.0; self.right.len()],
        }];
        let mut ratio = vec![1.0; l_max + 1];
        let mut factor = 1.0;
        // Maps on the way do without draws. The blocks know more than data of a short time do, so that the power comes out too small, and
        // the map too smooth: on the safe side.
        let is_wanted = watch.is_wanted();
        let settled = if is_wanted { SETTLED } else { SETTLED_ON_THE_WAY };
        for round in 1..=ROUNDS_MAX {
            let r = fit.regularisation();
            let factors = Factors::new(self.blocks, &r);
            let regularisation = Diagonal::ByDegree(r.clone());
            let mut rule = rule;
            if is_wanted {
                ratio = self.drawn_ratio(&regularisation, &factors, &ratio, watch);
            } else {
                rule = self.rule(&factors, factor, rule);
            }
            let system = System { sums: self.sums, regularisation, precondition: &|v| factors.solve(v) };
            {
                let task = watch.start(&format!("map and the sky's power, round {round}"), rule.residual_max);
                system.solve(&[self.right], &mut x, &[rule], &task);
            }
            let before = factor;
            factor = self.noise_factor(&x[0], &r);
            let next = self.next(&fit, &x[0], (factor, &ratio))?;
            // That of the noise is one of the power, too.
            let change = next.fit.change(&fit).max((factor / before).ln().abs());
            let task = watch.start("the sky's power", settled);
            if !task.report_wanting(change > settled && round < ROUNDS_MAX, round, change) {
                return Ok(next);
            }
            fit = next.fit;
        }
        Err(SolveError::NoPower)
    }

    /// The power of `fit`, of which `x` is the solution, with its uncertainty.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub(in crate::imaging) fn estimated(
        &self,
        fit: &PowerFit,
        x: &[f64],
        (factor, ratio): (f64, &[f64]),
    ) -> Result<FoundPower, SolveError> {
        self.of_round(fit, x, (factor, ratio), &|_| Ok(fit.clone()))
    }

    /// The power that the solution `x` of `fit` makes most likely, of data whose noise is larger by a factor and with these ratios of traces.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub(in crate::imaging) fn next(
        &self,
        fit: &PowerFit,
        x: &[f64],
        (factor, ratio): (f64, &[f64]),
    ) -> Result<FoundPower, SolveError> {
        self.of_round(fit, x, (factor, ratio), &|data| fit.maximised(data))
    }

    fn of_round(
        &self,
        fit: &PowerFit,
        x: &[f64],
        (factor, ratio): (f64, &[f64]),
        step: &dyn Fn(BlockData<'_>) -> Result<PowerFit, SolveError>,
    ) -> Result<FoundPower, SolveError> {
        let l_max = self.l_max();
        let traces = |fit: &PowerFit| Factors::new(self.blocks, &fit.regularisation()).traces(l_max);
        let (r, before) = (fit.regularisation(), traces(fit));
        let tilt: Vec<f64> = (0..=l_max).map(|l| 0.5 * r[l] * (ratio[l] - 1.0) * before[l]).collect();
        let mut right = fit.data_of(self.blocks, x, self.degrees);
        right.iter_mut().for_each(|b| *b /= factor);
        let data = BlockData { blocks: self.blocks, right: &right, tilt: &tilt };
        let fit = step(data)?;
        let mut traces = traces(&fit);
        traces.iter_mut().zip(ratio).for_each(|(trace, ratio)| *trace *= ratio);
        let (power, covariance) = fit.estimate(data, &traces)?;
        Ok(FoundPower {
            regularisation: fit.regularisation(),
            solution: x.to_vec(),
            power: power.of_data_divided_by(factor),
            ratio: ratio.to_vec(),
            fit,
            covariance,
            degrees: self.degrees.to_vec(),
        })
    }

    /// When a map on the way is good enough beside what the data leave open, or as good as `rule` asks.
    pub(in crate::imaging) fn rule(
        &self,
        factors: &Factors<'_>,
        factor: f64,
        rule: StoppingRule,
    ) -> StoppingRule {
        let mut solved = self.right.to_vec();
        factors.solve(&mut solved);
        // The squares of errors of (A + R)^-1 add up to one an unknown in the norm of A + R, in which residuals are measured.
        let open = factor * (self.right.len() as f64 / dot(self.right, &solved)).sqrt();
        // No less than a tenth of the map, whatever the noise.
        StoppingRule { residual_max: rule.residual_max.max(SOLVED * open.min(1.0)), ..rule }
    }

    /// The ratio of traces by draws: few where the last ones said that the blocks are near.
    pub(in crate::imaging) fn drawn_ratio(
        &self,
        regularisation: &Diagonal,
        factors: &Factors<'_>,
        last: &[f64],
        watch: NamedWatch<'_>,
    ) -> Vec<f64> {
        let is_near = watch.all(last.iter().all(|ratio| ratio.ln().abs() < NEAR));
        let which = if is_near { &TRACES[..1] } else { &TRACES };
        let task = watch.start("draws for the sky's power", TRACE_SETTLED);
        let products = |x: &[&[f64]]| self.sums.apply_all(x);
        let unknowns = self.right.len();
        let covariance = Covariance { products: &products, unknowns, regularisation, factors };
        let drawn = covariance.draw(which, TRACE_SETTLED, &task);
        self.ratio(&drawn, &factors.traces(self.l_max()))
    }

    /// Traces of the true covariance over those of the blocks, means over neighbouring degrees: a draw has few numbers of each.
    fn ratio(&self, drawn: &[Drawn], traces: &[f64]) -> Vec<f64> {
        let mut more = vec![0.0; traces.len()];
        for Drawn { whole, of_blocks } in drawn {
            for ((l, d), of_blocks) in self.degrees.iter().zip(whole).zip(of_blocks) {
                more[*l] += (d * d - of_blocks * of_blocks) / drawn.len() as f64;
            }
        }
        let of_degree = |l: usize| {
            let l = l.max(FREE);
            let width = (l / 4).max(2);
            let near = l.saturating_sub(width).max(FREE)..(l + width + 1).min(traces.len());
            let sums = near.fold([0.0, 0.0], |[a, b], l| [a + more[l], b + traces[l]]);
            if sums[1] > 0.0 { (1.0 + sums[0] / sums[1]).clamp(RATIO_MAX.recip(), RATIO_MAX) } else { 1.0 }
        };
        (0..traces.len()).map(of_degree).collect()
    }
}
