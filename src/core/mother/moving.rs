//! Sources that move and change with time, as the daughters measure them.

use std::f64::consts::PI;
use std::fmt::Write;
use std::sync::Arc;

use num_complex::Complex64;

use crate::array::{Array, body_hat_by_date, hidden_by_moon};
use crate::frames::{AntennaResponse, Channel, ObservingWindow};
use crate::response::beacon::plane_wave;
use crate::response::pixel::exact::envelope;
use crate::response::pixel::{PairGeometry, SingleGeometry};
use crate::sky::{MovingDirection, MovingSource, ecliptic_deg, k_sr_per_jy};
use crate::units::Pair;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, direction, dot, sub};

/// Instants of an integration, where visibilities are averages over it. The Moon's limb is an edge, for which equal steps are as good as any.
const INSTANTS: u32 = 16;

/// The moving sources of a mission.
#[derive(Clone, Debug)]
pub struct MovingSky {
    /// The sources.
    pub sources: Vec<MovingSource>,
    /// Steady sources in each channel.
    pub points: Vec<SteadyPoints>,
    /// Orbits of the daughters.
    pub array: Arc<Array>,
    /// Epoch of the mission, TAI seconds since 1958-01-01.
    pub epoch_tai_s: f64,
    /// Antennas of the daughters.
    pub response: AntennaResponse,
    /// Whether directions change within integrations, or are those of their middle. Flux densities are means over integrations.
    pub smear_integrations: bool,
    /// Whether visibilities are averages over the channel's width.
    pub smear_bandwidth: bool,
}

/// Steady point sources at the frequency of a channel.
#[derive(Clone, Debug, PartialEq)]
pub struct SteadyPoints {
    /// Frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// Direction of each source on ecliptic axes, and its power, K sr.
    pub sources: Vec<(Vec3, f64)>,
}

/// What the moving sources add to a visibility, and to the powers of its two daughters.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct MovingSignal {
    pub(super) powers_k_sr: [f64; 2],
    pub(super) visibility_k_sr: Complex64,
}

impl MovingSky {
    /// Direction of a source at a time.
    fn source_hat(&self, source: &MovingSource, t_s: f64) -> Vec3 {
        match source.direction {
            MovingDirection::Body(body) => body_hat_by_date(body, self.epoch_tai_s, t_s),
            MovingDirection::Fixed([longitude_deg, latitude_deg]) => direction(longitude_deg, latitude_deg),
        }
    }

    /// The signal in an integration of a pair about a time, of a length, s. Powers of auto-correlations are those of a pair of one daughter
    /// with itself.
    pub(super) fn signal(&self, pair: Pair, channel: &Channel, middle_s: f64, dt_s: f64) -> MovingSignal {
        let mut total = MovingSignal::default();
        let ends_s = [middle_s - 0.5 * dt_s, middle_s + 0.5 * dt_s];
        let instants = if self.smear_integrations { INSTANTS } else { 1 };
        let instant_s = |k: u32| ends_s[0] + dt_s * (f64::from(k) + 0.5) / f64::from(instants);
        if !self.points.is_empty() {
            (0..instants)
                .for_each(|k| self.add_points(&mut total, f64::from(instants), pair, channel, instant_s(k)));
        }
        for source in self.sources.iter().filter(|source| source.is_on(channel.frequency_hz, ends_s)) {
            for k in 0..instants {
                let t_s = instant_s(k);
                let half_s = 0.5 * dt_s / f64::from(instants);
                let flux_jy = source.mean_flux_jy(channel.frequency_hz, [t_s - half_s, t_s + half_s]);
                let k_sr = flux_jy * k_sr_per_jy(channel.frequency_hz);
                if k_sr > 0.0 {
                    self.add(&mut total, (source, k_sr / f64::from(instants)), pair, channel, t_s);
                }
            }
        }
        total
    }

    /// Adds the steady sources at one of some instants.
    fn add_points(&self, total: &mut MovingSignal, instants: f64, pair: Pair, channel: &Channel, t_s: f64) {
        let (response, moon_radius_m, hz) = (self.response, self.array.moon_radius_m(), channel.frequency_hz);
        let daughters = [pair.i, pair.j].map(|n| SingleGeometry {
            r_m: self.array.position_m(n.into(), t_s),
            normal_hat: self.array.normal_hat(n.into(), t_s),
            moon_radius_m,
            response,
        });
        let [r_i_m, r_j_m] = daughters.map(|daughter| daughter.r_m);
        let geometry = PairGeometry { r_i_m, r_j_m, frequency_hz: hz, moon_radius_m, response };
        let width_hz = if self.smear_bandwidth { channel.width_hz } else { 0.0 };
        let of_channel = self.points.iter().filter(|points| points.frequency_hz == hz);
        for &(n_hat, k_sr) in of_channel.flat_map(|points| &points.sources) {
            let seen_k_sr = daughters.map(|daughter| k_sr / instants * daughter.envelope(n_hat));
            total.powers_k_sr.iter_mut().zip(seen_k_sr).for_each(|(power, seen)| *power += seen);
            if pair.i != pair.j && seen_k_sr.iter().all(|k_sr| *k_sr > 0.0) {
                total.visibility_k_sr += point_source(k_sr / instants, n_hat, &geometry, width_hz);
            }
        }
    }

    /// Adds a source of a power at an instant.
    fn add(
        &self,
        total: &mut MovingSignal,
        (source, k_sr): (&MovingSource, f64),
        pair: Pair,
        channel: &Channel,
        t_s: f64,
    ) {
        let (n_hat, response) = (self.source_hat(source, t_s), self.response);
        let [r_i_m, r_j_m] = [pair.i, pair.j].map(|n| self.array.position_m(n.into(), t_s));
        let moon_radius_m = self.array.moon_radius_m();
        for ((power_k_sr, r_m), n) in total.powers_k_sr.iter_mut().zip([r_i_m, r_j_m]).zip([pair.i, pair.j]) {
            let normal_hat = self.array.normal_hat(n.into(), t_s);
            *power_k_sr += k_sr * SingleGeometry { r_m, normal_hat, moon_radius_m, response }.envelope(n_hat);
        }
        if pair.i == pair.j {
            return;
        }
        let frequency_hz = channel.frequency_hz;
        let geometry = PairGeometry { r_i_m, r_j_m, frequency_hz, moon_radius_m, response };
        let width_hz = if self.smear_bandwidth { channel.width_hz } else { 0.0 };
        total.visibility_k_sr += point_source(k_sr, n_hat, &geometry, width_hz);
    }

    /// The true bursts as a table (CSV), one line for each burst and channel: source, from 1, channel, frequency, start, peak, decay
    /// time, flux density and power at the peak, ecliptic direction then, the window that it lies in (empty if none), and 1 if the
    /// Moon hides it from daughter 1.
    #[must_use]
    pub fn truth_csv(&self, channels: &[Channel], windows: &[ObservingWindow]) -> String {
        let mut text = String::from(
            "source,channel,frequency_hz,start_s,peak_s,decay_s,peak_jy,peak_k_sr,longitude_deg,latitude_deg,window,hidden\n",
        );
        for (number, source) in (1..).zip(&self.sources) {
            for &start_s in &source.starts_s {
                for (channel, &Channel { frequency_hz, .. }) in channels.iter().enumerate() {
                    let [rise_s, decay_s] = source.times_s(frequency_hz);
                    let begin_s = start_s + source.delay_s(frequency_hz);
                    let peak_s = begin_s + rise_s;
                    let n_hat = self.source_hat(source, peak_s);
                    let [longitude_deg, latitude_deg] = ecliptic_deg(n_hat);
                    let holds = |w: &&ObservingWindow| (w.start.seconds()..w.end.seconds()).contains(&peak_s);
                    let window = windows.iter().find(holds);
                    let r_m = self.array.position_m(0, peak_s);
                    let hidden = hidden_by_moon(r_m, n_hat, self.array.moon_radius_m());
                    let peak_jy = source.peak_at_jy(frequency_hz);
                    // Writing to a String cannot fail.
                    let _ = writeln!(
                        text,
                        "{number},{channel},{frequency_hz},{begin_s:.6},{peak_s:.6},{decay_s:.6},{peak_jy:e},{:e},{longitude_deg:.6},\
                         {latitude_deg:.6},{},{}",
                        peak_jy * k_sr_per_jy(frequency_hz),
                        window.map(|window| window.index.to_string()).unwrap_or_default(),
                        u8::from(hidden),
                    );
                }
            }
        }
        text
    }
}

/// Visibility of a point source of a power in direction `n_hat`, averaged over a channel's width (0 for its centre), K sr.
fn point_source(k_sr: f64, n_hat: Vec3, pair: &PairGeometry, width_hz: f64) -> Complex64 {
    let baseline_m = sub(pair.r_i_m, pair.r_j_m);
    let x = PI * dot(n_hat, baseline_m) * width_hz / SPEED_OF_LIGHT_M_S;
    let sinc = if x == 0.0 { 1.0 } else { x.sin() / x };
    sinc * plane_wave(k_sr * envelope(pair, n_hat), n_hat, baseline_m, pair.frequency_hz)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Longitude and latitude, deg, and the visibility of 3.2548e7 K sr at 10 MHz and its mean over 8 kHz, K sr: numpy 2,
    /// `P exp(-2 pi i (nu / c) n . (ri - rj))` with ri = (2.0371e6, 0, 0), rj as below, and its mean over 20,000 frequencies; zero if the ray
    /// `r + s n`, s > 0, of either daughter passes within 1,737,100 m of the Moon's centre.
    const SEEN: [([f64; 2], [f64; 2], [f64; 2]); 4] = [
        ([40.0, 10.0], [-26788890.37433059, 18485877.217814088], [-136718.37040103326, 94343.54963580391]),
        // Hidden from both, from behind the Moon, and from one.
        ([150.0, -20.0], [0.0; 2], [0.0; 2]),
        ([180.0, 0.0], [0.0; 2], [0.0; 2]),
        ([125.0, 0.0], [0.0; 2], [0.0; 2]),
    ];

    #[test]
    fn a_source_is_seen_as_by_independent_code() {
        let pair = PairGeometry {
            r_i_m: [2.0371e6, 0.0, 0.0],
            r_j_m: [1902242.05625989, 700826.02072733, 200236.00592209],
            frequency_hz: 1e7,
            moon_radius_m: 1_737_100.0,
            response: AntennaResponse::Isotropic,
        };
        for ([longitude, latitude], whole, mean) in SEEN {
            let found = |width_hz| point_source(3.2548e7, direction(longitude, latitude), &pair, width_hz);
            for (found, [re, im]) in [(found(0.0), whole), (found(8e3), mean)] {
                // 2e4 turns lose four digits of sixteen, and rj is given to 1e-8 m; the mean over frequencies is a midpoint sum.
                assert!((found - Complex64::new(re, im)).norm() < 20.0, "{longitude}: {found}, {re} {im}");
            }
        }
    }

    #[test]
    fn the_sun_is_seen_by_both_daughters_and_their_powers_alike() {
        let source: MovingSource =
            toml::from_str("direction = 'sun'\nstarts_s = [1000.0]\npeak_jy = 1e8\ndecay_s = 1e5").unwrap();
        let sky = MovingSky {
            sources: vec![source],
            points: Vec::new(),
            array: Arc::new(Array::new(&Default::default()).unwrap()),
            epoch_tai_s: 2.2e9,
            response: AntennaResponse::Isotropic,
            smear_integrations: false,
            smear_bandwidth: false,
        };
        let channel = Channel { frequency_hz: 1e7, width_hz: 8e3 };
        let pair = Pair { i: 0, j: 7 };
        assert_eq!(sky.signal(pair, &channel, 900.0, 1.0), MovingSignal::default());
        // Over an orbit the Moon hides a source for a part that its disc, seen from 300 km, covers: less than a third of the circle.
        let times = (0..100).map(|k| 1010.0 + 82.0 * f64::from(k));
        let signals: Vec<MovingSignal> = times.map(|t_s| sky.signal(pair, &channel, t_s, 1.0)).collect();
        let seen = signals.iter().filter(|signal| signal.visibility_k_sr != Complex64::ZERO);
        assert!((55..100).contains(&seen.clone().count()), "{}", seen.count());
        for signal in seen {
            let [p, q] = signal.powers_k_sr;
            assert!(p == q && (signal.visibility_k_sr.norm() / p - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn steady_sources_are_seen_at_any_time_while_the_moon_does_not_hide_them() {
        let array = Arc::new(Array::new(&Default::default()).unwrap());
        let sources = vec![(direction(10.0, 80.0), 3.0), (direction(200.0, -5.0), 2.0)];
        let sky = MovingSky {
            sources: Vec::new(),
            points: vec![SteadyPoints { frequency_hz: 1e7, sources: sources.clone() }],
            array: Arc::clone(&array),
            epoch_tai_s: 2.2e9,
            response: AntennaResponse::Isotropic,
            smear_integrations: false,
            smear_bandwidth: false,
        };
        let channel = Channel { frequency_hz: 1e7, width_hz: 8e3 };
        let mut hidden = 0;
        for k in 0..100 {
            let t_s = 1e6 + 82.0 * f64::from(k);
            let [r_i_m, r_j_m] = [0, 7].map(|n| array.position_m(n, t_s));
            let is_seen = |n_hat: Vec3| {
                ![r_i_m, r_j_m].iter().any(|&r_m| hidden_by_moon(r_m, n_hat, array.moon_radius_m()))
            };
            hidden += usize::from(!is_seen(sources[1].0));
            let wave = |(n_hat, k_sr): &(Vec3, f64)| {
                let turns = dot(sub(r_i_m, r_j_m), *n_hat) * 1e7 / SPEED_OF_LIGHT_M_S;
                if is_seen(*n_hat) { *k_sr * Complex64::cis(-2.0 * PI * turns) } else { Complex64::ZERO }
            };
            let expected: Complex64 = sources.iter().map(wave).sum();
            let found = sky.signal(Pair { i: 0, j: 7 }, &channel, t_s, 1.0).visibility_k_sr;
            // 3e3 turns of 16 digits.
            assert!((found - expected).norm() < 1e-9, "{found} {expected}");
        }
        assert!((10..60).contains(&hidden), "{hidden}");
        let other = Channel { frequency_hz: 2e7, width_hz: 8e3 };
        assert_eq!(sky.signal(Pair { i: 0, j: 7 }, &other, 1e6, 1.0).visibility_k_sr, Complex64::ZERO);
    }
}
