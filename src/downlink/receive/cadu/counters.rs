//! Counters of a coded stream.

use std::fmt;

use serde::Serialize;

/// Frames of one virtual channel.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct ChannelCounts {
    /// Virtual channel.
    pub channel: u8,
    /// Sound frames without duplicates.
    pub frames: u64,
    /// Gaps in the frame count.
    pub gaps: u64,
    /// Frames in those gaps.
    pub missing: u64,
    /// Frames that filled a gap later.
    pub late: u64,
    /// Frames received before.
    pub duplicates: u64,
}

/// Counters of a coded stream.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct FrameCounters {
    /// Bytes received.
    pub bytes: u64,
    /// Codewords interleaved in a block; 0 if no frame was found.
    pub interleave: usize,
    /// Sound frames, including idle ones and duplicates.
    pub frames: u64,
    /// Sound frames after correction.
    pub frames_corrected: u64,
    /// Bytes corrected in them.
    pub bytes_corrected: u64,
    /// Uncorrectable frames.
    pub frames_uncorrectable: u64,
    /// Sound frames of another version or spacecraft, or of virtual channels beyond the supported number.
    pub frames_foreign: u64,
    /// Sound frames with a pointer beyond their end.
    pub frames_malformed: u64,
    /// Sound frames of idle data.
    pub frames_idle: u64,
    /// Losses of synchronisation.
    pub sync_losses: u64,
    /// Bits skipped in searches for a marker.
    pub bits_skipped: u64,
    /// Changes of polarity.
    pub inversions: u64,
    /// Bytes of an incomplete frame at the end.
    pub bytes_truncated: u64,
    /// Bytes of idle packets.
    pub bytes_idle_packets: u64,
    /// Pieces of packets whose other frames have not arrived, or never did.
    pub fragments: u64,
    /// Bytes of these pieces.
    pub bytes_fragments: u64,
    /// Virtual channels, without that of idle frames.
    pub channels: Vec<ChannelCounts>,
}

impl FrameCounters {
    /// Adds the counters of another stream. The interleave remains that of the first.
    pub(in crate::downlink) fn add(&mut self, other: &Self) {
        self.bytes += other.bytes;
        self.interleave = if self.interleave == 0 { other.interleave } else { self.interleave };
        self.frames += other.frames;
        self.frames_corrected += other.frames_corrected;
        self.bytes_corrected += other.bytes_corrected;
        self.frames_uncorrectable += other.frames_uncorrectable;
        self.frames_foreign += other.frames_foreign;
        self.frames_malformed += other.frames_malformed;
        self.frames_idle += other.frames_idle;
        self.sync_losses += other.sync_losses;
        self.bits_skipped += other.bits_skipped;
        self.inversions += other.inversions;
        self.bytes_truncated += other.bytes_truncated;
        self.bytes_idle_packets += other.bytes_idle_packets;
        self.fragments += other.fragments;
        self.bytes_fragments += other.bytes_fragments;
        for counts in &other.channels {
            let known = self.channels.iter_mut().find(|known| known.channel == counts.channel);
            let Some(known) = known else {
                self.channels.push(counts.clone());
                continue;
            };
            known.frames += counts.frames;
            known.gaps += counts.gaps;
            known.missing += counts.missing;
            known.late += counts.late;
            known.duplicates += counts.duplicates;
        }
    }

    /// Whether nothing is missing and nothing was corrected.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        let faults =
            self.frames_corrected + self.frames_uncorrectable + self.frames_malformed + self.sync_losses;
        let gaps: u64 = self.channels.iter().map(|channel| channel.gaps).sum();
        faults + gaps + self.bits_skipped + self.bytes_truncated + self.fragments == 0
    }
}

impl fmt::Display for FrameCounters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { frames, frames_corrected, bytes_corrected, frames_uncorrectable, .. } = self;
        writeln!(
            f,
            "frames         {frames:>10} good of interleave {}, {frames_corrected} corrected ({bytes_corrected} \
             bytes), {frames_uncorrectable} uncorrectable, {} idle, {} foreign",
            self.interleave, self.frames_idle, self.frames_foreign
        )?;
        for counts in &self.channels {
            let ChannelCounts { channel, frames, gaps, missing, late, duplicates } = counts;
            writeln!(
                f,
                "  channel {channel:<4} {frames:>10} frames  {missing} missing in {gaps} gaps, {late} late, \
                 {duplicates} duplicate"
            )?;
        }
        write!(
            f,
            "  stream       {} times lost, {} bits passed over, {} inversions, {} bytes in a cut end, {} fragments \
             of packets",
            self.sync_losses, self.bits_skipped, self.inversions, self.bytes_truncated, self.fragments
        )
    }
}
