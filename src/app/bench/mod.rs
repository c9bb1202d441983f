//! Speed of the stages of sample fidelity, each alone and all in a chain, for `lunarray bench`.
//!
//! Each stage is measured alone: its input, the output of the stage before it, is in memory. `chain` runs all stages with
//! their queues, and `growth` repeats this at other sizes. May use every folder except [`crate::cli`].

mod chain;
mod compare;
mod display;
mod growth;
mod machine;
mod timing;

use std::convert::Infallible;
use std::time::Instant;

use serde::Serialize;

use self::machine::{machine_seconds, share_of_others};
use self::timing::{
    TimeSpent, core_seconds_used, median, mission_s, quartiles, samples_per_mission_s, timed,
};
use crate::downlink::Transmitter;
use crate::frames::{GroundFrame, Samples, SpaceFrame};
use crate::imaging::EngineKind;
use crate::mother::Fidelity;
use crate::pipeline::Config;
use crate::pipeline::PipelineError;
use crate::pipeline::Plan;
use crate::pipeline::graph::{models, space_segment};
use crate::pipeline::{SampleCounts, sample_stages};
use crate::runtime::{Flow, Outlet, Report, Source, Stage};
use crate::sky::SkyMap;

pub use chain::{ChainRun, QueueDepths};
pub use compare::{Comparison, StageComparison};
pub use growth::GrowthRow;
pub use machine::Machine;

/// The stages that can be measured alone, and the chain.
pub const BENCH_STAGES: [&str; 6] = ["sample", "link", "correlate", "transmit", "receive", "chain"];

/// What to measure.
#[derive(Clone, Debug, PartialEq)]
pub struct BenchSettings {
    /// One of [`BENCH_STAGES`]; `None` for all.
    pub stage: Option<String>,
    /// Number of runs of each stage.
    pub runs: usize,
    /// Whether to run the chain also with other numbers of channels and daughters and other block sizes.
    pub growth: bool,
}

/// The rate of one stage over several runs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Rate {
    /// Name of the stage.
    pub stage: &'static str,
    /// Time of every run, s.
    pub runs_s: Vec<f64>,
    /// Median time, s.
    pub median_s: f64,
    /// Quartiles of the time, s.
    pub quartiles_s: [f64; 2],
    /// Complex samples per second, median over runs.
    pub samples_per_s: f64,
    /// Rates of the slowest and the fastest run.
    pub samples_per_s_range: [f64; 2],
    /// Visibilities per second that the stage processes; 0 if none.
    pub visibilities_per_s: f64,
    /// Bytes per second that the stage processes: samples on the links, packets on the downlink.
    pub bytes_per_s: f64,
    /// Mission time divided by median time.
    pub times_real_time: f64,
    /// Processor time per second of mission time, s, median over runs. It hardly depends on the load by other processes.
    /// `None` where the system does not report it.
    pub core_s_per_mission_s: Option<f64>,
}

/// The results of a benchmark.
#[derive(Clone, Debug, Serialize)]
pub struct Bench {
    /// The machine and the program.
    pub machine: Machine,
    /// Fraction of the processors that other processes used; `None` where the system does not report it.
    pub others: Option<f64>,
    /// Mission time of one run, s.
    pub mission_s: f64,
    /// Number of channels.
    pub channels: usize,
    /// Number of daughters.
    pub daughters: usize,
    /// Bits per real or imaginary part.
    pub bits: u32,
    /// Samples per block.
    pub block_samples: usize,
    /// Number of sky pixels, all of which each prediction sums.
    pub sky_pixels: usize,
    /// Rates by stage.
    pub rates: Vec<Rate>,
    /// The last run of the chain: fractions of time, latencies since sampling, queue depths.
    pub chain: Option<ChainRun>,
    /// The run of the ground segment on its packets, up to the sums, with latencies since the packet.
    pub ground: Option<ChainRun>,
    /// The stage with the longest working time in the chain.
    pub saturates_first: Option<String>,
    /// The chain at other sizes; empty unless requested.
    pub growth: Vec<GrowthRow>,
    /// Comparison with an earlier benchmark, if one was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub comparison: Option<Comparison>,
}

/// The default pipeline of a benchmark: the design's 30 channels, 8 bits, and a small sky.
#[must_use]
pub fn bench_config() -> Config {
    let mut config = Config { name: "bench".to_owned(), ..Config::default() };
    config.sky.nside = 8;
    config.map.engine = EngineKind::Pixel;
    config.spacecraft.fidelity = Fidelity::Samples;
    config.spacecraft.channels_hz = (1..=30).map(|k| 1e6 * f64::from(k)).collect();
    config.spacecraft.duration_s = 3e4;
    config.spacecraft.window_s_max = 16.0;
    // The last daughters see the Earth for 64 s of a window, and their visibilities would be flagged.
    config.spacecraft.flag_earth = false;
    config
}

/// The outputs of all stages for one window: the inputs for the measurements.
struct StageData {
    samples: Vec<SpaceFrame>,
    visibilities: Vec<GroundFrame>,
    packets: Vec<Vec<u8>>,
    sample_count: f64,
    visibility_count: f64,
    packet_bytes: f64,
    sample_bytes: f64,
}

/// Measures the first window of a plan in sample fidelity, with the data between stages in memory.
///
/// # Errors
/// An invalid sky or downlink; a chain that fails.
pub fn bench(plan: &Plan, settings: &BenchSettings) -> Result<Bench, PipelineError> {
    let plan = Plan { windows: plan.windows.iter().take(1).copied().collect(), ..plan.clone() };
    let skies = space_segment::skies(&plan)?;
    let sky_pixels = skies.first().map_or(0, |sky| sky.values().len());
    let config = &plan.config;
    let data = stage_data(&plan, &skies)?;
    let is_selected = |stage: &str| settings.stage.as_deref().is_none_or(|only| only == stage);
    let mission_s = mission_s(&plan);
    let (since, before_s) = (Instant::now(), machine_seconds().zip(core_seconds_used()));
    let mut rates = Vec::new();
    let (mut chain, mut ground) = (None, None);
    for stage in BENCH_STAGES.into_iter().filter(|stage| is_selected(stage)) {
        let (mut seconds, mut core_seconds) = (Vec::new(), Vec::new());
        for _ in 0..settings.runs.max(1) {
            let spent = if stage == "chain" {
                let (spent, run) = timed(|| chain::run(&plan, &skies));
                chain = Some(run?);
                spent
            } else {
                time_stage(&plan, &skies, &data, stage)?
            };
            seconds.push(spent.seconds);
            core_seconds.extend(spent.core_seconds);
        }
        let core_s = (!core_seconds.is_empty()).then(|| median(&mut core_seconds) / mission_s);
        rates.push(data.rate(stage, seconds, core_s, samples_per_mission_s(&plan)));
        if stage == "chain" {
            ground = Some(chain::run_ground(config, &data.packets)?);
        }
    }
    let growth = if settings.growth { growth::rows(&plan, &skies, settings.runs)? } else { Vec::new() };
    let spent = machine_seconds().zip(core_seconds_used()).zip(before_s);
    let others = spent.map(|((all_s, own_s), (all_before_s, own_before_s))| {
        share_of_others(since.elapsed().as_secs_f64(), all_s - all_before_s, own_s - own_before_s)
    });
    let busiest = |report: &Report| {
        let stages = report.stages.iter();
        stages.max_by(|a, b| a.working.total_s.total_cmp(&b.working.total_s)).map(|s| s.name.clone())
    };
    Ok(Bench {
        machine: Machine::new(),
        others,
        mission_s,
        channels: plan.instrument.channels.len(),
        daughters: plan.array.satellites(),
        bits: config.daughters.bits,
        block_samples: config.daughters.block_samples,
        sky_pixels,
        rates,
        saturates_first: chain.as_ref().and_then(|chain: &ChainRun| busiest(&chain.report)),
        chain,
        ground,
        growth,
        comparison: None,
    })
}

fn run_source<S: Source>(mut source: S) -> Result<Vec<S::Out>, S::Error> {
    let mut out = Outlet::collect();
    while source.next(&mut out)? == Flow::Continue {}
    Ok(out.into_vec())
}

fn run_stage<S: Stage>(mut stage: S, input: Vec<S::In>) -> Result<Vec<S::Out>, S::Error> {
    let mut out = Outlet::collect();
    for item in input {
        stage.step(item, &mut out)?;
    }
    stage.finish(&mut out)?;
    Ok(out.into_vec())
}

/// The value of a result that cannot be an error.
fn infallible<T>(result: Result<T, Infallible>) -> T {
    match result {
        Ok(value) => value,
        Err(never) => match never {},
    }
}

fn stage_data(plan: &Plan, skies: &[SkyMap]) -> Result<StageData, PipelineError> {
    let (sampler, _, correlator) =
        sample_stages(plan, models::build_all(plan, skies)?, &SampleCounts::default());
    let samples = run_source(sampler)?;
    let visibilities = infallible(run_stage(correlator, samples.clone()));
    let packets = run_stage(Transmitter::new(&plan.config.downlink)?, visibilities.clone())?;
    let count = |frame: &GroundFrame| match frame {
        GroundFrame::Visibilities(block) => block.len() as f64,
        _ => 0.0,
    };
    Ok(StageData {
        sample_count: samples_of(&samples).map(|samples| samples.len() as f64).sum(),
        sample_bytes: samples_of(&samples).map(|samples| samples.bits() as f64 / 8.0).sum(),
        visibility_count: visibilities.iter().map(count).sum(),
        packet_bytes: packets.iter().map(|packet| packet.len() as f64).sum(),
        samples,
        visibilities,
        packets,
    })
}

fn samples_of(frames: &[SpaceFrame]) -> impl Iterator<Item = &Samples> {
    let blocks = frames.iter().flat_map(|frame| match frame {
        SpaceFrame::Samples(blocks) => blocks.as_slice(),
        _ => &[],
    });
    blocks.map(|block| &block.samples)
}

fn time_stage(
    plan: &Plan,
    skies: &[SkyMap],
    data: &StageData,
    name: &str,
) -> Result<TimeSpent, PipelineError> {
    let (sampler, link, correlator) =
        sample_stages(plan, models::build_all(plan, skies)?, &SampleCounts::default());
    // Input is copied before the clock starts, and output is dropped after it stops.
    Ok(match name {
        "sample" => {
            let (spent, sampled) = timed(|| run_source(sampler));
            sampled?;
            spent
        }
        "link" => {
            let input = data.samples.clone();
            timed(|| infallible(run_stage(link, input))).0
        }
        "correlate" => {
            let input = data.samples.clone();
            timed(|| infallible(run_stage(correlator, input))).0
        }
        "transmit" => {
            let (input, transmitter) = (data.visibilities.clone(), Transmitter::new(&plan.config.downlink)?);
            let (spent, sent) = timed(|| run_stage(transmitter, input));
            sent?;
            spent
        }
        _ => {
            let (input, reception) = (data.packets.clone(), chain::reception());
            let (spent, received) = timed(|| run_stage(reception, input));
            received?;
            spent
        }
    })
}

impl StageData {
    fn rate(
        &self,
        stage: &'static str,
        runs_s: Vec<f64>,
        core_s_per_mission_s: Option<f64>,
        real_time: f64,
    ) -> Rate {
        let mut seconds = runs_s.clone();
        let median_s = median(&mut seconds);
        let (min_s, max_s) = (seconds[0], seconds[seconds.len() - 1]);
        let bytes = match stage {
            "transmit" | "receive" => self.packet_bytes,
            _ => self.sample_bytes,
        };
        let visibilities = if matches!(stage, "sample" | "link") { 0.0 } else { self.visibility_count };
        let samples_per_s = self.sample_count / median_s;
        Rate {
            stage,
            runs_s,
            median_s,
            quartiles_s: quartiles(&seconds),
            samples_per_s,
            samples_per_s_range: [self.sample_count / max_s, self.sample_count / min_s],
            visibilities_per_s: visibilities / median_s,
            bytes_per_s: bytes / median_s,
            times_real_time: samples_per_s / real_time,
            core_s_per_mission_s,
        }
    }
}
