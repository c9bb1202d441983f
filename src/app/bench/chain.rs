//! Runs the chain, and the ground segment on its packets, as graphs whose queue depths are sampled.

use std::convert::Infallible;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::downlink::Transmitter;
use crate::frames::GroundFrame;
use crate::ground::{Ground, Reception, WAIT_BYTES};
use crate::imaging::Snapshot;
use crate::mother::Store;
use crate::pipeline::Config;
use crate::pipeline::PipelineError;
use crate::pipeline::Plan;
use crate::pipeline::graph::{SHUTDOWN, models};
use crate::pipeline::{SampleCounts, sample_stages};
use crate::runtime::{Cancel, Flow, Graph, Metrics, Outlet, Report, Sink, Source, StageProgress, Units};
use crate::sky::SkyMap;

const SAMPLE_INTERVAL: Duration = Duration::from_millis(5);
const SAMPLES_MAX: usize = 512;

/// One run of a chain of stages.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ChainRun {
    /// Fractions of time, latencies since the source, rates.
    pub report: Report,
    /// Times at which queue depths were sampled, s since the start.
    pub times_s: Vec<f64>,
    /// The queue before each stage except the source.
    pub queues: Vec<QueueDepths>,
}

/// Depth of the queue before a stage, in items, over time.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct QueueDepths {
    /// Name of the stage.
    pub stage: String,
    /// 10 % quantile.
    pub p10: u64,
    /// Median.
    pub p50: u64,
    /// 90 % quantile.
    pub p90: u64,
    /// The samples in order of time.
    pub series: Vec<u64>,
}

/// Runs the chain from samples to received visibilities.
pub(super) fn run(plan: &Plan, skies: &[SkyMap]) -> Result<ChainRun, PipelineError> {
    let capacity = plan.config.runtime.queue_capacity;
    let (sampler, link, correlator) =
        sample_stages(plan, models::build_all(plan, skies)?, &SampleCounts::default());
    let mut graph = Graph::new();
    let samples = graph.source("sample", capacity, sampler);
    let samples = graph.stage("link", capacity, samples, link);
    let visibilities = graph.stage("correlate", capacity, samples, correlator);
    let passes = graph.stage("store", capacity, visibilities, Store::new(&plan.config.spacecraft, None));
    let packets = graph.stage("transmit", capacity, passes, Transmitter::new(&plan.config.downlink)?);
    let received = graph.stage("receive", capacity, packets, reception());
    graph.sink("drop", received, FrameSink(0));
    run_sampled(graph)
}

/// Maximum number of ephemeris segments that the receiving stage keeps.
const SEGMENTS_MAX: usize = 8192;

pub(super) fn reception() -> Reception {
    Reception::new(WAIT_BYTES, SEGMENTS_MAX, Arc::default())
}

/// Runs the ground segment on packets, up to the sums.
pub(super) fn run_ground(config: &Config, packets: &[Vec<u8>]) -> Result<ChainRun, PipelineError> {
    let mut graph = Graph::new();
    // The source takes packets from the end.
    let packets = Packets(packets.iter().rev().cloned().collect());
    let bytes = graph.source("packets", config.runtime.queue_capacity, packets);
    let sums = graph.stage("ground", 1, bytes, Ground::new(&config.ground(WAIT_BYTES))?);
    graph.sink("drop", sums, SumsSink);
    run_sampled(graph)
}

fn run_sampled(graph: Graph) -> Result<ChainRun, PipelineError> {
    let (metrics, done) = (graph.metrics(), AtomicBool::new(false));
    let since = Instant::now();
    let (report, mut samples) = std::thread::scope(|scope| {
        let sampler = scope.spawn(|| {
            let mut samples = QueueSamples { step: 1, times_s: Vec::new(), depths: Vec::new() };
            let mut tick = 0_usize;
            while !done.load(Ordering::Relaxed) {
                if tick.is_multiple_of(samples.step) {
                    samples.add(since.elapsed().as_secs_f64(), &metrics);
                }
                tick += 1;
                std::thread::sleep(SAMPLE_INTERVAL);
            }
            samples
        });
        let report = graph.run(&Cancel::new(), SHUTDOWN);
        done.store(true, Ordering::Relaxed);
        (report, sampler.join().unwrap_or_default())
    });
    let report = report?;
    let queued = report.stages.iter().filter(|stage| stage.queue.is_some());
    let queues = queued.enumerate().map(|(k, stage)| {
        let series: Vec<u64> =
            samples.depths.iter_mut().map(|depths| std::mem::take(&mut depths[k])).collect();
        let mut sorted = series.clone();
        sorted.sort_unstable();
        let quantile = |q: f64| sorted.get(((sorted.len() as f64 - 1.0) * q) as usize).copied().unwrap_or(0);
        let [p10, p50, p90] = [0.1, 0.5, 0.9].map(quantile);
        QueueDepths { stage: stage.name.clone(), p10, p50, p90, series }
    });
    Ok(ChainRun { queues: queues.collect(), times_s: samples.times_s, report })
}

/// Samples of all queue depths.
#[derive(Default)]
struct QueueSamples {
    /// Number of intervals from one sample to the next.
    step: usize,
    times_s: Vec<f64>,
    /// Depths by sample, then by stage without the source.
    depths: Vec<Vec<u64>>,
}

impl QueueSamples {
    fn add(&mut self, time_s: f64, metrics: &Metrics) {
        let stages = metrics.snapshot();
        // Stages are in chain order, so a queue has the items that one stage has emitted and the next has not received. The
        // difference may be negative, as the counters change while they are read.
        let depth = |pair: &[StageProgress]| pair[0].items_out.saturating_sub(pair[1].items_in);
        self.times_s.push(time_s);
        self.depths.push(stages.windows(2).map(depth).collect());
        if self.times_s.len() >= SAMPLES_MAX {
            // Keep every other sample, so that a long run fits.
            let mut keep = (0..SAMPLES_MAX).map(|k| k % 2 == 0);
            self.times_s.retain(|_| keep.next().unwrap_or(false));
            let mut keep = (0..SAMPLES_MAX).map(|k| k % 2 == 0);
            self.depths.retain(|_| keep.next().unwrap_or(false));
            self.step *= 2;
        }
    }
}

struct Packets(Vec<Vec<u8>>);

impl Source for Packets {
    type Out = Vec<u8>;
    type Error = Infallible;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, Infallible> {
        let Some(packet) = self.0.pop() else { return Ok(Flow::Done) };
        out.push(packet);
        Ok(Flow::Continue)
    }
}

struct SumsSink;

impl Sink for SumsSink {
    type In = Snapshot;
    type Error = Infallible;

    fn take(&mut self, _: Snapshot) -> Result<(), Infallible> {
        Ok(())
    }
}

/// A sink that counts visibilities and drops them.
struct FrameSink(u64);

impl Sink for FrameSink {
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
