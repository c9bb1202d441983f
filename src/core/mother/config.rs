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
use crate::units::{Checks, Dimension, InvalidValue, PerChannel, keys};

/// Maximum number of channels: that of the mission.
pub const CHANNELS_MAX: usize = 30;

/// Lowest and highest channel frequency, Hz: the mission's band.
pub const BAND_HZ: [f64; 2] = [0.1e6, 30e6];

/// Minimum width of a channel of samples, Hz. The 2^14 samples that are synthesised together then span half a minute,
/// in which the array moves by some degrees; the cost grows with the third power of that time.
const SAMPLES_WIDTH_HZ_MIN: f64 = 500.0;

/// Maximum power that a receiver adds, K sr: a hundred times that of the brightest sky, at the low end of the band.
const RECEIVER_K_SR_MAX: f64 = 1e10;

/// Missions with the default keep their hash.
#[allow(clippy::trivially_copy_pass_by_ref)] // As serde calls it.
fn is_one(number: &u64) -> bool {
    *number == 1
}

keys! {
    /// The `[spacecraft]` section.
    pub struct SpacecraftConfig {
        /// What is simulated: "visibilities", or "samples", the voltages of every daughter, which are correlated; for minutes
        /// to hours of mission time.
        everyday fidelity: Fidelity = Fidelity::default();
        /// Centre frequencies of up to 30 channels, from 0.1 to 30 MHz.
        everyday channels_hz: Vec<f64> = vec![10e6];
        /// Width of every channel.
        expert channel_width_hz: f64 = 8_000.0;
        /// Length of the mission.
        everyday duration_s: f64 = 1.3 * YEAR_S;
        /// Keep one visibility in this many, from windows at all phases of month, breathing and precession; instead of
        /// every_nth_window and every_nth_integration.
        #[serde(skip_serializing_if = "is_one")]
        everyday thin: u64 = 1;
        /// Observe only in every n-th window; there is one an orbit.
        everyday every_nth_window: u64 = 1;
        /// Maximum time observed from the start of each window; 0 for all of it.
        everyday window_s_max: f64 = 0.0;
        /// Flag a visibility while one of its daughters sees the Earth. Windows are daughter 1's; the others trail her into the
        /// shadow.
        expert flag_earth: bool = true;
        /// Send only every n-th integration of a window; one value, or one per channel.
        everyday every_nth_integration: PerChannel<u64> = PerChannel::All(1);
        /// Maximum length of an integration.
        expert integration_s_max: f64 = IntegrationRule::default().duration_s_max;
        /// Maximum motion of a baseline in one integration.
        expert motion_wavelengths_max: f64 = IntegrationRule::default().motion_wavelengths_max;
        /// Maximum baseline that is correlated; 0 for no limit; one value, or one per channel.
        expert baseline_wavelengths_max: PerChannel<f64> = PerChannel::All(0.0);
        /// Model of the visibilities: "direct" sums over pixels, "harmonic" on a circle, "general" harmonics anywhere, or
        /// "auto", by cost: harmonics where they hold all degrees that baselines see, or with sky.l_max, sky.points or averages.
        expert model: ModelChoice = ModelChoice::default();
        /// Average visibilities over their integrations, instead of taking the middle.
        expert smear_integrations: bool = false;
        /// Average visibilities over the channel's width, as those of samples are: the integrand times `sinc(pi n . r_ij dnu /
        /// c)`. The ground's rows of B are for the channel's centre.
        expert smear_bandwidth: bool = false;
        /// Add thermal noise. Weights describe it in either case.
        everyday thermal_noise: bool = true;
        /// Receiver noise over the antenna's transmission efficiency, T_rec / zeta, added to the sky: one value, one per
        /// channel, or a table of [Hz, K sr] at rising frequencies, linear in both logarithms, such as `[[1e6, 2e4], [10e6,
        /// 300.0], [30e6, 100.0]]`.
        everyday receiver_noise_k_sr: ReceiverNoise = ReceiverNoise::default();
        /// Frequency at which the receiver's 1/f noise equals its other noise: `receiver_noise_k_sr` is multiplied by `1 + knee /
        /// frequency`.
        #[serde(skip_serializing_if = "is_zero")]
        expert receiver_knee_hz: f64 = 0.0;
        /// Radio interference of the spacecraft itself, added to every daughter's receiver noise; one value, or one per channel.
        #[serde(skip_serializing_if = "is_none")]
        expert interference_floor_k_sr: PerChannel<f64> = PerChannel::All(0.0);
        /// Fraction xi_R of the sky's power that the Moon reflects; 0.07 in the paper.
        everyday moon_reflection: f64 = 0.0;
        /// Form of the Moon that reflects: "flat", or "sphere" with spacecraft.model = "direct".
        #[serde(skip_serializing_if = "MoonMirror::is_flat")]
        expert moon_mirror: MoonMirror = MoonMirror::default();
        /// Brightness temperature of the Moon's disc, uniform; physically some 250. The ground does not correct for it.
        #[serde(skip_serializing_if = "is_zero")]
        expert moon_temperature_k: f64 = 0.0;
        /// Antenna of the daughters: "isotropic", "dipole-normal", or "three-dipoles": three crossed dipoles, each with a
        /// receiver, as one antenna.
        everyday antenna: Antenna = Antenna::default();
        /// Sub-bands into which a channel of samples is divided before correlation: a power of two, 1 for none.
        expert sub_bands: usize = 1;
        /// Delay centre of samples: ecliptic longitude and latitude; empty for no delays.
        expert delay_centre_deg: Vec<f64> = Vec::new();
        /// Integration time of auto-correlations, in whole blocks of samples; 0 for no auto-correlations.
        #[only_with(r#"spacecraft.auto_powers = true or spacecraft.fidelity = "samples""#)]
        expert auto_integration_s: f64 = 1.0;
        /// Simulate auto-correlations with fidelity "visibilities", too; samples always have them.
        expert auto_powers: bool = false;
        /// Blocks that the correlator reads ahead while one is missing.
        #[only_with(r#"spacecraft.fidelity = "samples""#)]
        expert wait_blocks: u64 = 16;
        /// Capacity of the onboard store.
        expert store_bytes_max: u64 = 4 << 30;
        /// What a full store drops: the "newest" data, the "oldest", or "lowest-value", which adds least to the map.
        expert store_drop: StoreDrop = StoreDrop::default();
        /// Epoch of the mission, TAI seconds since 1958-01-01; by default 2027-01-01.
        expert epoch_tai_s: f64 = (69.0 * 365.0 + 17.0) * 86_400.0;
        /// The ninth daughter: a spectrometer of the whole sky, whose spectra are auto-correlations.
        section ninth: NinthConfig = NinthConfig::default();
    }
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
    /// The data that add least to the map for each byte: blocks with the lowest weight of a visibility, relative to
    /// the weight of a second of their channel. These are the long baselines, whose integrations are short.
    LowestValue,
}

/// Shape of the Moon as a mirror of the sky.
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
    /// Three short dipoles perpendicular to each other.
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

/// Integrations are shorter than the shortest dump of the correlator.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
#[error(
    "spacecraft.motion_wavelengths_max and spacecraft.integration_s_max give integrations of {shortest_s:.3e} s, shorter \
     than the correlator's dumps of {dump_s:.3e} s: expected longer integrations, or shorter baselines \
     (spacecraft.baseline_wavelengths_max)"
)]
pub struct IntegrationTooShort {
    /// Shortest integration, s.
    pub shortest_s: f64,
    /// Shortest dump, s.
    pub dump_s: f64,
}

impl SpacecraftConfig {
    /// Channels as in the instrument description.
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

    /// Selection of the observed windows.
    #[must_use]
    pub fn window_thinning(&self) -> WindowThinning {
        match self.thin {
            0 | 1 => WindowThinning::EveryNth(self.every_nth_window),
            thin => WindowThinning::Spread(thinning::strides(thin).0),
        }
    }

    /// One schedule for each channel.
    #[must_use]
    pub fn schedules(&self) -> Vec<Schedule> {
        let schedule = |(channel, &frequency_hz): (usize, &f64)| Schedule {
            rule: self.rule(),
            frequency_hz,
            baseline_wavelengths_max: self.baseline_wavelengths_max.get(channel).unwrap_or(0.0),
            every_nth: match self.thin {
                0 | 1 => self.every_nth_integration.get(channel).unwrap_or(1),
                thin => thinning::strides(thin).1,
            },
            windows: self.window_thinning(),
        };
        self.channels_hz.iter().enumerate().map(schedule).collect()
    }

    /// Problem of integrations of samples that are shorter than one dump of the correlator.
    #[must_use]
    pub fn dump_problem(&self, array: &Array) -> Option<IntegrationTooShort> {
        let schedules = self.schedules();
        let shortest_s = shortest_integration_s(array, &schedules);
        let width_hz = self.channel_width_hz;
        let dump_s = dump_samples(array, &schedules, width_hz, self.sub_bands) as f64 / width_hz;
        let short = self.fidelity == Fidelity::Samples && shortest_s < dump_s;
        short.then_some(IntegrationTooShort { shortest_s, dump_s })
    }

    /// Delay centre and sub-bands of samples.
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

    /// Checks the channels, and lists by channel.
    fn check_channels(&self, checks: &mut Checks) {
        let channels = self.channels_hz.len();
        let count = format!("({channels} channels)");
        let expected = format!("1 to {CHANNELS_MAX} channels");
        let is_listed = (1..=CHANNELS_MAX).contains(&channels);
        checks.require("channels_hz", count, is_listed, expected);
        let [low_hz, high_hz] = BAND_HZ;
        let [low, high] = BAND_HZ.map(|hz| Dimension::Frequency.show(hz));
        // Each value and pair of values can be a problem; for a list that is too long only its length is reported.
        let listed = if is_listed { self.channels_hz.as_slice() } else { &[] };
        for (index, &value) in listed.iter().enumerate() {
            let key = format!("channels_hz[{index}]");
            let inside = (low_hz..=high_hz).contains(&value);
            checks.number(&key, value, inside, format!("{low} to {high}"));
            let half_hz = 0.5 * self.channel_width_hz;
            // Sub-bands are channels of the downlink and must lie within the band; other channels must only stay
            // above zero.
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
                let is_separated = distance_hz >= self.channel_width_hz.max(1e3);
                let expected =
                    format!("at least channel_width_hz, and 1 kHz, from channels_hz[{first}] = {low}");
                checks.number(format!("channels_hz[{second}]"), high, is_separated, expected);
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
            let expected = format!("a single value, or a list of one for each of the {channels} channels");
            checks.require(key, format!("({values} values)"), fits, expected);
        }
    }

    /// Checks the fidelity, with delays and sub-bands.
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
             sums at single instants; smear_bandwidth = false too, as samples cover the whole channel",
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
        let expected = "with fidelity = \"visibilities\", which are for one frequency or averages over the whole channel";
        checks.require("sub_bands", bands, samples || bands == 1, format!("1 {expected}"));
        let whole = samples || self.delay_centre_deg.is_empty();
        checks.require("delay_centre_deg", centre, whole, format!("[] {expected}"));
        let has_noise = self.thermal_noise || !samples;
        checks.require(
            "thermal_noise",
            false,
            has_noise,
            "true with fidelity = \"samples\": samples are noise",
        );
    }

    /// Power that a daughter's receiver adds to the sky in each channel, K sr: `T_rec / zeta (1 + knee / nu)`, and
    /// the floor of interference. 0 for values missing in a configuration with [`Self::problems`].
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
        let loudest = self.receiver_k_sr().into_iter().fold(0.0, f64::max);
        let expected = "at most 1e10 K sr with receiver_knee_hz and interference_floor_k_sr: beyond, nothing of the sky is left";
        checks.number("receiver_noise_k_sr", loudest, loudest <= RECEIVER_K_SR_MAX, expected);
    }

    /// Rule of the integration time.
    #[must_use]
    pub fn rule(&self) -> IntegrationRule {
        IntegrationRule {
            duration_s_max: self.integration_s_max,
            motion_wavelengths_max: self.motion_wavelengths_max,
        }
    }

    /// All invalid values; empty if there are none.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("spacecraft");
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
        let is_wide_enough = self.fidelity == Fidelity::Visibilities || width >= SAMPLES_WIDTH_HZ_MIN;
        checks.number(
            "channel_width_hz",
            width,
            is_wide_enough,
            "at least 500 Hz with fidelity = \"samples\"",
        );
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
        let expected = "\"flat\", or spacecraft.model = \"direct\": harmonics assume a flat mirror";
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
        let is_positive = self.every_nth_integration.values().iter().all(|&nth| nth >= 1);
        checks.require("every_nth_integration", 0, is_positive, "at least 1");
        let limits = self.baseline_wavelengths_max.values();
        let expected = "wavelengths, or 0 for no limit";
        checks.numbers("baseline_wavelengths_max", limits, |limit| limit >= 0.0, expected);
        let epoch = self.epoch_tai_s;
        // The time code holds whole seconds in four octets.
        checks.number("epoch_tai_s", epoch, (0.0..=3.0e9).contains(&epoch), "0 to 3e9 s");
    }
}
