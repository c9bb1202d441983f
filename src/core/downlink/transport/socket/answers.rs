//! Senders that wait until a checkpoint on disk contains their packets.

use std::collections::VecDeque;
use std::io::Write;
use std::net::TcpStream;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::report::BUSY;

/// The line before the packets with which a sender asks for the answer `held`. No packet and no frame begins like it.
pub(super) const HELD_REQUEST: &[u8] = b"answer held\n";

/// A checkpoint is due once nothing was received for this time.
const IDLE: Duration = Duration::from_secs(2);
/// A checkpoint is due once the oldest data that no checkpoint contains have this age.
const AGE_MAX: Duration = Duration::from_secs(60);

/// Minimum pause after a checkpoint for senders, as a multiple of the time that it took.
const PAUSE_FACTOR: u32 = 9;

/// Answers `held` to senders that wait until a checkpoint on disk contains their packets. Clones share the state.
///
/// The source counts the bytes that it forwards; the ground reports how many of them its newest checkpoint contains. No
/// method blocks: answers are a few bytes on non-blocking connections.
#[derive(Clone, Debug)]
pub struct HeldAnswers(Arc<Mutex<AnswersState>>);

/// A sender whose packets have all been forwarded.
#[derive(Debug)]
pub(super) struct WaitingSender {
    /// The connection, which is non-blocking.
    pub(super) stream: TcpStream,
    /// Number of bytes that it sent.
    pub(super) bytes: u64,
    /// Number of bytes of all senders up to its last packet.
    pub(super) mark: u64,
}

#[derive(Debug)]
struct AnswersState {
    waiting: VecDeque<WaitingSender>,
    /// Number of bytes of all senders that the newest checkpoint contains.
    held: u64,
    /// Number of bytes of all senders that the ground has received, and when it received the last ones.
    received: u64,
    received_at: Instant,
    /// When the ground received the first bytes that no checkpoint contains.
    unsaved_since: Option<Instant>,
    /// Number of bytes of all senders up to the last packet of a connection that has ended.
    ended: u64,
    /// Number of bytes of all senders that a requested checkpoint must contain, until it begins.
    requested: Option<u64>,
    /// When the requested checkpoint began; `None` if none is being written.
    started: Option<Instant>,
    /// When the next checkpoint may be requested; `None` for immediately.
    next_request: Option<Instant>,
    /// Minimum time between checkpoints.
    pause: Duration,
}

impl HeldAnswers {
    /// A state in which no sender waits. Checkpoints are requested at least `pause` after the last one, and take at most a tenth
    /// of the time.
    #[must_use]
    pub fn new(pause: Duration) -> Self {
        let waiting = VecDeque::new();
        let state = AnswersState {
            waiting,
            held: 0,
            received: 0,
            received_at: Instant::now(),
            unsaved_since: None,
            ended: 0,
            requested: None,
            started: None,
            next_request: None,
            pause,
        };
        Self(Arc::new(Mutex::new(state)))
    }

    /// Answers a sender, now or later. If more than `senders_max` wait, the one that has waited longest is refused.
    pub(super) fn add(&self, sender: WaitingSender, senders_max: usize) {
        let mut state = self.state();
        if sender.mark <= state.held {
            return sender.answer_held();
        }
        state.waiting.push_back(sender);
        if state.waiting.len() > senders_max
            && let Some(oldest) = state.waiting.pop_front()
        {
            oldest.answer_not_held("more than downlink.listen.connections_max senders wait for a checkpoint");
        }
    }

    /// Records the end of a connection; `mark` is the number of bytes of all senders up to its last packet.
    pub(super) fn record_end(&self, mark: u64) {
        let mut state = self.state();
        state.ended = state.ended.max(mark);
    }

    /// Requests a checkpoint if one is due, and returns whether it did. `received` is the number of bytes that the ground has
    /// received. A checkpoint is due if a sender waits whose packets are all among these bytes, if a connection has ended, if
    /// nothing was received for [`IDLE`], or if the oldest unsaved data are older than [`AGE_MAX`].
    pub(super) fn request_checkpoint(&self, received: u64) -> bool {
        let mut state = self.state();
        let now = Instant::now();
        state.record_received(received, now);
        let is_allowed = state.next_request.is_none_or(|instant| now >= instant);
        let has_ended = (state.held + 1..=received).contains(&state.ended);
        let is_idle = now.saturating_duration_since(state.received_at) >= IDLE;
        let unsaved = state.unsaved_since.map(|since| now.saturating_duration_since(since));
        let is_due = unsaved.is_some_and(|age| has_ended || is_idle || age >= AGE_MAX)
            || state.waiting.iter().any(|sender| sender.mark <= received);
        let requests = is_allowed && is_due && state.requested.is_none() && state.started.is_none();
        if requests {
            state.requested = Some(received);
        }
        requests
    }

    /// Starts the requested checkpoint, if one with `bytes` bytes contains enough; returns whether it starts.
    #[must_use]
    pub fn start_checkpoint(&self, bytes: u64) -> bool {
        let mut state = self.state();
        let starts = state.requested.take_if(|requested| *requested <= bytes).is_some();
        if starts {
            state.started = Some(Instant::now());
        }
        starts
    }

    /// Records that a checkpoint on disk contains the first `bytes` bytes of all senders, and answers the senders.
    pub fn record_checkpoint(&self, bytes: u64) {
        let mut state = self.state();
        state.end_checkpoint();
        state.held = state.held.max(bytes);
        if state.held >= state.received {
            state.unsaved_since = None;
        } else if state.unsaved_since.is_some() {
            state.unsaved_since = Some(Instant::now());
        }
        let held = state.held;
        for sender in std::mem::take(&mut state.waiting) {
            match sender.mark <= held {
                true => sender.answer_held(),
                false => state.waiting.push_back(sender),
            }
        }
    }

    /// Records that a checkpoint could not be written. Senders continue to wait.
    pub fn record_failure(&self) {
        self.state().end_checkpoint();
    }

    fn state(&self) -> MutexGuard<'_, AnswersState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl AnswersState {
    /// Records the number of bytes that the ground has received.
    fn record_received(&mut self, received: u64, now: Instant) {
        if received > self.received {
            (self.received, self.received_at) = (received, now);
            if received > self.held {
                self.unsaved_since.get_or_insert(now);
            }
        }
    }

    /// Ends the requested checkpoint, and sets the pause after it.
    fn end_checkpoint(&mut self) {
        if let Some(started) = self.started.take() {
            let pause = self.pause.max(started.elapsed().saturating_mul(PAUSE_FACTOR));
            self.next_request = Instant::now().checked_add(pause);
        }
    }
}

impl Drop for AnswersState {
    fn drop(&mut self) {
        for sender in self.waiting.drain(..) {
            sender.answer_not_held("the ground ended before a checkpoint held them");
        }
    }
}

impl WaitingSender {
    /// Answers and closes the connection.
    fn answer_held(mut self) {
        // A sender need not read the answer.
        let _ = self.stream.write(format!("held {} bytes\n", self.bytes).as_bytes());
    }

    fn answer_not_held(mut self, reason: &str) {
        let _ = self.stream.write(format!("{BUSY}{} bytes are not held: {reason}\n", self.bytes).as_bytes());
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::net::TcpListener;

    use super::*;

    /// A waiting sender, and its end of the connection.
    fn sender(mark: u64) -> (WaitingSender, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let peer = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (stream, _) = listener.accept().unwrap();
        stream.set_nonblocking(true).unwrap();
        (WaitingSender { stream, bytes: 7, mark }, peer)
    }

    fn answer(mut peer: TcpStream) -> String {
        let mut text = String::new();
        peer.read_to_string(&mut text).unwrap();
        text
    }

    #[test]
    fn a_sender_is_answered_by_the_first_checkpoint_that_reaches_its_mark() {
        let answers = HeldAnswers::new(Duration::ZERO);
        let (first, second, third) = (sender(100), sender(200), sender(150));
        for waiting in [first.0, second.0] {
            answers.add(waiting, 9);
        }
        answers.record_checkpoint(99);
        assert_eq!(answers.state().waiting.len(), 2);
        answers.record_checkpoint(199);
        assert_eq!(answer(first.1), "held 7 bytes\n");
        // Packets in the checkpoint are confirmed immediately.
        answers.add(third.0, 9);
        assert_eq!(answer(third.1), "held 7 bytes\n");
        drop(answers);
        assert!(answer(second.1).starts_with("busy: 7 bytes are not held"));
    }

    #[test]
    fn checkpoints_are_requested_while_a_sender_waits_and_with_a_pause() {
        let answers = HeldAnswers::new(Duration::from_secs(1 << 20));
        assert!(!answers.request_checkpoint(100) && !answers.start_checkpoint(100));
        let (waiting, _peer) = sender(100);
        answers.add(waiting, 9);
        // Not before the ground has received all packets of the sender; then once, until the checkpoint has ended.
        assert!(!answers.request_checkpoint(99));
        assert!(
            answers.request_checkpoint(100)
                && !answers.request_checkpoint(100)
                && answers.start_checkpoint(100)
                && !answers.start_checkpoint(100)
                && !answers.request_checkpoint(100)
        );
        answers.record_checkpoint(50);
        assert!(!answers.request_checkpoint(100), "the pause is not over");
        let (waiting, _peer) = sender(100);
        let answers = HeldAnswers::new(Duration::ZERO);
        answers.add(waiting, 9);
        assert!(answers.request_checkpoint(100) && answers.start_checkpoint(100));
        answers.record_failure();
        // The pause is nine times the time that the checkpoint took.
        while !answers.request_checkpoint(100) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_checkpoint_follows_the_end_of_a_connection() {
        let answers = HeldAnswers::new(Duration::ZERO);
        answers.record_end(100);
        // The ground has not received the last bytes of the connection.
        assert!(!answers.request_checkpoint(99));
        assert!(answers.request_checkpoint(100) && answers.start_checkpoint(100));
        answers.record_checkpoint(100);
        // The checkpoint contains everything, so a repeated end requests none.
        while answers.state().next_request.is_some_and(|instant| Instant::now() < instant) {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(!answers.request_checkpoint(100));
        answers.record_end(100);
        assert!(!answers.request_checkpoint(100));
    }

    #[test]
    fn the_sender_that_waits_longest_is_refused_when_too_many_wait() {
        let answers = HeldAnswers::new(Duration::ZERO);
        let (oldest, other) = (sender(100), sender(100));
        answers.add(oldest.0, 1);
        answers.add(other.0, 1);
        assert!(answer(oldest.1).contains("connections_max"));
        answers.record_checkpoint(100);
        assert_eq!(answer(other.1), "held 7 bytes\n");
    }
}
