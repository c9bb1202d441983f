//! Solves the normal equations with rows at the true positions, with search directions from the equations of a circular orbit.
//!
//! Rows of a circular orbit do not fit data from another orbit, but its normal matrix tells nearly as well as the true one which modes are
//! measured. Therefore
//!
//! ```text
//! (Bt N^-1 B + R) x = Bt N^-1 V,   with directions   z = (Bc^t N^-1 Bc + s R)^-1 r,   r the residual of the true equations
//! ```
//!
//! with B the rows of the true positions and Bc those of the nearest circle, converges in a few products with the true matrix. The first
//! directions are the map of the circle's own sums (or an earlier solution) and the circle's solution of the true right-hand side. Each
//! iteration multiplies the directions of the map and of the noise-only map by the true matrix, makes them conjugate, and moves both maps to
//! the best solution in the span of all directions. Inexact inner solutions therefore cost iterations but no accuracy.
//!
//! s is 1 while that converges. The circle's matrix may lack modes that the true one has, after a short time or for an orbit far from
//! circular, and its inverse then exaggerates them. Directions with larger s, nearer to plain conjugate gradients, are then added. If that is
//! not enough and the unknowns are few, the true matrix is formed column by column, and the equations are solved directly.

use faer::linalg::solvers::Solve;
use faer::{Mat, Side};
use num_complex::Complex64;

use super::refinement::{Refinement, chi_squares};
use super::subspace::{Column, Subspace};
use crate::imaging::anywhere::RefinedSums;
use crate::imaging::circle::{HarmonicRequest, HarmonicSolution, Posterior, largest_of_circle};
use crate::imaging::circle::{OrderFactors, coefficients, prior_unknowns, unknowns_of_gradient};
use crate::imaging::power::FoundPower;
use crate::imaging::regulariser::{Diagonal, Regulariser};
use crate::imaging::solver::{Convergence, Diagnostics, LargestEigenvalue, NamedWatch, SolveTask};
use crate::imaging::solver::{StoppingRule, System, add, check_request, dot, right_hand_side};
use crate::imaging::{AccumulationError, NormalSums, SolveError};
use crate::sky::harmonics::synthesis;
use crate::sky::healpix::pixel_area_sr;

/// Residual of the inner iterations, well below the factor of three to ten that an outer iteration gains. A smaller one would save no outer
/// iteration, and take longer than one.
const INNER_RESIDUAL: f64 = 1e-2;

/// Factors s of R in the circle's matrix; only the first is used while an iteration halves the residual.
const SHIFTS: [f64; 4] = [1.0, 10.0, 100.0, 1000.0];

/// Ratio of successive residuals above which convergence is slow.
const SLOW_RATIO: f64 = 0.5;

/// Iterations after which slow convergence is given up if the matrix can be formed.
const SLOW_ITERATIONS_MAX: usize = 5;

/// Maximum numbers of unknowns (those of nside 16), and of rows times unknowns, for which the matrix is formed: it takes minutes.
const DIRECT_UNKNOWNS_MAX: usize = 41 * 41;
const DIRECT_PRODUCTS_MAX: usize = 50_000_000;

/// Columns of the matrix that are formed together, so that rows of B are computed once for all of them.
pub(super) const COLUMNS_AT_ONCE: usize = 16;

/// Stopping rule of a refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineRule {
    /// Maximum number of iterations, each over all visibilities.
    pub passes_max: usize,
    /// Target residual, relative to the right-hand side, in the preconditioner's norm.
    pub residual_max: f64,
}

impl From<AccumulationError> for SolveError {
    fn from(error: AccumulationError) -> Self {
        Self::Refinement(error.to_string())
    }
}

/// Start of a refinement, and where its iterations are saved.
pub struct RefineSteps<'a> {
    /// Earlier unknowns of the map, without its prior, and of the noise-only map.
    pub start: Option<[Vec<f64>; 2]>,
    /// Saves both after each iteration.
    pub save: &'a mut dyn FnMut([&[f64]; 2]),
}

/// Solves for the map and the noise-only map with the rows of the true positions.
///
/// # Errors
/// There is no data, the prior is no map, or R is from a table that ends before the map's degrees; [`SolveError::Interrupted`] before the end of
/// the first iteration.
pub fn solve_refined(
    sums: &RefinedSums,
    request: HarmonicRequest,
    (rule, regulariser): (RefineRule, &Regulariser),
    prior_k: Option<&[f64]>,
    steps: RefineSteps<'_>,
    watch: NamedWatch<'_>,
) -> Result<(HarmonicSolution, Refinement), SolveError> {
    let is_of_data = *regulariser == Regulariser::Data;
    check_request(&sums.circle, if is_of_data { 1.0 } else { request.epsilon })?;
    let l_max = sums.circle.setup().l_max;
    let prior = prior_k.map(|map| prior_unknowns(map, l_max)).transpose()?;
    let order_blocks = sums.circle.order_blocks();
    let circle_data = right_hand_side(&sums.circle, prior.as_deref())?;
    let inner = request.rule;
    let mut problem = RefinedProblem { sums, regularisation: Diagonal::Uniform(0.0), inner, rule, watch };
    let right = problem.right(prior.as_deref());
    let blocks = order_blocks.blocks();
    let (refined, found, mut diagnostics) = if is_of_data {
        let of = RightHandSides { of_rows: &right, of_circle: &circle_data, prior: prior.as_deref() };
        let (refined, found) = problem.solve_with_power(&blocks, of, steps)?;
        (refined, Some(found), Diagnostics::of_power(l_max, &[]))
    } else {
        let LargestEigenvalue { value: w_max, iterations, .. } =
            largest_of_circle(&sums.circle, &order_blocks, watch);
        problem.regularisation = regulariser.diagonal(request.epsilon, w_max, l_max)?;
        let diagnostics = Diagnostics {
            epsilon: Some(request.epsilon),
            w_max: Some(w_max * pixel_area_sr(request.nside)),
            w_max_iterations: iterations,
            ..Diagnostics::of_power(l_max, &[])
        };
        (problem.solve(right.clone(), circle_data, steps)?, None, diagnostics)
    };
    let RefinedColumns {
        columns: [map, noise],
        convergence: [map_convergence, noise_convergence],
        residuals,
        direct,
    } = refined;
    diagnostics.convergence = Some(map_convergence);
    diagnostics.noise_convergence = Some(noise_convergence);
    let synthesise = |x: &[f64]| synthesis(&coefficients(x, l_max), request.nside).map_err(SolveError::from);
    let mut whole = map.x.clone();
    if let Some(prior) = prior {
        add(&mut whole, &prior);
    }
    let errors = |found: &FoundPower| {
        let posterior = Posterior {
            sums: &sums.circle,
            blocks: &blocks,
            found,
            right: &right[0],
            solved: &map.x,
            whole: &whole,
            nside: request.nside,
            rule: request.rule,
            watch: watch.beside_map(),
        };
        posterior.uncertainty(request.samples, &|x| problem.normal(x))
    };
    let uncertainty = found.as_ref().map(errors).transpose()?;
    let refinement = Refinement {
        convergence: map_convergence,
        residuals,
        direct,
        departures: sums.departures,
        rows_computed: sums.plan.computed() as u64,
        taken_as_instants: sums.plan.instants() as u64,
        chi_square: chi_squares(sums, &problem.data_residuals(&whole)),
    };
    let solution = HarmonicSolution {
        map_k: synthesise(&whole)?,
        noise_k: synthesise(&noise.x)?,
        unknowns: [map.x, noise.x],
        diagnostics,
        uncertainty,
    };
    Ok((solution, refinement))
}

/// The true normal equations and the settings of their solution.
pub(super) struct RefinedProblem<'a> {
    pub(super) sums: &'a RefinedSums,
    pub(super) regularisation: Diagonal,
    /// Iteration limit of inner solutions.
    pub(super) inner: StoppingRule,
    pub(super) rule: RefineRule,
    pub(super) watch: NamedWatch<'a>,
}

/// Right-hand sides of a refined map.
#[derive(Clone, Copy)]
pub(super) struct RightHandSides<'a> {
    /// Of the map and of the noise-only map, by true rows.
    pub(super) of_rows: &'a [Vec<f64>; 2],
    /// Of the map, by the circle's.
    pub(super) of_circle: &'a [f64],
    pub(super) prior: Option<&'a [f64]>,
}

/// The solutions for the map and the noise-only map, with their convergence.
pub(super) struct RefinedColumns {
    pub(super) columns: [Column; 2],
    pub(super) convergence: [Convergence; 2],
    /// Residual of the map after each iteration.
    pub(super) residuals: Vec<f64>,
    pub(super) direct: bool,
}

/// The circle's matrix plus a multiple of R.
struct CircleSystem {
    regularisation: Diagonal,
    factors: OrderFactors,
}

impl RefinedProblem<'_> {
    pub(super) fn l_max(&self) -> usize {
        self.sums.circle.setup().l_max
    }

    /// The right-hand sides of the map less its prior and of the noise-only map.
    fn right(&self, prior: Option<&[f64]>) -> [Vec<f64>; 2] {
        let RefinedSums { rows, plan, data, .. } = self.sums;
        let predicted = prior.map(|prior| rows.forward(plan, &[coefficients(prior, self.l_max())]));
        let predicted = predicted.iter().flatten().flatten();
        let predicted = predicted.copied().chain(std::iter::repeat(Complex64::ZERO));
        let values = data.value_k_sr.iter().zip(predicted).zip(&data.weight);
        let weighted: Vec<Complex64> =
            values.map(|((value, known), weight)| (value - known) * *weight).collect();
        let noise = data.noise.iter().zip(&data.weight);
        let noise: Vec<Complex64> = noise.map(|(noise, weight)| noise * weight.sqrt()).collect();
        let mut gradients = rows.adjoint(plan, &[&weighted, &noise]).into_iter();
        [(); 2].map(|()| gradients.next().as_ref().map(unknowns_of_gradient).unwrap_or_default())
    }

    /// Residuals of the data for these coefficients, K sr.
    pub(super) fn data_residuals(&self, whole: &[f64]) -> Vec<Complex64> {
        let RefinedSums { rows, plan, data, .. } = self.sums;
        let seen = rows.forward(plan, &[coefficients(whole, self.l_max())]);
        data.value_k_sr.iter().zip(seen.iter().flatten()).map(|(value, seen)| value - seen).collect()
    }

    /// Products of the true matrix with several vectors, for which rows are computed once.
    fn normal(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let RefinedSums { rows, plan, data, .. } = self.sums;
        let skies: Vec<_> = x.iter().map(|x| coefficients(x, self.l_max())).collect();
        rows.normal(plan, &skies, &data.weight).iter().map(unknowns_of_gradient).collect()
    }

    /// Products of the true matrix plus R with several vectors, for which rows are computed once.
    fn products(&self, x: &[Vec<f64>]) -> Vec<Vec<f64>> {
        let mut products = self.normal(&x.iter().map(Vec::as_slice).collect::<Vec<_>>());
        products.iter_mut().zip(x).for_each(|(product, x)| self.regularisation.add_product(x, product));
        products
    }

    fn circle_system(&self, shift: f64) -> CircleSystem {
        let regularisation = self.regularisation.times(shift);
        let factors = self.sums.circle.order_blocks().factors_with(&|l| regularisation.at(l));
        CircleSystem { regularisation, factors }
    }

    /// Solves the circle's equations for several right-hand sides.
    fn solve_on_circle(&self, system: &CircleSystem, right: &[&[f64]], residual_max: f64) -> Vec<Vec<f64>> {
        let circle = System {
            sums: &self.sums.circle,
            regularisation: system.regularisation.clone(),
            precondition: &|v| system.factors.solve(v),
        };
        let mut z: Vec<Vec<f64>> = right.iter().map(|b| vec![0.0; b.len()]).collect();
        let rule = StoppingRule { residual_max, ..self.inner };
        circle.solve(
            right,
            &mut z,
            &vec![rule; right.len()],
            &self.watch.inner("on the nearest circle", residual_max),
        );
        z
    }

    /// Solves for two right-hand sides; `circle_data` is the first one computed with the circle's rows.
    pub(super) fn solve(
        &self,
        right: [Vec<f64>; 2],
        circle_data: Vec<f64>,
        steps: RefineSteps<'_>,
    ) -> Result<RefinedColumns, SolveError> {
        let RefineRule { passes_max, residual_max } = self.rule;
        let task = self.watch.start("refined map", residual_max);
        let mut shifts = vec![self.circle_system(SHIFTS[0])];
        let both = right.each_ref().map(Vec::as_slice);
        let mut directions = self.solve_on_circle(&shifts[0], &both, INNER_RESIDUAL);
        let right_norms = [0, 1].map(|k| dot(&right[k], &directions[k]));
        let start = steps.start.filter(|start| right.iter().zip(start).all(|(b, x)| b.len() == x.len()));
        directions.extend(start.map_or_else(
            || {
                let circle = [circle_data.as_slice(), self.sums.circle.noise_right_hand_side()];
                self.solve_on_circle(&shifts[0], &circle, self.inner.residual_max)
            },
            Vec::from,
        ));
        let mut columns = right.clone().map(|residual| Column { x: vec![0.0; residual.len()], residual });
        let (mut subspace, mut relative, mut residuals) = (Subspace::default(), [1.0; 2], Vec::new());
        let mut direct = false;
        let worst = |relative: &[f64; 2]| relative[0].max(relative[1]);
        while residuals.len() < passes_max.max(1) && task.report(residuals.len(), worst(&relative)) {
            let products = self.products(&directions);
            let added = subspace.extend(directions.into_iter().zip(products), &mut columns);
            let left = columns.each_ref().map(|column| column.residual.as_slice());
            directions = self.solve_on_circle(&shifts[0], &left, INNER_RESIDUAL);
            relative = [0, 1].map(|k| relative_residual(&columns[k], &directions[k], right_norms[k]));
            residuals.push(relative[0]);
            (steps.save)([&columns[0].x, &columns[1].x]);
            if added == 0 || worst(&relative) <= residual_max {
                break;
            }
            if worst(&relative) > SLOW_RATIO.powi(residuals.len() as i32) {
                if residuals.len() >= SLOW_ITERATIONS_MAX && self.can_be_formed() {
                    break;
                }
                for shift in &SHIFTS[shifts.len()..] {
                    shifts.push(self.circle_system(*shift));
                }
            }
            let left = columns.each_ref().map(|column| column.residual.as_slice());
            for shift in &shifts[1..] {
                directions.extend(self.solve_on_circle(shift, &left, INNER_RESIDUAL));
            }
        }
        if residuals.is_empty() {
            return Err(SolveError::Interrupted);
        }
        let is_direct = worst(&relative) > residual_max && self.can_be_formed();
        let solved = is_direct.then(|| self.solve_directly(&right, &task, residuals.len())).flatten();
        if let Some(solved) = solved {
            (columns, direct) = (solved, true);
            let left = columns.each_ref().map(|column| column.residual.as_slice());
            let z = self.solve_on_circle(&shifts[0], &left, INNER_RESIDUAL);
            relative = [0, 1].map(|k| relative_residual(&columns[k], &z[k], right_norms[k]));
            residuals.push(relative[0]);
            (steps.save)([&columns[0].x, &columns[1].x]);
        }
        let convergence = relative.map(|residual| Convergence {
            iterations: residuals.len(),
            residual,
            converged: residual <= residual_max,
        });
        Ok(RefinedColumns { columns, convergence, residuals, direct })
    }

    fn can_be_formed(&self) -> bool {
        can_be_formed(self.sums.circle.unknowns(), self.sums.plan.computed())
    }

    /// Forms the matrix and solves by Cholesky factorisation; `None` if it is interrupted.
    fn solve_directly(
        &self,
        right: &[Vec<f64>; 2],
        task: &SolveTask<'_>,
        iterations: usize,
    ) -> Option<[Column; 2]> {
        let unknowns = right[0].len();
        let mut columns: Vec<Vec<f64>> = Vec::with_capacity(unknowns);
        while columns.len() < unknowns {
            if !task.report(iterations, 1.0) {
                return None;
            }
            let unit = |k: usize| (0..unknowns).map(|n| f64::from(u8::from(n == k))).collect();
            let units: Vec<Vec<f64>> =
                (columns.len()..unknowns.min(columns.len() + COLUMNS_AT_ONCE)).map(unit).collect();
            columns.extend(self.products(&units));
        }
        // The matrix is symmetric to 1e-6 only, because of sums in f32.
        let element = |a: usize, b: usize| 0.5 * (columns[a][b] + columns[b][a]);
        let factor = Mat::from_fn(unknowns, unknowns, element).llt(Side::Lower).ok()?;
        Some(right.each_ref().map(|right| {
            let solved = factor.solve(&Mat::from_fn(unknowns, 1, |k, _| right[k]));
            let x: Vec<f64> = (0..unknowns).map(|k| solved[(k, 0)]).collect();
            let mut residual = right.clone();
            for (a, left) in residual.iter_mut().enumerate() {
                *left -= (0..unknowns).map(|b| element(a, b) * x[b]).sum::<f64>();
            }
            Column { x, residual }
        }))
    }
}

/// Whether the true matrix of so many unknowns is formed from so many rows where a refinement converges slowly.
pub(super) fn can_be_formed(unknowns: usize, rows: usize) -> bool {
    unknowns <= DIRECT_UNKNOWNS_MAX && rows.saturating_mul(unknowns) <= DIRECT_PRODUCTS_MAX
}

/// The relative residual `sqrt(r.Mr / b.Mb)`, with `z = M r` and `right_norm = b.Mb`; 0 without data.
fn relative_residual(column: &Column, z: &[f64], right_norm: f64) -> f64 {
    if right_norm > 0.0 { (dot(&column.residual, z).max(0.0) / right_norm).sqrt() } else { 0.0 }
}
