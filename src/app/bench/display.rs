//! Text output of a benchmark.

use std::fmt;

use super::machine::is_doubtful;
use super::{Bench, ChainRun, Comparison, Machine, QueueDepths, StageComparison};

impl fmt::Display for Bench {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Machine { processor, vector_units, threads, version, commit, date } = &self.machine;
        let commit = commit.map_or(String::new(), |commit| format!(" ({commit})"));
        writeln!(f, "lunarray {version}{commit}, {date}")?;
        let units =
            if vector_units.is_empty() { String::new() } else { format!(" ({})", vector_units.join(", ")) };
        writeln!(f, "{processor}{units}, {threads} worker threads")?;
        if let Some(share) = self.others.filter(|share| is_doubtful(*share)) {
            let percent = 100.0 * share;
            writeln!(
                f,
                "warning: other processes used {percent:.0} % of the processors; repeat the benchmark on an idle machine"
            )?;
        }
        writeln!(
            f,
            "{:.1} s of {} channels x {} daughters, {} bits, blocks of {}, {} sky pixels\n",
            self.mission_s, self.channels, self.daughters, self.bits, self.block_samples, self.sky_pixels
        )?;
        self.write_rates(f)?;
        if let Some(chain) = &self.chain {
            writeln!(
                f,
                "\nLast run of the chain; \"since source\" is the time from a sample to the stage's output"
            )?;
            write_run(f, chain)?;
        }
        if let Some(ground) = &self.ground {
            writeln!(
                f,
                "\nThe ground segment on its packets; \"since source\" is the time from a packet to the stage's output"
            )?;
            write_run(f, ground)?;
        }
        if !self.growth.is_empty() {
            self.write_growth(f)?;
        }
        if let Some(stage) = &self.saturates_first {
            write!(f, "\nsaturates first: {stage}")?;
        }
        if let Some(Comparison { before: [version, processor, date], stages }) = &self.comparison {
            write!(f, "\n\ncompared with lunarray {version} of {date} on {processor}:")?;
            for StageComparison { stage, before_s, now_s, times_as_fast, differs } in stages {
                let verdict = if *differs { "" } else { ", within the spread" };
                write!(
                    f,
                    "\n{stage:<10} {now_s:.4} s, was {before_s:.4} s: {times_as_fast:.2} times as fast{verdict}"
                )?;
            }
        }
        Ok(())
    }
}

impl Bench {
    fn write_rates(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let columns = [
            ("stage     ", 10),
            ("median s", 9),
            ("quartiles s", 17),
            ("samples/s", 11),
            ("visibilities/s", 15),
            ("bytes/s", 12),
            ("times real time", 16),
            ("core s / mission s", 20),
        ];
        let rows = self.rates.iter().map(|rate| {
            [
                format!("{:<10}", rate.stage),
                format!("{:.4}", rate.median_s),
                format!("{:.4} .. {:.4}", rate.quartiles_s[0], rate.quartiles_s[1]),
                format!("{:.3e}", rate.samples_per_s),
                format!("{:.3e}", rate.visibilities_per_s),
                format!("{:.3e}", rate.bytes_per_s),
                format!("{:.1}", rate.times_real_time),
                core_seconds(rate.core_s_per_mission_s),
            ]
        });
        write_table(f, columns, rows)
    }

    fn write_growth(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nThe chain at other sizes; real time depends on the size")?;
        let columns = [
            ("channels", 8),
            ("daughters", 9),
            ("block", 6),
            ("samples/s", 11),
            ("slowest .. fastest", 23),
            ("times real time", 16),
            ("core s / mission s", 20),
        ];
        let rows = self.growth.iter().map(|row| {
            [
                row.channels.to_string(),
                row.daughters.to_string(),
                row.block_samples.to_string(),
                format!("{:.3e}", row.samples_per_s),
                range(row.samples_per_s_range),
                format!("{:.1}", row.times_real_time),
                core_seconds(row.core_s_per_mission_s),
            ]
        });
        write_table(f, columns, rows)
    }
}

/// Writes a table with right-aligned columns of the given titles and widths.
fn write_table<const N: usize>(
    f: &mut fmt::Formatter<'_>,
    columns: [(&str, usize); N],
    rows: impl Iterator<Item = [String; N]>,
) -> fmt::Result {
    let header = columns.map(|(title, _)| title.to_owned());
    for row in std::iter::once(header).chain(rows) {
        let cells = row.iter().zip(columns).map(|(cell, (_, width))| format!("{cell:>width$}"));
        writeln!(f, "{}", cells.collect::<Vec<_>>().join(" "))?;
    }
    Ok(())
}

fn range([slow, fast]: [f64; 2]) -> String {
    format!("{slow:.2e} .. {fast:.2e}")
}

fn core_seconds(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.4}"))
}

fn write_run(f: &mut fmt::Formatter<'_>, run: &ChainRun) -> fmt::Result {
    writeln!(f, "{}", run.report)?;
    let depths = |queue: &QueueDepths| format!("{} {}/{}/{}", queue.stage, queue.p10, queue.p50, queue.p90);
    let queues: Vec<String> = run.queues.iter().map(depths).collect();
    writeln!(f, "queue depths, p10/p50/p90 of {} samples: {}", run.times_s.len(), queues.join(", "))
}
