//! The journal: a record of every packet that was applied, and what became of it.

use std::collections::BTreeMap;

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};

use super::draft::RecordDraft;
use super::entry::JournalEntry;
use crate::downlink::receive::PacketOutcome;
use crate::downlink::wire::{COUNT_MAX, PACKET_BYTES_MAX};
use crate::downlink::{PacketHeader, PacketKind};
use crate::frames::{Housekeeping, VisibilityReason};
use crate::ground::DeliveredPacket;
pub(super) use crate::ground::hold_buffer::Sent;
use crate::runtime::LedgerReport;
use crate::units::{ChannelId, MissionTime};

/// A packet of visibilities, and what became of them.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub(super) struct JournalRecord {
    pub(super) entry: JournalEntry,
    /// Start of the window of the visibilities.
    pub(super) window: MissionTime,
    /// The packet's checksum.
    pub(super) check: u32,
    /// The packet's bytes.
    pub(super) bytes: u32,
    pub(super) reading: PacketOutcome,
    /// Whether its block had been received already, in another packet.
    pub(super) is_duplicate: bool,
    /// Digest of what was offered to the sums: positions, values, weights.
    pub(super) digest: u32,
    /// Visibilities that could be placed and were offered to the sums.
    pub(super) offered: u32,
    /// Visibilities in the sums.
    pub(super) accumulated: u32,
    /// Visibilities flagged or lost, by reason.
    pub(super) left_out: Vec<(VisibilityReason, u32)>,
    /// Visibilities that were offered to an engine.
    pub(super) used: Option<SumsSpan>,
}

/// Channel of the sums, which sub-bands share, and first and last mission time, s, of what was offered to its engine.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub(super) struct SumsSpan {
    pub(super) channel: ChannelId,
    pub(super) span_s: [f64; 2],
}

/// A packet of another kind.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub(super) struct OtherRecord {
    /// The packet's checksum.
    pub(super) check: u32,
    /// The packet's bytes.
    pub(super) bytes: u32,
    pub(super) reading: PacketOutcome,
    /// First and last count of the packets of its payload.
    pub(super) payload: [u64; 2],
    /// Start of the positions in it, if they are those that are used.
    pub(super) segment: Option<MissionTime>,
    /// The spacecraft's report in it.
    pub(super) report: Option<Housekeeping>,
}

/// Records of all packets that were applied, in the order of sending.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Journal {
    pub(super) visibilities: BTreeMap<Sent, JournalRecord>,
    pub(super) others: BTreeMap<(PacketKind, Sent), OtherRecord>,
}

impl Journal {
    /// Whether no packet was applied.
    pub(super) fn is_empty(&self) -> bool {
        self.visibilities.is_empty() && self.others.is_empty()
    }

    /// Whether it has records of packets that can exist; a forged checkpoint may hold anything.
    pub(super) fn is_sound(&self) -> bool {
        let can_exist =
            |(_, count): &Sent, bytes: u32| *count <= COUNT_MAX && bytes <= PACKET_BYTES_MAX as u32;
        self.visibilities.iter().all(|(sent, record)| can_exist(sent, record.bytes))
            && self.others.iter().all(|((_, sent), record)| can_exist(sent, record.bytes))
    }

    /// Whether there is a record of a packet.
    pub(super) fn contains(&self, header: &PacketHeader) -> bool {
        let sent = (header.time, header.count);
        match header.kind {
            PacketKind::Visibilities => self.visibilities.contains_key(&sent),
            kind => self.others.contains_key(&(kind, sent)),
        }
    }

    /// Records a packet of visibilities that became what the ledger's `posts` say.
    pub(super) fn record_visibilities(
        &mut self,
        packet: &DeliveredPacket,
        draft: RecordDraft,
        posts: &LedgerReport<VisibilityReason>,
    ) {
        let DeliveredPacket { header, check, reading } = *packet;
        let entry = JournalEntry { count: header.count, made: header.time, ..draft.entry };
        let left_out = posts.left_out.iter().map(|(&reason, &count)| (reason, count as u32)).collect();
        let record = JournalRecord {
            entry,
            window: draft.window,
            check,
            bytes: header.bytes as u32,
            reading,
            // The first of its blocks is counted as sampled at the end.
            is_duplicate: posts.sampled > 0,
            digest: draft.digest,
            offered: draft.offered,
            accumulated: posts.accumulated as u32,
            left_out,
            used: draft.used_s.map(|span_s| SumsSpan { channel: draft.channel, span_s }),
        };
        self.visibilities.insert((header.time, header.count), record);
    }

    /// Adds the records of another journal. A packet of visibilities that is in both is an error: its count.
    pub(super) fn merge(&mut self, other: Self) -> Result<(), u64> {
        let Self { visibilities, others } = other;
        if let Some((_, count)) = visibilities.keys().find(|sent| self.visibilities.contains_key(sent)) {
            return Err(*count);
        }
        self.visibilities.extend(visibilities);
        for (key, record) in others {
            let ours = self.others.entry(key).or_insert(record);
            ours.segment = ours.segment.or(record.segment);
        }
        Ok(())
    }
}

/// As a list of records: a record of visibilities names its packet itself.
impl Encode for Journal {
    fn encode<E: Encoder>(&self, encoder: &mut E) -> Result<(), EncodeError> {
        (self.visibilities.len() as u64).encode(encoder)?;
        for record in self.visibilities.values() {
            record.encode(encoder)?;
        }
        self.others.encode(encoder)
    }
}

impl<Context> Decode<Context> for Journal {
    fn decode<D: Decoder<Context = Context>>(decoder: &mut D) -> Result<Self, DecodeError> {
        let records = Vec::<JournalRecord>::decode(decoder)?;
        let visibilities = records.into_iter().map(|record| (record.entry.sent(), record)).collect();
        Ok(Self { visibilities, others: Decode::decode(decoder)? })
    }
}

bincode::impl_borrow_decode!(Journal);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::{CucTime, FORMAT_VERSION, PacketSegment};

    fn packet(count: u64, check: u32) -> DeliveredPacket {
        let (kind, segment, time) = (PacketKind::Visibilities, PacketSegment::Whole, CucTime(7 * count));
        let header = PacketHeader { kind, segment, count, time, version: FORMAT_VERSION, bytes: 60 };
        DeliveredPacket { header, check, reading: PacketOutcome::default() }
    }

    const FAR: VisibilityReason = VisibilityReason::BaselineBeyondMap;
    const BRIGHT: VisibilityReason = VisibilityReason::Interference;

    fn posts(reasons: &[(VisibilityReason, u64)]) -> LedgerReport<VisibilityReason> {
        let left_out = reasons.iter().copied().collect();
        LedgerReport { accumulated: 5, left_out, ..LedgerReport::default() }
    }

    type Told = Vec<(u64, Vec<(VisibilityReason, u32)>)>;

    fn told(journal: &Journal) -> Told {
        journal.visibilities.values().map(|record| (record.entry.count, record.left_out.clone())).collect()
    }

    #[test]
    fn reasons_are_told_again_whatever_was_merged_and_kept() {
        let (mut ours, mut theirs) = (Journal::default(), Journal::default());
        ours.record_visibilities(&packet(1, 11), RecordDraft::default(), &posts(&[(FAR, 2)]));
        theirs.record_visibilities(&packet(2, 12), RecordDraft::default(), &posts(&[(BRIGHT, 3), (FAR, 4)]));
        theirs.record_visibilities(&packet(0, 13), RecordDraft::default(), &posts(&[]));
        assert_eq!(ours.merge(theirs.clone()), Ok(()));
        let expected: Told = vec![(0, vec![]), (1, vec![(FAR, 2)]), (2, vec![(BRIGHT, 3), (FAR, 4)])];
        assert_eq!(told(&ours), expected);
        assert_eq!(told(&ours), expected);
        let bytes = bincode::encode_to_vec(&ours, bincode::config::standard()).unwrap();
        let (kept, used) =
            bincode::decode_from_slice::<Journal, _>(&bytes, bincode::config::standard()).unwrap();
        assert_eq!((&kept, used), (&ours, bytes.len()));
        // The other way round the same is told.
        let mut first = Journal::default();
        first.record_visibilities(&packet(1, 11), RecordDraft::default(), &posts(&[(FAR, 2)]));
        assert_eq!(theirs.merge(first.clone()), Ok(()));
        assert_eq!((told(&theirs), &theirs), (expected, &ours));
        assert_eq!(theirs.merge(first), Err(1));
    }
    #[test]
    fn records_of_packets_that_cannot_exist_are_not_sound() {
        let with = |count: u64, bytes: usize| {
            let mut packet = packet(1, 5);
            (packet.header.count, packet.header.bytes) = (count, bytes);
            let mut journal = Journal::default();
            journal.record_visibilities(&packet, RecordDraft::default(), &posts(&[]));
            journal
        };
        assert!(Journal::default().is_sound() && with(COUNT_MAX, PACKET_BYTES_MAX).is_sound());
        assert!(!with(COUNT_MAX + 1, 60).is_sound() && !with(u64::MAX, 60).is_sound());
        assert!(!with(1, PACKET_BYTES_MAX + 1).is_sound());
        let (mut others, of) = (Journal::default(), with(1, 60));
        let (check, bytes, reading) = (1, 60, PacketOutcome::default());
        let record = OtherRecord { check, bytes, reading, payload: [1, 1], segment: None, report: None };
        others.others.insert((PacketKind::Ephemeris, (CucTime(1), COUNT_MAX)), record);
        assert!(others.is_sound() && of.is_sound());
        others.others.insert((PacketKind::Ephemeris, (CucTime(1), COUNT_MAX + 1)), record);
        assert!(!others.is_sound());
    }
}
