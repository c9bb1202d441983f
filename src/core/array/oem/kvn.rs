//! Messages as lines of text (KVN).

use super::form::{Fault, Message, short};

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
pub(super) fn parse<M: Message>(bytes: &[u8]) -> Result<(M, usize), Fault> {
    let (mut place, mut is_known, mut last) = (Place::Header, false, 0);
    let mut message = M::default();
    let keyword = format!("CCSDS_{}_VERS", M::NAME);
    let first_line = || format!("{keyword} = {} on the first line", M::VERSIONS.join(" or "));
    let line_end = if bytes.contains(&b'\n') { b'\n' } else { b'\r' };
    for (line, content) in (1..).zip(bytes.split(|byte| *byte == line_end)) {
        let content = String::from_utf8_lossy(content);
        let content = content.trim();
        last = line;
        if content.is_empty() || content.starts_with("COMMENT") {
            continue;
        }
        let fault = |expected: &str| Err(Fault::new(line, short(content), expected));
        match (place, content) {
            (Place::Header | Place::Data, "META_START") => {
                if !is_known {
                    return fault(&first_line());
                }
                message.end_segment(line)?;
                message.begin_metadata();
                place = Place::Metadata;
            }
            (Place::Metadata, "META_STOP") => {
                message.end_metadata(line)?;
                place = Place::Data;
            }
            (Place::Data, "COVARIANCE_START") => place = Place::Covariance,
            (Place::Covariance, "COVARIANCE_STOP") => place = Place::Data,
            (Place::Covariance, _) if content.starts_with("EPOCH") => message.covariance(),
            (Place::Covariance, _) => {}
            // Data of attitudes are marked.
            (Place::Data, "DATA_START" | "DATA_STOP") if M::NAME == "AEM" => {}
            (Place::Header, _) => {
                if let Some((key, version)) = content.split_once('=')
                    && key.trim() == keyword
                {
                    is_known = M::VERSIONS.contains(&version.trim());
                }
                if !is_known {
                    return fault(&first_line());
                }
            }
            (Place::Metadata, _) => match content.split_once('=') {
                Some((key, value)) => message.set(key.trim(), value.trim(), line)?,
                None => return fault("KEY = VALUE, or META_STOP"),
            },
            (Place::Data, _) if content.contains('=') => {
                return fault(&format!("{}, or META_START", M::LINE));
            }
            (Place::Data, _) => data_line(content, line, &mut message)?,
        }
    }
    if place == Place::Metadata {
        return Err(Fault::new(last, "the end", "META_STOP, and states"));
    }
    Ok((message, last))
}

/// Adds a line of data: an epoch and numbers.
fn data_line<M: Message>(content: &str, line: usize, message: &mut M) -> Result<(), Fault> {
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
    if !M::COUNTS.contains(&count) || numbers[..count].iter().any(|x| !x.is_finite()) {
        return Err(Fault::new(line, short(content), M::LINE));
    }
    message.state(epoch, &numbers[..count], line)
}
