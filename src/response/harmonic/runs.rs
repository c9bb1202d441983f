//! Runs: consecutive states of a pair along which node and baseline change little and linearly.
//!
//! In an observing window the node moves by 0.4 mrad and the baseline by a fraction of a wavelength, while the phase
//! covers a third of a turn. Along such a run everything but `exp(-i mu gamma)` is smooth in the phase, so a few
//! Chebyshev points represent it.

use std::f64::consts::{PI, TAU};

use super::PairState;

/// Consecutive states with `node = node[0] + node[1] tau`, `u = u[0] + u[1] tau`,
/// `tau = (phase - phase[0]) / phase[1]` between -1 and 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Run {
    pub(crate) first: usize,
    pub(crate) len: usize,
    pub(crate) phase: [f64; 2],
    pub(crate) node: [f64; 2],
    pub(crate) u: [f64; 2],
    /// Phase swept in one integration, the mean of the run.
    pub(crate) span: f64,
}

/// Limits of a run.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RunLimits {
    /// Greatest order m.
    pub(crate) l_max: f64,
    /// Greatest half range of u.
    pub(crate) u_half: f64,
    /// Greatest half range of the node, rad.
    pub(crate) node_half: f64,
    /// Greatest half range of the phase `2 pi u + m node`, rad.
    pub(crate) drift_half: f64,
    /// Greatest deviation of that phase from a straight line, rad.
    pub(crate) residual: f64,
}

impl Run {
    /// `tau` of a phase, rad.
    #[inline]
    pub(crate) fn tau(&self, phase_rad: f64) -> f64 {
        (wrap(phase_rad - self.phase[0]) / self.phase[1]).clamp(-1.0, 1.0)
    }
}

/// Reduces an angle to [-pi, pi].
#[inline]
pub(crate) fn wrap(angle: f64) -> f64 {
    angle - TAU * (angle / TAU).round()
}

/// Splits `states` into runs, in order.
pub(crate) fn split(states: &[PairState], limits: RunLimits) -> Vec<Run> {
    let mut runs = Vec::new();
    let mut first = 0;
    let mut swept = 0.0;
    for k in 1..=states.len() {
        let ends = k == states.len() || {
            let step = wrap(states[k].phase_rad - states[k - 1].phase_rad);
            swept += step;
            breaks(&states[k - 1], &states[k], step, limits) || swept > 0.95 * TAU
        };
        if ends {
            cut(states, first, k - first, limits, &mut runs);
            first = k;
            swept = 0.0;
        }
    }
    runs
}

/// Whether `b` cannot continue a run after `a`.
fn breaks(a: &PairState, b: &PairState, step: f64, limits: RunLimits) -> bool {
    let drift = TAU * (b.baseline_wavelengths - a.baseline_wavelengths).abs()
        + limits.l_max * wrap(b.node_rad - a.node_rad).abs();
    step <= 0.0
        || step > 0.25 * PI
        || drift > limits.drift_half
        || (b.span_rad - a.span_rad).abs() > 0.02 * a.span_rad.abs()
}

/// Halves an interval of states until each part is a run.
fn cut(states: &[PairState], first: usize, len: usize, limits: RunLimits, runs: &mut Vec<Run>) {
    let run = straight(states, first, len);
    if len <= 1 || fits(&states[first..first + len], &run, limits) {
        runs.push(run);
    } else {
        let half = len / 2;
        cut(states, first, half, limits, runs);
        cut(states, first + half, len - half, limits, runs);
    }
}

/// The straight line through the ends of an interval of states.
fn straight(states: &[PairState], first: usize, len: usize) -> Run {
    let (a, b) = (&states[first], &states[first + len - 1]);
    // Steps are forward and add up to less than a turn.
    let swept = (b.phase_rad - a.phase_rad).rem_euclid(TAU);
    let turned = wrap(b.node_rad - a.node_rad);
    let grown = b.baseline_wavelengths - a.baseline_wavelengths;
    Run {
        first,
        len,
        phase: [a.phase_rad + 0.5 * swept, (0.5 * swept).max(1e-12)],
        node: [a.node_rad + 0.5 * turned, 0.5 * turned],
        u: [a.baseline_wavelengths + 0.5 * grown, 0.5 * grown],
        span: 0.5 * (a.span_rad + b.span_rad),
    }
}

fn fits(states: &[PairState], run: &Run, limits: RunLimits) -> bool {
    let drift = TAU * run.u[1].abs() + limits.l_max * run.node[1].abs();
    let spans = (states[0].span_rad - run.span).abs() <= 0.02 * run.span.abs();
    spans
        && run.u[1].abs() <= limits.u_half
        && run.node[1].abs() <= limits.node_half
        && drift <= limits.drift_half
        && states.iter().all(|state| {
            let tau = run.tau(state.phase_rad);
            let u = state.baseline_wavelengths - run.u[0] - run.u[1] * tau;
            let node = wrap(state.node_rad - run.node[0] - run.node[1] * tau);
            TAU * u.abs() + limits.l_max * node.abs() <= limits.residual
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: RunLimits =
        RunLimits { l_max: 100.0, u_half: 0.2, node_half: 0.01, drift_half: 1.5, residual: 1e-5 };

    fn window(from: f64, u: f64, rate: f64) -> Vec<PairState> {
        (0..400)
            .map(|k| {
                let phase = 0.005 * f64::from(k);
                PairState {
                    node_rad: 1.0 - 2e-4 * phase,
                    phase_rad: wrap(from + phase),
                    baseline_wavelengths: u + rate * (phase - 1.0).abs(),
                    span_rad: 0.005,
                }
            })
            .collect()
    }

    #[test]
    fn states_are_cut_at_jumps_and_at_a_kink() {
        let mut states = window(2.0, 20.0, 0.0);
        states.extend(window(2.0, 30.0, 0.1));
        let runs = split(&states, LIMITS);
        assert_eq!(runs[0].len, 400);
        let total: usize = runs.iter().map(|run| run.len).sum();
        assert_eq!(total, 800);
        // The kink in the middle of the second window costs about a halving a bit of its place.
        assert!(runs.len() > 2 && runs.len() < 12, "{}", runs.len());
        for run in &runs {
            for state in &states[run.first..run.first + run.len] {
                let tau = run.tau(state.phase_rad);
                assert!((run.u[0] + run.u[1] * tau - state.baseline_wavelengths).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn unordered_states_are_single_runs() {
        let states: Vec<_> = window(0.0, 5.0, 0.0).into_iter().rev().collect();
        assert_eq!(split(&states, LIMITS).len(), 400);
    }
}
