//! What is missing, in packets and in what they would add to the map.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::Serialize;

use super::journal::JournalEntry;
use crate::downlink::{Kind, Taken};
use crate::units::{ChannelId, Pair};

/// What sends packets in its turn, pass by pass.
type Stream = (ChannelId, Pair);

/// What the missing packets of one channel and pair held, estimated.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LostStream {
    /// Channel, from 0.
    pub channel: u16,
    /// Pair, as in "1-2".
    pub pair: String,
    /// Packets.
    pub packets: u64,
    /// Integration time in them, s.
    pub integration_s: f64,
    /// Sum of weights in them, (K sr)^-2.
    pub weight: f64,
}

/// A stretch of missing packets, to be asked for again.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GapReport {
    /// Kind.
    pub kind: Kind,
    /// Application process identifier.
    pub apid: u16,
    /// Count of the first missing packet.
    pub from: u64,
    /// Count of the last missing packet.
    pub to: u64,
    /// Mission time of the last visibility before it and the first behind it, s, where there are such.
    pub between_s: [Option<f64>; 2],
    /// Integration time in it, s, over all channels and pairs.
    pub integration_s: f64,
    /// What it would add: its weight over that received in the same channel, summed over channels.
    pub gain: f64,
    /// By channel and pair; empty for packets other than visibilities.
    pub lost: Vec<LostStream>,
}

/// What has been received of one channel.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ChannelCoverage {
    /// Channel, from 0.
    pub channel: u16,
    /// Packets received.
    pub packets: u64,
    /// Integration time received, s, over all pairs.
    pub integration_s: f64,
    /// Weight received, (K sr)^-2.
    pub weight: f64,
    /// Integration time missing, s.
    pub missing_integration_s: f64,
    /// Weight missing, (K sr)^-2.
    pub missing_weight: f64,
}

/// All that is missing.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Gaps {
    /// Channels.
    pub channels: Vec<ChannelCoverage>,
    /// Gaps: the one whose recovery adds most first; those of other kinds than visibilities last.
    pub gaps: Vec<GapReport>,
}

/// Finds what is missing between the packets of `journal`, which are those of `taken`.
///
/// Every pass sends channel after channel and pair after pair, each in as many packets as it takes. The order and the
/// usual number of packets are learnt from what was received; a gap is filled along them from the packet before
/// it, with packets as the same channel and pair has sent on average. What was sent after the last packet that came is
/// not known to be missing.
#[must_use]
pub fn find_gaps(journal: &[JournalEntry], taken: &[(Kind, &Taken)]) -> Gaps {
    let mut gaps = Vec::new();
    let mut channels: BTreeMap<u16, ChannelCoverage> = BTreeMap::new();
    for entry in journal {
        let coverage = channels.entry(entry.channel.0).or_default();
        coverage.packets += 1;
        coverage.integration_s += entry.integration_s;
        coverage.weight += entry.weight;
    }
    for (kind, taken) in taken {
        let eras = taken.eras();
        for (k, (from, missing)) in eras.iter().enumerate() {
            let until = eras.get(k + 1).map(|(from, _)| *from);
            let in_era = |entry: &&JournalEntry| {
                (k == 0 || entry.made >= *from) && until.is_none_or(|until| entry.made < until)
            };
            let entries: Vec<JournalEntry> = match kind {
                Kind::Visibilities => journal.iter().filter(in_era).copied().collect(),
                _ => Vec::new(),
            };
            let schedule = Schedule::learn(entries);
            gaps.extend(missing.iter().map(|gap| schedule.report(*kind, gap)));
        }
    }
    for gap in &mut gaps {
        for lost in &gap.lost {
            let Some(coverage) = channels.get_mut(&lost.channel) else { continue };
            coverage.missing_integration_s += lost.integration_s;
            coverage.missing_weight += lost.weight;
            gap.gain += if coverage.weight > 0.0 { lost.weight / coverage.weight } else { 0.0 };
        }
    }
    gaps.sort_by(|a, b| b.gain.total_cmp(&a.gain).then((a.kind, a.from).cmp(&(b.kind, b.from))));
    let channels = channels.into_iter().map(|(channel, coverage)| ChannelCoverage { channel, ..coverage });
    Gaps { channels: channels.collect(), gaps }
}

/// What a channel and pair sends.
#[derive(Clone, Copy, Debug, Default)]
struct Usual {
    /// Packets a pass.
    packets: u64,
    /// Means over its packets.
    integration_s: f64,
    weight: f64,
}

/// How packets follow each other in an era, learnt from those that came.
struct Schedule {
    /// By count.
    entries: Vec<JournalEntry>,
    /// In the order of sending within a pass.
    order: Vec<Stream>,
    usual: BTreeMap<Stream, Usual>,
}

impl Schedule {
    fn learn(mut entries: Vec<JournalEntry>) -> Self {
        entries.sort_by_key(|entry| entry.count);
        let mut order: Vec<Stream> = Vec::new();
        let mut at = 0;
        // Packets of each stream, pass by pass.
        let mut passes: BTreeMap<Stream, Vec<u64>> = BTreeMap::new();
        let mut sums: BTreeMap<Stream, (f64, f64)> = BTreeMap::new();
        let mut before: Option<JournalEntry> = None;
        for entry in &entries {
            let stream = (entry.channel, entry.pair);
            at = match order.iter().position(|known| *known == stream) {
                Some(at) => at,
                None => {
                    let after = (at + 1).min(order.len());
                    order.insert(after, stream);
                    after
                }
            };
            let counts = passes.entry(stream).or_default();
            match counts.last_mut() {
                Some(count) if before.is_some_and(|before| same_pass(&before, entry)) => *count += 1,
                _ => counts.push(1),
            }
            let (integration_s, weight) = sums.entry(stream).or_default();
            *integration_s += entry.integration_s;
            *weight += entry.weight;
            before = Some(*entry);
        }
        let usual = passes.into_iter().map(|(stream, mut counts)| {
            let packets = counts.iter().sum::<u64>() as f64;
            counts.sort_unstable();
            let (integration_s, weight) = sums.get(&stream).copied().unwrap_or_default();
            let median = counts[counts.len() / 2];
            let usual =
                Usual { packets: median, integration_s: integration_s / packets, weight: weight / packets };
            (stream, usual)
        });
        Self { order, usual: usual.collect(), entries }
    }

    fn report(&self, kind: Kind, gap: &Range<u64>) -> GapReport {
        let next = self.entries.partition_point(|entry| entry.count < gap.start);
        let before = next.checked_sub(1).map(|at| &self.entries[at]);
        let after = self.entries.get(next);
        let mut lost: Vec<LostStream> = self
            .fill(gap.end - gap.start, next)
            .into_iter()
            .map(|(stream, packets)| {
                let usual = self.usual.get(&stream).copied().unwrap_or_default();
                LostStream {
                    channel: stream.0.0,
                    pair: stream.1.to_string(),
                    packets,
                    integration_s: usual.integration_s * packets as f64,
                    weight: usual.weight * packets as f64,
                }
            })
            .collect();
        lost.sort_by(|a, b| (a.channel, &a.pair).cmp(&(b.channel, &b.pair)));
        GapReport {
            kind,
            apid: kind.apid(),
            from: gap.start,
            to: gap.end - 1,
            between_s: [before.map(|entry| entry.end.seconds()), after.map(|entry| entry.start.seconds())],
            integration_s: lost.iter().map(|lost| lost.integration_s).sum(),
            gain: 0.0,
            lost,
        }
    }

    /// The streams of `missing` packets before the entry `next`, along the schedule.
    fn fill(&self, missing: u64, next: usize) -> BTreeMap<Stream, u64> {
        let mut filled = BTreeMap::new();
        let before = next.checked_sub(1).map(|at| self.entries[at]);
        let after = self.entries.get(next);
        let (mut at, mut sent, mut step) = (0, 0, 1);
        let place = |stream: Stream| self.order.iter().position(|known| *known == stream).unwrap_or(0);
        if let Some(before) = before {
            let stream = (before.channel, before.pair);
            if after.is_some_and(|after| same_pass(&before, after)) {
                filled.insert(stream, missing);
                return filled;
            }
            at = place(stream);
            let of_pass = self.entries[..next].iter().rev();
            sent = of_pass.take_while(|entry| (entry.channel, entry.pair) == stream).count() as u64;
        } else if let Some(after) = after {
            // Nothing came before: backwards from what came first.
            let stream = (after.channel, after.pair);
            (at, step) = (place(stream), self.order.len() - 1);
            let of_pass = self.entries[next..].iter();
            sent = of_pass.take_while(|entry| (entry.channel, entry.pair) == stream).count() as u64;
        }
        let usual = |stream: &Stream| self.usual.get(stream).map_or(1, |usual| usual.packets.max(1));
        let pass: u64 = self.order.iter().map(usual).sum();
        let mut left = missing;
        while left > 0 && !self.order.is_empty() {
            let stream = self.order[at];
            let packets = usual(&stream).saturating_sub(sent).min(left);
            if packets > 0 {
                *filled.entry(stream).or_default() += packets;
            }
            left -= packets;
            sent = 0;
            at = (at + step) % self.order.len();
            // Whole passes at once: a packet may claim any count.
            for stream in self.order.iter().filter(|_| left >= pass) {
                *filled.entry(*stream).or_default() += left / pass * usual(stream);
            }
            left %= pass;
        }
        filled
    }
}

/// Whether a packet goes on with the channel and pair of the one before it, in the same pass.
fn same_pass(before: &JournalEntry, entry: &JournalEntry) -> bool {
    // A pass is over when another channel or pair has been in between: then time has gone back, or far ahead.
    let length_s = (before.end.seconds() - before.start.seconds()).max(1.0);
    let ahead_s = entry.start.seconds() - before.end.seconds();
    let packets = entry.count.abs_diff(before.count) as f64;
    (before.channel, before.pair) == (entry.channel, entry.pair)
        && ahead_s >= -1e-6
        && ahead_s <= 4.0 * length_s * packets
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::CucTime;
    use crate::units::MissionTime;

    const PASSES: u64 = 6;
    const STREAMS: u64 = 6;

    /// Six passes of two channels and three pairs; channel 1 sends three packets a pass and pair, channel 0 one.
    fn journal() -> Vec<JournalEntry> {
        let mut entries = Vec::new();
        for pass in 0..PASSES {
            for stream in 0..STREAMS {
                let channel = (stream / 3) as u16;
                for part in 0..1 + 2 * u64::from(channel) {
                    let start_s = 9000.0 * pass as f64 + 600.0 * part as f64;
                    entries.push(JournalEntry {
                        count: entries.len() as u64,
                        made: CucTime((1 + pass) << 24),
                        channel: ChannelId(channel),
                        pair: Pair { i: 0, j: 1 + (stream % 3) as u8 },
                        start: MissionTime::from_seconds(start_s),
                        end: MissionTime::from_seconds(start_s + 600.0),
                        visibilities: 100,
                        integration_s: 500.0,
                        weight: 1.0 + f64::from(channel),
                    });
                }
            }
        }
        entries
    }

    /// What is found when packets are left out, and what they held by channel and pair.
    fn without(lost: &[Range<u64>]) -> (Gaps, BTreeMap<(u16, String), f64>) {
        let mut taken = Taken::default();
        let mut held = BTreeMap::new();
        let mut kept = Vec::new();
        for entry in journal() {
            if lost.iter().any(|range| range.contains(&entry.count)) {
                *held.entry((entry.channel.0, entry.pair.to_string())).or_default() += entry.integration_s;
            } else {
                taken.take(entry.count, entry.made);
                kept.push(entry);
            }
        }
        (find_gaps(&kept, &[(Kind::Visibilities, &taken)]), held)
    }

    #[test]
    fn a_gap_is_told_by_channel_and_pair() {
        // In one pair; over the ends of several; a whole pass; the first packets of all.
        for gap in [14..15, 20..22, 2..5, 18..25, 24..36, 0..2, 33..40] {
            let (found, held) = without(std::slice::from_ref(&gap));
            assert_eq!(found.gaps.len(), 1);
            let report = &found.gaps[0];
            assert_eq!((report.apid, report.from, report.to), (0x103, gap.start, gap.end - 1));
            let told: BTreeMap<_, _> = report
                .lost
                .iter()
                .map(|lost| ((lost.channel, lost.pair.clone()), lost.integration_s))
                .collect();
            assert_eq!(told, held, "{gap:?}");
        }
    }

    #[test]
    fn a_gap_of_any_length_is_told_at_once() {
        // As many whole passes as fit 2^46 packets, of 12 each, and four packets: one of each pair of channel 0, and the
        // first of channel 1, pair by pair behind the six passes that came.
        let entries = journal();
        let last = entries.len() as u64;
        let missing = ((1 << 46) - last - 5) / 12 * 12 + 4;
        let far = JournalEntry { count: last + missing, start: MissionTime::from_seconds(1e9), ..entries[0] };
        let far = JournalEntry { end: MissionTime::from_seconds(1e9 + 600.0), ..far };
        let schedule = Schedule::learn([entries, vec![far]].concat());
        let report = schedule.report(Kind::Visibilities, &(last..last + missing));
        let packets: Vec<u64> = report.lost.iter().map(|lost| lost.packets).collect();
        let passes = missing / 12;
        let [one, three] = [passes + 1, 3 * passes];
        assert_eq!(packets, [one, one, one, three + 1, three, three]);
    }

    #[test]
    fn the_gap_that_adds_most_comes_first() {
        // Three packets of channel 0, of 18 in all; two of channel 1, of 54.
        let (found, _) = without(&[15..17, 36..39]);
        assert_eq!((found.gaps[0].from, found.gaps[1].from), (36, 15));
        assert!((found.gaps[0].gain - 3.0 / 15.0).abs() < 1e-12, "{}", found.gaps[0].gain);
        assert!((found.gaps[1].gain - 2.0 / 52.0).abs() < 1e-12);
        assert_eq!(found.channels[0].missing_integration_s, 1500.0);
        assert_eq!(found.channels[1].missing_weight, 4.0);
    }

    #[test]
    fn nothing_missing_and_nothing_received() {
        assert!(without(&[]).0.gaps.is_empty());
        assert_eq!(find_gaps(&[], &[(Kind::Visibilities, &Taken::default())]), Gaps::default());
    }
}
