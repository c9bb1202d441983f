//! Observing windows.

use super::orbit::Array;
use crate::frames::ObservingWindow;
use crate::units::MissionTime;

/// Steps an orbit of the search for a limb crossing; a window is a third of an orbit.
const STEPS_PER_ORBIT: f64 = 64.0;

/// As many for an ellipse, on which the Moon may hide the Earth for a short part of an orbit.
const STEPS_PER_ELLIPSE: f64 = 1024.0;

/// Observing windows in order of time: the intervals in which the Earth is hidden from daughter 1.
///
/// Only whole windows: one in progress at `from_s` or at `until_s` is skipped.
#[derive(Clone, Debug)]
pub struct ObservingWindows<'a> {
    array: &'a Array,
    now_s: f64,
    until_s: f64,
    index: u64,
}

impl<'a> ObservingWindows<'a> {
    /// The windows of `array` between two times, s.
    #[must_use]
    pub fn new(array: &'a Array, from_s: f64, until_s: f64) -> Self {
        Self { array, now_s: from_s, until_s, index: 0 }
    }

    /// The next time after `now_s` at which the Earth sets (`hides`) or rises.
    fn next_edge_s(&self, mut now_s: f64, hides: bool) -> Option<f64> {
        let steps = if self.array.formation().is_some() { STEPS_PER_ORBIT } else { STEPS_PER_ELLIPSE };
        let step_s = self.array.orbital_period_s() / steps;
        let is_past = |t_s: f64| (self.array.earth_depth_m(t_s) > 0.0) == hides;
        let mut was_before = !is_past(now_s);
        while now_s < self.until_s {
            let next_s = now_s + step_s;
            let past = is_past(next_s);
            if past && was_before {
                let edge_s = bisect(now_s, next_s, is_past);
                return (edge_s <= self.until_s).then_some(edge_s);
            }
            was_before = !past;
            now_s = next_s;
        }
        None
    }
}

/// Time for which the Earth is visible from daughter 1 between two times, s.
#[must_use]
pub fn earth_in_sight_s(array: &Array, from_s: f64, until_s: f64) -> f64 {
    let edges = ObservingWindows::new(array, from_s, until_s);
    let (mut now_s, mut sight_s) = (from_s, 0.0);
    if array.earth_depth_m(from_s) > 0.0 {
        now_s = edges.next_edge_s(from_s, false).unwrap_or(until_s);
    }
    while now_s < until_s {
        let hidden_s = edges.next_edge_s(now_s, true).unwrap_or(until_s);
        sight_s += hidden_s - now_s;
        now_s = edges.next_edge_s(hidden_s, false).unwrap_or(until_s);
    }
    sight_s
}

/// The point between `before` and `after` at which `is_past` becomes true, to one tick.
fn bisect(mut before: f64, mut after: f64, is_past: impl Fn(f64) -> bool) -> f64 {
    while after - before > 1e-7 {
        let middle = 0.5 * (before + after);
        if middle <= before || middle >= after {
            break;
        }
        if is_past(middle) { after = middle } else { before = middle }
    }
    after
}

impl Iterator for ObservingWindows<'_> {
    type Item = ObservingWindow;

    fn next(&mut self) -> Option<ObservingWindow> {
        let start_s = self.next_edge_s(self.now_s, true)?;
        let end_s = self.next_edge_s(start_s, false)?;
        self.now_s = end_s;
        let index = self.index;
        self.index += 1;
        Some(ObservingWindow {
            index,
            start: MissionTime::from_seconds(start_s),
            end: MissionTime::from_seconds(end_s),
        })
    }
}
