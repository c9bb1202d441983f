//! Errors of a map over harmonics whose R is from the data, and draws from its posterior.

use super::coefficients;
use super::gain_errors::ErrorDraws;
use super::sigma::{moments, moments_k, pixel_resolution_deg, pixel_sigma_k, sample};
use crate::imaging::NormalSums;
use crate::imaging::SolveError;
use crate::imaging::power::{
    Block, Factors, FoundPower, PosteriorPrecision, PosteriorSample, SAMPLE_TOLERANCE,
};
use crate::imaging::power::{Sample, Samples, Uncertainty};
use crate::imaging::regulariser::Diagonal;
use crate::imaging::solver::{NamedWatch, StoppingRule, System, add, dot};
use crate::imaging::unknowns::degrees;
use crate::sky::harmonics::synthesis;

/// Realisations or samples that are solved for together: a thread has a workspace for each.
pub const NOISES_TOGETHER: usize = 4;

/// Residual of the errors of mean and dipole: they err by its square.
const BESIDE: f64 = 0.1;

/// First number of the draws of Gibbs sampling: those of plain samples are below.
const GIBBS: u64 = 1 << 40;

/// The equations of a map with R from the data, solved.
pub(in crate::imaging) struct Posterior<'a> {
    /// Equations over harmonics: of one circle, or projected from pixels.
    pub(in crate::imaging) sums: &'a dyn NormalSums,
    /// Blocks near their matrix.
    pub(in crate::imaging) blocks: &'a [Block<'a>],
    pub(in crate::imaging) found: &'a FoundPower,
    /// Right-hand side, less what the prior map predicts.
    pub(in crate::imaging) right: &'a [f64],
    /// The solution, without its prior map.
    pub(in crate::imaging) solved: &'a [f64],
    /// With it.
    pub(in crate::imaging) whole: &'a [f64],
    pub(in crate::imaging) nside: usize,
    pub(in crate::imaging) rule: StoppingRule,
    pub(in crate::imaging) watch: NamedWatch<'a>,
}

/// Products of a normal matrix with several vectors.
pub(in crate::imaging) type Products<'a> = &'a dyn Fn(&[&[f64]]) -> Vec<Vec<f64>>;

impl Posterior<'_> {
    fn l_max(&self) -> usize {
        self.found.regularisation.len() - 1
    }

    /// Errors, with samples of the equations whose matrix makes `products`.
    ///
    /// # Errors
    /// An nside or degree without a transform.
    pub(in crate::imaging) fn uncertainty(
        &self,
        samples: Samples,
        products: Products<'_>,
    ) -> Result<Uncertainty, SolveError> {
        let FoundPower { regularisation: r, power, ratio, .. } = self.found;
        let nside = self.nside;
        let factors = Factors::new(self.blocks, r);
        let by_gains = self.gain_errors(&factors);
        let shares = by_gains.as_ref().map(|draws| self.shares_without_gains(draws));
        let shares = shares.unwrap_or_else(|| vec![1.0; r.len()]);
        let ratio: Vec<f64> = ratio.iter().zip(&shares).map(|(ratio, share)| ratio * share).collect();
        let scale: Vec<f64> = shares.iter().map(|share| power.noise_factor * share.sqrt()).collect();
        let mut sigma_k = pixel_sigma_k(self.blocks, &factors, &ratio, nside);
        sigma_k.iter_mut().for_each(|sigma_k| *sigma_k *= power.noise_factor);
        let mut moments_sigma_k = self.moments_sigma(&factors);
        moments_sigma_k.iter_mut().zip([0, 1, 1, 1]).for_each(|(sigma, l)| *sigma *= scale[l]);
        let (mut power, mut gains) = (power.clone(), None);
        if let Some(draws) = &by_gains {
            let (pixels, moments) = (draws.pixel_variances_k2(nside)?, draws.moment_variances_k2());
            let add = |sigma: &mut f64, variance: &f64| *sigma = (*sigma * *sigma + variance).sqrt();
            sigma_k.iter_mut().zip(&pixels).for_each(|(sigma, variance)| add(sigma, variance));
            moments_sigma_k.iter_mut().zip(&moments).for_each(|(sigma, variance)| add(sigma, variance));
            let of_ln = draws.ln_power_variances(self.solved);
            power.sigma_ln.iter_mut().zip(&of_ln).skip(2).for_each(|(sigma, variance)| add(sigma, variance));
            gains = Some(draws.summary(&pixels, moments[0]));
        }
        let [mean_sigma_k, dipole_sigma_k @ ..] = moments_sigma_k;
        let [_, dipole_k @ ..] = moments_k(self.whole, self.l_max());
        let mut samples = if samples.gibbs {
            self.gibbs_samples(samples.count, &scale)?
        } else {
            self.samples(samples.count, &factors, products, &scale)?
        };
        if let Some(draws) = &by_gains {
            (0..).zip(&mut samples).for_each(|(number, away)| add(away, &draws.drawn(number)));
        }
        Ok(Uncertainty {
            sigma_k,
            resolution_deg: pixel_resolution_deg(self.blocks, &factors, (r, &power.constrained), nside),
            mean_sigma_k,
            dipole_k,
            dipole_sigma_k,
            power,
            gains,
            samples: samples.into_iter().map(|away| self.sample(away)).collect::<Result<_, _>>()?,
        })
    }

    /// Maps of draws of the errors by gains; `None` if these are not known, or if not all maps converged: errors would be too small.
    fn gain_errors(&self, factors: &Factors<'_>) -> Option<ErrorDraws> {
        let mut unknowns = Vec::new();
        let system = System {
            sums: self.sums,
            regularisation: Diagonal::ByDegree(self.found.regularisation.clone()),
            precondition: &|v| factors.solve(v),
        };
        // As accurate as the map: what the data hardly constrain, where errors are largest, converges last.
        let rule = self.rule;
        for right in self.sums.gain_error_right_hand_sides().chunks(NOISES_TOGETHER) {
            let right: Vec<&[f64]> = right.iter().map(Vec::as_slice).collect();
            let mut solved = vec![vec![0.0; self.right.len()]; right.len()];
            let task = self.watch.start("errors by gains", rule.residual_max);
            let convergence = system.solve(&right, &mut solved, &vec![rule; right.len()], &task);
            if !convergence.iter().all(|found| found.converged) {
                return None;
            }
            unknowns.append(&mut solved);
        }
        (!unknowns.is_empty()).then(|| ErrorDraws { unknowns, l_max: self.l_max() })
    }

    /// What is left of variances if errors by gains are taken off, by degree. The noise factor holds all that the map leaves of the data, also
    /// what these leave: the noise that remains is that of the share of a degree that the data constrain.
    fn shares_without_gains(&self, draws: &ErrorDraws) -> Vec<f64> {
        let FoundPower { regularisation: r, power, .. } = self.found;
        let square = power.noise_factor.powi(2);
        let fitted = draws.fitted_power(self.sums.gain_error_right_hand_sides(), r);
        let left = (self.sums.gain_error_power() - fitted) / (2.0 * self.sums.counts().visibilities as f64);
        let remains = (square - left.max(0.0)).max(1.0) / square;
        let of_degree = |(l, constrained): (usize, &f64)| {
            let share = (constrained / (2 * l + 1) as f64).min(1.0);
            share * remains + (1.0 - share)
        };
        power.constrained.iter().enumerate().map(of_degree).collect()
    }

    /// Standard deviations of mean and dipole, K, for data of their noise: columns of the covariance, or of the blocks' where no time is left for
    /// a step.
    fn moments_sigma(&self, factors: &Factors<'_>) -> [f64; 4] {
        let unit = |(place, factor): (usize, f64)| {
            let mut unit = vec![0.0; self.right.len()];
            unit[place] = factor;
            unit
        };
        let units = moments(self.l_max()).map(unit);
        let mut columns = units.each_ref().map(|unit| vec![0.0; unit.len()]);
        let rule = StoppingRule { residual_max: self.rule.residual_max.max(BESIDE), ..self.rule };
        let system = System {
            sums: self.sums,
            regularisation: Diagonal::ByDegree(self.found.regularisation.clone()),
            precondition: &|v| factors.solve(v),
        };
        let task = self.watch.start("errors of mean and dipole", rule.residual_max);
        system.solve(&units.each_ref().map(Vec::as_slice), &mut columns, &[rule; 4], &task);
        for (column, unit) in columns.iter_mut().zip(&units) {
            if column.iter().all(|x| *x == 0.0) {
                column.clone_from(unit);
                factors.solve(column);
            }
        }
        [0, 1, 2, 3].map(|k| dot(&units[k], &columns[k]).max(0.0).sqrt())
    }

    /// A sample that is `away` from the solution.
    fn sample(&self, mut away: Vec<f64>) -> Result<Sample, SolveError> {
        add(&mut away, self.whole);
        let map_k = synthesis(&coefficients(&away, self.l_max()), self.nside)?;
        Ok(sample(&away, self.l_max(), map_k))
    }

    /// What maps as likely as this one are away from it, C_l as it was found.
    fn samples(
        &self,
        count: usize,
        factors: &Factors<'_>,
        products: Products<'_>,
        scale: &[f64],
    ) -> Result<Vec<Vec<f64>>, SolveError> {
        let regularisation = &Diagonal::ByDegree(self.found.regularisation.clone());
        let covariance = PosteriorPrecision { products, unknowns: self.right.len(), regularisation, factors };
        let mut samples = Vec::new();
        let numbers: Vec<u64> = (0..count as u64).collect();
        for which in numbers.chunks(NOISES_TOGETHER) {
            let name = format!("samples from {} of {count}", which[0] + 1);
            let task = self.watch.start(&name, SAMPLE_TOLERANCE);
            for PosteriorSample { exact: mut drawn, .. } in covariance.draw(which, SAMPLE_TOLERANCE, &task) {
                drawn.iter_mut().zip(degrees(self.l_max())).for_each(|(value, l)| *value *= scale[l]);
                samples.push(drawn);
            }
        }
        Ok(samples)
    }

    /// The same of maps and powers as likely as those that were found.
    fn gibbs_samples(&self, count: usize, scale: &[f64]) -> Result<Vec<Vec<f64>>, SolveError> {
        let mut samples = Vec::new();
        for number in 0..count as u64 {
            if !self.watch.may_continue() {
                return Err(SolveError::Interrupted);
            }
            let mut turn = 0;
            let name = format!("sample {} of {count}, with its power", number + 1);
            // Shown between its solutions, too.
            let _drawing = self.watch.start(&name, self.rule.residual_max);
            let drawn = self.found.gibbs(number, &mut |r| {
                turn += 1;
                self.drawn_with((r, scale), GIBBS + 16 * number + turn, &name)
            });
            samples.push(drawn.iter().zip(self.solved).map(|(drawn, solved)| drawn - solved).collect());
        }
        Ok(samples)
    }

    /// Coefficients, less those of the prior, as likely as the data say with this R, for data of this noise by degree.
    fn drawn_with(&self, (r, scale): (&[f64], &[f64]), which: u64, name: &str) -> Vec<f64> {
        let factors = &Factors::new(self.blocks, r);
        let regularisation = Diagonal::ByDegree(r.to_vec());
        let products = |x: &[&[f64]]| self.sums.apply_all(x);
        let mut columns = [self.solved.to_vec()];
        {
            let (regularisation, precondition) = (regularisation.clone(), |v: &mut [f64]| factors.solve(v));
            let system = System { sums: self.sums, regularisation, precondition: &precondition };
            let task = self.watch.start(name, self.rule.residual_max);
            system.solve(&[self.right], &mut columns, &[self.rule], &task);
        }
        let [mut sky] = columns;
        let unknowns = self.right.len();
        let covariance =
            PosteriorPrecision { products: &products, unknowns, regularisation: &regularisation, factors };
        let task = self.watch.start(name, SAMPLE_TOLERANCE);
        for PosteriorSample { exact, .. } in covariance.draw(&[which], SAMPLE_TOLERANCE, &task) {
            let drawn = degrees(self.l_max()).zip(exact);
            sky.iter_mut().zip(drawn).for_each(|(sky, (l, drawn))| *sky += scale[l] * drawn);
        }
        sky
    }
}
