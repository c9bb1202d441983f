//! Statistics of a run.

use std::fmt;

use serde::Serialize;

use super::metrics::Counters;
use super::timing::TimingSummary;
use super::worker::Timings;

/// Statistics of the queue before a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct QueueReport {
    /// Capacity of the queue, items.
    pub capacity: usize,
    /// Maximum number of items found in the queue.
    pub depth_max: usize,
}

/// Statistics of one stage. Working and the two waiting times add up to the lifetime of its thread.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StageReport {
    /// Name of the stage.
    pub name: String,
    /// Number of items received.
    pub items_in: u64,
    /// Number of items sent.
    pub items_out: u64,
    /// Number of units processed.
    pub units: u64,
    /// Name of the unit; empty if the stage does not count.
    pub unit: &'static str,
    /// Time waiting for input, with one entry per input and one for the end.
    pub waiting_in: TimingSummary,
    /// Time working, with one entry per step and one for `finish`.
    pub working: TimingSummary,
    /// Time waiting for space in the output queue, with one entry per step and one for `finish`.
    pub waiting_out: TimingSummary,
    /// Time from the push of an item by the source, or from its arrival there, to the end of the step on the items made from it,
    /// with one entry per input.
    pub since_source: TimingSummary,
    /// The queue before the stage; `None` for a source.
    pub queue: Option<QueueReport>,
}

impl StageReport {
    pub(super) fn new(counters: &Counters, timings: &Timings) -> Self {
        let units = counters.units();
        Self {
            name: counters.name.clone(),
            items_in: counters.items_in(),
            items_out: counters.items_out(),
            units: units.count,
            unit: units.name,
            waiting_in: timings.waiting_in.summary(),
            working: timings.working.summary(),
            waiting_out: timings.waiting_out.summary(),
            since_source: timings.since_source.summary(),
            queue: counters
                .queue_capacity
                .map(|capacity| QueueReport { capacity, depth_max: counters.queue_depth_max() }),
        }
    }
}

/// Statistics of a run by stage, displayed as a table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Statistics of the stages, in the order in which they were added.
    pub stages: Vec<StageReport>,
    /// Duration of the run, s.
    pub elapsed_s: f64,
    /// Whether a source was cancelled before its end.
    pub cancelled: bool,
    /// Stages that had not ended when the grace period after cancellation was over. Their remaining outputs are missing.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cut: Vec<String>,
}

impl Report {
    /// The statistics of the stage called `name`.
    #[must_use]
    pub fn stage(&self, name: &str) -> Option<&StageReport> {
        self.stages.iter().find(|stage| stage.name == name)
    }
}

const HEADINGS: [&str; 10] = [
    "stage",
    "in",
    "out",
    "units/s",
    "busy",
    "wait in",
    "wait out",
    "queue",
    "step p50 / p99 / p99.9",
    "since source p50 / p99 / p99.9",
];

impl fmt::Display for Report {
    /// A plain-text table with fractions of the time of each thread, maximum queue length and capacity, time per step, and latency.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut rows = vec![HEADINGS.map(str::to_owned)];
        rows.extend(self.stages.iter().map(|stage| self.row(stage)));
        let widths: Vec<usize> = (0..HEADINGS.len())
            .map(|column| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0))
            .collect();
        for row in &rows {
            let mut line = String::new();
            for (column, (cell, &width)) in row.iter().zip(&widths).enumerate() {
                let cell = if column == 0 { format!("{cell:<width$}") } else { format!("  {cell:>width$}") };
                line.push_str(&cell);
            }
            writeln!(f, "{}", line.trim_end())?;
        }
        write!(f, "elapsed {}", format_duration(self.elapsed_s))?;
        if self.cancelled {
            f.write_str(", cancelled")?;
        }
        if !self.cut.is_empty() {
            write!(f, ", cut short: {}", self.cut.join(", "))?;
        }
        Ok(())
    }
}

impl Report {
    fn row(&self, stage: &StageReport) -> [String; HEADINGS.len()] {
        let lifetime_s = stage.waiting_in.total_s + stage.working.total_s + stage.waiting_out.total_s;
        let percentage = |summary: &TimingSummary| match lifetime_s {
            0.0 => "-".to_owned(),
            _ => format!("{:.0} %", 100.0 * summary.total_s / lifetime_s),
        };
        let has_queue = stage.queue.is_some();
        let rate = match stage.unit {
            "" => "-".to_owned(),
            unit => format!("{} {unit}", format_rate(stage.units as f64 / self.elapsed_s)),
        };
        [
            stage.name.clone(),
            if has_queue { stage.items_in.to_string() } else { "-".to_owned() },
            stage.items_out.to_string(),
            rate,
            percentage(&stage.working),
            if stage.waiting_in.count > 0 { percentage(&stage.waiting_in) } else { "-".to_owned() },
            if stage.waiting_out.count > 0 { percentage(&stage.waiting_out) } else { "-".to_owned() },
            stage.queue.map_or("-".to_owned(), |queue| format!("{}/{}", queue.depth_max, queue.capacity)),
            percentiles(&stage.working),
            percentiles(&stage.since_source),
        ]
    }
}

fn percentiles(summary: &TimingSummary) -> String {
    if summary.count == 0 {
        return "-".to_owned();
    }
    let [p50, p99, p999] = [summary.p50_s, summary.p99_s, summary.p999_s].map(format_duration);
    format!("{p50} / {p99} / {p999}")
}

fn format_duration(seconds: f64) -> String {
    let (value, unit) = match seconds {
        s if s >= 1.0 => (s, "s"),
        s if s >= 1e-3 => (s * 1e3, "ms"),
        s if s >= 1e-6 => (s * 1e6, "us"),
        s => (s * 1e9, "ns"),
    };
    format!("{} {unit}", three_digits(value))
}

fn format_rate(per_second: f64) -> String {
    let (value, prefix) = match per_second {
        r if r >= 1e9 => (r * 1e-9, " G"),
        r if r >= 1e6 => (r * 1e-6, " M"),
        r if r >= 1e3 => (r * 1e-3, " k"),
        r => (r, ""),
    };
    format!("{}{prefix}", three_digits(value))
}

fn three_digits(value: f64) -> String {
    let decimals = match value {
        v if v >= 100.0 => 0,
        v if v >= 10.0 => 1,
        _ => 2,
    };
    format!("{value:.decimals$}")
}
