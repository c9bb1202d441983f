//! Answers to senders about checkpoints.

use crate::downlink::transport::socket::HeldAnswers;

/// Tells senders what is in a checkpoint.
#[derive(Debug, Default)]
pub(super) struct SenderPromises {
    /// Senders that wait; `None` if none may.
    answers: Option<HeldAnswers>,
    /// Bytes of the stream whose packets have all been applied, or are held.
    pub(super) bytes: u64,
    /// Bytes that were applied before the stream began: from the raw archive.
    before: u64,
    /// Packets that the newest checkpoint has.
    packets: u64,
}

impl SenderPromises {
    /// The promises of a ground whose newest checkpoint has this number of packets.
    pub(super) fn since(packets: u64) -> Self {
        Self { packets, ..Self::default() }
    }

    /// The stream begins after so many bytes.
    pub(super) fn begin(&mut self, bytes: u64) {
        (self.before, self.bytes) = (bytes, 0);
    }

    /// So many bytes have been applied, or are held.
    pub(super) fn note_bytes(&mut self, bytes: u64) {
        self.bytes = bytes.saturating_sub(self.before);
    }

    /// Whether there are more than `packets` of the newest checkpoint.
    pub(super) fn has_new(&self, packets: u64) -> bool {
        packets > self.packets
    }

    /// From now on tells these.
    pub(super) fn answering(self, answers: &HeldAnswers) -> Self {
        Self { answers: Some(answers.clone()), ..self }
    }

    /// Whether a checkpoint has to be written because senders wait for it. If the newest one has all `packets` already, they are
    /// told.
    pub(super) fn are_due(&self, packets: u64) -> bool {
        let Some(answers) = self.answers.as_ref().filter(|answers| answers.begin(self.bytes)) else {
            return false;
        };
        let is_new = packets > self.packets;
        if !is_new {
            answers.hold(self.bytes);
        }
        is_new
    }

    /// Notes whether a checkpoint of this many packets was written.
    pub(super) fn keep(&mut self, packets: u64, is_written: bool) {
        if is_written {
            self.packets = packets;
        }
        match &self.answers {
            Some(answers) if is_written => answers.hold(self.bytes),
            Some(answers) => answers.fail(),
            None => {}
        }
    }
}
