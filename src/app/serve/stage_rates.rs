//! Rates of stages over the last seconds of a run, or over a whole run.

use std::collections::VecDeque;
use std::time::Instant;

use crate::runtime::StageProgress;

/// Number of samples over which rates are computed.
const SAMPLES: usize = 6;

/// Measures the rates of stages over the last samples of their counters.
#[derive(Debug, Default)]
pub(super) struct RateMeter(VecDeque<StageSample>);

/// Counters of all stages at one time.
#[derive(Debug)]
struct StageSample {
    time: Instant,
    /// Units processed, and time spent working, s, by stage.
    stages: Vec<(u64, f64)>,
}

/// Rates of a stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct StageRate {
    /// Fraction of the time in which the stage worked.
    pub(super) busy: f64,
    pub(super) units_per_s: f64,
}

impl RateMeter {
    /// Takes a sample; returns the rates since the oldest sample that is kept.
    pub(super) fn sample(&mut self, stages: &[StageProgress], now: Instant) -> Vec<StageRate> {
        let counters: Vec<(u64, f64)> = stages.iter().map(|s| (s.units.count, s.working.total_s)).collect();
        let rate = |k: usize, old: &StageSample| {
            let seconds = now.duration_since(old.time).as_secs_f64();
            let (&(units, worked_s), progress) = (old.stages.get(k)?, stages.get(k)?);
            let busy = (progress.working.total_s - worked_s) / seconds.max(1e-3);
            // A step in progress is not yet in `working`.
            let is_in_long_step = progress.is_working && busy == 0.0;
            Some(StageRate {
                busy: if is_in_long_step { 1.0 } else { busy.clamp(0.0, 1.0) },
                units_per_s: progress.units.count.saturating_sub(units) as f64 / seconds.max(1e-3),
            })
        };
        let rates = match self.0.front() {
            Some(old) => (0..counters.len()).map(|k| rate(k, old).unwrap_or_default()).collect(),
            None => vec![StageRate::default(); counters.len()],
        };
        self.0.push_back(StageSample { time: now, stages: counters });
        while self.0.len() > SAMPLES {
            self.0.pop_front();
        }
        rates
    }
}

pub(super) fn whole_run_rates(stages: &[StageProgress], elapsed_s: f64) -> Vec<StageRate> {
    let seconds = elapsed_s.max(1e-3);
    let rate = |stage: &StageProgress| StageRate {
        busy: (stage.working.total_s / seconds).clamp(0.0, 1.0),
        units_per_s: stage.units.count as f64 / seconds,
    };
    stages.iter().map(rate).collect()
}
