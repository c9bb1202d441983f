//! Orbits given by tables of positions and velocities.

use std::path::Path;
use std::sync::Arc;

use super::file::{DEGREE_MAX, Fault, OemFile, OemSegment, TableMethod, parse};
use crate::array::config::ArrayError;
use crate::array::state::SatelliteState;
use crate::units::constants::MOON_GM_M3_S2;
use crate::units::vector::{Vec3, cross, dot, norm, scale, sub};

/// An orbit from a file. Cheap to clone.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::array) struct TableOrbit {
    file: Arc<OemFile>,
    /// Epoch of the mission in the file's seconds.
    epoch_s: f64,
}

/// States of one orbit, at rising times, without a jump.
#[derive(Clone, Debug, Default)]
pub(in crate::array) struct Stretch {
    time_s: Vec<f64>,
    position_m: Vec<Vec3>,
    velocity_m_s: Vec<Vec3>,
}

impl Stretch {
    pub(in crate::array) fn times_s(&self) -> &[f64] {
        &self.time_s
    }

    /// Times and states.
    pub(in crate::array) fn states(&self) -> impl Iterator<Item = (f64, SatelliteState)> + '_ {
        let states = self.position_m.iter().zip(&self.velocity_m_s);
        let states = states.map(|(&position_m, &velocity_m_s)| SatelliteState { position_m, velocity_m_s });
        self.time_s.iter().copied().zip(states)
    }

    pub(in crate::array) fn push(&mut self, time_s: f64, state: SatelliteState) {
        self.time_s.push(time_s);
        self.position_m.push(state.position_m);
        self.velocity_m_s.push(state.velocity_m_s);
    }
}

/// Largest file that is read, bytes: ten years of states each minute.
const FILE_BYTES_MAX: u64 = 1 << 30;

/// Nearest that two satellites may be at any state of the first, m.
const APART_M: f64 = 1.0;

fn error(path: &Path, what: String) -> ArrayError {
    ArrayError::Oem { path: path.to_owned(), what }
}

/// Reads the files of all satellites. The mission starts at `epoch_s` of their time system, or with the last to start.
pub(in crate::array) fn read(
    paths: &[std::path::PathBuf],
    epoch_s: Option<f64>,
    moon_radius_m: f64,
) -> Result<Vec<TableOrbit>, ArrayError> {
    let mut files: Vec<OemFile> = Vec::new();
    for path in paths {
        let size = std::fs::metadata(path).map_err(|source| error(path, source.to_string()))?.len();
        if size > FILE_BYTES_MAX {
            return Err(error(path, format!("{size} bytes; expected at most {FILE_BYTES_MAX}")));
        }
        let text = std::fs::read_to_string(path).map_err(|source| error(path, source.to_string()))?;
        let of_line = |Fault { line, found, expected }: Fault| {
            error(path, format!("line {line}: found {found}; expected {expected}"))
        };
        let file = parse(&text).map_err(of_line)?;
        check(&file, moon_radius_m).map_err(of_line)?;
        if let Some(first) = files.first()
            && first.time_system != file.time_system
        {
            let expected = &first.time_system;
            return Err(error(
                path,
                format!("TIME_SYSTEM = {}; expected {expected} as in the first file", file.time_system),
            ));
        }
        files.push(file);
    }
    let latest_s = files.iter().map(|file| file.span_s()[0]).fold(f64::NEG_INFINITY, f64::max);
    let epoch_s = epoch_s.unwrap_or(latest_s);
    let orbits: Vec<TableOrbit> =
        files.into_iter().map(|file| TableOrbit { file: Arc::new(file), epoch_s }).collect();
    for (second, path) in paths.iter().enumerate() {
        for first in 0..second {
            if let Some(t_s) = meeting_s(&orbits[first], &orbits[second]) {
                return Err(error(
                    path,
                    format!(
                        "satellites {} and {} are at one place {t_s:.3} s after the mission's epoch; expected orbits of their own",
                        first + 1,
                        second + 1
                    ),
                ));
            }
        }
    }
    Ok(orbits)
}

/// Requires orbits above the surface that the Moon holds, and segments that follow each other.
fn check(file: &OemFile, moon_radius_m: f64) -> Result<(), Fault> {
    for segment in &file.segments {
        for (k, (position_m, velocity_m_s)) in
            segment.position_m.iter().zip(&segment.velocity_m_s).enumerate()
        {
            let (radius_m, speed_m_s) = (norm(*position_m), norm(*velocity_m_s));
            if radius_m <= moon_radius_m || radius_m > 1e9 {
                let found = format!("{:.3} km from the Moon's centre", radius_m / 1e3);
                return Err(Fault {
                    line: segment.line + k,
                    found,
                    expected: "above the Moon's surface, within 1e6 km",
                });
            }
            if 0.5 * speed_m_s * speed_m_s >= MOON_GM_M3_S2 / radius_m {
                let found =
                    format!("{:.3} km/s at {:.1} km from the Moon's centre", speed_m_s / 1e3, radius_m / 1e3);
                let expected =
                    "less than the velocity of escape: other orbits are not closed (parabolic, hyperbolic)";
                return Err(Fault { line: segment.line + k, found, expected });
            }
        }
    }
    for (before, after) in file.segments.iter().zip(file.segments.iter().skip(1)) {
        let (Some(end_s), Some(start_s)) = (before.time_s.last(), after.time_s.first()) else { continue };
        let gap_s = start_s - end_s;
        if gap_s != 0.0 {
            let found = format!(
                "a segment that begins {:.3} s {} the one before ends",
                gap_s.abs(),
                if gap_s > 0.0 { "after" } else { "before" }
            );
            let expected =
                "segments without gaps and overlaps: each begins with the last epoch of the one before";
            return Err(Fault { line: after.line, found, expected });
        }
    }
    Ok(())
}

/// A time, s since the epoch, at which two orbits meet, among the states of both.
fn meeting_s(first: &TableOrbit, second: &TableOrbit) -> Option<f64> {
    let times = |orbit: &TableOrbit| -> Vec<f64> {
        orbit.file.segments.iter().flat_map(|s| &s.time_s).map(|t_s| t_s - orbit.epoch_s).collect()
    };
    let ([from, to], [start, end]) = (first.span_s(), second.span_s());
    let common = |t_s: &f64| (from.max(start)..=to.min(end)).contains(t_s);
    times(first)
        .into_iter()
        .chain(times(second))
        .filter(common)
        .find(|&t_s| norm(sub(first.state(t_s).position_m, second.state(t_s).position_m)) < APART_M)
}

impl OemFile {
    fn span_s(&self) -> [f64; 2] {
        let first = self.segments.first().and_then(|segment| segment.time_s.first());
        let last = self.segments.last().and_then(|segment| segment.time_s.last());
        [first.copied().unwrap_or(0.0), last.copied().unwrap_or(0.0)]
    }
}

impl TableOrbit {
    /// An orbit through states at times after the mission's epoch; each stretch, of four states or more, begins when the one
    /// before ends.
    pub(in crate::array) fn of_stretches(stretches: Vec<Stretch>) -> Self {
        let segment = |Stretch { time_s, position_m, velocity_m_s }| OemSegment {
            method: TableMethod::Hermite,
            degree: 7,
            line: 0,
            time_s,
            position_m,
            velocity_m_s,
        };
        let segments = stretches.into_iter().map(segment).collect();
        Self { file: Arc::new(OemFile { time_system: "TDB".into(), segments }), epoch_s: 0.0 }
    }

    /// The states of the table, at times since the mission's epoch.
    pub(in crate::array) fn stretches(&self) -> Vec<Stretch> {
        let stretch = |segment: &OemSegment| Stretch {
            time_s: segment.time_s.iter().map(|t_s| t_s - self.epoch_s).collect(),
            position_m: segment.position_m.clone(),
            velocity_m_s: segment.velocity_m_s.clone(),
        };
        self.file.segments.iter().map(stretch).collect()
    }

    /// Memory of the states, bytes; clones share it.
    pub(in crate::array) fn table_bytes(&self) -> u64 {
        let states: usize = self.file.segments.iter().map(|segment| segment.time_s.len()).sum();
        (states * (size_of::<f64>() + 2 * size_of::<Vec3>())) as u64
    }

    /// First and last time, s since the mission's epoch.
    pub(in crate::array) fn span_s(&self) -> [f64; 2] {
        self.file.span_s().map(|t_s| t_s - self.epoch_s)
    }

    /// Position and velocity; beyond the file the nearest polynomial goes on.
    pub(in crate::array) fn state(&self, t_s: f64) -> SatelliteState {
        let at_s = t_s + self.epoch_s;
        let segments = &self.file.segments;
        let after =
            segments.partition_point(|segment| segment.time_s.first().is_some_and(|first| *first <= at_s));
        segments[after.saturating_sub(1)].state(at_s)
    }

    /// Greatest distance from the Moon's centre among the states, m.
    pub(in crate::array) fn farthest_m(&self) -> f64 {
        let positions = self.file.segments.iter().flat_map(|segment| &segment.position_m);
        positions.map(|position_m| norm(*position_m)).fold(0.0, f64::max)
    }

    /// Normal of the plane in which it moves.
    pub(in crate::array) fn normal_hat(&self, t_s: f64) -> Vec3 {
        let state = self.state(t_s);
        let normal = cross(state.position_m, state.velocity_m_s);
        scale(1.0 / norm(normal), normal)
    }

    /// Semi-major axis of the ellipse at the epoch, m; of one that is not closed, the distance.
    pub(in crate::array) fn semi_major_axis_m(&self) -> f64 {
        let SatelliteState { position_m, velocity_m_s } = self.state(0.0);
        let radius_m = norm(position_m);
        let inverse = 2.0 / radius_m - dot(velocity_m_s, velocity_m_s) / MOON_GM_M3_S2;
        if inverse * radius_m > 1e-2 { 1.0 / inverse } else { radius_m }
    }

    pub(in crate::array) fn period_s(&self) -> f64 {
        std::f64::consts::TAU * (self.semi_major_axis_m().powi(3) / MOON_GM_M3_S2).sqrt()
    }

    pub(in crate::array) fn inclination_rad(&self) -> f64 {
        self.normal_hat(0.0)[2].clamp(-1.0, 1.0).acos()
    }
}

impl OemSegment {
    /// Newton's polynomial through the states about a time, and its derivative.
    fn state(&self, at_s: f64) -> SatelliteState {
        let (repeats, points) = (self.repeats(), self.points());
        let after = self.time_s.partition_point(|t_s| *t_s <= at_s);
        let first = after.saturating_sub(points.div_ceil(2)).min(self.time_s.len() - points);
        // Times from the middle, so that differences keep their digits.
        let zero_s = self.time_s[first];
        let count = points * repeats;
        let mut times = [0.0; 2 * DEGREE_MAX + 2];
        let mut divided = [[0.0; 3]; 2 * DEGREE_MAX + 2];
        for k in 0..count {
            times[k] = self.time_s[first + k / repeats] - zero_s;
            divided[k] = self.position_m[first + k / repeats];
        }
        for order in 1..count {
            for k in (order..count).rev() {
                let step = times[k] - times[k - order];
                divided[k] = if step == 0.0 {
                    self.velocity_m_s[first + k / repeats]
                } else {
                    scale(1.0 / step, sub(divided[k], divided[k - 1]))
                };
            }
        }
        let tau = at_s - zero_s;
        let (mut position_m, mut velocity_m_s) = (divided[count - 1], [0.0; 3]);
        for k in (0..count - 1).rev() {
            for axis in 0..3 {
                velocity_m_s[axis] = velocity_m_s[axis] * (tau - times[k]) + position_m[axis];
                position_m[axis] = position_m[axis] * (tau - times[k]) + divided[k][axis];
            }
        }
        SatelliteState { position_m, velocity_m_s }
    }
}
