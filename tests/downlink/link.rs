//! The ground against the truth of a simulated link: it recovers everything recoverable, and nothing else.

use crate::common;

use std::collections::{BTreeMap, BTreeSet};

use common::downlink::{mission, packets_of, transmit};
use lunarray::downlink::link::{FrameFate, LinkConfig, LinkSimulator, LinkTruth, PacketRange};
use lunarray::downlink::receive::cadu::FrameCounters;
use lunarray::downlink::{
    Decoder, DownlinkConfig, DownlinkReceiver, Event, Format, PacketHeader, ReceptionCounters,
};
use lunarray::frames::GroundFrame;
use proptest::prelude::*;

/// A packet's APID and count.
type Name = (u16, u64);

struct Received {
    packets: Vec<Name>,
    bodies: BTreeMap<Name, Vec<u8>>,
    account: ReceptionCounters,
    frames: Option<FrameCounters>,
}

fn receive(stream: &[u8]) -> Received {
    let (mut receiver, mut decoder) = (DownlinkReceiver::new(), Decoder::new());
    let (mut packets, mut bodies) = (Vec::new(), BTreeMap::new());
    let mut drain = |receiver: &mut DownlinkReceiver| {
        while let Some(event) = receiver.next_event() {
            if let Event::Packet(packet) = &event {
                let name = (packet.header.kind.apid(), packet.header.count);
                packets.push(name);
                bodies.insert(name, packet.payload.to_vec());
            }
            decoder.accept(&event);
        }
    };
    for chunk in stream.chunks(7_000) {
        receiver.push(chunk);
        drain(&mut receiver);
    }
    receiver.finish();
    drain(&mut receiver);
    Received { packets, bodies, account: decoder.counters().clone(), frames: receiver.frames() }
}

fn config(format: Format) -> DownlinkConfig {
    DownlinkConfig { format, packet_bytes_max: 2_048, ..DownlinkConfig::default() }
}

fn damage(sound: &[u8], format: Format, link: &LinkConfig, seed: u64, chunk: usize) -> (Vec<u8>, LinkTruth) {
    let mut simulator = LinkSimulator::new(link, seed, config(format).code()).unwrap();
    let mut out = Vec::new();
    for part in sound.chunks(chunk) {
        simulator.push(part, &mut out).unwrap();
    }
    let truth = simulator.finish(&mut out).unwrap().clone();
    (out, truth)
}

fn names(ranges: &[PacketRange]) -> BTreeSet<Name> {
    ranges.iter().flat_map(|range| range.counts().map(|count| (range.apid, count))).collect()
}

/// Identities of all packets sent.
fn sent_names(frames: &[GroundFrame]) -> BTreeSet<Name> {
    let sound = transmit(frames, &config(Format::Packets));
    let header = |packet: &Vec<u8>| PacketHeader::parse(packet).unwrap();
    packets_of(&sound).iter().map(header).map(|header| (header.kind.apid(), header.count)).collect()
}

/// Receives, and compares with the truth: each packet not lost by the truth arrives once.
fn hold_to(truth: &LinkTruth, stream: &[u8], passes: i64) -> Received {
    hold_to_truth(truth, stream, &mission(passes, 1_000))
}

fn hold_to_truth(truth: &LinkTruth, stream: &[u8], frames: &[GroundFrame]) -> Received {
    let received = receive(stream);
    let found: BTreeSet<Name> = received.packets.iter().copied().collect();
    assert_eq!(found.len(), received.packets.len(), "a packet came twice");
    let lost = names(&truth.packets_lost);
    let expected: BTreeSet<Name> = sent_names(frames).difference(&lost).copied().collect();
    let wrong: Vec<&Name> = expected.symmetric_difference(&found).collect();
    assert!(wrong.is_empty(), "{wrong:?}\n{truth:?}\n{:?}", received.frames);
    received
}

const FORMATS: [Format; 2] = [Format::Packets, Format::Cadu];

#[test]
fn one_wrong_bit_in_ten_thousand_costs_no_frame() {
    let sound = transmit(&mission(8, 1_000), &config(Format::Cadu));
    let link = LinkConfig { bit_error_rate: 1e-4, ..LinkConfig::default() };
    let (stream, truth) = damage(&sound, Format::Cadu, &link, 1, 10_000);
    let received = hold_to(&truth, &stream, 8);
    let frames = received.frames.unwrap();
    assert_eq!((truth.frames_recoverable, frames.frames), (truth.frames_sent, truth.frames_sent));
    assert!(truth.bits_flipped > 500 && frames.frames_uncorrectable == 0);
    // Every wrong byte after the markers is corrected, and counted once.
    let bytes_wrong = stream.iter().zip(&sound).enumerate().filter(|(at, (a, b))| at % 1279 >= 4 && a != b);
    assert_eq!(frames.bytes_corrected, bytes_wrong.count() as u64);
}

#[test]
fn three_wrong_bits_in_a_thousand_cost_what_the_truth_says() {
    let sound = transmit(&mission(40, 1_000), &config(Format::Cadu));
    let link = LinkConfig { bit_error_rate: 3e-3, ..LinkConfig::default() };
    let (stream, truth) = damage(&sound, Format::Cadu, &link, 2, 10_000);
    let received = hold_to(&truth, &stream, 40);
    let frames = received.frames.unwrap();
    let lost: u64 = truth.frames_lost.iter().map(|range| u64::from(range.to - range.from) + 1).sum();
    // A codeword of 255 bytes has 6.1 wrong ones on average; more than 16 have a probability of 2e-4, so 1e-3 of the
    // frames have such a codeword: of 3000, three or so.
    assert!(
        (1..20).contains(&lost) && truth.frames_lost.iter().all(|range| range.fate == FrameFate::Spoilt),
        "{lost}"
    );
    assert_eq!((frames.frames, frames.frames_uncorrectable), (truth.frames_recoverable, lost));
}

#[test]
fn a_day_of_data_loses_what_the_truth_says() {
    // Eleven passes of 240,000 visibilities, 57 MB: a day of one channel at 6.6 MHz, all pairs, as the paper counts
    // 1.9e9 in 471 days at 10 MHz, in proportion to frequency.
    let day = mission(11, 60_000);
    let sound = transmit(&day, &config(Format::Cadu));
    let frames = sound.len() as u64 / 1279;
    for (bit_error_rate, losses) in [(1e-4, 0..1), (3e-3, 10..150)] {
        let link = LinkConfig { bit_error_rate, ..LinkConfig::default() };
        let (stream, truth) = damage(&sound, Format::Cadu, &link, 4, 1 << 20);
        let received = hold_to_truth(&truth, &stream, &day);
        let found = received.frames.unwrap();
        let lost: u64 = truth.frames_lost.iter().map(|range| u64::from(range.to - range.from) + 1).sum();
        // At 3e-3, 1e-3 of some 45,000 frames, as in the test above.
        assert!(frames > 40_000 && losses.contains(&lost), "{lost} of {frames}");
        assert_eq!((found.frames, found.frames_uncorrectable), (frames - lost, lost));
        if lost == 0 {
            let visibilities = 11 * 4 * 60_000;
            assert_eq!(received.account.visibilities_decoded, visibilities);
        }
    }
}

#[test]
fn plain_packets_lose_what_has_a_wrong_bit() {
    let sound = transmit(&mission(8, 1_000), &config(Format::Packets));
    let link = LinkConfig { bit_error_rate: 2e-5, ..LinkConfig::default() };
    let (stream, truth) = damage(&sound, Format::Packets, &link, 3, 10_000);
    assert!(!truth.packets_lost.is_empty());
    hold_to(&truth, &stream, 8);
}

#[test]
fn disorder_and_doubles_lose_nothing_and_add_nothing() {
    for format in FORMATS {
        let sound = transmit(&mission(6, 1_000), &config(format));
        let link = LinkConfig {
            duplicate: 0.1,
            reorder: 0.2,
            reorder_frames: 30,
            pass_swap: 0.5,
            second_station_frames: 20,
            ..LinkConfig::default()
        };
        let (stream, truth) = damage(&sound, format, &link, 4, 10_000);
        assert!(truth.copies_duplicate > 100 && truth.copies_delayed > 50 && truth.passes_swapped > 0);
        assert!(truth.packets_lost.is_empty());
        let (disordered, clean) = (hold_to(&truth, &stream, 6), receive(&sound));
        assert!(disordered.bodies == clean.bodies);
        if let Some(frames) = disordered.frames {
            let missing: u64 = frames.channels.iter().map(|counts| counts.missing - counts.late).sum();
            assert_eq!((missing, frames.fragments), (0, 0));
        }
    }
}

#[test]
fn a_second_station_makes_good_what_the_first_has_lost() {
    let sound = transmit(&mission(6, 1_000), &config(Format::Cadu));
    let link = LinkConfig { frame_loss: 0.2, second_station_frames: 1_000, ..LinkConfig::default() };
    let (stream, truth) = damage(&sound, Format::Cadu, &link, 5, 10_000);
    // Lost by both: 4 % instead of 20.
    let lost = truth.frames_sent - truth.frames_recoverable;
    assert!(lost * 100 < truth.frames_sent * 8 && lost > 0, "{lost} of {}", truth.frames_sent);
    hold_to(&truth, &stream, 6);
}

#[test]
fn the_same_seed_gives_the_same_bytes_whatever_the_chunks() {
    let link = LinkConfig {
        bit_error_rate: 1e-3,
        burst_every_bits: 1e5,
        burst_bits: 300.0,
        frame_loss: 0.1,
        duplicate: 0.1,
        reorder: 0.1,
        pass_cut: 0.3,
        pass_swap: 0.3,
        ..LinkConfig::default()
    };
    for format in FORMATS {
        let sound = transmit(&mission(4, 500), &config(format));
        let whole = damage(&sound, format, &link, 6, usize::MAX);
        assert!(whole == damage(&sound, format, &link, 6, 1_001));
        assert!(whole.0 != damage(&sound, format, &link, 7, 1_001).0);
    }
}

#[test]
fn no_fault_changes_nothing_and_a_damaged_downlink_is_refused() {
    for format in FORMATS {
        let mut sound = transmit(&mission(2, 500), &config(format));
        let (stream, truth) = damage(&sound, format, &LinkConfig::default(), 8, 999);
        assert!(
            stream == sound && truth.frames_sent == truth.frames_recoverable && truth.packets_lost.is_empty()
        );
        // In a header, by which plain packets are found too.
        let at = if format == Format::Cadu { 10 * 1279 + 500 } else { 3 };
        sound[at] ^= 1;
        let mut simulator = LinkSimulator::new(&LinkConfig::default(), 8, config(format).code()).unwrap();
        let error = simulator.push(&sound, &mut Vec::new()).unwrap_err().to_string();
        let place = if format == Format::Cadu { "byte 12790:" } else { "byte 0:" };
        assert!(error.contains(place), "{error}");
    }
}

fn any_link(slips: bool) -> impl Strategy<Value = LinkConfig> {
    let some = |most: f64| prop_oneof![Just(0.0), 0.0..most];
    let bits =
        (prop_oneof![Just(0.0), 1e-5..4e-3], prop_oneof![Just(0.0), 1e4..1e6], 1.0..30_000.0, some(0.5));
    let frames = (some(0.2), some(0.3), some(0.3), 0_u64..60, 0_u64..40);
    let passes =
        (some(0.3), some(0.3), some(0.5), if slips { some(0.05).boxed() } else { Just(0.0).boxed() });
    (bits, frames, passes).prop_map(|(bits, frames, passes)| LinkConfig {
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
        bit_slip: passes.3,
    })
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]

    #[test]
    fn any_mix_of_faults_costs_what_the_truth_says(seed in any::<u64>(), link in any_link(false), coded in any::<bool>()) {
        let format = FORMATS[usize::from(coded)];
        let sound = transmit(&mission(4, 1_000), &config(format));
        let (stream, truth) = damage(&sound, format, &link, seed, 10_000);
        let received = hold_to(&truth, &stream, 4);
        // Decoded and lost add up to sent.
        let visibilities = received.account.visibilities_decoded + received.account.visibilities_before_instrument;
        prop_assert!(visibilities <= 16_000);
    }

    #[test]
    fn slipped_bits_cost_their_frames_alone(seed in any::<u64>(), link in any_link(true)) {
        // Where a slip, a cut and a burst over the next marker coincide, a frame may be missed; nothing else.
        let sound = transmit(&mission(3, 1_000), &config(Format::Cadu));
        let (stream, truth) = damage(&sound, Format::Cadu, &link, seed, 10_000);
        let found: BTreeSet<Name> = receive(&stream).packets.into_iter().collect();
        let lost = names(&truth.packets_lost);
        prop_assert!(found.is_disjoint(&lost));
        if link.burst_every_bits == 0.0 {
            hold_to(&truth, &stream, 3);
        }
    }
}
