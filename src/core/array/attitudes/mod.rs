//! Attitudes of satellites from CCSDS Attitude Ephemeris Messages (504.0-B-1 and -2), as KVN or XML.

mod aem;
mod rotation;
#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use aem::{AttitudeSegment, Collector};

use super::config::ArrayError;
use super::oem::{at_line, error, read_message};
use crate::units::echo;
use crate::units::time_scales::utc_text;
use crate::units::vector::Vec3;

/// How far beyond its states an attitude counts as known, s.
const BEYOND_S: f64 = 1.0;

/// Attitudes of the satellites. Cheap to clone.
#[derive(Clone, Debug, PartialEq)]
pub struct Attitudes {
    satellites: Arc<Vec<SatelliteAttitude>>,
}

/// The attitude of one satellite.
#[derive(Clone, Debug, PartialEq)]
struct SatelliteAttitude {
    object: String,
    /// In the order of their times.
    segments: Vec<AttitudeSegment>,
}

impl Attitudes {
    /// Reads messages. Each object in them is a satellite, in the order in which they appear.
    ///
    /// # Errors
    /// A file that cannot be used; segments of one object that are to be used at the same time.
    pub fn read(paths: &[PathBuf]) -> Result<Self, ArrayError> {
        let mut satellites: Vec<SatelliteAttitude> = Vec::new();
        let mut places = BTreeMap::new();
        for path in paths {
            let (collector, line) = read_message::<Collector>(path)?;
            for (object, segment) in collector.finish(line).map_err(|fault| at_line(path, fault))? {
                let place = *places.entry(object).or_insert_with_key(|object| {
                    satellites.push(SatelliteAttitude { object: object.clone(), segments: Vec::new() });
                    satellites.len() - 1
                });
                satellites[place].segments.push(segment);
            }
            for SatelliteAttitude { object, segments } in &mut satellites {
                segments.sort_by(|a, b| a.useable_s[0].total_cmp(&b.useable_s[0]));
                let overlap = segments.windows(2).find(|pair| pair[0].useable_s[1] > pair[1].useable_s[0]);
                if let Some([before, after]) = overlap {
                    let what = format!(
                        "segments of {} overlap by {:.3} s; expected segments of an object, in all files, without overlaps: \
                         USEABLE_START_TIME and USEABLE_STOP_TIME say when each is to be used",
                        echo(object),
                        before.useable_s[1] - after.useable_s[0]
                    );
                    return Err(error(path, what));
                }
            }
        }
        Ok(Self { satellites: Arc::new(satellites) })
    }

    /// The objects, in the order of the satellites.
    pub fn objects(&self) -> impl ExactSizeIterator<Item = &str> {
        self.satellites.iter().map(|satellite| satellite.object.as_str())
    }

    /// Axes x, y, z of a satellite's body, unit vectors on ecliptic axes, at a time in TAI seconds since 1958; those of the nearest time
    /// that is known. `None` of a satellite beyond the objects.
    #[must_use]
    pub fn body_axes(&self, satellite: usize, tai_s: f64) -> Option<[Vec3; 3]> {
        let segment = self.nearest(satellite, tai_s)?;
        let [from_s, until_s] = segment.useable_s;
        Some(segment.axes(tai_s.clamp(from_s, until_s)))
    }

    /// The first time from one to another (TAI seconds since 1958) at which the attitude is unknown, to a second: time tags err, and
    /// dates are rounded.
    #[must_use]
    pub fn first_unknown_s(&self, satellite: usize, [from_s, until_s]: [f64; 2]) -> Option<f64> {
        let segments = self.satellites.get(satellite).map_or(&[][..], |satellite| &satellite.segments);
        let first = segments.partition_point(|segment| segment.useable_s[1] + BEYOND_S < from_s);
        let mut unknown_s = from_s;
        for segment in &segments[first..] {
            if segment.useable_s[0] - BEYOND_S > unknown_s {
                break;
            }
            unknown_s = segment.useable_s[1] + BEYOND_S;
            if unknown_s >= until_s {
                return None;
            }
        }
        Some(unknown_s)
    }

    fn nearest(&self, satellite: usize, tai_s: f64) -> Option<&AttitudeSegment> {
        let segments = &self.satellites.get(satellite)?.segments;
        let after = segments.partition_point(|segment| segment.useable_s[0] <= tai_s);
        let near = &segments[after.saturating_sub(1)..segments.len().min(after + 1)];
        near.iter().min_by(|a, b| a.beyond_s(tai_s).total_cmp(&b.beyond_s(tai_s)))
    }

    /// When a satellite's attitude is known, for messages.
    #[must_use]
    pub fn known_utc(&self, satellite: usize) -> String {
        let segments = self.satellites.get(satellite).map(|satellite| satellite.segments.as_slice());
        let spans = segments.unwrap_or_default().iter();
        let text = |segment: &AttitudeSegment| segment.useable_s.map(utc_text).join(" to ");
        let said: Vec<String> = spans.clone().take(4).map(text).collect();
        said.join(", ") + if spans.len() > said.len() { ", .." } else { "" }
    }
}
