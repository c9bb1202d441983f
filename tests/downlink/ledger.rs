//! The whole chain, with the onboard store, over links with any mix of faults: nothing is summed twice, and every
//! visibility is accounted for, on the ground and in the link's truth.
//!
//! A few dozen cases; set `PROPTEST_CASES` for more.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};

use lunarray::array::{Array, ArrayConfig, ObservingWindows, segments_for};
use lunarray::calibration::{CalibrationConfig, Calibrator, Completeness, MissingPackets};
use lunarray::downlink::link::{LinkConfig, LinkSimulator, LinkTruth, PacketRange};
use lunarray::downlink::wire::cadu::INTERLEAVES;
use lunarray::downlink::{
    CucTime, Decoder, DownlinkConfig, DownlinkReceiver, Event, FORMAT_VERSION, Format, HEADER_BYTES,
    PacketHeader, PacketKind, PacketSegment, ReceptionCounters, Transmission,
};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, ObservingWindow, PlacedFrame,
    VisibilityBlock, VisibilityReason,
};
use lunarray::ground::{Collector, Delivery, Ground, GroundConfig, Reception};
use lunarray::imaging::{Accumulator, MapConfig};
use lunarray::mother::{PacedLink, SpacecraftConfig, Store, StoreDrop};
use lunarray::runtime::{Ledger, LedgerReport, Outlet, Stage};
use lunarray::units::{ChannelId, MissionTime, all_pairs};
use num_complex::Complex32;
use proptest::prelude::*;

const WINDOWS: usize = 5;
const SATELLITES: usize = 4;
/// Visibilities of a channel and pair in a window.
const INTEGRATIONS: u32 = 30;
const BLOCKS: usize = 2 * 6;
const SAMPLED: u64 = WINDOWS as u64 * BLOCKS as u64 * INTEGRATIONS as u64;

static ARRAY: LazyLock<Arc<Array>> = LazyLock::new(|| {
    Arc::new(Array::new(&ArrayConfig { satellites: SATELLITES, ..ArrayConfig::default() }).unwrap())
});

/// The mother's output: every visibility has its number as value, and positions that the map can use.
static FRAMES: LazyLock<Vec<GroundFrame>> = LazyLock::new(|| {
    let channel = |frequency_hz| Channel { frequency_hz, width_hz: 8e3 };
    let instrument = Instrument {
        name: "test".to_owned(),
        epoch_tai_s: 2_493_072_037.25,
        moon_radius_m: ARRAY.moon_radius_m(),
        satellites: SATELLITES as u8,
        channels: vec![channel(3e6), channel(1e7)],
        response: AntennaResponse::Isotropic,
        seed: 7,
        configuration_hash: 1,
        spectrometer: None,
        noiseless: false,
    };
    let mut frames = Vec::new();
    let mut sampled = 0;
    for window in ObservingWindows::new(&ARRAY, 0.0, 1e6).take(WINDOWS) {
        frames.push(GroundFrame::Instrument(instrument.clone()));
        let segments = segments_for(&ARRAY, window.start, window.end, 300.0);
        frames.extend(segments.into_iter().map(GroundFrame::Ephemeris));
        for channel in 0..2 {
            for pair in all_pairs(SATELLITES) {
                let mut block = block(window, sampled);
                (block.channel, block.pair) = (ChannelId(channel), pair);
                sampled += u64::from(INTEGRATIONS);
                frames.push(GroundFrame::Visibilities(block));
            }
        }
        let time = window.end;
        frames.push(GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 }));
    }
    assert_eq!(sampled, SAMPLED);
    frames
});

/// Of pairs of other lengths too: longer ones have shorter integrations, as the adaptive rule has it.
fn block(window: ObservingWindow, first: u64) -> VisibilityBlock {
    let length = 5_000_000 + 1_000_000 * (first / u64::from(INTEGRATIONS) % 7) as u32;
    VisibilityBlock {
        start: window.start,
        offset_ticks: (0..INTEGRATIONS).map(|k| length * k).collect(),
        duration_ticks: vec![length; INTEGRATIONS as usize],
        // Integers below 2^24 are exact in single precision.
        value_k_sr: (0..INTEGRATIONS).map(|k| Complex32::new((first + u64::from(k)) as f32, 0.0)).collect(),
        weight: vec![1e-7 * length as f32; INTEGRATIONS as usize],
        flags: (0..INTEGRATIONS).map(|k| Flags(u8::from(k % 20 == 3))).collect(),
        ..VisibilityBlock::default()
    }
}

/// Configuration of the spacecraft and the link.
#[derive(Clone, Debug)]
struct Case {
    seed: u64,
    downlink: DownlinkConfig,
    spacecraft: SpacecraftConfig,
}

/// What was sent, what arrived, and the truth.
struct Sent {
    sound: Vec<u8>,
    arrived: Vec<u8>,
    truth: LinkTruth,
}

fn send(case: &Case) -> Sent {
    let paced = |bytes_per_s| PacedLink { array: Arc::clone(&ARRAY), bytes_per_s };
    let mut store = Store::new(&case.spacecraft, case.downlink.payload_bytes_per_s().map(paced));
    let mut frames = Outlet::collect();
    for frame in FRAMES.iter() {
        store.step(frame.clone(), &mut frames).unwrap();
    }
    store.finish(&mut frames).unwrap();
    let mut transmission = Transmission::new(&case.downlink).unwrap();
    let mut sound = Vec::new();
    for frame in frames.items() {
        transmission.send(frame, &mut sound).unwrap();
    }
    transmission.finish(&mut sound);
    let mut link = LinkSimulator::new(&case.downlink.link, case.seed, case.downlink.code()).unwrap();
    let mut arrived = Vec::new();
    for part in sound.chunks(9_000) {
        link.push(part, &mut arrived).unwrap();
    }
    let truth = link.finish(&mut arrived).unwrap().clone();
    Sent { sound, arrived, truth }
}

/// The numbers of a block's visibilities.
fn numbers(block: &VisibilityBlock) -> Vec<u64> {
    block.value_k_sr.iter().map(|value| value.re as u64).collect()
}

/// The numbers of the visibilities in each packet, by its count.
fn visibilities_by_packet(sound: &[u8]) -> BTreeMap<u64, Vec<u64>> {
    let (mut receiver, mut decoder, mut found) = (DownlinkReceiver::new(), Decoder::new(), BTreeMap::new());
    receiver.push(sound);
    receiver.finish();
    while let Some(event) = receiver.next_event() {
        let header = if let Event::Packet(packet) = &event { Some(packet.header) } else { None };
        if let Some(GroundFrame::Visibilities(block)) = decoder.accept(&event) {
            found.insert(header.unwrap().count, numbers(&block));
        }
    }
    found
}

/// The ground's result.
struct Received {
    ledger: LedgerReport<VisibilityReason>,
    reception: ReceptionCounters,
    completeness: Completeness,
    /// Numbers of the accumulated visibilities, in order.
    summed: Vec<u64>,
}

fn receive(arrived: &[u8]) -> Received {
    let account = Arc::new(Mutex::new(ReceptionCounters::default()));
    // The hold buffer never fills.
    let mut reception = Reception::new(1 << 24, 1024, Arc::clone(&account));
    let mut frames = Outlet::collect();
    for part in arrived.chunks(7_000) {
        reception.step(part.to_vec(), &mut frames).unwrap();
    }
    reception.finish(&mut frames).unwrap();
    let ledger = Ledger::new();
    let hook = CalibrationConfig::default().build(std::path::Path::new("")).unwrap();
    let mut calibrator = Calibrator::new(hook, ledger.clone());
    let mut placed = Outlet::collect();
    for frame in frames.into_vec() {
        calibrator.step(frame, &mut placed).unwrap();
    }
    let completeness = calibrator.post_losses(MissingPackets::default());
    // All baselines and weights: what is placed is summed.
    let map = MapConfig { nside: 1, baseline_bp_max: 1e6, weight_max: 1e3, ..MapConfig::default() };
    let mut accumulator = Accumulator::new(map, ledger.clone());
    let (mut summed, mut maps) = (Vec::new(), Outlet::collect());
    for frame in placed.into_vec() {
        if let PlacedFrame::Visibilities(block) = &frame {
            summed.extend(block.value_k_sr.iter().map(|value| value.re as u64));
        }
        accumulator.step(frame, &mut maps).unwrap();
    }
    accumulator.finish(&mut maps).unwrap();
    let ledger = ledger.balanced_report().unwrap();
    let reception = account.lock().unwrap_or_else(PoisonError::into_inner).clone();
    Received { ledger, reception, completeness, summed }
}

fn counts_of(ranges: &[PacketRange], kind: PacketKind) -> BTreeSet<u64> {
    ranges.iter().filter(|range| range.apid == kind.apid()).flat_map(PacketRange::counts).collect()
}

/// Compares a ground without a state with the truth.
fn hold_to_the_truth(sent: &Sent) {
    let Sent { sound, arrived, truth } = sent;
    let by_packet = visibilities_by_packet(sound);
    let packets_lost = counts_of(&truth.packets_lost, PacketKind::Visibilities);
    let all_sent: BTreeSet<u64> = by_packet.values().flatten().copied().collect();
    let of_lost = |count: &u64| by_packet[count].iter().copied();
    let lost_on_link: BTreeSet<u64> = packets_lost.iter().flat_map(of_lost).collect();
    // On the spacecraft, what is not sent has been dropped and counted.
    assert_eq!(truth.visibilities_sampled, SAMPLED);
    assert_eq!(truth.visibilities_sent, all_sent.len() as u64);
    assert_eq!(truth.visibilities_sent + truth.visibilities_dropped, SAMPLED);
    assert_eq!(truth.visibilities_lost, lost_on_link.len() as u64);

    let received = receive(arrived);
    let (ledger, reception) = (&received.ledger, &received.reception);
    let summed: BTreeSet<u64> = received.summed.iter().copied().collect();
    assert_eq!(summed.len(), received.summed.len(), "a visibility was summed twice");
    assert_eq!(ledger.accumulated, summed.len() as u64);
    // Visibilities that were recovered but not accumulated are flagged, unless nothing could be decoded.
    let unread = reception.visibilities_before_instrument;
    assert!(unread == 0 || reception.instrument.packets == 0);
    let recovered = &all_sent - &lost_on_link;
    assert!(summed.is_subset(&recovered));
    let flagged = ledger.flagged_total() as u64;
    assert_eq!(ledger.accumulated + flagged + unread, recovered.len() as u64, "{ledger:?}");
    // Each for its reason: every twentieth has a flag, others no positions.
    let without_ephemeris = ledger.count(VisibilityReason::NoEphemeris);
    assert_eq!(flagged, ledger.count(VisibilityReason::Interference) + without_ephemeris);
    if unread == 0 && without_ephemeris == 0 {
        let good: BTreeSet<u64> =
            recovered.iter().copied().filter(|number| number % u64::from(INTEGRATIONS) % 20 != 3).collect();
        assert_eq!(summed, good);
    }
    // Losses by the ground's count, as far as the last housekeeping received reports them.
    // Two in each pass, and the last pass may have both.
    let reports_lost = counts_of(&truth.packets_lost, PacketKind::Housekeeping);
    let last_reports = [2 * WINDOWS as u64 - 2, 2 * WINDOWS as u64 - 1];
    let last_report_came = !last_reports.iter().all(|report| reports_lost.contains(report));
    assert_eq!(received.completeness.complete, last_report_came && reception.instrument.packets > 0);
    if received.completeness.complete {
        assert_eq!(ledger.sampled, SAMPLED);
        assert_eq!(ledger.count(VisibilityReason::StoreFull), truth.visibilities_dropped);
        assert_eq!(ledger.count(VisibilityReason::NotReceived), truth.visibilities_lost);
    }
    assert!(ledger.count(VisibilityReason::StoreFull) <= truth.visibilities_dropped);
    assert!(ledger.sampled <= SAMPLED);
}

/// Compares a ground with a state with the truth: packets by number.
fn hold_the_collector_to_the_truth(sent: &Sent) {
    let by_packet = visibilities_by_packet(&sent.sound);
    let mut collector = Collector::new(20_000);
    let mut frames = Vec::new();
    for part in sent.arrived.chunks(5_000) {
        collector.push(part);
        while let Some(frame) = collector.next_delivery(&|_| true).unwrap() {
            frames.push(frame);
        }
    }
    collector.finish();
    while let Some(frame) = collector.next_delivery(&|_| true).unwrap() {
        frames.push(frame);
    }
    while let Some(frame) = collector.flush_next() {
        frames.push(frame);
    }
    let mut seen = BTreeSet::new();
    for Delivery { packets, frame } in &frames {
        if let Some(GroundFrame::Visibilities(block)) = frame {
            assert_eq!(numbers(block), by_packet[&packets[0].header.count]);
            assert!(numbers(block).into_iter().all(|number| seen.insert(number)), "taken twice");
        }
    }
    if !frames.iter().any(|found| matches!(found.frame, Some(GroundFrame::Instrument(_)))) {
        return; // Nothing could be read.
    }
    for (kind, received) in collector.received().filter(|(_, received)| !received.is_empty()) {
        let missing: BTreeSet<u64> =
            received.eras().into_iter().flat_map(|era| era.missing).flatten().collect();
        let mut expected = counts_of(&sent.truth.packets_lost, kind);
        // Nothing is known after the last packet received.
        let end = received.len() + missing.len() as u64;
        expected.retain(|count| *count < end);
        assert_eq!(missing, expected, "{kind}");
    }
}

fn any_case() -> impl Strategy<Value = Case> {
    let some = |most: f64| prop_oneof![Just(0.0), 0.0..most];
    let bits =
        (prop_oneof![Just(0.0), 1e-6..4e-3], prop_oneof![Just(0.0), 1e4..1e6], 1.0..30_000.0, some(0.5));
    let frames = (some(0.2), some(0.3), some(0.3), 0_u64..60, 0_u64..40);
    let passes = (some(0.3), some(0.3), some(0.5), some(0.05));
    // A window's visibilities are 7.5 kB and its positions 2 kB, and the Earth is in sight for 5500 s.
    let onboard = (
        prop_oneof![Just(0_u64), 500_u64..40_000],
        prop_oneof![Just(StoreDrop::Newest), Just(StoreDrop::Oldest), Just(StoreDrop::LowestValue)],
        prop_oneof![Just(0.0), 1.0..40.0_f64],
    );
    let format = (any::<bool>(), proptest::sample::select(&INTERLEAVES), 256_usize..3_000, 1_u32..3);
    (any::<u64>(), bits, frames, passes, onboard, format).prop_map(
        |(seed, bits, frames, passes, onboard, (coded, interleave, packet_bytes_max, idle_frames))| {
            let link = LinkConfig {
                bit_error_rate: bits.0,
                burst_every_bits: bits.1,
                burst_bits: bits.2,
                burst_bit_error_rate: bits.3,
                frame_loss: frames.0,
                duplicate: frames.1,
                reorder: frames.2,
                reorder_frames: frames.3,
                second_station_frames: frames.4,
                pass_loss: passes.0,
                pass_cut: passes.1,
                pass_swap: passes.2,
                bit_slip: if coded { passes.3 } else { 0.0 },
            };
            let downlink = DownlinkConfig {
                format: if coded { Format::Cadu } else { Format::Packets },
                packet_bytes_max,
                interleave,
                idle_frames,
                rate_bits_per_s_max: onboard.2,
                link,
                ..DownlinkConfig::default()
            };
            let store_bytes_max = if onboard.0 == 0 { u64::MAX } else { onboard.0 };
            let spacecraft =
                SpacecraftConfig { store_bytes_max, store_drop: onboard.1, ..SpacecraftConfig::default() };
            Case { seed, downlink, spacecraft }
        },
    )
}

fn cases() -> u32 {
    std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(48)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(cases()) })]

    #[test]
    fn every_visibility_is_accounted_for_whatever_goes_wrong(case in any_case()) {
        let sent = send(&case);
        prop_assert_eq!(&case.downlink.link, &sent.truth.link);
        hold_to_the_truth(&sent);
        hold_the_collector_to_the_truth(&sent);
    }
}

/// A link that is too slow for the store before it.
fn crowded(drop: StoreDrop) -> Case {
    let downlink =
        DownlinkConfig { rate_bits_per_s_max: 9.0, packet_bytes_max: 512, ..DownlinkConfig::default() };
    let spacecraft =
        SpacecraftConfig { store_bytes_max: 9_000, store_drop: drop, ..SpacecraftConfig::default() };
    Case { seed: 1, downlink, spacecraft }
}

#[test]
fn a_slow_link_and_a_small_store_lose_what_the_policy_says() {
    let mut integrations_s = Vec::new();
    for drop in [StoreDrop::Newest, StoreDrop::Oldest, StoreDrop::LowestValue] {
        let sent = send(&crowded(drop));
        assert!(sent.truth.visibilities_dropped > SAMPLED / 10, "{:?}", sent.truth);
        assert!(sent.truth.visibilities_lost == 0 && sent.arrived == sent.sound);
        hold_to_the_truth(&sent);
        hold_the_collector_to_the_truth(&sent);
        let numbers: Vec<u64> = visibilities_by_packet(&sent.sound).into_values().flatten().collect();
        let length_s = |number: &u64| 5.0 + (number / u64::from(INTEGRATIONS) % 7) as f64;
        integrations_s.push(numbers.iter().map(length_s).sum::<f64>());
        // Of the last window the newest are dropped, of the first the oldest.
        let (first, last) = (numbers.contains(&0), numbers.contains(&(SAMPLED - 1)));
        match drop {
            StoreDrop::Newest => assert!(first && !last),
            StoreDrop::Oldest => assert!(last),
            StoreDrop::LowestValue => {}
        }
    }
    // As many bytes hold more integration time where the least worthy are dropped.
    assert!(integrations_s[2] > integrations_s[0].max(integrations_s[1]), "{integrations_s:?}");
}

/// What a whole ground makes of what arrived: its ledger, and whether it claims to be complete.
fn ground_of(arrived: &[u8]) -> (LedgerReport<VisibilityReason>, Completeness) {
    let map = MapConfig { nside: 1, baseline_bp_max: 1e6, weight_max: 1e3, ..MapConfig::default() };
    let (calibration, wait_bytes) = (CalibrationConfig::default(), 1 << 24);
    let config = GroundConfig {
        calibration,
        calibrate: Default::default(),
        map,
        wait_bytes,
        memory_max_bytes: None,
        group: None,
        part: None,
    };
    let mut ground = Ground::new(&config).unwrap();
    let outcome = ground.outcome();
    let mut maps = Outlet::collect();
    for part in arrived.chunks(7_000) {
        ground.step(part.to_vec(), &mut maps).unwrap();
    }
    ground.finish(&mut maps).unwrap();
    let completeness = outcome.completeness.lock().unwrap_or_else(PoisonError::into_inner).clone();
    (outcome.ledger.balanced_report().unwrap(), completeness)
}

/// Passes and frames that do not arrive, of each of which a ground may notice nothing.
fn lossy_links() -> Vec<LinkConfig> {
    let none = LinkConfig::default();
    vec![
        LinkConfig { pass_cut: 1.0, ..none.clone() },
        LinkConfig { pass_cut: 0.4, ..none.clone() },
        LinkConfig { pass_loss: 0.4, ..none.clone() },
        LinkConfig { frame_loss: 0.3, ..none.clone() },
        LinkConfig { frame_loss: 0.9, ..none.clone() },
        LinkConfig { pass_cut: 0.5, pass_loss: 0.2, pass_swap: 0.3, frame_loss: 0.05, ..none.clone() },
        LinkConfig { burst_every_bits: 1e5, burst_bits: 10_000.0, ..none },
    ]
}

#[test]
fn a_ledger_never_claims_to_be_complete_while_something_is_missing() {
    let spacecraft = SpacecraftConfig::default();
    let [mut complete, mut incomplete, mut lost] = [0; 3];
    for (coded, link, seed) in [false, true].into_iter().flat_map(|coded| {
        let links = lossy_links().into_iter();
        links.flat_map(move |link| (0..6).map(move |seed| (coded, link.clone(), seed)))
    }) {
        let format = if coded { Format::Cadu } else { Format::Packets };
        let downlink = DownlinkConfig { format, packet_bytes_max: 400, link, ..DownlinkConfig::default() };
        let sent = send(&Case { seed, downlink, spacecraft: spacecraft.clone() });
        let (ledger, completeness) = ground_of(&sent.arrived);
        let told = ledger.count(VisibilityReason::NotReceived);
        let at_least = ledger.count(VisibilityReason::NotReceivedAtLeast);
        let truth = &sent.truth;
        let what = format!("{format:?} {:?} {seed}: {ledger:?} {completeness:?} {truth:?}", truth.link);
        assert!(told + at_least <= truth.visibilities_lost && ledger.sampled <= SAMPLED, "{what}");
        if completeness.complete {
            assert_eq!((ledger.sampled, told, at_least), (SAMPLED, truth.visibilities_lost, 0), "{what}");
        }
        // Known gaps are told in either case.
        let sets = visibility_gaps(&sent.arrived);
        assert!(told + at_least >= sets || ledger.sampled == 0, "{sets} {what}");
        complete += i32::from(completeness.complete);
        incomplete += i32::from(!completeness.complete);
        lost += i32::from(truth.visibilities_lost > 0);
    }
    // Of 84 links nearly all lose something, and either answer is common enough to be tested.
    assert!(complete >= 8 && incomplete >= 8 && lost > 60, "{complete} {incomplete} {lost}");
}

/// Packets of visibilities that are missing between those that arrived.
fn visibility_gaps(arrived: &[u8]) -> u64 {
    let mut collector = Collector::new(1 << 24);
    collector.push(arrived);
    collector.finish();
    while collector.next_delivery(&|_| true).unwrap().is_some() {}
    collector.counters().visibilities.missing
}

#[test]
fn a_mission_of_which_every_pass_is_cut_short_still_tells_what_is_missing() {
    let link = LinkConfig { pass_cut: 1.0, ..LinkConfig::default() };
    let downlink = DownlinkConfig { packet_bytes_max: 400, link, ..DownlinkConfig::default() };
    let spacecraft = SpacecraftConfig::default();
    let mut exact = 0;
    for seed in 0..10 {
        let case = Case { seed, downlink: downlink.clone(), spacecraft: spacecraft.clone() };
        let sent = send(&case);
        // No pass has its closing report, but most have the one that begins them.
        let (ledger, completeness) = ground_of(&sent.arrived);
        if completeness.complete {
            exact += 1;
            assert_eq!(ledger.sampled, SAMPLED);
            assert_eq!(ledger.count(VisibilityReason::NotReceived), sent.truth.visibilities_lost);
            assert!(sent.truth.visibilities_lost > 0);
        }
    }
    assert!(exact >= 5, "{exact}");
}

/// A sound packet of visibilities with no payload.
fn forged(count: u64, s: u64) -> Vec<u8> {
    let (kind, segment, version) = (PacketKind::Visibilities, PacketSegment::Whole, FORMAT_VERSION);
    let header =
        PacketHeader { kind, segment, count, time: CucTime(s << 24), version, bytes: HEADER_BYTES + 4 };
    let mut packet = header.to_bytes().to_vec();
    let check = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, &packet) as u32;
    packet.extend(check.to_be_bytes());
    packet
}

/// Packets of one time and consecutive counts are one interval, but a state has a record of each.
#[test]
fn forged_packets_of_one_time_are_refused_beyond_a_number() {
    const ROOM: u64 = 100;
    let mut collector = Collector::new(1 << 20).with_packets_max(ROOM);
    let all: Vec<u8> = (0..3 * ROOM).flat_map(|k| forged(k, 5)).collect();
    for [beyond, duplicates] in [[2 * ROOM, 0], [4 * ROOM, ROOM]] {
        collector.push(&all);
        while collector.next_delivery(&|_| true).unwrap().is_some() {}
        let counters = collector.counters();
        assert_eq!([counters.packets_beyond, counters.visibilities.duplicates], [beyond, duplicates]);
        assert_eq!(collector.received().map(|(_, set)| set.len()).sum::<u64>(), ROOM);
    }
}

/// Packets that were dropped for want of space may come again: they are not counted as received.
#[test]
fn packets_that_were_dropped_before_the_instrument_are_not_received() {
    // More than the 64 MiB that are held before an instrument's description, at some 200 bytes of memory each.
    const PACKETS: u64 = 600_000;
    let mut collector = Collector::new(1 << 20);
    for first in (0..PACKETS).step_by(1000) {
        let some: Vec<u8> = (first..first + 1000).flat_map(|k| forged(k, 5)).collect();
        collector.push(&some);
        while collector.next_delivery(&|_| true).unwrap().is_some() {}
    }
    let received = collector.received().map(|(_, set)| set.len()).sum::<u64>();
    assert!(0 < received && received < PACKETS, "none were dropped, or all");
    assert_eq!(collector.packets(), received);
}

#[test]
fn forged_packet_times_fill_a_bounded_set_and_are_then_refused() {
    const ROOM: usize = 100;
    let mut collector = Collector::new(1 << 20).with_intervals_max(ROOM);
    let mut push = |packets: Vec<u8>| {
        collector.push(&packets);
        while collector.next_delivery(&|_| true).unwrap().is_some() {}
        let counters = collector.counters();
        let [beyond, duplicates] = [counters.packets_beyond, counters.visibilities.duplicates];
        (
            collector.received().map(|(_, set)| set.len()).sum::<u64>(),
            beyond,
            duplicates,
            counters.bytes_beyond,
        )
    };
    let bytes = (HEADER_BYTES + 4) as u64;
    let all: Vec<u8> = (0..3 * ROOM as u64).flat_map(|k| forged(2 * k, k)).collect();
    assert_eq!(push(all.clone()), (100, 200, 0, 200 * bytes));
    // What was received before is known; what goes on from it is taken.
    assert_eq!(push(all), (100, 400, 100, 400 * bytes));
    assert_eq!(push(forged(7, 3)), (101, 400, 100, 400 * bytes));
}

#[test]
fn a_forged_report_neither_poisons_the_ledger_nor_the_state() {
    let spacecraft = SpacecraftConfig::default();
    let downlink = DownlinkConfig { packet_bytes_max: 400, ..DownlinkConfig::default() };
    let sent = send(&Case { seed: 1, downlink: downlink.clone(), spacecraft });
    let (sound, _) = ground_of(&sent.arrived);
    // As the spacecraft would send it, from a transmission of its own; counts that the payload allows and does not.
    let report = |time: MissionTime, sampled: u64| {
        let mut bytes = Vec::new();
        let mut transmission = Transmission::new(&downlink).unwrap();
        for frame in FRAMES.iter().take(2) {
            transmission.send(frame, &mut bytes).unwrap();
        }
        let before = bytes.len();
        let frame = GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 });
        transmission.send(&frame, &mut bytes).unwrap();
        bytes.split_off(before)
    };
    let huge = report(MissionTime(5), 1 << 48);
    // 2^64 - 1 sampled and dropped: refused as a payload.
    let mut impossible = report(MissionTime(5), 0);
    let end = impossible.len() - 4;
    impossible[end - 16..end].fill(0xFF);
    let check = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, &impossible[..end]) as u32;
    impossible[end..].copy_from_slice(&check.to_be_bytes());
    for (forged, contradictory) in [(huge, 1), (impossible, 0)] {
        for bytes in [[&forged[..], &sent.arrived].concat(), [&sent.arrived[..], &forged].concat()] {
            let (ledger, completeness) = ground_of(&bytes);
            assert_eq!(ledger, sound);
            assert_eq!((completeness.complete, completeness.reports_contradictory), (true, contradictory));
        }
        // With nothing else the ledger closes, and claims nothing.
        let (_, completeness) = ground_of(&forged);
        assert!(!completeness.complete);
    }
}
