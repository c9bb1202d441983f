//! The visibility model of each channel.

use std::borrow::Cow;
use std::collections::HashMap;
use std::f64::consts::PI;
use std::sync::Arc;

use rayon::prelude::*;

use super::error::PipelineError;
use super::plan::{Expected, Plan};
use crate::array::Array;
use crate::calibration::CalibrationHook;
use crate::calibration::solver::{CalibrationMode, known_wavelengths_max};
use crate::daughters::OrbitAntennas;
use crate::frames::{AntennaResponse, ObservingWindow};
use crate::mother::{ChannelModel, Fidelity, MoonMirror, Schedule};
use crate::response::harmonic::{GeometryLimits, RotationTable};
use crate::response::model::{
    AntennaPatterns, AntennaSum, BandAverage, DirectSum, Emitting, GeneralSum, HarmonicSum, HarmonicSumSetup,
    Load, ModelChoice, ModelKind, ModelPlan, Reflected, SphereMirrored, TimeAverage, VisibilityModel,
    degrees_seen,
};
use crate::sky::fits::{read_nside, sky_options};
use crate::sky::harmonics::{Alm, AnalysisOptions, Method, analysis};
use crate::sky::healpix::pixel_count;
use crate::sky::{Frame, GENERATED_NSIDE_MAX, MapError, SkyConfig, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, norm, sub};
use crate::units::{Pair, all_pairs};

impl Plan {
    /// The choice of model for each channel, with skies of these nsides, channel by channel.
    #[must_use]
    #[doc(hidden)]
    pub fn model_plans(&self, nsides: &[usize]) -> Vec<ModelPlan> {
        self.model_plans_for(&self.visibilities(), nsides)
    }

    /// As [`Self::model_plans`], for the visibilities of [`Self::visibilities`].
    pub(super) fn model_plans_for(&self, expected: &[Expected], nsides: &[usize]) -> Vec<ModelPlan> {
        let spacecraft = &self.config.spacecraft;
        let apart_m = match self.array.formation() {
            Some(_) => 0.0,
            None => farthest_apart_m(&self.array, &self.windows),
        };
        let plan = |((schedule, expected), &sky_nside): ((&Schedule, &Expected), &usize)| {
            let longest = longest_baseline_wavelengths(&self.array, apart_m, schedule);
            let (frequencies, stretch) = match spacecraft.smear_bandwidth {
                true => {
                    let width_hz = spacecraft.channel_width_hz;
                    let longest_m = longest * SPEED_OF_LIGHT_M_S / schedule.frequency_hz;
                    let frequencies = BandAverage::frequencies(longest_m, width_hz);
                    (frequencies, BandAverage::baseline_factor(schedule.frequency_hz, width_hz))
                }
                false => (1, 1.0),
            };
            let load = Load {
                visibilities: expected.sent * frequencies as f64,
                sky_nside,
                baseline_wavelengths_max: longest * stretch,
                l_max: self.config.sky.l_max,
                smeared: spacecraft.smear_integrations,
                circle: self.array.formation().is_some(),
            };
            if spacecraft.fidelity == Fidelity::Samples {
                // The sampler needs auto-correlations and pairs stretched over the channel; the others are made for neither.
                let direct = ModelPlan::new(ModelChoice::Direct, load);
                return ModelPlan { why: "samples take direct sums", ..direct };
            }
            ModelPlan::new(spacecraft.model, load)
        };
        self.schedules.iter().zip(expected).zip(nsides).map(plan).collect()
    }
}

impl Plan {
    /// nside of each channel's simulated sky; a map file that cannot be read counts as a generated sky.
    #[must_use]
    #[doc(hidden)]
    pub fn sky_nsides(&self) -> Vec<usize> {
        let sky = &self.config.sky;
        let nside = |channel: usize| {
            let path = sky.file.as_ref().and_then(|files| files.get(channel));
            let options = sky_options(sky, self.schedules[channel].frequency_hz);
            let of_map = path.and_then(|path| read_nside(&path, &options).ok());
            let least = if sky.added.is_some() { sky.nside } else { 1 };
            of_map.map_or(sky.nside, |nside| nside.max(least))
        };
        (0..self.schedules.len()).map(nside).collect()
    }

    /// Channels whose baselines see finer scales than the sky's pixels hold, if there are any: direct sums take pixels for points,
    /// harmonics leave out what is finer, and neither is the sky.
    #[must_use]
    pub(super) fn coarse_sky_note(&self) -> Option<String> {
        let apart_m = match self.array.formation() {
            Some(_) => 0.0,
            None => farthest_apart_m(&self.array, &self.windows),
        };
        let coarse: Vec<(String, usize, usize)> = self
            .schedules
            .iter()
            .zip(self.sky_nsides())
            .map(|(schedule, nside)| {
                let longest = longest_baseline_wavelengths(&self.array, apart_m, schedule);
                let name = format!("{:.3} MHz ({longest:.1} wavelengths)", schedule.frequency_hz / 1e6);
                (name, degrees_seen(longest), nside)
            })
            .filter(|&(_, seen, nside)| seen > SkyConfig::l_max_held(nside))
            .collect();
        let (_, seen, nside) = coarse.iter().max_by_key(|(_, seen, _)| *seen)?;
        let (held, most) = (SkyConfig::l_max_held(*nside), SkyConfig::l_max_held(GENERATED_NSIDE_MAX));
        let names: Vec<&str> = coarse.iter().map(|(name, ..)| name.as_str()).take(4).collect();
        let more = if coarse.len() > names.len() { ", .." } else { "" };
        let needed =
            (0..).map(|k| 1 << k).find(|&nside| SkyConfig::l_max_held(nside) >= *seen).unwrap_or(nside * 2);
        let mend = match *seen <= most {
            true => format!("a sky of nside {needed} (sky.nside, or a finer map) or shorter baselines"),
            false => "shorter baselines".to_owned(),
        };
        Some(format!(
            "the sky is too coarse for the longest baselines of {}{more}: they see degrees up to l = {seen}, its pixels (nside {nside}) \
             hold l up to {held}. Beyond, direct sums take the pixels for points and harmonics leave out what is finer: the two may \
             differ by tens of per cent. Expected {mend} (spacecraft.baseline_wavelengths_max)",
            names.join(", ")
        ))
    }

    /// Memory of the known sky from whose visibilities gains are found while the data arrive, bytes; what cannot be read counts nothing.
    pub(super) fn known_sky_bytes(&self) -> f64 {
        let solver = &self.config.calibrate;
        if self.config.calibration.hook != CalibrationHook::Solve || solver.mode == CalibrationMode::Beacon {
            return 0.0;
        }
        let bytes = |nside: usize| {
            let map = DIRECTION_BYTES * pixel_count(nside.max(solver.model_nside)) as f64;
            let load = Load {
                visibilities: 0.0,
                sky_nside: nside,
                baseline_wavelengths_max: known_wavelengths_max(nside),
                l_max: 5 * nside / 2,
                smeared: false,
                circle: true,
            };
            map + if solver.is_harmonic(nside) {
                ModelPlan::new(ModelChoice::Harmonic, load).bytes
            } else {
                0.0
            }
        };
        solver.models().unwrap_or_default().iter().map(|map| bytes(map.nside())).sum()
    }
}

/// Memory of a pixel of a direct sum, bytes: its direction, and its value twice.
const DIRECTION_BYTES: f64 = 40.0;

/// The longest baseline of a schedule, wavelengths. The limit holds at the start of an integration; until its middle a
/// baseline moves by less than the rule allows. Without a formation satellites are `apart_m` apart at most.
fn longest_baseline_wavelengths(array: &Array, apart_m: f64, schedule: &Schedule) -> f64 {
    let Some(formation) = array.formation() else {
        let limit = schedule.baseline_wavelengths_max;
        let most = apart_m * schedule.frequency_hz / SPEED_OF_LIGHT_M_S;
        return if limit > 0.0 { most.min(limit + schedule.rule.motion_wavelengths_max) } else { most };
    };
    // Arcs are greatest at the start of a period.
    let arcs = (0..array.satellites()).map(|n| formation.arc_m(n, 0.0).0);
    let arc_m = arcs.fold(0.0, f64::max);
    let radius_m = array.orbit_radius_m();
    let chord_m = 2.0 * radius_m * (0.5 * arc_m / radius_m).min(std::f64::consts::FRAC_PI_2).sin();
    let longest = chord_m * schedule.frequency_hz / SPEED_OF_LIGHT_M_S * (1.0 + 1e-9);
    match schedule.baseline_wavelengths_max {
        0.0 => longest,
        limit => longest.min(limit + schedule.rule.motion_wavelengths_max),
    }
}

/// Windows in which distances are looked at, at most, and instants of each.
const WINDOWS_MAX: usize = 500;
const INSTANTS: usize = 5;

/// About the greatest distance of two satellites while they observe, m: a tenth more than at some instants, and at most that of
/// opposite sides.
fn farthest_apart_m(array: &Array, windows: &[ObservingWindow]) -> f64 {
    let step = windows.len().div_ceil(WINDOWS_MAX).max(1);
    let chosen: Vec<&ObservingWindow> = windows.iter().step_by(step).collect();
    let pairs = all_pairs(array.satellites());
    let in_window = |window: &&ObservingWindow| {
        let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
        let at = |k: usize| start_s + (end_s - start_s) * k as f64 / (INSTANTS - 1) as f64;
        let distance = |t_s: f64| {
            let places: Vec<Vec3> = (0..array.satellites()).map(|n| array.position_m(n, t_s)).collect();
            let apart = |pair: &Pair| norm(sub(places[usize::from(pair.i)], places[usize::from(pair.j)]));
            pairs.iter().map(apart).fold(0.0, f64::max)
        };
        (0..INSTANTS).map(at).map(distance).fold(0.0, f64::max)
    };
    let found = chosen.par_iter().map(in_window).reduce(|| 0.0, f64::max);
    (1.1 * found).min(2.0 * array.farthest_m())
}

/// The model of each channel that has a sky.
///
/// # Errors
/// A sky whose coefficients cannot be computed; an invalid model.
pub(crate) fn build(plan: &Plan, skies: &[Option<&SkyMap>]) -> Result<Vec<ChannelModel>, PipelineError> {
    let nside = |(sky, usual): (&Option<&SkyMap>, usize)| sky.map_or(usual, SkyMap::nside);
    let nsides: Vec<usize> = skies.iter().zip(plan.sky_nsides()).map(nside).collect();
    nsides.iter().try_for_each(|&nside| SkyConfig::check_l_max(plan.config.sky.l_max, nside))?;
    let (mut rotations, antennas) = (HashMap::new(), plan.antenna_errors());
    let mut models = Vec::new();
    for ((choice, sky), schedule) in plan.model_plans(&nsides).iter().zip(skies).zip(&plan.schedules) {
        let own = antennas.as_ref().map(|antennas| Arc::new(antennas.at(schedule.frequency_hz)));
        let antennas = own.map(|own| own as Arc<dyn AntennaPatterns>);
        let made =
            sky.map(|sky| channel_model((plan, antennas.as_ref()), choice, sky, schedule, &mut rotations));
        models.push(ChannelModel { batch: choice.kind.batch(), model: made.transpose()? });
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

/// The model of a channel, with antennas that are not ideal; `rotations` holds the tables that channels share.
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
        // On a common circle all dipoles are normal to one plane, and to that of each pair.
        let own = own_dipoles(plan).filter(|_| array.formation().is_none());
        let antennas = antennas.or(own.as_ref());
        let direct = |moon_m, less_k| -> Result<Box<dyn VisibilityModel>, PipelineError> {
            let sky = less(sky, less_k)?;
            let sum = DirectSum::new(&sky, frequency_hz, moon_m, response);
            Ok(match antennas {
                Some(antennas) => Box::new(AntennaSum::new(sum, Arc::clone(antennas))),
                None => Box::new(sum),
            })
        };
        // Pixels hold twice nside degrees.
        let model = with_moon(plan, direct, sky, frequency_hz)?;
        return Ok(in_time(plan, averaged(plan, model, frequency_hz), frequency_hz, 2 * sky.nside()));
    }
    let alm = coefficients(sky, choice.l_max)?;
    if choice.kind == ModelKind::General {
        let own = own_dipoles(plan);
        let antennas = antennas.or(own.as_ref());
        let general = |moon_m, less_k| -> Result<Box<dyn VisibilityModel>, PipelineError> {
            let (sky, alm) = (less(sky, less_k)?, less_alm(&alm, less_k));
            let antennas = antennas.map(Arc::clone);
            Ok(Box::new(GeneralSum::new(&sky, alm, frequency_hz, moon_m, antennas)?))
        };
        let model = with_moon(plan, general, sky, frequency_hz)?;
        return Ok(in_time(plan, averaged(plan, model, frequency_hz), frequency_hz, choice.l_max));
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
    let harmonic = |moon_m, less_k| -> Result<Box<dyn VisibilityModel>, PipelineError> {
        Ok(Box::new(HarmonicSum::new(less_alm(&alm, less_k), setup(moon_m), Arc::clone(&rotation))?))
    };
    Ok(averaged(plan, with_moon(plan, harmonic, sky, frequency_hz)?, frequency_hz))
}

/// Dipoles along the normals of the daughters' own orbits, if they have dipoles, and along their tracks, if they have three.
fn own_dipoles(plan: &Plan) -> Option<Arc<dyn AntennaPatterns>> {
    let elements = plan.instrument.response;
    let own = || Arc::new(OrbitAntennas::new(Arc::clone(&plan.array), elements));
    (elements != AntennaResponse::Isotropic).then(|| own() as Arc<dyn AntennaPatterns>)
}

/// The sky less a temperature in all directions.
fn less(sky: &SkyMap, less_k: f64) -> Result<Cow<'_, SkyMap>, MapError> {
    if less_k == 0.0 {
        return Ok(Cow::Borrowed(sky));
    }
    let values_k = sky.values().iter().map(|value| value - less_k).collect();
    Ok(Cow::Owned(SkyMap::new(sky.frame(), values_k)?))
}

/// As [`less`], of its coefficients: 1 K in all directions is sqrt(4 pi) of l = 0.
fn less_alm(alm: &Alm, less_k: f64) -> Alm {
    let mut alm = alm.clone();
    alm.get_mut(0, 0).re -= less_k * (4.0 * PI).sqrt();
    alm
}

/// The model that `of` makes for a radius of the Moon, m, and of the sky's `map` less a temperature, K; with the Moon's emission and
/// the image of the sky if the configuration asks for them.
fn with_moon(
    plan: &Plan,
    of: impl Fn(f64, f64) -> Result<Box<dyn VisibilityModel>, PipelineError>,
    map: &SkyMap,
    frequency_hz: f64,
) -> Result<Box<dyn VisibilityModel>, PipelineError> {
    let moon_k = plan.config.spacecraft.moon_temperature_k;
    let mut sky = of(plan.array.moon_radius_m(), moon_k)?;
    if moon_k > 0.0 {
        sky = Box::new(Emitting::new(sky, frequency_hz, plan.instrument.response, moon_k));
    }
    let share = plan.config.spacecraft.moon_reflection;
    if share == 0.0 {
        return Ok(sky);
    }
    if plan.config.spacecraft.moon_mirror == MoonMirror::Sphere {
        let mirror = (plan.array.moon_radius_m(), share);
        let response = plan.instrument.response;
        return Ok(Box::new(SphereMirrored::new(sky, map.clone(), frequency_hz, response, mirror)));
    }
    // A Moon that all but touches the orbit hides what is below the horizontal: to 5e-5 rad.
    let above = of(plan.array.orbit_radius_m() * (1.0 - 1e-9), 0.0)?;
    Ok(Box::new(Reflected::new(sky, above, share)))
}

/// The model, averaged over its channel if the configuration asks for it.
fn averaged(plan: &Plan, model: Box<dyn VisibilityModel>, frequency_hz: f64) -> Box<dyn VisibilityModel> {
    let spacecraft = &plan.config.spacecraft;
    match spacecraft.smear_bandwidth {
        true => Box::new(BandAverage::new(model, frequency_hz, spacecraft.channel_width_hz)),
        false => model,
    }
}

/// A model of instants, averaged over its integrations if the configuration asks for it.
fn in_time(
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

/// Coefficients of a map in any frame on ecliptic axes, up to `l_max`.
///
/// # Errors
/// More degrees than the map determines; a map with values that are not finite.
fn coefficients(sky: &SkyMap, l_max: usize) -> Result<Alm, PipelineError> {
    SkyConfig::check_l_max(l_max, sky.nside())?;
    let options = AnalysisOptions { method: Method::ACCURATE };
    let alm = analysis(sky.values(), l_max, &options)?.alm;
    Ok(match sky.frame() {
        Frame::Ecliptic => alm,
        frame => alm.rotated(&frame.to_ecliptic()),
    })
}
