//! Messages as lines of text (KVN).

use super::message::{Collector, Fault, Reading, short};

/// Where the reader is.
#[derive(Clone, Copy, PartialEq)]
enum Place {
    Header,
    Metadata,
    Data,
    Covariance,
}

/// Reads a message. Comments and names may hold any bytes, also such as are not text.
///
/// # Errors
/// The first thing that is wrong.
pub(super) fn parse(bytes: &[u8]) -> Result<Reading, Fault> {
    let (mut place, mut is_oem, mut last) = (Place::Header, false, 0);
    let mut collector = Collector::default();
    for (line, content) in bytes.split(|byte| *byte == b'\n').enumerate().map(|(k, content)| (k + 1, content))
    {
        let content = String::from_utf8_lossy(content);
        let content = content.trim();
        last = line;
        if content.is_empty() || content.starts_with("COMMENT") {
            continue;
        }
        let fault = |expected: &str| Err(Fault::new(line, short(content), expected));
        match (place, content) {
            (Place::Header | Place::Data, "META_START") => {
                if !is_oem {
                    return fault("CCSDS_OEM_VERS = 2.0 on the first line");
                }
                collector.end_segment(line)?;
                collector.begin_metadata();
                place = Place::Metadata;
            }
            (Place::Metadata, "META_STOP") => {
                collector.end_metadata(line)?;
                place = Place::Data;
            }
            (Place::Data, "COVARIANCE_START") => place = Place::Covariance,
            (Place::Covariance, "COVARIANCE_STOP") => place = Place::Data,
            (Place::Covariance, _) => collector.covariances += usize::from(content.starts_with("EPOCH")),
            (Place::Header, _) => {
                if let Some((key, version)) = content.split_once('=')
                    && key.trim() == "CCSDS_OEM_VERS"
                {
                    is_oem = ["1.0", "2.0", "3.0"].contains(&version.trim());
                }
                if !is_oem {
                    return fault("CCSDS_OEM_VERS = 1.0, 2.0 or 3.0 on the first line");
                }
            }
            (Place::Metadata, _) => match content.split_once('=') {
                Some((key, value)) => collector.set(key.trim(), value.trim(), line),
                None => return fault("KEY = VALUE, or META_STOP"),
            },
            (Place::Data, _) if content.contains('=') => {
                return fault("an epoch and six numbers, or META_START");
            }
            (Place::Data, _) => data_line(content, line, &mut collector)?,
        }
    }
    if place == Place::Metadata {
        return Err(Fault::new(last, "the end", "META_STOP, and states"));
    }
    collector.finish(last)
}

/// Adds a line `epoch x y z vx vy vz`, with or without an acceleration.
fn data_line(content: &str, line: usize, collector: &mut Collector) -> Result<(), Fault> {
    let mut fields = content.split_whitespace();
    let epoch = fields.next().unwrap_or_default();
    let mut numbers = [f64::NAN; 9];
    let mut count = 0;
    for field in fields {
        match (numbers.get_mut(count), field.parse()) {
            (Some(place), Ok(number)) => *place = number,
            _ => count = numbers.len(),
        }
        count += 1;
    }
    if !(count == 6 || count == 9) || numbers[..count].iter().any(|x| !x.is_finite()) {
        let expected = "an epoch and six finite numbers: position in km, velocity in km/s";
        return Err(Fault::new(line, short(content), expected));
    }
    collector.state(epoch, &numbers[..count], line)
}
