//! The sink that sends a byte stream over TCP, on the spacecraft.

use std::io::{self, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use super::answers::HELD_REQUEST;
use super::preamble::TOKEN;
use super::report::{BUSY, CLOSED};
use super::url::TcpUrl;
use crate::downlink::error::{DownlinkError, SocketError};
use crate::runtime::{Cancel, Sink, Units};
use crate::units::printable;

/// Maximum time that a system call blocks between two checks for the end of the run.
const POLL: Duration = Duration::from_millis(200);

/// Maximum wait for a stalled receiver once the run has been cancelled.
const GRACE: Duration = Duration::from_secs(10);

/// Number of bytes sent between two checks of the rate.
const PIECE_BYTES: usize = 1 << 16;

/// Maximum number of bytes that are kept from the beginning of the stream, to send them again to a receiver that was busy.
const RESEND_BYTES_MAX: usize = 1 << 24;

/// Pause before the first new attempt; it doubles with each attempt, up to [`PAUSE_MAX`].
const PAUSE: Duration = Duration::from_millis(200);
const PAUSE_MAX: Duration = Duration::from_secs(5);

/// Wait for a checkpoint of the receiver after which it is reported, and interval of further reports.
const WAIT: Duration = Duration::from_secs(5);
const WAIT_EVERY: Duration = Duration::from_secs(30);

const ANSWER_BYTES_MAX: u64 = 1 << 10;

/// Options for sending.
#[derive(Clone, Debug, PartialEq)]
pub struct SendOptions {
    /// Time limit for connecting and for attempts to reach a busy receiver, s.
    pub connect_s: f64,
    /// Maximum rate, bytes per second; 0 for no limit.
    pub bytes_per_s: f64,
    /// Whether to wait until a checkpoint of the receiver contains everything.
    pub held: bool,
    /// Token of the station, for a receiver that requires one.
    pub token: Option<String>,
}

/// Reports that a sender still waits for a checkpoint: to where, the bytes that it has to hold, and the wait so far.
pub type WaitHandler = fn(to: &TcpUrl, bytes: u64, waited: Duration);

/// Sends a byte stream to a listening ground. Connects with the first bytes, and blocks while the receiver does not read.
///
/// If the receiver is busy or the connection breaks, the sink connects again and sends the stream from its beginning, while
/// that is kept. The ground does not apply packets twice.
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
    /// The stream from its beginning; `None` once it exceeds [`RESEND_BYTES_MAX`].
    sent: Option<Vec<u8>>,
    confirmed: Arc<AtomicU64>,
    on_wait: Option<WaitHandler>,
}

impl SocketSink {
    /// A sink without a connection.
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
            on_wait: None,
        })
    }

    /// Calls `on_wait` while the answer of a receiver that is to hold everything takes long.
    #[must_use]
    pub fn with_wait_handler(self, on_wait: WaitHandler) -> Self {
        Self { on_wait: Some(on_wait), ..self }
    }

    /// Number of bytes that the receiver has confirmed: all, or 0 before its answer.
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

    fn pause(&self, length: Duration) {
        let until = Instant::now() + length;
        while let Some(left) = until.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) {
            if self.cancel.is_cancelled() {
                return;
            }
            std::thread::sleep(left.min(POLL));
        }
    }

    /// Sends bytes in pieces, on a new connection if there is none.
    fn send_all(&mut self, bytes: &[u8]) -> Result<(), SocketError> {
        let mut stream = match self.stream.take() {
            Some(stream) => stream,
            None => {
                let mut stream = self.connect()?;
                if let Some(token) = self.options.token.clone() {
                    self.send(&mut stream, &[TOKEN, token.as_bytes(), b"\n"].concat())?;
                }
                if self.options.held {
                    self.send(&mut stream, HELD_REQUEST)?;
                }
                (self.since, self.bytes) = (Instant::now(), 0);
                stream
            }
        };
        for piece in bytes.chunks(PIECE_BYTES) {
            self.send(&mut stream, piece)?;
            self.limit_rate();
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
            // The receiver has ended, or does not support the request.
            false if self.options.held => {
                Err(self.closed()(format!("no checkpoint is known to hold them; it answered {answer:?}")))
            }
            false => Ok(answer),
        }
    }

    /// The answer that confirms everything.
    fn expected(&self) -> String {
        let bytes = self.bytes;
        match self.options.held {
            true => format!("taken {bytes} bytes\nheld {bytes} bytes"),
            false => format!("taken {bytes} bytes"),
        }
    }

    /// After a failure, sends the kept stream again and repeats `operation`, until it succeeds or the time limit is reached.
    fn retry<T>(
        &mut self,
        failure: SocketError,
        operation: impl Fn(&mut Self) -> Result<T, SocketError>,
    ) -> Result<T, SocketError> {
        let (since, mut failure, mut pause, mut attempts) = (Instant::now(), failure, PAUSE, 0);
        while self.may_retry(&failure) && since.elapsed().as_secs_f64() < self.options.connect_s {
            self.pause(pause);
            pause = (2 * pause).min(PAUSE_MAX);
            attempts += 1;
            self.stream = None;
            let Some(sent) = self.sent.take() else { break };
            let resent = self.send_all(&sent);
            self.sent = Some(sent);
            match resent.and_then(|()| operation(self)) {
                Ok(result) => return Ok(result),
                // The earlier reason is more useful than a failed connection.
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

    /// Whether the stream can be sent again from its beginning, as the receiver was busy or the connection broke.
    fn may_retry(&self, failure: &SocketError) -> bool {
        let SocketError::Closed { reason, .. } = failure else { return false };
        let is_final = reason.starts_with(CLOSED);
        self.sent.is_some() && !is_final && !self.cancel.is_cancelled()
    }

    /// Keeps bytes for another attempt, unless the stream has become too long.
    fn keep(&mut self, bytes: &[u8]) {
        if let Some(sent) = &mut self.sent {
            match sent.len() + bytes.len() <= RESEND_BYTES_MAX {
                true => sent.extend_from_slice(bytes),
                false => self.sent = None,
            }
        }
    }

    /// Makes the error of a closed connection from its reason.
    fn closed<E: ToString>(&self) -> impl Fn(E) -> SocketError + use<E> {
        let (url, bytes) = (self.url.clone(), self.bytes);
        // The receiver's answer may contain control characters, which a terminal would interpret.
        let shown = |reason: E| printable(&reason.to_string()).into_owned();
        move |reason| SocketError::Closed { url: url.to_string(), bytes, reason: shown(reason) }
    }

    /// Sends a piece; blocks while the receiver does not read.
    fn send(&mut self, stream: &mut TcpStream, mut piece: &[u8]) -> Result<(), SocketError> {
        let mut progress = Instant::now();
        while !piece.is_empty() {
            match stream.write(piece) {
                Ok(0) => return Err(self.refusal(stream, &"it accepts no more bytes")),
                Ok(bytes) => {
                    self.bytes += bytes as u64;
                    piece = &piece[bytes..];
                    progress = Instant::now();
                }
                Err(error) if is_transient(&error) => self.require_progress(progress, "read the rest")?,
                Err(error) => return Err(self.refusal(stream, &error)),
            }
        }
        Ok(())
    }

    /// The error of a connection that the receiver has closed, with the reason that it may have sent.
    fn refusal(&self, stream: &mut TcpStream, error: &dyn ToString) -> SocketError {
        let mut answer = String::new();
        let _ = stream.take(ANSWER_BYTES_MAX).read_to_string(&mut answer);
        let reason = if answer.trim().is_empty() { error.to_string() } else { answer.trim().to_owned() };
        self.closed()(reason)
    }

    /// Limits the wait for a stalled receiver after cancellation; the receiver does not do `what`.
    fn require_progress(&self, since: Instant, what: &str) -> Result<(), SocketError> {
        match self.cancel.is_cancelled() && since.elapsed() > GRACE {
            true => Err(self.closed()(format!("the run was interrupted, and the receiver does not {what}"))),
            false => Ok(()),
        }
    }

    /// Waits as long as the maximum rate requires, counted from the first byte.
    fn limit_rate(&self) {
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

    /// Ends the stream and reads the receiver's answer.
    fn answer(&self, stream: &mut TcpStream) -> Result<String, SocketError> {
        if let Err(error) = stream.shutdown(Shutdown::Write) {
            return Err(self.refusal(stream, &error));
        }
        let since = Instant::now();
        let mut report_after = WAIT;
        let mut answer = Vec::new();
        let mut piece = [0; 256];
        loop {
            if let Some(on_wait) =
                self.on_wait.filter(|_| self.options.held && since.elapsed() >= report_after)
            {
                on_wait(&self.url, self.bytes, since.elapsed());
                report_after += WAIT_EVERY;
            }
            match stream.read(&mut piece) {
                Ok(0) => return Ok(String::from_utf8_lossy(&answer).trim().to_owned()),
                Ok(bytes) if answer.len() as u64 + bytes as u64 > ANSWER_BYTES_MAX => {
                    return Err(self.closed()("its answer is not a line of text"));
                }
                Ok(bytes) => answer.extend_from_slice(&piece[..bytes]),
                Err(error) if is_transient(&error) => self.require_progress(since, "answer")?,
                Err(error) if answer.is_empty() => return Err(self.closed()(error)),
                // The beginning of an answer is more useful than the error.
                Err(_) => return Err(self.closed()(String::from_utf8_lossy(&answer).trim().to_owned())),
            }
        }
    }
}

/// Whether a system call can be repeated after an error.
fn is_transient(error: &io::Error) -> bool {
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
            // The kept stream includes these bytes.
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

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::sync::atomic::AtomicBool;

    use super::*;

    #[test]
    fn a_sender_that_waits_for_a_checkpoint_says_so() {
        static IS_TOLD: AtomicBool = AtomicBool::new(false);
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = TcpUrl::from(listener.local_addr().unwrap());
        let ground = std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.read_to_end(&mut Vec::new()).unwrap();
            writeln!(stream, "taken 3 bytes").unwrap();
            // No checkpoint before the sender has said that it waits.
            while !IS_TOLD.load(Ordering::Relaxed) {
                std::thread::sleep(POLL);
            }
            writeln!(stream, "held 3 bytes").unwrap();
        });
        let options = SendOptions { connect_s: 5.0, bytes_per_s: 0.0, held: true, token: None };
        let sink = SocketSink::new(&url, options, &Cancel::new()).unwrap();
        let mut sink = sink.with_wait_handler(|_, bytes, waited| {
            assert!(bytes == 3 && waited >= WAIT);
            IS_TOLD.store(true, Ordering::Relaxed);
        });
        sink.take(vec![1, 2, 3]).unwrap();
        sink.finish().unwrap();
        assert_eq!(sink.confirmed().load(Ordering::Relaxed), 3);
        ground.join().unwrap();
    }
}
