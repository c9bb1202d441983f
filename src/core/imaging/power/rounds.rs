//! Alternates between solutions and power estimates until both have converged.

use faer::Mat;

use super::blocks::{Block, Coupling, Factors};
use super::knots::FREE_DEGREES;
use super::samples::{PosteriorPrecision, PosteriorSample, TRACE_TOLERANCE};
use super::{BlockData, PowerFit, SkyPower};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{Convergence, NamedWatch, StoppingRule, System, dot};

/// Maximum number of rounds.
const ROUNDS_MAX: usize = 6;
/// Change of ln C_l at which rounds have converged: a tenth in C_l changes a map by far less than its error.
const TOLERANCE: f64 = 0.1;
/// The same for early rounds, and for intermediate maps.
const EARLY_TOLERANCE: f64 = 0.5;
/// Error of a solution of early rounds in units of its posterior error.
const EARLY_ERROR: f64 = 0.1;
/// Ids of the posterior samples for trace estimates, different from those of maps. The first alone suffices if the blocks are accurate.
const TRACE_SAMPLES: [u64; 4] = [1 << 32, (1 << 32) + 1, (1 << 32) + 2, (1 << 32) + 3];
/// Maximum difference of ln(trace) between the true matrix and the blocks for which one sample suffices.
const LN_RATIO_ACCURATE: f64 = 0.2;
/// Maximum ratio of true traces to those of the blocks.
const RATIO_MAX: f64 = 30.0;
/// Change of the logarithm of the noise factor at which it has converged.
const FACTOR_TOLERANCE: f64 = 0.03;

/// How often the noise of a map that is not plausible is doubled.
const DOUBLINGS_MAX: usize = 8;

/// Normal equations whose R is estimated from the data.
pub(in crate::imaging) struct PowerProblem<'a> {
    pub(in crate::imaging) sums: &'a dyn NormalSums,
    /// Blocks of the normal matrix, or of an approximation that preconditions it.
    pub(in crate::imaging) blocks: &'a [Block<'a>],
    /// What couples the blocks, for preconditioning.
    pub(in crate::imaging) coupling: Option<&'a Coupling>,
    pub(in crate::imaging) degrees: &'a [usize],
    pub(in crate::imaging) right: &'a [f64],
    /// `V'N^-1V` of the data.
    pub(in crate::imaging) data_chi2: f64,
    /// Number of real numbers in the data: two for each visibility.
    pub(in crate::imaging) data_count: f64,
}

/// The estimated power and the solution.
pub(in crate::imaging) struct FoundPower {
    pub(in crate::imaging) regularisation: Vec<f64>,
    /// The last solution, for nearly this R.
    pub(in crate::imaging) solution: Vec<f64>,
    pub(in crate::imaging) power: SkyPower,
    /// Ratio of the traces of `(A + R)^-1` to those of the blocks alone, by degree.
    pub(in crate::imaging) ratio: Vec<f64>,
    /// The fitted curve, from which further rounds start.
    pub(in crate::imaging) fit: PowerFit,
    /// Covariance of its parameters.
    pub(super) covariance: Mat<f64>,
    /// Degree of each unknown.
    pub(super) degrees: Vec<usize>,
}

/// The map and the noise map for the estimated power.
pub(in crate::imaging) struct MapsWithPower {
    pub(in crate::imaging) found: FoundPower,
    /// Unknowns of the map, without its prior, and of the noise map.
    pub(in crate::imaging) columns: [Vec<f64>; 2],
    pub(in crate::imaging) convergence: Vec<Convergence>,
}

impl FoundPower {
    /// The factor by which standard deviations from `(A + R)^-1` are multiplied.
    pub(in crate::imaging) fn noise_factor(&self) -> f64 {
        self.power.noise_factor
    }
}

impl PowerProblem<'_> {
    fn l_max(&self) -> usize {
        self.degrees.iter().copied().max().unwrap_or(0)
    }

    fn preconditioner(&self, r: &[f64]) -> Factors<'_> {
        match self.coupling {
            Some(coupling) => Factors::coupled(self.blocks, coupling, r),
            None => Factors::new(self.blocks, r),
        }
    }

    /// Estimates the power if the blocks are the whole normal matrix.
    ///
    /// What a map cannot have, structure beyond its degrees for instance, is no white noise: modes that the data hardly see may fit it with
    /// an enormous sky, which then passes for the sky's power. While the solution is not plausible, the noise counts as twice as large.
    pub(in crate::imaging) fn solve_blocks(
        &self,
        is_plausible: &dyn Fn(&[f64]) -> Result<bool, SolveError>,
    ) -> Result<FoundPower, SolveError> {
        let (mut least, mut first) = (1.0, None);
        for _ in 0..=DOUBLINGS_MAX {
            let found = self.solve_blocks_in_noise(least)?;
            if is_plausible(&found.solution)? {
                return Ok(found);
            }
            least = 2.0 * found.noise_factor();
            first.get_or_insert(found);
        }
        // More noise does not help.
        first.ok_or(SolveError::NoPower)
    }

    /// The same with a noise factor of at least `least`.
    fn solve_blocks_in_noise(&self, least: f64) -> Result<FoundPower, SolveError> {
        let l_max = self.l_max();
        let gradient_correction = vec![0.0; l_max + 1];
        let mut factor = least;
        let (right, data_chi2) = (self.right_divided_by(factor), self.data_chi2 / factor.powi(2));
        let mut fit = PowerFit::begin(self.blocks, l_max, &right, data_chi2)?;
        for round in 1.. {
            let right = self.right_divided_by(factor);
            let data =
                BlockData { blocks: self.blocks, right: &right, gradient_correction: &gradient_correction };
            fit = fit.with_noise_factor(self.data_chi2, factor, self.right.len()).maximised(data)?;
            let regularisation = fit.regularisation();
            let factors = Factors::new(self.blocks, &regularisation);
            let mut solution = self.right.to_vec();
            factors.solve(&mut solution);
            let next_factor = self.noise_factor(&solution, &regularisation).max(least);
            if round >= ROUNDS_MAX || (next_factor / factor).ln().abs() < FACTOR_TOLERANCE {
                let (power, covariance) = fit.estimate(data, &factors.traces(l_max))?;
                return Ok(FoundPower {
                    regularisation,
                    solution,
                    power: power.scaled_from_divided_data(factor),
                    ratio: vec![1.0; l_max + 1],
                    fit,
                    covariance,
                    degrees: self.degrees.to_vec(),
                });
            }
            factor = next_factor;
        }
        Err(SolveError::NoPower)
    }

    /// The right-hand side divided by a factor.
    fn right_divided_by(&self, factor: f64) -> Vec<f64> {
        self.right.iter().map(|b| b / factor).collect()
    }

    /// Scatter of the residuals of a solution in units of the noise, at least 1.
    fn noise_factor(&self, x: &[f64], r: &[f64]) -> f64 {
        // |V - B x|^2 in units of the noise is V'N^-1V - 2 x.b + x.A x, and A x = b - R x.
        let regularised: f64 = x.iter().zip(self.degrees).map(|(x, l)| r[*l] * x * x).sum();
        let residual = self.data_chi2 - dot(x, self.right) - regularised;
        // The few degrees of freedom that the solution takes are neglected. An unconverged solution may fit worse than an empty sky: then
        // the residual is that of the empty sky.
        (residual.min(self.data_chi2) / self.data_count).max(1.0).sqrt()
    }

    /// Estimates the power in rounds, from the initial solution `start`.
    ///
    /// Early rounds stop their solutions early and draw no samples; intermediate maps have only such rounds. While data are few, the C_l of the blocks,
    /// from which rounds start, is far too large, and a converged solution would fit rounding errors of the matrix.
    pub(in crate::imaging) fn solve(
        &self,
        start: Option<&[f64]>,
        rule: StoppingRule,
        watch: NamedWatch<'_>,
    ) -> Result<FoundPower, SolveError> {
        let l_max = self.l_max();
        let mut fit = PowerFit::begin(self.blocks, l_max, self.right, self.data_chi2)?;
        let mut x = [match start {
            Some(start) if start.len() == self.right.len() => start.to_vec(),
            _ => vec![0.0; self.right.len()],
        }];
        let mut ratio = vec![1.0; l_max + 1];
        let mut factor = 1.0;
        let (mut is_early, mut round) = (true, 0);
        loop {
            round += 1;
            let r = fit.regularisation();
            let factors = self.preconditioner(&r);
            let regularisation = Diagonal::ByDegree(r.clone());
            let mut rule = rule;
            if is_early {
                rule = self.early_rule(&factors, factor, rule);
            } else {
                ratio = self.sampled_ratio(&regularisation, &factors, &ratio, watch);
            }
            let system = System { sums: self.sums, regularisation, precondition: &|v| factors.solve(v) };
            {
                let task = watch.start(&format!("map and the sky's power, round {round}"), rule.residual_max);
                system.solve(&[self.right], &mut x, &[rule], &task);
            }
            let before = factor;
            factor = self.noise_factor(&x[0], &r);
            let found = self.next(&fit, &x[0], (factor, &ratio))?;
            // A change of the noise factor changes C_l, too.
            let change = found.fit.change(&fit).max((factor / before).ln().abs());
            let tolerance = if is_early { EARLY_TOLERANCE } else { TOLERANCE };
            let task = watch.start("the sky's power", tolerance);
            if !task.report_step(change > tolerance && round < ROUNDS_MAX, round, change) {
                if !is_early || !watch.is_of_final_map() {
                    return Ok(found);
                }
                (is_early, round) = (false, 0);
            }
            fit = found.fit;
        }
    }

    /// Estimates the power, then solves for the map and the noise map, from earlier ones of the same size if there are any. The noise
    /// map of an intermediate map has the map's absolute accuracy.
    pub(in crate::imaging) fn solve_maps(
        &self,
        start: Option<&[Vec<f64>; 2]>,
        rule: StoppingRule,
        watch: NamedWatch<'_>,
    ) -> Result<MapsWithPower, SolveError> {
        let found = self.solve(start.map(|[map, _]| map.as_slice()), rule, watch)?;
        let factors = self.preconditioner(&found.regularisation);
        let regularisation = Diagonal::ByDegree(found.regularisation.clone());
        let system = System { sums: self.sums, regularisation, precondition: &|v| factors.solve(v) };
        let noise = match start {
            Some([_, noise]) if noise.len() == self.right.len() => noise.clone(),
            _ => vec![0.0; self.right.len()],
        };
        let mut columns = [found.solution.clone(), noise];
        let task = watch.start("map and noise map", rule.residual_max);
        let right = [self.right, self.sums.noise_right_hand_side()];
        let rules = [rule, if watch.is_of_final_map() { rule } else { noise_rule(right, &factors, rule) }];
        let convergence = system.solve(&right, &mut columns, &rules, &task);
        drop(task);
        Ok(MapsWithPower { found, columns, convergence })
    }

    /// The C_l of `fit` with its uncertainty, given the solution `x` for its R.
    ///
    /// # Errors
    /// Numbers that are not finite.
    pub(in crate::imaging) fn estimated(
        &self,
        fit: &PowerFit,
        x: &[f64],
        (factor, ratio): (f64, &[f64]),
    ) -> Result<FoundPower, SolveError> {
        self.found_power(fit, x, (factor, ratio), &|_| Ok(fit.clone()))
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
        self.found_power(fit, x, (factor, ratio), &|data| {
            fit.clone().with_noise_factor(self.data_chi2, factor, self.right.len()).maximised(data)
        })
    }

    /// The C_l after a step from `fit`, with the data for which `x` solves the equations of the blocks.
    fn found_power(
        &self,
        fit: &PowerFit,
        x: &[f64],
        (factor, ratio): (f64, &[f64]),
        step: &dyn Fn(BlockData<'_>) -> Result<PowerFit, SolveError>,
    ) -> Result<FoundPower, SolveError> {
        let l_max = self.l_max();
        let traces = |fit: &PowerFit| Factors::new(self.blocks, &fit.regularisation()).traces(l_max);
        let (r, before) = (fit.regularisation(), traces(fit));
        let gradient_correction: Vec<f64> =
            (0..=l_max).map(|l| 0.5 * r[l] * (ratio[l] - 1.0) * before[l]).collect();
        let mut right = fit.equivalent_data(self.blocks, x, self.degrees);
        right.iter_mut().for_each(|b| *b /= factor);
        let data =
            BlockData { blocks: self.blocks, right: &right, gradient_correction: &gradient_correction };
        let fit = step(data)?;
        let mut traces = traces(&fit);
        traces.iter_mut().zip(ratio).for_each(|(trace, ratio)| *trace *= ratio);
        let (power, covariance) = fit.estimate(data, &traces)?;
        Ok(FoundPower {
            regularisation: fit.regularisation(),
            solution: x.to_vec(),
            power: power.scaled_from_divided_data(factor),
            ratio: ratio.to_vec(),
            fit,
            covariance,
            degrees: self.degrees.to_vec(),
        })
    }

    /// The stopping rule of an early solution: its error is a fraction of its posterior error, or as `rule` requires.
    pub(in crate::imaging) fn early_rule(
        &self,
        factors: &Factors<'_>,
        factor: f64,
        rule: StoppingRule,
    ) -> StoppingRule {
        let mut solved = self.right.to_vec();
        factors.solve(&mut solved);
        // In the norm of A + R, in which residuals are measured, posterior variances sum to one per unknown.
        let posterior_error = factor * (self.right.len() as f64 / dot(self.right, &solved)).sqrt();
        // Never less accurate than a tenth of the map.
        StoppingRule { residual_max: rule.residual_max.max(EARLY_ERROR * posterior_error.min(1.0)), ..rule }
    }

    /// Estimates the ratio of traces from posterior samples, from one if the last estimate says that the blocks are accurate.
    pub(in crate::imaging) fn sampled_ratio(
        &self,
        regularisation: &Diagonal,
        factors: &Factors<'_>,
        last: &[f64],
        watch: NamedWatch<'_>,
    ) -> Vec<f64> {
        let is_accurate = watch.all(last.iter().all(|ratio| ratio.ln().abs() < LN_RATIO_ACCURATE));
        let sample_ids = if is_accurate { &TRACE_SAMPLES[..1] } else { &TRACE_SAMPLES };
        let task = watch.start("samples for the sky's power", TRACE_TOLERANCE);
        let products = |x: &[&[f64]]| self.sums.apply_all(x);
        let unknowns = self.right.len();
        let precision = PosteriorPrecision { products: &products, unknowns, regularisation, factors };
        let samples = precision.draw(sample_ids, TRACE_TOLERANCE, &task);
        self.ratio(&samples, &factors.traces(self.l_max()))
    }

    /// The ratio of the traces of the true covariance and of the blocks', averaged over neighbouring degrees for accuracy.
    fn ratio(&self, samples: &[PosteriorSample], traces: &[f64]) -> Vec<f64> {
        let mut excess = vec![0.0; traces.len()];
        for PosteriorSample { exact, of_blocks } in samples {
            for ((l, x), y) in self.degrees.iter().zip(exact).zip(of_blocks) {
                excess[*l] += (x * x - y * y) / samples.len() as f64;
            }
        }
        let of_degree = |l: usize| {
            let l = l.max(FREE_DEGREES);
            let width = (l / 4).max(2);
            let neighbours = l.saturating_sub(width).max(FREE_DEGREES)..(l + width + 1).min(traces.len());
            let sums = neighbours.fold([0.0, 0.0], |[a, b], l| [a + excess[l], b + traces[l]]);
            if sums[1] > 0.0 { (1.0 + sums[0] / sums[1]).clamp(RATIO_MAX.recip(), RATIO_MAX) } else { 1.0 }
        };
        (0..traces.len()).map(of_degree).collect()
    }
}

/// Largest relative residual of an intermediate noise map.
const NOISE_RESIDUAL_MAX: f64 = 0.1;

/// The stopping rule of an intermediate noise map, the second of two right-hand sides: the map's absolute residual. Relative to its own, much smaller
/// right-hand side it may be larger.
fn noise_rule([map, noise]: [&[f64]; 2], factors: &Factors<'_>, rule: StoppingRule) -> StoppingRule {
    let square = |right: &[f64]| {
        let mut solved = right.to_vec();
        factors.solve(&mut solved);
        dot(right, &solved)
    };
    let ratio = (square(map) / square(noise)).sqrt();
    // Without noise, or with a preconditioner that is not positive definite, it is not a number.
    let residual_max = if ratio.is_finite() { rule.residual_max * ratio } else { rule.residual_max };
    StoppingRule { residual_max: residual_max.min(NOISE_RESIDUAL_MAX).max(rule.residual_max), ..rule }
}
