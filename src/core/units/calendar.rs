//! Calendar dates without a time scale, by `chrono`; [`super::time_scales`] adds the scale.

use chrono::{DateTime, NaiveDate};

/// Days from 1958-01-01, the epoch of TAI, to 1970-01-01.
const DAYS_BEFORE_1970: i64 = 4_383;
const DAY_S: i64 = 86_400;
/// Time from the epoch of TAI to 1970-01-01T00:00:00, s.
pub const TAI_1970_S: f64 = (DAYS_BEFORE_1970 * DAY_S) as f64;

/// Formats seconds since 1958-01-01T00:00:00 as an ISO 8601 date and time, to the millisecond, on the same scale.
#[must_use]
pub fn tai_text(tai_s: f64) -> String {
    let ms = ((tai_s * 1e3).round() as i64).saturating_sub(1_000 * DAYS_BEFORE_1970 * DAY_S);
    formatted(DateTime::from_timestamp_millis(ms), "%Y-%m-%dT%H:%M:%S%.3f")
}

/// A calendar date and time of day on any scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct CalendarTime {
    /// Days from 1970-01-01.
    pub(super) day: i64,
    /// Whole seconds of the day, 0 to 86,400; the last is a leap second.
    pub(super) second: i64,
    /// Fraction of the second, 0 to less than 1.
    pub(super) part_s: f64,
}

impl CalendarTime {
    /// Parses `YYYY-MM-DDThh:mm:ss[.d]` or `YYYY-DDDThh:mm:ss[.d]`, with or without a Z; second 60 exists at 23:59 only.
    pub(super) fn parse(text: &str) -> Option<Self> {
        fn digits(text: &str, count: usize) -> Option<u32> {
            (text.len() == count && text.bytes().all(|b| b.is_ascii_digit())).then(|| text.parse().ok())?
        }
        let (date, clock) = text.strip_suffix('Z').unwrap_or(text).split_once('T')?;
        let parts: Vec<&str> = date.split('-').collect();
        let year = digits(parts.first()?, 4)?.cast_signed();
        let date = match parts[1..] {
            [month, day] => NaiveDate::from_ymd_opt(year, digits(month, 2)?, digits(day, 2)?)?,
            [day] => NaiveDate::from_yo_opt(year, digits(day, 3)?)?,
            _ => return None,
        };
        let clock: Vec<&str> = clock.split(':').collect();
        let [hour, minute, second] = clock[..] else { return None };
        let (hour, minute) = (digits(hour, 2)?, digits(minute, 2)?);
        let (whole, decimals) = second.split_once('.').unwrap_or((second, "0"));
        let whole = digits(whole, 2)?;
        let part_s: f64 = match decimals.bytes().all(|b| b.is_ascii_digit()) {
            true => format!("0.{decimals}").parse().ok()?,
            false => return None,
        };
        // A fraction of twenty nines would be rounded to 1.
        let part_s = part_s.min(1.0 - f64::EPSILON / 2.0);
        let is_leap = (hour, minute, whole) == (23, 59, 60);
        let is_valid = hour < 24 && minute < 60 && (whole < 60 || is_leap);
        is_valid.then(|| Self {
            day: date.signed_duration_since(NaiveDate::default()).num_days(),
            second: i64::from(hour * 3600 + minute * 60 + whole),
            part_s,
        })
    }

    /// Formats the date and time of day with this many decimals of a second.
    pub(super) fn text(self, decimals: usize) -> String {
        let Self { day, second, part_s } = self;
        let date = DateTime::from_timestamp(day.saturating_mul(DAY_S), 0);
        let Some(date) = date else { return "beyond the calendar".to_owned() };
        let (minutes, seconds) = if second < DAY_S { (second / 60, second % 60) } else { (24 * 60 - 1, 60) };
        let unit = 10f64.powi(decimals as i32);
        let fraction = (part_s * unit).round().min(unit - 1.0);
        let fraction = if decimals == 0 { String::new() } else { format!(".{fraction:0decimals$.0}") };
        format!("{}T{:02}:{:02}:{seconds:02}{fraction}", date.format("%Y-%m-%d"), minutes / 60, minutes % 60)
    }
}

fn formatted(time: Option<DateTime<chrono::Utc>>, pattern: &str) -> String {
    time.map_or_else(|| "beyond the calendar".to_owned(), |time| time.format(pattern).to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_agree_with_python() {
        // Made with Python: datetime(1958, 1, 1) + timedelta(seconds=s).
        for (s, text) in [
            (0.0, "1958-01-01T00:00:00.000"),
            (1_956_528_000.5, "2020-01-01T00:00:00.500"),
            (68_169_599.999_6, "1960-02-29T00:00:00.000"),
            (4_294_967_295.0, "2094-02-06T06:28:15.000"),
            (-1.0, "1957-12-31T23:59:59.000"),
        ] {
            assert_eq!(tai_text(s), text);
        }
    }

    #[test]
    fn dates_are_parsed_to_days_and_seconds() {
        // `date -u -d ... +%s`.
        for (date, expected) in [
            ("1970-01-01T00:00:00", 0.0),
            ("1969-12-31T23:59:59", -1.0),
            ("1968-12-31T00:00:00", -31_622_400.0),
            ("1901-01-01T00:00:00", -2_177_452_800.0),
            ("2000-01-01T12:00:00", 946_728_000.0),
            ("2024-02-29T23:59:59.5", 1_709_251_199.5),
            ("2024-060T23:59:59.5", 1_709_251_199.5),
            ("2030-12-31T00:00:00Z", 1_924_905_600.0),
            ("2030-365T00:00:00", 1_924_905_600.0),
            // A second 60 has the same number as the next midnight.
            ("2016-12-31T23:59:60.5", 1_483_228_800.5),
        ] {
            let CalendarTime { day, second, part_s } = CalendarTime::parse(date).unwrap();
            assert_eq!((day * DAY_S + second) as f64 + part_s, expected, "{date}");
        }
        for date in ["1960-12-31T12:00:00.000", "2024-02-29T23:59:59.500", "2016-12-31T23:59:60.250"] {
            assert_eq!(CalendarTime::parse(date).unwrap().text(3), date);
        }
        assert_eq!(CalendarTime::parse("2024-03-01T00:00:09.999").unwrap().text(0), "2024-03-01T00:00:09");
        for bad in [
            "",
            "2030-02-29T00:00:00",
            "2030-13-01T00:00:00",
            "2030-366T00:00:00",
            "2030-01-01",
            "2030-01-01T24:00:00",
            "2030-01-01T00:00:NaN",
            "2030-01-01T00:00:00.1e3",
            "2030-01-01T12:00:60",
            "30-01-01T00:00:00",
            "2030-01-01T0:00:00",
            "2030-1-1T00:00:00",
        ] {
            assert_eq!(CalendarTime::parse(bad), None, "{bad}");
        }
    }
}
