//! Time scales. Times are held in TAI, which has no leap seconds; dates are read and written in UTC, TAI, TT, TDB and GPS.
//!
//! Mission time counts seconds of TAI, and so does the packets' time code.

use std::fmt;

use super::calendar::{CalendarTime, TAI_1970_S};

const DAY_S: i64 = 86_400;

/// TT minus TAI, s (IAU 1991, exact).
const TT_MINUS_TAI_S: f64 = 32.184;

/// TAI minus GPS time, s.
const TAI_MINUS_GPS_S: f64 = 19.0;

/// Calendar time from 1970-01-01 to J2000 (2000-01-01T12:00:00), s.
const J2000_1970_S: f64 = 946_728_000.0;

/// One Julian century, s.
const CENTURY_S: f64 = 36_525.0 * 86_400.0;

/// Each change of TAI - UTC: the day since 1970-01-01 at whose start it takes effect, and the new difference, s (IERS Bulletin C;
/// `leap-seconds.list` as of November 2026 announces no later one).
const LEAP_SECONDS: [(i64, i64); 28] = [
    (730, 10),    // 1972-01-01
    (912, 11),    // 1972-07-01
    (1_096, 12),  // 1973-01-01
    (1_461, 13),  // 1974-01-01
    (1_826, 14),  // 1975-01-01
    (2_191, 15),  // 1976-01-01
    (2_557, 16),  // 1977-01-01
    (2_922, 17),  // 1978-01-01
    (3_287, 18),  // 1979-01-01
    (3_652, 19),  // 1980-01-01
    (4_199, 20),  // 1981-07-01
    (4_564, 21),  // 1982-07-01
    (4_929, 22),  // 1983-07-01
    (5_660, 23),  // 1985-07-01
    (6_574, 24),  // 1988-01-01
    (7_305, 25),  // 1990-01-01
    (7_670, 26),  // 1991-01-01
    (8_217, 27),  // 1992-07-01
    (8_582, 28),  // 1993-07-01
    (8_947, 29),  // 1994-07-01
    (9_496, 30),  // 1996-01-01
    (10_043, 31), // 1997-07-01
    (10_592, 32), // 1999-01-01
    (13_149, 33), // 2006-01-01
    (14_245, 34), // 2009-01-01
    (15_522, 35), // 2012-07-01
    (16_617, 36), // 2015-07-01
    (17_167, 37), // 2017-01-01
];

/// A time scale of dates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TimeScale {
    /// Coordinated universal time, with leap seconds, from 1972 on.
    Utc,
    /// International atomic time.
    Tai,
    /// Terrestrial time.
    Tt,
    /// Barycentric dynamical time.
    Tdb,
    /// GPS time.
    Gps,
}

impl TimeScale {
    /// The scale with a name such as `UTC`.
    #[must_use]
    pub fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "UTC" => Self::Utc,
            "TAI" => Self::Tai,
            "TT" => Self::Tt,
            "TDB" => Self::Tdb,
            "GPS" => Self::Gps,
            _ => return None,
        })
    }
}

impl fmt::Display for TimeScale {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Utc => "UTC",
            Self::Tai => "TAI",
            Self::Tt => "TT",
            Self::Tdb => "TDB",
            Self::Gps => "GPS",
        })
    }
}

/// A time on TAI, to a nanosecond or better.
#[derive(Clone, Copy, Debug, PartialEq, PartialOrd)]
pub struct Tai {
    /// Whole seconds since 1970-01-01T00:00:00 TAI, as an integer that loses no digit.
    whole_s: i64,
    /// Fraction of the second, 0 to less than 1.
    part_s: f64,
}

impl Tai {
    /// The time `tai_s` seconds after 1958-01-01T00:00:00 TAI.
    #[must_use]
    pub fn from_seconds_since_1958(tai_s: f64) -> Self {
        Self::normalised(-(TAI_1970_S as i64), tai_s)
    }

    fn normalised(whole_s: i64, part_s: f64) -> Self {
        let carry_s = part_s.floor();
        Self { whole_s: whole_s.saturating_add(carry_s as i64), part_s: part_s - carry_s }
    }

    /// Parses a date on a scale, such as 2030-01-31T12:00:00.5 or 2030-031T12:00:00. `None` for other text, for a second 60 where there is no
    /// leap second, and for UTC before 1972.
    #[must_use]
    pub fn parse(date: &str, scale: TimeScale) -> Option<Self> {
        let CalendarTime { day, second, part_s } = CalendarTime::parse(date)?;
        let is_leap = second == DAY_S;
        if is_leap
            && !(scale == TimeScale::Utc && LEAP_SECONDS.iter().skip(1).any(|(first, _)| *first == day + 1))
        {
            return None;
        }
        let label_s = day * DAY_S + second;
        let scaled = Self::normalised(label_s, part_s);
        Some(match scale {
            TimeScale::Utc => {
                let (_, offset_s) = LEAP_SECONDS.iter().rev().find(|(first, _)| *first <= day)?;
                Self::normalised(label_s + offset_s, part_s)
            }
            TimeScale::Tai => scaled,
            TimeScale::Gps => scaled.plus_s(TAI_MINUS_GPS_S),
            TimeScale::Tt => scaled.plus_s(-TT_MINUS_TAI_S),
            TimeScale::Tdb => tai_of_tdb(scaled),
        })
    }

    /// The time `tdb_s` seconds of TDB after J2000 (2000-01-01T12:00:00 TDB).
    #[must_use]
    pub fn of_tdb(tdb_s: f64) -> Self {
        tai_of_tdb(Self::normalised(J2000_1970_S as i64, tdb_s))
    }

    /// Seconds since 1958-01-01T00:00:00 TAI, to half a microsecond in this century.
    #[must_use]
    pub fn seconds_since_1958(self) -> f64 {
        (self.whole_s + TAI_1970_S as i64) as f64 + self.part_s
    }

    /// This time rounded down to a whole second.
    #[must_use]
    pub fn floor_second(self) -> Self {
        Self { part_s: 0.0, ..self }
    }

    /// Seconds elapsed from `other` to this time.
    #[must_use]
    pub fn since_s(self, other: Self) -> f64 {
        (self.whole_s - other.whole_s) as f64 + (self.part_s - other.part_s)
    }

    /// The time `s` seconds later.
    #[must_use]
    pub fn plus_s(self, s: f64) -> Self {
        let whole = s.floor();
        Self::normalised(self.whole_s.saturating_add(whole as i64), self.part_s + (s - whole))
    }

    /// Julian centuries of TT since J2000.
    #[must_use]
    pub fn tt_centuries(self) -> f64 {
        self.plus_s(TT_MINUS_TAI_S).centuries()
    }

    fn centuries(self) -> f64 {
        ((self.whole_s as f64 - J2000_1970_S) + self.part_s) / CENTURY_S
    }

    /// Formats the date and time of day on a scale, with this many decimals of a second. A leap second of UTC is second 60; before 1972 the
    /// difference between TAI and UTC is taken to be that of 1972.
    #[must_use]
    pub fn text(self, scale: TimeScale, decimals: usize) -> String {
        let unit = 10f64.powi(decimals as i32);
        let scaled = match scale {
            TimeScale::Utc | TimeScale::Tai => self,
            TimeScale::Gps => self.plus_s(-TAI_MINUS_GPS_S),
            TimeScale::Tt => self.plus_s(TT_MINUS_TAI_S),
            TimeScale::Tdb => {
                let tt = self.plus_s(TT_MINUS_TAI_S);
                tt.plus_s(tdb_minus_tt_s(tt.centuries()))
            }
        };
        // Rounding may complete a second, so it comes before the division into minutes and leap seconds.
        let rounded = (scaled.part_s * unit).round();
        let (whole_s, fraction) =
            if rounded >= unit { (scaled.whole_s + 1, 0.0) } else { (scaled.whole_s, rounded) };
        let (day, second) = match scale {
            TimeScale::Utc => utc_label(whole_s),
            _ => (whole_s.div_euclid(DAY_S), whole_s.rem_euclid(DAY_S)),
        };
        CalendarTime { day, second, part_s: fraction / unit }.text(decimals)
    }
}

/// Each change of TAI - UTC: its time, s of TAI since 1970-01-01, and the new difference, s.
pub fn leap_seconds() -> impl Iterator<Item = [i64; 2]> {
    LEAP_SECONDS.iter().map(|(day, offset_s)| [day * DAY_S + offset_s, *offset_s])
}

/// TAI minus UTC, s, at whole seconds of TAI since 1970-01-01; before 1972 the value of 1972.
#[must_use]
pub fn tai_minus_utc_s(tai_1970_s: i64) -> i64 {
    let (day, second) = utc_label(tai_1970_s);
    tai_1970_s - day * DAY_S - second
}

/// The UTC day since 1970 and second of the day (86,400 for a leap second) at whole seconds of TAI since 1970.
fn utc_label(whole_s: i64) -> (i64, i64) {
    let start_s = |(day, offset_s): &(i64, i64)| day * DAY_S + offset_s;
    let next = LEAP_SECONDS.partition_point(|leap| start_s(leap) <= whole_s);
    let (_, offset_s) = LEAP_SECONDS[next.saturating_sub(1)];
    // The second before the offset changes is the leap second.
    if let Some(leap) = LEAP_SECONDS.get(next).filter(|leap| next > 0 && whole_s == start_s(leap) - 1) {
        return (leap.0 - 1, DAY_S);
    }
    let label_s = whole_s - offset_s;
    (label_s.div_euclid(DAY_S), label_s.rem_euclid(DAY_S))
}

/// The time that a label on TDB means.
fn tai_of_tdb(label: Tai) -> Tai {
    // TDB - TT changes so slowly that its value at TDB is that at TT to a picosecond.
    label.plus_s(-tdb_minus_tt_s(label.centuries()) - TT_MINUS_TAI_S)
}

/// TDB minus TT, s, to 10 us over 1600 to 2200 (USNO Circular 179, Eq. 2.6).
fn tdb_minus_tt_s(centuries: f64) -> f64 {
    let t = centuries;
    let term = |amplitude: f64, rate: f64, phase: f64| amplitude * (rate * t + phase).sin();
    term(0.001_657, 628.307_6, 6.240_1)
        + term(0.000_022, 575.338_5, 4.297_0)
        + term(0.000_014, 1_256.615_2, 6.196_9)
        + term(0.000_005, 606.977_7, 4.021_2)
        + term(0.000_005, 52.969_1, 0.444_4)
        + term(0.000_002, 21.329_9, 5.543_1)
        + t * term(0.000_010, 628.307_6, 4.249_0)
}

/// Formats TAI seconds since 1958-01-01T00:00:00 as a UTC date and time, to the millisecond.
#[must_use]
pub fn utc_text(tai_s: f64) -> String {
    Tai::from_seconds_since_1958(tai_s).text(TimeScale::Utc, 3)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// From astropy 8.0.2 (`Time(date, scale=scale).tai`, with ERFA's dtdb at the geocentre for TDB).
    const DATES: [(&str, TimeScale, &str); 9] = [
        ("1972-01-01T00:00:00.000000000", TimeScale::Utc, "1972-01-01T00:00:10.000000000"),
        ("2016-12-31T23:59:59.500000000", TimeScale::Utc, "2017-01-01T00:00:35.500000000"),
        ("2016-12-31T23:59:60.250000000", TimeScale::Utc, "2017-01-01T00:00:36.250000000"),
        ("2017-01-01T00:00:00.000000000", TimeScale::Utc, "2017-01-01T00:00:37.000000000"),
        ("2024-03-01T00:00:00.000000000", TimeScale::Utc, "2024-03-01T00:00:37.000000000"),
        ("2024-03-01T00:00:00.000000000", TimeScale::Tt, "2024-02-29T23:59:27.816000000"),
        ("2024-03-01T00:00:00.000000000", TimeScale::Tdb, "2024-02-29T23:59:27.814640394"),
        ("2030-10-05T12:34:56.789000000", TimeScale::Tdb, "2030-10-05T12:34:24.606674964"),
        ("2024-03-01T00:00:00.000000000", TimeScale::Gps, "2024-03-01T00:00:19.000000000"),
    ];

    #[test]
    fn dates_of_all_scales_are_those_of_astropy() {
        for (date, scale, tai) in DATES {
            let found = Tai::parse(date, scale).unwrap();
            let expected = Tai::parse(tai, TimeScale::Tai).unwrap();
            // The truncation of the TDB series; other scales are exact.
            let tolerance_s = if scale == TimeScale::Tdb { 1e-5 } else { 1e-9 };
            assert!(
                found.since_s(expected).abs() < tolerance_s,
                "{date} {scale}: {}",
                found.text(TimeScale::Tai, 9)
            );
            assert_eq!(found.text(scale, 9), date, "{scale}");
        }
    }

    #[test]
    fn leap_seconds_agree_with_erfa() {
        // TAI - UTC from `erfa.leap_seconds.get()`: one row per year from 1972, with the values on 1 January and on 1 July.
        let by_year: [[i64; 2]; 46] = [
            [10, 11],
            [12, 12],
            [13, 13],
            [14, 14],
            [15, 15],
            [16, 16],
            [17, 17],
            [18, 18],
            [19, 19],
            [19, 20],
            [20, 21],
            [21, 22],
            [22, 22],
            [22, 23],
            [23, 23],
            [23, 23],
            [24, 24],
            [24, 24],
            [25, 25],
            [26, 26],
            [26, 27],
            [27, 28],
            [28, 29],
            [29, 29],
            [30, 30],
            [30, 31],
            [31, 31],
            [32, 32],
            [32, 32],
            [32, 32],
            [32, 32],
            [32, 32],
            [32, 32],
            [32, 32],
            [33, 33],
            [33, 33],
            [33, 33],
            [34, 34],
            [34, 34],
            [34, 34],
            [34, 35],
            [35, 35],
            [35, 35],
            [35, 36],
            [36, 36],
            [37, 37],
        ];
        let mut before = 10;
        for (year, offsets) in (1972..).zip(by_year) {
            for (month, offset) in ["01", "07"].into_iter().zip(offsets) {
                let date = format!("{year}-{month}-01T00:00:00");
                let utc = Tai::parse(&date, TimeScale::Utc).unwrap();
                assert_eq!(utc.since_s(Tai::parse(&date, TimeScale::Tai).unwrap()), offset as f64, "{date}");
                assert_eq!(tai_minus_utc_s(utc.whole_s), offset);
                // The second before has a name of its own only where one was put in.
                let second = utc.plus_s(-0.5).text(TimeScale::Utc, 1);
                assert_eq!(second.ends_with("23:59:60.5"), offset == before + 1, "{second}");
                before = offset;
            }
        }
    }

    #[test]
    fn what_is_no_date_is_none() {
        for (date, scale) in [
            ("2016-12-31T23:59:60", TimeScale::Tai),
            ("2016-12-30T23:59:60", TimeScale::Utc),
            ("2017-12-31T23:59:60", TimeScale::Utc),
            ("2016-12-31T23:59:61", TimeScale::Utc),
            ("2016-12-31T12:00:60", TimeScale::Utc),
            ("1971-12-31T23:59:59", TimeScale::Utc),
        ] {
            assert_eq!(Tai::parse(date, scale), None, "{date} {scale}");
        }
        assert_eq!(
            Tai::parse("2027-01-01T00:00:00", TimeScale::Tai).unwrap().seconds_since_1958(),
            2_177_452_800.0
        );
        assert_eq!(utc_text(2_177_452_800.0), "2026-12-31T23:59:23.000");
        // Rounding to the full second is the leap second's, too.
        assert_eq!(
            Tai::parse("2017-01-01T00:00:35.9999", TimeScale::Tai).unwrap().text(TimeScale::Utc, 3),
            "2016-12-31T23:59:60.000"
        );
    }
}
