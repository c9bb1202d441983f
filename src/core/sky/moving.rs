//! Sources that move and change with time: bursts of the Sun, and points of one's own with a light curve.

use std::f64::consts::TAU;

use serde::{Deserialize, Serialize};

use crate::units::constants::{BOLTZMANN_J_K, SPEED_OF_LIGHT_M_S};
use crate::units::vector::Vec3;
use crate::units::{Checks, InvalidValue};

/// One jansky, W m^-2 Hz^-1.
const JANSKY: f64 = 1e-26;

/// Decay times after which a burst has ended: 2e-9 of its peak is left.
const DECAYS: f64 = 20.0;

/// Index of the delay by frequency: integral of the drift rate of type III bursts, df/dt ~ f^1.84 (Alvarez and Haddock 1973).
const DRIFT_INDEX: f64 = 0.84;

/// Maximum length of any time of a burst, s.
const TIME_S_MAX: f64 = 1e6;

/// Direction of a moving source.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum MovingDirection {
    /// A body whose direction follows from the date.
    Body(Body),
    /// Fixed ecliptic longitude and latitude, deg.
    Fixed([f64; 2]),
}

/// Bodies with a known direction by date.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, bincode::Encode, bincode::Decode)]
#[serde(rename_all = "kebab-case")]
pub enum Body {
    /// The Sun.
    Sun,
    /// Jupiter.
    Jupiter,
}

impl Body {
    /// Its name in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Sun => "sun",
            Self::Jupiter => "jupiter",
        }
    }
}

/// A point source with steady flux, bursts or both (`[[sky.moving]]`); all bursts have the same light curve: a linear rise, then an exponential decay.
///
/// At frequency f the flux density scales as f^spectral_index, the rise and the decay as f^-duration_index, and a burst is late by
/// `drift_s ((f / reference_hz)^-0.84 - 1)`. The defaults are those of a solar type III burst: the drift rate is 0.01 f^1.84 MHz/s
/// with f in MHz (Alvarez and Haddock 1973), the decay 10^7.71 f^-0.95 s with f in Hz (Evans et al. 1973).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MovingSource {
    /// `"sun"`, `"jupiter"`, or ecliptic longitude and latitude in degrees.
    pub direction: MovingDirection,
    /// Steady flux density at the reference frequency, Jy.
    #[serde(default)]
    pub steady_jy: f64,
    /// Starts of the bursts at the reference frequency, s after the mission's epoch.
    #[serde(default)]
    pub starts_s: Vec<f64>,
    /// Flux density at the peak of bursts, at the reference frequency, Jy.
    #[serde(default)]
    pub peak_jy: f64,
    /// Reference frequency, Hz.
    #[serde(default = "reference_hz")]
    pub reference_hz: f64,
    /// Spectral index of the flux density.
    #[serde(default)]
    pub spectral_index: f64,
    /// Time from the start to the peak, s.
    #[serde(default = "rise_s")]
    pub rise_s: f64,
    /// Time after the peak in which the flux density falls by a factor e, s.
    #[serde(default = "decay_s")]
    pub decay_s: f64,
    /// Index by which rise and decay shorten with frequency.
    #[serde(default = "duration_index")]
    pub duration_index: f64,
    /// Scale of the delay by frequency, s.
    #[serde(default = "drift_s")]
    pub drift_s: f64,
}

fn reference_hz() -> f64 {
    1e7
}

fn rise_s() -> f64 {
    5.0
}

fn decay_s() -> f64 {
    11.5
}

fn duration_index() -> f64 {
    0.95
}

/// The integral of the drift rate from 10 MHz to infinity: 10^-0.84 / (0.01 * 0.84) s.
fn drift_s() -> f64 {
    17.2
}

impl MovingSource {
    /// Mean flux density at a frequency between two times, Jy, since bursts are shorter than integrations.
    #[must_use]
    pub fn mean_flux_jy(&self, frequency_hz: f64, [from_s, until_s]: [f64; 2]) -> f64 {
        let [rise_s, decay_s] = self.times_s(frequency_hz);
        // Integral of a burst of 1 Jy to a time after its start, Jy s.
        let until = |after_s: f64| {
            let [rising_s, falling_s] =
                [after_s.clamp(0.0, rise_s), (after_s - rise_s).clamp(0.0, DECAYS * decay_s)];
            let risen = if rise_s > 0.0 { 0.5 * rising_s * rising_s / rise_s } else { 0.0 };
            let fallen = if decay_s > 0.0 { -decay_s * (-falling_s / decay_s).exp_m1() } else { 0.0 };
            risen + fallen
        };
        let delay_s = self.delay_s(frequency_hz);
        let of_burst = |start_s: &f64| {
            let begin_s = start_s + delay_s;
            until(until_s - begin_s) - until(from_s - begin_s)
        };
        let total: f64 = self.starts_s.iter().map(of_burst).sum();
        self.factor(frequency_hz) * (self.steady_jy + self.peak_jy * total / (until_s - from_s))
    }

    /// Whether it has flux at a frequency between two times.
    #[must_use]
    pub fn is_on(&self, frequency_hz: f64, [from_s, until_s]: [f64; 2]) -> bool {
        let [rise_s, decay_s] = self.times_s(frequency_hz);
        let begins_s = self.starts_s.iter().map(|start_s| start_s + self.delay_s(frequency_hz));
        self.steady_jy > 0.0
            || begins_s
                .into_iter()
                .any(|begin_s| begin_s < until_s && from_s < begin_s + rise_s + DECAYS * decay_s)
    }

    /// Delay of the start at a frequency after that at the reference frequency, s.
    #[must_use]
    pub fn delay_s(&self, frequency_hz: f64) -> f64 {
        self.drift_s * ((frequency_hz / self.reference_hz).powf(-DRIFT_INDEX) - 1.0)
    }

    /// Rise and decay times at a frequency, s.
    #[must_use]
    pub fn times_s(&self, frequency_hz: f64) -> [f64; 2] {
        let factor = (frequency_hz / self.reference_hz).powf(-self.duration_index);
        [factor * self.rise_s, factor * self.decay_s]
    }

    /// Flux density at the peak at a frequency, Jy.
    #[must_use]
    pub fn peak_at_jy(&self, frequency_hz: f64) -> f64 {
        self.peak_jy * self.factor(frequency_hz)
    }

    /// Flux density at a frequency in units of that at the reference frequency.
    fn factor(&self, frequency_hz: f64) -> f64 {
        (frequency_hz / self.reference_hz).powf(self.spectral_index)
    }

    /// Lists the problems of source `index` of the list.
    #[must_use]
    pub fn problems(&self, index: usize) -> Vec<InvalidValue> {
        let mut checks = Checks::new("sky");
        let key = |name: &str| format!("moving[{index}].{name}");
        if let MovingDirection::Fixed([longitude, latitude]) = self.direction {
            let good = longitude.is_finite() && (-90.0..=90.0).contains(&latitude);
            let expected = "\"sun\", \"jupiter\", or ecliptic longitude and latitude, -90 to 90 degrees";
            checks.require(key("direction"), format!("[{longitude}, {latitude}]"), good, expected);
        }
        let is_time = |s: f64| s.abs() <= 1e10;
        checks.numbers(key("starts_s"), &self.starts_s, is_time, "times after the epoch, s");
        for (name, value) in [("steady_jy", self.steady_jy), ("peak_jy", self.peak_jy)] {
            checks.number(key(name), value, (0.0..=1e15).contains(&value), "0 to 1e15 Jy");
        }
        let (has_starts, has_peak) = (!self.starts_s.is_empty(), self.peak_jy > 0.0);
        let says_what = has_starts == has_peak && (has_peak || self.steady_jy > 0.0);
        let given = format!(
            "{} Jy with {} starts_s and steady_jy = {}",
            self.peak_jy,
            self.starts_s.len(),
            self.steady_jy
        );
        checks.require(
            key("peak_jy"),
            given,
            says_what,
            "steady_jy, or starts_s and peak_jy of bursts, or both",
        );
        let hz = self.reference_hz;
        checks.number(key("reference_hz"), hz, (1e3..=1e10).contains(&hz), "1 kHz to 10 GHz");
        for (name, value) in
            [("spectral_index", self.spectral_index), ("duration_index", self.duration_index)]
        {
            checks.number(key(name), value, value.abs() <= 5.0, "-5 to 5");
        }
        for (name, value) in [("rise_s", self.rise_s), ("decay_s", self.decay_s), ("drift_s", self.drift_s)] {
            checks.number(key(name), value, (0.0..=TIME_S_MAX).contains(&value), "0 to 1e6 s");
        }
        checks.finish()
    }
}

/// Temperature times solid angle of a point source of 1 Jy, K sr: S = 2 k T nu^2 / c^2 dOmega.
#[must_use]
pub fn k_sr_per_jy(frequency_hz: f64) -> f64 {
    let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
    JANSKY * wavelength_m * wavelength_m / (2.0 * BOLTZMANN_J_K)
}

/// Ecliptic longitude (0 to 360) and latitude of a unit vector, degrees.
#[must_use]
pub fn ecliptic_deg([x, y, z]: Vec3) -> [f64; 2] {
    [y.atan2(x).rem_euclid(TAU).to_degrees(), z.clamp(-1.0, 1.0).asin().to_degrees()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::direction;

    fn burst(text: &str) -> MovingSource {
        toml::from_str(&format!("direction = 'sun'\nstarts_s = [100.0]\npeak_jy = 1e8\n{text}")).unwrap()
    }

    #[test]
    fn integrations_have_the_mean_of_a_burst() {
        let burst = burst("");
        let mean = |from_s, until_s| burst.mean_flux_jy(1e7, [from_s, until_s]) / 1e8;
        // Rise of 5 s, then exp(-t / 11.5 s); a whole burst is 2.5 + 11.5 s at its peak.
        let cases = [
            (mean(0.0, 100.0), 0.0),
            (mean(90.0, 102.0), 0.4 / 12.0),
            (mean(102.0, 105.0), 2.1 / 3.0),
            (mean(100.0, 125.0), (2.5 + 11.5 * (1.0 - (-20.0_f64 / 11.5).exp())) / 25.0),
            (mean(0.0, 1000.0), 0.014),
            (mean(1000.0, 2000.0), 0.0),
        ];
        for (found, expected) in cases {
            // Without what is left after 20 decay times, 2e-9.
            assert!((found - expected).abs() < 1e-9, "{found} {expected}");
        }
    }

    #[test]
    fn steady_sources_have_flux_at_all_times() {
        let text = "direction = 'jupiter'\nsteady_jy = 200.0\nspectral_index = -2.0";
        let steady: MovingSource = toml::from_str(text).unwrap();
        assert!(steady.is_on(5e6, [-1e6, -9e5]) && steady.problems(0).is_empty());
        // Twice the wavelength of the reference frequency, 10 MHz.
        assert!((steady.mean_flux_jy(5e6, [3.0, 4.0]) - 800.0).abs() < 1e-9);
    }

    #[test]
    fn a_burst_of_1e8_jy_at_10_mhz_is_seven_times_the_sky() {
        // 1e-18 W m^-2 Hz^-1 (29.979 m)^2 / (2 * 1.380649e-23 J/K).
        assert!((1e8 * k_sr_per_jy(1e7) / 3.2548e7 - 1.0).abs() < 1e-4);
    }

    #[test]
    fn light_curves_rise_decay_and_drift_as_published() {
        let burst = burst("");
        // Over 2 ms, in which it changes by less than 1e-3 of its peak.
        let flux = |mhz: f64, t_s: f64| burst.mean_flux_jy(1e6 * mhz, [t_s - 1e-3, t_s + 1e-3]);
        for (t_s, expected_jy) in [(99.9, 0.0), (102.5, 5e7), (105.0, 1e8), (116.5, 1e8 * (-1.0_f64).exp())] {
            assert!((flux(10.0, t_s) - expected_jy).abs() < 1e5, "{t_s}");
        }
        // Time from 10 to 1 MHz at 0.01 f^1.84 MHz/s: (1 - 10^-0.84) / 0.0084 s. The constant is rounded to 0.3 %.
        let late_s = (1.0 - 10.0_f64.powf(-0.84)) / 0.0084;
        assert!((burst.delay_s(1e6) / late_s - 1.0).abs() < 5e-3, "{} {late_s}", burst.delay_s(1e6));
        // Decay at 1 MHz: 10^7.71 10^(-6 * 0.95) = 10^2.01 s; rounded at 10 MHz to 0.4 %.
        assert!((burst.times_s(1e6)[1] / 10.0_f64.powf(2.01) - 1.0).abs() < 5e-3);
        assert_eq!(flux(1.0, 99.99 + burst.delay_s(1e6)), 0.0);
        assert!(flux(1.0, 100.01 + burst.delay_s(1e6)) > 0.0);
        assert!(burst.is_on(1e6, [300.0, 301.0]) && !burst.is_on(1e6, [0.0, 101.0]));
        assert_eq!(flux(10.0, 1e4), 0.0);
    }

    #[test]
    fn wrong_values_are_named() {
        let wrong = burst("decay_s = -1\nspectral_index = 9.0");
        let texts: Vec<String> = wrong.problems(2).iter().map(ToString::to_string).collect();
        assert_eq!(
            texts,
            [
                "sky.moving[2].spectral_index = 9: expected -5 to 5",
                "sky.moving[2].decay_s = -1: expected 0 to 1e6 s"
            ]
        );
        assert!(burst("").problems(0).is_empty());
        // Bursts without a flux density or without times, and a source without either.
        for given in ["starts_s = [9.0]", "peak_jy = 1e8", "steady_jy = 3.0\nstarts_s = [9.0]", ""] {
            let source: MovingSource = toml::from_str(&format!("direction = 'sun'\n{given}")).unwrap();
            let [problem] = &source.problems(0)[..] else { panic!("{given}") };
            assert!(problem.to_string().contains("expected steady_jy, or starts_s and peak_jy"), "{problem}");
        }
        assert!(toml::from_str::<MovingSource>("direction = 'mars'\nstarts_s = []\npeak_jy = 1").is_err());
    }

    #[test]
    fn directions_survive_both_ways() {
        for deg in [[0.0, 0.0], [123.0, -45.0], [359.0, 89.0]] {
            let found = ecliptic_deg(direction(deg[0], deg[1]));
            assert!((found[0] - deg[0]).abs() < 1e-9 && (found[1] - deg[1]).abs() < 1e-9, "{found:?}");
        }
    }
}
