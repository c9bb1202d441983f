//! Tabulated positions: sampled on the spacecraft, interpolated on the ground.
//!
//! Lagrange interpolation through the eight nodes about a time, within one segment, written as one polynomial between
//! adjacent nodes because many visibilities lie between two nodes. Its
//! error is at most `|d8r/dt8| h^8 max|s (s-1) .. (s-7)| / 8!` (Abramowitz and Stegun 25.2.27); on an orbit
//! of radius R and angular speed w it is R (w h)^8 / 940 in the middle of a segment and 28 times that in its
//! outermost steps: about a micrometre for nodes a minute apart.

use std::collections::BTreeMap;

use super::orbit::Array;
use crate::frames::EphemerisSegment;
use crate::units::vector::Vec3;
use crate::units::{MissionTime, TICKS_PER_SECOND};

/// Number of nodes of an interpolation.
const NODES: usize = 8;

/// Number of segments examined for one time: the latest that start before it, as a few may overlap.
const OVERLAPPING_MAX: usize = 8;

/// The ephemeris of `array` from `start` to `end`, in segments without a turnaround of the formation inside, each of at
/// least eight nodes at most `step_s_max` apart.
///
/// The segments cover every time from `start` to `end`; they may extend beyond by less than a step.
#[must_use]
pub fn segments_for(
    array: &Array,
    start: MissionTime,
    end: MissionTime,
    step_s_max: f64,
) -> Vec<EphemerisSegment> {
    let mut segments = Vec::new();
    let mut from = start;
    while from < end {
        let turnaround = turnaround_after(array, from);
        let to = turnaround.map_or(end, |turnaround| turnaround.min(end));
        segments.push(segment(array, [from, to], turnaround == Some(to), step_s_max));
        from = to;
    }
    segments
}

/// Tick of the first turnaround of a formation after `from`, which may itself be one.
fn turnaround_after(array: &Array, from: MissionTime) -> Option<MissionTime> {
    let formation = array.formation_of_any_shape()?;
    let next_after =
        |time: MissionTime| MissionTime::from_seconds(formation.next_turnaround_s(time.seconds()));
    let next_tick = from.plus_ticks(1);
    let found = next_after(from);
    Some(if found > from { found } else { next_after(next_tick).max(next_tick) })
}

/// One segment over an interval without a jump in velocity.
///
/// Its nodes are whole ticks apart, so it may be a few ticks longer than the interval: at its start if it ends at a
/// turnaround, otherwise at its end.
fn segment(
    array: &Array,
    [from, to]: [MissionTime; 2],
    ends_at_turnaround: bool,
    step_s_max: f64,
) -> EphemerisSegment {
    let ticks = to.0 - from.0;
    let step_max = ((step_s_max * TICKS_PER_SECOND as f64) as i64).clamp(1, i64::from(u32::MAX));
    let intervals = ((ticks + step_max - 1) / step_max).max(NODES as i64 - 1);
    let step = (ticks + intervals - 1) / intervals;
    let first = if ends_at_turnaround { to.plus_ticks(-step * intervals) } else { from };
    let satellites = array.satellites();
    let mut positions_m = Vec::with_capacity((intervals as usize + 1) * satellites);
    for k in 0..=intervals {
        let t_s = first.plus_ticks(k * step).seconds();
        positions_m.extend((0..satellites).map(|n| array.position_m(n, t_s)));
    }
    EphemerisSegment { start: first, step_ticks: step as u32, satellites: satellites as u8, positions_m }
}

/// Outcome of inserting a segment into an [`Ephemeris`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Insertion {
    /// It was inserted.
    New,
    /// It was in the table before.
    Repeated,
    /// Another segment that starts at the same time is in the table, and stays.
    Contradictory,
    /// The table is full of later segments.
    TooOld,
    /// It has fewer than eight nodes, or no step.
    Unusable,
}

/// Positions of the satellites as the ground knows them, from ephemeris frames only.
#[derive(Clone, Debug, PartialEq)]
pub struct Ephemeris {
    segments: BTreeMap<MissionTime, EphemerisSegment>,
    segments_max: usize,
}

impl Default for Ephemeris {
    /// Creates a table for 1024 segments: ten weeks of windows, some 10 MB with eight satellites.
    fn default() -> Self {
        Self::new(1024)
    }
}

impl Ephemeris {
    /// Creates an empty table for `segments_max` segments, of which the earliest are dropped first.
    #[must_use]
    pub fn new(segments_max: usize) -> Self {
        Self { segments: BTreeMap::new(), segments_max: segments_max.max(1) }
    }

    /// Number of segments.
    #[must_use]
    #[doc(hidden)]
    pub fn len(&self) -> usize {
        self.segments.len()
    }

    /// Whether the table is empty.
    #[must_use]
    #[doc(hidden)]
    pub fn is_empty(&self) -> bool {
        self.segments.is_empty()
    }

    /// All segments, in order of their start.
    #[doc(hidden)]
    pub fn segments(&self) -> impl Iterator<Item = &EphemerisSegment> {
        self.segments.values()
    }

    /// Inserts a segment.
    pub fn insert(&mut self, segment: EphemerisSegment) -> Insertion {
        let positions = segment.nodes() * usize::from(segment.satellites);
        let whole = positions == segment.positions_m.len();
        if segment.nodes() < NODES || segment.step_ticks == 0 || !whole {
            return Insertion::Unusable;
        }
        match self.segments.get(&segment.start) {
            Some(known) if *known == segment => return Insertion::Repeated,
            Some(_) => return Insertion::Contradictory,
            None => {}
        }
        let start = segment.start;
        self.segments.insert(start, segment);
        if self.segments.len() > self.segments_max
            && self.segments.pop_first().is_some_and(|(dropped, _)| dropped == start)
        {
            return Insertion::TooOld;
        }
        Insertion::New
    }

    /// The segment that starts at a given time.
    #[must_use]
    #[doc(hidden)]
    pub fn segment(&self, start: MissionTime) -> Option<&EphemerisSegment> {
        self.segments.get(&start)
    }

    /// Removes the segment that starts at a given time.
    #[doc(hidden)]
    pub fn remove(&mut self, start: MissionTime) -> Option<EphemerisSegment> {
        self.segments.remove(&start)
    }

    /// Whether segments cover all of an interval, both ends included.
    #[must_use]
    pub fn covers(&self, [from, to]: [MissionTime; 2]) -> bool {
        let mut time = from;
        while time <= to {
            let Some(segment) = self.valid_at(time).segment else { return false };
            time = segment.end().plus_ticks(1);
        }
        true
    }

    /// Position of a satellite (from 0), m; `None` where no segment covers the time or knows the satellite.
    #[must_use]
    pub fn position_at(&self, time_s: f64, satellite: usize) -> Option<Vec3> {
        if !time_s.is_finite() {
            return None;
        }
        let time = MissionTime::from_seconds(time_s);
        let piece = Piece::at(self.valid_at(time).segment?, 2 * time.0, [satellite])?;
        let middle_s = piece.middle_half_ticks as f64 / 2e6;
        let [position_m] = piece.positions_m((time_s - middle_s) * 2e6);
        Some(position_m)
    }

    /// Segment valid at a time, the latest that covers it, and the time up to which it is valid. Depends on the time
    /// and the table only.
    pub(super) fn valid_at(&self, time: MissionTime) -> ValidSegment<'_> {
        let before = self.segments.range(..=time).rev().take(OVERLAPPING_MAX);
        let segment = before.map(|(_, segment)| segment).find(|segment| segment.covers(time));
        let after = self.segments.range(time.plus_ticks(1)..).next();
        let next = after.map_or(MissionTime(i64::MAX), |(start, _)| start.plus_ticks(-1));
        ValidSegment { segment, first: time, last: segment.map_or(next, |segment| segment.end().min(next)) }
    }
}

/// An interval, both ends included, over which one segment is valid, or none.
#[derive(Clone, Copy, Debug)]
pub(super) struct ValidSegment<'a> {
    pub(super) segment: Option<&'a EphemerisSegment>,
    pub(super) first: MissionTime,
    pub(super) last: MissionTime,
}

/// Interpolating polynomials of some satellites from one node of a segment to the next.
#[derive(Clone, Copy, Debug)]
pub(super) struct Piece<const N: usize> {
    /// Time of the middle between the two nodes, half ticks after the mission epoch.
    pub(super) middle_half_ticks: i64,
    /// Half the time between them, half ticks.
    pub(super) reach_half_ticks: i64,
    steps_per_half_tick: f64,
    /// Coefficient of each power of the steps after the middle, for each coordinate.
    coefficients_m: [[[f64; 3]; N]; NODES],
}

impl<const N: usize> Piece<N> {
    /// Computes the piece valid at a time; the first and last piece of a segment extrapolate. `None` if the segment
    /// has fewer than eight nodes or lacks a satellite.
    pub(super) fn at(segment: &EphemerisSegment, half_ticks: i64, satellites: [usize; N]) -> Option<Self> {
        const MONOMIALS: [[[f64; NODES]; NODES]; NODES - 1] = monomials();
        let known = usize::from(segment.satellites);
        let last_first = segment.nodes().checked_sub(NODES)?;
        if satellites.iter().any(|&satellite| satellite >= known) {
            return None;
        }
        let step = i64::from(segment.step_ticks);
        let intervals = segment.nodes() as i64 - 1;
        let interval = ((half_ticks - 2 * segment.start.0) / (2 * step)).clamp(0, intervals - 1) as usize;
        let first = interval.saturating_sub(NODES / 2 - 1).min(last_first);
        let mut coefficients_m = [[[0.0; 3]; N]; NODES];
        for (node, monomials) in MONOMIALS[interval - first].iter().enumerate() {
            let positions_m = &segment.positions_m[(first + node) * known..];
            for (n, &satellite) in satellites.iter().enumerate() {
                for (sum, monomial) in coefficients_m.iter_mut().zip(monomials) {
                    for (sum, r) in sum[n].iter_mut().zip(positions_m[satellite]) {
                        *sum += monomial * r;
                    }
                }
            }
        }
        Some(Self {
            middle_half_ticks: 2 * segment.start.0 + (2 * interval as i64 + 1) * step,
            reach_half_ticks: step,
            steps_per_half_tick: 0.5 / step as f64,
            coefficients_m,
        })
    }

    /// Positions, m, a number of half ticks after the middle.
    #[inline(always)] // To use the registers of the caller.
    pub(super) fn positions_m(&self, half_ticks_after: f64) -> [Vec3; N] {
        let steps = half_ticks_after * self.steps_per_half_tick;
        let [lower @ .., highest] = &self.coefficients_m;
        let mut sum = *highest;
        for coefficients in lower.iter().rev() {
            for (sum, coefficient) in sum.as_flattened_mut().iter_mut().zip(coefficients.as_flattened()) {
                *sum = *sum * steps + coefficient;
            }
        }
        sum
    }
}

/// Lagrange polynomials through nodes 0 to 7 in powers of `s - o - 1/2`: `[o][m]` has the coefficients of
/// `l_m(s) = prod_{k != m} (s - k) / (m - k)`.
const fn monomials() -> [[[f64; NODES]; NODES]; NODES - 1] {
    const SCALE: [f64; NODES] = inverse_products();
    let mut all = [[[0.0; NODES]; NODES]; NODES - 1];
    let mut o = 0;
    while o < NODES - 1 {
        let mut m = 0;
        while m < NODES {
            let mut product = [0.0; NODES];
            product[0] = SCALE[m];
            let (mut k, mut degree) = (0, 0);
            while k < NODES {
                if k != m {
                    // The factor is `(s - o - 1/2) + (o + 1/2 - k)`; exact except for the scale, as all terms are
                    // halves of integers.
                    let shift = o as f64 + 0.5 - k as f64;
                    degree += 1;
                    let mut power = degree;
                    while power > 0 {
                        product[power] = product[power] * shift + product[power - 1];
                        power -= 1;
                    }
                    product[0] *= shift;
                }
                k += 1;
            }
            all[o][m] = product;
            m += 1;
        }
        o += 1;
    }
    all
}

/// `1 / prod_{k != m} (m - k)` for each node m.
const fn inverse_products() -> [f64; NODES] {
    let mut inverse = [1.0; NODES];
    let mut m = 0;
    while m < NODES {
        let mut product = 1.0;
        let mut k = 0;
        while k < NODES {
            if k != m {
                product *= m as f64 - k as f64;
            }
            k += 1;
        }
        inverse[m] = 1.0 / product;
        m += 1;
    }
    inverse
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{ArrayConfig, BreathingConfig};
    use crate::units::constants::DAY_S;
    use crate::units::vector::{norm, sub};

    fn table(array: &Array, start_s: f64, end_s: f64) -> Ephemeris {
        let mut table = Ephemeris::default();
        let (start, end) = (MissionTime::from_seconds(start_s), MissionTime::from_seconds(end_s));
        for segment in segments_for(array, start, end, 60.0) {
            assert!(segment.nodes() >= NODES && segment.step_ticks <= 60_000_000);
            assert_eq!(table.insert(segment), Insertion::New);
        }
        table
    }

    /// Maximum error over a window between its nodes, m.
    fn worst_m(array: &Array, start_s: f64, end_s: f64) -> f64 {
        let table = table(array, start_s, end_s);
        let count = 20_011;
        let times = (0..=count).map(|k| start_s + (end_s - start_s) * f64::from(k) / f64::from(count));
        let error = |t_s: f64| {
            (0..array.satellites())
                .map(|n| norm(sub(table.position_at(t_s, n).unwrap(), array.position_m(n, t_s))))
                .fold(0.0, f64::max)
        };
        times.map(error).fold(0.0, f64::max)
    }

    #[test]
    fn a_window_is_interpolated_to_micrometres() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        // The formula above gives 1.1 um at the ends. Times in f64 are good to 4e-9 s at the end of the
        // precession, orbital phases to 5e-13 turns: 6 um each in the nodes and in the time asked for,
        // magnified up to fivefold by the coefficients at the ends.
        for (start_s, bound_m) in [(0.0, 2e-6), (1.3e6 + 0.1234567, 5e-6), (4.09e7, 1e-4)] {
            let worst_m = worst_m(&array, start_s, start_s + 2_751.3);
            assert!(worst_m < bound_m, "{start_s}: {worst_m}");
        }
    }

    #[test]
    fn an_ellipse_is_interpolated_to_far_less_than_a_centimetre() {
        let elements = |mean_anomaly_deg| crate::array::KeplerElements {
            semi_major_axis_m: 2.5e6,
            eccentricity: 0.25,
            inclination_deg: 50.0,
            node_longitude_deg: 40.0,
            periapsis_deg: 70.0,
            mean_anomaly_deg,
            node_rate_deg_per_day: -0.75,
            periapsis_rate_deg_per_day: 0.0,
        };
        // Across the periapsis, where the motion is fastest.
        let kepler = vec![elements(-10.0), elements(-20.0), elements(-30.0)];
        let array = Array::new(&ArrayConfig { satellites: 3, kepler, ..ArrayConfig::default() }).unwrap();
        // The formula above at the periapsis: 1.9e6 m and 9.6e-4 rad/s, whose eighth derivative is some tens of times that
        // of a circle, give 0.1 mm at the ends.
        let worst_m = worst_m(&array, 0.0, 2_751.3);
        assert!(worst_m < 1e-3, "{worst_m}");
    }

    #[test]
    fn a_turnaround_in_the_window_costs_nothing() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        for turnaround_s in [7.0 * DAY_S, 14.0 * DAY_S] {
            for before_s in [2_000.0, 100.0, 10.0, 1e-3, 2e-6] {
                let worst_m = worst_m(&array, turnaround_s - before_s, turnaround_s + 750.0);
                assert!(worst_m < 1e-5, "{before_s} s before {turnaround_s}: {worst_m}");
            }
        }
        // Without a division there, the jump of 0.2 m/s over a step of a minute would cost more than a metre.
        let (start_s, end_s) = (7.0 * DAY_S - 2_000.0, 7.0 * DAY_S + 750.0);
        assert_eq!(table(&array, start_s, end_s).len(), 2);
    }

    #[test]
    fn fast_breathing_divides_a_window_often() {
        let breathing = BreathingConfig { period_s: 777.777_777_7, ..Default::default() };
        let array = Array::new(&ArrayConfig { breathing, ..Default::default() }).unwrap();
        // Both ends of a segment are turnarounds here: the one node beyond is less than 8 ticks off, in
        // which a jump of 340 m/s takes the last daughter 3 mm.
        let worst_m = worst_m(&array, 12_345.678, 12_345.678 + 2_750.0);
        assert!(worst_m < 1e-2, "{worst_m}");
        let segments = segments_for(&array, MissionTime(0), MissionTime(2_750_000_000), 60.0);
        assert_eq!(segments.len(), 8);
    }

    #[test]
    fn an_interval_is_covered_without_a_gap() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        // The interval is divided at the turnaround.
        let turnaround_s = 7.0 * DAY_S;
        let mut table = table(&array, turnaround_s - 1000.0, turnaround_s + 1000.0);
        let covers = |table: &Ephemeris, from_s: f64, to_s: f64| {
            table.covers([from_s, to_s].map(|s| MissionTime::from_seconds(turnaround_s + s)))
        };
        assert!(covers(&table, -999.0, 999.0) && covers(&table, 5.0, 5.0));
        assert!(!covers(&table, -1100.0, 0.0) && !covers(&table, 0.0, 1100.0));
        let second = table.segments().last().map(|segment| segment.start).unwrap();
        assert!(table.remove(second).is_some() && table.segment(second).is_none());
        assert!(covers(&table, -999.0, -1.0) && !covers(&table, -999.0, 1.0));
    }

    #[test]
    fn nodes_are_returned() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let segment = segments_for(&array, MissionTime(0), MissionTime(1_200_000_000), 60.0).remove(0);
        for k in 0..segment.nodes() {
            let time = segment.start.plus_ticks(k as i64 * i64::from(segment.step_ticks));
            let piece = Piece::at(&segment, 2 * time.0, [3, 5]).unwrap();
            let found = piece.positions_m((2 * time.0 - piece.middle_half_ticks) as f64);
            for (found, satellite) in found.into_iter().zip([3, 5]) {
                let node = segment.positions_m[8 * k + satellite];
                // 1e-8 m: some tens of roundings of 1e6 m.
                assert!(norm(sub(found, node)) < 1e-8, "{k}: {found:?} {node:?}");
            }
        }
    }

    #[test]
    fn the_table_is_bounded_and_keeps_its_segments() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let segment =
            |start: i64| segments_for(&array, MissionTime(start), MissionTime(start + 1_000), 60.0).remove(0);
        let mut table = Ephemeris::new(3);
        for start in [0, 10_000, 20_000] {
            assert_eq!(table.insert(segment(start)), Insertion::New);
            assert_eq!(table.insert(segment(start)), Insertion::Repeated);
        }
        let mut other = segment(10_000);
        other.positions_m[0][0] += 1.0;
        assert_eq!(table.insert(other), Insertion::Contradictory);
        assert_eq!(table.insert(segment(-5_000)), Insertion::TooOld);
        assert_eq!(table.insert(segment(30_000)), Insertion::New);
        assert_eq!(table.len(), 3);
        assert_eq!(table.position_at(0.000_5, 0), None);
        assert!(table.position_at(0.020_5, 7).is_some());
        assert_eq!(table.position_at(0.020_5, 8), None);
        assert_eq!(table.position_at(f64::NAN, 0), None);
        let mut short = segment(50_000);
        short.positions_m.pop();
        assert_eq!(table.insert(short), Insertion::Unusable);
    }
}
