//! A journal record in the making.

use super::entry::JournalEntry;
use crate::downlink::CucTime;
use crate::frames::{EphemerisSegment, GroundFrame, Housekeeping, PlacedFrame, PlacedVisibilities};
use crate::units::{ChannelId, MissionTime};

/// A journal record of a delivery that is being applied.
#[derive(Debug, Default)]
pub(in crate::ground) struct RecordDraft {
    /// The entry, without the packet's count and time.
    pub(super) entry: JournalEntry,
    pub(super) window: MissionTime,
    pub(super) segment: Option<EphemerisSegment>,
    pub(super) report: Option<Housekeeping>,
    /// Channel of the sums.
    pub(super) channel: ChannelId,
    pub(super) digest: u32,
    pub(super) offered: u32,
    /// First and last mission time, s, of what was offered to an engine.
    pub(in crate::ground) used_s: Option<[f64; 2]>,
}

impl RecordDraft {
    /// The draft of a frame.
    pub(in crate::ground) fn of(frame: Option<&GroundFrame>) -> Self {
        let nothing = Self::default();
        match frame {
            Some(GroundFrame::Visibilities(block)) => {
                let entry = JournalEntry::of(CucTime::default(), 0, block);
                Self { entry, window: block.start, ..nothing }
            }
            Some(GroundFrame::Ephemeris(segment)) => Self { segment: Some(segment.clone()), ..nothing },
            Some(GroundFrame::Housekeeping(report)) => Self { report: Some(*report), ..nothing },
            Some(GroundFrame::Instrument(_)) | None => nothing,
        }
    }

    /// Notes what is offered to the sums.
    pub(in crate::ground) fn offer(&mut self, placed: &PlacedFrame) {
        if let PlacedFrame::Visibilities(placed) = placed {
            (self.channel, self.digest, self.offered) = (placed.channel, digest(placed), placed.len() as u32);
        }
    }
}

/// A checksum over all that the sums are made of.
pub(super) fn digest(placed: &PlacedVisibilities) -> u32 {
    let mut crc = crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi);
    let mut bytes = Vec::with_capacity(80 * placed.len());
    for k in 0..placed.len() {
        let ([a, b, c], [d, e, f], v) = (placed.r_i_m[k], placed.r_j_m[k], placed.value_k_sr[k]);
        for number in [placed.time_s[k], a, b, c, d, e, f, v.re, v.im, placed.weight[k]] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
    }
    crc.update(&bytes);
    crc.finalize() as u32
}
