//! Division of windows into integrations.

use super::thinning::WindowThinning;
use crate::array::{Array, IntegrationRule, integration_time_s};
use crate::frames::ObservingWindow;
use crate::units::vector::{norm, sub};
use crate::units::{Pair, TICKS_PER_SECOND};

use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// An integration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Integration {
    /// Start, us after the window's start.
    pub offset_ticks: u32,
    /// Duration, us.
    pub duration_ticks: u32,
}

/// Rule that divides windows into integrations, for one channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    /// Rule of the integration time.
    pub rule: IntegrationRule,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Maximum baseline, wavelengths; 0 for no limit.
    pub baseline_wavelengths_max: f64,
    /// Stride of kept integrations.
    pub every_nth: u64,
    /// Selection of windows, by which the choice of integrations varies from window to window.
    pub windows: WindowThinning,
}

impl Schedule {
    /// The integrations of `pair` in `window`: contiguous from its start, each as long as the
    /// baseline's speed at its start allows, the last one cut at the window's end.
    ///
    /// The phase of the thinning changes from window to window, so that no part of a window is always omitted.
    #[must_use]
    pub fn integrations(&self, array: &Array, window: ObservingWindow, pair: Pair) -> Vec<Integration> {
        let length_ticks = (window.end.0 - window.start.0).clamp(0, i64::from(u32::MAX)) as u32;
        let longest_m = match self.baseline_wavelengths_max {
            0.0 => f64::INFINITY,
            limit => limit * SPEED_OF_LIGHT_M_S / self.frequency_hz,
        };
        if shortest_m(array, window, pair) >= longest_m {
            return Vec::new();
        }
        let mut found = Vec::new();
        let mut offset_ticks = 0;
        let mut index = self.windows.first_integration(window.index, self.every_nth);
        while offset_ticks < length_ticks {
            let t_s = window.start.plus_ticks(i64::from(offset_ticks)).seconds();
            let (i, j) = (array.state(pair.i.into(), t_s), array.state(pair.j.into(), t_s));
            let dt_s = integration_time_s(self.rule, self.frequency_hz, i.velocity_m_s, j.velocity_m_s);
            // At least one tick, so that the loop ends with any rule.
            let dt_ticks = ((dt_s * TICKS_PER_SECOND as f64) as u32).max(1);
            let duration_ticks = dt_ticks.min(length_ticks - offset_ticks);
            let is_in_range = norm(sub(i.position_m, j.position_m)) < longest_m;
            if is_in_range && index.is_multiple_of(self.every_nth) {
                found.push(Integration { offset_ticks, duration_ticks });
            }
            offset_ticks += duration_ticks;
            index += 1;
        }
        found
    }

    /// Estimated number of integrations in a window, and the baseline's length, m; both evaluated at the window's
    /// middle.
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

/// Lower bound of a pair's baseline in a window, m. Arcs are linear in time between turnarounds, so they are closest at an end of the
/// window or at a turnaround.
fn shortest_m(array: &Array, window: ObservingWindow, pair: Pair) -> f64 {
    // Orbits of one's own give no bound.
    let Some(formation) = array.formation_of_any_shape() else { return 0.0 };
    let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
    // There is no bound for a formation with more turnarounds.
    if (end_s - start_s) * 2.0 > TURNAROUNDS_MAX as f64 * formation.period_s() {
        return 0.0;
    }
    let arc_m = |n: u8, t_s: f64| formation.arc_m(n.into(), t_s).0;
    let next = |t_s: &f64| Some(formation.next_turnaround_s(*t_s)).filter(|turn_s| *turn_s < end_s);
    let instants = std::iter::successors(Some(start_s), next).take(TURNAROUNDS_MAX);
    // Bounds rise and fall once with the arc.
    let bound_m = |t_s: f64| array.distance_m_min(arc_m(pair.i, t_s) - arc_m(pair.j, t_s));
    // Beyond the rounding of positions.
    (1.0 - 1e-9) * instants.chain([end_s]).map(bound_m).fold(f64::INFINITY, f64::min)
}

/// Maximum number of turnarounds considered in a window; the paper's formation has at most one.
const TURNAROUNDS_MAX: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{ArrayConfig, ObservingWindows};
    use crate::units::all_pairs;

    fn schedule(baseline_wavelengths_max: f64, every_nth: u64) -> Schedule {
        let rule = IntegrationRule::default();
        Schedule {
            rule,
            frequency_hz: 10e6,
            baseline_wavelengths_max,
            every_nth,
            windows: WindowThinning::EveryNth(1),
        }
    }

    #[test]
    fn integrations_fill_the_window_and_move_an_eighth_of_a_wavelength() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let window = ObservingWindows::new(&array, 0.0, 1e5).next().unwrap();
        for pair in all_pairs(4) {
            let found = schedule(0.0, 1).integrations(&array, window, pair);
            let mut expected = 0;
            for Integration { offset_ticks, duration_ticks } in &found {
                assert_eq!(*offset_ticks, expected);
                expected += duration_ticks;
                let from = window.start.plus_ticks(i64::from(*offset_ticks)).seconds();
                let baseline = |t_s: f64| {
                    sub(array.position_m(pair.i.into(), t_s), array.position_m(pair.j.into(), t_s))
                };
                let until = from + f64::from(*duration_ticks) * 1e-6;
                let moved_m = norm(sub(baseline(until), baseline(from)));
                // The motion's chord is at most its path, lambda / 8 at 10 MHz.
                assert!(moved_m <= 0.125 * SPEED_OF_LIGHT_M_S / 10e6 * (1.0 + 1e-6), "{pair}: {moved_m} m");
            }
            assert_eq!(i64::from(expected), window.end.0 - window.start.0);
        }
    }

    #[test]
    fn baselines_beyond_the_limit_are_left_out() {
        left_out_of(&ArrayConfig::default(), 7);
        left_out_of(
            &ArrayConfig { eccentricity: 0.05, cross_track_ratio: 0.3, ..ArrayConfig::default() },
            70,
        );
    }

    fn left_out_of(config: &ArrayConfig, every_nth: usize) {
        let array = Array::new(config).unwrap();
        for window in ObservingWindows::new(&array, 0.0, 15.0 * 86_400.0).step_by(every_nth) {
            for pair in all_pairs(8) {
                let limit_m = 31.3 * SPEED_OF_LIGHT_M_S / 10e6;
                let near = schedule(31.3, 1).integrations(&array, window, pair);
                let kept = schedule(0.0, 1).integrations(&array, window, pair).into_iter().filter(|one| {
                    let t_s = window.start.plus_ticks(i64::from(one.offset_ticks)).seconds();
                    let (i, j) = (usize::from(pair.i), usize::from(pair.j));
                    norm(sub(array.position_m(i, t_s), array.position_m(j, t_s))) < limit_m
                });
                assert_eq!(near, kept.collect::<Vec<_>>(), "{pair} in window {}", window.index);
            }
        }
    }

    #[test]
    fn no_baseline_is_shorter_than_its_bound() {
        // Bound over the shortest distance of an orbit: 1 on a circle; of an ellipse at least (1 - e) / (1 + e)^2 and what inclined planes
        // add, which is half of the distance along the track at most.
        for (eccentricity, cross_track_ratio, least) in
            [(0.0, 0.0, 1.0 - 1e-6), (0.05, 0.0, 0.85), (0.05, 0.3, 0.75)]
        {
            let config = ArrayConfig { eccentricity, cross_track_ratio, ..ArrayConfig::default() };
            let array = Array::new(&config).unwrap();
            for window in ObservingWindows::new(&array, 0.0, 15.0 * 86_400.0).step_by(31) {
                for pair in all_pairs(8) {
                    let bound_m = shortest_m(&array, window, pair);
                    let start_s = window.start.seconds();
                    let distance_m = |k: i32| {
                        let t_s = start_s + array.orbital_period_s() * f64::from(k) / 500.0;
                        norm(sub(array.position_m(pair.i.into(), t_s), array.position_m(pair.j.into(), t_s)))
                    };
                    let until = ((window.end.seconds() - start_s) / array.orbital_period_s() * 500.0) as i32;
                    let within = (0..=until).map(distance_m).fold(f64::INFINITY, f64::min);
                    assert!(bound_m <= within, "{pair}: {bound_m} {within}");
                    // Arcs change by 1 % in an orbit, if they do.
                    let around = (0..=500).map(distance_m).fold(f64::INFINITY, f64::min);
                    assert!(bound_m >= 0.98 * least * around, "{pair}: {bound_m} {around}");
                }
            }
        }
    }

    #[test]
    fn estimates_are_close() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let window = ObservingWindows::new(&array, 2e6, 3e6).next().unwrap();
        for pair in all_pairs(5) {
            let count = schedule(0.0, 1).integrations(&array, window, pair).len() as f64;
            let (estimate, _) = schedule(0.0, 1).estimate(&array, window, pair);
            // The estimate neglects rounding to whole integrations, and the change of the baseline in a window, below
            // 1 %.
            assert!((count - estimate).abs() <= 1.0 + 0.01 * count, "{pair}: {count} {estimate}");
        }
    }
}
