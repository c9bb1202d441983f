//! The spacecraft's end of a connection.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::error::SocketError;
use super::url::TcpUrl;
use crate::downlink::error::DownlinkError;
use crate::runtime::{Cancel, Sink, Units};

/// How long a system call may block before it is looked whether the run has been ended.
const POLL: Duration = Duration::from_millis(200);

/// How long a receiver may take nothing once the run has been ended early.
const GRACE: Duration = Duration::from_secs(10);

/// Bytes sent between two looks at the rate.
const PIECE_BYTES: usize = 1 << 16;

/// Bytes of an answer that are read.
const ANSWER_BYTES_MAX: u64 = 1 << 10;

/// How to send.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SendOptions {
    /// How long to try to connect, s.
    pub connect_s: f64,
    /// Bytes a second at most; 0 for as many as the receiver takes.
    pub bytes_per_s: f64,
}

/// Sends what comes to a place that listens. It connects with the first bytes; while the receiver does not read, it
/// waits, and so does whoever makes the bytes.
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
    confirmed: Arc<AtomicU64>,
}

impl SocketSink {
    /// A sink that has not connected yet.
    ///
    /// # Errors
    /// A host without an address.
    pub fn new(url: &TcpUrl, options: SendOptions, cancel: &Cancel) -> Result<Self, SocketError> {
        Ok(Self {
            url: url.clone(),
            addresses: url.addresses()?,
            options,
            cancel: cancel.clone(),
            stream: None,
            since: Instant::now(),
            bytes: 0,
            confirmed: Arc::default(),
        })
    }

    /// Bytes that the receiver has said it has taken; all of them, or none if it says nothing.
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
                return Err(SocketError::Connect { url: self.url.clone(), waited_s, source: failed });
            }
            std::thread::sleep(POLL);
        }
    }

    fn closed<E: ToString>(&self) -> impl Fn(E) -> SocketError + use<E> {
        let (url, bytes) = (self.url.clone(), self.bytes);
        move |reason| SocketError::Closed { url: url.clone(), bytes, reason: reason.to_string() }
    }

    /// Sends a piece; waits as long as the receiver does not read.
    fn send(&mut self, stream: &mut TcpStream, mut piece: &[u8]) -> Result<(), SocketError> {
        let mut taken = Instant::now();
        while !piece.is_empty() {
            match stream.write(piece) {
                Ok(0) => return Err(self.refused(stream, &"it takes nothing any more")),
                Ok(bytes) => {
                    self.bytes += bytes as u64;
                    piece = &piece[bytes..];
                    taken = Instant::now();
                }
                Err(error) if may_go_on(&error) => self.require_patience(taken)?,
                Err(error) => return Err(self.refused(stream, &error)),
            }
        }
        Ok(())
    }

    /// The receiver has closed: it may have said why.
    fn refused(&self, stream: &mut TcpStream, error: &dyn ToString) -> SocketError {
        let mut said = String::new();
        let _ = stream.take(ANSWER_BYTES_MAX).read_to_string(&mut said);
        let reason = if said.trim().is_empty() { error.to_string() } else { said.trim().to_owned() };
        self.closed()(reason)
    }

    /// After Ctrl-C a receiver that takes nothing is not waited for without end.
    fn require_patience(&self, taken: Instant) -> Result<(), SocketError> {
        match self.cancel.is_cancelled() && taken.elapsed() > GRACE {
            true => Err(self.closed()("ended early, and it does not take the rest")),
            false => Ok(()),
        }
    }

    /// Keeps to the rate, counted from the first byte.
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

    /// What the receiver says when all has been sent.
    fn answer(&self, stream: &mut TcpStream) -> Result<String, SocketError> {
        stream.shutdown(Shutdown::Write).map_err(self.closed())?;
        let since = Instant::now();
        let mut said = Vec::new();
        let mut piece = [0; 256];
        loop {
            match stream.read(&mut piece) {
                Ok(0) => return Ok(String::from_utf8_lossy(&said).trim().to_owned()),
                Ok(bytes) if said.len() as u64 + bytes as u64 > ANSWER_BYTES_MAX => {
                    return Err(self.closed()("its answer is no line of text"));
                }
                Ok(bytes) => said.extend_from_slice(&piece[..bytes]),
                Err(error) if may_go_on(&error) => self.require_patience(since)?,
                Err(error) => return Err(self.closed()(error)),
            }
        }
    }
}

/// Whether it only was not the time.
fn may_go_on(error: &io::Error) -> bool {
    use io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(error.kind(), Interrupted | TimedOut | WouldBlock)
}

impl Sink for SocketSink {
    type In = Vec<u8>;
    type Error = DownlinkError;

    fn take(&mut self, bytes: Vec<u8>) -> Result<(), DownlinkError> {
        let mut stream = match self.stream.take() {
            Some(stream) => stream,
            None => {
                let stream = self.connect()?;
                self.since = Instant::now();
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

    fn finish(&mut self) -> Result<(), DownlinkError> {
        let Some(mut stream) = self.stream.take() else { return Ok(()) };
        let answer = self.answer(&mut stream)?;
        if answer == format!("taken {} bytes", self.bytes) {
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
