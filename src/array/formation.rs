//! Arcs of the daughters along the orbit, and their breathing.

use super::config::{ArrayConfig, ArrayError};

/// Greatest arcs by which the daughters trail daughter 1, and their breathing.
///
/// `s_1 = 0`, `s_n = a_offset + a0 q0^(n-2)` for n >= 2 at the start of a period; they shrink linearly to
/// `s_n / R_n` in half a period, and grow back (the paper, Sect. 2).
#[derive(Clone, Debug, PartialEq)]
pub struct Formation {
    /// Ratio q0 of successive steps.
    pub step_ratio: f64,
    /// Scale a0, m.
    pub scale_m: f64,
    /// Offset a_offset, m.
    pub offset_m: f64,
    arc_m_max: Vec<f64>,
    shrink: Vec<f64>,
    period_s: f64,
}

impl Formation {
    /// The formation of a configuration.
    ///
    /// # Errors
    /// [`ArrayError::Progression`] when no geometric progression meets the spacings.
    pub fn new(config: &ArrayConfig) -> Result<Self, ArrayError> {
        let breathing = &config.breathing;
        let first_m = breathing.first_ratio * breathing.first_spacing_m_min;
        let second_m = breathing.ratio * breathing.second_spacing_m_min;
        let span_m = breathing.span_m_max;
        let steps = config.satellites.saturating_sub(2);
        let step_ratio = step_ratio(steps, (span_m - first_m) / second_m).ok_or(ArrayError::Progression {
            satellites: config.satellites,
            first_m,
            second_m,
            span_m,
        })?;
        let scale_m = second_m / (step_ratio - 1.0);
        let offset_m = first_m - scale_m;
        let arc = |n: usize| match n {
            0 => 0.0,
            _ => offset_m + scale_m * step_ratio.powi(n as i32 - 1),
        };
        let ratio = |n: usize| {
            if n == 1 { breathing.first_ratio } else { breathing.ratio }
        };
        Ok(Self {
            step_ratio,
            scale_m,
            offset_m,
            arc_m_max: (0..config.satellites).map(arc).collect(),
            shrink: (0..config.satellites).map(|n| 1.0 - 1.0 / ratio(n)).collect(),
            period_s: breathing.period_s,
        })
    }

    /// Number of daughters.
    #[must_use]
    pub fn satellites(&self) -> usize {
        self.arc_m_max.len()
    }

    /// Breathing period, s.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        self.period_s
    }

    /// Arc of daughter `n` (from 0), m, and its rate, m/s, at `t_s`.
    #[must_use]
    pub fn arc_m(&self, n: usize, t_s: f64) -> (f64, f64) {
        let half_s = 0.5 * self.period_s;
        let into_s = t_s.rem_euclid(self.period_s);
        let rate_max = self.arc_m_max[n] * self.shrink[n] / half_s;
        if into_s < half_s {
            (self.arc_m_max[n] - rate_max * into_s, -rate_max)
        } else {
            (self.arc_m_max[n] - rate_max * (self.period_s - into_s), rate_max)
        }
    }

    /// The first instant after `t_s` at which the daughters' speeds change, s.
    #[must_use]
    pub fn next_turnaround_s(&self, t_s: f64) -> f64 {
        let half_s = 0.5 * self.period_s;
        ((t_s / half_s).floor() + 1.0) * half_s
    }
}

/// The q > 1 with (q^steps - 1) / (q - 1) = `sum`, by bisection; the left side rises with q.
fn step_ratio(steps: usize, sum: f64) -> Option<f64> {
    let steps = i32::try_from(steps).ok()?;
    let series = |q: f64| (0..steps).rev().fold(0.0, |acc, _| acc * q + 1.0);
    let (mut low, mut high) = (1.0_f64, 2.0_f64);
    if !sum.is_finite() || series(low) >= sum || steps < 2 {
        return None;
    }
    while series(high) < sum {
        high *= 2.0;
    }
    while high - low > 2.0 * f64::EPSILON * high {
        let middle = 0.5 * (low + high);
        if series(middle) < sum {
            low = middle
        } else {
            high = middle
        }
        if middle == low && middle == high {
            break;
        }
    }
    Some(0.5 * (low + high))
}
