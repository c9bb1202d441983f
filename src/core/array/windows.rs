//! Observing windows.

use super::orbit::Array;
use crate::frames::ObservingWindow;
use crate::units::{MissionTime, Pair};

/// Number of steps per orbit in the search for a limb crossing; a window is a third of an orbit.
const STEPS_PER_ORBIT: f64 = 64.0;

/// Number of steps per orbit for an ellipse, on which the Moon may hide the Earth for a short part of an orbit.
const STEPS_PER_ELLIPSE: f64 = 1024.0;

/// Longest window of stations, s. From the Moon's far side the Earth never rises.
const SURFACE_WINDOW_S: f64 = 3600.0;

/// Iterator over observing windows in order of time: the intervals in which the Earth is hidden from daughter 1.
///
/// A window in progress at `from_s` or at `until_s` is skipped. Under stations, these intervals are cut into windows of an hour, and
/// begin at `from_s` and end at `until_s`.
#[derive(Clone, Debug)]
pub struct ObservingWindows<'a> {
    array: &'a Array,
    now_s: f64,
    until_s: f64,
    index: u64,
}

impl<'a> ObservingWindows<'a> {
    /// Creates an iterator over the windows of `array` between two times, s.
    #[must_use]
    pub fn new(array: &'a Array, from_s: f64, until_s: f64) -> Self {
        Self { array, now_s: from_s, until_s, index: 0 }
    }

    /// Next time after `now_s` at which the Earth sets (`hides`) or rises.
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

/// Occultation of the Earth by the Moon, as seen from each daughter during an observing window.
///
/// A window is defined by daughter 1. Daughters that trail it see the Earth set later, the last one of the fiducial
/// array by at most 64 s (100 km of arc at 1.55 km/s), and rise later.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EarthOccultation {
    /// First and last tick, by daughter.
    spans: Vec<[MissionTime; 2]>,
}

impl EarthOccultation {
    /// Finds the occultations of all daughters within `window`. A daughter from which the Earth is hidden neither at
    /// an end nor in the middle of the window counts as never in occultation.
    #[must_use]
    pub fn new(array: &Array, window: ObservingWindow) -> Self {
        let [start_s, end_s] = [window.start, window.end].map(MissionTime::seconds);
        let span = |n: usize| {
            // The window's own edges are those of daughter 1, to the tick.
            if n == 0 {
                return [window.start, window.end];
            }
            let is_hidden = |t_s: f64| array.earth_depth_for_m(n, t_s) > 0.0;
            let inside = [start_s, end_s, 0.5 * (start_s + end_s)].into_iter().find(|t_s| is_hidden(*t_s));
            let Some(inside_s) = inside else { return [window.end, window.start] };
            // Whole ticks within the occultation.
            let from = match is_hidden(start_s) {
                true => window.start,
                false => MissionTime::from_seconds(bisect(start_s, inside_s, is_hidden)).plus_ticks(1),
            };
            let until = match is_hidden(end_s) {
                true => window.end,
                false => MissionTime::from_seconds(bisect(inside_s, end_s, |t| !is_hidden(t))).plus_ticks(-1),
            };
            [from, until]
        };
        Self { spans: (0..array.satellites()).map(span).collect() }
    }

    /// Whether the Earth is hidden from both daughters of `pair` from `from` to `until`.
    #[must_use]
    pub fn covers(&self, pair: Pair, from: MissionTime, until: MissionTime) -> bool {
        [pair.i, pair.j].into_iter().all(|n| {
            self.spans.get(usize::from(n)).is_some_and(|[first, last]| *first <= from && until <= *last)
        })
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

/// Time between `before` and `after` at which `is_past` becomes true, to one tick.
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

impl ObservingWindows<'_> {
    /// Start and end of the next window of stations, s.
    fn next_on_surface(&self) -> Option<[f64; 2]> {
        let is_seen = |t_s: f64| self.array.earth_depth_m(t_s) <= 0.0;
        let start_s = if is_seen(self.now_s) { self.next_edge_s(self.now_s, true)? } else { self.now_s };
        let end_s = (start_s + SURFACE_WINDOW_S).min(self.until_s);
        // The Earth rises or sets at most once in an hour.
        let end_s = if is_seen(end_s) { bisect(start_s, end_s, is_seen) } else { end_s };
        (end_s > start_s).then_some([start_s, end_s])
    }
}

impl Iterator for ObservingWindows<'_> {
    type Item = ObservingWindow;

    fn next(&mut self) -> Option<ObservingWindow> {
        let [start_s, end_s] = match self.array.is_on_surface() {
            true => self.next_on_surface()?,
            false => {
                let start_s = self.next_edge_s(self.now_s, true)?;
                [start_s, self.next_edge_s(start_s, false)?]
            }
        };
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
