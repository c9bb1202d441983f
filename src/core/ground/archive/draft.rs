//! Draft of a journal record, for a delivery that is being applied.

use super::entry::JournalEntry;
use crate::downlink::CucTime;
use crate::frames::{EphemerisSegment, GroundFrame, Housekeeping, PlacedFrame, PlacedVisibilities};
use crate::units::{ChannelId, MissionTime};

/// Draft of a journal record, for a delivery that is being applied.
#[derive(Debug, Default)]
pub(in crate::ground) struct RecordDraft {
    /// Summary of the packet, without its count and time.
    pub(in crate::ground) entry: JournalEntry,
    pub(in crate::ground) window: MissionTime,
    pub(in crate::ground) segment: Option<EphemerisSegment>,
    pub(in crate::ground) report: Option<Housekeeping>,
    /// Channel of the sums, which sub-bands share.
    pub(in crate::ground) channel: ChannelId,
    pub(in crate::ground) digest: u32,
    pub(in crate::ground) offered: u32,
    /// First and last mission time, s, of the data offered to an engine.
    pub(in crate::ground) used_span_s: Option<[f64; 2]>,
}

impl RecordDraft {
    pub(in crate::ground) fn new(frame: Option<&GroundFrame>) -> Self {
        let empty = Self::default();
        match frame {
            Some(GroundFrame::Visibilities(block)) => {
                let entry = JournalEntry::new(CucTime::default(), 0, block);
                Self { entry, window: block.start, ..empty }
            }
            Some(GroundFrame::Ephemeris(segment)) => Self { segment: Some(segment.clone()), ..empty },
            Some(GroundFrame::Housekeeping(report)) => Self { report: Some(*report), ..empty },
            Some(GroundFrame::Instrument(_)) | None => empty,
        }
    }

    pub(in crate::ground) fn offer(&mut self, placed: &PlacedFrame) {
        if let PlacedFrame::Visibilities(placed) = placed {
            (self.channel, self.digest, self.offered) = (placed.channel, digest(placed), placed.len() as u32);
        }
    }
}

/// Checksum of the data that enter the sums, with draws of the errors of their gains.
pub(in crate::ground) fn digest(placed: &PlacedVisibilities) -> u32 {
    let mut crc = crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi);
    let mut bytes = Vec::with_capacity(80 * placed.len());
    for k in 0..placed.len() {
        let ([a, b, c], [d, e, f], v) = (placed.r_i_m[k], placed.r_j_m[k], placed.value_k_sr[k]);
        let data = [placed.time_s[k], a, b, c, d, e, f, v.re, v.im, placed.weight[k]];
        let errors = placed.gain_errors_of(k).iter().flat_map(|error| [error.re, error.im]);
        data.into_iter().chain(errors).for_each(|number| bytes.extend_from_slice(&number.to_le_bytes()));
    }
    crc.update(&bytes);
    crc.finalize() as u32
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;

    #[test]
    fn draws_of_errors_are_among_the_data_of_a_digest() {
        let mut placed = PlacedVisibilities {
            time_s: vec![1.0],
            r_i_m: vec![[1.0, 2.0, 3.0]],
            r_j_m: vec![[2.0, 2.0, 3.0]],
            value_k_sr: vec![Complex64::new(1.0, 2.0)],
            weight: vec![1.0],
            ..PlacedVisibilities::default()
        };
        let mut of = |errors: &[f64]| {
            placed.gain_errors = errors.iter().map(|re| Complex64::new(*re, 0.0)).collect();
            digest(&placed)
        };
        let digests = [of(&[]), of(&[0.1, 0.2]), of(&[0.1, 0.3])];
        assert!(digests[0] != digests[1] && digests[1] != digests[2] && digests[0] != digests[2]);
    }
}
