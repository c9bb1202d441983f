//! Noise and measured modes of a planned array, by degree.

use super::bound::observation;
use crate::imaging::{DegreeSensitivity, SensitivitySums};
use crate::mother::{NoiseModel, Schedule};
use crate::pipeline::config::{PipelineError, Plan};
use crate::pipeline::graph::space_segment::sky;
use crate::response::model::DirectSum;
use crate::sky::SkyMap;
use crate::sky::harmonics::AnalysisOptions;
use crate::sky::spectra::auto_cl;
use crate::units::{ChannelId, all_pairs};

/// nside of the pixels over which rows of B are integrated.
const NSIDE: usize = 16;
/// nside of the sky whose power the antennas receive.
const POWER_NSIDE: usize = 8;
/// Highest degree of which an estimate tells.
pub const SENSITIVITY_L_MAX: usize = 18;
/// Higher degrees that are solved with them, as the data mix neighbours.
const L_MARGIN: usize = 3;
/// Most visibilities of one estimate; of more, windows are left out evenly.
const VISIBILITIES_MAX: f64 = 6000.0;

/// Estimates noise and measured modes of one channel from positions and weights, without simulating its visibilities.
///
/// R is the inverse power of the sky, as maps with R from the data have it nearly; baselines far beyond the degrees are left out, and the Earth
/// is hidden in whole windows. Arrays with one sky and frequency can share an estimator.
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
        let (moon_m, response) = (plan.array.moon_radius_m(), plan.instrument.response);
        let spacecraft = &plan.config.spacecraft;
        let noise = NoiseModel { seed: None, receiver_noise_k_sr: spacecraft.receiver_k_sr(), response };
        let (id, width_hz) =
            (ChannelId(self.channel as u16), plan.instrument.channels[self.channel].width_hz);
        let sigma = |powers: [f64; 2], duration_s: f64| noise.sigma_k_sr(id, powers, width_hz, duration_s);
        let schedule = short_baselines(&plan.schedules[self.channel]);
        let pairs = all_pairs(plan.array.satellites());
        let expected: f64 = plan
            .windows
            .iter()
            .flat_map(|window| pairs.iter().map(move |pair| schedule.estimate(&plan.array, *window, *pair).0))
            .sum();
        let windows = plan.windows.len();
        let used = ((windows as f64 * (VISIBILITIES_MAX / expected).min(1.0)) as usize).max(1);
        let factor = windows as f64 / used as f64 * spacecraft.sub_bands as f64;
        let mut power = DirectSum::new(&self.sky, schedule.frequency_hz, moon_m, response);
        self.sums.clear();
        for window in (0..used).filter_map(|k| plan.windows.get(k * windows / used)) {
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

/// The schedule without baselines that see only degrees far above, 2 pi b / lambda > l + 10.
fn short_baselines(schedule: &Schedule) -> Schedule {
    let reach = (SENSITIVITY_L_MAX + L_MARGIN + 10) as f64 / std::f64::consts::TAU;
    let limit = match schedule.baseline_wavelengths_max {
        0.0 => reach,
        limit => limit.min(reach),
    };
    Schedule { baseline_wavelengths_max: limit, ..*schedule }
}
