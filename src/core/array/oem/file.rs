//! Files of messages, KVN or XML, and of kernels, also compressed.

use std::io::Read;
use std::path::Path;

use flate2::read::MultiGzDecoder;

use super::form::{Fault, Message};
use super::{kvn, xml};
use crate::array::config::ArrayError;
use crate::files::{form_of, read_file};

/// Largest file that is read, and largest content of a compressed one, bytes: ten years of states each minute.
const FILE_BYTES_MAX: u64 = 1 << 30;

pub(in crate::array) fn error(path: &Path, what: String) -> ArrayError {
    ArrayError::File { path: path.to_owned(), what }
}

/// The fault of a file.
pub(in crate::array) fn at_line(path: &Path, Fault { line, found, expected }: Fault) -> ArrayError {
    error(path, format!("line {line}: found {found}; expected {expected}"))
}

/// The fault of a segment of a kernel, from 1, or of a kernel.
pub(super) fn at_segment(
    path: &Path,
    object: Option<i32>,
    Fault { line, found, expected }: Fault,
) -> ArrayError {
    let segment = if line == 0 { String::new() } else { format!("segment {line}: ") };
    let object = object.map_or_else(String::new, |object| format!("object {object}, "));
    error(path, format!("{object}{segment}found {found}; expected {expected}"))
}

/// The content of a file, which may be compressed by gzip.
pub(super) fn read_content(path: &Path) -> Result<Vec<u8>, ArrayError> {
    let bytes = read_file(path, FILE_BYTES_MAX).map_err(|source| error(path, source.to_string()))?;
    if !bytes.starts_with(&[0x1f, 0x8b]) {
        return Ok(bytes);
    }
    let mut content = Vec::new();
    // A sum at the end says whether it is whole.
    let unpacked = MultiGzDecoder::new(&*bytes).take(FILE_BYTES_MAX + 1).read_to_end(&mut content);
    unpacked.map_err(|source| error(path, format!("gzip: {source}")))?;
    if content.len() as u64 > FILE_BYTES_MAX {
        return Err(error(path, format!("it is too long; expected at most {FILE_BYTES_MAX} bytes")));
    }
    Ok(content)
}

/// Reads a message, KVN or XML, also compressed by gzip, to the end of its last segment; gives its last line, too.
pub(in crate::array) fn read_message<M: Message>(path: &Path) -> Result<(M, usize), ArrayError> {
    parse_content(path, &read_content(path)?)
}

/// Reads a message from the content of its file.
pub(super) fn parse_content<M: Message>(path: &Path, bytes: &[u8]) -> Result<(M, usize), ArrayError> {
    if let Some(form) = form_of(bytes) {
        return Err(error(path, format!("{form}; expected text as ASCII or UTF-8, or gzip of it")));
    }
    if let Some(table) = other_table(bytes) {
        return Err(error(path, format!("{table}; expected a CCSDS {} as KVN or XML", M::NAME)));
    }
    parse(bytes).map_err(|fault| at_line(path, fault))
}

/// A table of states that is no message, and what its program writes instead.
fn other_table(bytes: &[u8]) -> Option<&'static str> {
    let text = bytes.trim_ascii_start();
    let is_horizons = || text.windows(5).take(1 << 16).any(|five| five == b"$$SOE");
    if text.starts_with(b"stk.v.") {
        Some("an ephemeris of STK (.e), which also exports CCSDS OEM")
    } else if text.starts_with(b"**********") && is_horizons() {
        Some("a table of JPL's Horizons, which also makes SPK kernels (.bsp)")
    } else {
        None
    }
}

/// Reads a message that is given as bytes.
fn parse<M: Message>(bytes: &[u8]) -> Result<(M, usize), Fault> {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let is_xml = text.trim_ascii_start().starts_with(b"<");
    let (mut message, line): (M, usize) = if is_xml { xml::parse(text)? } else { kvn::parse(text)? };
    message.end_segment(line)?;
    Ok((message, line))
}
