//! Files of messages, KVN or XML, also compressed.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use flate2::read::MultiGzDecoder;

use super::form::{Fault, Message};
use super::{kvn, xml};
use crate::array::config::ArrayError;

/// Largest file that is read, and largest content of a compressed one, bytes: ten years of states each minute.
const FILE_BYTES_MAX: u64 = 1 << 30;

pub(in crate::array) fn error(path: &Path, what: String) -> ArrayError {
    ArrayError::Oem { path: path.to_owned(), what }
}

/// The fault of a file.
pub(in crate::array) fn at_line(path: &Path, Fault { line, found, expected }: Fault) -> ArrayError {
    error(path, format!("line {line}: found {found}; expected {expected}"))
}

/// Reads a message, KVN or XML, also compressed by gzip, to the end of its last segment; gives its last line, too.
pub(in crate::array) fn read_message<M: Message>(path: &Path) -> Result<(M, usize), ArrayError> {
    let of_io = |source: std::io::Error| error(path, source.to_string());
    let mut bytes = Vec::new();
    // A pipe has no size before it is read.
    let file = File::open(path).map_err(of_io)?;
    file.take(FILE_BYTES_MAX + 1).read_to_end(&mut bytes).map_err(of_io)?;
    let too_large = || error(path, format!("it is too long; expected at most {FILE_BYTES_MAX} bytes"));
    if bytes.len() as u64 > FILE_BYTES_MAX {
        return Err(too_large());
    }
    if bytes.starts_with(&[0x1f, 0x8b]) {
        let mut content = Vec::new();
        // A sum at the end says whether it is whole.
        let unpacked = MultiGzDecoder::new(&*bytes).take(FILE_BYTES_MAX + 1).read_to_end(&mut content);
        unpacked.map_err(|source| error(path, format!("gzip: {source}")))?;
        if content.len() as u64 > FILE_BYTES_MAX {
            return Err(too_large());
        }
        bytes = content;
    }
    if bytes.starts_with(&[0xff, 0xfe]) || bytes.starts_with(&[0xfe, 0xff]) {
        return Err(error(path, "UTF-16; expected ASCII or UTF-8".into()));
    }
    parse(&bytes).map_err(|fault| at_line(path, fault))
}

/// Reads a message that is given as bytes.
fn parse<M: Message>(bytes: &[u8]) -> Result<(M, usize), Fault> {
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let is_xml = text.trim_ascii_start().starts_with(b"<");
    let (mut message, line): (M, usize) = if is_xml { xml::parse(text)? } else { kvn::parse(text)? };
    message.end_segment(line)?;
    Ok((message, line))
}
