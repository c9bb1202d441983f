//! Which integrations a window holds.

use crate::array::{Array, IntegrationRule, integration_time_s};
use crate::frames::ObservingWindow;
use crate::units::vector::{norm, sub};
use crate::units::{Pair, TICKS_PER_SECOND};

use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// One integration: start after the window's first tick, and length, us.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Integration {
    /// Start, us after the window's start.
    pub offset_ticks: u32,
    /// Length, us.
    pub duration_ticks: u32,
}

/// How the integrations of one channel follow each other in a window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Rule of the adaptive integration.
    pub rule: IntegrationRule,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Longest baseline, wavelengths; 0 for no limit.
    pub baseline_wavelengths_max: f64,
    /// Keep every n-th integration.
    pub every_nth: u64,
}

impl Schedule {
    /// The integrations of `pair` in `window`: back to back from its start, each as long as the
    /// baseline's speed at its start allows, the last cut at the window's end.
    ///
    /// Of a thinned schedule the phase of the thinning moves on with the window, so that no part of
    /// a window is always left out.
    #[must_use]
    pub fn integrations(&self, array: &Array, window: ObservingWindow, pair: Pair) -> Vec<Integration> {
        let length_ticks = (window.end.0 - window.start.0).clamp(0, i64::from(u32::MAX)) as u32;
        let longest_m = match self.baseline_wavelengths_max {
            0.0 => f64::INFINITY,
            limit => limit * SPEED_OF_LIGHT_M_S / self.frequency_hz,
        };
        let mut found = Vec::new();
        let mut offset_ticks = 0;
        let mut number = window.index;
        while offset_ticks < length_ticks {
            let t_s = window.start.plus_ticks(i64::from(offset_ticks)).seconds();
            let (i, j) = (array.state(pair.i.into(), t_s), array.state(pair.j.into(), t_s));
            let dt_s = integration_time_s(self.rule, self.frequency_hz, i.velocity_m_s, j.velocity_m_s);
            // At least one tick, so that the loop ends whatever the rule says.
            let dt_ticks = ((dt_s * TICKS_PER_SECOND as f64) as u32).max(1);
            let duration_ticks = dt_ticks.min(length_ticks - offset_ticks);
            let near_enough = norm(sub(i.position_m, j.position_m)) < longest_m;
            if near_enough && number.is_multiple_of(self.every_nth) {
                found.push(Integration { offset_ticks, duration_ticks });
            }
            offset_ticks += duration_ticks;
            number += 1;
        }
        found
    }

    /// About how many integrations [`Self::integrations`] gives, and the baseline's length, m; both
    /// from the window's middle alone.
    #[must_use]
    pub fn estimate(&self, array: &Array, window: ObservingWindow, pair: Pair) -> (f64, f64) {
        let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
        let middle_s = 0.5 * (start_s + end_s);
        let (i, j) = (array.state(pair.i.into(), middle_s), array.state(pair.j.into(), middle_s));
        let length_m = norm(sub(i.position_m, j.position_m));
        let limit = self.baseline_wavelengths_max;
        if limit > 0.0 && length_m * self.frequency_hz / SPEED_OF_LIGHT_M_S >= limit {
            return (0.0, length_m);
        }
        let dt_s = integration_time_s(self.rule, self.frequency_hz, i.velocity_m_s, j.velocity_m_s);
        ((end_s - start_s) / dt_s / self.every_nth as f64, length_m)
    }
}
