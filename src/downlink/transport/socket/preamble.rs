//! What a connection begins with, before its packets: the token of its station, and the question what checkpoints hold.

use std::sync::Arc;

use super::answers::ASKS_HELD;
use super::report::ConnectionEnd;
use super::stations::{Stations, TOKEN_BYTES_MAX};

/// Begins the line with a token. No packet and no frame begins like it: packets of version 1 begin with a zero bit and their
/// type, frames with their marker.
pub(super) const TOKEN: &[u8] = b"token ";

/// The lines before the packets: `token TOKEN`, then `answer held`, or either, or none. Whatever differs from them belongs to the
/// packets.
pub(super) struct Preamble {
    /// Who may send; `None` for everyone.
    stations: Option<Arc<Stations>>,
    /// Whether a sender may ask what checkpoints hold.
    may_ask: bool,
    /// The beginning of a line that may become one of the two.
    line: Vec<u8>,
    bytes: u64,
    has_token: bool,
    station: Option<String>,
    asks_held: bool,
    is_over: bool,
}

/// What a beginning of a line may become.
enum LineStart {
    /// One of the two lines.
    Line,
    /// The line with a token, which is here.
    Token,
    /// The question.
    Question,
    /// Packets.
    Packets,
}

impl Preamble {
    pub(super) fn new(stations: Option<Arc<Stations>>, may_ask: bool) -> Self {
        Self {
            stations,
            may_ask,
            line: Vec::new(),
            bytes: 0,
            has_token: false,
            station: None,
            asks_held: false,
            is_over: false,
        }
    }

    /// Takes the next bytes; returns those that belong to the packets: what was held back, and the rest.
    ///
    /// # Errors
    /// A token that no station has, or none where there has to be one; a question that the ground cannot answer.
    pub(super) fn take<'a>(&mut self, bytes: &'a [u8]) -> Result<(Vec<u8>, &'a [u8]), ConnectionEnd> {
        let mut rest = bytes;
        while !self.is_over {
            let Some((&octet, after)) = rest.split_first() else { return Ok((Vec::new(), rest)) };
            rest = after;
            self.line.push(octet);
            match self.becoming() {
                LineStart::Line => {}
                LineStart::Token => {
                    self.has_token = true;
                    self.know()?;
                    self.end_line();
                }
                LineStart::Question => {
                    self.asks_held = true;
                    self.end_line();
                    self.end()?;
                }
                LineStart::Packets => self.end()?,
            }
        }
        Ok((std::mem::take(&mut self.line), rest))
    }

    /// The connection has ended; returns what belongs to the packets after all.
    ///
    /// # Errors
    /// As [`Preamble::take`]. A connection without a byte needs no token.
    pub(super) fn finish(&mut self) -> Result<Vec<u8>, ConnectionEnd> {
        let is_empty = self.line.is_empty() && self.bytes == 0;
        if !self.is_over && !is_empty {
            self.end()?;
        }
        Ok(std::mem::take(&mut self.line))
    }

    fn becoming(&self) -> LineStart {
        let Self { line, .. } = self;
        if line == ASKS_HELD {
            return LineStart::Question;
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
            true => LineStart::Line,
            false if ASKS_HELD.starts_with(line) => LineStart::Line,
            false => LineStart::Packets,
        }
    }

    /// Finds the station of the token in the line.
    fn know(&mut self) -> Result<(), ConnectionEnd> {
        let token = self.line.strip_prefix(TOKEN).and_then(|token| token.strip_suffix(b"\n"));
        if let Some(stations) = &self.stations {
            let found = token.and_then(|token| stations.of(token)).map(str::to_owned);
            self.station = Some(found.ok_or(ConnectionEnd::UnknownToken)?);
        }
        Ok(())
    }

    fn end_line(&mut self) {
        self.bytes += self.line.len() as u64;
        self.line.clear();
    }

    /// Packets follow.
    fn end(&mut self) -> Result<(), ConnectionEnd> {
        self.is_over = true;
        if self.stations.is_some() && self.station.is_none() {
            self.line.clear();
            return Err(ConnectionEnd::NoToken);
        }
        if self.asks_held && !self.may_ask { Err(ConnectionEnd::NoState) } else { Ok(()) }
    }

    /// Whether the sender asks to be told what checkpoints hold.
    pub(super) fn asks_held(&self) -> bool {
        self.asks_held
    }

    /// The station whose token the connection gave.
    pub(super) fn station(&self) -> Option<&str> {
        self.station.as_deref()
    }

    /// Bytes of whole lines before the packets.
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

    /// Everything that belongs to the packets, or why the connection ends, in pieces of `piece` bytes.
    fn through(preamble: &mut Preamble, bytes: &[u8], piece: usize) -> Result<Vec<u8>, ConnectionEnd> {
        let mut packets = Vec::new();
        for bytes in bytes.chunks(piece) {
            let (held, rest) = preamble.take(bytes)?;
            packets.extend_from_slice(&held);
            packets.extend_from_slice(rest);
        }
        packets.extend(preamble.finish()?);
        Ok(packets)
    }

    #[test]
    fn a_station_is_known_by_its_token_however_it_comes_in_pieces() {
        let packets = b"token and answer are only read before the packets\nanswer held\n";
        for piece in [1, 3, 7, 1000] {
            for (question, asks) in [(b"".as_slice(), false), (ASKS_HELD, true)] {
                let mut preamble = Preamble::new(stations(), true);
                let sent = [TOKEN, SECRET, b"\n", question, &packets[..]].concat();
                assert_eq!(through(&mut preamble, &sent, piece).as_deref(), Ok(packets.as_slice()));
                assert_eq!((preamble.station(), preamble.asks_held()), (Some("urumqi"), asks));
                assert_eq!(preamble.bytes() as usize, sent.len() - packets.len());
            }
        }
    }

    #[test]
    fn without_the_token_of_a_station_nothing_is_taken() {
        let ends = |sent: &[u8]| through(&mut Preamble::new(stations(), true), sent, 5).unwrap_err();
        for wrong in [b"0123456789abcdeg".as_slice(), b"0123456789abcde", b"", b"urumqi"] {
            assert_eq!(ends(&[TOKEN, wrong, b"\npackets"].concat()), ConnectionEnd::UnknownToken);
        }
        // A long line, blanks, another ending, the wrong order, half a line: no token.
        let long = [TOKEN, &[b'x'; TOKEN_BYTES_MAX + 1], b"\n"].concat();
        let spaced = [TOKEN, b" ", SECRET, b"\n"].concat();
        let returned = [TOKEN, SECRET, b"\r\n"].concat();
        let late = [ASKS_HELD, TOKEN, SECRET, b"\n"].concat();
        for sent in [b"packets".as_slice(), &long, &spaced, &returned, &late, b"token 01234", ASKS_HELD] {
            assert_eq!(ends(sent), ConnectionEnd::NoToken, "{}", String::from_utf8_lossy(sent));
        }
        // Nothing at all, as who looks whether somebody listens: no harm.
        assert_eq!(through(&mut Preamble::new(stations(), true), b"", 5), Ok(Vec::new()));
    }

    #[test]
    fn a_ground_that_asks_for_no_token_skips_it() {
        let sent = [TOKEN, b"whatever-it-is\n", ASKS_HELD, b"packets"].concat();
        let mut preamble = Preamble::new(None, true);
        assert_eq!(through(&mut preamble, &sent, 4).as_deref(), Ok(b"packets".as_slice()));
        assert!(preamble.station().is_none() && preamble.asks_held());
    }
}
