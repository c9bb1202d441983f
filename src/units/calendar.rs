//! Dates of scales without leap seconds (TAI, TDB, system time), by the calendar of `chrono`.

use chrono::{DateTime, NaiveDate};

/// Days from 1958-01-01, with which TAI begins, to 1970-01-01.
const DAYS_BEFORE_1970: i64 = 4_383;
const DAY_S: i64 = 86_400;
/// From the beginning of TAI to 1970-01-01T00:00:00, s.
pub const TAI_1970_S: f64 = (DAYS_BEFORE_1970 * DAY_S) as f64;

/// The ISO 8601 date and time of day, to the millisecond, of TAI seconds since 1958-01-01T00:00:00.
#[must_use]
pub fn tai_text(tai_s: f64) -> String {
    let ms = ((tai_s * 1e3).round() as i64).saturating_sub(1_000 * DAYS_BEFORE_1970 * DAY_S);
    written(DateTime::from_timestamp_millis(ms), "%Y-%m-%dT%H:%M:%S%.3f")
}

/// The date and time of day, to the microsecond, of seconds from 1970-01-01T00:00:00.
#[must_use]
pub fn epoch_text(from_1970_s: f64) -> String {
    let whole = from_1970_s.floor();
    let micros = ((from_1970_s - whole) * 1e6).round() as i64;
    let all = (whole as i64).saturating_mul(1_000_000).saturating_add(micros);
    written(DateTime::from_timestamp_micros(all), "%Y-%m-%dT%H:%M:%S%.6f")
}

fn written(time: Option<DateTime<chrono::Utc>>, pattern: &str) -> String {
    time.map_or_else(|| "beyond the calendar".to_owned(), |time| time.format(pattern).to_string())
}

/// Seconds from 1970-01-01T00:00:00 of an epoch `YYYY-MM-DDThh:mm:ss[.d]` or `YYYY-DDDThh:mm:ss[.d]`; a second may be a leap second's.
#[must_use]
pub fn epoch_s(epoch: &str) -> Option<f64> {
    fn digits(text: &str, count: usize) -> Option<u32> {
        (text.len() == count && text.bytes().all(|b| b.is_ascii_digit())).then(|| text.parse().ok())?
    }
    let (date, clock) = epoch.trim_end_matches('Z').split_once('T')?;
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
    let (whole, _) = second.split_once('.').unwrap_or((second, ""));
    digits(whole, 2)?;
    let second: f64 = second.parse().ok()?;
    let days = date.signed_duration_since(NaiveDate::default()).num_days();
    let good = hour < 24 && minute < 60 && second < 61.0;
    good.then(|| (days * DAY_S) as f64 + f64::from(hour * 3600 + minute * 60) + second)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
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
    fn epochs_are_seconds_of_the_calendar() {
        // `date -u -d ... +%s`.
        for (epoch, expected) in [
            ("1970-01-01T00:00:00", 0.0),
            ("2000-01-01T12:00:00", 946_728_000.0),
            ("2024-02-29T23:59:59.5", 1_709_251_199.5),
            ("2024-060T23:59:59.5", 1_709_251_199.5),
            ("2030-12-31T00:00:00Z", 1_924_905_600.0),
            ("2030-365T00:00:00", 1_924_905_600.0),
        ] {
            assert_eq!(epoch_s(epoch), Some(expected), "{epoch}");
        }
        for (expected, seconds) in [
            ("1970-01-01T00:00:00.000000", 0.0),
            ("1969-12-31T23:59:59.000000", -1.0),
            // `date -u -d 1968-12-31 +%s`, and so on.
            ("1968-12-31T00:00:00.000000", -31_622_400.0),
            ("1960-12-31T12:00:00.000000", -284_040_000.0),
            ("1901-01-01T00:00:00.000000", -2_177_452_800.0),
            ("2000-01-01T12:00:00.000000", 946_728_000.0),
            ("2024-02-29T23:59:59.500000", 1_709_251_199.5),
            ("2024-03-01T00:00:00.000000", 1_709_251_199.999_999_8),
            ("2030-12-31T00:00:00.000000", 1_924_905_600.0),
        ] {
            assert_eq!(epoch_text(seconds), expected);
        }
        for bad in [
            "",
            "2030-02-29T00:00:00",
            "2030-13-01T00:00:00",
            "2030-366T00:00:00",
            "2030-01-01",
            "2030-01-01T24:00:00",
            "2030-01-01T00:00:NaN",
            "30-01-01T00:00:00",
            "2030-01-01T0:00:00",
            "2030-1-1T00:00:00",
        ] {
            assert_eq!(epoch_s(bad), None, "{bad}");
        }
    }
}
