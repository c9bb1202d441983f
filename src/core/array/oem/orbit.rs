//! Orbits given by tables of positions and velocities.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;

use super::checks::check;
use super::file::{at_line, at_segment, error, parse_content, read_content};
use super::interpolate::interpolated;
use super::message::{Collector, OemMessage, OemSegment, Reading, TableMethod};
use super::spk::{self, Kernel};
use crate::array::config::{ArrayConfig, ArrayError};
use crate::array::state::SatelliteState;
use crate::units::constants::MOON_GM_M3_S2;
use crate::units::time_scales::{Tai, TimeScale};
use crate::units::vector::{Vec3, cross, dot, norm, scale, sub};

/// An orbit from a file. Cheap to clone.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::array) struct TableOrbit {
    message: Arc<OemMessage>,
    /// Epoch of the mission in the message's seconds.
    epoch_s: f64,
    /// Interval in which positions are known without a gap, of the mission's time.
    span_s: [f64; 2],
}

/// States of one orbit, at rising times, without a jump.
#[derive(Clone, Debug, Default)]
pub(in crate::array) struct TableSpan {
    time_s: Vec<f64>,
    position_m: Vec<Vec3>,
    velocity_m_s: Vec<Vec3>,
}

impl TableSpan {
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

/// Nearest that two satellites may be at any state of the first, m.
const APART_M: f64 = 1.0;

/// How far beyond its states an orbit goes on, s: ticks of time tags. Farther out nothing is known, and states are not numbers.
const BEYOND_S: f64 = 1.0;

/// Gap between segments that still counts as continuous, s: rounded epochs.
const SEAM_S: f64 = 1e-6;

/// The orbits of all satellites.
#[derive(Clone, Debug)]
pub(in crate::array) struct OemOrbits {
    pub(in crate::array) orbits: Vec<TableOrbit>,
    /// Epoch of the mission.
    pub(in crate::array) epoch: Tai,
    /// Content of the files that is not used.
    pub(in crate::array) notes: Vec<String>,
}

/// An orbit of a file, and what of the file is not used.
struct FileOrbit {
    path: PathBuf,
    reading: Reading,
    note: Option<String>,
}

/// Reads the files of all satellites, which are as many as the files have orbits. The mission begins at `epoch`, a date in UTC if it ends
/// with Z, else in their time system, or with the last to begin.
pub(in crate::array) fn read(config: &ArrayConfig) -> Result<OemOrbits, ArrayError> {
    let ArrayConfig { oem, oem_epoch, moon_radius_m, satellites, .. } = config;
    let files: Vec<Result<Vec<FileOrbit>, ArrayError>> =
        oem.par_iter().map(|path| read_orbits(path, *moon_radius_m)).collect();
    // Of several errors the first file's.
    let files: Vec<Vec<FileOrbit>> = files.into_iter().collect::<Result<_, _>>()?;
    let files: Vec<FileOrbit> = files.into_iter().flatten().collect();
    if let Some(last) = files.last().filter(|_| files.len() != *satellites) {
        let found = format!("with it the files of array.oem have {} orbits", files.len());
        return Err(error(
            &last.path,
            format!("{found}; expected as many as array.satellites = {satellites}"),
        ));
    }
    let epoch = epoch_of(&files, oem_epoch)?;
    let mut orbits = Vec::with_capacity(files.len());
    let mut notes = Vec::new();
    let mut paths = Vec::new();
    for FileOrbit { path, reading, note } in files {
        notes.extend(note);
        let Reading { message, scale, .. } = reading;
        let text = |s: f64| format!("{} {scale}", message.zero.plus_s(s).text(scale, 3));
        let epoch_s = epoch.since_s(message.zero);
        let Some(span_s) = message.span_s(epoch_s) else {
            let spans: Vec<String> =
                message.segments.iter().take(4).map(|s| s.useable_s.map(text).join(" to ")).collect();
            let found = format!(
                "nothing at the mission's epoch, {}; expected states then, and they go from {}",
                text(epoch_s),
                spans.join(", ")
            );
            return Err(error(&path, found));
        };
        orbits.push(TableOrbit { epoch_s, span_s, message: Arc::new(message) });
        paths.push(path);
    }
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
    Ok(OemOrbits { orbits, epoch, notes })
}

/// The mission's epoch, to the digits that time codes have.
fn epoch_of(files: &[FileOrbit], epoch: &str) -> Result<Tai, ArrayError> {
    let begins = |FileOrbit { reading, .. }: &FileOrbit| {
        let first = reading.message.segments.first();
        reading.message.zero.plus_s(first.map_or(0.0, |segment| segment.useable_s[0]))
    };
    let latest = files.iter().map(begins).reduce(|a, b| if b > a { b } else { a });
    let (Some(latest), Some(FileOrbit { path, reading: first, .. })) = (latest, files.first()) else {
        return Ok(Tai::from_seconds_since_1958(0.0));
    };
    let given = if epoch.is_empty() {
        latest
    } else {
        let scale = if epoch.ends_with('Z') { TimeScale::Utc } else { first.scale };
        let other = files.iter().find(|file| file.reading.scale != scale);
        if let Some(FileOrbit { path, reading, .. }) = other.filter(|_| !epoch.ends_with('Z')) {
            return Err(error(
                path,
                format!(
                    "TIME_SYSTEM = {}; expected {} as in the first file, where array.oem_epoch is a date in it",
                    reading.scale, first.scale
                ),
            ));
        }
        Tai::parse(epoch, scale)
            .ok_or_else(|| error(path, format!("array.oem_epoch = {epoch:?}; expected a date on {scale}")))?
    };
    Ok(Tai::from_seconds_since_1958(given.seconds_since_1958()))
}

/// Reads the orbits of a file: one of a message, those of all objects of a kernel.
fn read_orbits(path: &Path, moon_radius_m: f64) -> Result<Vec<FileOrbit>, ArrayError> {
    let bytes = read_content(path)?;
    let orbit = |reading, note| FileOrbit { path: path.to_owned(), reading, note };
    if !spk::is_daf(&bytes) {
        let (collector, line) = parse_content::<Collector>(path, &bytes)?;
        let reading = collector.finish(line);
        let reading = reading.and_then(|reading| check(&reading, moon_radius_m).map(|()| reading));
        let reading = reading.map_err(|fault| at_line(path, fault))?;
        let unused = reading.covariances;
        let note = (unused > 0).then(|| format!("{}: {unused} covariances are not used", path.display()));
        return Ok(vec![orbit(reading, note)]);
    }
    let Kernel { objects, other_centres } =
        spk::read(&bytes).map_err(|fault| at_segment(path, None, fault))?;
    let mut note = (other_centres > 0).then(|| {
        let path = path.display();
        format!("{path}: {other_centres} segments about other centres than the Moon are not used")
    });
    let checked = |(object, reading): (i32, Reading)| {
        check(&reading, moon_radius_m).map_err(|fault| at_segment(path, Some(object), fault))?;
        Ok(orbit(reading, note.take()))
    };
    objects.into_iter().map(checked).collect()
}

/// A time, s since the epoch, at which two orbits meet, among the states of both.
fn meeting_s(first: &TableOrbit, second: &TableOrbit) -> Option<f64> {
    let times = |orbit: &TableOrbit| -> Vec<f64> {
        orbit.message.segments.iter().flat_map(|s| &s.time_s).map(|t_s| t_s - orbit.epoch_s).collect()
    };
    let ([from, to], [start, end]) = (first.span_s(), second.span_s());
    let common = |t_s: &f64| (from.max(start)..=to.min(end)).contains(t_s);
    times(first)
        .into_iter()
        .chain(times(second))
        .filter(common)
        .find(|&t_s| norm(sub(first.state(t_s).position_m, second.state(t_s).position_m)) < APART_M)
}

impl OemMessage {
    /// From when to when there is no gap about a time, s; `None` if nothing is known then.
    fn span_s(&self, at_s: f64) -> Option<[f64; 2]> {
        let mut spans: Vec<[f64; 2]> = Vec::new();
        for OemSegment { useable_s, .. } in &self.segments {
            match spans.last_mut() {
                Some(last) if useable_s[0] - last[1] <= SEAM_S => last[1] = last[1].max(useable_s[1]),
                _ => spans.push(*useable_s),
            }
        }
        // The epoch is rounded to half a microsecond.
        spans.into_iter().find(|[from_s, until_s]| (from_s - SEAM_S..=until_s + SEAM_S).contains(&at_s))
    }
}

impl TableOrbit {
    /// An orbit through states at times after the mission's epoch; each stretch, of four states or more, begins when the one
    /// before ends.
    pub(in crate::array) fn of_stretches(stretches: Vec<TableSpan>) -> Self {
        let segment = |TableSpan { time_s, position_m, velocity_m_s }| OemSegment {
            method: TableMethod::Hermite,
            degree: 7,
            useable_s: [time_s.first(), time_s.last()].map(|s| s.copied().unwrap_or_default()),
            time_s,
            position_m,
            velocity_m_s,
        };
        let segments: Vec<OemSegment> = stretches.into_iter().map(segment).collect();
        let message = OemMessage { zero: Tai::from_seconds_since_1958(0.0), segments };
        let span_s = message.span_s(0.0).unwrap_or_default();
        Self { message: Arc::new(message), epoch_s: 0.0, span_s }
    }

    /// The states of the table that are to be used, at times since the mission's epoch; where useable times lie between states, also
    /// those then.
    pub(in crate::array) fn table_spans(&self) -> Vec<TableSpan> {
        let stretch = |segment: &OemSegment| {
            let [from_s, until_s] = segment.useable_s;
            let first = segment.time_s.partition_point(|t_s| *t_s < from_s);
            let end = segment.time_s.partition_point(|t_s| *t_s <= until_s);
            // An end between two states gets one of its own.
            let own = |t_s: f64, k: usize| {
                segment.time_s.get(k).is_none_or(|known_s| *known_s != t_s).then_some(t_s)
            };
            let mut out = TableSpan::default();
            let mut add = |t_s: f64| out.push(t_s - self.epoch_s, segment.state(t_s));
            own(from_s, first).into_iter().for_each(&mut add);
            segment.time_s[first..end].iter().copied().for_each(&mut add);
            own(until_s, end.saturating_sub(1)).into_iter().for_each(&mut add);
            out
        };
        self.message.segments.iter().filter(|segment| self.is_within(segment)).map(stretch).collect()
    }

    /// Whether a segment is of the time about the epoch without a gap.
    fn is_within(&self, segment: &OemSegment) -> bool {
        self.span_s[0] <= segment.useable_s[0] && segment.useable_s[1] <= self.span_s[1]
    }

    /// Memory of the states, bytes; clones share it.
    pub(in crate::array) fn table_bytes(&self) -> u64 {
        let states: usize = self.message.segments.iter().map(|segment| segment.time_s.len()).sum();
        (states * (size_of::<f64>() + 2 * size_of::<Vec3>())) as u64
    }

    /// First and last time, s since the mission's epoch, between which positions are known without a gap.
    pub(in crate::array) fn span_s(&self) -> [f64; 2] {
        // The epoch is rounded to half a microsecond.
        let since = |t_s: f64| if (t_s - self.epoch_s).abs() < SEAM_S { 0.0 } else { t_s - self.epoch_s };
        self.span_s.map(since)
    }

    /// Position and velocity; beyond what is known they are not numbers.
    pub(in crate::array) fn state(&self, t_s: f64) -> SatelliteState {
        let at_s = t_s + self.epoch_s;
        let [from_s, until_s] = self.span_s;
        if !(from_s - BEYOND_S..=until_s + BEYOND_S).contains(&at_s) {
            return SatelliteState { position_m: [f64::NAN; 3], velocity_m_s: [f64::NAN; 3] };
        }
        let inside_s = at_s.clamp(from_s, until_s);
        let segments = &self.message.segments;
        let after = segments.partition_point(|segment| segment.useable_s[0] <= inside_s);
        segments[after.saturating_sub(1)].state(at_s)
    }

    /// Greatest distance from the Moon's centre among the states, m.
    pub(in crate::array) fn farthest_m(&self) -> f64 {
        let positions = self.message.segments.iter().flat_map(|segment| &segment.position_m);
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
    /// Position and velocity by the file's own interpolation.
    fn state(&self, at_s: f64) -> SatelliteState {
        interpolated(self, self.method, self.points(), at_s)
    }
}
