//! Orbit Ephemeris Messages (CCSDS 502.0-B-3, section 5), whatever form they are written in.

use std::collections::BTreeMap;

use crate::units::time_scales::{Tai, TimeScale};
use crate::units::vector::{Vec3, norm};

/// Obliquity of the ecliptic of J2000 (IAU 1976): 84381.448 arc seconds.
const OBLIQUITY_DEG: f64 = 84_381.448 / 3600.0;

/// Greatest degree of an interpolation.
pub(super) const DEGREE_MAX: usize = 15;

/// Most that a useable time may lie beyond the states, s: a rounded epoch.
const ROUNDED_S: f64 = 1e-6;

/// A fault of a file: its line, from 1, what was found, and what was expected there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Fault {
    pub(super) line: usize,
    pub(super) found: String,
    pub(super) expected: String,
}

impl Fault {
    pub(super) fn new(line: usize, found: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { line, found: found.into(), expected: expected.into() }
    }
}

/// How a file asks to be interpolated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TableMethod {
    /// Through positions.
    Lagrange,
    /// Through positions and velocities.
    Hermite,
}

/// Positions and velocities of one segment, on ecliptic axes.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct OemSegment {
    pub(super) method: TableMethod,
    pub(super) degree: usize,
    /// First and last time at which the segment is to be used, s of TAI after the file's zero.
    pub(super) useable_s: [f64; 2],
    /// Seconds of TAI after the file's zero.
    pub(super) time_s: Vec<f64>,
    pub(super) position_m: Vec<Vec3>,
    pub(super) velocity_m_s: Vec<Vec3>,
}

impl OemSegment {
    /// Values that a state carries to the polynomial: its position, and its velocity.
    pub(super) fn repeats(&self) -> usize {
        match self.method {
            TableMethod::Lagrange => 1,
            TableMethod::Hermite => 2,
        }
    }

    /// States that the polynomial goes through.
    pub(super) fn points(&self) -> usize {
        (self.degree + 1).div_ceil(self.repeats())
    }
}

/// Content of one file.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct OemMessage {
    /// From which its seconds count: the second in which its first state is.
    pub(super) zero: Tai,
    pub(super) segments: Vec<OemSegment>,
}

/// A message with what is of use only while it is checked.
#[derive(Debug)]
pub(super) struct Reading {
    pub(super) message: OemMessage,
    /// Line of each state, by segment.
    pub(super) lines: Vec<Vec<u32>>,
    /// Scale of the first segment's dates.
    pub(super) scale: TimeScale,
    /// Matrices of covariance that were passed over.
    pub(super) covariances: usize,
}

/// Values of a segment's metadata, with their lines.
#[derive(Debug, Default)]
struct Metadata(BTreeMap<String, (String, usize)>);

/// Gathers a message as its form is read.
#[derive(Debug, Default)]
pub(super) struct Collector {
    zero: Option<Tai>,
    scale: Option<TimeScale>,
    metadata: Metadata,
    /// How the latest segment's states are read.
    of_segment: Option<SegmentForm>,
    segments: Vec<OemSegment>,
    lines: Vec<Vec<u32>>,
    pub(super) covariances: usize,
}

/// How states are read.
#[derive(Clone, Copy, Debug)]
struct SegmentForm {
    scale: TimeScale,
    /// Whether its axes are equatorial.
    turns: bool,
    /// Useable times and the lines that give them.
    useable: [Option<(Tai, usize)>; 2],
}

impl Collector {
    pub(super) fn begin_metadata(&mut self) {
        self.metadata = Metadata::default();
    }

    pub(super) fn set(&mut self, key: &str, value: &str, line: usize) {
        // Others say what the data say, or nothing on which positions depend.
        const USED: [&str; 7] = [
            "CENTER_NAME",
            "REF_FRAME",
            "TIME_SYSTEM",
            "INTERPOLATION",
            "INTERPOLATION_DEGREE",
            "USEABLE_START_TIME",
            "USEABLE_STOP_TIME",
        ];
        if USED.contains(&key) {
            self.metadata.0.insert(key.to_owned(), (value.to_uppercase(), line));
        }
    }

    /// Begins a segment with the metadata that end in a line.
    pub(super) fn end_metadata(&mut self, line: usize) -> Result<(), Fault> {
        let metadata = std::mem::take(&mut self.metadata);
        metadata.require("CENTER_NAME", &["MOON"], "CENTER_NAME = MOON", line)?;
        let frame = metadata.frame(line)?;
        let expected = "TIME_SYSTEM = UTC, TAI, TT, TDB or GPS";
        let (system, at) = metadata.value("TIME_SYSTEM", line);
        let Some(scale) = TimeScale::from_name(system) else { return Err(Fault::new(at, system, expected)) };
        let (method, degree) = metadata.interpolation(line)?;
        let useable = [
            metadata.date("USEABLE_START_TIME", scale, line)?,
            metadata.date("USEABLE_STOP_TIME", scale, line)?,
        ];
        self.scale.get_or_insert(scale);
        self.of_segment = Some(SegmentForm { scale, turns: frame != "ECLIPJ2000", useable });
        self.segments.push(OemSegment {
            method,
            degree,
            useable_s: [f64::NEG_INFINITY, f64::INFINITY],
            time_s: Vec::new(),
            position_m: Vec::new(),
            velocity_m_s: Vec::new(),
        });
        self.lines.push(Vec::new());
        Ok(())
    }

    /// Adds a state of the latest segment, km and km/s.
    pub(super) fn state(&mut self, epoch: &str, numbers: &[f64], line: usize) -> Result<(), Fault> {
        let (Some(form), Some(segment), Some(lines)) =
            (self.of_segment, self.segments.last_mut(), self.lines.last_mut())
        else {
            return Err(Fault::new(line, short(epoch), "metadata before states"));
        };
        let Some(time) = Tai::parse(epoch, form.scale) else {
            let expected = format!(
                "an epoch on {} such as 2030-01-31T12:00:00.000 or 2030-031T12:00:00; UTC from 1972 on, with a second 60 only \
                 where there was a leap second",
                form.scale
            );
            return Err(Fault::new(line, short(epoch), expected));
        };
        let Some([x, y, z, vx, vy, vz]) =
            numbers.first_chunk().filter(|six| six.iter().all(|x| x.is_finite()))
        else {
            let expected = "an epoch and six finite numbers: position in km, velocity in km/s";
            return Err(Fault::new(line, format!("{} numbers after {epoch}", numbers.len()), expected));
        };
        let zero = *self.zero.get_or_insert_with(|| time.floor_second());
        let time_s = time.since_s(zero);
        if segment.time_s.last().is_some_and(|before| *before >= time_s) {
            let expected = "epochs in rising order: each later than the one before";
            return Err(Fault::new(line, short(epoch), expected));
        }
        let metres = |v: [f64; 3]| turned(form.turns, v.map(|km| 1e3 * km));
        let velocity_m_s = metres([*vx, *vy, *vz]);
        if norm(velocity_m_s) > 1e5 {
            return Err(Fault::new(
                line,
                format!("{:.3e} km/s", norm(velocity_m_s) / 1e3),
                "a velocity below 100 km/s",
            ));
        }
        segment.time_s.push(time_s);
        segment.position_m.push(metres([*x, *y, *z]));
        segment.velocity_m_s.push(velocity_m_s);
        lines.push(u32::try_from(line).unwrap_or(u32::MAX));
        Ok(())
    }

    /// Ends the latest segment, if there is one.
    pub(super) fn end_segment(&mut self, line: usize) -> Result<(), Fault> {
        let Some(form) = self.of_segment.take() else { return Ok(()) };
        let (Some(segment), Some(zero)) = (self.segments.last_mut(), self.zero) else {
            return Err(Fault::new(line, "0 states", ENOUGH));
        };
        let (Some(&first_s), Some(&last_s)) = (segment.time_s.first(), segment.time_s.last()) else {
            return Err(Fault::new(line, "0 states", ENOUGH));
        };
        if segment.time_s.len() < segment.points().max(2) {
            return Err(Fault::new(line, format!("{} states", segment.time_s.len()), ENOUGH));
        }
        segment.useable_s = [first_s, last_s];
        for (end, given) in form.useable.into_iter().enumerate() {
            let Some((time, at)) = given else { continue };
            let time_s = time.since_s(zero);
            if !(first_s - ROUNDED_S..=last_s + ROUNDED_S).contains(&time_s) {
                let ends = [first_s, last_s].map(|s| zero.plus_s(s).text(form.scale, 3));
                let found = format!("a USEABLE time of {}", time.text(form.scale, 3));
                return Err(Fault::new(
                    at,
                    found,
                    format!("one among the states, {} to {}", ends[0], ends[1]),
                ));
            }
            segment.useable_s[end] = time_s.clamp(first_s, last_s);
        }
        let [from_s, until_s] = segment.useable_s;
        if from_s >= until_s {
            let at = form.useable.iter().flatten().map(|(_, at)| *at).max().unwrap_or(line);
            return Err(Fault::new(
                at,
                "useable times that end before they begin",
                "USEABLE_START_TIME before USEABLE_STOP_TIME",
            ));
        }
        Ok(())
    }

    /// The message that ends in a line.
    pub(super) fn finish(mut self, line: usize) -> Result<Reading, Fault> {
        self.end_segment(line)?;
        let (Some(zero), Some(scale)) = (self.zero, self.scale) else {
            return Err(Fault::new(line, "the end", "a segment: metadata and states"));
        };
        Ok(Reading {
            message: OemMessage { zero, segments: self.segments },
            lines: self.lines,
            scale,
            covariances: self.covariances,
        })
    }
}

const ENOUGH: &str = "as many states in a segment as its interpolation needs";

impl Metadata {
    /// The value of a key and its line; `nothing`, at the end of the metadata, if it is not given.
    fn value(&self, key: &str, end: usize) -> (&str, usize) {
        self.0.get(key).map_or(("nothing", end), |(value, line)| (value, *line))
    }

    fn require(&self, key: &str, names: &[&str], expected: &str, end: usize) -> Result<(), Fault> {
        let (value, line) = self.value(key, end);
        if names.contains(&value) { Ok(()) } else { Err(Fault::new(line, value, expected)) }
    }

    /// The name of the axes: those of J2000 of the equator, which ICRF's meet to 0.02 arc seconds (20 cm at the Moon's surface), or
    /// of the ecliptic.
    fn frame(&self, end: usize) -> Result<&str, Fault> {
        let (frame, line) = self.value("REF_FRAME", end);
        let numbered = |name: &str| {
            frame
                .strip_prefix(name)
                .is_some_and(|rest| rest.len() < 3 && rest.bytes().all(|b| b.is_ascii_digit()))
        };
        if ["EME2000", "J2000", "ECLIPJ2000"].contains(&frame) || numbered("ICRF") || numbered("GCRF") {
            return Ok(frame);
        }
        let expected = match frame.starts_with("MOON") {
            true => {
                "REF_FRAME = EME2000, J2000, ICRF, GCRF or ECLIPJ2000: axes fixed to the Moon are not read; convert the file"
            }
            false => {
                "REF_FRAME = EME2000, J2000, ICRF, ICRF1 to 3, GCRF or ECLIPJ2000: axes that do not turn"
            }
        };
        Err(Fault::new(line, frame, expected))
    }

    fn interpolation(&self, end: usize) -> Result<(TableMethod, usize), Fault> {
        let method = match self.0.get("INTERPOLATION").map(|(value, line)| (value.as_str(), *line)) {
            None | Some(("HERMITE", _)) => TableMethod::Hermite,
            Some(("LAGRANGE", _)) => TableMethod::Lagrange,
            Some((other, line)) => {
                return Err(Fault::new(line, other, "INTERPOLATION = HERMITE or LAGRANGE"));
            }
        };
        let (degree, line) = self.value("INTERPOLATION_DEGREE", end);
        let number = if degree == "nothing" { Some(7) } else { degree.parse().ok() };
        match number.filter(|degree| (1..=DEGREE_MAX).contains(degree)) {
            Some(number) => Ok((method, number)),
            None => Err(Fault::new(line, degree, "INTERPOLATION_DEGREE = 1 to 15")),
        }
    }

    /// A date and its line, if it is given.
    fn date(&self, key: &str, scale: TimeScale, end: usize) -> Result<Option<(Tai, usize)>, Fault> {
        if !self.0.contains_key(key) {
            return Ok(None);
        }
        let (text, line) = self.value(key, end);
        match Tai::parse(text, scale) {
            Some(time) => Ok(Some((time, line))),
            None => Err(Fault::new(
                line,
                short(text),
                format!("{key} = a date on {scale}, such as 2030-01-31T12:00:00.000"),
            )),
        }
    }
}

/// The beginning of a line, for messages.
pub(super) fn short(content: &str) -> String {
    let mut text: String = content.chars().take(60).filter(|c| !c.is_control()).collect();
    if text.len() < content.len() {
        text.push_str("..");
    }
    format!("{text:?}")
}

/// From equatorial to ecliptic axes.
fn turned(turns: bool, v: Vec3) -> Vec3 {
    if !turns {
        return v;
    }
    let (sin, cos) = OBLIQUITY_DEG.to_radians().sin_cos();
    [v[0], cos * v[1] + sin * v[2], cos * v[2] - sin * v[1]]
}

/// From ecliptic to equatorial axes.
pub(in crate::array) fn to_equatorial(v: Vec3) -> Vec3 {
    let (sin, cos) = OBLIQUITY_DEG.to_radians().sin_cos();
    [v[0], cos * v[1] - sin * v[2], cos * v[2] + sin * v[1]]
}
