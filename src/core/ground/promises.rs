//! Acknowledges to senders which of their data are in a checkpoint.

use crate::downlink::transport::socket::HeldAnswers;

/// Acknowledges to senders which of their data are in a checkpoint.
#[derive(Debug, Default)]
pub(super) struct SenderPromises {
    /// Senders that wait; `None` if there is no answer channel.
    answers: Option<HeldAnswers>,
    /// Bytes of the stream whose packets have all been applied or are held.
    pub(super) bytes: u64,
    /// Bytes that were applied from the raw archive, before the stream began.
    archived_bytes: u64,
    packets: u64,
}

impl SenderPromises {
    /// The initial state, for a newest checkpoint with this number of packets.
    pub(super) fn since(packets: u64) -> Self {
        Self { packets, ..Self::default() }
    }

    /// Notes that the stream begins after this number of bytes.
    pub(super) fn begin(&mut self, bytes: u64) {
        (self.archived_bytes, self.bytes) = (bytes, 0);
    }

    /// Notes the number of bytes that have been applied or are held.
    pub(super) fn note_bytes(&mut self, bytes: u64) {
        self.bytes = bytes.saturating_sub(self.archived_bytes);
    }

    pub(super) fn has_new(&self, packets: u64) -> bool {
        packets > self.packets
    }

    /// Answers these senders from now on.
    pub(super) fn with_answers(self, answers: &HeldAnswers) -> Self {
        Self { answers: Some(answers.clone()), ..self }
    }

    /// Whether a checkpoint has to be written because senders wait for it. If the newest one already has all `packets`, the senders get
    /// their answer.
    pub(super) fn are_due(&self, packets: u64) -> bool {
        let Some(answers) = self.answers.as_ref().filter(|answers| answers.start_checkpoint(self.bytes))
        else {
            return false;
        };
        let has_new = self.has_new(packets);
        if !has_new {
            answers.record_checkpoint(self.bytes);
        }
        has_new
    }

    /// Notes whether a checkpoint with this number of packets was written, and answers the senders.
    pub(super) fn note_checkpoint(&mut self, packets: u64, is_written: bool) {
        if is_written {
            self.packets = packets;
        }
        match &self.answers {
            Some(answers) if is_written => answers.record_checkpoint(self.bytes),
            Some(answers) => answers.record_failure(),
            None => {}
        }
    }
}
