//! The journal, with a record of every applied packet and its outcome.

use std::collections::BTreeMap;

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};

use super::draft::RecordDraft;
use super::entry::JournalEntry;
use crate::downlink::receive::PacketOutcome;
pub(in crate::ground) use crate::downlink::receive::SendingKey;
use crate::downlink::wire::{COUNT_MAX, PACKET_BYTES_MAX};
use crate::downlink::{PacketHeader, PacketKind};
use crate::frames::{Housekeeping, VisibilityReason};
use crate::ground::DeliveredPacket;
use crate::runtime::LedgerReport;
use crate::units::{ChannelId, MissionTime};

#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub(in crate::ground) struct JournalRecord {
    pub(in crate::ground) entry: JournalEntry,
    /// Start of the window of the visibilities.
    pub(in crate::ground) window: MissionTime,
    pub(in crate::ground) checksum: u32,
    pub(in crate::ground) bytes: u32,
    pub(in crate::ground) counts: PacketOutcome,
    /// Whether its block had been received already, in another packet.
    pub(in crate::ground) is_duplicate: bool,
    /// Digest of the positions, values, weights and draws offered to the sums.
    pub(in crate::ground) digest: u32,
    /// Number of visibilities with positions, which were offered to the sums.
    pub(in crate::ground) offered: u32,
    pub(in crate::ground) accumulated: u32,
    /// Number of visibilities flagged or lost, by reason.
    pub(in crate::ground) left_out: Vec<(VisibilityReason, u32)>,
    /// Channel and span of the visibilities offered to an engine.
    pub(in crate::ground) used: Option<SumsSpan>,
}

/// Channel of the sums, which sub-bands share, and first and last mission time, s, of the data offered to its engine.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub(in crate::ground) struct SumsSpan {
    pub(in crate::ground) channel: ChannelId,
    pub(in crate::ground) span_s: [f64; 2],
}

#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub(in crate::ground) struct OtherRecord {
    pub(in crate::ground) checksum: u32,
    pub(in crate::ground) bytes: u32,
    pub(in crate::ground) counts: PacketOutcome,
    /// First and last count of the packets of its payload.
    pub(in crate::ground) payload: [u64; 2],
    /// Start of the ephemeris segment in it; `None` if another segment with that start is used.
    pub(in crate::ground) ephemeris_start: Option<MissionTime>,
    /// Housekeeping report of the spacecraft in it.
    pub(in crate::ground) report: Option<Housekeeping>,
}

/// Records of all applied packets, in the order of sending.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in crate::ground) struct Journal {
    pub(in crate::ground) visibilities: BTreeMap<SendingKey, JournalRecord>,
    pub(in crate::ground) others: BTreeMap<(PacketKind, SendingKey), OtherRecord>,
}

impl Journal {
    pub(in crate::ground) fn is_empty(&self) -> bool {
        self.visibilities.is_empty() && self.others.is_empty()
    }

    /// Whether all records are of valid packets. Checkpoints are untrusted.
    pub(in crate::ground) fn is_sound(&self) -> bool {
        let is_valid =
            |(_, count): &SendingKey, bytes: u32| *count <= COUNT_MAX && bytes <= PACKET_BYTES_MAX as u32;
        self.visibilities.iter().all(|(key, record)| is_valid(key, record.bytes))
            && self.others.iter().all(|((_, key), record)| is_valid(key, record.bytes))
    }

    pub(in crate::ground) fn contains(&self, header: &PacketHeader) -> bool {
        let sent = (header.time, header.count);
        match header.kind {
            PacketKind::Visibilities => self.visibilities.contains_key(&sent),
            kind => self.others.contains_key(&(kind, sent)),
        }
    }

    /// Records a packet of visibilities whose outcome is in the ledger entries `posts`.
    pub(in crate::ground) fn record_visibilities(
        &mut self,
        packet: &DeliveredPacket,
        draft: RecordDraft,
        posts: &LedgerReport<VisibilityReason>,
    ) {
        let DeliveredPacket { header, checksum, counts } = *packet;
        let entry = JournalEntry { count: header.count, made: header.time, ..draft.entry };
        let left_out = posts.left_out.iter().map(|(&reason, &count)| (reason, count as u32)).collect();
        let record = JournalRecord {
            entry,
            window: draft.window,
            checksum,
            bytes: header.bytes as u32,
            counts,
            // Only a duplicate posts its visibilities as sampled at once; others are counted at the end.
            is_duplicate: posts.sampled > 0,
            digest: draft.digest,
            offered: draft.offered,
            accumulated: posts.accumulated as u32,
            left_out,
            used: draft.used_span_s.map(|span_s| SumsSpan { channel: draft.channel, span_s }),
        };
        self.visibilities.insert((header.time, header.count), record);
    }

    /// Adds the records of another journal. A packet of visibilities in both is an error, which is its count.
    pub(in crate::ground) fn merge(&mut self, other: Self) -> Result<(), u64> {
        let Self { visibilities, others } = other;
        if let Some((_, count)) = visibilities.keys().find(|sent| self.visibilities.contains_key(sent)) {
            return Err(*count);
        }
        self.visibilities.extend(visibilities);
        for (key, record) in others {
            let ours = self.others.entry(key).or_insert(record);
            ours.ephemeris_start = ours.ephemeris_start.or(record.ephemeris_start);
        }
        Ok(())
    }
}

/// Encodes visibilities as a list of records, as each contains its key.
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

    fn packet(count: u64, checksum: u32) -> DeliveredPacket {
        let (kind, segment, time) = (PacketKind::Visibilities, PacketSegment::Whole, CucTime(7 * count));
        let header = PacketHeader { kind, segment, count, time, version: FORMAT_VERSION, bytes: 60 };
        DeliveredPacket { header, checksum, counts: PacketOutcome::default() }
    }

    const FAR: VisibilityReason = VisibilityReason::BaselineBeyondMap;
    const BRIGHT: VisibilityReason = VisibilityReason::Interference;

    fn posts(reasons: &[(VisibilityReason, u64)]) -> LedgerReport<VisibilityReason> {
        let left_out = reasons.iter().copied().collect();
        LedgerReport { accumulated: 5, left_out, ..LedgerReport::default() }
    }

    type Reasons = Vec<(u64, Vec<(VisibilityReason, u32)>)>;

    fn reasons(journal: &Journal) -> Reasons {
        journal.visibilities.values().map(|record| (record.entry.count, record.left_out.clone())).collect()
    }

    #[test]
    fn reasons_survive_merging_and_storing() {
        let (mut ours, mut theirs) = (Journal::default(), Journal::default());
        ours.record_visibilities(&packet(1, 11), RecordDraft::default(), &posts(&[(FAR, 2)]));
        theirs.record_visibilities(&packet(2, 12), RecordDraft::default(), &posts(&[(BRIGHT, 3), (FAR, 4)]));
        theirs.record_visibilities(&packet(0, 13), RecordDraft::default(), &posts(&[]));
        assert_eq!(ours.merge(theirs.clone()), Ok(()));
        let expected: Reasons = vec![(0, vec![]), (1, vec![(FAR, 2)]), (2, vec![(BRIGHT, 3), (FAR, 4)])];
        assert_eq!(reasons(&ours), expected);
        assert_eq!(reasons(&ours), expected);
        let bytes = bincode::encode_to_vec(&ours, bincode::config::standard()).unwrap();
        let (kept, used) =
            bincode::decode_from_slice::<Journal, _>(&bytes, bincode::config::standard()).unwrap();
        assert_eq!((&kept, used), (&ours, bytes.len()));
        // Merging the other way round gives the same.
        let mut first = Journal::default();
        first.record_visibilities(&packet(1, 11), RecordDraft::default(), &posts(&[(FAR, 2)]));
        assert_eq!(theirs.merge(first.clone()), Ok(()));
        assert_eq!((reasons(&theirs), &theirs), (expected, &ours));
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
        let (mut others, visibilities) = (Journal::default(), with(1, 60));
        let (checksum, bytes, counts) = (1, 60, PacketOutcome::default());
        let record =
            OtherRecord { checksum, bytes, counts, payload: [1, 1], ephemeris_start: None, report: None };
        others.others.insert((PacketKind::Ephemeris, (CucTime(1), COUNT_MAX)), record);
        assert!(others.is_sound() && visibilities.is_sound());
        others.others.insert((PacketKind::Ephemeris, (CucTime(1), COUNT_MAX + 1)), record);
        assert!(!others.is_sound());
    }
}
