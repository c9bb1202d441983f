//! Where the pairs are while they observe.

use rayon::prelude::*;

use crate::array::{EarthOccultation, SatelliteState};
use crate::frames::ObservingWindow;
use crate::pipeline::Plan;
use crate::units::{MissionTime, Pair, all_pairs};

/// Windows that one task takes; the division does not depend on the number of threads.
const WINDOWS_PER_TASK: usize = 64;

/// An instant that stands for a short time of an observing window.
pub(super) struct Instant<'a> {
    /// The time it stands for, s.
    pub length_s: f64,
    /// Satellites.
    pub states: &'a [SatelliteState],
    /// Pairs that observe.
    pub pairs: &'a [Pair],
}

/// Gathers all instants of the plan's windows, `step_s` apart at most: `add` counts an instant, `merge` joins two counts.
/// Equal plans give equal results, whatever the threads.
pub(super) fn gather<T: Send>(
    plan: &Plan,
    step_s: f64,
    empty: impl Fn() -> T + Sync,
    add: impl Fn(&mut T, &Instant<'_>) + Sync,
    merge: impl Fn(&mut T, T),
) -> T {
    let task = |windows: &[ObservingWindow]| {
        let mut part = empty();
        for &window in windows {
            through_window(plan, step_s, window, &mut |instant| add(&mut part, instant));
        }
        part
    };
    let parts: Vec<T> = plan.windows.par_chunks(WINDOWS_PER_TASK).map(task).collect();
    let mut whole = empty();
    for part in parts {
        merge(&mut whole, part);
    }
    whole
}

/// Calls `add` for instants in the middle of equal parts of a window.
fn through_window(plan: &Plan, step_s: f64, window: ObservingWindow, add: &mut dyn FnMut(&Instant<'_>)) {
    let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
    let steps = ((end_s - start_s) / step_s).ceil().max(1.0) as usize;
    let length_s = (end_s - start_s) / steps as f64;
    let satellites = plan.array.satellites();
    let shadow = plan.config.spacecraft.flag_earth.then(|| EarthOccultation::new(&plan.array, window));
    let all = all_pairs(satellites);
    let mut pairs = Vec::with_capacity(all.len());
    for step in 0..steps {
        let t_s = start_s + (step as f64 + 0.5) * length_s;
        let at = MissionTime::from_seconds(t_s);
        pairs.clear();
        let observes = |pair: &&Pair| shadow.as_ref().is_none_or(|shadow| shadow.covers(**pair, at, at));
        pairs.extend(all.iter().filter(observes));
        let states: Vec<SatelliteState> = (0..satellites).map(|n| plan.array.state(n, t_s)).collect();
        add(&Instant { length_s, states: &states, pairs: &pairs });
    }
}

/// Longest baseline of a channel's map, m: the map's limit, and the correlator's if there is one.
pub(super) fn limit_m(plan: &Plan, channel: usize) -> f64 {
    let schedule = &plan.schedules[channel];
    let map_m = plan.config.map.baseline_m_max(schedule.frequency_hz);
    match schedule.baseline_wavelengths_max {
        0.0 => map_m,
        limit => map_m.min(limit * crate::units::constants::SPEED_OF_LIGHT_M_S / schedule.frequency_hz),
    }
}
