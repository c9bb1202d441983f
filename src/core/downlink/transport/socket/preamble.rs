//! The lines that a connection may begin with, before its packets: the token of its station and the request of `held`.

use std::sync::Arc;

use super::answers::HELD_REQUEST;
use super::report::ConnectionEnd;
use super::stations::{Stations, TOKEN_BYTES_MAX};

/// Beginning of the line with a token. No packet and no frame begins like it: a packet begins with its version and type, a
/// frame with its sync marker.
pub(super) const TOKEN: &[u8] = b"token ";

/// Parser of the lines before the packets: `token TOKEN`, then `answer held`, or either, or none. All other bytes belong to
/// the packets.
pub(super) struct Preamble {
    /// The stations that may send; `None` if every sender may.
    stations: Option<Arc<Stations>>,
    /// Whether the ground has checkpoints, so that a sender may request `held`.
    has_checkpoints: bool,
    /// The beginning of a line that may become one of the two.
    line: Vec<u8>,
    bytes: u64,
    has_token: bool,
    station: Option<String>,
    requests_held: bool,
    is_over: bool,
}

enum LineStart {
    /// The incomplete beginning of one of the two lines.
    Incomplete,
    /// The complete line with a token.
    Token,
    /// The complete request of `held`.
    HeldRequest,
    /// The beginning of the packets.
    Packets,
}

impl Preamble {
    pub(super) fn new(stations: Option<Arc<Stations>>, has_checkpoints: bool) -> Self {
        Self {
            stations,
            has_checkpoints,
            line: Vec::new(),
            bytes: 0,
            has_token: false,
            station: None,
            requests_held: false,
            is_over: false,
        }
    }

    /// Takes the next bytes; returns those that belong to the packets: buffered bytes, and the rest of `bytes`.
    ///
    /// # Errors
    /// The token is missing or unknown; the ground has no checkpoints, so that it cannot answer `held`.
    pub(super) fn take<'a>(&mut self, bytes: &'a [u8]) -> Result<(Vec<u8>, &'a [u8]), ConnectionEnd> {
        let mut rest = bytes;
        while !self.is_over {
            let Some((&octet, after)) = rest.split_first() else { return Ok((Vec::new(), rest)) };
            rest = after;
            self.line.push(octet);
            match self.classify() {
                LineStart::Incomplete => {}
                LineStart::Token => {
                    self.has_token = true;
                    self.identify_station()?;
                    self.end_line();
                }
                LineStart::HeldRequest => {
                    self.requests_held = true;
                    self.end_line();
                    self.end()?;
                }
                LineStart::Packets => self.end()?,
            }
        }
        Ok((std::mem::take(&mut self.line), rest))
    }

    /// Ends the connection; returns the buffered bytes, which belong to the packets.
    ///
    /// # Errors
    /// The errors of [`Preamble::take`]. A connection without bytes needs no token.
    pub(super) fn finish(&mut self) -> Result<Vec<u8>, ConnectionEnd> {
        let is_empty = self.line.is_empty() && self.bytes == 0;
        if !self.is_over && !is_empty {
            self.end()?;
        }
        Ok(std::mem::take(&mut self.line))
    }

    fn classify(&self) -> LineStart {
        let Self { line, .. } = self;
        if line == HELD_REQUEST {
            return LineStart::HeldRequest;
        }
        let may_be_token = !self.has_token
            && match line.strip_prefix(TOKEN) {
                Some(token) => {
                    let text = token.strip_suffix(b"\n").unwrap_or(token);
                    text.len() <= TOKEN_BYTES_MAX && text.iter().all(u8::is_ascii_graphic)
                }
                None => TOKEN.starts_with(line),
            };
        match may_be_token {
            true if line.ends_with(b"\n") => LineStart::Token,
            true => LineStart::Incomplete,
            false if HELD_REQUEST.starts_with(line) => LineStart::Incomplete,
            false => LineStart::Packets,
        }
    }

    fn identify_station(&mut self) -> Result<(), ConnectionEnd> {
        let token = self.line.strip_prefix(TOKEN).and_then(|token| token.strip_suffix(b"\n"));
        if let Some(stations) = &self.stations {
            let found = token.and_then(|token| stations.station(token)).map(str::to_owned);
            self.station = Some(found.ok_or(ConnectionEnd::UnknownToken)?);
        }
        Ok(())
    }

    fn end_line(&mut self) {
        self.bytes += self.line.len() as u64;
        self.line.clear();
    }

    /// Ends the preamble, as packets follow.
    fn end(&mut self) -> Result<(), ConnectionEnd> {
        self.is_over = true;
        if self.stations.is_some() && self.station.is_none() {
            self.line.clear();
            return Err(ConnectionEnd::NoToken);
        }
        if self.requests_held && !self.has_checkpoints { Err(ConnectionEnd::NoState) } else { Ok(()) }
    }

    pub(super) fn requests_held(&self) -> bool {
        self.requests_held
    }

    /// The station whose token the connection sent.
    pub(super) fn station(&self) -> Option<&str> {
        self.station.as_deref()
    }

    /// Number of bytes of the lines before the packets.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECRET: &[u8] = b"0123456789abcdef";

    fn stations() -> Option<Arc<Stations>> {
        Some(Arc::new(Stations::parse("urumqi 0123456789abcdef\nmalargue fedcba9876543210").unwrap()))
    }

    /// All bytes that belong to the packets, or why the connection ends. Sends pieces of `piece` bytes.
    fn through(preamble: &mut Preamble, bytes: &[u8], piece: usize) -> Result<Vec<u8>, ConnectionEnd> {
        let mut packets = Vec::new();
        for bytes in bytes.chunks(piece) {
            let (buffered, rest) = preamble.take(bytes)?;
            packets.extend_from_slice(&buffered);
            packets.extend_from_slice(rest);
        }
        packets.extend(preamble.finish()?);
        Ok(packets)
    }

    #[test]
    fn a_station_is_identified_by_its_token_in_pieces_of_any_size() {
        let packets = b"token and answer are only read before the packets\nanswer held\n";
        for piece in [1, 3, 7, 1000] {
            for (question, asks) in [(b"".as_slice(), false), (HELD_REQUEST, true)] {
                let mut preamble = Preamble::new(stations(), true);
                let sent = [TOKEN, SECRET, b"\n", question, &packets[..]].concat();
                assert_eq!(through(&mut preamble, &sent, piece).as_deref(), Ok(packets.as_slice()));
                assert_eq!((preamble.station(), preamble.requests_held()), (Some("urumqi"), asks));
                assert_eq!(preamble.bytes() as usize, sent.len() - packets.len());
            }
        }
    }

    #[test]
    fn without_the_token_of_a_station_nothing_is_accepted() {
        let ends = |sent: &[u8]| through(&mut Preamble::new(stations(), true), sent, 5).unwrap_err();
        for wrong in [b"0123456789abcdeg".as_slice(), b"0123456789abcde", b"", b"urumqi"] {
            assert_eq!(ends(&[TOKEN, wrong, b"\npackets"].concat()), ConnectionEnd::UnknownToken);
        }
        // A long line, a blank, another line ending, the wrong order and half a line are not tokens.
        let long = [TOKEN, &[b'x'; TOKEN_BYTES_MAX + 1], b"\n"].concat();
        let spaced = [TOKEN, b" ", SECRET, b"\n"].concat();
        let returned = [TOKEN, SECRET, b"\r\n"].concat();
        let late = [HELD_REQUEST, TOKEN, SECRET, b"\n"].concat();
        for sent in [b"packets".as_slice(), &long, &spaced, &returned, &late, b"token 01234", HELD_REQUEST] {
            assert_eq!(ends(sent), ConnectionEnd::NoToken, "{}", String::from_utf8_lossy(sent));
        }
        // A connection without bytes, which only tests whether the ground listens, is accepted.
        assert_eq!(through(&mut Preamble::new(stations(), true), b"", 5), Ok(Vec::new()));
    }

    #[test]
    fn a_ground_without_stations_skips_the_token() {
        let sent = [TOKEN, b"whatever-it-is\n", HELD_REQUEST, b"packets"].concat();
        let mut preamble = Preamble::new(None, true);
        assert_eq!(through(&mut preamble, &sent, 4).as_deref(), Ok(b"packets".as_slice()));
        assert!(preamble.station().is_none() && preamble.requests_held());
    }
}
