//! The stages of the space segment that simulate samples: sampler, links, correlator.

use std::sync::Arc;

use super::sample_summary::SampleCounts;
use crate::daughters::{SampleLink, Sampler, Scene};
use crate::frames::{Channel, GroundFrame, Instrument};
use crate::mother::Schedule;
use crate::mother::correlator::{Correlator, CorrelatorSetup};
use crate::pipeline::config::Plan;
use crate::response::model::VisibilityModel;
use crate::runtime::{Graph, Link};

/// Makes the sampler, links and correlator of a plan, not yet in a graph.
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
        receiver_noise_k_sr: config.spacecraft.receiver_k_sr(),
        seed: config.seed,
    };
    let daughters = &config.daughters;
    let errors = plan.instrument_errors();
    let sampler = Sampler::new(scene, daughters.clone(), windows.clone(), Arc::clone(&counts.sampler))
        .with_errors(errors.clone());
    let link = SampleLink::new(daughters, array, Arc::clone(&counts.link));
    let division = config.spacecraft.division();
    // On the downlink each sub-band is a channel of its own.
    let channels = division.divided(&instrument.channels);
    let instrument = Instrument { channels, ..instrument.clone() };
    let band_schedule = |(k, band): (usize, &Channel)| Schedule {
        frequency_hz: band.frequency_hz,
        ..schedules[k / division.sub_bands]
    };
    let setup = CorrelatorSetup {
        array: Arc::clone(array),
        schedules: instrument.channels.iter().enumerate().map(band_schedule).collect(),
        instrument,
        division,
        auto_integration_s: config.spacecraft.autos_s(),
        flag_earth: config.spacecraft.flag_earth,
        block_samples: daughters.block_samples,
        wait_blocks: config.spacecraft.wait_blocks,
    };
    let correlator = Correlator::new(setup, Arc::clone(&counts.correlator)).with_errors(errors);
    (sampler, link, correlator)
}

pub(crate) fn add_sample_stages(
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
