//! Samples the positions of the satellites and the observing pairs over the mission.

use rayon::prelude::*;

use crate::array::{EarthOccultation, SatelliteState};
use crate::frames::ObservingWindow;
use crate::pipeline::Plan;
use crate::units::{MissionTime, Pair, all_pairs};

/// Number of windows per task. It does not depend on the number of threads, so that results do not.
const WINDOWS_PER_TASK: usize = 64;

/// A sample in time of an observing window.
pub(super) struct TimeSample<'a> {
    /// Time that the sample represents, s.
    pub length_s: f64,
    /// States of the satellites.
    pub states: &'a [SatelliteState],
    /// Pairs that observe, for which the Earth is occulted if that is required.
    pub pairs: &'a [Pair],
}

/// Samples all windows of the plan with steps of at most `step_s`. `add` adds a sample to a partial result, `merge` merges two.
///
/// The result does not depend on the number of threads.
pub(super) fn gather<T: Send>(
    plan: &Plan,
    step_s: f64,
    empty: impl Fn() -> T + Sync,
    add: impl Fn(&mut T, &TimeSample<'_>) + Sync,
    merge: impl Fn(&mut T, T),
) -> T {
    let task = |windows: &[ObservingWindow]| {
        let mut part = empty();
        for &window in windows {
            sample_window(plan, step_s, window, &mut |sample| add(&mut part, sample));
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

/// Calls `add` for samples in the middle of equal parts of a window.
fn sample_window(plan: &Plan, step_s: f64, window: ObservingWindow, add: &mut dyn FnMut(&TimeSample<'_>)) {
    let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
    let steps = ((end_s - start_s) / step_s).ceil().max(1.0) as usize;
    let length_s = (end_s - start_s) / steps as f64;
    let satellites = plan.array.satellites();
    let shadow = plan.config.spacecraft.flag_earth.then(|| EarthOccultation::new(&plan.array, window));
    let all = all_pairs(satellites);
    let mut pairs = Vec::with_capacity(all.len());
    for step in 0..steps {
        let t_s = start_s + (step as f64 + 0.5) * length_s;
        let time = MissionTime::from_seconds(t_s);
        pairs.clear();
        let observes = |pair: &&Pair| shadow.as_ref().is_none_or(|shadow| shadow.covers(**pair, time, time));
        pairs.extend(all.iter().filter(observes));
        let states: Vec<SatelliteState> = (0..satellites).map(|n| plan.array.state(n, t_s)).collect();
        add(&TimeSample { length_s, states: &states, pairs: &pairs });
    }
}

/// Limit on the baselines of a channel, m: the lower of those of the map and of the correlator, if it has one.
pub(super) fn limit_m(plan: &Plan, channel: usize) -> f64 {
    let schedule = &plan.schedules[channel];
    let map_m = plan.config.map.baseline_m_max(schedule.frequency_hz);
    match schedule.baseline_wavelengths_max {
        0.0 => map_m,
        limit => map_m.min(limit * crate::units::constants::SPEED_OF_LIGHT_M_S / schedule.frequency_hz),
    }
}
