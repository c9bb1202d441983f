//! Runs: consecutive states of a pair along which node and baseline change little and linearly.
//!
//! In an observing window the node moves by 0.4 mrad and the baseline by a fraction of a wavelength, while the orbital phase
//! covers a third of a turn. Along such a run all factors except `exp(-i mu gamma)` are smooth in the phase, so that a few
//! Chebyshev points represent them.

use std::f64::consts::{PI, TAU};

use super::PairState;

/// Centre and half of a range of values.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Range {
    pub(crate) centre: f64,
    /// Half the difference of the last value and the first.
    pub(crate) half: f64,
}

/// Consecutive states whose node and u are linear in `tau = (phase - phase.centre) / phase.half`, between -1 and 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Run {
    pub(crate) first: usize,
    pub(crate) len: usize,
    pub(crate) phase: Range,
    pub(crate) node: Range,
    pub(crate) u: Range,
    /// Mean phase swept in one integration, rad.
    pub(crate) span: f64,
}

/// Fraction of a turn that a run may cover.
const TURN_FRACTION_MAX: f64 = 0.95;

/// Maximum step of the orbital phase between consecutive states, rad.
const PHASE_STEP_RAD_MAX: f64 = 0.25 * PI;

/// Maximum relative change of the integration's span within a run, which has one span for all states.
const SPAN_CHANGE_MAX: f64 = 0.02;

#[derive(Clone, Copy, Debug)]
pub(crate) struct RunLimits {
    pub(crate) m_max: f64,
    pub(crate) u_half: f64,
    pub(crate) node_half: f64,
    /// Maximum half range of the fringe phase `2 pi u + m node`, rad.
    pub(crate) fringe_phase_half: f64,
    /// Maximum deviation of the fringe phase from a straight line, rad.
    pub(crate) residual: f64,
}

impl Run {
    /// `tau` of an orbital phase, rad.
    #[inline]
    pub(crate) fn tau(&self, phase_rad: f64) -> f64 {
        (wrap(phase_rad - self.phase.centre) / self.phase.half).clamp(-1.0, 1.0)
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
            is_discontinuous(&states[k - 1], &states[k], step, limits) || swept > TURN_FRACTION_MAX * TAU
        };
        if ends {
            bisect(states, first, k - first, limits, &mut runs);
            first = k;
            swept = 0.0;
        }
    }
    runs
}

fn is_discontinuous(a: &PairState, b: &PairState, step: f64, limits: RunLimits) -> bool {
    let fringe_phase = TAU * (b.baseline_wavelengths - a.baseline_wavelengths).abs()
        + limits.m_max * wrap(b.node_rad - a.node_rad).abs();
    step <= 0.0
        || step > PHASE_STEP_RAD_MAX
        || fringe_phase > limits.fringe_phase_half
        || (b.span_rad - a.span_rad).abs() > SPAN_CHANGE_MAX * a.span_rad.abs()
}

/// Bisects an interval of states until each part is a run.
fn bisect(states: &[PairState], first: usize, len: usize, limits: RunLimits, runs: &mut Vec<Run>) {
    let run = chord(states, first, len);
    if len <= 1 || fits(&states[first..first + len], &run, limits) {
        runs.push(run);
    } else {
        let half = len / 2;
        bisect(states, first, half, limits, runs);
        bisect(states, first + half, len - half, limits, runs);
    }
}

/// The run that is linear between the ends of an interval of states.
fn chord(states: &[PairState], first: usize, len: usize) -> Run {
    let (a, b) = (&states[first], &states[first + len - 1]);
    // The phase rises by less than a turn.
    let swept = (b.phase_rad - a.phase_rad).rem_euclid(TAU);
    let turned = wrap(b.node_rad - a.node_rad);
    let grown = b.baseline_wavelengths - a.baseline_wavelengths;
    Run {
        first,
        len,
        phase: Range { centre: a.phase_rad + 0.5 * swept, half: (0.5 * swept).max(1e-12) },
        node: Range { centre: a.node_rad + 0.5 * turned, half: 0.5 * turned },
        u: Range { centre: a.baseline_wavelengths + 0.5 * grown, half: 0.5 * grown },
        span: 0.5 * (a.span_rad + b.span_rad),
    }
}

fn fits(states: &[PairState], run: &Run, limits: RunLimits) -> bool {
    let fringe_phase = TAU * run.u.half.abs() + limits.m_max * run.node.half.abs();
    let is_same_span = (states[0].span_rad - run.span).abs() <= SPAN_CHANGE_MAX * run.span.abs();
    is_same_span
        && run.u.half.abs() <= limits.u_half
        && run.node.half.abs() <= limits.node_half
        && fringe_phase <= limits.fringe_phase_half
        && states.iter().all(|state| {
            let tau = run.tau(state.phase_rad);
            let u = state.baseline_wavelengths - run.u.centre - run.u.half * tau;
            let node = wrap(state.node_rad - run.node.centre - run.node.half * tau);
            TAU * u.abs() + limits.m_max * node.abs() <= limits.residual
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: RunLimits =
        RunLimits { m_max: 100.0, u_half: 0.2, node_half: 0.01, fringe_phase_half: 1.5, residual: 1e-5 };

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
        // The kink in the middle of the second window adds about one bisection per bit of its index.
        assert!(runs.len() > 2 && runs.len() < 12, "{}", runs.len());
        for run in &runs {
            for state in &states[run.first..run.first + run.len] {
                let tau = run.tau(state.phase_rad);
                assert!((run.u.centre + run.u.half * tau - state.baseline_wavelengths).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn unordered_states_are_single_runs() {
        let states: Vec<_> = window(0.0, 5.0, 0.0).into_iter().rev().collect();
        assert_eq!(split(&states, LIMITS).len(), 400);
    }
}
