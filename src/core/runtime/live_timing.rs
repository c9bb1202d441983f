//! Statistics of durations that can be read while a stage records them.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use super::timing::TimingSummary;

/// log2 of the upper limit of the first class, ns, which is about 1 us.
const FIRST_LIMIT_LOG2: u32 = 10;

/// Number of classes. The last one ends at about 18 minutes and also takes longer durations.
const CLASSES: usize = 31;

/// Histogram of durations in classes that double in width. Only one thread writes, so stores suffice.
#[derive(Debug, Default)]
pub(super) struct LiveTiming {
    classes: [AtomicU64; CLASSES],
    total_ns: AtomicU64,
    longest_ns: AtomicU64,
}

impl LiveTiming {
    pub(super) fn record(&self, duration: Duration) {
        let nanoseconds = u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX);
        let add = |counter: &AtomicU64, more: u64| {
            counter.store(counter.load(Ordering::Relaxed).saturating_add(more), Ordering::Relaxed);
        };
        add(&self.classes[class(nanoseconds)], 1);
        add(&self.total_ns, nanoseconds);
        if nanoseconds > self.longest_ns.load(Ordering::Relaxed) {
            self.longest_ns.store(nanoseconds, Ordering::Relaxed);
        }
    }

    pub(super) fn read(&self) -> DurationCounts {
        let classes = std::array::from_fn(|k| self.classes[k].load(Ordering::Relaxed));
        DurationCounts {
            classes,
            total_s: self.total_ns.load(Ordering::Relaxed) as f64 * 1e-9,
            max_s: self.longest_ns.load(Ordering::Relaxed) as f64 * 1e-9,
        }
    }
}

fn class(nanoseconds: u64) -> usize {
    let log2 = u64::BITS - nanoseconds.saturating_sub(1).leading_zeros();
    (log2.saturating_sub(FIRST_LIMIT_LOG2) as usize).min(CLASSES - 1)
}

/// Number of durations by class.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DurationCounts {
    classes: [u64; CLASSES],
    /// Sum of the durations, s.
    pub total_s: f64,
    /// Longest duration, s.
    pub max_s: f64,
}

impl DurationCounts {
    /// Upper limit of each class, s, and the number of durations in it. The last class also contains longer ones.
    pub fn classes(&self) -> impl Iterator<Item = (f64, u64)> + '_ {
        (FIRST_LIMIT_LOG2..)
            .zip(&self.classes)
            .map(|(log2, &count)| (1e-9 * 2_f64.powf(f64::from(log2)), count))
    }

    /// Number of durations.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.classes.iter().sum()
    }

    /// Statistics of the durations. Percentiles are upper limits of classes, so up to twice the true values, but at most the maximum.
    #[must_use]
    pub fn summary(&self) -> TimingSummary {
        let count = self.count();
        let percentile_s = |quantile: f64| {
            let rank = (quantile * count as f64).ceil().max(1.0) as u64;
            let mut below = 0;
            let reaches = |&(_, more): &(f64, u64)| {
                below += more;
                below >= rank
            };
            self.classes().find(reaches).map_or(0.0, |(limit_s, _)| limit_s.min(self.max_s))
        };
        TimingSummary {
            count,
            total_s: self.total_s,
            p50_s: percentile_s(0.5),
            p99_s: percentile_s(0.99),
            p999_s: percentile_s(0.999),
            max_s: self.max_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_at_most_twice_too_large() {
        let timing = LiveTiming::default();
        assert_eq!(timing.read().summary(), TimingSummary::default());
        for microseconds in 1..=1_000 {
            timing.record(Duration::from_micros(microseconds));
        }
        let summary = timing.read().summary();
        assert_eq!(summary.count, 1_000);
        // 1 + .. + 1000 us, with a rounding error each.
        assert!((summary.total_s - 0.500_5).abs() < 1e-9);
        for (found, expected) in [(summary.p50_s, 500e-6), (summary.p99_s, 990e-6), (summary.p999_s, 999e-6)]
        {
            assert!(found >= expected * 0.999 && found <= 2.0 * expected, "{found} for {expected}");
        }
        assert!((summary.max_s - 1e-3).abs() < 1e-12);
    }

    #[test]
    fn every_duration_has_a_class() {
        let timing = LiveTiming::default();
        for duration in
            [Duration::ZERO, Duration::from_nanos(1024), Duration::from_nanos(1025), Duration::MAX]
        {
            timing.record(duration);
        }
        let counts: Vec<u64> = timing.read().classes().map(|(_, count)| count).collect();
        assert_eq!((counts[0], counts[1], counts[CLASSES - 1], counts.iter().sum::<u64>()), (2, 1, 1, 4));
    }
}
