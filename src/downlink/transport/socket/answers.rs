//! Senders that wait until a checkpoint on disk holds what they sent.

use std::collections::VecDeque;
use std::io::Write;
use std::net::TcpStream;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::report::BUSY;

/// The line before the packets with which a sender asks. No packet and no frame begins like it.
pub(super) const ASKS_HELD: &[u8] = b"answer held\n";

/// A checkpoint is due once nothing came for so long, and once what came first is so old.
const IDLE: Duration = Duration::from_secs(2);
const AGE_MAX: Duration = Duration::from_secs(60);

/// A checkpoint for senders is followed by so many times its own length without another.
const REST: u32 = 9;

/// The answers of senders that wait until a checkpoint on disk holds what they sent. Clones share them.
///
/// The source counts the bytes that it passes on; the ground says how many of them its newest checkpoint holds. Nothing here
/// waits: answers are a few bytes, on connections that do not block.
#[derive(Clone, Debug)]
pub struct HeldAnswers(Arc<Mutex<AnswersState>>);

/// A sender of which everything has been passed on.
#[derive(Debug)]
pub(super) struct WaitingSender {
    /// Its connection, which does not block.
    pub(super) stream: TcpStream,
    /// Bytes that it sent.
    pub(super) bytes: u64,
    /// Bytes of all senders up to its last packet.
    pub(super) mark: u64,
}

#[derive(Debug)]
struct AnswersState {
    waiting: VecDeque<WaitingSender>,
    /// Bytes of all senders that the newest checkpoint holds.
    held: u64,
    /// Bytes of all senders that the ground has got, and when it got the last of them.
    given: u64,
    given_at: Instant,
    /// When the first of those came that no checkpoint holds.
    unsaved_since: Option<Instant>,
    /// Bytes of all senders up to the last packet of a connection that has ended.
    ended: u64,
    /// Bytes of all senders that a checkpoint is asked to hold, which has not begun.
    asked: Option<u64>,
    /// When the one that was asked for began.
    begun: Option<Instant>,
    /// None is asked for before.
    not_before: Option<Instant>,
    pause: Duration,
}

impl HeldAnswers {
    /// Nobody waits. Checkpoints are asked for no sooner than `pause` after the last one, and take no more than a tenth of the
    /// time.
    #[must_use]
    pub fn new(pause: Duration) -> Self {
        let waiting = VecDeque::new();
        let state = AnswersState {
            waiting,
            held: 0,
            given: 0,
            given_at: Instant::now(),
            unsaved_since: None,
            ended: 0,
            asked: None,
            begun: None,
            not_before: None,
            pause,
        };
        Self(Arc::new(Mutex::new(state)))
    }

    /// Answers a sender, at once or later. Of more than `most` senders the one that has waited longest is sent away.
    pub(super) fn add(&self, sender: WaitingSender, most: usize) {
        let mut state = self.state();
        if sender.mark <= state.held {
            return sender.say_held();
        }
        state.waiting.push_back(sender);
        if state.waiting.len() > most
            && let Some(oldest) = state.waiting.pop_front()
        {
            oldest.say_not("more than downlink.listen.connections_max senders wait for a checkpoint");
        }
    }

    /// A connection has ended whose last packet is among so many bytes of all senders.
    pub(super) fn note_end(&self, mark: u64) {
        let mut state = self.state();
        state.ended = state.ended.max(mark);
    }

    /// Asks for a checkpoint, if a sender waits for one of which all is among the `given` bytes that the ground gets; if a delivery
    /// has ended; if nothing came for a while; or if what came first is old by now. Returns whether it does so now.
    pub(super) fn ask(&self, given: u64) -> bool {
        let mut state = self.state();
        let now = Instant::now();
        state.note_passed_on(given, now);
        let is_time = state.not_before.is_none_or(|instant| now >= instant);
        let has_ended = (state.held + 1..=given).contains(&state.ended);
        let is_idle = now.saturating_duration_since(state.given_at) >= IDLE;
        let unsaved = state.unsaved_since.map(|since| now.saturating_duration_since(since));
        let is_due = unsaved.is_some_and(|age| has_ended || is_idle || age >= AGE_MAX);
        let is_wanted = is_due || state.waiting.iter().any(|sender| sender.mark <= given);
        let asks = is_time && is_wanted && state.asked.is_none() && state.begun.is_none();
        if asks {
            state.asked = Some(given);
        }
        asks
    }

    /// Whether a checkpoint is asked for of no more than these `bytes`; it begins then.
    #[must_use]
    pub fn begin(&self, bytes: u64) -> bool {
        let mut state = self.state();
        // One of less would answer nobody.
        let begins = state.asked.take_if(|asked| *asked <= bytes).is_some();
        if begins {
            state.begun = Some(Instant::now());
        }
        begins
    }

    /// A checkpoint on disk holds this many bytes of all senders, from the first on.
    pub fn hold(&self, bytes: u64) {
        let mut state = self.state();
        state.end();
        state.held = state.held.max(bytes);
        if state.held >= state.given {
            state.unsaved_since = None;
        } else if state.unsaved_since.is_some() {
            state.unsaved_since = Some(Instant::now());
        }
        let held = state.held;
        for sender in std::mem::take(&mut state.waiting) {
            match sender.mark <= held {
                true => sender.say_held(),
                false => state.waiting.push_back(sender),
            }
        }
    }

    /// A checkpoint could not be written. Senders go on waiting.
    pub fn fail(&self) {
        self.state().end();
    }

    fn state(&self) -> MutexGuard<'_, AnswersState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl AnswersState {
    /// The ground has got so many bytes.
    fn note_passed_on(&mut self, given: u64, now: Instant) {
        if given > self.given {
            (self.given, self.given_at) = (given, now);
            if given > self.held {
                self.unsaved_since.get_or_insert(now);
            }
        }
    }

    /// The checkpoint that was asked for has ended.
    fn end(&mut self) {
        if let Some(begun) = self.begun.take() {
            let pause = self.pause.max(begun.elapsed().saturating_mul(REST));
            self.not_before = Instant::now().checked_add(pause);
        }
    }
}

impl Drop for AnswersState {
    fn drop(&mut self) {
        for sender in self.waiting.drain(..) {
            sender.say_not("the ground ended before a checkpoint held them");
        }
    }
}

impl WaitingSender {
    /// Answers, and closes the connection. A sender need not read it.
    fn say_held(mut self) {
        let _ = self.stream.write(format!("held {} bytes\n", self.bytes).as_bytes());
    }

    fn say_not(mut self, reason: &str) {
        let _ = self.stream.write(format!("{BUSY}{} bytes are not held: {reason}\n", self.bytes).as_bytes());
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;
    use std::net::TcpListener;

    use super::*;

    /// A sender that waits, and its end of the connection.
    fn sender(mark: u64) -> (WaitingSender, TcpStream) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let far = TcpStream::connect(listener.local_addr().unwrap()).unwrap();
        let (stream, _) = listener.accept().unwrap();
        stream.set_nonblocking(true).unwrap();
        (WaitingSender { stream, bytes: 7, mark }, far)
    }

    fn answer(mut far: TcpStream) -> String {
        let mut said = String::new();
        far.read_to_string(&mut said).unwrap();
        said
    }

    #[test]
    fn a_sender_is_answered_by_the_first_checkpoint_that_reaches_its_mark() {
        let answers = HeldAnswers::new(Duration::ZERO);
        let (first, second, third) = (sender(100), sender(200), sender(150));
        for waiting in [first.0, second.0] {
            answers.add(waiting, 9);
        }
        answers.hold(99);
        assert_eq!(answers.state().waiting.len(), 2);
        answers.hold(199);
        assert_eq!(answer(first.1), "held 7 bytes\n");
        // What is held already is answered at once.
        answers.add(third.0, 9);
        assert_eq!(answer(third.1), "held 7 bytes\n");
        drop(answers);
        assert!(answer(second.1).starts_with("busy: 7 bytes are not held"));
    }

    #[test]
    fn checkpoints_are_asked_for_while_somebody_waits_and_not_in_a_row() {
        let answers = HeldAnswers::new(Duration::from_secs(1 << 20));
        assert!(!answers.ask(100) && !answers.begin(100));
        let (waiting, _far) = sender(100);
        answers.add(waiting, 9);
        // Not before the ground gets all of it; then once, until it has ended.
        assert!(!answers.ask(99));
        assert!(
            answers.ask(100)
                && !answers.ask(100)
                && answers.begin(100)
                && !answers.begin(100)
                && !answers.ask(100)
        );
        answers.hold(50);
        assert!(!answers.ask(100), "the pause is not over");
        let (waiting, _far) = sender(100);
        let answers = HeldAnswers::new(Duration::ZERO);
        answers.add(waiting, 9);
        assert!(answers.ask(100) && answers.begin(100));
        answers.fail();
        // Nine times as long as it took.
        wait_for(&answers);
    }

    fn wait_for(answers: &HeldAnswers) {
        while !answers.ask(100) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn a_delivery_that_has_ended_is_followed_by_a_checkpoint() {
        let answers = HeldAnswers::new(Duration::ZERO);
        answers.note_end(100);
        // Its last bytes are on their way to the ground.
        assert!(!answers.ask(99));
        assert!(answers.ask(100) && answers.begin(100));
        answers.hold(100);
        // All is held, whoever sends it again.
        wait_until_rested(&answers);
        assert!(!answers.ask(100));
        answers.note_end(100);
        assert!(!answers.ask(100));
    }

    /// The pause after a checkpoint is over.
    fn wait_until_rested(answers: &HeldAnswers) {
        while answers.state().not_before.is_some_and(|instant| Instant::now() < instant) {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn who_waits_longest_goes_when_too_many_wait() {
        let answers = HeldAnswers::new(Duration::ZERO);
        let (oldest, other) = (sender(100), sender(100));
        answers.add(oldest.0, 1);
        answers.add(other.0, 1);
        assert!(answer(oldest.1).contains("connections_max"));
        answers.hold(100);
        assert_eq!(answer(other.1), "held 7 bytes\n");
    }
}
