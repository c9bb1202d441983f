//! The stages of the space segment: from observing windows to visibilities, the onboard store and packets.

use std::path::Path;
use std::sync::Arc;

use super::models;
use super::sample_summary::SampleCounts;
use super::sampling::add_sample_stages;
use crate::downlink::Transmitter;
use crate::frames::GroundFrame;
use crate::mother::{
    Fidelity, Integrator, MeasurementOptions, Ninth, NinthSetup, NinthSky, NoiseModel, Observer, PacedLink,
    Store,
};
use crate::pipeline::config::{Config, PipelineError, Plan};
use crate::response::model::DirectSum;
use crate::runtime::{Graph, Link};
use crate::sky::fits::{read_notes, read_sky, sky_notes as map_notes};
use crate::sky::generated::{AddedSkyError, describe_catalogue, generate};
use crate::sky::{Frame, SkyMap};
use crate::units::ChannelId;

/// Name of the stage whose count of windows measures progress.
pub const INTEGRATE: &str = "integrate";

/// The simulated sky of every channel, at the map's own resolution and frame.
///
/// # Errors
/// A map that cannot be read, with pixels that are no sky temperature, or for another frequency.
pub fn skies(plan: &Plan) -> Result<Vec<SkyMap>, PipelineError> {
    (0..).map(ChannelId).take(plan.schedules.len()).map(|channel| sky(plan, channel)).collect()
}

/// The sky of one channel.
///
/// # Errors
/// As [`skies`].
pub(crate) fn sky(plan: &Plan, channel: ChannelId) -> Result<SkyMap, PipelineError> {
    let config = &plan.config.sky;
    let channel = usize::from(channel.0);
    let frequency_hz = plan.config.spacecraft.channels_hz[channel];
    match config.file.as_ref() {
        Some(files) => {
            let path = files.get(channel).unwrap_or_default();
            let map = read_sky(&path, &plan.sky_channel(channel), config)?;
            let Some(added) = &config.added else { return Ok(map) };
            let seed = plan.config.seed;
            Ok(added.add_to(map, &config.generated, frequency_hz, config.nside, seed)?)
        }
        None => {
            let values = generate(&config.generated, frequency_hz, config.nside, plan.config.seed)?;
            Ok(SkyMap::new(Frame::Ecliptic, values)?)
        }
    }
}

/// Notes on the sky: assumptions about map files and catalogues, such as their unit, and whether it is too coarse for the baselines.
///
/// # Errors
/// A map of the sky that cannot be read.
pub fn sky_notes(plan: &Plan) -> Result<Vec<String>, PipelineError> {
    let Config { sky, map, spacecraft, .. } = &plan.config;
    let mut notes: Vec<String> = Vec::new();
    let mut add = |path: &Path, found: Vec<String>| {
        for note in found {
            let note = format!("{}: {note}", path.display());
            // A file may serve several channels.
            if !notes.contains(&note) {
                notes.push(note);
            }
        }
    };
    for channel in 0..spacecraft.channels_hz.len() {
        let Some(path) = sky.file.as_ref().and_then(|files| files.get(channel)) else { continue };
        add(&path, map_notes(&path, &plan.sky_channel(channel), sky)?);
    }
    for (channel, path) in map.prior_files.iter().enumerate() {
        // A prior that cannot be read is an error where it is used.
        let options = map.prior_options(&spacecraft.channels_hz, channel);
        add(path, read_notes(path, &options).unwrap_or_default());
    }
    let catalogue = sky.added.as_ref().and_then(|added| added.catalogue.as_ref());
    for path in catalogue.into_iter().chain(&sky.points) {
        notes.extend(describe_catalogue(path).map_err(AddedSkyError::from)?.1);
    }
    notes.extend(plan.coarse_sky_note());
    Ok(notes)
}

/// Adds the space segment to `graph` and returns its output, the bytes of the downlink. `counts` is filled if samples are
/// simulated.
///
/// # Errors
/// An invalid model of the visibilities or configuration of the downlink.
pub fn add(
    graph: &mut Graph,
    plan: &Plan,
    skies: &[SkyMap],
    counts: &SampleCounts,
) -> Result<Link<Vec<u8>>, PipelineError> {
    if plan.config.spacecraft.fidelity == Fidelity::Samples {
        let frames = add_sample_stages(graph, plan, models::build_all(plan, skies)?, counts);
        return add_downlink(graph, plan, frames);
    }
    let skies: Vec<Option<&SkyMap>> = skies.iter().map(Some).collect();
    let frames = add_integration(graph, plan, &skies)?;
    add_downlink(graph, plan, frames)
}

/// Adds the stages that simulate visibilities of the channels that have a sky.
///
/// # Errors
/// An invalid model.
pub(in crate::pipeline) fn add_integration(
    graph: &mut Graph,
    plan: &Plan,
    skies: &[Option<&SkyMap>],
) -> Result<Link<GroundFrame>, PipelineError> {
    // A window itself is small; its visibilities are not.
    let windows = graph.source("observe", 1, Observer::new(plan.windows.clone()));
    Ok(graph.stage(INTEGRATE, plan.config.runtime.queue_capacity, windows, integrator(plan, skies)?))
}

/// The stage that simulates visibilities of the channels that have a sky.
///
/// # Errors
/// An invalid model.
pub(in crate::pipeline) fn integrator(
    plan: &Plan,
    skies: &[Option<&SkyMap>],
) -> Result<Integrator, PipelineError> {
    let Plan { config, array, instrument, schedules, .. } = plan;
    let models = models::build(plan, skies)?;
    let noise = NoiseModel {
        seed: config.spacecraft.thermal_noise.then_some(config.seed),
        receiver_noise_k_sr: config.spacecraft.receiver_k_sr(),
        response: plan.instrument.response,
    };
    let options = MeasurementOptions {
        noise,
        smear_integrations: config.spacecraft.smear_integrations,
        auto_integration_s: config.spacecraft.autos_s(),
        flag_earth: config.spacecraft.flag_earth,
    };
    let integrator =
        Integrator::new(Arc::clone(array), models, instrument.clone(), schedules.clone(), options);
    Ok(integrator.with_errors(plan.instrument_errors()).with_moving(plan.moving_sky()?))
}

/// Adds the stages from the frames of all channels to the bytes of the downlink.
///
/// # Errors
/// A sky that the ninth daughter cannot use; an invalid configuration of the downlink.
pub(in crate::pipeline) fn add_downlink(
    graph: &mut Graph,
    plan: &Plan,
    frames: Link<GroundFrame>,
) -> Result<Link<Vec<u8>>, PipelineError> {
    let frames = add_ninth(graph, plan, frames)?;
    add_transmitter(graph, plan, frames)
}

/// Adds the spectra of the ninth daughter to the frames, if it is on.
fn add_ninth(
    graph: &mut Graph,
    plan: &Plan,
    frames: Link<GroundFrame>,
) -> Result<Link<GroundFrame>, PipelineError> {
    let Plan { config, array, windows, .. } = plan;
    if !config.spacecraft.ninth.on {
        return Ok(frames);
    }
    let setup = NinthSetup {
        array: Arc::clone(array),
        config: config.spacecraft.ninth.clone(),
        sky: ninth_sky(plan)?,
        windows: windows.clone(),
        seed: config.spacecraft.thermal_noise.then_some(config.seed),
    };
    let capacity = config.runtime.queue_capacity;
    Ok(match Ninth::new(setup) {
        Some(ninth) => graph.stage("ninth", capacity, frames, ninth),
        None => frames,
    })
}

/// The sky of the ninth daughter: the generated sky at nodes of its band, or the map file of the highest channel,
/// extrapolated by a power law of frequency.
fn ninth_sky(plan: &Plan) -> Result<NinthSky, PipelineError> {
    let Plan { config, array, instrument, .. } = plan;
    let model = |sky: &SkyMap, frequency_hz| {
        DirectSum::new(sky, frequency_hz, array.moon_radius_m(), instrument.response)
    };
    let ninth = &config.spacecraft.ninth;
    let channels = (0..).map(ChannelId).zip(&config.spacecraft.channels_hz);
    let highest = channels.max_by(|a, b| a.1.total_cmp(b.1));
    if let (Some(_), Some((channel, &frequency_hz))) = (&config.sky.file, highest) {
        return Ok(NinthSky::PowerLaw {
            model: model(&sky(plan, channel)?, frequency_hz),
            frequency_hz,
            index: ninth.file_index,
        });
    }
    let map = |node_hz: f64| -> Result<(f64, DirectSum), PipelineError> {
        let values = generate(&config.sky.generated, node_hz, config.sky.nside, config.seed)?;
        Ok((node_hz, model(&SkyMap::new(Frame::Ecliptic, values)?, node_hz)))
    };
    Ok(NinthSky::Maps(NinthSky::nodes_hz(ninth.band_hz).into_iter().map(map).collect::<Result<_, _>>()?))
}

fn add_transmitter(
    graph: &mut Graph,
    plan: &Plan,
    frames: Link<GroundFrame>,
) -> Result<Link<Vec<u8>>, PipelineError> {
    let config = &plan.config;
    let capacity = config.runtime.queue_capacity;
    let passes = graph.stage("store", capacity, frames, store(plan));
    Ok(graph.stage("transmit", capacity, passes, Transmitter::new(&config.downlink)?))
}

/// The onboard store.
pub(in crate::pipeline) fn store(plan: &Plan) -> Store {
    let config = &plan.config;
    let paced = |bytes_per_s| PacedLink { array: Arc::clone(&plan.array), bytes_per_s };
    Store::new(&config.spacecraft, config.downlink.payload_bytes_per_s().map(paced))
}
