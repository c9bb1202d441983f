//! The stations that may send, with their tokens.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use crate::downlink::error::SocketError;

/// Minimum length of a token, so that it cannot be guessed if it is random.
const TOKEN_BYTES_MIN: usize = 16;
pub(super) const TOKEN_BYTES_MAX: usize = 256;
const NAME_CHARACTERS_MAX: usize = 64;
const STATIONS_MAX: usize = 1000;
const FILE_BYTES_MAX: u64 = 1 << 20;

/// Stations with their tokens. Their file has a line `NAME TOKEN` for each; empty lines and lines that begin with `#` are
/// skipped.
pub struct Stations(Vec<(String, Vec<u8>)>);

impl Stations {
    /// Reads a file, which only its owner may be able to read.
    ///
    /// # Errors
    /// The file cannot be read; others can read it; a line has another form.
    pub fn read(path: &Path) -> Result<Self, SocketError> {
        let failed = |found: String| SocketError::Stations { path: path.to_owned(), found };
        let unread = |error: io::Error| failed(error.to_string());
        let file = File::open(path).map_err(unread)?;
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            let mode = file.metadata().map_err(unread)?.permissions().mode();
            if mode & 0o077 != 0 {
                return Err(failed(format!(
                    "others can read it; expected mode 600 (chmod 600 {})",
                    path.display()
                )));
            }
        }
        let mut text = String::new();
        if file.take(FILE_BYTES_MAX + 1).read_to_string(&mut text).map_err(unread)? as u64 > FILE_BYTES_MAX {
            return Err(failed(format!("more than {FILE_BYTES_MAX} bytes")));
        }
        Self::parse(&text).map_err(failed)
    }

    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let mut found: Vec<(String, Vec<u8>)> = Vec::new();
        for (number, line) in (1..).zip(text.lines()) {
            let line = line.trim();
            if line.is_empty() || line.starts_with('#') {
                continue;
            }
            // The message does not show the line, which may contain a token.
            let wrong = |expected: &str| Err(format!("line {number}: expected {expected}"));
            let mut words = line.split_whitespace();
            let (Some(name), Some(token), None) = (words.next(), words.next(), words.next()) else {
                return wrong("NAME TOKEN");
            };
            let is_name = |c: char| c.is_ascii_alphanumeric() || ['-', '_', '.'].contains(&c);
            if name.len() > NAME_CHARACTERS_MAX || !name.chars().all(is_name) {
                return wrong("a name of at most 64 letters, digits, '-', '_' and '.'");
            }
            let has_valid_length = (TOKEN_BYTES_MIN..=TOKEN_BYTES_MAX).contains(&token.len());
            if !has_valid_length || !token.bytes().all(|c| c.is_ascii_graphic()) {
                return wrong("a token of 16 to 256 ASCII characters (openssl rand -hex 16)");
            }
            if found.iter().any(|(other, other_token)| other == name || other_token == token.as_bytes()) {
                return wrong("a name and a token that no other line has");
            }
            found.push((name.to_owned(), token.as_bytes().to_owned()));
            if found.len() > STATIONS_MAX {
                return wrong("at most 1000 stations");
            }
        }
        if found.is_empty() { Err("no station; expected lines NAME TOKEN".into()) } else { Ok(Self(found)) }
    }

    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.0.iter().map(|(name, _)| name.as_str())
    }

    /// The station that has this token. The comparison takes the same time for every token of a length, so that its duration
    /// does not reveal correct characters.
    pub(super) fn station(&self, token: &[u8]) -> Option<&str> {
        let mut found = None;
        for (name, expected) in &self.0 {
            let differences = expected.iter().zip(token).fold(0, |sum, (a, b)| sum | (a ^ b));
            if std::hint::black_box(differences) == 0 && expected.len() == token.len() {
                found = Some(name.as_str());
            }
        }
        found
    }

    /// The token of the only station, for a sender.
    ///
    /// # Errors
    /// The file has several stations.
    pub fn only_token(self, path: &Path) -> Result<String, SocketError> {
        match <[_; 1]>::try_from(self.0) {
            Ok([(_, token)]) => Ok(String::from_utf8_lossy(&token).into_owned()),
            Err(several) => Err(SocketError::Stations {
                path: path.to_owned(),
                found: format!("{} stations; a sender's file has one line, its own", several.len()),
            }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stations_are_identified_by_their_tokens() {
        let text = "# ours\nurumqi 0123456789abcdef\n\n  malargue  fedcba9876543210fedcba9876543210 \n";
        let stations = Stations::parse(text).unwrap();
        assert_eq!(stations.station(b"0123456789abcdef"), Some("urumqi"));
        assert_eq!(stations.station(b"fedcba9876543210fedcba9876543210"), Some("malargue"));
        for wrong in [b"fedcba9876543210".as_slice(), b"", b"0123456789abcdeF", b"0123456789abcdef0"] {
            assert_eq!(stations.station(wrong), None);
        }
    }

    #[test]
    fn an_invalid_list_is_refused_with_its_line_but_without_its_text() {
        for (text, line, expected) in [
            ("urumqi", 1, "NAME TOKEN"),
            ("# x\nurumqi secret", 2, "16 to 256"),
            ("urumqi 0123456789abcdef more", 1, "NAME TOKEN"),
            ("a/b 0123456789abcdef", 1, "a name of"),
            ("a 0123456789abcdef\nb 0123456789abcdef", 2, "no other line"),
            ("a 0123456789abcdef\na 0123456789abcdeg", 2, "no other line"),
            ("a 0123456789abcde\u{e9}", 1, "16 to 256"),
        ] {
            let error = Stations::parse(text).err().unwrap();
            assert!(error.starts_with(&format!("line {line}: ")) && error.contains(expected), "{error}");
            assert!(!error.contains("secret") && !error.contains("0123"), "{error}");
        }
        assert!(Stations::parse("# nobody\n").err().unwrap().contains("no station"));
        assert!(Stations::parse("\n").err().unwrap().contains("no station"));
    }

    #[cfg(unix)]
    #[test]
    fn a_file_that_others_can_read_is_refused() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("stations");
        std::fs::write(&path, "urumqi 0123456789abcdef\n").unwrap();
        for (mode, good) in [(0o600, true), (0o640, false), (0o604, false), (0o400, true)] {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
            let read = Stations::read(&path);
            assert_eq!(read.is_ok(), good, "{mode:o}");
            if let Err(error) = read {
                assert!(error.to_string().contains("chmod 600"), "{error}");
            }
        }
        let read = Stations::read(&path).unwrap();
        assert_eq!(read.only_token(&path).unwrap(), "0123456789abcdef");
        assert!(Stations::read(&folder.path().join("none")).is_err());
    }
}
