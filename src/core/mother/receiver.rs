//! Noise of the receivers, by channel.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, PerChannel};

/// Maximum number of points of a table of receiver noise.
const POINTS_MAX: usize = 1000;

/// Receiver noise T_rec / zeta, referred to the sky, K sr.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "expected one value, a list with one for each channel, or a table of [frequency_hz, k_sr]"
)]
pub enum ReceiverNoise {
    /// One value, or one for each channel.
    Channels(PerChannel<f64>),
    /// Points `[frequency_hz, k_sr]` at increasing frequencies, interpolated linearly in the logarithms of both.
    Table(Vec<[f64; 2]>),
}

impl Default for ReceiverNoise {
    fn default() -> Self {
        Self::Channels(PerChannel::All(0.0))
    }
}

impl ReceiverNoise {
    /// Noise of `channel` at its frequency, K sr; `None` if it is not specified.
    #[must_use]
    pub fn at(&self, channel: usize, frequency_hz: f64) -> Option<f64> {
        match self {
            Self::Channels(values) => values.get(channel),
            Self::Table(points) => {
                let upper = points.iter().position(|[hz, _]| frequency_hz <= *hz)?;
                let [high_hz, high_k_sr] = points[upper];
                if frequency_hz == high_hz {
                    return Some(high_k_sr);
                }
                let [low_hz, low_k_sr] = points[upper.checked_sub(1)?];
                let fraction = (frequency_hz / low_hz).ln() / (high_hz / low_hz).ln();
                Some(low_k_sr * (high_k_sr / low_k_sr).powf(fraction))
            }
        }
    }

    pub(super) fn check(&self, channels_hz: &[f64], checks: &mut Checks) {
        let key = "receiver_noise_k_sr";
        let points = match self {
            Self::Channels(values) => {
                check_channels(key, values, channels_hz.len(), checks);
                return;
            }
            Self::Table(points) => points,
        };
        let count = points.len();
        let is_accepted = (2..=POINTS_MAX).contains(&count);
        checks.require(key, format!("({count} points)"), is_accepted, format!("2 to {POINTS_MAX} points"));
        let is_positive =
            |[hz, k_sr]: &[f64; 2]| hz.is_finite() && k_sr.is_finite() && *hz > 0.0 && *k_sr > 0.0;
        if let Some(bad) = points.iter().position(|point| !is_positive(point)) {
            let expected = "[frequency, K sr], both above 0 as their logarithms are interpolated";
            checks.require(format!("{key}[{bad}]"), format!("{:?}", points[bad]), false, expected);
            return;
        }
        if let Some(preceding) = points.windows(2).position(|pair| pair[0][0] >= pair[1][0]) {
            let (bad, low_hz) = (preceding + 1, points[preceding][0]);
            let expected = format!("a frequency above that of the preceding point, {low_hz} Hz");
            checks.require(format!("{key}[{bad}]"), format!("{:?}", points[bad]), false, expected);
            return;
        }
        let [Some([low_hz, _]), Some([high_hz, _])] = [points.first(), points.last()] else { return };
        if let Some(outside) = channels_hz.iter().position(|hz| !(low_hz..=high_hz).contains(&hz)) {
            let expected = format!("a table that covers channels_hz[{outside}] = {}", channels_hz[outside]);
            checks.require(key, format!("({low_hz} Hz to {high_hz} Hz)"), false, expected);
        }
    }
}

/// Checks that there is one value, or one for each channel, and that none is negative.
pub(super) fn check_channels(key: &str, values: &PerChannel<f64>, channels: usize, checks: &mut Checks) {
    let expected = format!("a single value, or a list of one for each of the {channels} channels");
    checks.require(key, format!("({} values)", values.values().len()), values.fits(channels), expected);
    checks.numbers(key, values.values(), |k_sr| k_sr >= 0.0, "K sr, not negative");
}

/// Whether a number is 0. Keys that were added later are left out of hashes while they have no effect.
#[allow(clippy::trivially_copy_pass_by_ref)] // As serde calls it.
pub(super) fn is_zero(value: &f64) -> bool {
    *value == 0.0
}

/// Whether all channels have 0, see [`is_zero`].
pub(super) fn is_none(values: &PerChannel<f64>) -> bool {
    *values == PerChannel::All(0.0)
}

#[cfg(test)]
mod tests {
    use crate::mother::SpacecraftConfig;

    fn problems_of(lines: &str) -> Vec<String> {
        let config: SpacecraftConfig = toml::from_str(lines).unwrap();
        config.problems().iter().map(ToString::to_string).collect()
    }

    #[test]
    fn tables_are_interpolated_in_the_logarithms() {
        let table: SpacecraftConfig = toml::from_str(
            "channels_hz = [1e6, 2e6, 10e6, 17320508.0, 30e6]\nreceiver_noise_k_sr = [[1e6, 2e4], [10e6, 300], [30e6, 100.0]]",
        )
        .unwrap();
        assert_eq!(table.problems(), []);
        // 2e4 2^(log10 300 / 2e4) = 2e4 2^-1.823909; between 10 and 30 MHz it goes as 1 / nu, at 10 sqrt 3: 300 / sqrt 3.
        let expected = [2e4, 5649.0934, 300.0, 173.205_08, 100.0];
        for (found, expected) in table.receiver_k_sr().iter().zip(expected) {
            assert!((found / expected - 1.0).abs() < 1e-6, "{found} {expected}");
        }
    }

    #[test]
    fn the_knee_multiplies_the_receiver_and_the_floor_is_added() {
        let config: SpacecraftConfig = toml::from_str(
            "channels_hz = [1e6, 10e6]\nreceiver_noise_k_sr = [100.0, 40.0]\nreceiver_knee_hz = 2e6\n\
             interference_floor_k_sr = [7.0, 9.0]",
        )
        .unwrap();
        assert_eq!(config.problems(), []);
        assert_eq!(config.receiver_k_sr(), [307.0, 57.0]);
        let usual = SpacecraftConfig { channels_hz: vec![1e6, 10e6], ..SpacecraftConfig::default() };
        assert_eq!(usual.receiver_k_sr(), [0.0, 0.0]);
        // The provenance of data made before these keys existed does not change.
        let text = toml::to_string(&usual).unwrap();
        assert!(text.contains("receiver_noise_k_sr = 0.0\n"), "{text}");
        assert!(
            !text.contains("knee")
                && !text.contains("floor")
                && !text.contains("moon_temperature")
                && !text.contains("mirror"),
            "{text}"
        );
    }

    #[test]
    fn invalid_noise_is_refused_with_its_key() {
        for (line, expected) in [
            ("receiver_noise_k_sr = -1.0", "receiver_noise_k_sr = -1: expected K sr, not negative"),
            (
                "receiver_noise_k_sr = []",
                "receiver_noise_k_sr = (0 values): expected a single value, or a list of one for each of the 2",
            ),
            (
                "receiver_noise_k_sr = [1.0]",
                "receiver_noise_k_sr = (1 values): expected a single value, or a list of one for each",
            ),
            (
                "receiver_noise_k_sr = [[1e6, 2e4]]",
                "receiver_noise_k_sr = (1 points): expected 2 to 1000 points",
            ),
            (
                "receiver_noise_k_sr = [[1e6, 2e4], [30e6, 0.0]]",
                "receiver_noise_k_sr[1] = [30000000.0, 0.0]: expected [frequency, K sr], both above 0",
            ),
            (
                "receiver_noise_k_sr = [[30e6, 1.0], [1e6, 2.0]]",
                "receiver_noise_k_sr[1] = [1000000.0, 2.0]: expected a frequency above that of the preceding point, 30000000 Hz",
            ),
            (
                "receiver_noise_k_sr = [[1e6, 2e4], [9e6, 1.0]]",
                "receiver_noise_k_sr = (1000000 Hz to 9000000 Hz): expected a table that covers channels_hz[1] = 10000000",
            ),
            ("receiver_noise_k_sr = 1e16", "receiver_noise_k_sr = 1e16: expected at most 1e10 K sr"),
            (
                "receiver_noise_k_sr = 1e3\nreceiver_knee_hz = 1e300",
                // 1e3 * 1e300 / 5e6, whose last digits are rounded.
                "receiver_noise_k_sr = 2",
            ),
            ("interference_floor_k_sr = 1e11", "receiver_noise_k_sr = 100000000000: expected at most"),
            ("receiver_knee_hz = -1.0", "receiver_knee_hz = -1: expected Hz, or 0"),
            (
                "interference_floor_k_sr = [1.0]",
                "interference_floor_k_sr = (1 values): expected a single value",
            ),
            ("interference_floor_k_sr = inf", "interference_floor_k_sr = inf: expected K sr, not negative"),
        ] {
            let found = problems_of(&format!("channels_hz = [5e6, 10e6]\n{line}"));
            let expected = format!("spacecraft.{expected}");
            assert!(found.iter().any(|text| text.starts_with(&expected)), "{line}: {found:?}");
        }
        let table = "channels_hz = [10e6, 1e6]\nreceiver_noise_k_sr = [[9e6, 2e4], [30e6, 1.0]]";
        assert!(problems_of(table)[0].contains("covers channels_hz[1] = 1000000"));
    }
}
