//! Segments of attitude messages.

use super::rotation::{Rotation, interpolated};
use crate::array::axes::turned;
use crate::array::oem::{Fault, Message, Metadata, SegmentTimes, read_epoch, short};
use crate::units::time_scales::{Tai, TimeScale};
use crate::units::vector::Vec3;

/// Most that an attitude between states may be off, degrees: a dipole's response errs by some 0.2 % of its maximum.
const ERROR_DEG_MAX: f64 = 0.1;

/// Most that a satellite may turn between two states, degrees: farther apart, which way it went is open.
const STEP_DEG_MAX: f64 = 60.0;

/// Greatest degree of an interpolation.
const DEGREE_MAX: usize = 15;

/// Most that the length of a quaternion may differ from 1: numbers of four digits.
const LENGTH_ERROR_MAX: f64 = 1e-3;

/// Attitudes of one segment.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct AttitudeSegment {
    /// First and last time at which it is to be used, TAI seconds since 1958.
    pub(super) useable_s: [f64; 2],
    points: usize,
    /// TAI seconds since 1958.
    time_s: Vec<f64>,
    /// From the axes of the message to those of the body.
    to_body: Vec<Rotation>,
    /// Whether the message's axes are equatorial.
    turns: bool,
}

/// How the states of a segment are read.
#[derive(Debug)]
struct SegmentForm {
    object: String,
    scale: TimeScale,
    times: SegmentTimes,
    /// Whether rotations are given from the body to the axes.
    is_inverse: bool,
    /// Whether the scalar part comes first.
    scalar_first: bool,
    lines: Vec<usize>,
    segment: AttitudeSegment,
}

/// Gathers a message as its form is read.
#[derive(Debug, Default)]
pub(super) struct Collector {
    metadata: Metadata,
    latest: Option<SegmentForm>,
    segments: Vec<(String, AttitudeSegment)>,
}

impl Collector {
    /// The segments and their objects.
    pub(super) fn finish(self, line: usize) -> Result<Vec<(String, AttitudeSegment)>, Fault> {
        if self.segments.is_empty() {
            return Err(Fault::new(line, "the end", "a segment: metadata and attitudes"));
        }
        Ok(self.segments)
    }
}

/// Whether rotations are given from the body to the axes, and whether those are equatorial.
fn axes_of(metadata: &Metadata, line: usize) -> Result<[bool; 2], Fault> {
    let is_body = |key| metadata.value(key, line).0.starts_with("SC_BODY");
    let from_body = match ["REF_FRAME_A", "REF_FRAME_B"].map(is_body) {
        [false, true] => false,
        [true, false] => true,
        _ => {
            let (found, at) = metadata.value("REF_FRAME_B", line);
            return Err(Fault::new(
                at,
                found,
                "SC_BODY_1 (or another number) as one of REF_FRAME_A and REF_FRAME_B",
            ));
        }
    };
    let turns = metadata.is_equatorial(if from_body { "REF_FRAME_B" } else { "REF_FRAME_A" }, line)?;
    let backwards = match metadata.value("ATTITUDE_DIR", line) {
        ("A2B" | "nothing", _) => false,
        ("B2A", _) => true,
        (found, at) => return Err(Fault::new(at, found, "ATTITUDE_DIR = A2B or B2A")),
    };
    Ok([from_body != backwards, turns])
}

/// States that an interpolation goes through.
fn points_of(metadata: &Metadata, line: usize) -> Result<usize, Fault> {
    let (degree, degree_at) = metadata.value("INTERPOLATION_DEGREE", line);
    let number = degree.parse().ok().filter(|degree| (1..=DEGREE_MAX).contains(degree));
    match (metadata.value("INTERPOLATION_METHOD", line), number) {
        (("LINEAR" | "nothing", _), _) => Ok(2),
        (("LAGRANGE" | "HERMITE", _), Some(degree)) => Ok(degree + 1),
        (("LAGRANGE" | "HERMITE", _), None) => {
            Err(Fault::new(degree_at, degree, "INTERPOLATION_DEGREE = 1 to 15"))
        }
        ((found, at), _) => Err(Fault::new(at, found, "INTERPOLATION_METHOD = LINEAR, LAGRANGE or HERMITE")),
    }
}

impl Message for Collector {
    const NAME: &'static str = "AEM";
    const VERSIONS: &'static [&'static str] = &["2.0", "1.0"];
    const LINE: &'static str = "an epoch and the four finite numbers of a quaternion, with or without rates";
    const COUNTS: &'static [usize] = &[4, 7, 8];
    const STATE: &'static str = "attitudeState";
    const NUMBERS: &'static [&'static str] = &["Q1", "Q2", "Q3", "QC"];

    fn begin_metadata(&mut self) {
        self.metadata = Metadata::default();
    }

    fn set(&mut self, key: &str, value: &str, line: usize) -> Result<(), Fault> {
        const USED: [&str; 14] = [
            "OBJECT_NAME",
            "OBJECT_ID",
            "REF_FRAME_A",
            "REF_FRAME_B",
            "ATTITUDE_DIR",
            "TIME_SYSTEM",
            "ATTITUDE_TYPE",
            "QUATERNION_TYPE",
            "INTERPOLATION_METHOD",
            "INTERPOLATION_DEGREE",
            "START_TIME",
            "STOP_TIME",
            "USEABLE_START_TIME",
            "USEABLE_STOP_TIME",
        ];
        self.metadata.set(&USED, key, value, line)
    }

    fn end_metadata(&mut self, line: usize) -> Result<(), Fault> {
        let metadata = std::mem::take(&mut self.metadata);
        let object = match metadata.value("OBJECT_ID", line).0 {
            "nothing" => metadata.value("OBJECT_NAME", line),
            _ => metadata.value("OBJECT_ID", line),
        };
        if object.0 == "nothing" {
            return Err(Fault::new(line, "nothing", "OBJECT_ID or OBJECT_NAME"));
        }
        let [is_inverse, turns] = axes_of(&metadata, line)?;
        let scale = metadata.scale(line)?;
        let (kind, at) = metadata.value("ATTITUDE_TYPE", line);
        if !kind.starts_with("QUATERNION") {
            return Err(Fault::new(at, kind, "ATTITUDE_TYPE = QUATERNION, with or without rates"));
        }
        // The second issue has the scalar part last, and no key for it.
        let scalar_first = match metadata.value("QUATERNION_TYPE", line) {
            ("LAST" | "nothing", _) => false,
            ("FIRST", _) => true,
            (found, at) => return Err(Fault::new(at, found, "QUATERNION_TYPE = FIRST or LAST")),
        };
        let times = metadata.times(scale, line)?;
        let points = points_of(&metadata, line)?;
        let (time_s, to_body, lines) = (Vec::new(), Vec::new(), Vec::new());
        let segment = AttitudeSegment { useable_s: [0.0; 2], points, time_s, to_body, turns };
        let object = object.0.to_owned();
        self.latest = Some(SegmentForm { object, scale, times, is_inverse, scalar_first, lines, segment });
        Ok(())
    }

    fn state(&mut self, epoch: &str, numbers: &[f64], line: usize) -> Result<(), Fault> {
        let Some(form) = &mut self.latest else {
            return Err(Fault::new(line, short(epoch), "metadata before attitudes"));
        };
        let time_s = read_epoch(epoch, form.scale, line)?.seconds_since_1958();
        let Some(&[a, b, c, d]) = numbers.first_chunk().filter(|four| four.iter().all(|x| x.is_finite()))
        else {
            return Err(Fault::new(line, format!("{} numbers after {epoch}", numbers.len()), Self::LINE));
        };
        let segment = &mut form.segment;
        if segment.time_s.last().is_some_and(|before| *before >= time_s) {
            let expected = "epochs in rising order: each later than the one before";
            return Err(Fault::new(line, short(epoch), expected));
        }
        let length = [a, b, c, d].map(|x| x * x).iter().sum::<f64>().sqrt();
        if (length - 1.0).abs() > LENGTH_ERROR_MAX {
            return Err(Fault::new(line, format!("a quaternion of length {length}"), "one of length 1"));
        }
        let (vector, scalar) = if form.scalar_first { ([b, c, d], a) } else { ([a, b, c], d) };
        let given = Rotation::new(vector, scalar);
        let to_body = if form.is_inverse { given.inverse() } else { given };
        if let Some(before) = segment.to_body.last() {
            let step_deg = before.apart_rad(to_body).to_degrees();
            if step_deg > STEP_DEG_MAX {
                let found = format!("a turn by {step_deg:.1} deg since the attitude before");
                let expected = format!("at most {STEP_DEG_MAX} deg: shorter steps, or a segment of its own");
                return Err(Fault::new(line, found, expected));
            }
        }
        segment.time_s.push(time_s);
        segment.to_body.push(to_body);
        form.lines.push(line);
        Ok(())
    }

    fn named_state(&mut self, epoch: &str, numbers: &[f64], line: usize) -> Result<(), Fault> {
        if let Some(form) = &mut self.latest {
            form.scalar_first = false;
        }
        self.state(epoch, numbers, line)
    }

    fn end_segment(&mut self, line: usize) -> Result<(), Fault> {
        let Some(SegmentForm { object, scale, times, lines, mut segment, .. }) = self.latest.take() else {
            return Ok(());
        };
        let count = segment.time_s.len();
        if count < segment.points {
            let expected = format!("{} or more in a segment, as its interpolation needs", segment.points);
            return Err(Fault::new(line, format!("{count} attitudes"), expected));
        }
        segment.useable_s = times.useable_s(Tai::from_seconds_since_1958(0.0), &segment.time_s)?;
        segment.require_steps(&lines, scale)?;
        self.segments.push((object, segment));
        Ok(())
    }
}

impl AttitudeSegment {
    fn to_body(&self, points: usize, at_s: f64) -> Rotation {
        let after = self.time_s.partition_point(|t_s| *t_s <= at_s);
        let first = after.saturating_sub(points.div_ceil(2)).min(self.time_s.len() - points);
        let range = first..first + points;
        interpolated(&self.time_s[range.clone()], &self.to_body[range], at_s)
    }

    /// The axes of the body on those of the ecliptic.
    pub(super) fn axes(&self, at_s: f64) -> [Vec3; 3] {
        self.to_body(self.points, at_s).rows().map(|axis| turned(self.turns, axis))
    }

    /// How far a time is from those in which it is to be used, s.
    pub(super) fn beyond_s(&self, at_s: f64) -> f64 {
        let [from_s, until_s] = self.useable_s;
        (from_s - at_s).max(at_s - until_s).max(0.0)
    }

    /// Requires states that are near enough to each other: an interpolation through one more gives the same in the middle.
    fn require_steps(&self, lines: &[usize], scale: TimeScale) -> Result<(), Fault> {
        let other = if self.points < self.time_s.len() { self.points + 1 } else { self.points - 1 };
        if other < 2 {
            return Ok(());
        }
        // With no state more it is one less, which errs some ten times as much or more.
        let allowed_deg = if other > self.points { ERROR_DEG_MAX } else { 10.0 * ERROR_DEG_MAX };
        for (k, ends) in self.time_s.windows(2).enumerate() {
            let [from_s, until_s] = [ends[0], ends[1]];
            if from_s >= self.useable_s[1] || until_s <= self.useable_s[0] {
                continue;
            }
            let middle_s = 0.5 * (from_s + until_s);
            let apart = self.to_body(self.points, middle_s).apart_rad(self.to_body(other, middle_s));
            if apart.to_degrees() > allowed_deg {
                let date = Tai::from_seconds_since_1958(from_s).text(scale, 3);
                let found = format!(
                    "{:.3} s after {date} {scale}, in which the interpolation errs by some {:.2} deg",
                    until_s - from_s,
                    apart.to_degrees()
                );
                let line = lines.get(k + 1).copied().unwrap_or_default();
                return Err(Fault::new(line, found, format!("at most {allowed_deg} deg: shorter steps")));
            }
        }
        Ok(())
    }
}
