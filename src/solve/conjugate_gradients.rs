//! Conjugate gradients for `(BtN^-1B + R) x = b`.

use super::regulariser::Diagonal;
use super::vectors::{dot, subtract};
use super::watch::SolveTask;
use crate::accumulation::NormalSums;

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoppingRule {
    /// Greatest residual, relative to the right-hand side, in the preconditioner's norm.
    pub residual_max: f64,
    /// Iteration limit.
    pub iterations_max: usize,
}

/// How an iteration ended.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, bincode::Encode, bincode::Decode)]
pub struct Convergence {
    /// Products with BtN^-1B.
    pub iterations: usize,
    /// `sqrt(r.Mr / b.Mb)`, M the preconditioner, r the residual, b the right-hand side.
    pub residual: f64,
    /// Whether the residual was reached; if not, the iteration limit was, or the run was interrupted.
    pub converged: bool,
}

/// A symmetric system.
pub(super) struct System<'a> {
    pub(super) sums: &'a dyn NormalSums,
    pub(super) regularisation: Diagonal,
    /// Multiplies a vector by the preconditioner, in place.
    pub(super) precondition: &'a dyn Fn(&mut [f64]),
}

/// One right-hand side on its way.
struct Iteration {
    x: Vec<f64>,
    residual: Vec<f64>,
    direction: Vec<f64>,
    /// The residual's square in the preconditioner's norm.
    energy: f64,
    /// The right-hand side's.
    whole: f64,
    products: usize,
    /// Rounding errors dominate: no further gain is possible.
    is_stuck: bool,
}

impl Iteration {
    /// From the first guess `x`, whose product is known unless it is zero.
    fn new(b: &[f64], x: Vec<f64>, product: Option<&[f64]>, precondition: &dyn Fn(&mut [f64])) -> Self {
        let preconditioned = |v: &[f64]| {
            let mut z = v.to_vec();
            precondition(&mut z);
            z
        };
        let whole = dot(b, &preconditioned(b));
        let mut residual = b.to_vec();
        if let Some(product) = product {
            subtract(&mut residual, 1.0, product);
        }
        let direction = preconditioned(&residual);
        let energy = dot(&residual, &direction);
        let products = usize::from(product.is_some());
        Self { x, residual, direction, energy, whole, products, is_stuck: false }
    }

    /// The residual, relative to the right-hand side; 0 if that is zero.
    fn relative(&self) -> f64 {
        if self.whole > 0.0 { (self.energy.max(0.0) / self.whole).sqrt() } else { 0.0 }
    }

    fn wants(&self, rule: StoppingRule) -> bool {
        !self.is_stuck && self.relative() > rule.residual_max && self.products < rule.iterations_max
    }

    /// Takes the step along the direction, of which this is the product, and turns to the next.
    fn step(&mut self, product: &[f64], precondition: &dyn Fn(&mut [f64])) {
        self.products += 1;
        let curvature = dot(&self.direction, product);
        if curvature.is_nan() || curvature <= 0.0 {
            self.is_stuck = true;
            return;
        }
        let step = self.energy / curvature;
        self.x.iter_mut().zip(&self.direction).for_each(|(x, d)| *x += step * d);
        subtract(&mut self.residual, step, product);
        let mut z = self.residual.clone();
        precondition(&mut z);
        let next = dot(&self.residual, &z);
        let turn = next / self.energy;
        self.energy = next;
        self.direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + turn * *d);
    }

    fn convergence(&self, rule: StoppingRule) -> Convergence {
        let residual = self.relative();
        Convergence { iterations: self.products, residual, converged: residual <= rule.residual_max }
    }
}

impl System<'_> {
    /// The products of several vectors with the system's matrix.
    fn apply(&self, x: &[&[f64]]) -> Vec<Vec<f64>> {
        let mut products = self.sums.apply_all(x);
        products.iter_mut().zip(x).for_each(|(product, x)| self.regularisation.add_product(x, product));
        products
    }

    /// Solves for each right-hand side `b` in place, from the first guess `x`; the best so far is left whenever it ends. Each solution has
    /// the bits that it has alone: only products are made together.
    pub(super) fn solve(
        &self,
        b: &[&[f64]],
        x: &mut [Vec<f64>],
        rule: StoppingRule,
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
        let goes_on = |iterations: &[Iteration]| {
            let wants = iterations.iter().any(|iteration| iteration.wants(rule));
            let products = iterations.iter().map(|iteration| iteration.products).max().unwrap_or(0);
            let residual = iterations.iter().map(Iteration::relative).fold(0.0, f64::max);
            task.report_wanting(wants, products, residual)
        };
        while goes_on(&iterations) {
            let mut wanting: Vec<&mut Iteration> =
                iterations.iter_mut().filter(|iteration| iteration.wants(rule)).collect();
            let directions: Vec<&[f64]> = wanting.iter().map(|one| one.direction.as_slice()).collect();
            let products = self.apply(&directions);
            for (iteration, product) in wanting.iter_mut().zip(&products) {
                iteration.step(product, self.precondition);
            }
        }
        let convergence = iterations.iter().map(|iteration| iteration.convergence(rule)).collect();
        x.iter_mut().zip(iterations).for_each(|(x, iteration)| *x = iteration.x);
        convergence
    }
}
