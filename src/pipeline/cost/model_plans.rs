//! The choice of the visibility model of each channel, by cost.

use rayon::prelude::*;

use crate::array::Array;
use crate::calibration::CalibrationHook;
use crate::calibration::solver::{CalibrationMode, known_wavelengths_max};
use crate::frames::ObservingWindow;
use crate::mother::{Fidelity, Schedule};
use crate::pipeline::config::{Expected, Plan};
use crate::response::model::{BandAverage, ModelChoice, ModelPlan, Workload, l_max_of_fringes};
use crate::sky::fits::{read_nside, sky_options};
use crate::sky::healpix::pixel_count;
use crate::sky::{GENERATED_NSIDE_MAX, SkyConfig};
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
    pub(in crate::pipeline) fn model_plans_for(
        &self,
        expected: &[Expected],
        nsides: &[usize],
    ) -> Vec<ModelPlan> {
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
                    let frequencies = BandAverage::frequency_count(longest_m, width_hz);
                    (frequencies, BandAverage::baseline_factor(schedule.frequency_hz, width_hz))
                }
                false => (1, 1.0),
            };
            let load = Workload {
                visibilities: expected.sent * frequencies as f64,
                sky_nside,
                baseline_wavelengths_max: longest * stretch,
                l_max: self.config.sky.l_max,
                is_time_averaged: spacecraft.smear_integrations,
                is_on_circle: self.array.formation().is_some(),
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
    pub(in crate::pipeline) fn coarse_sky_note(&self) -> Option<String> {
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
                (name, l_max_of_fringes(longest), nside)
            })
            .filter(|&(_, seen, nside)| seen > SkyConfig::l_max_determined(nside))
            .collect();
        let (_, seen, nside) = coarse.iter().max_by_key(|(_, seen, _)| *seen)?;
        let (held, most) =
            (SkyConfig::l_max_determined(*nside), SkyConfig::l_max_determined(GENERATED_NSIDE_MAX));
        let names: Vec<&str> = coarse.iter().map(|(name, ..)| name.as_str()).take(4).collect();
        let more = if coarse.len() > names.len() { ", .." } else { "" };
        let needed = (0..)
            .map(|k| 1 << k)
            .find(|&nside| SkyConfig::l_max_determined(nside) >= *seen)
            .unwrap_or(nside * 2);
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
    pub(in crate::pipeline) fn known_sky_bytes(&self) -> f64 {
        let solver = &self.config.calibrate;
        if self.config.calibration.hook != CalibrationHook::Solve || solver.mode == CalibrationMode::Beacon {
            return 0.0;
        }
        let bytes = |nside: usize| {
            let map = DIRECTION_BYTES * pixel_count(nside.max(solver.model_nside)) as f64;
            let load = Workload {
                visibilities: 0.0,
                sky_nside: nside,
                baseline_wavelengths_max: known_wavelengths_max(nside),
                l_max: 5 * nside / 2,
                is_time_averaged: false,
                is_on_circle: true,
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
