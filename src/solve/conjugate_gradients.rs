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

impl System<'_> {
    fn apply(&self, x: &[f64], y: &mut [f64]) {
        self.sums.apply(x, y);
        self.regularisation.add_product(x, y);
    }

    /// Solves for the right-hand side `b` in place, from the first guess `x`; the best so far is left whenever it ends.
    pub(super) fn solve(
        &self,
        b: &[f64],
        x: &mut [f64],
        rule: StoppingRule,
        task: &SolveTask<'_>,
    ) -> Convergence {
        let mut residual = b.to_vec();
        let mut product = vec![0.0; x.len()];
        let mut iterations = 0;
        if x.iter().any(|x| *x != 0.0) {
            self.apply(x, &mut product);
            iterations += 1;
            subtract(&mut residual, 1.0, &product);
        }
        let preconditioned = |v: &[f64]| {
            let mut z = v.to_vec();
            (self.precondition)(&mut z);
            z
        };
        let whole = dot(b, &preconditioned(b));
        if whole <= 0.0 {
            return Convergence { iterations, residual: 0.0, converged: true };
        }
        let mut z = preconditioned(&residual);
        let mut energy = dot(&residual, &z);
        let mut direction = z.clone();
        let relative = |energy: f64| (energy.max(0.0) / whole).sqrt();
        let mut is_stuck = false;
        let wants = |energy: f64, iterations: usize| {
            relative(energy) > rule.residual_max && iterations < rule.iterations_max
        };
        while task.report_wanting(!is_stuck && wants(energy, iterations), iterations, relative(energy)) {
            self.apply(&direction, &mut product);
            iterations += 1;
            let curvature = dot(&direction, &product);
            // Rounding errors dominate: no further gain is possible.
            if curvature.is_nan() || curvature <= 0.0 {
                is_stuck = true;
                continue;
            }
            let step = energy / curvature;
            x.iter_mut().zip(&direction).for_each(|(x, d)| *x += step * d);
            subtract(&mut residual, step, &product);
            z.copy_from_slice(&residual);
            (self.precondition)(&mut z);
            let next = dot(&residual, &z);
            let turn = next / energy;
            energy = next;
            direction.iter_mut().zip(&z).for_each(|(d, z)| *d = z + turn * *d);
        }
        let residual = relative(energy);
        Convergence { iterations, residual, converged: residual <= rule.residual_max }
    }
}
