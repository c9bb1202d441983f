//! Finds missing packets, and estimates what they would add to the map.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::Serialize;

use super::gap_report::{GapReport, LostStream, Stream, VisibilityPacket};
use super::packet_order::{PacketStreams, SendingOrder, windows_of};
use crate::downlink::{CucTime, Era, PacketKind, ReceivedSet};
use crate::units::MissionTime;

/// The received packets, as input to [`find_gaps`].
#[derive(Clone, Debug, Default)]
pub struct ReceivedPackets {
    /// Every packet of visibilities that was decoded, in the order of sending.
    pub packets: Vec<VisibilityPacket>,
    /// Every ephemeris packet that was decoded, in the order of sending.
    pub ephemerides: Vec<EphemerisPacket>,
    /// Received sets by kind.
    pub sets: Vec<(PacketKind, ReceivedSet)>,
    /// Frequencies of the instrument's channels, Hz.
    pub frequencies_hz: Vec<f64>,
}

/// A received ephemeris packet.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EphemerisPacket {
    /// Count of the packet.
    pub count: u64,
    /// Time at which the packet was made.
    pub made: CucTime,
    /// First and last instant of the ephemeris.
    pub span: [MissionTime; 2],
}

/// A restart of the packet counts of the spacecraft.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct RestartReport {
    /// Kind of the packets.
    pub kind: PacketKind,
    /// Application process identifier.
    pub apid: u16,
    /// Count of the last packet received before the restart. Whether more were sent is unknown.
    pub last: u64,
}

/// Cross-correlations of one channel that were received.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ChannelCoverage {
    /// Channel, from 0.
    pub channel: u16,
    /// Frequency, Hz; `None` if the instrument is unknown.
    pub frequency_hz: Option<f64>,
    /// Number of packets received.
    pub packets: u64,
    /// Integration time received, s, over all pairs.
    pub integration_s: f64,
    /// Weight in the map, (K sr)^-2.
    pub weight: f64,
    /// Integration time in missing packets, s.
    pub missing_integration_s: f64,
    /// Weight in missing packets, (K sr)^-2.
    pub missing_weight: f64,
    /// Part of the received integration time whose positions are missing, s.
    pub waiting_integration_s: f64,
    /// Weight that it would have in the map, (K sr)^-2.
    pub waiting_weight: f64,
}

/// All gaps in the received packets.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Gaps {
    /// The instrument's channels, with or without data.
    pub channels: Vec<ChannelCoverage>,
    /// Gaps, with the largest gain first.
    pub gaps: Vec<GapReport>,
    /// Restarts of the packet counts of the spacecraft.
    pub restarts: Vec<RestartReport>,
}

/// Finds the packets missing between received ones, and estimates their content.
///
/// Every window is sent channel by channel and pair by pair, each in as many packets as needed. The content of a gap is modelled by
/// the packets of a nearby complete window that fits its number of packets best, from the packet before the gap to the packet after
/// it. Missing ephemeris packets count as the visibilities that wait for them. Packets after the last one received are not
/// known to be missing.
#[must_use]
pub fn find_gaps(received: &ReceivedPackets) -> Gaps {
    let mut found = Gaps::default();
    for (kind, set) in &received.sets {
        let eras = set.eras();
        for (k, era) in eras.iter().enumerate() {
            let until = eras.get(k + 1).map(|era| era.from);
            if until.is_some() {
                let (kind, apid, last) = (*kind, kind.apid(), era.end.saturating_sub(1));
                found.restarts.push(RestartReport { kind, apid, last });
            }
            let in_era = |made: CucTime| made >= era.from && until.is_none_or(|until| made < until);
            found.gaps.extend(gaps_of_era(received, *kind, era, &in_era));
        }
    }
    let mut channels = coverage(received);
    for gap in &mut found.gaps {
        let mut weights: BTreeMap<u16, f64> = BTreeMap::new();
        for lost in &gap.lost {
            let Some(coverage) = channels.get_mut(&lost.channel) else { continue };
            if gap.kind == PacketKind::Visibilities {
                coverage.missing_integration_s += lost.integration_s;
                coverage.missing_weight += lost.weight;
            }
            *weights.entry(lost.channel).or_default() += lost.weight;
        }
        for (channel, weight) in weights.into_iter().filter(|(_, weight)| *weight > 0.0) {
            let in_map = channels.get(&channel).map_or(0.0, |coverage| coverage.weight);
            gap.gain += if in_map > 0.0 { weight / in_map } else { 1.0 };
        }
        gap.gain /= channels.len().max(1) as f64;
    }
    found.gaps.sort_by(|a, b| b.gain.total_cmp(&a.gain).then((a.kind, a.from).cmp(&(b.kind, b.from))));
    found.channels = channels.into_values().collect();
    found
}

fn gaps_of_era(
    received: &ReceivedPackets,
    kind: PacketKind,
    era: &Era,
    in_era: &dyn Fn(CucTime) -> bool,
) -> Vec<GapReport> {
    if era.missing.is_empty() {
        return Vec::new();
    }
    let visibilities = received.packets.iter().filter(|packet| in_era(packet.entry.made));
    let schedule = SendingOrder::new(match kind {
        PacketKind::Visibilities => visibilities.copied().collect(),
        _ => Vec::new(),
    });
    let mut positions: Vec<EphemerisPacket> = match kind {
        PacketKind::Ephemeris => {
            received.ephemerides.iter().filter(|known| in_era(known.made)).copied().collect()
        }
        _ => Vec::new(),
    };
    positions.sort_by_key(|known| known.count);
    let report = |gap: &Range<u64>| match kind {
        PacketKind::Ephemeris => missing_ephemeris(&received.packets, &positions, &era.missing, gap),
        _ => schedule.report(kind, gap),
    };
    era.missing.iter().map(report).collect()
}

/// Sums the received visibilities by channel.
fn coverage(received: &ReceivedPackets) -> BTreeMap<u16, ChannelCoverage> {
    let frequencies = received.frequencies_hz.iter().zip(0..);
    let mut channels: BTreeMap<u16, ChannelCoverage> = frequencies
        .map(|(&hz, channel)| {
            (channel, ChannelCoverage { channel, frequency_hz: Some(hz), ..ChannelCoverage::default() })
        })
        .collect();
    let streams =
        PacketStreams::new(received.packets.iter().filter(|packet| packet.share.is_some()).copied());
    for packet in received.packets.iter().filter(|packet| !packet.is_auto()) {
        let VisibilityPacket { entry, is_waiting, share } = packet;
        let channel = entry.channel.0;
        let new = || ChannelCoverage { channel, ..ChannelCoverage::default() };
        let coverage = channels.entry(channel).or_insert_with(new);
        coverage.packets += 1;
        coverage.integration_s += entry.integration_s;
        if *is_waiting {
            coverage.waiting_integration_s += entry.integration_s;
            coverage.waiting_weight += entry.weight * streams.share(packet.stream(), entry.sent());
        } else {
            coverage.weight += entry.weight * share.unwrap_or(1.0);
        }
    }
    channels
}

/// Sums the visibilities that wait for the ephemeris in missing packets.
///
/// Several windows may lie between the ephemeris packets received before and after the gap, each with several packets. The windows of
/// the waiting visibilities, in the order of time, are assumed to have equal numbers of these packets. The visibilities of a window
/// count once, divided among its missing packets.
fn missing_ephemeris(
    packets: &[VisibilityPacket],
    positions: &[EphemerisPacket],
    missing: &[Range<u64>],
    gap: &Range<u64>,
) -> GapReport {
    let next = positions.partition_point(|known| known.count < gap.start);
    let before = next.checked_sub(1).map(|at| positions[at]);
    // The next packet may repeat an earlier one.
    let is_later = |known: &&EphemerisPacket| before.is_none_or(|before| known.span[0] > before.span[0]);
    let after = positions[next..].iter().find(is_later);
    let waits_for_gap = |packet: &&VisibilityPacket| {
        let entry = &packet.entry;
        packet.is_waiting
            && before.is_none_or(|before| entry.end > before.span[0])
            && after.is_none_or(|after| entry.start < after.span[0])
    };
    let mut waiting: Vec<&VisibilityPacket> = packets.iter().filter(waits_for_gap).collect();
    waiting.sort_by_key(|packet| packet.entry.start);
    let windows = windows_of(&waiting);
    let first = before.map_or(0, |before| before.count + 1);
    let hole = first..after.map_or(gap.end, |after| after.count).max(gap.end);
    let shares = loss_fractions(gap, missing, &hole, windows.len());
    let streams = PacketStreams::new(packets.iter().filter(|packet| packet.share.is_some()).copied());
    let mut lost: BTreeMap<Stream, LostStream> = BTreeMap::new();
    for (window, share) in windows.into_iter().zip(shares).filter(|(_, share)| *share > 0.0) {
        for packet in &waiting[window] {
            let stream = packet.stream();
            let sum = lost.entry(stream).or_insert_with(|| LostStream::empty(stream));
            sum.packets += 1;
            sum.integration_s += share * packet.entry.integration_s;
            sum.weight += share * packet.entry.weight * streams.share(stream, packet.entry.sent());
        }
    }
    let [before_s, after_s] = [before.map(|before| before.span[1]), after.map(|after| after.span[0])];
    let between_s = [before_s, after_s].map(|time| time.map(MissionTime::seconds));
    GapReport::new(PacketKind::Ephemeris, gap, between_s, lost.into_values().collect())
}

/// Fraction of the loss of each window due to a gap: the missing packets of the window in the gap, over all its missing packets.
/// `windows` divide the packets of a `hole` between received ones equally.
fn loss_fractions(gap: &Range<u64>, missing: &[Range<u64>], hole: &Range<u64>, windows: usize) -> Vec<f64> {
    let per_window = (hole.end - hole.start) as f64 / windows.max(1) as f64;
    let overlap = |packets: &Range<u64>, [from, to]: [f64; 2]| {
        let [start, end] = [packets.start, packets.end].map(|count| count as f64 - hole.start as f64);
        (end.min(to) - start.max(from)).max(0.0)
    };
    let share = |window: usize| {
        let part = [window as f64 * per_window, (window + 1) as f64 * per_window];
        let all: f64 = missing.iter().map(|packets| overlap(packets, part)).sum();
        if all > 0.0 { overlap(gap, part) / all } else { 0.0 }
    };
    (0..windows).map(share).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::CucTime;
    use crate::ground::archive::entry::JournalEntry;
    use crate::units::{ChannelId, Pair};

    const WINDOWS: u64 = 6;
    const STREAMS: u64 = 6;

    #[test]
    fn missing_positions_count_for_their_own_window_and_once() {
        // Eight packets of four windows: three lack one packet each, the last lacks both.
        let missing = [14..15, 16..17, 18..19, 20..22, 27..29];
        let fractions = |gap: usize| loss_fractions(&missing[gap], &missing, &(14..22), 4);
        assert_eq!(fractions(0), [1.0, 0.0, 0.0, 0.0]);
        assert_eq!(fractions(1), [0.0, 1.0, 0.0, 0.0]);
        assert_eq!(fractions(3), [0.0, 0.0, 0.0, 1.0]);
        // A window with two separate gaps counts once for both together.
        let separate = [0..1, 1..2];
        assert_eq!(separate.each_ref().map(|gap| loss_fractions(gap, &separate, &(0..2), 1)), [[0.5], [0.5]]);
        // A gap that fills its hole accounts for the whole loss.
        let hole = 3..8;
        let whole = std::slice::from_ref(&hole);
        assert_eq!(loss_fractions(&hole, whole, &hole, 2), [1.0, 1.0]);
        assert!(loss_fractions(&hole, whole, &hole, 0).is_empty());
    }

    /// Six windows of two channels and three pairs. Per window and pair, channel 1 sends three packets and channel 0 one.
    fn journal() -> Vec<JournalEntry> {
        let mut entries = Vec::new();
        for window in 0..WINDOWS {
            for stream in 0..STREAMS {
                let channel = (stream / 3) as u16;
                for part in 0..1 + 2 * u64::from(channel) {
                    let start_s = 9000.0 * window as f64 + 600.0 * part as f64;
                    entries.push(JournalEntry {
                        count: entries.len() as u64,
                        made: CucTime((1 + window) << 24),
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

    fn read(entry: JournalEntry) -> VisibilityPacket {
        VisibilityPacket { entry, is_waiting: false, share: Some(1.0) }
    }

    /// Gaps found if packets are left out, and the content left out by channel and pair.
    fn without(lost: &[Range<u64>]) -> (Gaps, BTreeMap<(u16, String), f64>) {
        let mut set = ReceivedSet::default();
        let mut held = BTreeMap::new();
        let mut kept = Vec::new();
        for entry in journal() {
            if lost.iter().any(|range| range.contains(&entry.count)) {
                *held.entry((entry.channel.0, entry.pair.to_string())).or_default() += entry.integration_s;
            } else {
                set.insert(entry.count, entry.made);
                kept.push(entry);
            }
        }
        let packets = kept.into_iter().map(read).collect();
        let sets = vec![(PacketKind::Visibilities, set)];
        (find_gaps(&ReceivedPackets { packets, sets, ..ReceivedPackets::default() }), held)
    }

    #[test]
    fn a_gap_is_reported_by_channel_and_pair() {
        // Within one pair; across several; a whole window; the first packets.
        for gap in [14..15, 20..22, 2..5, 18..25, 24..36, 0..2, 33..40] {
            let (found, held) = without(std::slice::from_ref(&gap));
            assert_eq!(found.gaps.len(), 1);
            let report = &found.gaps[0];
            assert_eq!((report.apid, report.from, report.to), (0x103, gap.start, gap.end - 1));
            let reported: BTreeMap<_, _> = report
                .lost
                .iter()
                .map(|lost| ((lost.channel, lost.pair.clone()), lost.integration_s))
                .collect();
            assert_eq!(reported, held, "{gap:?}");
        }
    }

    #[test]
    fn a_gap_of_any_length_is_reported_at_once() {
        // As many windows of 12 packets as fit into 2^46 packets, and four more after the six received windows: one of each
        // pair of channel 0, and the first of channel 1.
        let entries = journal();
        let last = entries.len() as u64;
        let missing = ((1 << 46) - last - 5) / 12 * 12 + 4;
        let far = JournalEntry { count: last + missing, start: MissionTime::from_seconds(1e9), ..entries[0] };
        let far = JournalEntry { end: MissionTime::from_seconds(1e9 + 600.0), ..far };
        let schedule = SendingOrder::new([entries, vec![far]].concat().into_iter().map(read).collect());
        let report = schedule.report(PacketKind::Visibilities, &(last..last + missing));
        let packets: Vec<u64> = report.lost.iter().map(|lost| lost.packets).collect();
        let windows = missing / 12;
        let [one, three] = [windows + 1, 3 * windows];
        assert_eq!(packets, [one, one, one, three + 1, three, three]);
    }

    #[test]
    fn the_gap_that_adds_most_comes_first() {
        // Three packets of channel 0, of 18 in all; two of channel 1, of 54.
        let (found, _) = without(&[15..17, 36..39]);
        assert_eq!((found.gaps[0].from, found.gaps[1].from), (36, 15));
        assert!((found.gaps[0].gain - 0.5 * 3.0 / 15.0).abs() < 1e-12, "{}", found.gaps[0].gain);
        assert!((found.gaps[1].gain - 0.5 * 2.0 / 52.0).abs() < 1e-12);
        assert_eq!(found.channels[0].missing_integration_s, 1500.0);
        assert_eq!(found.channels[1].missing_weight, 4.0);
    }

    #[test]
    fn nothing_missing_and_nothing_received() {
        assert!(without(&[]).0.gaps.is_empty());
        let sets = vec![(PacketKind::Visibilities, ReceivedSet::default())];
        assert_eq!(find_gaps(&ReceivedPackets { sets, ..ReceivedPackets::default() }), Gaps::default());
    }
}
