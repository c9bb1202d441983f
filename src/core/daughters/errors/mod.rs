//! Errors of the instrument, for integrated visibilities and for samples: gains, clocks, positions, antennas, dead
//! receivers, outliers, bursts and leaks.
//!
//! A daughter's signal is multiplied by its voltage gain `g = exp(a + i p)`, `p = phase - 2 pi nu tau` (signals
//! rotate as exp(-2 pi i nu t), so a clock that is late by tau turns them back), and a visibility by `g_i conj(g_j)`.
//! Noise is multiplied by the same gain. The positions in packets are the true ones plus an error along the track,
//! along the orbit's normal and away from the Moon; time tags are the true times plus an error.

mod attitude;
mod config;
mod navigation;
mod series;
mod truth;

pub use attitude::{AntennaErrors, ChannelAntennas, OrbitAntennas};
pub use config::{BeaconSchedule, ErrorTerms, InstrumentConfig};
pub use navigation::NavigationConfig;
pub use truth::truth_csv;

use std::f64::consts::TAU;

use num_complex::Complex64;
use rand_chacha::ChaCha8Rng;

use crate::array::{Array, track_offset_m};
use crate::frames::{Channel, EphemerisSegment, ObservingWindow, VisibilityBlock};
use crate::units::vector::add;
use crate::units::{MissionTime, Pair, StreamKind, TICKS_PER_SECOND, random_stream};
use navigation::TIME_TAG_S_MAX;
use series::{Draws, Series};

/// Errors of an instrument, drawn from a seed.
#[derive(Clone, Debug)]
pub struct InstrumentErrors {
    config: InstrumentConfig,
    navigation: NavigationConfig,
    seed: u64,
    satellites: usize,
    channels: Vec<Channel>,
    orbital_period_s: f64,
}

/// Errors over one pass.
#[derive(Clone, Debug)]
pub struct PassErrors {
    channels: Vec<Channel>,
    /// Log amplitude, phase and failures, by daughter and channel.
    amplitude: Vec<Vec<Series>>,
    phase_deg: Vec<Vec<Series>>,
    dead: Vec<Vec<bool>>,
    /// Clock error, by daughter.
    clock_ns: Vec<Series>,
    /// Position error along the track, across it and away from the Moon, by daughter.
    offset_m: Vec<[Series; 3]>,
    /// Errors of the formation's time tags; `None` if tags are exact.
    time_tag_ms: Option<Series>,
    /// Tilt along the track, tilt away from the Moon (deg) and distortion, by daughter.
    antennas: Vec<[Series; 3]>,
}

impl InstrumentErrors {
    /// Creates the errors of an array with these channels; `None` if there are none.
    #[must_use]
    pub fn new(
        config: &InstrumentConfig,
        navigation: &NavigationConfig,
        seed: u64,
        array: &Array,
        channels: &[Channel],
    ) -> Option<Self> {
        (config.is_on() || navigation.is_on()).then(|| Self {
            config: config.clone(),
            navigation: navigation.clone(),
            // Seeds of realisations differ from each other and from seeds that users choose.
            seed: seed.wrapping_add(u64::from(config.realisation).wrapping_mul(0x9E37_79B9_7F4A_7C15)),
            satellites: array.satellites(),
            channels: channels.to_vec(),
            orbital_period_s: array.orbital_period_s(),
        })
    }

    /// The configuration.
    #[must_use]
    pub fn config(&self) -> &InstrumentConfig {
        &self.config
    }

    /// Whether anything changes within a pass.
    fn changes_in_a_pass(&self) -> bool {
        self.config.changes_in_a_pass() || self.navigation.changes_in_a_pass()
    }

    /// Series of one error of a daughter over a pass.
    fn series(&self, window: ObservingWindow, error: u8, terms: &ErrorTerms, [n, c]: [usize; 2]) -> Series {
        let span = (window.index, [window.start.seconds(), window.end.seconds()]);
        let draws = Draws { seed: self.seed, error, daughter: n, channel: c };
        Series::new(terms, draws, span, self.orbital_period_s)
    }

    /// Tilts and distortion of every daughter over a pass.
    fn antennas(&self, window: ObservingWindow) -> Vec<[Series; 3]> {
        let InstrumentConfig { tilt_along_deg, tilt_radial_deg, pattern, .. } = &self.config;
        let errors = [(6, tilt_along_deg), (7, tilt_radial_deg), (8, pattern)];
        let of = |n: usize| errors.map(|(error, terms)| self.series(window, error, terms, [n, 0]));
        (0..self.satellites).map(of).collect()
    }

    /// Clock error of a daughter over a pass, ns.
    fn clock_ns(&self, window: ObservingWindow, n: usize) -> Series {
        let InstrumentConfig { clock_ns, clock_allan_deviation, clock_steering_s, .. } = &self.config;
        let draws = Draws { seed: self.seed, error: 2, daughter: n, channel: 0 };
        let span_s = [window.start.seconds(), window.end.seconds()];
        self.series(window, 2, clock_ns, [n, 0]).with_walk(
            1e9 * clock_allan_deviation,
            *clock_steering_s,
            draws,
            span_s,
        )
    }

    /// Draws the errors over a pass.
    #[must_use]
    pub fn pass(&self, window: ObservingWindow) -> PassErrors {
        let Self { config, navigation, satellites, channels, .. } = self;
        let series = |error: u8, terms: &ErrorTerms, daughter: usize, channel: usize| {
            self.series(window, error, terms, [daughter, channel])
        };
        let by_channel = |error: u8, terms: &ErrorTerms| -> Vec<Vec<Series>> {
            let of = |n: usize| (0..channels.len()).map(|c| series(error, terms, n, c)).collect();
            (0..*satellites).map(of).collect()
        };
        let dead = |n: usize, c: usize| {
            config.dead_daughters.iter().any(|dead| *dead as usize == n + 1)
                || config.dead_channels.iter().any(|dead| dead.map(|k| k as usize) == [n + 1, c])
        };
        PassErrors {
            channels: channels.clone(),
            amplitude: by_channel(0, &config.amplitude),
            phase_deg: by_channel(1, &config.phase_deg),
            dead: (0..*satellites).map(|n| (0..channels.len()).map(|c| dead(n, c)).collect()).collect(),
            clock_ns: (0..*satellites).map(|n| self.clock_ns(window, n)).collect(),
            offset_m: (0..*satellites)
                .map(|n| {
                    let NavigationConfig { along_m, across_m, radial_m, .. } = navigation;
                    let axes = [(3, along_m), (4, across_m), (5, radial_m)];
                    axes.map(|(error, terms)| series(error, terms, n, 0))
                })
                .collect(),
            time_tag_ms: navigation.has_tag_errors().then(|| series(9, &navigation.time_tag_ms, 0, 0)),
            antennas: self.antennas(window),
        }
    }

    /// Random stream of the outliers of a pair in a channel and pass.
    #[must_use]
    pub fn outliers(&self, window: ObservingWindow, channel: usize, pair: Pair) -> Option<ChaCha8Rng> {
        let identity = 254_u64 << 40 | (channel as u64) << 16 | u64::from(pair.i) << 8 | u64::from(pair.j);
        let stream = || random_stream(self.seed, StreamKind::Instrument, [identity, window.start.0 as u64]);
        (self.config.outlier_probability > 0.0 && self.config.outlier_sigma > 0.0).then(stream)
    }

    /// Power at a daughter of interference that leaks about the Moon's limb, K sr: full with the Earth at the limb or
    /// above it, less by a factor e for each `leak_depth_deg` below it.
    #[must_use]
    pub fn leak_k_sr(&self, array: &Array, daughter: usize, t_s: f64) -> f64 {
        if self.config.leak_k_sr == 0.0 {
            return 0.0;
        }
        let below_deg = array.earth_below_limb_rad(daughter, t_s).to_degrees().max(0.0);
        self.config.leak_k_sr * (-below_deg / self.config.leak_depth_deg).exp()
    }

    /// Power of a burst of interference at a time, K sr.
    #[must_use]
    pub fn burst_k_sr(&self, t_s: f64) -> f64 {
        let InstrumentConfig { burst_every_s, burst_s, burst_k_sr, .. } = self.config;
        let on = self.config.has_bursts() && series::burst_is_on(self.seed, [burst_every_s, burst_s], t_s);
        if on { burst_k_sr } else { 0.0 }
    }
}

impl PassErrors {
    /// Voltage gain of a daughter in a channel at a time, without its clock.
    fn receiver_gain(&self, daughter: usize, channel: usize, t_s: f64) -> Complex64 {
        let amplitude = self.amplitude[daughter][channel].at(t_s);
        let phase_rad = self.phase_deg[daughter][channel].at(t_s).to_radians();
        Complex64::from_polar(amplitude.exp(), phase_rad)
    }

    /// Delay of a daughter's clock, s.
    #[must_use]
    pub fn clock_s(&self, daughter: usize, t_s: f64) -> f64 {
        1e-9 * self.clock_ns[daughter].at(t_s)
    }

    /// Voltage gain of a daughter in a channel at a time, clock included; that of the noise if it is dead.
    #[must_use]
    pub fn gain(&self, daughter: usize, channel: usize, t_s: f64) -> Complex64 {
        let turns = self.channels[channel].frequency_hz * self.clock_s(daughter, t_s);
        self.receiver_gain(daughter, channel, t_s) * Complex64::cis(-TAU * turns.fract())
    }

    /// Whether a daughter delivers no signal in a channel.
    #[must_use]
    pub fn is_dead(&self, daughter: usize, channel: usize) -> bool {
        self.dead[daughter][channel]
    }

    /// Position error, m: along the track, along the orbit's normal, away from the Moon.
    #[must_use]
    pub fn offset_m(&self, daughter: usize, t_s: f64) -> [f64; 3] {
        self.offset_m[daughter].each_ref().map(|series| series.at(t_s))
    }

    /// Error of the time tag of data taken at a time, s.
    #[must_use]
    pub fn time_tag_s(&self, t_s: f64) -> f64 {
        let tag_s = self.time_tag_ms.as_ref().map_or(0.0, |series| 1e-3 * series.at(t_s));
        tag_s.clamp(-TIME_TAG_S_MAX, TIME_TAG_S_MAX)
    }

    /// Maximum time tag error in a pass, s: positions must be known for so long before and after it.
    #[must_use]
    pub fn tag_error_max_s(&self) -> f64 {
        if self.time_tag_ms.is_some() { TIME_TAG_S_MAX } else { 0.0 }
    }

    /// Replaces the times of a block by the reported ones, in whole ticks.
    pub fn tag(&self, block: &mut VisibilityBlock) {
        if self.time_tag_ms.is_none() {
            return;
        }
        let ticks = |t_s: f64| MissionTime::from_seconds(self.time_tag_s(t_s)).0;
        let middles: Vec<i64> = (0..block.len()).map(|k| ticks(block.middle_s(k))).collect();
        let of_start = middles.first().copied().unwrap_or_default();
        block.start = block.start.plus_ticks(of_start);
        // A clock that is set back does not change the order: tags stand still until it has caught up.
        let mut after_half_ticks = 0;
        for ((offset, duration), of_middle) in
            block.offset_ticks.iter_mut().zip(&block.duration_ticks).zip(middles)
        {
            let duration = i64::from(*duration);
            let least = (after_half_ticks - duration + 1).div_euclid(2);
            let tagged = (i64::from(*offset) + of_middle - of_start).max(least).max(0);
            *offset = u32::try_from(tagged).unwrap_or(u32::MAX);
            after_half_ticks = 2 * i64::from(*offset) + duration + 1;
        }
    }

    /// Replaces the true positions of a segment by the reported ones.
    pub fn add_errors(&self, segment: &mut EphemerisSegment, array: &Array) {
        let satellites = usize::from(segment.satellites);
        for (place, position_m) in segment.positions_m.iter_mut().enumerate() {
            let (node, daughter) = ((place / satellites) as i64, place % satellites);
            let time = segment.start.0 + node * i64::from(segment.step_ticks);
            let t_s = MissionTime(time).0 as f64 / TICKS_PER_SECOND as f64;
            let moved =
                track_offset_m(*position_m, array.normal_hat(daughter, t_s), self.offset_m(daughter, t_s));
            *position_m = add(*position_m, moved);
        }
    }
}

#[cfg(test)]
mod tests;
