//! Numbers with units, such as `3MHz`, `30d` or `10km`: one parser for arguments and pipeline files.

use super::constants::DAY_S;

/// The dimension of a number, with the unit in which its values are held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dimension {
    /// Hz.
    Frequency,
    /// s.
    Time,
    /// ns, for clock errors and the like.
    ShortTime,
    /// m.
    Length,
    /// Degrees.
    Angle,
}

/// Magnitudes of numbers that are written without a power of ten.
const PLAIN_RANGE: std::ops::Range<f64> = 1e-3..1e9;

/// Units of frequency, each with its size in Hz. A name stands before the names it ends with, here and below.
const FREQUENCIES: [(&str, f64); 4] = [("GHz", 1e9), ("MHz", 1e6), ("kHz", 1e3), ("Hz", 1.0)];
const TIMES: [(&str, f64); 7] = [
    ("min", 60.0),
    ("ms", 1e-3),
    ("us", 1e-6),
    ("yr", 365.25 * DAY_S),
    ("s", 1.0),
    ("h", 3600.0),
    ("d", DAY_S),
];
const SHORT_TIMES: [(&str, f64); 4] = [("ns", 1.0), ("us", 1e3), ("ms", 1e6), ("s", 1e9)];
const LENGTHS: [(&str, f64); 2] = [("km", 1e3), ("m", 1.0)];
const ANGLES: [(&str, f64); 3] = [("arcmin", 1.0 / 60.0), ("arcsec", 1.0 / 3600.0), ("deg", 1.0)];

impl Dimension {
    /// The dimension of a key, by the unit that ends its name (before `_max` or `_min`), as in `channels_hz` or `window_s_max`. `None` for
    /// other units and for quotients such as `_m_s`.
    #[must_use]
    pub fn from_key(key: &str) -> Option<Self> {
        let name = key.rsplit('.').next().unwrap_or(key);
        let name = name.strip_suffix("_max").or_else(|| name.strip_suffix("_min")).unwrap_or(name);
        let (stem, unit) = name.rsplit_once('_')?;
        let dimension = match unit {
            "hz" => Self::Frequency,
            "s" => Self::Time,
            "ns" => Self::ShortTime,
            "m" => Self::Length,
            "deg" => Self::Angle,
            _ => return None,
        };
        // As in bits_per_s or km_s.
        let is_quotient =
            ["per", "m", "km", "deg", "k", "s"].contains(&stem.rsplit('_').next().unwrap_or(stem));
        (!is_quotient).then_some(dimension)
    }

    fn units(self) -> &'static [(&'static str, f64)] {
        match self {
            Self::Frequency => &FREQUENCIES,
            Self::Time => &TIMES,
            Self::ShortTime => &SHORT_TIMES,
            Self::Length => &LENGTHS,
            Self::Angle => &ANGLES,
        }
    }

    /// Describes what [`Dimension::parse`] accepts, for messages.
    #[must_use]
    pub fn expected(self) -> &'static str {
        match self {
            Self::Frequency => "a number of Hz, or one with Hz, kHz, MHz or GHz, such as 3MHz",
            Self::Time => "a number of seconds, or one with us, ms, s, min, h, d or yr, such as 90s or 7d",
            Self::ShortTime => "a number of nanoseconds, or one with ns, us, ms or s, such as 30ns",
            Self::Length => "a number of metres, or one with m or km, such as 10km",
            Self::Angle => "a number of degrees, or one with deg, arcmin or arcsec",
        }
    }

    /// Formats a value in the largest unit that does not exceed it and loses no digit.
    #[must_use]
    pub fn show(self, value: f64) -> String {
        let plain = |number: f64, unit: &str| match PLAIN_RANGE.contains(&number.abs()) || number == 0.0 {
            true => format!("{number} {unit}"),
            false => format!("{number:e} {unit}"),
        };
        // These units are accepted only; a mission is counted in days.
        let shown = self.units().iter().filter(|(unit, _)| !["yr", "h", "min"].contains(unit));
        let fitting = shown.filter(|(_, size)| value.abs() >= *size && (value / size) * size == value);
        let (unit, size) = fitting.max_by(|a, b| a.1.total_cmp(&b.1)).copied().unwrap_or(self.base());
        plain(value / size, unit)
    }

    /// The unit in which values are held.
    fn base(self) -> (&'static str, f64) {
        let unit = self.units().iter().find(|(_, size)| *size == 1.0);
        unit.copied().unwrap_or_default()
    }

    /// Parses a text to a value in the unit of this dimension; a number without a unit is in that unit.
    ///
    /// # Errors
    /// A message that says what was expected, if the text is not a finite number with one of the units.
    pub fn parse(self, text: &str) -> Result<f64, String> {
        let text = text.trim();
        let found = self.units().iter().find_map(|(unit, size)| Some((text.strip_suffix(unit)?, *size)));
        let (number, size) = found.unwrap_or((text, 1.0));
        let plain = number.trim();
        // Rust would parse words such as `inf` and `nan` as numbers.
        let is_number = plain.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
        match plain.replace('_', "").parse::<f64>() {
            Ok(value) if is_number && (value * size).is_finite() => Ok(value * size),
            _ => Err(format!("expected {}", self.expected())),
        }
    }
}

/// A number of bytes as text, in the unit that suits it.
#[must_use]
pub fn bytes_text(bytes: f64) -> String {
    match bytes {
        1e8.. => format!("{:.2} GB", bytes / 1e9),
        1e5.. => format!("{:.1} MB", bytes / 1e6),
        _ => format!("{bytes:.0} bytes"),
    }
}

/// The name of the folder of products of a frequency, in MHz to the kHz.
#[must_use]
pub fn frequency_folder(frequency_hz: f64) -> String {
    format!("{:.3}MHz", frequency_hz / 1e6)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_units() {
        for (dimension, text, expected) in [
            (Dimension::Frequency, "3MHz", 3e6),
            (Dimension::Frequency, " 8.5 kHz", 8500.0),
            (Dimension::Frequency, "30e6", 30e6),
            (Dimension::Time, "30d", 2_592_000.0),
            (Dimension::Time, "1.5 h", 5400.0),
            (Dimension::Time, "-90s", -90.0),
            (Dimension::Time, "2min", 120.0),
            (Dimension::Time, "5ms", 5e-3),
            (Dimension::ShortTime, "1us", 1e3),
            (Dimension::ShortTime, "30 ns", 30.0),
            (Dimension::ShortTime, "2.5", 2.5),
            (Dimension::Length, "10km", 1e4),
            (Dimension::Length, "1_737_100 m", 1_737_100.0),
            (Dimension::Angle, "30arcmin", 0.5),
        ] {
            assert_eq!(dimension.parse(text), Ok(expected), "{text}");
        }
        for (dimension, text) in [
            (Dimension::Frequency, "3mhz"),
            (Dimension::Frequency, "3m"),
            (Dimension::Time, ""),
            (Dimension::Time, "d"),
            (Dimension::Time, "infd"),
            (Dimension::Time, "nan"),
            (Dimension::Time, "7w"),
            (Dimension::ShortTime, "1h"),
            (Dimension::Length, "1e308km"),
            (Dimension::Length, "3 feet"),
        ] {
            assert!(dimension.parse(text).is_err(), "{text}");
        }
    }

    #[test]
    fn values_are_shown_with_their_unit_and_read_again() {
        for (dimension, value, expected) in [
            (Dimension::Frequency, 3e6, "3 MHz"),
            (Dimension::Frequency, 8500.0, "8.5 kHz"),
            (Dimension::Frequency, 0.1, "0.1 Hz"),
            (Dimension::Frequency, 0.0, "0 Hz"),
            (Dimension::Frequency, 1e12, "1000 GHz"),
            (Dimension::Frequency, f64::NAN, "NaN Hz"),
            (Dimension::Time, 2_592_000.0, "30 d"),
            (Dimension::Time, 90.0, "90 s"),
            (Dimension::Length, 300.0, "300 m"),
            (Dimension::Length, -300e3, "-300 km"),
            (Dimension::Length, 1e300, "1e297 km"),
            (Dimension::Angle, 0.5, "30 arcmin"),
            (Dimension::Angle, 30.0, "30 deg"),
            (Dimension::ShortTime, 30e3, "30 us"),
        ] {
            assert_eq!(dimension.show(value), expected);
        }
        // No digit is lost: 0.1 MHz and its neighbours.
        for value in [1e5_f64.next_up(), 1e5, 1e5_f64.next_down(), 2.1e6, 1.0 / 3.0, 1e6 / 3.0] {
            assert_eq!(Dimension::Frequency.parse(&Dimension::Frequency.show(value)), Ok(value), "{value}");
        }
    }

    #[test]
    fn keys_say_what_they_measure() {
        for (key, expected) in [
            ("spacecraft.channels_hz", Some(Dimension::Frequency)),
            ("spacecraft.window_s_max", Some(Dimension::Time)),
            ("calibrate.clock_sigma_ns", Some(Dimension::ShortTime)),
            ("array.altitude_m", Some(Dimension::Length)),
            ("map.limits.altitude_m_max", Some(Dimension::Length)),
            ("array.inclination_deg", Some(Dimension::Angle)),
            ("daughters.link_bits_per_s_max", None),
            ("map.nside", None),
            ("map.prior_k", None),
        ] {
            assert_eq!(Dimension::from_key(key), expected, "{key}");
        }
    }
}
