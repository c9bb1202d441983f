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
    /// Chooses the model of each channel; `nsides` are those of the channels' skies.
    #[must_use]
    #[doc(hidden)]
    pub fn model_plans(&self, nsides: &[usize]) -> Vec<ModelPlan> {
        self.model_plans_for(&self.visibilities(), nsides)
    }

    /// Chooses the model of each channel for given numbers of visibilities.
    pub(in crate::pipeline) fn model_plans_for(
        &self,
        expected: &[Expected],
        nsides: &[usize],
    ) -> Vec<ModelPlan> {
        let spacecraft = &self.config.spacecraft;
        let distance_m_max = self.distance_m_max();
        let plan = |((schedule, expected), &sky_nside): ((&Schedule, &Expected), &usize)| {
            let longest = longest_baseline_wavelengths(&self.array, distance_m_max, schedule);
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
                baseline_wavelengths_max: self
                    .config
                    .sky
                    .reach_wavelengths(sky_nside)
                    .unwrap_or(longest)
                    .min(longest)
                    * stretch,
                l_max: self.config.sky.l_max,
                is_time_averaged: spacecraft.smear_integrations,
                is_on_circle: self.array.formation().is_some(),
                has_points: self.config.sky.points.is_some(),
            };
            if spacecraft.fidelity == Fidelity::Samples {
                // The sampler needs auto-correlations and baselines scaled over the channel, which only direct sums provide.
                let direct = ModelPlan::new(ModelChoice::Direct, load);
                return ModelPlan { why: "samples take direct sums", ..direct };
            }
            ModelPlan::new(spacecraft.model, load)
        };
        self.schedules.iter().zip(expected).zip(nsides).map(plan).collect()
    }

    /// Greatest distance of two satellites without a formation, m; 0 with one.
    fn distance_m_max(&self) -> f64 {
        match self.array.formation() {
            Some(_) => 0.0,
            None => satellite_distance_m_max(&self.array, &self.windows),
        }
    }

    /// nside of each channel's simulated sky; for a map file that cannot be read, that of a generated sky.
    #[must_use]
    #[doc(hidden)]
    pub fn sky_nsides(&self) -> Vec<usize> {
        let sky = &self.config.sky;
        let nside = |channel: usize| {
            let path = sky.file.as_ref().and_then(|files| files.get(channel));
            let options = sky_options(sky, self.schedules[channel].frequency_hz);
            let map_nside = path.and_then(|path| read_nside(&path, &options).ok());
            let nside_min = if sky.added.is_some() { sky.nside } else { 1 };
            map_nside.map_or(sky.nside, |nside| nside.max(nside_min))
        };
        (0..self.schedules.len()).map(nside).collect()
    }

    /// A note if the baselines of some channels resolve finer scales than the sky's pixels represent.
    #[must_use]
    pub(in crate::pipeline) fn coarse_sky_note(&self) -> Option<String> {
        // Beside points, the map is not asked for what it does not hold.
        if self.config.sky.points.is_some() {
            return None;
        }
        let distance_m_max = self.distance_m_max();
        let coarse: Vec<(String, usize, usize)> = self
            .schedules
            .iter()
            .zip(self.sky_nsides())
            .map(|(schedule, nside)| {
                let longest = longest_baseline_wavelengths(&self.array, distance_m_max, schedule);
                let name = format!("{:.3} MHz ({longest:.1} wavelengths)", schedule.frequency_hz / 1e6);
                (name, l_max_of_fringes(longest), nside)
            })
            .filter(|&(_, seen, nside)| seen > SkyConfig::l_max_determined(nside))
            .collect();
        let (_, seen, nside) = coarse.iter().max_by_key(|(_, seen, _)| *seen)?;
        let held = SkyConfig::l_max_determined(*nside);
        let held_max = SkyConfig::l_max_determined(GENERATED_NSIDE_MAX);
        let names: Vec<&str> = coarse.iter().map(|(name, ..)| name.as_str()).take(4).collect();
        let more = if coarse.len() > names.len() { ", .." } else { "" };
        let needed = (0..)
            .map(|k| 1 << k)
            .find(|&nside| SkyConfig::l_max_determined(nside) >= *seen)
            .unwrap_or(nside * 2);
        let mend = match *seen <= held_max {
            true => format!("a sky of nside {needed} (sky.nside, or a finer map) or shorter baselines"),
            false => "shorter baselines".to_owned(),
        };
        Some(format!(
            "the sky (nside {nside}, l up to {held}) is too coarse for the longest baselines, which see l up to {seen}, of {}{more}: \
             visibilities by direct sums and by harmonics differ there, by up to tens of per cent. Expected {mend} \
             (spacecraft.baseline_wavelengths_max)",
            names.join(", ")
        ))
    }

    /// Memory of the sky model for gains that are solved while data arrive, bytes; 0 for maps that cannot be read.
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
                has_points: false,
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

/// Memory of a pixel in a direct sum, bytes: its direction, and two copies of its value.
const DIRECTION_BYTES: f64 = 40.0;

/// Longest baseline of a schedule, wavelengths. `distance_m_max` is the greatest distance of satellites without a formation.
///
/// The limit of the schedule holds at the start of an integration; until the middle a baseline can move by as much as the rule permits.
fn longest_baseline_wavelengths(array: &Array, distance_m_max: f64, schedule: &Schedule) -> f64 {
    let Some(formation) = array.formation() else {
        let limit = schedule.baseline_wavelengths_max;
        let longest = distance_m_max * schedule.frequency_hz / SPEED_OF_LIGHT_M_S;
        return if limit > 0.0 { longest.min(limit + schedule.rule.motion_wavelengths_max) } else { longest };
    };
    // Arcs are longest at the start of a breathing period.
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

/// Maximum number of windows in which distances are computed.
const WINDOWS_MAX: usize = 500;
/// Instants of each window at which distances are computed.
const INSTANTS: usize = 5;

/// Estimated greatest distance of two satellites in observing windows, m: 10 % above the greatest at some instants, but at most the
/// diameter of the orbits.
fn satellite_distance_m_max(array: &Array, windows: &[ObservingWindow]) -> f64 {
    let step = windows.len().div_ceil(WINDOWS_MAX).max(1);
    let chosen: Vec<&ObservingWindow> = windows.iter().step_by(step).collect();
    let pairs = all_pairs(array.satellites());
    let in_window = |window: &&ObservingWindow| {
        let (start_s, end_s) = (window.start.seconds(), window.end.seconds());
        let time_s = |k: usize| start_s + (end_s - start_s) * k as f64 / (INSTANTS - 1) as f64;
        let distance_m_max = |t_s: f64| {
            let positions_m: Vec<Vec3> = (0..array.satellites()).map(|n| array.position_m(n, t_s)).collect();
            let distance_m =
                |pair: &Pair| norm(sub(positions_m[usize::from(pair.i)], positions_m[usize::from(pair.j)]));
            pairs.iter().map(distance_m).fold(0.0, f64::max)
        };
        (0..INSTANTS).map(time_s).map(distance_m_max).fold(0.0, f64::max)
    };
    let found = chosen.par_iter().map(in_window).reduce(|| 0.0, f64::max);
    (1.1 * found).min(2.0 * array.farthest_m())
}
