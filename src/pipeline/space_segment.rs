//! The space segment as a graph: windows, visibilities, the onboard store, packets.

use std::sync::Arc;

use super::config::Problems;
use super::error::PipelineError;
use super::plan::Plan;
use super::sampling::{SampleCounts, samples};
use crate::downlink::Transmitter;
use crate::frames::GroundFrame;
use crate::mother::{
    Fidelity, Integrator, MeasurementOptions, Ninth, NinthSetup, NinthSky, NoiseModel, Observer, PacedLink,
    Store,
};
use crate::response::model::DirectSum;
use crate::runtime::{Graph, Link};
use crate::sky::fits::{ReadOptions, read_whole_map};
use crate::sky::generated::generate;
use crate::sky::{Frame, SkyMap};

/// Name of the stage by whose windows progress is measured.
pub const INTEGRATE: &str = "integrate";

/// What is wrong with the files that a pipeline names; each is read.
pub(crate) fn file_problems(plan: &Plan) -> Problems {
    let mut found = Problems::new();
    let skies = plan.config.sky.file.iter().flat_map(|files| files.values());
    for path in skies.chain(&plan.config.map.prior_files) {
        if let Err(problem) = read_whole_map(path, &ReadOptions::default()) {
            found.push(Box::new(problem));
        }
    }
    if let Err(problem) = plan.config.calibration.build(std::path::Path::new("")) {
        found.push(Box::new(problem));
    }
    found
}

/// The simulated sky of every channel, in its own pixels and frame.
///
/// # Errors
/// A map that cannot be read or that has pixels without a value.
pub fn skies(plan: &Plan) -> Result<Vec<SkyMap>, PipelineError> {
    let config = &plan.config.sky;
    let sky = |(channel, &frequency_hz): (usize, &f64)| match config.file.as_ref() {
        Some(files) => {
            let path = files.get(channel).unwrap_or_default();
            Ok(read_whole_map(&path, &ReadOptions::default())?)
        }
        None => {
            let values = generate(&config.generated, frequency_hz, config.nside, plan.config.seed)?;
            Ok(SkyMap::new(Frame::Ecliptic, values)?)
        }
    };
    plan.config.spacecraft.channels_hz.iter().enumerate().map(sky).collect()
}

/// Adds the space segment to `graph`; what comes out are the bytes of the downlink. With sample fidelity its stages
/// count in `counts`.
///
/// # Errors
/// A model of the visibilities or a downlink configuration that cannot be.
pub fn add(
    graph: &mut Graph,
    plan: &Plan,
    skies: &[SkyMap],
    counts: &SampleCounts,
) -> Result<Link<Vec<u8>>, PipelineError> {
    let Plan { config, array, instrument, schedules, windows } = plan;
    let capacity = config.runtime.queue_capacity;
    let models = crate::pipeline::models::build(plan, skies)?;
    if config.spacecraft.fidelity == Fidelity::Samples {
        let frames = samples(graph, plan, models, counts);
        let frames = add_ninth(graph, plan, skies, frames)?;
        return transmit(graph, plan, frames);
    }
    let noise = NoiseModel {
        seed: config.spacecraft.thermal_noise.then_some(config.seed),
        receiver_noise_k_sr: config.spacecraft.receiver_noise_k_sr,
    };
    let options = MeasurementOptions {
        noise,
        smear_integrations: config.spacecraft.smear_integrations,
        auto_integration_s: config.spacecraft.autos_s(),
    };
    let integrator =
        Integrator::new(Arc::clone(array), models, instrument.clone(), schedules.clone(), options);
    // A window waiting is nothing; a window's visibilities are.
    let windows = graph.source("observe", 1, Observer::new(windows.clone()));
    let frames = graph.stage(INTEGRATE, capacity, windows, integrator);
    let frames = add_ninth(graph, plan, skies, frames)?;
    transmit(graph, plan, frames)
}

/// The ninth daughter's spectra among the frames, if there is one.
fn add_ninth(
    graph: &mut Graph,
    plan: &Plan,
    skies: &[SkyMap],
    frames: Link<GroundFrame>,
) -> Result<Link<GroundFrame>, PipelineError> {
    let Plan { config, array, windows, .. } = plan;
    if !config.spacecraft.ninth.on {
        return Ok(frames);
    }
    let setup = NinthSetup {
        array: Arc::clone(array),
        config: config.spacecraft.ninth.clone(),
        sky: ninth_sky(plan, skies)?,
        windows: windows.clone(),
        seed: config.spacecraft.thermal_noise.then_some(config.seed),
    };
    let capacity = config.runtime.queue_capacity;
    Ok(match Ninth::new(setup) {
        Some(ninth) => graph.stage("ninth", capacity, frames, ninth),
        None => frames,
    })
}

/// What the ninth daughter hears: the generated sky at her own frequencies, or the file of the highest channel, carried
/// on as a power of frequency.
fn ninth_sky(plan: &Plan, skies: &[SkyMap]) -> Result<NinthSky, PipelineError> {
    let Plan { config, array, instrument, .. } = plan;
    let model = |sky: &SkyMap, at_hz| DirectSum::new(sky, at_hz, array.moon_radius_m(), instrument.response);
    let ninth = &config.spacecraft.ninth;
    let channels = skies.iter().zip(&config.spacecraft.channels_hz);
    let highest = channels.max_by(|a, b| a.1.total_cmp(b.1));
    if let (Some(_), Some((sky, &frequency_hz))) = (&config.sky.file, highest) {
        return Ok(NinthSky::PowerLaw {
            model: model(sky, frequency_hz),
            frequency_hz,
            index: ninth.file_index,
        });
    }
    let map = |at_hz: f64| -> Result<(f64, DirectSum), PipelineError> {
        let values = generate(&config.sky.generated, at_hz, config.sky.nside, config.seed)?;
        Ok((at_hz, model(&SkyMap::new(Frame::Ecliptic, values)?, at_hz)))
    };
    Ok(NinthSky::Maps(NinthSky::nodes_hz(ninth.band_hz).into_iter().map(map).collect::<Result<_, _>>()?))
}

/// What comes after the visibilities, however they were made.
fn transmit(
    graph: &mut Graph,
    plan: &Plan,
    frames: Link<GroundFrame>,
) -> Result<Link<Vec<u8>>, PipelineError> {
    let config = &plan.config;
    let capacity = config.runtime.queue_capacity;
    let paced = |bytes_per_s| PacedLink { array: Arc::clone(&plan.array), bytes_per_s };
    let store = Store::new(&config.spacecraft, config.downlink.payload_bytes_per_s().map(paced));
    let passes = graph.stage("store", capacity, frames, store);
    Ok(graph.stage("transmit", capacity, passes, Transmitter::new(&config.downlink)?))
}
