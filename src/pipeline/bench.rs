//! How fast the stages of sample fidelity are, each alone and all in a chain.

use std::convert::Infallible;
use std::fmt;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Serialize;

use super::config::Config;
use super::error::PipelineError;
use super::plan::Plan;
use super::sampling::{SampleCounts, sample_stages};
use super::space;
use crate::downlink::{Reception, Transmitter};
use crate::frames::{GroundFrame, SpaceFrame};
use crate::mother::{Fidelity, Store};
use crate::runtime::{Cancel, Flow, Graph, Outlet, Report, Sink, Source, Stage, Units};
use crate::sky::SkyMap;

/// Stages that can be measured alone, and the chain of them.
pub const BENCH_STAGES: [&str; 6] = ["sample", "link", "correlate", "transmit", "receive", "chain"];

/// Samples a second of the design: eight daughters, 30 channels of 8 kHz.
const DESIGN_SAMPLES_PER_S: f64 = 8.0 * 30.0 * 8000.0;

/// What is measured.
#[derive(Clone, Debug, PartialEq)]
pub struct BenchSettings {
    /// One of [`BENCH_STAGES`]; `None` for all.
    pub stage: Option<String>,
    /// Runs of each.
    pub runs: usize,
}

/// The rate of one stage over several runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Rate {
    /// Stage.
    pub stage: &'static str,
    /// Complex samples a second, median over runs.
    pub samples_per_s: f64,
    /// The slowest run and the fastest.
    pub samples_per_s_range: [f64; 2],
    /// Visibilities a second that the stage makes or passes; 0 if none.
    pub visibilities_per_s: f64,
    /// Bytes a second that the stage passes: samples on the links, packets on the downlink.
    pub bytes_per_s: f64,
    /// Median rate over that of eight daughters with 30 channels of 8 kHz.
    pub times_real_time: f64,
}

/// The machine.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Machine {
    /// Processor, as the system names it.
    pub processor: String,
    /// Worker threads.
    pub threads: usize,
}

/// All that was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Bench {
    /// The machine.
    pub machine: Machine,
    /// Mission time of one run, s.
    pub mission_s: f64,
    /// Number of channels.
    pub channels: usize,
    /// Number of daughters.
    pub daughters: usize,
    /// Bits of a part of a sample.
    pub bits: u32,
    /// Samples of a block.
    pub block_samples: usize,
    /// Pixels of the sky, all summed for each prediction.
    pub sky_pixels: usize,
    /// Stage by stage.
    pub rates: Vec<Rate>,
    /// The last run of the chain: shares of time, latencies since sampling, queues.
    pub chain: Option<Report>,
    /// The stage that worked most of the chain's time.
    pub saturates_first: Option<String>,
}

/// The pipeline that is measured when none is named: the design's 30 channels, 8 bits, a small sky.
#[must_use]
pub fn bench_config() -> Config {
    let mut config = Config { name: "bench".to_owned(), ..Config::default() };
    config.sky.nside = 8;
    config.spacecraft.fidelity = Fidelity::Samples;
    config.spacecraft.channels_hz = (1..=30).map(|k| 1e6 * f64::from(k)).collect();
    config.spacecraft.duration_s = 3e4;
    config.spacecraft.window_s_max = 16.0;
    config
}

/// Everything that is made of one window, kept so that each stage can be fed alone.
struct Material {
    samples: Vec<SpaceFrame>,
    visibilities: Vec<GroundFrame>,
    packets: Vec<Vec<u8>>,
    sample_count: f64,
    visibility_count: f64,
    packet_bytes: f64,
    sample_bytes: f64,
}

/// Measures a plan's first window in sample fidelity; what waits between stages is kept in memory.
///
/// # Errors
/// A sky or downlink that cannot be; a chain that fails.
pub fn bench(plan: &Plan, settings: &BenchSettings) -> Result<Bench, PipelineError> {
    let plan = Plan { windows: plan.windows.iter().take(1).copied().collect(), ..plan.clone() };
    let skies = space::skies(&plan)?;
    let sky_pixels = skies.first().map_or(0, |sky| sky.values().len());
    let config = &plan.config;
    let material = material(&plan, &skies)?;
    let wanted = |stage: &str| settings.stage.as_deref().is_none_or(|only| only == stage);
    let mut rates = Vec::new();
    let mut chain = None;
    for stage in BENCH_STAGES.into_iter().filter(|stage| wanted(stage)) {
        let mut seconds = Vec::new();
        for _ in 0..settings.runs.max(1) {
            if stage == "chain" {
                let since = Instant::now();
                chain = Some(run_chain(&plan, &skies)?);
                seconds.push(since.elapsed().as_secs_f64());
            } else {
                seconds.push(time_stage(&plan, &skies, &material, stage)?);
            }
        }
        rates.push(material.rate(stage, seconds));
    }
    let busiest = |report: &Report| {
        let stages = report.stages.iter();
        stages.max_by(|a, b| a.working.total_s.total_cmp(&b.working.total_s)).map(|s| s.name.clone())
    };
    Ok(Bench {
        machine: Machine { processor: processor(), threads: rayon::current_num_threads() },
        mission_s: plan.windows.iter().map(|w| (w.end.0 - w.start.0) as f64 * 1e-6).sum(),
        channels: plan.instrument.channels.len(),
        daughters: plan.array.satellites(),
        bits: config.daughters.bits,
        block_samples: config.daughters.block_samples,
        sky_pixels,
        rates,
        saturates_first: chain.as_ref().and_then(busiest),
        chain,
    })
}

fn source<S: Source>(mut source: S) -> Result<Vec<S::Out>, S::Error> {
    let mut out = Outlet::collect();
    while source.next(&mut out)? == Flow::Continue {}
    Ok(out.into_vec())
}

fn stage<S: Stage>(mut stage: S, input: Vec<S::In>) -> Result<Vec<S::Out>, S::Error> {
    let mut out = Outlet::collect();
    for item in input {
        stage.step(item, &mut out)?;
    }
    stage.finish(&mut out)?;
    Ok(out.into_vec())
}

fn never<T>(result: Result<T, Infallible>) -> T {
    match result {
        Ok(value) => value,
        Err(never) => match never {},
    }
}

fn material(plan: &Plan, skies: &[SkyMap]) -> Result<Material, PipelineError> {
    let (sampler, _, correlator) =
        sample_stages(plan, super::models::build(plan, skies)?, &SampleCounts::default());
    let samples = source(sampler)?;
    let visibilities = never(stage(correlator, samples.clone()));
    let packets = stage(Transmitter::new(&plan.config.downlink)?, visibilities.clone())?;
    let length = |frame: &SpaceFrame| match frame {
        SpaceFrame::Samples(block) => (block.samples.len() as f64, block.samples.bits() as f64 / 8.0),
        _ => (0.0, 0.0),
    };
    let count = |frame: &GroundFrame| match frame {
        GroundFrame::Visibilities(block) => block.len() as f64,
        _ => 0.0,
    };
    Ok(Material {
        sample_count: samples.iter().map(|frame| length(frame).0).sum(),
        sample_bytes: samples.iter().map(|frame| length(frame).1).sum(),
        visibility_count: visibilities.iter().map(count).sum(),
        packet_bytes: packets.iter().map(|packet| packet.len() as f64).sum(),
        samples,
        visibilities,
        packets,
    })
}

/// Seconds of one run of a stage alone.
fn time_stage(plan: &Plan, skies: &[SkyMap], material: &Material, name: &str) -> Result<f64, PipelineError> {
    let (sampler, link, correlator) =
        sample_stages(plan, super::models::build(plan, skies)?, &SampleCounts::default());
    // Input is copied before the clock starts, and output dropped after it has stopped.
    Ok(match name {
        "sample" => {
            let (seconds, sampled) = timed(|| source(sampler));
            sampled?;
            seconds
        }
        "link" => {
            let input = material.samples.clone();
            timed(|| never(stage(link, input))).0
        }
        "correlate" => {
            let input = material.samples.clone();
            timed(|| never(stage(correlator, input))).0
        }
        "transmit" => {
            let (input, transmitter) =
                (material.visibilities.clone(), Transmitter::new(&plan.config.downlink)?);
            let (seconds, sent) = timed(|| stage(transmitter, input));
            sent?;
            seconds
        }
        _ => {
            let (input, reception) = (material.packets.clone(), Reception::new(Arc::default()));
            let (seconds, received) = timed(|| stage(reception, input));
            received?;
            seconds
        }
    })
}

fn timed<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let since = Instant::now();
    let value = work();
    (since.elapsed().as_secs_f64(), value)
}

fn run_chain(plan: &Plan, skies: &[SkyMap]) -> Result<Report, PipelineError> {
    let capacity = plan.config.runtime.queue_capacity;
    let (sampler, link, correlator) =
        sample_stages(plan, super::models::build(plan, skies)?, &SampleCounts::default());
    let mut graph = Graph::new();
    let samples = graph.source("sample", capacity, sampler);
    let samples = graph.stage("link", capacity, samples, link);
    let visibilities = graph.stage("correlate", capacity, samples, correlator);
    let passes = graph.stage("store", capacity, visibilities, Store::new(&plan.config.spacecraft, None));
    let packets = graph.stage("transmit", capacity, passes, Transmitter::new(&plan.config.downlink)?);
    let received = graph.stage("receive", capacity, packets, Reception::new(Arc::default()));
    graph.sink("drop", received, Forget(0));
    Ok(graph.run(&Cancel::new(), Duration::from_secs_f64(plan.config.runtime.shutdown_s))?)
}

/// Counts visibilities and forgets them.
struct Forget(u64);

impl Sink for Forget {
    type In = GroundFrame;
    type Error = Infallible;

    fn take(&mut self, input: GroundFrame) -> Result<(), Infallible> {
        if let GroundFrame::Visibilities(block) = input {
            self.0 += block.len() as u64;
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.0, "visibilities")
    }
}

impl Material {
    fn rate(&self, stage: &'static str, mut seconds: Vec<f64>) -> Rate {
        seconds.sort_by(f64::total_cmp);
        let (least_s, most_s) = (seconds[0], seconds[seconds.len() - 1]);
        let median_s = seconds[seconds.len() / 2];
        let bytes = match stage {
            "transmit" | "receive" => self.packet_bytes,
            _ => self.sample_bytes,
        };
        let visibilities = if matches!(stage, "sample" | "link") { 0.0 } else { self.visibility_count };
        let samples_per_s = self.sample_count / median_s;
        Rate {
            stage,
            samples_per_s,
            samples_per_s_range: [self.sample_count / most_s, self.sample_count / least_s],
            visibilities_per_s: visibilities / median_s,
            bytes_per_s: bytes / median_s,
            times_real_time: samples_per_s / DESIGN_SAMPLES_PER_S,
        }
    }
}

/// The processor's name where the system tells it.
fn processor() -> String {
    let text = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let named = text.lines().find_map(|line| line.strip_prefix("model name")?.split_once(':'));
    named.map_or_else(|| std::env::consts::ARCH.to_owned(), |(_, name)| name.trim().to_owned())
}

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
            "{:<10} {:>11} {:>23} {:>15} {:>12} {:>16}",
            "stage", "samples/s", "slowest .. fastest", "visibilities/s", "bytes/s", "times real time"
        )?;
        for rate in &self.rates {
            let [slow, fast] = rate.samples_per_s_range;
            let range = format!("{slow:.2e} .. {fast:.2e}");
            writeln!(
                f,
                "{:<10} {:>11.3e} {range:>23} {:>15.3e} {:>12.3e} {:>16.1}",
                rate.stage,
                rate.samples_per_s,
                rate.visibilities_per_s,
                rate.bytes_per_s,
                rate.times_real_time
            )?;
        }
        if let Some(chain) = &self.chain {
            writeln!(
                f,
                "\nThe chain's last run; \"since source\" is from sample to what the stage made\n{chain}"
            )?;
        }
        if let Some(stage) = &self.saturates_first {
            write!(f, "\nsaturates first: {stage}")?;
        }
        Ok(())
    }
}
