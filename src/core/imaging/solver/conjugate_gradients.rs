//! Solves `(BtN^-1B + R) x = b` by preconditioned conjugate gradients.

use super::vectors::{dot, subtract};
use super::watch::SolveTask;
use crate::imaging::NormalSums;
use crate::imaging::regulariser::Diagonal;

/// Stopping rule of an iteration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoppingRule {
    /// Target residual, relative to the right-hand side, in the preconditioner's norm.
    pub residual_max: f64,
    /// Maximum number of iterations.
    pub iterations_max: usize,
}

/// The result of an iteration.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
pub struct Convergence {
    /// Number of products with BtN^-1B.
    pub iterations: usize,
    /// `sqrt(r.Mr / b.Mb)`: r the residual, b the right-hand side, M the preconditioner, which approximates the inverse of the matrix.
    pub residual: f64,
    /// Whether the target residual was reached before the iteration limit or an interruption.
    pub converged: bool,
}

/// A symmetric system of equations with its preconditioner.
pub(in crate::imaging) struct System<'a> {
    pub(in crate::imaging) sums: &'a dyn NormalSums,
    pub(in crate::imaging) regularisation: Diagonal,
    /// Multiplies a vector by the preconditioner, in place.
    pub(in crate::imaging) precondition: &'a dyn Fn(&mut [f64]),
}

/// The iteration for one right-hand side.
struct Iteration {
    x: Vec<f64>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    /// Squared norm of the residual, in the preconditioner's norm.
    residual_square: f64,
    /// Squared norm of the right-hand side.
    right_square: f64,
    products: usize,
    /// Whether rounding errors, or a matrix or preconditioner that is not positive definite, prevent further progress.
    is_stuck: bool,
    /// The earlier solution with the smallest residual, and its square.
    best: Option<(f64, Vec<f64>)>,
}

/// Growth of the squared residual since its smallest value at which an iteration ends: the matrix is not positive definite within its accuracy,
/// as of few data that leave most of the sky open. The residuals of one that is may rise for a while, by no more than its condition number with
/// the preconditioner.
const GROWTH_MAX: f64 = 1e6;

impl Iteration {
    /// Starts from the initial guess `x` and its product with the matrix; `None` if the guess is zero.
    fn new(b: &[f64], x: Vec<f64>, product: Option<&[f64]>, precondition: &dyn Fn(&mut [f64])) -> Self {
        let preconditioned = |v: &[f64]| {
            let mut z = v.to_vec();
            precondition(&mut z);
            z
        };
        let right_square = dot(b, &preconditioned(b));
        let mut residual = b.to_vec();
        if let Some(product) = product {
            subtract(&mut residual, 1.0, product);
        }
        let direction = preconditioned(&residual);
        let residual_square = dot(&residual, &direction);
        let products = usize::from(product.is_some());
        let is_stuck = right_square < 0.0 || residual_square < 0.0;
        Self { x, residual, direction, residual_square, right_square, products, is_stuck, best: None }
    }

    /// The residual relative to the right-hand side; 0 if that is zero. Negative squares, of a preconditioner that is not positive definite, are
    /// no convergence.
    fn relative_residual(&self) -> f64 {
        match self.right_square {
            0.0 => 0.0,
            square if square < 0.0 => f64::INFINITY,
            square => (self.residual_square.abs() / square).sqrt(),
        }
    }

    /// Whether the rule requires another iteration.
    fn needs_step(&self, rule: StoppingRule) -> bool {
        !self.is_stuck && self.relative_residual() > rule.residual_max && self.products < rule.iterations_max
    }

    /// Takes a step along the current direction, given its product with the matrix, and computes the next direction.
    fn step(&mut self, product: &[f64], precondition: &dyn Fn(&mut [f64])) {
        self.products += 1;
        let curvature = dot(&self.direction, product);
        if curvature.is_nan() || curvature <= 0.0 {
            self.is_stuck = true;
            return;
        }
        let step = self.residual_square / curvature;
        let before = self.x.clone();
        self.x.iter_mut().zip(&self.direction).for_each(|(x, d)| *x += step * d);
        subtract(&mut self.residual, step, product);
        let mut z = self.residual.clone();
        precondition(&mut z);
        let next = dot(&self.residual, &z);
        let beta = next / self.residual_square;
        self.keep_best(next, before);
        self.residual_square = next;
        self.direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + beta * *d);
    }

    /// Keeps the solution before a step after which the square of the residual is `next`, if it is the best so far and the step makes it worse.
    fn keep_best(&mut self, next: f64, before: Vec<f64>) {
        let least = self.best.as_ref().map_or(f64::INFINITY, |(square, _)| *square);
        let is_worse = next.is_nan() || next >= self.residual_square;
        if is_worse && self.residual_square < least {
            self.best = Some((self.residual_square, before));
        }
        let limit = GROWTH_MAX * least.min(self.residual_square);
        self.is_stuck |= next.is_nan() || next < 0.0 || next > limit;
    }

    /// Returns to the solution of the smallest residual if the iteration is stuck. Otherwise the last one is the best: errors fall with every
    /// step, although residuals may rise (Hestenes & Stiefel 1952).
    fn settle(&mut self) {
        let is_least = |square: f64| (0.0..=square).contains(&self.residual_square);
        let best = self.best.take().filter(|(square, _)| self.is_stuck && !is_least(*square));
        if let Some((square, x)) = best {
            (self.residual_square, self.x) = (square, x);
        }
    }

    fn convergence(&self, rule: StoppingRule) -> Convergence {
        let residual = self.relative_residual();
        Convergence { iterations: self.products, residual, converged: residual <= rule.residual_max }
    }
}

/// Solves a system for one right-hand side from zero. `product` multiplies by the matrix, `precondition` in place by the preconditioner.
pub(in crate::imaging) fn solve_one(
    b: &[f64],
    rule: StoppingRule,
    product: &dyn Fn(&[f64]) -> Vec<f64>,
    precondition: &dyn Fn(&mut [f64]),
) -> (Vec<f64>, Convergence) {
    let mut iteration = Iteration::new(b, vec![0.0; b.len()], None, precondition);
    while iteration.needs_step(rule) {
        let along = product(&iteration.direction);
        iteration.step(&along, precondition);
    }
    iteration.settle();
    let convergence = iteration.convergence(rule);
    (iteration.x, convergence)
}

impl System<'_> {
    /// Multiplies several vectors by `BtN^-1B + R`.
    fn apply(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let mut products = self.sums.apply_all(x);
        products.iter_mut().zip(x).for_each(|(product, x)| self.regularisation.add_product(x, product));
        products
    }

    /// Solves for each right-hand side `b` by its own rule, from the initial guesses in `x`, which then hold the solutions. An interrupted
    /// iteration leaves its last solution, one that gets stuck that of the smallest residual. Products are computed together, but each solution has the bits that it would have alone.
    pub(in crate::imaging) fn solve(
        &self,
        b: &[&[f64]],
        x: &mut [Vec<f64>],
        rules: &[StoppingRule],
        task: &SolveTask<'_>,
    ) -> Vec<Convergence> {
        let is_guess = |x: &Vec<f64>| x.iter().any(|x| *x != 0.0);
        let guesses: Vec<&[f64]> = x.iter().filter(|x| is_guess(x)).map(Vec::as_slice).collect();
        let mut products = if guesses.is_empty() { Vec::new() } else { self.apply(&guesses) }.into_iter();
        let mut iterations: Vec<Iteration> = b
            .iter()
            .zip(x.iter_mut())
            .map(|(b, x)| {
                let product = is_guess(x).then(|| products.next()).flatten();
                Iteration::new(b, std::mem::take(x), product.as_deref(), self.precondition)
            })
            .collect();
        loop {
            let needs_step: Vec<bool> =
                iterations.iter().zip(rules).map(|(one, rule)| one.needs_step(*rule)).collect();
            let products = iterations.iter().map(|iteration| iteration.products).max().unwrap_or(0);
            let residual = iterations.iter().map(Iteration::relative_residual).fold(0.0, f64::max);
            let continues = task.report_each(&needs_step, products, residual);
            let mut running: Vec<&mut Iteration> = iterations
                .iter_mut()
                .zip(continues)
                .filter_map(|(one, continues)| continues.then_some(one))
                .collect();
            if running.is_empty() {
                break;
            }
            let directions: Vec<&[f64]> = running.iter().map(|one| one.direction.as_slice()).collect();
            let products = self.apply(&directions);
            for (iteration, product) in running.iter_mut().zip(&products) {
                iteration.step(product, self.precondition);
            }
        }
        iterations.iter_mut().for_each(Iteration::settle);
        let convergence = iterations.iter().zip(rules).map(|(one, rule)| one.convergence(*rule)).collect();
        x.iter_mut().zip(iterations).for_each(|(x, iteration)| *x = iteration.x);
        convergence
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::imaging::solver::SolveWatch;
    use crate::imaging::{Accuracy, SumCounts};
    use crate::ranks::on_threads;

    const ORDER: usize = 40;

    /// A symmetric matrix with eigenvalues from 1 (or another) to 40 that records the number of vectors in each product.
    #[derive(Default)]
    struct TestMatrix {
        products: Mutex<Vec<usize>>,
        first: Option<f64>,
    }

    impl NormalSums for TestMatrix {
        fn unknowns(&self) -> usize {
            ORDER
        }

        /// With v a unit vector, `(1 - 2 v v') D (1 - 2 v v')`.
        fn apply(&self, x: &[f64], y: &mut [f64]) {
            let mirrored = |x: &[f64]| {
                let twice = 2.0 * x.iter().sum::<f64>() / ORDER as f64;
                x.iter().map(|x| x - twice).collect::<Vec<f64>>()
            };
            let eigenvalue = |k: usize| if k == 0 { self.first.unwrap_or(1.0) } else { (k + 1) as f64 };
            let scaled: Vec<f64> = mirrored(x).iter().enumerate().map(|(k, x)| eigenvalue(k) * x).collect();
            y.copy_from_slice(&mirrored(&scaled));
        }

        fn apply_all(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
            self.products.lock().unwrap().push(x.len());
            let product = |x: &&[f64]| {
                let mut y = vec![0.0; ORDER];
                self.apply(x, &mut y);
                y
            };
            x.iter().map(product).collect()
        }

        fn right_hand_side(&self) -> &[f64] {
            &[]
        }

        fn noise_right_hand_side(&self) -> &[f64] {
            &[]
        }

        fn counts(&self) -> SumCounts {
            SumCounts::default()
        }

        fn accuracy(&self) -> Accuracy {
            Accuracy { relative: 0.0, absolute: 0.0 }
        }
    }

    fn solve(
        matrix: &TestMatrix,
        b: &[&[f64]],
        x: &mut [Vec<f64>],
        rule: StoppingRule,
        watch: &SolveWatch,
    ) -> Vec<Convergence> {
        let system = System { sums: matrix, regularisation: Diagonal::Uniform(0.5), precondition: &|_| () };
        let rules = vec![rule; b.len()];
        system.solve(b, x, &rules, &watch.named("test").start("columns", rule.residual_max))
    }

    const RULE: StoppingRule = StoppingRule { residual_max: 1e-6, iterations_max: 100 };

    #[test]
    fn columns_of_all_kinds_have_the_bits_of_each_alone() {
        let wave = |f: f64| (0..ORDER).map(|k| (f * k as f64).sin()).collect::<Vec<f64>>();
        let matrix = TestMatrix::default();
        let zeros = vec![0.0; ORDER];
        let watch = SolveWatch::default();
        let mut solved = [zeros.clone()];
        solve(&matrix, &[&wave(0.3)], &mut solved, RULE, &watch);
        let [solved] = solved;
        // A zero right-hand side; one that is solved already; one with the solution of another as guess; a plain one; and NaN.
        let columns = [
            (zeros.clone(), zeros.clone()),
            (wave(0.3), solved.clone()),
            (wave(0.7), solved),
            (wave(1.1), zeros.clone()),
            (vec![f64::NAN; ORDER], zeros),
        ];
        let bits = |x: &[f64]| x.iter().map(|x| x.to_bits()).collect::<Vec<u64>>();
        let b: Vec<&[f64]> = columns.iter().map(|(b, _)| b.as_slice()).collect();
        let mut together: Vec<Vec<f64>> = columns.iter().map(|(_, x)| x.clone()).collect();
        let found = solve(&matrix, &b, &mut together, RULE, &watch);
        for (k, (b, x)) in columns.iter().enumerate() {
            let mut alone = [x.clone()];
            let convergence = solve(&matrix, &[b], &mut alone, RULE, &watch)[0];
            assert_eq!(bits(&together[k]), bits(&alone[0]), "{k}");
            assert_eq!(format!("{:?}", found[k]), format!("{convergence:?}"), "{k}");
        }
        let products: Vec<usize> = found.iter().map(|one| one.iterations).collect();
        assert!(products[0] == 0 && products[1] == 1 && products[2] > 5 && products[3] > 5, "{products:?}");
        let converged: Vec<bool> = found.iter().map(|one| one.converged).collect();
        assert_eq!(converged, [true, true, true, true, false]);
        // The solution satisfies `(A + 0.5 I) x = b`.
        let mut again = vec![0.0; ORDER];
        matrix.apply(&together[3], &mut again);
        for (k, (y, x)) in again.iter().zip(&together[3]).enumerate() {
            assert!((y + 0.5 * x - columns[3].0[k]).abs() < 1e-5, "{k}");
        }
    }

    /// Solves with the first eigenvalue changed; returns the convergence and the true residual.
    fn solved(first: f64, iterations_max: usize) -> (Convergence, f64) {
        let b: Vec<f64> = (0..ORDER).map(|k| (0.7 * k as f64).sin()).collect();
        let matrix = TestMatrix { first: Some(first), ..TestMatrix::default() };
        let system = System { sums: &matrix, regularisation: Diagonal::Uniform(0.0), precondition: &|_| {} };
        let mut x = [vec![0.0; ORDER]];
        let rule = StoppingRule { residual_max: 1e-12, iterations_max };
        let watch = SolveWatch::default();
        let task = watch.named("x").start("map", 1e-12);
        let found = system.solve(&[&b], &mut x, &[rule], &task)[0];
        let mut residual = vec![0.0; ORDER];
        matrix.apply(&x[0], &mut residual);
        subtract(&mut residual, 1.0, &b);
        (found, (dot(&residual, &residual) / dot(&b, &b)).sqrt())
    }

    /// Residuals by numpy. With -1e-4 the curvature ends the iteration, with -1e-6 the residual, which has grown 3412-fold.
    #[test]
    fn a_matrix_that_is_not_positive_definite_leaves_the_solution_of_the_smallest_residual() {
        for (first, least, products) in [(-1e-4, 0.061_728_034_9, 20), (-1e-6, 0.061_725_011_8, 22)] {
            let (found, residual) = solved(first, 3 * ORDER);
            assert!(!found.converged && found.iterations == products, "{first}: {found:?}");
            assert!((found.residual - least).abs() < 1e-8, "{first}: {found:?}");
            // The residual that is said is that of the solution; rounding errors accumulate.
            assert!((residual - found.residual).abs() < 1e-8, "{residual} {found:?}");
        }
    }

    /// By numpy the residual rises from 0.0617 after 7 steps to 1.5516 after 18, while the error falls with every step.
    #[test]
    fn an_iteration_that_is_cut_leaves_its_last_solution() {
        for (steps, expected) in [(7, 0.061_694_464_7), (18, 1.551_555_085_0)] {
            let (found, residual) = solved(1e-3, steps);
            assert!((found.residual - expected).abs() < 1e-8, "{steps}: {found:?}");
            assert!((residual - expected).abs() < 1e-8, "{steps}: {residual}");
        }
        assert!(solved(1e-3, 3 * ORDER).0.converged);
    }

    /// Ranks whose processors round differently would stop at different iterations.
    #[test]
    fn ranks_end_a_column_together() {
        let wave = |f: f64| (0..ORDER).map(|k| (f * k as f64).sin()).collect::<Vec<f64>>();
        let b = [wave(0.7), wave(1.1)];
        let found = on_threads(3, |ranks| {
            let matrix = TestMatrix::default();
            let watch = SolveWatch::default().with_ranks(ranks);
            let residual_max = [1e-3, 1e-6, 1e-9][ranks.share().rank];
            let mut x = [vec![0.0; ORDER], vec![0.0; ORDER]];
            let b: Vec<&[f64]> = b.iter().map(Vec::as_slice).collect();
            solve(&matrix, &b, &mut x, StoppingRule { residual_max, ..RULE }, &watch);
            (matrix.products.into_inner().unwrap(), x)
        });
        assert!(found[0].0.len() > 3 && found.iter().all(|one| *one == found[0]), "{:?}", found[0].0);
    }
}
