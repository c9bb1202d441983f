//! Statistics of durations in bounded memory.

use std::time::Duration;

use hdrhistogram::Histogram;
use serde::Serialize;

/// Longest duration in the histogram, ns, which is one day. In percentiles longer ones count as this.
const LONGEST_NS: u64 = 86_400_000_000_000;

/// Decimal digits of a duration, for a precision of 1 %. A histogram takes about 40 kB.
const DIGITS: u8 = 2;

/// Histogram of durations of one kind in one stage.
pub(super) struct Timing {
    histogram: Histogram<u64>,
    total: Duration,
    longest: Duration,
}

impl Timing {
    #[expect(clippy::expect_used, reason = "bounds and digits are constants that the histogram accepts")]
    pub(super) fn new() -> Self {
        let histogram = Histogram::new_with_bounds(1, LONGEST_NS, DIGITS).expect("valid bounds");
        Self { histogram, total: Duration::ZERO, longest: Duration::ZERO }
    }

    pub(super) fn record(&mut self, duration: Duration) {
        let nanoseconds = u64::try_from(duration.as_nanos()).unwrap_or(LONGEST_NS);
        self.histogram.saturating_record(nanoseconds);
        self.total += duration;
        self.longest = self.longest.max(duration);
    }

    pub(super) fn summary(&self) -> TimingSummary {
        let percentile_s = |quantile| self.histogram.value_at_quantile(quantile) as f64 * 1e-9;
        TimingSummary {
            count: self.histogram.len(),
            total_s: self.total.as_secs_f64(),
            p50_s: percentile_s(0.5),
            p99_s: percentile_s(0.99),
            p999_s: percentile_s(0.999),
            max_s: self.longest.as_secs_f64(),
        }
    }
}

/// Statistics of durations of one kind in one stage, s. Percentiles are precise to 1 %, total and maximum are exact.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct TimingSummary {
    /// Number of entries.
    pub count: u64,
    /// Sum of the durations.
    pub total_s: f64,
    /// Median duration.
    pub p50_s: f64,
    /// 99th percentile.
    pub p99_s: f64,
    /// 99.9th percentile.
    pub p999_s: f64,
    /// Longest duration.
    pub max_s: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_hold_to_a_percent() {
        let mut timing = Timing::new();
        for microseconds in 1..=1_000 {
            timing.record(Duration::from_micros(microseconds));
        }
        let summary = timing.summary();
        assert_eq!(summary.count, 1_000);
        // 1 + .. + 1000 us.
        assert!((summary.total_s - 0.500_5).abs() < 1e-12);
        // Two decimal digits are kept.
        for (found, expected) in [(summary.p50_s, 500e-6), (summary.p99_s, 990e-6), (summary.p999_s, 999e-6)]
        {
            assert!((found / expected - 1.0).abs() < 0.01, "{found} instead of {expected}");
        }
        assert!((summary.max_s - 1e-3).abs() < 1e-15);
    }

    #[test]
    fn nothing_and_too_much_are_recorded() {
        let mut timing = Timing::new();
        timing.record(Duration::ZERO);
        timing.record(Duration::MAX / 2);
        let summary = timing.summary();
        assert_eq!(summary.count, 2);
        assert!(summary.p999_s >= 86_400.0);
        assert_eq!(Timing::new().summary(), TimingSummary::default());
    }
}
