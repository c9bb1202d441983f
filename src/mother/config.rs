//! Configuration of the spacecraft.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::correlator::{Division, SUB_BANDS_MAX, dump_samples, shortest_integration_s};
use super::ninth::NinthConfig;
use super::schedule::Schedule;
use crate::array::{Array, IntegrationRule};
use crate::frames::{AntennaResponse, Channel};
use crate::response::model::ModelChoice;
use crate::units::PerChannel;
use crate::units::constants::YEAR_S;

/// Maximum number of channels, which is the mission's.
pub const CHANNELS_MAX: usize = 30;

/// Lowest and highest channel frequency, Hz: the mission's band.
pub const BAND_HZ: [f64; 2] = [0.1e6, 30e6];

/// Size of one visibility in the store and on the link, bytes.
pub const VISIBILITY_BYTES: u64 = 21;

/// Narrowest channel in sample fidelity, Hz: one chunk of 2^14 samples lasts half a minute, in which the array moves by
/// some degrees; the work for a chunk grows with the third power of its duration.
const SAMPLES_WIDTH_HZ_MIN: f64 = 500.0;

/// The `[spacecraft]` section: the space segment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpacecraftConfig {
    /// What is simulated: integrated visibilities, or the samples behind them.
    pub fidelity: Fidelity,
    /// Centre frequencies, Hz.
    pub channels_hz: Vec<f64>,
    /// Width of every channel, Hz.
    pub channel_width_hz: f64,
    /// Length of the mission, s.
    pub duration_s: f64,
    /// Observe only every n-th window.
    pub every_nth_window: u64,
    /// Maximum observing time per window, from its start, s; 0 for the whole window.
    pub window_s_max: f64,
    /// Send down only every n-th integration of a window.
    pub every_nth_integration: PerChannel<u64>,
    /// Longest integration, s.
    pub integration_s_max: f64,
    /// Maximum motion of a baseline during an integration, wavelengths.
    pub motion_wavelengths_max: f64,
    /// Longest baseline that is correlated, wavelengths; 0 for no limit.
    pub baseline_wavelengths_max: PerChannel<f64>,
    /// Model that predicts visibilities.
    pub model: ModelChoice,
    /// Whether visibilities are averages over their integrations (motion along the orbit; harmonic model only) or
    /// instantaneous values at their middle.
    pub smear_integrations: bool,
    /// Whether visibilities are averages over the channel's width, as in sample fidelity: the integrand times
    /// `sinc(pi n . r_ij dnu / c)`. The ground's rows of B are for the channel's centre.
    pub smear_bandwidth: bool,
    /// Whether thermal noise is added. Weights are those of the noise either way.
    pub thermal_noise: bool,
    /// Receiver noise T_rec / zeta, as the antenna would see it from the sky, K sr.
    pub receiver_noise_k_sr: f64,
    /// Antenna response of the daughters.
    pub antenna: Antenna,
    /// Number of sub-bands into which each channel of samples is divided before correlation: a power of two, 1 for none.
    pub sub_bands: usize,
    /// Ecliptic longitude and latitude, deg, of the delay centre towards which samples are delayed before correlation;
    /// empty for no delays.
    pub delay_centre_deg: Vec<f64>,
    /// Integration time of the auto-correlations, s, rounded to whole blocks; 0 for none.
    pub auto_integration_s: f64,
    /// Whether auto-correlations are sent with fidelity "visibilities" too; sample fidelity always sends them.
    pub auto_powers: bool,
    /// Number of blocks that the mother receives beyond a missing one before it gives it up.
    pub wait_blocks: u64,
    /// Capacity of the onboard store, bytes.
    pub store_bytes_max: u64,
    /// Which visibilities a full store drops.
    pub store_drop: StoreDrop,
    /// Mission epoch: TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// The ninth daughter.
    pub ninth: NinthConfig,
}

/// Level of detail of the simulation; the downlink has the same form.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fidelity {
    /// Integrated visibilities with thermal noise: for years of mission time.
    #[default]
    Visibilities,
    /// Samples of every daughter, quantised, sent over links and correlated: for minutes to hours of mission time.
    Samples,
}

/// Which visibilities a full store drops.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StoreDrop {
    /// The latest ones, of all channels and pairs alike.
    #[default]
    Newest,
    /// The earliest ones, likewise.
    Oldest,
    /// The ones that add least to the map per byte: blocks with the lowest weight per visibility, relative to the weight of
    /// a second of their channel. Those are the long baselines, whose integrations are short.
    LowestValue,
}

/// Antenna response by name.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Antenna {
    /// A = 1.
    #[default]
    Isotropic,
    /// A short dipole along the orbit normal.
    DipoleNormal,
}

impl From<Antenna> for AntennaResponse {
    fn from(antenna: Antenna) -> Self {
        match antenna {
            Antenna::Isotropic => Self::Isotropic,
            Antenna::DipoleNormal => Self::DipoleNormal,
        }
    }
}

impl Default for SpacecraftConfig {
    fn default() -> Self {
        let rule = IntegrationRule::default();
        Self {
            fidelity: Fidelity::default(),
            channels_hz: vec![10e6],
            channel_width_hz: 8_000.0,
            duration_s: 1.3 * YEAR_S,
            every_nth_window: 1,
            window_s_max: 0.0,
            every_nth_integration: PerChannel::All(1),
            integration_s_max: rule.duration_s_max,
            motion_wavelengths_max: rule.motion_wavelengths_max,
            baseline_wavelengths_max: PerChannel::All(0.0),
            model: ModelChoice::default(),
            smear_integrations: false,
            smear_bandwidth: false,
            thermal_noise: true,
            receiver_noise_k_sr: 0.0,
            antenna: Antenna::default(),
            sub_bands: 1,
            delay_centre_deg: Vec::new(),
            auto_integration_s: 1.0,
            // One per second over years would outnumber the visibilities several times.
            auto_powers: false,
            wait_blocks: 16,
            store_bytes_max: 4 << 30,
            store_drop: StoreDrop::default(),
            // 2027-01-01T00:00:00 TAI: 69 years of which 17 are leap years.
            epoch_tai_s: (69.0 * 365.0 + 17.0) * 86_400.0,
            ninth: NinthConfig::default(),
        }
    }
}

/// A setting of the spacecraft that cannot be.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum SpacecraftError {
    /// A frequency outside the band.
    #[error("spacecraft.channels_hz[{index}] = {value} Hz: expected {} Hz to {} Hz", BAND_HZ[0], BAND_HZ[1])]
    Frequency {
        /// Place in the list.
        index: usize,
        /// Value found, Hz.
        value: f64,
    },
    /// A channel that leaves the band.
    #[error(
        "spacecraft.channels_hz[{index}] = {value} Hz: a channel of channel_width_hz = {width_hz} Hz about it reaches below \
         zero, or its sub-bands out of {} Hz to {} Hz; expected all of it within", BAND_HZ[0], BAND_HZ[1]
    )]
    Edge {
        /// Place in the list.
        index: usize,
        /// Value found.
        value: f64,
        /// Width, Hz.
        width_hz: f64,
    },
    /// Two channels that overlap.
    #[error(
        "spacecraft.channels_hz[{first}] and [{second}] are {distance_hz} Hz apart: expected at least \
         channel_width_hz, and 1 kHz"
    )]
    Overlap {
        /// Place of one in the list.
        first: usize,
        /// Place of the other.
        second: usize,
        /// Distance, Hz.
        distance_hz: f64,
    },
    /// No or too many channels.
    #[error("spacecraft.channels_hz has {0} channels: expected 1 to {CHANNELS_MAX}")]
    ChannelCount(usize),
    /// A list by channel of the wrong length.
    #[error("spacecraft.{key}: expected one value, or one for each of the {channels} channels")]
    PerChannel {
        /// Key.
        key: &'static str,
        /// Number of channels.
        channels: usize,
    },
    /// Sub-bands of visibilities that were never samples.
    #[error(
        "spacecraft.sub_bands and spacecraft.delay_centre_deg are of samples: expected 1 and [] with \
         spacecraft.fidelity = \"visibilities\", which are of one frequency, or averages over the whole channel"
    )]
    Division,
    /// Integrations shorter than the shortest sum of the correlator.
    #[error(
        "spacecraft.motion_wavelengths_max and spacecraft.integration_s_max leave integrations of {shortest_s:.3e} s, but \
         the correlator sums {dump_s:.3e} s at once: expected longer ones, or baselines kept short by \
         spacecraft.baseline_wavelengths_max"
    )]
    Dump {
        /// The shortest integration, s.
        shortest_s: f64,
        /// The shortest sum, s.
        dump_s: f64,
    },
    /// A direction that cannot be.
    #[error(
        "spacecraft.delay_centre_deg = {0:?}: expected ecliptic longitude and latitude, -90 to 90 degrees, or []"
    )]
    DelayCentre(Vec<f64>),
    /// Averages asked of direct sums.
    #[error(
        "spacecraft.smear_integrations: direct sums are of instants; expected spacecraft.model = \"harmonic\" or \
         \"auto\" with it"
    )]
    Smearing,
    /// Samples asked of a model that they do not have.
    #[error(
        "spacecraft.fidelity = \"samples\" takes direct sums of instants: expected spacecraft.model = \"auto\" or \
         \"direct\", and spacecraft.smear_integrations = false; smear_bandwidth = false too, as samples are of the whole channel"
    )]
    SamplesModel,
    /// A parameter outside its range.
    #[error("spacecraft.{key} = {value}: expected {expected}")]
    Parameter {
        /// Key.
        key: &'static str,
        /// Value found.
        value: f64,
        /// Range that is accepted.
        expected: &'static str,
    },
}

impl SpacecraftConfig {
    /// The channels for the instrument description.
    #[must_use]
    pub fn channels(&self) -> Vec<Channel> {
        let width_hz = self.channel_width_hz;
        self.channels_hz.iter().map(|&frequency_hz| Channel { frequency_hz, width_hz }).collect()
    }

    /// Integration time of the auto-correlations, s; 0 if there are none.
    #[must_use]
    pub fn autos_s(&self) -> f64 {
        if self.auto_powers || self.fidelity == Fidelity::Samples { self.auto_integration_s } else { 0.0 }
    }

    /// One schedule per channel.
    #[must_use]
    pub fn schedules(&self) -> Vec<Schedule> {
        let schedule = |(channel, &frequency_hz): (usize, &f64)| Schedule {
            rule: self.rule(),
            frequency_hz,
            baseline_wavelengths_max: self.baseline_wavelengths_max.get(channel).unwrap_or(0.0),
            every_nth: self.every_nth_integration.get(channel).unwrap_or(1),
            every_nth_window: self.every_nth_window,
        };
        self.channels_hz.iter().enumerate().map(schedule).collect()
    }

    /// What is wrong with integrations of samples in an array, which are whole sums of the correlator.
    #[must_use]
    pub fn dump_problem(&self, array: &Array) -> Option<SpacecraftError> {
        let schedules = self.schedules();
        let shortest_s = shortest_integration_s(array, &schedules);
        let width_hz = self.channel_width_hz;
        let dump_s = dump_samples(array, &schedules, width_hz, self.sub_bands) as f64 / width_hz;
        let short = self.fidelity == Fidelity::Samples && shortest_s < dump_s;
        short.then_some(SpacecraftError::Dump { shortest_s, dump_s })
    }

    /// The delay centre and the sub-bands of sample fidelity.
    #[must_use]
    pub fn division(&self) -> Division {
        let delay_centre = match self.delay_centre_deg[..] {
            [longitude_deg, latitude_deg] => {
                let (sin, cos) = longitude_deg.to_radians().sin_cos();
                let (up, across) = latitude_deg.to_radians().sin_cos();
                Some([across * cos, across * sin, up])
            }
            _ => None,
        };
        Division { sub_bands: self.sub_bands.max(1), delay_centre }
    }

    /// What is wrong with delays and sub-bands.
    fn division_problems(&self) -> Vec<SpacecraftError> {
        let mut found = Vec::new();
        let good = match self.delay_centre_deg[..] {
            [] => true,
            [longitude_deg, latitude_deg] => {
                longitude_deg.is_finite() && (-90.0..=90.0).contains(&latitude_deg)
            }
            _ => false,
        };
        if !good {
            found.push(SpacecraftError::DelayCentre(self.delay_centre_deg.clone()));
        }
        let divided = self.sub_bands != 1 || !self.delay_centre_deg.is_empty();
        if divided && self.fidelity == Fidelity::Visibilities {
            found.push(SpacecraftError::Division);
        }
        for (index, &value) in self.channels_hz.iter().enumerate() {
            let half_hz = 0.5 * self.channel_width_hz;
            // Sub-bands are channels of the downlink, which has them within the band; others only must not reach zero.
            let out = value - half_hz < BAND_HZ[0] || value + half_hz > BAND_HZ[1];
            if half_hz >= value || (self.sub_bands > 1 && out) {
                let width_hz = self.channel_width_hz;
                found.push(SpacecraftError::Edge { index, value, width_hz });
            }
        }
        found
    }

    /// The rule of the adaptive integration.
    #[must_use]
    pub fn rule(&self) -> IntegrationRule {
        IntegrationRule {
            duration_s_max: self.integration_s_max,
            motion_wavelengths_max: self.motion_wavelengths_max,
        }
    }

    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<SpacecraftError> {
        let mut found = Vec::new();
        let channels = self.channels_hz.len();
        if channels == 0 || channels > CHANNELS_MAX {
            found.push(SpacecraftError::ChannelCount(channels));
        }
        for (index, &value) in self.channels_hz.iter().enumerate() {
            if !(BAND_HZ[0]..=BAND_HZ[1]).contains(&value) {
                found.push(SpacecraftError::Frequency { index, value });
            }
        }
        for (second, &high) in self.channels_hz.iter().enumerate() {
            for (first, &low) in self.channels_hz[..second].iter().enumerate() {
                let distance_hz = (high - low).abs();
                if distance_hz < self.channel_width_hz.max(1e3) {
                    found.push(SpacecraftError::Overlap { first, second, distance_hz });
                }
            }
        }
        for (key, fits) in [
            ("every_nth_integration", self.every_nth_integration.fits(channels)),
            ("baseline_wavelengths_max", self.baseline_wavelengths_max.fits(channels)),
        ] {
            if !fits {
                found.push(SpacecraftError::PerChannel { key, channels });
            }
        }
        let direct = self.model != ModelChoice::Harmonic && !self.smear_integrations && !self.smear_bandwidth;
        if self.fidelity == Fidelity::Samples && !direct {
            found.push(SpacecraftError::SamplesModel);
        }
        if self.smear_integrations && self.model == ModelChoice::Direct {
            found.push(SpacecraftError::Smearing);
        }
        found.extend(self.division_problems());
        found.extend(self.ninth.problems());
        let mut require = |key, value: f64, good: bool, expected| {
            if !(good && value.is_finite()) {
                found.push(SpacecraftError::Parameter { key, value, expected });
            }
        };
        let seconds = self.duration_s;
        require("duration_s", seconds, seconds > 0.0 && seconds <= 1e9, "seconds, above 0 and at most 1e9");
        let window = self.window_s_max;
        require("window_s_max", window, window >= 0.0, "seconds, or 0 for all of a window");
        let width = self.channel_width_hz;
        require("channel_width_hz", width, width > 0.0 && width <= 1e6, "above 0 Hz and at most 1 MHz");
        let moving = self.fidelity == Fidelity::Visibilities || width >= SAMPLES_WIDTH_HZ_MIN;
        require("channel_width_hz", width, moving, "at least 500 Hz with fidelity = \"samples\"");
        let longest = self.integration_s_max;
        require("integration_s_max", longest, (1e-3..=1000.0).contains(&longest), "0.001 s to 1000 s");
        let motion = self.motion_wavelengths_max;
        require("motion_wavelengths_max", motion, (1e-3..=1.0).contains(&motion), "0.001 to 1");
        let store = self.store_bytes_max;
        require("store_bytes_max", store as f64, store >= 1 << 20, "at least 1 MiB (1048576)");
        let bands = self.sub_bands;
        let good = bands.is_power_of_two() && bands <= SUB_BANDS_MAX;
        require("sub_bands", bands as f64, good, "a power of two from 1 to 64");
        let autos = self.auto_integration_s;
        let good = autos == 0.0 || (1e-3..=1000.0).contains(&autos);
        require("auto_integration_s", autos, good, "0.001 s to 1000 s, or 0 for none");
        let wait = self.wait_blocks;
        require("wait_blocks", wait as f64, (1..=1024).contains(&wait), "1 to 1024 blocks");
        let noisy = self.thermal_noise || self.fidelity == Fidelity::Visibilities;
        require("thermal_noise", 0.0, noisy, "true with fidelity = \"samples\": samples are noise");
        let noise = self.receiver_noise_k_sr;
        require("receiver_noise_k_sr", noise, noise >= 0.0, "K sr, not negative");
        require("every_nth_window", self.every_nth_window as f64, self.every_nth_window >= 1, "at least 1");
        for &nth in self.every_nth_integration.values() {
            require("every_nth_integration", nth as f64, nth >= 1, "at least 1");
        }
        for &limit in self.baseline_wavelengths_max.values() {
            require("baseline_wavelengths_max", limit, limit >= 0.0, "wavelengths, or 0 for no limit");
        }
        let epoch = self.epoch_tai_s;
        // Four octets of whole seconds are what the time code holds.
        require("epoch_tai_s", epoch, (0.0..=3.0e9).contains(&epoch), "0 to 3e9 s");
        found
    }
}
