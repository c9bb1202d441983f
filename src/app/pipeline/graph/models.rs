//! The visibility model of each channel.

use std::borrow::Cow;
use std::collections::HashMap;
use std::f64::consts::PI;
use std::sync::Arc;

use crate::daughters::OrbitAntennas;
use crate::frames::AntennaResponse;
use crate::mother::{ChannelModel, MoonMirror, Schedule};
use crate::pipeline::config::{PipelineError, Plan};
use crate::response::harmonic::{GeometryLimits, RotationTable};
use crate::response::model::{
    AntennaPatterns, AntennaSum, BandAverage, DirectSum, GeneralSum, HarmonicSum, HarmonicSumSetup,
    ModelKind, ModelPlan, TimeAverage, VisibilityModel, WithEmission, WithFlatReflection,
    WithSphereReflection, WithinBaselines,
};
use crate::sky::harmonics::{Alm, AnalysisOptions, Method, analysis};
use crate::sky::{Frame, MapError, SkyConfig, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// The model of each channel that has a sky.
///
/// # Errors
/// A sky whose coefficients cannot be computed; an invalid model.
pub(crate) fn build(plan: &Plan, skies: &[Option<&SkyMap>]) -> Result<Vec<ChannelModel>, PipelineError> {
    let nside = |(sky, default): (&Option<&SkyMap>, usize)| sky.map_or(default, SkyMap::nside);
    let nsides: Vec<usize> = skies.iter().zip(plan.sky_nsides()).map(nside).collect();
    nsides.iter().try_for_each(|&nside| SkyConfig::check_l_max(plan.config.sky.l_max, nside))?;
    let (mut rotations, antennas) = (HashMap::new(), plan.antenna_errors()?);
    let mut models = Vec::new();
    for ((choice, sky), schedule) in plan.model_plans(&nsides).iter().zip(skies).zip(&plan.schedules) {
        let antennas = antennas
            .as_ref()
            .map(|antennas| Arc::new(antennas.at(schedule.frequency_hz)) as Arc<dyn AntennaPatterns>);
        let model = sky.map(|sky| -> Result<Box<dyn VisibilityModel>, PipelineError> {
            let model = channel_model((plan, antennas.as_ref()), choice, sky, schedule, &mut rotations)?;
            let reach = plan.config.sky.reach_wavelengths(sky.nside());
            Ok(match reach {
                Some(reach) => Box::new(WithinBaselines::new(model, schedule.frequency_hz, reach)),
                None => model,
            })
        });
        models.push(ChannelModel { batch: choice.kind.batch(), model: model.transpose()? });
    }
    Ok(models)
}

/// The models of all channels.
///
/// # Errors
/// As [`build`].
pub(crate) fn build_all(
    plan: &Plan,
    skies: &[SkyMap],
) -> Result<Vec<Box<dyn VisibilityModel>>, PipelineError> {
    let skies: Vec<Option<&SkyMap>> = skies.iter().map(Some).collect();
    Ok(build(plan, &skies)?.into_iter().filter_map(|channel| channel.model).collect())
}

/// The model of a channel. `antennas` are patterns with errors, `None` if they are ideal; `rotations` holds tables that channels
/// share.
fn channel_model(
    (plan, antennas): (&Plan, Option<&Arc<dyn AntennaPatterns>>),
    choice: &ModelPlan,
    sky: &SkyMap,
    schedule: &Schedule,
    rotations: &mut HashMap<usize, Arc<RotationTable<f32>>>,
) -> Result<Box<dyn VisibilityModel>, PipelineError> {
    let array = &plan.array;
    let (frequency_hz, response) = (schedule.frequency_hz, plan.instrument.response);
    if choice.kind == ModelKind::Direct {
        // On a common circular orbit all dipoles are normal to one plane, which the model assumes.
        let dipoles = orbit_dipoles(plan).filter(|_| array.formation().is_none());
        let antennas = antennas.or(dipoles.as_ref());
        let direct = |moon_m, offset_k| -> Result<Box<dyn VisibilityModel>, PipelineError> {
            let sky = minus_temperature(sky, offset_k)?;
            let sum = DirectSum::new(&sky, frequency_hz, moon_m, response);
            Ok(match antennas {
                Some(antennas) => Box::new(AntennaSum::new(sum, Arc::clone(antennas))),
                None => Box::new(sum),
            })
        };
        // A map of HEALPix pixels determines l up to twice nside.
        let model = with_moon(plan, direct, sky, frequency_hz)?;
        let model = averaged_over_channel(plan, model, frequency_hz);
        return Ok(averaged_over_integrations(plan, model, frequency_hz, 2 * sky.nside()));
    }
    let alm = coefficients(sky, choice.l_max)?;
    if choice.kind == ModelKind::General {
        let dipoles = orbit_dipoles(plan);
        let antennas = antennas.or(dipoles.as_ref());
        let general = |moon_m, offset_k| -> Result<Box<dyn VisibilityModel>, PipelineError> {
            let (sky, alm) = (minus_temperature(sky, offset_k)?, alm_minus_temperature(&alm, offset_k));
            let antennas = antennas.map(Arc::clone);
            Ok(Box::new(GeneralSum::new(&sky, alm, frequency_hz, moon_m, antennas)?))
        };
        let model = with_moon(plan, general, sky, frequency_hz)?;
        let model = averaged_over_channel(plan, model, frequency_hz);
        return Ok(averaged_over_integrations(plan, model, frequency_hz, choice.l_max));
    }
    let setup = |moon_radius_m| HarmonicSumSetup {
        frequency_hz,
        orbit_radius_m: array.orbit_radius_m(),
        inclination_rad: array.inclination_rad(),
        moon_radius_m,
        baseline_wavelengths_max: choice.baseline_wavelengths_max,
        response,
        limits: GeometryLimits::default(),
    };
    let table = || Arc::new(RotationTable::new(choice.l_max, array.inclination_rad()));
    let rotation = Arc::clone(rotations.entry(choice.l_max).or_insert_with(table));
    let harmonic = |moon_m, offset_k| -> Result<Box<dyn VisibilityModel>, PipelineError> {
        let alm = alm_minus_temperature(&alm, offset_k);
        Ok(Box::new(HarmonicSum::new(alm, setup(moon_m), Arc::clone(&rotation))?))
    };
    Ok(averaged_over_channel(plan, with_moon(plan, harmonic, sky, frequency_hz)?, frequency_hz))
}

/// Dipoles oriented by each daughter's own orbit; `None` for isotropic antennas.
fn orbit_dipoles(plan: &Plan) -> Option<Arc<dyn AntennaPatterns>> {
    match plan.instrument.response {
        AntennaResponse::Isotropic => None,
        response => Some(Arc::new(OrbitAntennas::new(Arc::clone(&plan.array), response))),
    }
}

fn minus_temperature(sky: &SkyMap, offset_k: f64) -> Result<Cow<'_, SkyMap>, MapError> {
    if offset_k == 0.0 {
        return Ok(Cow::Borrowed(sky));
    }
    let values_k = sky.values().iter().map(|value| value - offset_k).collect();
    Ok(Cow::Owned(SkyMap::new(sky.frame(), values_k)?))
}

/// Subtracts a uniform temperature from harmonic coefficients: 1 K is sqrt(4 pi) in `a_00`.
fn alm_minus_temperature(alm: &Alm, offset_k: f64) -> Alm {
    let mut alm = alm.clone();
    alm.get_mut(0, 0).re -= offset_k * (4.0 * PI).sqrt();
    alm
}

/// Builds the model of the sky `map`, with the Moon's emission and its reflection of the sky if they are configured.
///
/// `build` makes the model for a radius of the Moon, m, and the map minus a uniform temperature, K.
fn with_moon(
    plan: &Plan,
    build: impl Fn(f64, f64) -> Result<Box<dyn VisibilityModel>, PipelineError>,
    map: &SkyMap,
    frequency_hz: f64,
) -> Result<Box<dyn VisibilityModel>, PipelineError> {
    let moon_k = plan.config.spacecraft.moon_temperature_k;
    let mut sky = build(plan.array.moon_radius_m(), moon_k)?;
    if moon_k > 0.0 {
        sky = Box::new(WithEmission::new(sky, frequency_hz, plan.instrument.response, moon_k));
    }
    let reflectivity = plan.config.spacecraft.moon_reflection;
    if reflectivity == 0.0 {
        return Ok(sky);
    }
    if plan.config.spacecraft.moon_mirror == MoonMirror::Sphere {
        let (radius_m, response) = (plan.array.moon_radius_m(), plan.instrument.response);
        let map = map.clone();
        return Ok(Box::new(WithSphereReflection::new(
            sky,
            map,
            frequency_hz,
            response,
            radius_m,
            reflectivity,
        )));
    }
    // A Moon just below the orbit hides everything below the local horizontal, to 5e-5 rad.
    let above_horizontal = build(plan.array.orbit_radius_m() * (1.0 - 1e-9), 0.0)?;
    Ok(Box::new(WithFlatReflection::new(sky, above_horizontal, reflectivity)))
}

/// The model, averaged over the channel's bandwidth if the configuration asks for it.
fn averaged_over_channel(
    plan: &Plan,
    model: Box<dyn VisibilityModel>,
    frequency_hz: f64,
) -> Box<dyn VisibilityModel> {
    let spacecraft = &plan.config.spacecraft;
    match spacecraft.smear_bandwidth {
        true => Box::new(BandAverage::new(model, frequency_hz, spacecraft.channel_width_hz)),
        false => model,
    }
}

/// A model of instantaneous visibilities, averaged over the integrations if the configuration asks for it.
fn averaged_over_integrations(
    plan: &Plan,
    model: Box<dyn VisibilityModel>,
    frequency_hz: f64,
    l_max: usize,
) -> Box<dyn VisibilityModel> {
    match plan.config.spacecraft.smear_integrations {
        true => {
            let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
            Box::new(TimeAverage::new(model, Arc::clone(&plan.array), wavelength_m, l_max))
        }
        false => model,
    }
}

/// Harmonic coefficients of a map in ecliptic coordinates, up to `l_max`.
///
/// # Errors
/// An `l_max` above what the map determines; a map with values that are not finite.
fn coefficients(sky: &SkyMap, l_max: usize) -> Result<Alm, PipelineError> {
    SkyConfig::check_l_max(l_max, sky.nside())?;
    let options = AnalysisOptions { method: Method::ACCURATE };
    let alm = analysis(sky.values(), l_max, &options)?.alm;
    Ok(match sky.frame() {
        Frame::Ecliptic => alm,
        frame => alm.rotated(&frame.to_ecliptic()),
    })
}
