//! The space segment in sample fidelity: samples, links, correlator.

use std::sync::{Arc, Mutex};

use super::plan::Plan;
use crate::daughters::{LinkCounts, SampleLink, Sampler, SamplerCounts, Scene};
use crate::frames::GroundFrame;
use crate::mother::VisibilityModel;
use crate::mother::correlator::{Correlator, CorrelatorCounts, CorrelatorSetup};
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
        channels: instrument.channels.clone(),
        receiver_noise_k_sr: config.spacecraft.receiver_noise_k_sr,
        seed: config.seed,
    };
    let daughters = &config.daughters;
    let sampler = Sampler::new(scene, daughters.clone(), windows.clone(), Arc::clone(&counts.sampler));
    let link = SampleLink::new(daughters, array.satellites(), Arc::clone(&counts.link));
    let setup = CorrelatorSetup {
        array: Arc::clone(array),
        instrument: instrument.clone(),
        schedules: schedules.clone(),
        block_samples: daughters.block_samples,
        wait_blocks: config.spacecraft.wait_blocks,
    };
    (sampler, link, Correlator::new(setup, Arc::clone(&counts.correlator)))
}

/// Adds them to `graph`.
pub(super) fn samples(
    graph: &mut Graph,
    plan: &Plan,
    models: Vec<Box<dyn VisibilityModel>>,
) -> Link<GroundFrame> {
    let capacity = plan.config.runtime.queue_capacity;
    let (sampler, link, correlator) = sample_stages(plan, models, &SampleCounts::default());
    let sent = graph.source("sample", capacity, sampler);
    let received = graph.stage("link", capacity, sent, link);
    graph.stage("correlate", capacity, received, correlator)
}
