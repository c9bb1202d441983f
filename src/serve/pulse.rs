//! Rates of stages over the last seconds, and of a run that has ended over all of it.

use std::collections::VecDeque;
use std::time::Instant;

use crate::runtime::StageProgress;

/// Looks over which rates are taken.
const LOOKS: usize = 6;

/// The last looks at the stages.
#[derive(Debug, Default)]
pub(super) struct Pulse(VecDeque<StageSample>);

#[derive(Debug)]
struct StageSample {
    at: Instant,
    /// Units, and time spent working, s.
    stages: Vec<(u64, f64)>,
}

/// Rates of a stage over the last seconds, or over the whole run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct StageRate {
    /// Share of the time in which it worked, 0 to 1.
    pub(super) busy: f64,
    /// Units per second.
    pub(super) units_per_s: f64,
}

impl Pulse {
    /// Looks at the stages; returns their rates since the oldest look that is kept.
    pub(super) fn look(&mut self, stages: &[StageProgress], now: Instant) -> Vec<StageRate> {
        let seen: Vec<(u64, f64)> = stages.iter().map(|s| (s.units.count, s.working.total_s)).collect();
        let rate = |k: usize, old: &StageSample| {
            let seconds = now.duration_since(old.at).as_secs_f64();
            let (&(units, worked_s), progress) = (old.stages.get(k)?, stages.get(k)?);
            let worked = (progress.working.total_s - worked_s) / seconds.max(1e-3);
            // A step that has not ended counts nowhere yet.
            let in_long_step = progress.is_working && worked == 0.0;
            Some(StageRate {
                busy: if in_long_step { 1.0 } else { worked.clamp(0.0, 1.0) },
                units_per_s: progress.units.count.saturating_sub(units) as f64 / seconds.max(1e-3),
            })
        };
        let rates = match self.0.front() {
            Some(old) => (0..seen.len()).map(|k| rate(k, old).unwrap_or_default()).collect(),
            None => vec![StageRate::default(); seen.len()],
        };
        self.0.push_back(StageSample { at: now, stages: seen });
        while self.0.len() > LOOKS {
            self.0.pop_front();
        }
        rates
    }
}

/// Rates over a whole run, which took so long.
pub(super) fn whole_run(stages: &[StageProgress], elapsed_s: f64) -> Vec<StageRate> {
    let seconds = elapsed_s.max(1e-3);
    let rate = |stage: &StageProgress| StageRate {
        busy: (stage.working.total_s / seconds).clamp(0.0, 1.0),
        units_per_s: stage.units.count as f64 / seconds,
    };
    stages.iter().map(rate).collect()
}
