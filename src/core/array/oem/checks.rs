//! Checks of states: above the surface, bound to the Moon, and close enough to each other for their interpolation.

use super::form::Fault;
use super::interpolate::interpolated;
use super::message::{OemSegment, Reading, TableMethod};
use crate::units::constants::MOON_GM_M3_S2;
use crate::units::vector::{Vec3, norm, sub};

/// Tolerance of a position between states, m: a fifth of the shortest observed wavelength, 10 m at 30 MHz.
const ERROR_M_MAX: f64 = 2.0;

/// Number of states with which a velocity is compared.
const VELOCITY_POINTS: usize = 9;

/// Ratio of a step to its neighbours from which it is a gap.
const GAP_STEPS: f64 = 3.0;

/// Checks that orbits are above the surface and bound to the Moon, that states agree with each other, and that
/// segments follow each other.
pub(super) fn check(reading: &Reading, moon_radius_m: f64) -> Result<(), Fault> {
    for (segment, lines) in reading.message.segments.iter().zip(&reading.lines) {
        let line = |k: usize| lines.get(k).map_or(0, |line| *line as usize);
        require_orbits(segment, &line, moon_radius_m)?;
        let check = SegmentCheck { reading, segment };
        for k in 0..segment.time_s.len() {
            check.velocity(k, line(k))?;
            if k > 0 {
                check.interval(k - 1, line(k))?;
            }
        }
        // After those that say more.
        for k in 1..segment.time_s.len().saturating_sub(1) {
            check.position(k, &line)?;
        }
    }
    require_order(reading)
}

/// Checks that states are above the surface and bound to the Moon.
fn require_orbits(
    segment: &OemSegment,
    line: &dyn Fn(usize) -> usize,
    moon_radius_m: f64,
) -> Result<(), Fault> {
    for (k, (position_m, velocity_m_s)) in segment.position_m.iter().zip(&segment.velocity_m_s).enumerate() {
        let (radius_m, speed_m_s) = (norm(*position_m), norm(*velocity_m_s));
        if radius_m <= moon_radius_m || radius_m > 1e9 {
            let found = format!("{:.3} km from the Moon's centre", radius_m / 1e3);
            return Err(Fault::new(line(k), found, "above the Moon's surface, within 1e6 km"));
        }
        if 0.5 * speed_m_s * speed_m_s >= MOON_GM_M3_S2 / radius_m {
            let found =
                format!("{:.3} km/s at {:.1} km from the Moon's centre", speed_m_s / 1e3, radius_m / 1e3);
            let expected =
                "less than the velocity of escape: other orbits are not closed (parabolic, hyperbolic)";
            return Err(Fault::new(line(k), found, expected));
        }
    }
    Ok(())
}

/// Checks that segments do not overlap. There may be gaps between them.
fn require_order(reading: &Reading) -> Result<(), Fault> {
    let segments = &reading.message.segments;
    for (k, (before, after)) in segments.iter().zip(segments.iter().skip(1)).enumerate() {
        let overlap_s = before.useable_s[1] - after.useable_s[0];
        if overlap_s > 0.0 {
            let line = reading.lines[k + 1].first().map_or(0, |line| *line as usize);
            let found = format!("a segment that begins {overlap_s:.3} s before the one before ends");
            let expected = "segments without overlaps: each begins when the one before ends, or USEABLE_START_TIME and \
                            USEABLE_STOP_TIME say when each is to be used";
            return Err(Fault::new(line, found, expected));
        }
    }
    Ok(())
}

/// Neighbouring states of a segment.
struct SegmentCheck<'a> {
    reading: &'a Reading,
    segment: &'a OemSegment,
}

impl SegmentCheck<'_> {
    fn date(&self, k: usize) -> String {
        let scale = self.reading.scale;
        format!("{} {scale}", self.reading.message.zero.plus_s(self.segment.time_s[k]).text(scale, 3))
    }

    /// Whether any time between two times is to be used.
    fn is_used(&self, from_s: f64, until_s: f64) -> bool {
        let [first_s, last_s] = self.segment.useable_s;
        from_s < last_s && until_s > first_s
    }

    /// Checks the interpolation after state `k`: one with another state must give the same in the middle.
    fn interval(&self, k: usize, line: usize) -> Result<(), Fault> {
        let segment = self.segment;
        let [from_s, until_s] = [segment.time_s[k], segment.time_s[k + 1]];
        if !self.is_used(from_s, until_s) {
            return Ok(());
        }
        let (points, states) = (segment.points(), segment.time_s.len());
        let other = if points < states { points + 1 } else { (points - 1).max(1) };
        let middle_s = 0.5 * (from_s + until_s);
        let at = |points| interpolated(segment, segment.method, points, middle_s).position_m;
        let error_m = norm(sub(at(points), at(other)));
        // If there is no other state, the comparison is with one state fewer, which errs some ten times as much or
        // more.
        let allowed_m = if points < states { ERROR_M_MAX } else { 10.0 * ERROR_M_MAX };
        if error_m <= allowed_m {
            return Ok(());
        }
        let step_s = until_s - from_s;
        let step = |k: Option<usize>| {
            let next = k.and_then(|k| Some(segment.time_s.get(k + 1)? - segment.time_s.get(k)?));
            next.unwrap_or(f64::INFINITY)
        };
        let usual_s = step(k.checked_sub(1)).min(step(Some(k + 1)));
        let what = match step_s > GAP_STEPS * usual_s {
            true => format!("a gap of {step_s:.3} s (the states beside it are {usual_s:.3} s apart)"),
            false => format!("{step_s:.3} s"),
        };
        let found = format!(
            "{what} from {} to {}, between which the interpolation errs by some {error_m:.1} m",
            self.date(k),
            self.date(k + 1)
        );
        let expected = format!(
            "at most {allowed_m} m: no gaps, steps that are short enough for INTERPOLATION_DEGREE = {}, and positions and \
             velocities that agree with their neighbours",
            segment.degree
        );
        Err(Fault::new(line, found, expected))
    }

    /// Position of state `k` that follows from the states around it, up to `reach` on either side.
    fn position_by_neighbours(&self, k: usize, reach: usize) -> Vec3 {
        let segment = self.segment;
        let (from, until) = (k.saturating_sub(reach), (k + reach + 1).min(segment.time_s.len()));
        let without = |values: &[Vec3]| [&values[from..k], &values[k + 1..until]].concat();
        let around = OemSegment {
            time_s: [&segment.time_s[from..k], &segment.time_s[k + 1..until]].concat(),
            position_m: without(&segment.position_m),
            velocity_m_s: without(&segment.velocity_m_s),
            ..*segment
        };
        interpolated(&around, TableMethod::Hermite, around.time_s.len(), segment.time_s[k]).position_m
    }

    /// How far state `k`, not the first or last, is from where its neighbours have it, m; 0 if they cannot say.
    fn step_m(&self, k: usize) -> f64 {
        let position_m = self.segment.position_m[k];
        let near = self.position_by_neighbours(k, 2);
        if norm(sub(near, position_m)) <= ERROR_M_MAX {
            return 0.0;
        }
        let far = self.position_by_neighbours(k, 3);
        let (off_m, open_m) = (norm(sub(far, position_m)), norm(sub(far, near)));
        if off_m > 10.0 * open_m { off_m } else { 0.0 }
    }

    /// Checks that state `k`, not the first or last, is where its neighbours have it.
    fn position(&self, k: usize, line: &dyn Fn(usize) -> usize) -> Result<(), Fault> {
        let time_s = self.segment.time_s[k];
        if !self.is_used(time_s - 1e-3, time_s + 1e-3) || self.step_m(k) <= ERROR_M_MAX {
            return Ok(());
        }
        // A step is seen from its neighbours, too.
        let last = (k + 3).min(self.segment.time_s.len() - 2);
        let k = (k..=last).max_by(|a, b| self.step_m(*a).total_cmp(&self.step_m(*b))).unwrap_or(k);
        let found = format!(
            "a position at {} that is {:.1} m from where its neighbours have it",
            self.date(k),
            self.step_m(k)
        );
        Err(Fault::new(
            line(k),
            found,
            format!("at most {ERROR_M_MAX} m: states of one orbit, without steps"),
        ))
    }

    /// Checks that the velocity of state `k` is the derivative of the positions around it.
    fn velocity(&self, k: usize, line: usize) -> Result<(), Fault> {
        let segment = self.segment;
        let time_s = segment.time_s[k];
        let states = segment.time_s.len();
        if !self.is_used(time_s - 1e-3, time_s + 1e-3) || states < 4 {
            return Ok(());
        }
        let at = |points| interpolated(segment, TableMethod::Lagrange, points, time_s).velocity_m_s;
        let points = VELOCITY_POINTS.min(states);
        let by_positions = at(points);
        let off_m_s = norm(sub(by_positions, segment.velocity_m_s[k]));
        let step = |k: usize| Some(segment.time_s.get(k + 1)? - segment.time_s.get(k)?);
        let step_s = step(k).unwrap_or(0.0).max(k.checked_sub(1).and_then(step).unwrap_or(0.0));
        if off_m_s * step_s <= ERROR_M_MAX {
            return Ok(());
        }
        // Positions alone may be too far apart to decide; interpolations with other numbers of them show the
        // uncertainty.
        let open_m_s = [points - 1, points - 2].map(|points| norm(sub(by_positions, at(points))));
        if off_m_s <= 10.0 * open_m_s[0].max(open_m_s[1]) {
            return Ok(());
        }
        let found = format!(
            "a velocity of {:.3} m/s at {} that differs by {off_m_s:.3} m/s from that of the positions around it",
            norm(segment.velocity_m_s[k]),
            self.date(k)
        );
        Err(Fault::new(line, found, "positions and velocities of one orbit"))
    }
}
