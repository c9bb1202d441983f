//! The visibility model of each channel.

use std::collections::HashMap;
use std::sync::Arc;

use super::error::PipelineError;
use super::plan::{Expected, Plan};
use crate::array::Array;
use crate::mother::{Fidelity, Schedule};
use crate::response::harmonic::RotationTable;
use crate::response::model::{
    BandAverage, DirectSum, HarmonicSum, HarmonicSumSetup, Load, ModelChoice, ModelKind, ModelPlan,
    Reflected, VisibilityModel,
};
use crate::sky::fits::{ReadOptions, read_whole_map};
use crate::sky::harmonics::{Alm, AnalysisOptions, Method, analysis};
use crate::sky::{Frame, SkyConfig, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

impl Plan {
    /// The choice of model for each channel, with skies of these nsides, channel by channel.
    #[must_use]
    pub fn model_plans(&self, nsides: &[usize]) -> Vec<ModelPlan> {
        self.model_plans_for(&self.visibilities(), nsides)
    }

    /// As [`Self::model_plans`], for the visibilities of [`Self::visibilities`].
    pub(super) fn model_plans_for(&self, expected: &[Expected], nsides: &[usize]) -> Vec<ModelPlan> {
        let spacecraft = &self.config.spacecraft;
        let plan = |((schedule, expected), &sky_nside): ((&Schedule, &Expected), &usize)| {
            let longest = longest_baseline_wavelengths(&self.array, schedule);
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
            };
            if spacecraft.fidelity == Fidelity::Samples {
                // The sampler needs auto-correlations and pairs stretched over the channel; the harmonic model is made for
                // neither.
                let direct = ModelPlan::new(ModelChoice::Direct, load);
                return ModelPlan { why: "samples take direct sums", ..direct };
            }
            if self.array.formation().is_none() {
                let direct = ModelPlan::new(ModelChoice::Direct, load);
                return ModelPlan { why: "harmonics need a common circle", ..direct };
            }
            ModelPlan::new(spacecraft.model, load)
        };
        self.schedules.iter().zip(expected).zip(nsides).map(plan).collect()
    }
}

impl Plan {
    /// nside of each channel's simulated sky; a map file that cannot be read counts as a generated sky.
    #[must_use]
    pub fn sky_nsides(&self) -> Vec<usize> {
        let sky = &self.config.sky;
        let options = ReadOptions { frame_if_missing: sky.frame, ..ReadOptions::default() };
        let nside = |channel: usize| {
            let path = sky.file.as_ref().and_then(|files| files.get(channel));
            let map = path.and_then(|path| read_whole_map(&path, &options).ok());
            map.map_or(sky.nside, |map| map.nside())
        };
        (0..self.schedules.len()).map(nside).collect()
    }
}

/// The longest baseline of a schedule, wavelengths. The limit holds at the start of an integration; until its middle a
/// baseline moves by less than the rule allows.
fn longest_baseline_wavelengths(array: &Array, schedule: &Schedule) -> f64 {
    let Some(formation) = array.formation() else {
        // No two satellites are further apart than on opposite sides; what counts is in the schedule.
        let limit = schedule.baseline_wavelengths_max;
        let most = 2.0 * array.farthest_m() * schedule.frequency_hz / SPEED_OF_LIGHT_M_S;
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

/// The model of each channel.
///
/// # Errors
/// A sky whose coefficients cannot be computed; an invalid model.
pub(crate) fn build(plan: &Plan, skies: &[SkyMap]) -> Result<Vec<Box<dyn VisibilityModel>>, PipelineError> {
    let nsides: Vec<usize> = skies.iter().map(SkyMap::nside).collect();
    let array = &plan.array;
    let mut rotations: HashMap<usize, Arc<RotationTable<f32>>> = HashMap::new();
    let mut models: Vec<Box<dyn VisibilityModel>> = Vec::new();
    for ((model, sky), schedule) in plan.model_plans(&nsides).iter().zip(skies).zip(&plan.schedules) {
        let (frequency_hz, response) = (schedule.frequency_hz, plan.instrument.response);
        if model.kind == ModelKind::Direct {
            let direct = |moon_m| -> Result<Box<dyn VisibilityModel>, PipelineError> {
                Ok(Box::new(DirectSum::new(sky, frequency_hz, moon_m, response)))
            };
            models.push(averaged(plan, reflected(plan, direct)?, frequency_hz));
            continue;
        }
        let alm = coefficients(sky, model.l_max)?;
        let setup = |moon_radius_m| HarmonicSumSetup {
            frequency_hz,
            orbit_radius_m: array.orbit_radius_m(),
            inclination_rad: array.inclination_rad(),
            moon_radius_m,
            baseline_wavelengths_max: model.baseline_wavelengths_max,
            response,
        };
        let table = || Arc::new(RotationTable::new(model.l_max, array.inclination_rad()));
        let rotation = Arc::clone(rotations.entry(model.l_max).or_insert_with(table));
        let harmonic = |moon_m| -> Result<Box<dyn VisibilityModel>, PipelineError> {
            Ok(Box::new(HarmonicSum::new(alm.clone(), setup(moon_m), Arc::clone(&rotation))?))
        };
        models.push(averaged(plan, reflected(plan, harmonic)?, frequency_hz));
    }
    Ok(models)
}

/// The model that `of` makes for a radius of the Moon, m, with the image of the sky if the configuration asks for it.
fn reflected(
    plan: &Plan,
    of: impl Fn(f64) -> Result<Box<dyn VisibilityModel>, PipelineError>,
) -> Result<Box<dyn VisibilityModel>, PipelineError> {
    let sky = of(plan.array.moon_radius_m())?;
    let share = plan.config.spacecraft.moon_reflection;
    if share == 0.0 {
        return Ok(sky);
    }
    // A Moon that all but touches the orbit hides what is below the horizontal: to 5e-5 rad.
    let above = of(plan.array.orbit_radius_m() * (1.0 - 1e-9))?;
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
