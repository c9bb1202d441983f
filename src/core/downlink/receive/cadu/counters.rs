//! Counters of a coded stream and its virtual channels.

use std::fmt;

use serde::Serialize;

/// Counters of the frames of one virtual channel.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct ChannelCounts {
    /// Virtual channel.
    pub channel: u8,
    /// Valid frames, without duplicates.
    pub frames: u64,
    /// Gaps in the frame count.
    pub gaps: u64,
    /// Frames missing in these gaps.
    pub missing: u64,
    /// Frames that arrived later and filled a gap.
    pub late: u64,
    /// Frames received before.
    pub duplicates: u64,
}

/// Counters of a coded stream.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, bincode::Encode, bincode::Decode)]
pub struct FrameCounters {
    /// Bytes received.
    pub bytes: u64,
    /// Number of codewords interleaved in a block; 0 if no frame was found.
    pub interleave: usize,
    /// Frames received with a correctable block, including idle frames and duplicates.
    pub frames: u64,
    /// Frames in which errors were corrected.
    pub frames_corrected: u64,
    /// Bytes corrected in these frames.
    pub bytes_corrected: u64,
    /// Uncorrectable frames.
    pub frames_uncorrectable: u64,
    /// Frames of another version or spacecraft, or of virtual channels beyond the supported number.
    pub frames_foreign: u64,
    /// Frames whose first header pointer is beyond their end.
    pub frames_malformed: u64,
    /// Frames of idle data.
    pub frames_idle: u64,
    /// Number of losses of synchronisation.
    pub sync_losses: u64,
    /// Bits skipped in searches for a marker.
    pub bits_skipped: u64,
    /// Number of changes of polarity.
    pub inversions: u64,
    /// Bytes of an incomplete frame at the end.
    pub bytes_truncated: u64,
    /// Bytes of idle packets.
    pub bytes_idle_packets: u64,
    /// Fragments of packets whose other frames have not arrived.
    pub fragments: u64,
    /// Bytes of these fragments.
    pub bytes_fragments: u64,
    /// Counters by virtual channel, without the idle channel.
    pub channels: Vec<ChannelCounts>,
}

impl FrameCounters {
    /// Adds the counters of another stream, but keeps the interleave of this one.
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
            let Some(own) = self.channels.iter_mut().find(|own| own.channel == counts.channel) else {
                self.channels.push(counts.clone());
                continue;
            };
            own.frames += counts.frames;
            own.gaps += counts.gaps;
            own.missing += counts.missing;
            own.late += counts.late;
            own.duplicates += counts.duplicates;
        }
    }

    /// Whether the stream had no errors: nothing is missing and nothing was corrected.
    #[must_use]
    pub fn is_undamaged(&self) -> bool {
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
            "  stream       {} losses of lock, {} bits skipped, {} inversions, {} bytes in a truncated frame, {} fragments \
             of packets",
            self.sync_losses, self.bits_skipped, self.inversions, self.bytes_truncated, self.fragments
        )
    }
}
