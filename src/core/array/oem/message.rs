//! Orbit Ephemeris Messages (CCSDS 502.0-B-3, section 5), whatever form they are written in.

use std::collections::BTreeMap;

use super::form::{Fault, Message, short};
use crate::array::axes::turned;
use crate::array::bodies::{MoonAxes, Orientation};
use crate::array::state::SatelliteState;
use crate::units::time_scales::{Tai, TimeScale};
use crate::units::vector::{Vec3, norm};

/// Greatest degree of an interpolation.
const DEGREE_MAX: usize = 15;

/// Most that a useable time may lie beyond the states, s: a rounded epoch.
const ROUNDED_S: f64 = 1e-6;

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
pub(in crate::array) struct Metadata(BTreeMap<String, (String, usize)>);

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
    covariances: usize,
}

/// Times of a segment's metadata, each with the line that gives it.
#[derive(Clone, Copy, Debug)]
pub(in crate::array) struct SegmentTimes {
    scale: TimeScale,
    /// Start and stop of the data.
    data: [Option<(Tai, usize)>; 2],
    /// Start and stop of what is to be used.
    useable: [Option<(Tai, usize)>; 2],
}

/// How states are read.
#[derive(Clone, Copy, Debug)]
struct SegmentForm {
    scale: TimeScale,
    axes: Axes,
    times: SegmentTimes,
}

/// Axes on which states are given.
#[derive(Clone, Copy, Debug)]
enum Axes {
    /// They do not turn; whether they are equatorial, else ecliptic.
    Still { equatorial: bool },
    /// They turn with the Moon.
    Moon(MoonAxes),
}

impl Axes {
    /// A state on ecliptic axes.
    fn turned(self, given: SatelliteState, time: Tai) -> SatelliteState {
        match self {
            Self::Moon(axes) => Orientation::at(time).state(axes, given),
            Self::Still { equatorial } => SatelliteState {
                position_m: turned(equatorial, given.position_m),
                velocity_m_s: turned(equatorial, given.velocity_m_s),
            },
        }
    }
}

impl Message for Collector {
    const NAME: &'static str = "OEM";
    const VERSIONS: &'static [&'static str] = &["2.0", "3.0", "1.0"];
    const LINE: &'static str = "an epoch and six finite numbers: position in km, velocity in km/s";
    const COUNTS: &'static [usize] = &[6, 9];
    const STATE: &'static str = "stateVector";
    const NUMBERS: &'static [&'static str] =
        &["X", "Y", "Z", "X_DOT", "Y_DOT", "Z_DOT", "X_DDOT", "Y_DDOT", "Z_DDOT"];

    fn unit(number: usize) -> Option<&'static str> {
        [Some("km"), Some("km/s"), None].get(number / 3).copied().flatten()
    }

    fn covariance(&mut self) {
        self.covariances += 1;
    }

    fn begin_metadata(&mut self) {
        self.metadata = Metadata::default();
    }

    fn set(&mut self, key: &str, value: &str, line: usize) -> Result<(), Fault> {
        // Positions do not depend on others.
        const USED: [&str; 9] = [
            "CENTER_NAME",
            "REF_FRAME",
            "TIME_SYSTEM",
            "START_TIME",
            "STOP_TIME",
            "INTERPOLATION",
            "INTERPOLATION_DEGREE",
            "USEABLE_START_TIME",
            "USEABLE_STOP_TIME",
        ];
        self.metadata.set(&USED, key, value, line)
    }

    /// Begins a segment with the metadata that end in a line.
    fn end_metadata(&mut self, line: usize) -> Result<(), Fault> {
        let metadata = std::mem::take(&mut self.metadata);
        // GMAT calls the Moon Luna.
        metadata.require("CENTER_NAME", &["MOON", "LUNA"], "CENTER_NAME = MOON", line)?;
        let axes = metadata.axes(line)?;
        let scale = metadata.scale(line)?;
        let (method, degree) = metadata.interpolation(line)?;
        let times = metadata.times(scale, line)?;
        self.scale.get_or_insert(scale);
        self.of_segment = Some(SegmentForm { scale, axes, times });
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
    fn state(&mut self, epoch: &str, numbers: &[f64], line: usize) -> Result<(), Fault> {
        let (Some(form), Some(segment), Some(lines)) =
            (self.of_segment, self.segments.last_mut(), self.lines.last_mut())
        else {
            return Err(Fault::new(line, short(epoch), "metadata before states"));
        };
        let time = read_epoch(epoch, form.scale, line)?;
        let Some([x, y, z, vx, vy, vz]) =
            numbers.first_chunk().filter(|six| six.iter().all(|x| x.is_finite()))
        else {
            return Err(Fault::new(line, format!("{} numbers after {epoch}", numbers.len()), Self::LINE));
        };
        let zero = *self.zero.get_or_insert_with(|| time.floor_second());
        let time_s = time.since_s(zero);
        if segment.time_s.last().is_some_and(|before| *before >= time_s) {
            let expected = "epochs in rising order: each later than the one before";
            return Err(Fault::new(line, short(epoch), expected));
        }
        let [position_m, velocity_m_s] = [[*x, *y, *z], [*vx, *vy, *vz]].map(|v| v.map(|km| 1e3 * km));
        let SatelliteState { position_m, velocity_m_s } =
            form.axes.turned(SatelliteState { position_m, velocity_m_s }, time);
        if norm(velocity_m_s) > 1e5 {
            return Err(Fault::new(
                line,
                format!("{:.3e} km/s", norm(velocity_m_s) / 1e3),
                "a velocity below 100 km/s",
            ));
        }
        segment.time_s.push(time_s);
        segment.position_m.push(position_m);
        segment.velocity_m_s.push(velocity_m_s);
        lines.push(u32::try_from(line).unwrap_or(u32::MAX));
        Ok(())
    }

    /// Ends the latest segment, if there is one.
    fn end_segment(&mut self, line: usize) -> Result<(), Fault> {
        let Some(form) = self.of_segment.take() else { return Ok(()) };
        let (Some(segment), Some(zero)) = (self.segments.last_mut(), self.zero) else {
            return Err(Fault::new(line, "0 states", ENOUGH));
        };
        if segment.time_s.len() < segment.points().max(2) {
            return Err(Fault::new(line, format!("{} states", segment.time_s.len()), ENOUGH));
        }
        segment.useable_s = form.times.useable_s(zero, &segment.time_s)?;
        Ok(())
    }
}

impl Collector {
    /// The message, whose segments have ended, with its last line.
    pub(super) fn finish(self, line: usize) -> Result<Reading, Fault> {
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
    /// Takes a value, if its key is one of those that are used.
    pub(in crate::array) fn set(
        &mut self,
        used: &[&str],
        key: &str,
        value: &str,
        line: usize,
    ) -> Result<(), Fault> {
        if !used.contains(&key) {
            return Ok(());
        }
        match self.0.insert(key.to_owned(), (value.to_uppercase(), line)) {
            None => Ok(()),
            Some((_, first)) => {
                let expected = format!("{key} once in a segment's metadata: line {first} has it, too");
                Err(Fault::new(line, format!("{key} again"), expected))
            }
        }
    }

    /// The scale of its dates.
    pub(in crate::array) fn scale(&self, end: usize) -> Result<TimeScale, Fault> {
        let (system, line) = self.value("TIME_SYSTEM", end);
        let expected = "TIME_SYSTEM = UTC, TAI, TT, TDB or GPS";
        TimeScale::from_name(system).ok_or_else(|| Fault::new(line, system, expected))
    }

    /// Times of the segment, those that are given.
    pub(in crate::array) fn times(&self, scale: TimeScale, end: usize) -> Result<SegmentTimes, Fault> {
        let of = |key| self.date(key, scale, end);
        Ok(SegmentTimes {
            scale,
            data: [of("START_TIME")?, of("STOP_TIME")?],
            useable: [of("USEABLE_START_TIME")?, of("USEABLE_STOP_TIME")?],
        })
    }

    /// The value of a key and its line; `nothing`, at the end of the metadata, if it is not given.
    pub(in crate::array) fn value(&self, key: &str, end: usize) -> (&str, usize) {
        self.0.get(key).map_or(("nothing", end), |(value, line)| (value, *line))
    }

    fn require(&self, key: &str, names: &[&str], expected: &str, end: usize) -> Result<(), Fault> {
        let (value, line) = self.value(key, end);
        if names.contains(&value) { Ok(()) } else { Err(Fault::new(line, value, expected)) }
    }

    /// Whether the axes that a key names are those of the equator: of J2000, which ICRF's meet to 0.02 arc seconds (20 cm at the
    /// Moon's surface). Else they are those of the ecliptic.
    pub(in crate::array) fn is_equatorial(&self, key: &str, end: usize) -> Result<bool, Fault> {
        let (frame, line) = self.value(key, end);
        let numbered = |name: &str| {
            frame
                .strip_prefix(name)
                .is_some_and(|rest| rest.len() < 3 && rest.bytes().all(|b| b.is_ascii_digit()))
        };
        if ["EME2000", "J2000", "ECLIPJ2000"].contains(&frame) || numbered("ICRF") || numbered("GCRF") {
            return Ok(frame != "ECLIPJ2000");
        }
        let expected = "EME2000, J2000, ICRF, ICRF1 to 3, GCRF or ECLIPJ2000: axes that do not turn; of orbits also MOON_ME or \
                        MOON_PA, which are fixed to the Moon";
        Err(Fault::new(line, frame, format!("{key} = {expected}")))
    }

    /// The axes of an orbit.
    fn axes(&self, end: usize) -> Result<Axes, Fault> {
        let key = "REF_FRAME";
        match MoonAxes::from_name(self.value(key, end).0) {
            Some(axes) => Ok(Axes::Moon(axes)),
            None => Ok(Axes::Still { equatorial: self.is_equatorial(key, end)? }),
        }
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

/// Reads the epoch of a state.
pub(in crate::array) fn read_epoch(epoch: &str, scale: TimeScale, line: usize) -> Result<Tai, Fault> {
    Tai::parse(epoch, scale).ok_or_else(|| {
        let expected = format!(
            "an epoch on {scale} such as 2030-01-31T12:00:00.000 or 2030-031T12:00:00; UTC from 1972 on, with a second 60 only \
             where there was a leap second"
        );
        Fault::new(line, short(epoch), expected)
    })
}

impl SegmentTimes {
    /// The interval in which a segment is to be used, s after `zero`, of one whose states have these times, two or more. States must lie
    /// between START_TIME and STOP_TIME, to a step; where these promise more, nothing is known there.
    pub(in crate::array) fn useable_s(&self, zero: Tai, time_s: &[f64]) -> Result<[f64; 2], Fault> {
        let (Some(&first_s), Some(&last_s)) = (time_s.first(), time_s.last()) else { return Ok([0.0; 2]) };
        let step_s = time_s.windows(2).map(|pair| pair[1] - pair[0]).fold(0.0, f64::max);
        let mut useable_s = [first_s, last_s];
        for (end, name) in ["START_TIME", "STOP_TIME"].into_iter().enumerate() {
            let fault = |key: String, (time, line): (Tai, usize)| {
                let [first, last] = [first_s, last_s].map(|s| zero.plus_s(s).text(self.scale, 3));
                let found = format!("{key} = {}", time.text(self.scale, 3));
                Err(Fault::new(line, found, format!("one that fits the states, {first} to {last}")))
            };
            if let Some(given) = self.data[end] {
                let at_s = given.0.since_s(zero);
                let outside_s = if end == 0 { at_s - first_s } else { last_s - at_s };
                if outside_s > step_s + ROUNDED_S {
                    return fault(name.to_owned(), given);
                }
            }
            if let Some(given) = self.useable[end] {
                let at_s = given.0.since_s(zero);
                if (first_s - at_s).max(at_s - last_s) > ROUNDED_S {
                    return fault(format!("USEABLE_{name}"), given);
                }
                useable_s[end] = at_s.clamp(first_s, last_s);
            }
        }
        if useable_s[0] >= useable_s[1] {
            let line = self.useable.iter().flatten().map(|(_, line)| *line).max().unwrap_or_default();
            let found = "useable times that end before they begin";
            return Err(Fault::new(line, found, "USEABLE_START_TIME before USEABLE_STOP_TIME"));
        }
        Ok(useable_s)
    }
}
