//! Noise and measured modes of a planned array, by degree.

use super::bound::observation;
use crate::imaging::{DegreeSensitivity, SensitivitySums};
use crate::mother::{NoiseModel, Schedule, WindowThinning};
use crate::pipeline::config::{PipelineError, Plan};
use crate::pipeline::graph::space_segment::sky;
use crate::response::model::DirectSum;
use crate::sky::SkyMap;
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::spectra::auto_cl;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::{ChannelId, all_pairs};

/// nside of the pixels over which rows of B are integrated.
const NSIDE: usize = 16;
/// nside of the sky whose power the antennas receive.
const POWER_NSIDE: usize = 8;
/// Highest degree of which an estimate tells.
pub const SENSITIVITY_L_MAX: usize = 18;
/// Higher degrees that are solved with them, as the data mix neighbours.
const L_MARGIN: usize = 3;
/// Most visibilities of one estimate; of more, integrations and windows are left out.
const VISIBILITIES_MAX: f64 = 6000.0;
/// Windows that are kept if the mission has them.
const WINDOWS_MIN: u64 = 64;

/// Estimates noise and measured modes of one channel from positions and weights, without simulating its visibilities.
///
/// R is the inverse power of the sky, as maps with R from the data have it nearly; baselines beyond [`Self::baseline_m_max`] are left out, and the
/// Earth is hidden in whole windows. Arrays with one sky and frequency can share an estimator.
#[derive(Debug)]
pub struct ArraySensitivity {
    channel: usize,
    sky: SkyMap,
    sky_k2: Vec<f64>,
    sums: SensitivitySums,
}

impl ArraySensitivity {
    /// Prepares estimates for a channel and degrees up to [`SENSITIVITY_L_MAX`].
    ///
    /// # Errors
    /// A sky that cannot be made.
    pub fn new(plan: &Plan, channel: usize) -> Result<Self, PipelineError> {
        let sky = sky(plan, ChannelId(channel as u16))?;
        let l_max = SENSITIVITY_L_MAX + L_MARGIN;
        let alm = sky.harmonics(l_max, &AnalysisOptions::default())?;
        let mut sky_k2 = auto_cl(&alm);
        // The mean is measured whatever it is, and a degree without power has no inverse.
        let floor = 1e-12 * sky_k2.iter().copied().fold(f64::MIN_POSITIVE, f64::max);
        sky_k2.iter_mut().for_each(|power| *power = power.max(floor));
        Ok(Self {
            channel,
            sky: sky.resized(POWER_NSIDE)?,
            sky_k2,
            sums: SensitivitySums::new(NSIDE, l_max)?,
        })
    }

    /// The estimate for an array, which may differ from the one before in all but sky and channels.
    ///
    /// # Errors
    /// Positions that the model does not cover.
    pub fn of(&mut self, plan: &Plan) -> Result<Vec<DegreeSensitivity>, PipelineError> {
        self.of_at_most(plan, VISIBILITIES_MAX)
    }

    /// Longest baseline of an estimate, m.
    pub(super) fn baseline_m_max(&self, plan: &Plan) -> f64 {
        let schedule = short_baselines(plan, self.channel);
        schedule.baseline_wavelengths_max * SPEED_OF_LIGHT_M_S / schedule.frequency_hz
    }

    fn of_at_most(
        &mut self,
        plan: &Plan,
        visibilities_max: f64,
    ) -> Result<Vec<DegreeSensitivity>, PipelineError> {
        let (moon_m, response) = (plan.array.moon_radius_m(), plan.instrument.response);
        let spacecraft = &plan.config.spacecraft;
        let noise = NoiseModel { seed: None, receiver_noise_k_sr: spacecraft.receiver_k_sr(), response };
        // Sub-bands together have the channel's width.
        let (id, width_hz) =
            (ChannelId(self.channel as u16), plan.instrument.channels[self.channel].width_hz);
        let sigma = |powers: [f64; 2], duration_s: f64| noise.sigma_k_sr(id, powers, width_hz, duration_s);
        let all = short_baselines(plan, self.channel);
        let pairs = all_pairs(plan.array.satellites());
        let expected: f64 = plan
            .windows
            .iter()
            .flat_map(|window| pairs.iter().map(move |pair| all.estimate(&plan.array, *window, *pair).0))
            .sum();
        let (schedule, windows) = thinned(all, plan.windows.len(), expected / visibilities_max);
        let factor = (plan.windows.len() as u64 * schedule.every_nth) as f64
            / (windows.len() as u64 * all.every_nth) as f64;
        let mut power = DirectSum::new(&self.sky, schedule.frequency_hz, moon_m, response);
        self.sums.clear();
        for window in windows.into_iter().filter_map(|k| plan.windows.get(k)) {
            for pair in &pairs {
                let of_pair = ((self.channel, *pair), (&schedule, *window));
                let placed = observation(plan, &mut power, of_pair.0, of_pair.1, &sigma)?;
                self.sums.add(&placed, (moon_m, response), factor);
            }
        }
        let mut found = self.sums.solve(&self.sky_k2)?;
        found.truncate(SENSITIVITY_L_MAX + 1);
        Ok(found)
    }
}

/// The schedule without integrations, and the windows of `windows`, that keep about one visibility in `excess`: many windows with few
/// integrations each, as [`crate::mother`] thins a mission.
fn thinned(schedule: Schedule, windows: usize, excess: f64) -> (Schedule, Vec<usize>) {
    let all = (0..windows).collect();
    if excess <= 1.0 || !excess.is_finite() {
        return (schedule, all);
    }
    let excess = excess.ceil() as u64;
    let stride = excess.isqrt().min(windows as u64 / WINDOWS_MIN).max(1);
    let every_nth = schedule.every_nth.max(1).saturating_mul(excess.div_ceil(stride));
    let mut kept = all;
    kept.retain(|k| WindowThinning::Spread(stride).keeps(*k as u64));
    // The first integration of each window is chosen at random.
    (Schedule { every_nth, windows: WindowThinning::Spread(1), ..schedule }, kept)
}

/// The schedule of a channel without baselines that are not mapped, or of 2 pi b / lambda above l + 10.
///
/// Those see every degree, too, as j_l(x)^2 is 1 / (2 x^2) on average, but weakly: without them noise is estimated too high, the more the fewer
/// baselines are short. Of eight satellites at 10 MHz, 2.5 measured modes of l = 12 are estimated, where a map of nside 16 has 9.6; all its
/// baselines and degrees up to 40 would give 10.6, in many times the time. At 3 MHz: 23.8, and 24.0 of the map.
fn short_baselines(plan: &Plan, channel: usize) -> Schedule {
    let schedule = plan.schedules[channel];
    let reach = (SENSITIVITY_L_MAX + L_MARGIN + 10) as f64 / std::f64::consts::TAU;
    let mapped_m = plan.config.map.baseline_m_max(schedule.frequency_hz);
    let mapped = mapped_m * schedule.frequency_hz / SPEED_OF_LIGHT_M_S;
    let simulated = match schedule.baseline_wavelengths_max {
        0.0 => f64::INFINITY,
        limit => limit,
    };
    Schedule { baseline_wavelengths_max: reach.min(mapped).min(simulated), ..schedule }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::config::ConfigSource;

    fn plan(more: &[&str]) -> Plan {
        let sets = [
            "array.satellites=3",
            "array.arcs_m=[600, 1500]",
            "sky.nside=16",
            "map.nside=8",
            "spacecraft.channels_hz=[3e6]",
            "spacecraft.duration_s=2e6",
            "spacecraft.every_nth_window=4",
            "spacecraft.every_nth_integration=10",
        ];
        let overrides = sets.iter().chain(more).map(|set| (*set).to_owned()).collect();
        let source = ConfigSource { overrides, ..ConfigSource::default() };
        Plan::new(source.load().unwrap()).unwrap()
    }

    /// The samples of a channel are as many whatever the sub-bands.
    #[test]
    fn sub_bands_have_the_information_of_their_channel() {
        let of = |bands: &str| {
            let sets = ["spacecraft.fidelity=samples", "spacecraft.every_nth_window=20"];
            let bands = ["spacecraft", "calibration"].map(|section| format!("{section}.sub_bands={bands}"));
            let plan = plan(&[&sets[..], &bands.each_ref().map(String::as_str)].concat());
            ArraySensitivity::new(&plan, 0).unwrap().of(&plan).unwrap()
        };
        for (one, four) in of("1").iter().zip(of("4")) {
            // Integrations are whole dumps, which sub-bands may lengthen by a few parts in a thousand.
            assert!((four.measured / one.measured - 1.0).abs() < 0.01, "{one:?} {four:?}");
            assert!((four.noise_k2 / one.noise_k2 - 1.0).abs() < 0.01, "{one:?} {four:?}");
        }
    }

    #[test]
    fn thinned_estimates_are_those_of_all_visibilities() {
        let plan = plan(&["spacecraft.every_nth_integration=1"]);
        let mut estimator = ArraySensitivity::new(&plan, 0).unwrap();
        let all = estimator.of_at_most(&plan, f64::INFINITY).unwrap();
        let thinned = estimator.of_at_most(&plan, 1.0 + VISIBILITIES_MAX / 6.0).unwrap();
        assert!(all != thinned);
        for (all, thinned) in all.iter().zip(&thinned).skip(2) {
            let ratio = thinned.measured / all.measured;
            assert!((ratio - 1.0).abs() < 0.1, "{all:?} {thinned:?}");
        }
    }

    #[test]
    fn many_windows_are_kept() {
        let schedule = plan(&[]).schedules[0];
        for (windows, excess, kept, every_nth) in
            [(640, 1.0, 640, 10), (640, 99.5, 64, 100), (10, 99.5, 10, 1000)]
        {
            let (found, places) = thinned(schedule, windows, excess);
            assert_eq!((places.len(), found.every_nth), (kept, every_nth), "{windows} {excess}");
        }
    }
}
