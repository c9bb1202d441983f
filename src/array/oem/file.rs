//! Orbit Ephemeris Messages (CCSDS 502.0-B-2, section 5) in KVN, the text form.

use crate::units::calendar::epoch_s;
use crate::units::vector::{Vec3, norm};

/// Obliquity of the ecliptic of J2000 (IAU 1976): 84381.448 arc seconds.
const OBLIQUITY_DEG: f64 = 84_381.448 / 3600.0;

/// Greatest degree of an interpolation.
pub(super) const DEGREE_MAX: usize = 15;

/// What a file may be wrong in: its line, from 1, what was found, and what was expected there.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Fault {
    pub(super) line: usize,
    pub(super) found: String,
    pub(super) expected: &'static str,
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
    /// First line of its data.
    pub(super) line: usize,
    /// Seconds from 1970-01-01T00:00:00 in the file's time system, days of 86,400 s.
    pub(super) time_s: Vec<f64>,
    pub(super) position_m: Vec<Vec3>,
    pub(super) velocity_m_s: Vec<Vec3>,
}

/// A file: its time system and its segments.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct OemFile {
    pub(super) time_system: String,
    pub(super) segments: Vec<OemSegment>,
}

/// What the metadata of a segment say.
#[derive(Default)]
struct Metadata {
    center: Option<String>,
    frame: Option<String>,
    time_system: Option<String>,
    method: Option<String>,
    degree: Option<String>,
}

/// Where the reader is.
#[derive(PartialEq)]
enum Place {
    Header,
    Metadata,
    Data,
    Covariance,
}

/// Reads a file.
///
/// # Errors
/// The first thing that is wrong.
pub(super) fn parse(text: &str) -> Result<OemFile, Fault> {
    let mut place = Place::Header;
    let mut is_oem = false;
    let mut metadata = Metadata::default();
    let mut turns = false;
    let mut file = OemFile { time_system: String::new(), segments: Vec::new() };
    let mut last = 0;
    for (line, content) in text.lines().enumerate().map(|(k, content)| (k + 1, content.trim())) {
        last = line;
        let fault = |expected| Fault { line, found: short(content), expected };
        if content.is_empty() || content.starts_with("COMMENT") {
            continue;
        }
        match content {
            "META_START" if place != Place::Metadata => {
                if !is_oem {
                    return Err(fault("CCSDS_OEM_VERS = 2.0 on the first line"));
                }
                end_of_data(&file, line)?;
                (place, metadata) = (Place::Metadata, Metadata::default());
                continue;
            }
            "META_STOP" if place == Place::Metadata => {
                let segment = metadata.segment(line)?;
                turns = metadata.frame.as_deref() != Some("ECLIPJ2000");
                let system = metadata.time_system.take().unwrap_or_default();
                if !file.segments.is_empty() && system != file.time_system {
                    return Err(Fault { line, found: system, expected: "one TIME_SYSTEM in all segments" });
                }
                file.time_system = system;
                file.segments.push(segment);
                place = Place::Data;
                continue;
            }
            "COVARIANCE_START" if place == Place::Data => {
                place = Place::Covariance;
                continue;
            }
            "COVARIANCE_STOP" if place == Place::Covariance => {
                place = Place::Data;
                continue;
            }
            _ => {}
        }
        match (&place, content.split_once('=')) {
            (Place::Header, Some((key, version))) => {
                if key.trim() == "CCSDS_OEM_VERS" {
                    is_oem = ["1.0", "2.0", "3.0"].contains(&version.trim());
                }
                if !is_oem {
                    return Err(fault("CCSDS_OEM_VERS = 1.0, 2.0 or 3.0 on the first line"));
                }
            }
            (Place::Metadata, Some((key, value))) => metadata.set(key.trim(), value.trim()),
            (Place::Data, None) => {
                let Some(segment) = file.segments.last_mut() else { continue };
                data_line(content, line, turns, segment)?;
            }
            (Place::Covariance, _) => {}
            (Place::Header, None) => return Err(fault("CCSDS_OEM_VERS = 2.0 on the first line")),
            (Place::Metadata, None) => return Err(fault("KEY = VALUE, or META_STOP")),
            (Place::Data, Some(_)) => return Err(fault("an epoch and six numbers, or META_START")),
        }
    }
    if file.segments.is_empty() || place == Place::Metadata {
        return Err(Fault {
            line: last,
            found: "the end".into(),
            expected: "a segment: META_START .. META_STOP, and data",
        });
    }
    end_of_data(&file, last)?;
    Ok(file)
}

/// The beginning of a line, for messages.
fn short(content: &str) -> String {
    let mut text: String = content.chars().take(60).filter(|c| !c.is_control()).collect();
    if text.len() < content.len() {
        text.push_str("..");
    }
    format!("{text:?}")
}

/// Requires that the last segment has enough data.
fn end_of_data(file: &OemFile, line: usize) -> Result<(), Fault> {
    let Some(segment) = file.segments.last() else { return Ok(()) };
    if segment.time_s.len() < segment.points().max(2) {
        let found = format!("{} states", segment.time_s.len());
        return Err(Fault {
            line,
            found,
            expected: "as many states in a segment as its interpolation needs",
        });
    }
    Ok(())
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

impl Metadata {
    fn set(&mut self, key: &str, value: &str) {
        let place = match key {
            "CENTER_NAME" => &mut self.center,
            "REF_FRAME" => &mut self.frame,
            "TIME_SYSTEM" => &mut self.time_system,
            "INTERPOLATION" => &mut self.method,
            "INTERPOLATION_DEGREE" => &mut self.degree,
            // The first and last epochs of the data say what USEABLE times and START and STOP say.
            _ => return,
        };
        *place = Some(value.to_uppercase());
    }

    /// An empty segment.
    fn segment(&self, line: usize) -> Result<OemSegment, Fault> {
        let text = |value: &Option<String>| value.clone().unwrap_or_else(|| "nothing".into());
        let known =
            |value: &Option<String>, names: &[&str]| value.as_deref().is_some_and(|v| names.contains(&v));
        let fault = |found: String, expected| Err(Fault { line, found, expected });
        if !known(&self.center, &["MOON"]) {
            return fault(text(&self.center), "CENTER_NAME = MOON");
        }
        if !known(&self.frame, &["EME2000", "ICRF", "GCRF", "ECLIPJ2000"]) {
            return fault(
                text(&self.frame),
                "REF_FRAME = EME2000, ICRF or ECLIPJ2000: axes that do not turn",
            );
        }
        if !known(&self.time_system, &["UTC", "TAI", "TT", "TDB", "GPS"]) {
            return fault(text(&self.time_system), "TIME_SYSTEM = UTC, TAI, TT, TDB or GPS");
        }
        let method = match self.method.as_deref() {
            None | Some("HERMITE") => TableMethod::Hermite,
            Some("LAGRANGE") => TableMethod::Lagrange,
            Some(_) => return fault(text(&self.method), "INTERPOLATION = HERMITE or LAGRANGE"),
        };
        let degree = self.degree.as_deref().map_or(Some(7), |degree| degree.parse().ok());
        let Some(degree) = degree.filter(|degree| (1..=DEGREE_MAX).contains(degree)) else {
            return fault(text(&self.degree), "INTERPOLATION_DEGREE = 1 to 15");
        };
        let empty = OemSegment {
            method,
            degree,
            line: line + 1,
            time_s: Vec::new(),
            position_m: Vec::new(),
            velocity_m_s: Vec::new(),
        };
        Ok(empty)
    }
}

/// Adds a line `epoch x y z vx vy vz`, km and km/s, with or without an acceleration.
fn data_line(content: &str, line: usize, turns: bool, segment: &mut OemSegment) -> Result<(), Fault> {
    let fault = |found: String, expected| Err(Fault { line, found, expected });
    let mut fields = content.split_whitespace();
    let epoch = fields.next().unwrap_or_default();
    let Some(time_s) = epoch_s(epoch) else {
        return fault(short(epoch), "an epoch such as 2030-01-31T12:00:00.000 or 2030-031T12:00:00");
    };
    let numbers: Vec<f64> = fields.map_while(|field| field.parse().ok()).collect();
    let count = content.split_whitespace().count() - 1;
    if numbers.len() != count || !(count == 6 || count == 9) || numbers.iter().any(|x| !x.is_finite()) {
        return fault(short(content), "an epoch and six finite numbers: position in km, velocity in km/s");
    }
    if segment.time_s.last().is_some_and(|before| *before >= time_s) {
        return fault(short(epoch), "epochs in rising order: each later than the one before");
    }
    let vector = |from: usize| turned(turns, std::array::from_fn(|k| 1e3 * numbers[from + k]));
    segment.time_s.push(time_s);
    segment.position_m.push(vector(0));
    segment.velocity_m_s.push(vector(3));
    if norm(vector(3)) > 1e5 {
        return fault(short(content), "a velocity below 100 km/s");
    }
    Ok(())
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
