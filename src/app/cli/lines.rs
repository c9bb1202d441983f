//! Lines of an input, each of bounded length.

use std::io::{BufRead, Read};

use super::output::CommandError;

/// Maximum length of a line, bytes; many times that of a valid row.
const LINE_BYTES_MAX: usize = 4096;

/// Reads the next line without its end; `None` at the end of the input. `number` counts lines from 1, for messages.
pub(super) fn next_line(input: &mut impl BufRead, number: usize) -> Result<Option<String>, CommandError> {
    let mut bytes = Vec::new();
    input.by_ref().take(LINE_BYTES_MAX as u64 + 1).read_until(b'\n', &mut bytes)?;
    if bytes.is_empty() {
        return Ok(None);
    }
    if bytes.len() > LINE_BYTES_MAX {
        let start = String::from_utf8_lossy(&bytes[..32]).into_owned();
        return Err(format!(
            "standard input, line {number}: `{start}...` has more than {LINE_BYTES_MAX} bytes; expected a shorter line"
        )
        .into());
    }
    let line = String::from_utf8(bytes)
        .map_err(|_| format!("standard input, line {number}: expected text in UTF-8"))?;
    Ok(Some(line.trim_end_matches(['\n', '\r']).to_owned()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_read_and_long_ones_refused_early() {
        let mut input: &[u8] = b"one\r\n\nthree";
        let mut lines = Vec::new();
        while let Some(line) = next_line(&mut input, lines.len() + 1).unwrap() {
            lines.push(line);
        }
        assert_eq!(lines, ["one", "", "three"]);
        // An input without end.
        let mut endless = std::io::BufReader::new(std::io::repeat(b'7'));
        let refused = next_line(&mut endless, 9).unwrap_err().to_string();
        assert!(refused.contains("line 9") && refused.contains("4096") && refused.len() < 200, "{refused}");
        let mut longest: &[u8] = &[&[b'x'; LINE_BYTES_MAX - 1], &b"\ny"[..]].concat();
        assert_eq!(next_line(&mut longest, 1).unwrap().unwrap().len(), LINE_BYTES_MAX - 1);
        assert!(next_line(&mut &b"\xff\n"[..], 1).is_err());
    }
}
