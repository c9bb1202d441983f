//! Maximum of a smooth function by Newton's iteration, with the Fisher information for the second derivative.

use faer::linalg::solvers::DenseSolveCore;
use faer::{Mat, Side};

/// Maximum number of steps.
const STEPS_MAX: usize = 20;
/// Maximum change of a parameter in one step.
const STEP_MAX: f64 = 2.0;
/// Maximum number of halvings of a step without gain.
const HALVINGS: usize = 8;

/// Gradient and information, the negative second derivative or an approximation of it.
pub(in crate::imaging) type Derivatives = (Vec<f64>, Mat<f64>);

/// Maximises `objective` from `start` until a step gains less than `gain_min`; `None` if it or its derivatives do not exist there. `goes_on` hears
/// of every step and its gain.
pub(in crate::imaging) fn maximise(
    (start, gain_min): (Vec<f64>, f64),
    objective: &dyn Fn(&[f64]) -> Option<f64>,
    derivatives: &dyn Fn(&[f64]) -> Option<Derivatives>,
    goes_on: &dyn Fn(usize, f64) -> bool,
) -> Option<Vec<f64>> {
    let mut theta = start;
    let mut best = objective(&theta)?;
    for number in 0..STEPS_MAX {
        let (gradient, information) = derivatives(&theta)?;
        let Ok(factor) = information.llt(Side::Lower) else { break };
        let covariance = factor.inverse();
        let mut step: Vec<f64> = (0..gradient.len())
            .map(|k| gradient.iter().enumerate().map(|(j, g)| covariance[(k, j)] * g).sum())
            .collect();
        let longest = step.iter().fold(0.0_f64, |longest, step| longest.max(step.abs()));
        if longest > STEP_MAX {
            step.iter_mut().for_each(|step| *step *= STEP_MAX / longest);
        }
        let improved = (0..HALVINGS).find_map(|halving| {
            let share = 0.5_f64.powi(halving as i32);
            let trial: Vec<f64> = theta.iter().zip(&step).map(|(t, s)| t + share * s).collect();
            let found = objective(&trial).filter(|found| *found > best)?;
            Some((found, trial))
        });
        let Some((found, trial)) = improved else { break };
        let gain = found - best;
        (best, theta) = (found, trial);
        if gain < gain_min || !goes_on(number + 1, gain) {
            break;
        }
    }
    Some(theta)
}
