//! Sends a byte stream over TCP: the spacecraft's end of a connection.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::answers::ASKS_HELD;
use super::error::SocketError;
use super::preamble::TOKEN;
use super::report::{BUSY, CLOSED};
use super::url::TcpUrl;
use crate::downlink::error::DownlinkError;
use crate::runtime::{Cancel, Sink, Units};
use crate::units::printable;

/// Longest blocking of a system call between two checks for the end of the run.
const POLL: Duration = Duration::from_millis(200);

/// Patience with a stalled receiver once the run has been cancelled.
const GRACE: Duration = Duration::from_secs(10);

/// Bytes sent between two checks of the rate.
const PIECE_BYTES: usize = 1 << 16;

/// Bytes kept from the beginning, to be sent again to a receiver that was busy.
const RESEND_BYTES_MAX: usize = 1 << 24;

/// Pause before the first new attempt; each further one is twice as long, up to the longest.
const PAUSE: Duration = Duration::from_millis(200);
const PAUSE_MAX: Duration = Duration::from_secs(5);

/// Maximum length of an answer, bytes.
const ANSWER_BYTES_MAX: u64 = 1 << 10;

/// Options for sending.
#[derive(Clone, Debug, PartialEq)]
pub struct SendOptions {
    /// Time limit for connecting, and for finding a receiver that is busy free again, s.
    pub connect_s: f64,
    /// Maximum rate, bytes/s; 0 for as fast as the receiver reads.
    pub bytes_per_s: f64,
    /// Whether to wait until a checkpoint of the receiver holds everything.
    pub held: bool,
    /// Token of the station, for a receiver that asks for one.
    pub token: Option<String>,
}

/// Sends a byte stream to a listening ground. Connects with the first bytes, and blocks while the receiver does not
/// read.
///
/// A receiver that is busy, or loses the connection, is tried again with the stream from its beginning, as long as that
/// is kept: what was received before is not applied twice.
#[derive(Debug)]
pub struct SocketSink {
    url: TcpUrl,
    addresses: Vec<SocketAddr>,
    options: SendOptions,
    cancel: Cancel,
    stream: Option<TcpStream>,
    /// When the first byte was sent.
    since: Instant,
    bytes: u64,
    /// The stream from its beginning; `None` once it is longer than what is kept.
    sent: Option<Vec<u8>>,
    confirmed: Arc<AtomicU64>,
}

impl SocketSink {
    /// A sink that is not connected yet.
    ///
    /// # Errors
    /// The host has no address.
    pub fn new(url: &TcpUrl, options: SendOptions, cancel: &Cancel) -> Result<Self, SocketError> {
        Ok(Self {
            url: url.clone(),
            addresses: url.addresses()?,
            options,
            cancel: cancel.clone(),
            stream: None,
            since: Instant::now(),
            bytes: 0,
            sent: Some(Vec::new()),
            confirmed: Arc::default(),
        })
    }

    /// Bytes that the receiver has confirmed: all of them, or none without an answer.
    #[must_use]
    pub fn confirmed(&self) -> Arc<AtomicU64> {
        Arc::clone(&self.confirmed)
    }

    fn connect(&self) -> Result<TcpStream, SocketError> {
        let since = Instant::now();
        loop {
            let mut failed = io::Error::from(io::ErrorKind::NotFound);
            for address in &self.addresses {
                match TcpStream::connect_timeout(address, Duration::from_secs(1)) {
                    Ok(stream) => {
                        stream.set_read_timeout(Some(POLL)).map_err(self.closed())?;
                        stream.set_write_timeout(Some(POLL)).map_err(self.closed())?;
                        return Ok(stream);
                    }
                    Err(error) => failed = error,
                }
            }
            let waited_s = since.elapsed().as_secs_f64();
            if waited_s >= self.options.connect_s || self.cancel.is_cancelled() {
                let waited_s = (10.0 * waited_s).round() / 10.0;
                return Err(SocketError::Connect { url: self.url.to_string(), waited_s, source: failed });
            }
            self.pause(POLL);
        }
    }

    /// Waits, but not once the run has been cancelled.
    fn pause(&self, length: Duration) {
        let until = Instant::now() + length;
        while let Some(left) = until.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            if self.cancel.is_cancelled() {
                return;
            }
            std::thread::sleep(left.min(POLL));
        }
    }

    /// Sends pieces on a connection, a new one if there is none.
    fn send_all(&mut self, bytes: &[u8]) -> Result<(), SocketError> {
        let mut stream = match self.stream.take() {
            Some(stream) => stream,
            None => {
                let mut stream = self.connect()?;
                if let Some(token) = self.options.token.clone() {
                    self.send(&mut stream, &[TOKEN, token.as_bytes(), b"\n"].concat())?;
                }
                if self.options.held {
                    self.send(&mut stream, ASKS_HELD)?;
                }
                (self.since, self.bytes) = (Instant::now(), 0);
                stream
            }
        };
        for piece in bytes.chunks(PIECE_BYTES) {
            self.send(&mut stream, piece)?;
            self.hold_back();
        }
        self.stream = Some(stream);
        Ok(())
    }

    /// Ends the stream; returns the receiver's answer.
    fn end(&mut self) -> Result<String, SocketError> {
        let Some(mut stream) = self.stream.take() else { return Ok(String::new()) };
        let answer = self.answer(&mut stream)?;
        if answer.starts_with(CLOSED) || answer == self.expected() {
            return Ok(answer);
        }
        match answer.starts_with(BUSY) {
            true => Err(self.closed()(answer)),
            // It has ended, or is one that does not know the question.
            false if self.options.held => {
                Err(self.closed()(format!("no checkpoint is known to hold them; it answered {answer:?}")))
            }
            false => Ok(answer),
        }
    }

    /// The answer after which the sender has no more to do.
    fn expected(&self) -> String {
        let bytes = self.bytes;
        match self.options.held {
            true => format!("taken {bytes} bytes\nheld {bytes} bytes"),
            false => format!("taken {bytes} bytes"),
        }
    }

    /// After a failure, does the same again with all that was sent so far, until it succeeds or the time is over.
    fn retry<T>(
        &mut self,
        failure: SocketError,
        again: impl Fn(&mut Self) -> Result<T, SocketError>,
    ) -> Result<T, SocketError> {
        let (since, mut failure, mut pause, mut attempts) = (Instant::now(), failure, PAUSE, 0);
        while self.may_try_again(&failure) && since.elapsed().as_secs_f64() < self.options.connect_s {
            self.pause(pause);
            pause = (2 * pause).min(PAUSE_MAX);
            attempts += 1;
            self.stream = None;
            let Some(sent) = self.sent.take() else { break };
            let resent = self.send_all(&sent);
            self.sent = Some(sent);
            match resent.and_then(|()| again(self)) {
                Ok(done) => return Ok(done),
                // The reason why it closed says more than that nobody listens now.
                Err(SocketError::Connect { .. }) => {}
                Err(error) => failure = error,
            }
        }
        match failure {
            SocketError::Closed { url, bytes, reason } if attempts > 0 => {
                let waited_s = since.elapsed().as_secs_f64();
                let reason =
                    format!("{reason}; {attempts} more attempts in {waited_s:.1} s (--connect-s) failed");
                Err(SocketError::Closed { url, bytes, reason })
            }
            other => Err(other),
        }
    }

    /// Whether the receiver may take the stream from its beginning: it was busy, or the connection broke.
    fn may_try_again(&self, failure: &SocketError) -> bool {
        let SocketError::Closed { reason, .. } = failure else { return false };
        let is_final = reason.starts_with(CLOSED);
        self.sent.is_some() && !is_final && !self.cancel.is_cancelled()
    }

    /// Keeps bytes for another attempt, as long as there is room.
    fn keep(&mut self, bytes: &[u8]) {
        if let Some(sent) = &mut self.sent {
            match sent.len() + bytes.len() <= RESEND_BYTES_MAX {
                true => sent.extend_from_slice(bytes),
                false => self.sent = None,
            }
        }
    }

    fn closed<E: ToString>(&self) -> impl Fn(E) -> SocketError + use<E> {
        let (url, bytes) = (self.url.clone(), self.bytes);
        // The receiver's words are shown as they are, but for what a terminal would take for a command.
        let shown = |reason: E| printable(&reason.to_string()).into_owned();
        move |reason| SocketError::Closed { url: url.to_string(), bytes, reason: shown(reason) }
    }

    /// Sends a piece; blocks while the receiver does not read.
    fn send(&mut self, stream: &mut TcpStream, mut piece: &[u8]) -> Result<(), SocketError> {
        let mut taken = Instant::now();
        while !piece.is_empty() {
            match stream.write(piece) {
                Ok(0) => return Err(self.refused(stream, &"it accepts no more bytes")),
                Ok(bytes) => {
                    self.bytes += bytes as u64;
                    piece = &piece[bytes..];
                    taken = Instant::now();
                }
                Err(error) if may_go_on(&error) => self.require_patience(taken, "read the rest")?,
                Err(error) => return Err(self.refused(stream, &error)),
            }
        }
        Ok(())
    }

    /// The receiver closed the connection; it may have sent a reason.
    fn refused(&self, stream: &mut TcpStream, error: &dyn ToString) -> SocketError {
        let mut said = String::new();
        let _ = stream.take(ANSWER_BYTES_MAX).read_to_string(&mut said);
        let reason = if said.trim().is_empty() { error.to_string() } else { said.trim().to_owned() };
        self.closed()(reason)
    }

    /// After cancellation, limits the wait for a stalled receiver, which does not do `what`.
    fn require_patience(&self, since: Instant, what: &str) -> Result<(), SocketError> {
        match self.cancel.is_cancelled() && since.elapsed() > GRACE {
            true => Err(self.closed()(format!("the run was ended early, and the receiver does not {what}"))),
            false => Ok(()),
        }
    }

    /// Waits as long as the rate requires, counted from the first byte.
    fn hold_back(&self) {
        if self.options.bytes_per_s <= 0.0 {
            return;
        }
        let due = Duration::from_secs_f64(self.bytes as f64 / self.options.bytes_per_s);
        while let Some(left) = due.checked_sub(self.since.elapsed()).filter(|left| !left.is_zero()) {
            if self.cancel.is_cancelled() {
                return;
            }
            std::thread::sleep(left.min(POLL));
        }
    }

    /// The receiver's answer after the last byte.
    fn answer(&self, stream: &mut TcpStream) -> Result<String, SocketError> {
        if let Err(error) = stream.shutdown(Shutdown::Write) {
            return Err(self.refused(stream, &error));
        }
        let since = Instant::now();
        let mut said = Vec::new();
        let mut piece = [0; 256];
        loop {
            match stream.read(&mut piece) {
                Ok(0) => return Ok(String::from_utf8_lossy(&said).trim().to_owned()),
                Ok(bytes) if said.len() as u64 + bytes as u64 > ANSWER_BYTES_MAX => {
                    return Err(self.closed()("its answer is not a line of text"));
                }
                Ok(bytes) => said.extend_from_slice(&piece[..bytes]),
                Err(error) if may_go_on(&error) => self.require_patience(since, "answer")?,
                Err(error) if said.is_empty() => return Err(self.closed()(error)),
                // What it said before the connection broke says more.
                Err(_) => return Err(self.closed()(String::from_utf8_lossy(&said).trim().to_owned())),
            }
        }
    }
}

/// Whether the operation may be tried again.
fn may_go_on(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), Interrupted | TimedOut | WouldBlock)
}

impl Sink for SocketSink {
    type In = Vec<u8>;
    type Error = DownlinkError;

    fn take(&mut self, bytes: Vec<u8>) -> Result<(), DownlinkError> {
        let sent = self.send_all(&bytes);
        self.keep(&bytes);
        match sent {
            Ok(()) => Ok(()),
            // All that is kept includes these bytes.
            Err(failure) => Ok(self.retry(failure, |_| Ok(()))?),
        }
    }

    fn finish(&mut self) -> Result<(), DownlinkError> {
        if self.stream.is_none() {
            return Ok(());
        }
        let answer = match self.end() {
            Ok(answer) => answer,
            Err(failure) => self.retry(failure, Self::end)?,
        };
        if answer == self.expected() {
            self.confirmed.store(self.bytes, Ordering::Relaxed);
        } else if !answer.is_empty() {
            return Err(self.closed()(answer).into());
        }
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}
