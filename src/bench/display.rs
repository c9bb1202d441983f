//! What was measured, as text.

use std::fmt;

use super::{Bench, ChainRun, Machine};

impl fmt::Display for Bench {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Machine { processor, threads } = &self.machine;
        writeln!(f, "{processor}, {threads} worker threads")?;
        writeln!(
            f,
            "{:.1} s of {} channels x {} daughters, {} bits, blocks of {}, {} sky pixels\n",
            self.mission_s, self.channels, self.daughters, self.bits, self.block_samples, self.sky_pixels
        )?;
        writeln!(
            f,
            "{:<10} {:>11} {:>23} {:>15} {:>12} {:>16} {:>20}",
            "stage",
            "samples/s",
            "slowest .. fastest",
            "visibilities/s",
            "bytes/s",
            "times real time",
            "core s / mission s"
        )?;
        for rate in &self.rates {
            let [slow, fast] = rate.samples_per_s_range;
            let range = format!("{slow:.2e} .. {fast:.2e}");
            writeln!(
                f,
                "{:<10} {:>11.3e} {range:>23} {:>15.3e} {:>12.3e} {:>16.1} {:>20}",
                rate.stage,
                rate.samples_per_s,
                rate.visibilities_per_s,
                rate.bytes_per_s,
                rate.times_real_time,
                core_seconds(rate.core_s_per_mission_s)
            )?;
        }
        if let Some(chain) = &self.chain {
            writeln!(f, "\nThe chain's last run; \"since source\" is from sample to what the stage made")?;
            write_run(f, chain)?;
        }
        if let Some(ground) = &self.ground {
            writeln!(
                f,
                "\nIts packets on the ground; \"since source\" is from packet to what the stage made"
            )?;
            write_run(f, ground)?;
        }
        if !self.growth.is_empty() {
            self.write_growth(f)?;
        }
        if let Some(stage) = &self.saturates_first {
            write!(f, "\nsaturates first: {stage}")?;
        }
        Ok(())
    }
}

impl Bench {
    fn write_growth(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "\nThe chain at other sizes; real time is that of the size")?;
        writeln!(
            f,
            "{:>8} {:>9} {:>6} {:>11} {:>23} {:>16} {:>20}",
            "channels",
            "daughters",
            "block",
            "samples/s",
            "slowest .. fastest",
            "times real time",
            "core s / mission s"
        )?;
        for row in &self.growth {
            let [slow, fast] = row.samples_per_s_range;
            let range = format!("{slow:.2e} .. {fast:.2e}");
            writeln!(
                f,
                "{:>8} {:>9} {:>6} {:>11.3e} {range:>23} {:>16.1} {:>20}",
                row.channels,
                row.daughters,
                row.block_samples,
                row.samples_per_s,
                row.times_real_time,
                core_seconds(row.core_s_per_mission_s)
            )?;
        }
        Ok(())
    }
}

fn core_seconds(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.4}"))
}

fn write_run(f: &mut fmt::Formatter<'_>, run: &ChainRun) -> fmt::Result {
    writeln!(f, "{}", run.report)?;
    let depths = |queue: &crate::bench::QueueDepths| {
        format!("{} {}/{}/{}", queue.stage, queue.p10, queue.p50, queue.p90)
    };
    let queues: Vec<String> = run.queues.iter().map(depths).collect();
    writeln!(f, "queued over {} looks, p10/p50/p90: {}", run.times_s.len(), queues.join(", "))
}
