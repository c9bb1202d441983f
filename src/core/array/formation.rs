//! Arcs of the daughters along the orbit, and their breathing.

use super::config::{ArrayConfig, ArrayError, Spacing};

/// Maximum arcs by which the daughters trail daughter 1, and their breathing: the arcs shrink linearly to `s_n / R_n`
/// in half a period, and grow back (the paper, Sect. 3.1).
#[derive(Clone, Debug, PartialEq)]
pub struct Formation {
    /// Progression of the arcs, if they follow one.
    pub progression: Option<Progression>,
    arc_m_max: Vec<f64>,
    shrink: Vec<f64>,
    period_s: f64,
}

/// Arcs `s_1 = 0`, `s_n = a_offset + a0 q0^(n-2)` for n >= 2 (the paper, Sect. 3.1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Progression {
    /// Ratio q0 of successive steps.
    pub step_ratio: f64,
    /// Scale a0, m.
    pub scale_m: f64,
    /// Offset a_offset, m.
    pub offset_m: f64,
}

impl Progression {
    /// Computes the progression of a configuration, from daughter 2 at its distance to the last one at the full span.
    ///
    /// # Errors
    /// [`ArrayError::Progression`] if none meets the spacings.
    pub fn new(config: &ArrayConfig) -> Result<Self, ArrayError> {
        let breathing = &config.breathing;
        let first_m = breathing.first_ratio * breathing.first_spacing_m_min;
        let second_m = breathing.ratio * breathing.second_spacing_m_min;
        let span_m = breathing.span_m_max;
        let refused = || ArrayError::Progression { satellites: config.satellites, first_m, second_m, span_m };
        let steps = config.satellites.saturating_sub(2);
        // Three daughters have one step, from the second to the span, which leaves no choice.
        if breathing.growing == Spacing::Arcs || steps < 2 {
            let step_ratio = (span_m / first_m).powf(1.0 / steps.max(1) as f64);
            let rises = step_ratio.is_finite() && step_ratio > 1.0;
            return if rises {
                Ok(Self { step_ratio, scale_m: first_m, offset_m: 0.0 })
            } else {
                Err(refused())
            };
        }
        let step_ratio = step_ratio(steps, (span_m - first_m) / second_m).ok_or_else(refused)?;
        let scale_m = second_m / (step_ratio - 1.0);
        Ok(Self { step_ratio, scale_m, offset_m: first_m - scale_m })
    }

    /// Arc of daughter `n` (from 0), m.
    fn arc_m(&self, n: usize) -> f64 {
        match n {
            0 => 0.0,
            _ => self.offset_m + self.scale_m * self.step_ratio.powi(n as i32 - 1),
        }
    }
}

impl Formation {
    /// Creates the formation of a configuration.
    ///
    /// # Errors
    /// [`ArrayError::Progression`] if no progression meets the spacings; [`ArrayError::Meeting`] if daughters meet.
    pub fn new(config: &ArrayConfig) -> Result<Self, ArrayError> {
        let breathing = &config.breathing;
        let progression = if config.arcs_m.is_empty() { Some(Progression::new(config)?) } else { None };
        let arc_m_max: Vec<f64> = match progression {
            Some(progression) => (0..config.satellites).map(|n| progression.arc_m(n)).collect(),
            None => std::iter::once(0.0).chain(config.arcs_m.iter().copied()).collect(),
        };
        let ratio = |n: usize| if n == 1 { breathing.first_ratio } else { breathing.ratio };
        let narrow_m = |n: usize| arc_m_max[n] / ratio(n);
        // Arcs are linear in time between these extremes.
        for n in 1..arc_m_max.len() {
            let (wide_m, narrow_m) = ([arc_m_max[n - 1], arc_m_max[n]], [narrow_m(n - 1), narrow_m(n)]);
            if [wide_m, narrow_m].iter().any(|[before, after]| before >= after) {
                return Err(ArrayError::Meeting { first: n, wide_m, narrow_m });
            }
        }
        Ok(Self {
            progression,
            shrink: (0..arc_m_max.len()).map(|n| 1.0 - 1.0 / ratio(n)).collect(),
            arc_m_max,
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

    /// First instant after `t_s` at which the daughters' speeds change, s.
    #[must_use]
    pub fn next_turnaround_s(&self, t_s: f64) -> f64 {
        let half_s = 0.5 * self.period_s;
        let number = (t_s / half_s).floor() + 1.0;
        // The quotient of a turnaround may be rounded to below its integer.
        if number * half_s > t_s { number * half_s } else { (number + 1.0) * half_s }
    }
}

/// The q > 1 with (q^steps - 1) / (q - 1) = `sum`, by bisection; the left side increases with q.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::BreathingConfig;

    fn config(satellites: usize, breathing: BreathingConfig) -> ArrayConfig {
        ArrayConfig { satellites, breathing, ..ArrayConfig::default() }
    }

    fn arcs_m(formation: &Formation, t_s: f64) -> Vec<f64> {
        (0..formation.satellites()).map(|n| formation.arc_m(n, t_s).0).collect()
    }

    fn assert_close(found: &[f64], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            // Powers and differences of f64.
            assert!((found - expected).abs() <= 1e-12 * expected.abs(), "{found} {expected}");
        }
    }

    #[test]
    fn turnarounds_follow_one_another() {
        // Of these periods some turnarounds, divided by half a period, come out below their number.
        for period_s in [1_200_000.1, 27.321_661 * 86_400.0, 86_400.0, 1e5 / 3.0, 777.7] {
            let breathing = BreathingConfig { period_s, ..BreathingConfig::default() };
            let formation = Formation::new(&config(8, breathing)).unwrap();
            let mut t_s = 0.0;
            for number in 1..2000 {
                let next_s = formation.next_turnaround_s(t_s);
                // Of f64.
                assert!(
                    (next_s / (0.5 * period_s) - f64::from(number)).abs() < 1e-9,
                    "{period_s}: {number}, {next_s}"
                );
                t_s = next_s;
            }
        }
    }

    #[test]
    fn three_daughters_reach_from_the_first_distance_to_the_span() {
        let formation = Formation::new(&config(3, BreathingConfig::default())).unwrap();
        // 6 x 100 m and 100 km; in the middle of 14 days 100 m and a third.
        assert_close(&arcs_m(&formation, 0.0), &[0.0, 600.0, 100e3]);
        assert_close(&arcs_m(&formation, 7.0 * 86_400.0), &[0.0, 100.0, 100e3 / 3.0]);
    }

    #[test]
    fn growing_arcs_fill_the_near_end() {
        let near = BreathingConfig {
            growing: Spacing::Arcs,
            first_ratio: 1.0,
            ratio: 1.0,
            span_m_max: 12.8e3,
            ..BreathingConfig::default()
        };
        let formation = Formation::new(&config(9, near)).unwrap();
        assert_close(
            &arcs_m(&formation, 1e5),
            &[0.0, 100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0, 6400.0, 12_800.0],
        );
        // More daughters within the first ten kilometres than with growing steps.
        let count = |growing| {
            let breathing = BreathingConfig { growing, ..BreathingConfig::default() };
            let formation = Formation::new(&config(16, breathing)).unwrap();
            arcs_m(&formation, 0.0).into_iter().filter(|arc_m| *arc_m < 2000.0).count()
        };
        assert!(count(Spacing::Arcs) > count(Spacing::Steps) + 2);
    }

    #[test]
    fn arcs_can_be_given_one_by_one() {
        let mut config = config(4, BreathingConfig::default());
        config.arcs_m = vec![600.0, 1200.0, 90e3];
        let formation = Formation::new(&config).unwrap();
        assert_close(&arcs_m(&formation, 0.0), &[0.0, 600.0, 1200.0, 90e3]);
        assert_close(&arcs_m(&formation, 3.5 * 86_400.0), &[0.0, 350.0, 800.0, 60e3]);
        config.arcs_m.pop();
        assert_eq!(config.problems()[0].key, "array.arcs_m");
        config.arcs_m.push(f64::NAN);
        assert_eq!(config.problems()[0].key, "array.arcs_m[2]");
    }

    #[test]
    fn daughters_that_would_meet_are_refused() {
        let mut config = config(4, BreathingConfig::default());
        config.arcs_m = vec![600.0, 300.0, 90e3];
        let refused = Formation::new(&config).unwrap_err();
        assert!(refused.to_string().contains("daughters 2 and 3 would meet"), "{refused}");
        // The third comes closer to the first than the second does.
        config.arcs_m = vec![600.0, 700.0, 90e3];
        config.breathing.ratio = 8.0;
        let refused = Formation::new(&config).unwrap_err();
        assert!(matches!(refused, ArrayError::Meeting { first: 2, .. }), "{refused}");
    }
}
