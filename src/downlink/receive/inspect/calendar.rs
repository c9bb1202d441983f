//! Dates of TAI seconds since 1958.

const DAY_S: i64 = 86_400;

/// The ISO 8601 date and time of day, to the millisecond, of TAI seconds since 1958-01-01T00:00:00.
///
/// Gregorian calendar by Hinnant's algorithm (civil from days, in eras of 400 years that begin in March).
#[must_use]
pub fn tai_text(tai_s: f64) -> String {
    let ms = (tai_s * 1e3).round() as i64;
    let (s, ms) = (ms.div_euclid(1_000), ms.rem_euclid(1_000));
    let (day, s) = (s.div_euclid(DAY_S), s.rem_euclid(DAY_S));
    // 1958-01-01 is 715 085 days after 0000-03-01.
    let day = day + 715_085;
    let (era, day) = (day.div_euclid(146_097), day.rem_euclid(146_097));
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let january = i64::from(month >= 10);
    let (year, month) = (400 * era + year + january, month + 3 - 12 * january);
    let (hour, minute, second) = (s / 3_600, s / 60 % 60, s % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{ms:03}")
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
}
