//! A line on every packet that has been read, and what became of it.

use std::collections::BTreeMap;

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};

use crate::downlink::{CucTime, Kind, PacketHeader};
use crate::frames::{PlacedVisibilities, VisibilityBlock, VisibilityReason};
use crate::runtime::LedgerReport;
use crate::units::{ChannelId, MissionTime, Pair};

/// What one packet of visibilities held, as it was received.
#[derive(Clone, Copy, Debug, Default, PartialEq, Encode, Decode)]
pub struct JournalEntry {
    /// Count of the packet.
    pub count: u64,
    /// Time at which the packet was made.
    pub made: CucTime,
    /// Channel.
    pub channel: ChannelId,
    /// Pair.
    pub pair: Pair,
    /// Beginning of the first integration.
    pub start: MissionTime,
    /// End of the last integration.
    pub end: MissionTime,
    /// Visibilities.
    pub visibilities: u32,
    /// Their integration time, s.
    pub integration_s: f64,
    /// Sum of the weights of the good ones, (K sr)^-2.
    pub weight: f64,
}

impl JournalEntry {
    /// Place in the order of sending.
    pub(super) fn sent(&self) -> Sent {
        (self.made, self.count)
    }

    /// The line on a packet: of none, if it holds no visibilities or has been refused.
    pub(super) fn of(header: PacketHeader, block: Option<&VisibilityBlock>) -> Self {
        let none = Self { count: header.count, made: header.time, ..Self::default() };
        let Some((block, last)) = block.and_then(|block| Some((block, block.len().checked_sub(1)?))) else {
            return none;
        };
        let end = i64::from(block.offset_ticks[last]) + i64::from(block.duration_ticks[last]);
        let ticks: u64 = block.duration_ticks.iter().map(|&ticks| u64::from(ticks)).sum();
        let good = block.weight.iter().zip(&block.flags).filter(|(_, flags)| flags.is_good());
        Self {
            channel: block.channel,
            pair: block.pair,
            start: block.start.plus_ticks(i64::from(block.offset_ticks[0])),
            end: block.start.plus_ticks(end),
            visibilities: block.len() as u32,
            integration_s: ticks as f64 * 1e-6,
            weight: good.map(|(&weight, _)| f64::from(weight)).sum(),
            ..none
        }
    }
}

/// Order of sending within a kind.
pub(super) type Sent = (CucTime, u64);

/// A packet of visibilities, and what became of them.
#[derive(Clone, Debug, PartialEq, Encode, Decode)]
pub(super) struct Line {
    pub(super) entry: JournalEntry,
    /// The packet's check.
    pub(super) check: u32,
    /// Of what was handed to the sums: places, values, weights.
    pub(super) digest: u32,
    /// Visibilities that could be placed and were offered to the sums.
    pub(super) offered: u32,
    /// Visibilities in the sums.
    pub(super) accumulated: u32,
    /// Visibilities flagged or lost, by reason.
    pub(super) left_out: Vec<(VisibilityReason, u32)>,
    /// First and last mission time, s, of those that were offered to the sums.
    pub(super) used_s: Option<[f64; 2]>,
}

/// A packet of another kind.
#[derive(Clone, Copy, Debug, PartialEq, Encode, Decode)]
pub(super) struct OtherLine {
    /// The packet's check.
    pub(super) check: u32,
    pub(super) bytes: u32,
    /// First and last count of the packets of its payload.
    pub(super) payload: [u64; 2],
    /// Beginning of the positions in it, if they are those that hold.
    pub(super) segment: Option<MissionTime>,
}

/// All packets that have been read, in the order of sending.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Journal {
    pub(super) visibilities: BTreeMap<Sent, Line>,
    pub(super) others: BTreeMap<(Kind, Sent), OtherLine>,
}

impl Journal {
    /// Lines on packets with visibilities.
    pub(super) fn entries(&self) -> impl Iterator<Item = &JournalEntry> {
        self.visibilities.values().map(|line| &line.entry).filter(|entry| entry.visibilities > 0)
    }

    /// Packets with visibilities, each with the share of what was offered to the sums that they have taken.
    pub(super) fn shares(&self) -> impl Iterator<Item = (&JournalEntry, Option<f64>)> {
        let share =
            |line: &Line| (line.offered > 0).then(|| f64::from(line.accumulated) / f64::from(line.offered));
        let with = |line: &&Line| line.entry.visibilities > 0;
        self.visibilities.values().filter(with).map(move |line| (&line.entry, share(line)))
    }

    /// Keeps a line on a packet of visibilities that became what `account` says.
    pub(super) fn keep(
        &mut self,
        header: PacketHeader,
        check: u32,
        block: Option<&VisibilityBlock>,
        (digest, offered, used_s): (u32, u32, Option<[f64; 2]>),
        account: &LedgerReport<VisibilityReason>,
    ) {
        let left_out = account.left_out.iter().map(|(&reason, &count)| (reason, count as u32)).collect();
        let (entry, accumulated) = (JournalEntry::of(header, block), account.accumulated as u32);
        let line = Line { entry, check, digest, offered, accumulated, left_out, used_s };
        self.visibilities.insert((header.time, header.count), line);
    }

    /// Takes all lines of another journal; the first packet of visibilities that is in both is refused, and gives
    /// packets of other kinds that are in both.
    pub(super) fn absorb(&mut self, other: Self) -> Result<Vec<(Kind, OtherLine)>, u64> {
        let Self { visibilities, others } = other;
        if let Some((_, count)) = visibilities.keys().find(|sent| self.visibilities.contains_key(sent)) {
            return Err(*count);
        }
        self.visibilities.extend(visibilities);
        let mut both = Vec::new();
        for (key, line) in others {
            if let Some(ours) = self.others.get_mut(&key) {
                both.push((key.0, line));
                ours.segment = ours.segment.or(line.segment);
            } else {
                self.others.insert(key, line);
            }
        }
        Ok(both)
    }

    /// First and last mission time, s, of what is in the sums of each channel.
    pub(super) fn spans_s(&self) -> BTreeMap<ChannelId, [f64; 2]> {
        let mut spans: BTreeMap<ChannelId, [f64; 2]> = BTreeMap::new();
        for line in self.visibilities.values() {
            let Some([first, last]) = line.used_s else { continue };
            let span = spans.entry(line.entry.channel).or_insert([first, last]);
            *span = [span[0].min(first), span[1].max(last)];
        }
        spans
    }

    /// Whether visibilities with positions of a stretch of time are in the sums; daughters' own powers have none.
    pub(super) fn uses(&self, [from, to]: [MissionTime; 2]) -> bool {
        let within = |Line { entry, accumulated, .. }: &Line| {
            *accumulated > 0 && entry.pair.i != entry.pair.j && entry.start <= to && entry.end >= from
        };
        self.visibilities.values().any(within)
    }
}

/// As a list of lines: a line names its packet itself.
impl Encode for Journal {
    fn encode<E: Encoder>(&self, encoder: &mut E) -> Result<(), EncodeError> {
        (self.visibilities.len() as u64).encode(encoder)?;
        for line in self.visibilities.values() {
            line.encode(encoder)?;
        }
        self.others.encode(encoder)
    }
}

impl<Context> Decode<Context> for Journal {
    fn decode<D: Decoder<Context = Context>>(decoder: &mut D) -> Result<Self, DecodeError> {
        let lines = Vec::<Line>::decode(decoder)?;
        let sent = |line: &Line| (line.entry.made, line.entry.count);
        let visibilities = lines.into_iter().map(|line| (sent(&line), line)).collect();
        Ok(Self { visibilities, others: Decode::decode(decoder)? })
    }
}

bincode::impl_borrow_decode!(Journal);

/// A checksum over everything that sums are made of.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::{FORMAT_VERSION, PacketSegment};

    fn header(count: u64) -> PacketHeader {
        let (kind, segment, time) = (Kind::Visibilities, PacketSegment::Whole, CucTime(7 * count));
        PacketHeader { kind, segment, count, time, version: FORMAT_VERSION, bytes: 60 }
    }

    const FAR: VisibilityReason = VisibilityReason::BaselineBeyondMap;
    const BRIGHT: VisibilityReason = VisibilityReason::Interference;

    fn account(reasons: &[(VisibilityReason, u64)]) -> LedgerReport<VisibilityReason> {
        let left_out = reasons.iter().copied().collect();
        LedgerReport { accumulated: 5, left_out, ..LedgerReport::default() }
    }

    type Told = Vec<(u64, Vec<(VisibilityReason, u32)>)>;

    fn told(journal: &Journal) -> Told {
        journal.visibilities.values().map(|line| (line.entry.count, line.left_out.clone())).collect()
    }

    #[test]
    fn reasons_are_told_again_whatever_was_merged_and_kept() {
        let (mut ours, mut theirs) = (Journal::default(), Journal::default());
        ours.keep(header(1), 11, None, (0, 0, None), &account(&[(FAR, 2)]));
        theirs.keep(header(2), 12, None, (0, 0, None), &account(&[(BRIGHT, 3), (FAR, 4)]));
        theirs.keep(header(0), 13, None, (0, 0, None), &account(&[]));
        assert_eq!(ours.absorb(theirs.clone()), Ok(vec![]));
        let expected: Told = vec![(0, vec![]), (1, vec![(FAR, 2)]), (2, vec![(BRIGHT, 3), (FAR, 4)])];
        assert_eq!(told(&ours), expected);
        let bytes = bincode::encode_to_vec(&ours, bincode::config::standard()).unwrap();
        let (kept, used) =
            bincode::decode_from_slice::<Journal, _>(&bytes, bincode::config::standard()).unwrap();
        assert_eq!((&kept, used), (&ours, bytes.len()));
        // The other way round the same is told.
        let mut first = Journal::default();
        first.keep(header(1), 11, None, (0, 0, None), &account(&[(FAR, 2)]));
        assert_eq!(theirs.absorb(first.clone()), Ok(vec![]));
        assert_eq!((told(&theirs), &theirs), (expected, &ours));
        assert_eq!(theirs.absorb(first), Err(1));
    }
}
