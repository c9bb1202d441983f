//! Measurement of time.

use std::time::Instant;

use crate::pipeline::Plan;

pub(super) struct TimeSpent {
    pub(super) seconds: f64,
    /// Processor time of the whole process, s; `None` where the system does not report it.
    pub(super) core_seconds: Option<f64>,
}

/// Mission time of a plan's windows, s.
pub(super) fn mission_s(plan: &Plan) -> f64 {
    plan.windows.iter().map(|window| (window.end.0 - window.start.0) as f64 * 1e-6).sum()
}

/// Number of samples per second of mission time.
pub(super) fn samples_per_mission_s(plan: &Plan) -> f64 {
    let channels = &plan.instrument.channels;
    let width_hz = channels.first().map_or(1.0, |channel| channel.width_hz);
    (channels.len() * plan.array.satellites()) as f64 * width_hz
}

/// The median of values, which it sorts.
pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The quartiles of sorted values, by nearest rank.
pub(super) fn quartiles(sorted: &[f64]) -> [f64; 2] {
    let last = sorted.len() - 1;
    [last / 4, last - last / 4].map(|at| sorted[at])
}

/// Processor time of all threads of this process, s. Linux reports it in ticks of 10 ms (proc(5), fields 14 and 15 of
/// stat).
pub(super) fn core_seconds_used() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // The name, in parentheses, may contain spaces.
    let mut fields = text.rsplit_once(')')?.1.split_whitespace().skip(11);
    let mut ticks = || fields.next()?.parse::<f64>().ok();
    Some((ticks()? + ticks()?) / 100.0)
}

/// Runs a task; returns the time spent and its result.
pub(super) fn timed<T>(task: impl FnOnce() -> T) -> (TimeSpent, T) {
    let (before_s, since) = (core_seconds_used(), Instant::now());
    let value = task();
    let seconds = since.elapsed().as_secs_f64();
    let core_seconds = core_seconds_used().zip(before_s).map(|(after_s, before_s)| after_s - before_s);
    (TimeSpent { seconds, core_seconds }, value)
}
