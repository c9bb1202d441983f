//! Configuration of the spacecraft.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::correlator::{Division, SUB_BANDS_MAX, dump_samples, shortest_integration_s};
use super::ninth::NinthConfig;
use super::receiver::{ReceiverNoise, check_channels, is_none, is_zero};
use super::schedule::Schedule;
use super::thinning::{self, WindowThinning};
use crate::array::{Array, IntegrationRule};
use crate::frames::{AntennaResponse, Channel};
use crate::response::model::ModelChoice;
use crate::units::constants::YEAR_S;
use crate::units::{Checks, Dimension, InvalidValue, PerChannel};

/// Most channels: the mission's own number.
pub const CHANNELS_MAX: usize = 30;

/// Lowest and highest channel frequency, Hz: the mission's band.
pub const BAND_HZ: [f64; 2] = [0.1e6, 30e6];

/// Narrowest channel of samples, Hz. The 2^14 samples that are synthesised together then span half a minute, in which the
/// array moves by some degrees; the cost of narrower channels grows with the third power of that time.
const SAMPLES_WIDTH_HZ_MIN: f64 = 500.0;

fn is_one(number: &u64) -> bool {
    *number == 1
}

/// The `[spacecraft]` section.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SpacecraftConfig {
    /// What is simulated: integrated visibilities, or samples that are correlated.
    pub fidelity: Fidelity,
    /// Centre frequencies, Hz.
    pub channels_hz: Vec<f64>,
    /// Width of every channel, Hz.
    pub channel_width_hz: f64,
    /// Length of the mission, s.
    pub duration_s: f64,
    /// Keep one visibility in this many, from windows that have all phases of month, breathing and precession; in place of
    /// `every_nth_window` and `every_nth_integration`.
    #[serde(skip_serializing_if = "is_one")] // Missions without it keep their hash.
    pub thin: u64,
    /// Observe only in every n-th window.
    pub every_nth_window: u64,
    /// Observe only for this time from the start of each window, s; 0 for all of it.
    pub window_s_max: f64,
    /// Flag a visibility while the Earth is in sight of one of its two daughters. Windows are daughter 1's, and the others
    /// trail her into the shadow.
    pub flag_earth: bool,
    /// Send only every n-th integration of a window.
    pub every_nth_integration: PerChannel<u64>,
    /// Longest integration, s.
    pub integration_s_max: f64,
    /// Longest motion of a baseline in one integration, wavelengths.
    pub motion_wavelengths_max: f64,
    /// Longest baseline that is correlated, wavelengths; 0 for no limit.
    pub baseline_wavelengths_max: PerChannel<f64>,
    /// Visibility model.
    pub model: ModelChoice,
    /// Whether visibilities are averages over their integrations (motion along the orbit; harmonic model only), or
    /// values at their middle.
    pub smear_integrations: bool,
    /// Whether visibilities are averages over the width of their channel, as those of samples are: the integrand times
    /// `sinc(pi n . r_ij dnu / c)`. The ground's rows of B are for the centre of the channel.
    pub smear_bandwidth: bool,
    /// Whether thermal noise is added. Weights describe the noise in either case.
    pub thermal_noise: bool,
    /// Receiver noise T_rec / zeta, referred to the sky, K sr.
    pub receiver_noise_k_sr: ReceiverNoise,
    /// Frequency at which the receiver's 1/f noise equals its other noise, Hz: `receiver_noise_k_sr` is multiplied by
    /// `1 + knee / frequency`; 0 for none.
    #[serde(skip_serializing_if = "is_zero")]
    pub receiver_knee_hz: f64,
    /// Radio interference of the spacecraft itself, added to the receiver noise of every daughter, K sr.
    #[serde(skip_serializing_if = "is_none")]
    pub interference_floor_k_sr: PerChannel<f64>,
    /// Share of the power of the sky that the Moon reflects, xi_R; 0 for none. The paper has 0.07.
    pub moon_reflection: f64,
    /// The form of the Moon that reflects.
    #[serde(skip_serializing_if = "MoonMirror::is_flat")]
    pub moon_mirror: MoonMirror,
    /// Brightness temperature of the Moon's disc, equal over it, K; 0 for none. Physically some 250.
    #[serde(skip_serializing_if = "is_zero")]
    pub moon_temperature_k: f64,
    /// Antenna response of the daughters.
    pub antenna: Antenna,
    /// Sub-bands into which each channel of samples is divided before correlation: a power of two, 1 for none.
    pub sub_bands: usize,
    /// Delay centre of samples: ecliptic longitude and latitude, deg; empty for no delays.
    pub delay_centre_deg: Vec<f64>,
    /// Integration time of auto-correlations, s, in whole blocks of samples; 0 for no auto-correlations.
    pub auto_integration_s: f64,
    /// Whether auto-correlations are simulated with fidelity "visibilities", too; with samples they always are.
    pub auto_powers: bool,
    /// Blocks that the correlator reads ahead while one is missing.
    pub wait_blocks: u64,
    /// Capacity of the onboard store, bytes.
    pub store_bytes_max: u64,
    /// What a full store drops.
    pub store_drop: StoreDrop,
    /// Mission epoch: TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// The ninth daughter.
    pub ninth: NinthConfig,
}

/// Level of detail of the simulated spacecraft; the form of the downlink does not depend on it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Fidelity {
    /// Integrated visibilities with thermal noise: for years of mission time.
    #[default]
    Visibilities,
    /// Samples of every daughter, quantised, sent over links and correlated: for minutes to hours of mission time.
    Samples,
}

/// What a full store drops.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum StoreDrop {
    /// The newest data, of all channels and pairs alike.
    #[default]
    Newest,
    /// The oldest data, of all channels and pairs alike.
    Oldest,
    /// The data that adds least to the map for each byte: blocks with the least weight of a visibility, relative to the
    /// weight of a second of their channel. These are the long baselines, whose integrations are short.
    LowestValue,
}

/// The form of the Moon that reflects the sky.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum MoonMirror {
    /// The horizontal plane below each pair.
    #[default]
    Flat,
    /// A sphere; direct sums only.
    Sphere,
}

impl MoonMirror {
    #[allow(clippy::trivially_copy_pass_by_ref)] // As serde calls it.
    fn is_flat(&self) -> bool {
        *self == Self::Flat
    }
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
    /// Three short dipoles across each other.
    ThreeDipoles,
}

impl From<Antenna> for AntennaResponse {
    fn from(antenna: Antenna) -> Self {
        match antenna {
            Antenna::Isotropic => Self::Isotropic,
            Antenna::DipoleNormal => Self::DipoleNormal,
            Antenna::ThreeDipoles => Self::ThreeDipoles,
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
            thin: 1,
            every_nth_window: 1,
            window_s_max: 0.0,
            flag_earth: true,
            every_nth_integration: PerChannel::All(1),
            integration_s_max: rule.duration_s_max,
            motion_wavelengths_max: rule.motion_wavelengths_max,
            baseline_wavelengths_max: PerChannel::All(0.0),
            model: ModelChoice::default(),
            smear_integrations: false,
            smear_bandwidth: false,
            thermal_noise: true,
            receiver_noise_k_sr: ReceiverNoise::default(),
            receiver_knee_hz: 0.0,
            interference_floor_k_sr: PerChannel::All(0.0),
            moon_reflection: 0.0,
            moon_mirror: MoonMirror::default(),
            moon_temperature_k: 0.0,
            antenna: Antenna::default(),
            sub_bands: 1,
            delay_centre_deg: Vec::new(),
            auto_integration_s: 1.0,
            // One each second over years would be several times as many as the visibilities.
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

/// Integrations that are shorter than the shortest sum of the correlator.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error(
    "spacecraft.motion_wavelengths_max and spacecraft.integration_s_max give integrations of {shortest_s:.3e} s, shorter \
     than the correlator's dumps of {dump_s:.3e} s: expected longer integrations, or shorter baselines \
     (spacecraft.baseline_wavelengths_max)"
)]
pub struct IntegrationTooShort {
    /// The shortest integration, s.
    pub shortest_s: f64,
    /// The shortest sum, s.
    pub dump_s: f64,
}

impl SpacecraftConfig {
    /// The channels, as the instrument description has them.
    #[must_use]
    pub fn channels(&self) -> Vec<Channel> {
        let width_hz = self.channel_width_hz;
        self.channels_hz.iter().map(|&frequency_hz| Channel { frequency_hz, width_hz }).collect()
    }

    /// Integration time of auto-correlations, s; 0 if there are none.
    #[must_use]
    pub fn autos_s(&self) -> f64 {
        if self.auto_powers || self.fidelity == Fidelity::Samples { self.auto_integration_s } else { 0.0 }
    }

    /// Which windows are observed.
    #[must_use]
    pub fn window_thinning(&self) -> WindowThinning {
        match self.thin {
            0 | 1 => WindowThinning::EveryNth(self.every_nth_window),
            thin => WindowThinning::Spread(thinning::shares(thin).0),
        }
    }

    /// One schedule a channel.
    #[must_use]
    pub fn schedules(&self) -> Vec<Schedule> {
        let schedule = |(channel, &frequency_hz): (usize, &f64)| Schedule {
            rule: self.rule(),
            frequency_hz,
            baseline_wavelengths_max: self.baseline_wavelengths_max.get(channel).unwrap_or(0.0),
            every_nth: match self.thin {
                0 | 1 => self.every_nth_integration.get(channel).unwrap_or(1),
                thin => thinning::shares(thin).1,
            },
            windows: self.window_thinning(),
        };
        self.channels_hz.iter().enumerate().map(schedule).collect()
    }

    /// Integrations of samples in an array that are shorter than one sum of the correlator.
    #[must_use]
    pub fn dump_problem(&self, array: &Array) -> Option<IntegrationTooShort> {
        let schedules = self.schedules();
        let shortest_s = shortest_integration_s(array, &schedules);
        let width_hz = self.channel_width_hz;
        let dump_s = dump_samples(array, &schedules, width_hz, self.sub_bands) as f64 / width_hz;
        let short = self.fidelity == Fidelity::Samples && shortest_s < dump_s;
        short.then_some(IntegrationTooShort { shortest_s, dump_s })
    }

    /// Delays and sub-bands of samples.
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

    /// Checks channels, and lists by channel.
    fn check_channels(&self, checks: &mut Checks) {
        let channels = self.channels_hz.len();
        let count = format!("({channels} channels)");
        let expected = format!("1 to {CHANNELS_MAX} channels");
        let is_listed = (1..=CHANNELS_MAX).contains(&channels);
        checks.require("channels_hz", count, is_listed, expected);
        let [low_hz, high_hz] = BAND_HZ;
        let [low, high] = BAND_HZ.map(|hz| Dimension::Frequency.show(hz));
        // Each value and pair of values can be a problem: of a list that is too long only its length is.
        let listed = if is_listed { self.channels_hz.as_slice() } else { &[] };
        for (index, &value) in listed.iter().enumerate() {
            let key = format!("channels_hz[{index}]");
            let inside = (low_hz..=high_hz).contains(&value);
            checks.number(&key, value, inside, format!("{low} to {high}"));
            let half_hz = 0.5 * self.channel_width_hz;
            // Sub-bands are channels of the downlink, which lie within the band; others must only stay above zero.
            let inside = value - half_hz >= low_hz && value + half_hz <= high_hz;
            let fits = half_hz < value && (self.sub_bands == 1 || inside);
            let expected = format!(
                "a channel of channel_width_hz = {} Hz that stays above zero, and with sub-bands within {low} to {high}",
                self.channel_width_hz
            );
            checks.number(&key, value, fits, expected);
        }
        for (second, &high) in listed.iter().enumerate() {
            for (first, &low) in listed[..second].iter().enumerate() {
                let distance_hz = (high - low).abs();
                let apart = distance_hz >= self.channel_width_hz.max(1e3);
                let expected =
                    format!("at least channel_width_hz, and 1 kHz, from channels_hz[{first}] = {low}");
                checks.number(format!("channels_hz[{second}]"), high, apart, expected);
            }
        }
        for (key, values, fits) in [
            (
                "every_nth_integration",
                self.every_nth_integration.values().len(),
                self.every_nth_integration.fits(channels),
            ),
            (
                "baseline_wavelengths_max",
                self.baseline_wavelengths_max.values().len(),
                self.baseline_wavelengths_max.fits(channels),
            ),
        ] {
            let expected = format!("one value, or one for each of the {channels} channels");
            checks.require(key, format!("({values} values)"), fits, expected);
        }
    }

    /// Checks what is simulated and how, with delays and sub-bands.
    fn check_fidelity(&self, checks: &mut Checks) {
        let samples = self.fidelity == Fidelity::Samples;
        let direct = matches!(self.model, ModelChoice::Auto | ModelChoice::Direct)
            && !self.smear_integrations
            && !self.smear_bandwidth;
        checks.require(
            "fidelity",
            "\"samples\"",
            !samples || direct,
            "spacecraft.model = \"auto\" or \"direct\", and spacecraft.smear_integrations = false, as samples are direct \
             sums of instants; smear_bandwidth = false too, as they are of the whole channel",
        );
        let good = match self.delay_centre_deg[..] {
            [] => true,
            [longitude_deg, latitude_deg] => {
                longitude_deg.is_finite() && (-90.0..=90.0).contains(&latitude_deg)
            }
            _ => false,
        };
        let centre = match self.delay_centre_deg.len() {
            0..=2 => format!("{:?}", self.delay_centre_deg),
            values => format!("({values} values)"),
        };
        let expected = "ecliptic longitude and latitude, -90 to 90 degrees, or []";
        checks.require("delay_centre_deg", &centre, good, expected);
        let bands = self.sub_bands;
        let expected =
            "with fidelity = \"visibilities\", which are of one frequency or averages over the whole channel";
        checks.require("sub_bands", bands, samples || bands == 1, format!("1 {expected}"));
        let whole = samples || self.delay_centre_deg.is_empty();
        checks.require("delay_centre_deg", centre, whole, format!("[] {expected}"));
        let noisy = self.thermal_noise || !samples;
        checks.require("thermal_noise", false, noisy, "true with fidelity = \"samples\": samples are noise");
    }

    /// What a daughter's receiver adds to the power of the sky in each channel, K sr: `T_rec / zeta (1 + knee / nu)`, and the
    /// floor of interference. 0 for what a configuration with [`Self::problems`] lacks.
    #[must_use]
    pub fn receiver_k_sr(&self) -> Vec<f64> {
        let of_channel = |(channel, &frequency_hz): (usize, &f64)| {
            let receiver = self.receiver_noise_k_sr.at(channel, frequency_hz).unwrap_or(0.0);
            let floor = self.interference_floor_k_sr.get(channel).unwrap_or(0.0);
            receiver * (1.0 + self.receiver_knee_hz / frequency_hz) + floor
        };
        self.channels_hz.iter().enumerate().map(of_channel).collect()
    }

    fn check_receiver(&self, checks: &mut Checks) {
        self.receiver_noise_k_sr.check(&self.channels_hz, checks);
        let knee = self.receiver_knee_hz;
        checks.number("receiver_knee_hz", knee, knee >= 0.0, "Hz, or 0 for no 1/f noise");
        let floor = &self.interference_floor_k_sr;
        check_channels("interference_floor_k_sr", floor, self.channels_hz.len(), checks);
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
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::of("spacecraft");
        self.check_channels(&mut checks);
        self.check_fidelity(&mut checks);
        self.check_numbers(&mut checks);
        let mut found = checks.finish();
        found.extend(self.ninth.problems());
        found
    }

    fn check_numbers(&self, checks: &mut Checks) {
        let seconds = self.duration_s;
        checks.number(
            "duration_s",
            seconds,
            seconds > 0.0 && seconds <= 1e9,
            "seconds, above 0 and at most 1e9",
        );
        let window = self.window_s_max;
        checks.number("window_s_max", window, window >= 0.0, "seconds, or 0 for all of a window");
        let width = self.channel_width_hz;
        checks.number("channel_width_hz", width, width > 0.0 && width <= 1e6, "above 0 Hz and at most 1 MHz");
        let moving = self.fidelity == Fidelity::Visibilities || width >= SAMPLES_WIDTH_HZ_MIN;
        checks.number("channel_width_hz", width, moving, "at least 500 Hz with fidelity = \"samples\"");
        let longest = self.integration_s_max;
        checks.number("integration_s_max", longest, (1e-3..=1000.0).contains(&longest), "0.001 s to 1000 s");
        let motion = self.motion_wavelengths_max;
        checks.number("motion_wavelengths_max", motion, (1e-3..=1.0).contains(&motion), "0.001 to 1");
        let store = self.store_bytes_max;
        checks.number("store_bytes_max", store as f64, store >= 1 << 20, "at least 1 MiB (1048576)");
        let bands = self.sub_bands;
        let good = bands.is_power_of_two() && bands <= SUB_BANDS_MAX;
        checks.number("sub_bands", bands as f64, good, "a power of two from 1 to 64");
        let autos = self.auto_integration_s;
        let good = autos == 0.0 || (1e-3..=1000.0).contains(&autos);
        checks.number("auto_integration_s", autos, good, "0.001 s to 1000 s, or 0 for none");
        let wait = self.wait_blocks;
        checks.number("wait_blocks", wait as f64, (1..=1024).contains(&wait), "1 to 1024 blocks");
        self.check_receiver(checks);
        let share = self.moon_reflection;
        checks.number("moon_reflection", share, (0.0..=1.0).contains(&share), "0 to 1");
        let direct = self.moon_mirror == MoonMirror::Flat || self.model == ModelChoice::Direct;
        let expected = "spacecraft.model = \"direct\" with it, as harmonics are of a flat mirror";
        checks.require("moon_mirror", "\"sphere\"", direct, expected);
        let moon_k = self.moon_temperature_k;
        checks.number("moon_temperature_k", moon_k, (0.0..=1e4).contains(&moon_k), "0 K to 1e4 K");
        checks.number(
            "every_nth_window",
            self.every_nth_window as f64,
            self.every_nth_window >= 1,
            "at least 1",
        );
        checks.number("thin", self.thin as f64, self.thin >= 1, "at least 1");
        let is_alone =
            self.every_nth_window == 1 && self.every_nth_integration.values().iter().all(|&nth| nth == 1);
        let expected = "1, or every_nth_window = 1 and every_nth_integration = 1, which it replaces";
        checks.number("thin", self.thin as f64, self.thin <= 1 || is_alone, expected);
        let some = self.every_nth_integration.values().iter().all(|&nth| nth >= 1);
        checks.require("every_nth_integration", 0, some, "at least 1");
        let limits = self.baseline_wavelengths_max.values();
        let expected = "wavelengths, or 0 for no limit";
        checks.numbers("baseline_wavelengths_max", limits, |limit| limit >= 0.0, expected);
        let epoch = self.epoch_tai_s;
        // Four octets of whole seconds are what the time code holds.
        checks.number("epoch_tai_s", epoch, (0.0..=3.0e9).contains(&epoch), "0 to 3e9 s");
    }
}
