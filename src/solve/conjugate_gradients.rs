//! Conjugate gradients for `(BtN^-1B + R) x = b`.

use super::watch::Work;
use crate::accumulation::NormalSums;

/// When to stop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoppingRule {
    /// Residual, in the norm of the preconditioner and relative to the right-hand side's, below which it ends.
    pub residual_max: f64,
    /// Most iterations.
    pub iterations_max: usize,
}

/// How an iteration ended.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Convergence {
    /// Products with BtN^-1B.
    pub iterations: usize,
    /// `sqrt(r.Mr / b.Mb)`, M the preconditioner, r the residual, b the right-hand side.
    pub residual: f64,
    /// Whether the stopping rule was met; if not, the iterations were used up or the run was interrupted.
    pub converged: bool,
}

/// A symmetric system.
pub(super) struct System<'a> {
    pub(super) sums: &'a dyn NormalSums,
    /// R = `regularisation` I.
    pub(super) regularisation: f64,
    /// Replaces a vector by the preconditioner times it.
    pub(super) precondition: &'a dyn Fn(&mut [f64]),
}

impl System<'_> {
    fn apply(&self, x: &[f64], y: &mut [f64]) {
        self.sums.apply(x, y);
        for (y, x) in y.iter_mut().zip(x) {
            *y += self.regularisation * x;
        }
    }

    /// Solves for `right`, from `x` on, in place; what it leaves is the best so far whenever it ends.
    pub(super) fn solve(
        &self,
        right: &[f64],
        x: &mut [f64],
        rule: StoppingRule,
        work: &Work<'_>,
    ) -> Convergence {
        let mut residual = right.to_vec();
        let mut product = vec![0.0; x.len()];
        let mut iterations = 0;
        if x.iter().any(|x| *x != 0.0) {
            self.apply(x, &mut product);
            iterations += 1;
            residual.iter_mut().zip(&product).for_each(|(r, p)| *r -= p);
        }
        let preconditioned = |v: &[f64]| {
            let mut z = v.to_vec();
            (self.precondition)(&mut z);
            z
        };
        let whole = dot(right, &preconditioned(right));
        if whole <= 0.0 {
            return Convergence { iterations, residual: 0.0, converged: true };
        }
        let mut z = preconditioned(&residual);
        let mut energy = dot(&residual, &z);
        let mut direction = z.clone();
        let relative = |energy: f64| (energy.max(0.0) / whole).sqrt();
        while relative(energy) > rule.residual_max
            && iterations < rule.iterations_max
            && work.goes_on(iterations, relative(energy))
        {
            self.apply(&direction, &mut product);
            iterations += 1;
            let curvature = dot(&direction, &product);
            // Rounding has eaten what was left to gain.
            if curvature.is_nan() || curvature <= 0.0 {
                break;
            }
            let step = energy / curvature;
            x.iter_mut().zip(&direction).for_each(|(x, d)| *x += step * d);
            residual.iter_mut().zip(&product).for_each(|(r, p)| *r -= step * p);
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

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
