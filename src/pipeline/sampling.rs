//! The space segment in sample fidelity: samples, links, correlator.

use std::sync::{Arc, Mutex};

use super::error::PipelineError;
use super::plan::Plan;
use super::sample_summary::SampleSummary;
use crate::daughters::{LinkCounts, SampleLink, Sampler, SamplerCounts, Scene};
use crate::frames::{Channel, GroundFrame, Instrument};
use crate::mother::correlator::{Correlator, CorrelatorCounts, CorrelatorSetup};
use crate::mother::{Fidelity, Schedule};
use crate::response::model::VisibilityModel;
use crate::runtime::{Graph, Link};

/// What the stages of sample fidelity count while they run.
#[derive(Clone, Default)]
pub struct SampleCounts {
    /// Sampling.
    pub sampler: Arc<Mutex<SamplerCounts>>,
    /// The links to the mother.
    pub link: Arc<Mutex<LinkCounts>>,
    /// The correlator.
    pub correlator: Arc<Mutex<CorrelatorCounts>>,
}

impl SampleCounts {
    /// The account of samples of a plan's run; `None` without samples.
    pub(crate) fn close(&self, plan: &Plan) -> Result<Option<SampleSummary>, PipelineError> {
        let sampled = plan.config.spacecraft.fidelity == Fidelity::Samples;
        Ok(sampled.then(|| SampleSummary::close(self)).transpose()?)
    }
}

/// The stages of sample fidelity for a plan, not yet in a graph.
#[must_use]
pub fn sample_stages(
    plan: &Plan,
    models: Vec<Box<dyn VisibilityModel>>,
    counts: &SampleCounts,
) -> (Sampler, SampleLink, Correlator) {
    let Plan { config, array, instrument, schedules, windows } = plan;
    let scene = Scene {
        array: Arc::clone(array),
        models,
        channels: config.spacecraft.channels(),
        receiver_noise_k_sr: config.spacecraft.receiver_noise_k_sr,
        seed: config.seed,
    };
    let daughters = &config.daughters;
    let sampler = Sampler::new(scene, daughters.clone(), windows.clone(), Arc::clone(&counts.sampler));
    let link = SampleLink::new(daughters, array, Arc::clone(&counts.link));
    let division = config.spacecraft.division();
    // What comes down are sub-bands, each a channel of its own.
    let channels = division.divided(&instrument.channels);
    let instrument = Instrument { channels, ..instrument.clone() };
    let of_band = |(k, band): (usize, &Channel)| Schedule {
        frequency_hz: band.frequency_hz,
        ..schedules[k / division.sub_bands]
    };
    let setup = CorrelatorSetup {
        array: Arc::clone(array),
        schedules: instrument.channels.iter().enumerate().map(of_band).collect(),
        instrument,
        division,
        auto_integration_s: config.spacecraft.autos_s(),
        block_samples: daughters.block_samples,
        wait_blocks: config.spacecraft.wait_blocks,
    };
    (sampler, link, Correlator::new(setup, Arc::clone(&counts.correlator)))
}

/// Adds them to `graph`.
pub(crate) fn samples(
    graph: &mut Graph,
    plan: &Plan,
    models: Vec<Box<dyn VisibilityModel>>,
    counts: &SampleCounts,
) -> Link<GroundFrame> {
    let capacity = plan.config.runtime.queue_capacity;
    let (sampler, link, correlator) = sample_stages(plan, models, counts);
    let sent = graph.source("sample", capacity, sampler);
    let received = graph.stage("link", capacity, sent, link);
    graph.stage("correlate", capacity, received, correlator)
}
