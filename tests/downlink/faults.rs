//! Reception of sound and damaged downlinks.

use std::collections::BTreeSet;

use lunarray::downlink::{
    Decoder, DownlinkConfig, DownlinkError, HEADER_BYTES, PacketHeader, PacketKind, PacketReceiver,
    Packetizer, ReceptionCounters, TRAILER_BYTES,
};
use lunarray::frames::{
    AntennaResponse, Channel, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;
use proptest::prelude::*;

fn instrument() -> Instrument {
    Instrument {
        name: "Hóngméng".to_owned(),
        epoch_tai_s: 2_493_072_037.25,
        moon_radius_m: 1_737_100.0,
        satellites: 8,
        channels: vec![
            Channel { frequency_hz: 3e6, width_hz: 8e3 },
            Channel { frequency_hz: 1e7, width_hz: 8e3 },
        ],
        response: AntennaResponse::DipoleNormal,
        seed: 7,
        configuration_hash: u64::MAX,
        spectrometer: None,
        noiseless: false,
    }
}

fn segment(start: i64) -> EphemerisSegment {
    let position = |k: usize| [k as f64 + 0.1, -2e6, f64::from_bits(0x4130_0000_0000_0001 + k as u64)];
    EphemerisSegment {
        start: MissionTime(start),
        step_ticks: 60_000_000,
        satellites: 8,
        positions_m: (0..8 * 50).map(position).collect(),
    }
}

fn block(channel: u16, j: u8, start: i64, count: u32) -> VisibilityBlock {
    VisibilityBlock {
        channel: ChannelId(channel),
        pair: Pair { i: 0, j },
        start: MissionTime(start),
        offset_ticks: (0..count).map(|k| 50_000 * k).collect(),
        duration_ticks: (0..count).map(|k| 50_000 - k % 2).collect(),
        value_k_sr: (0..count).map(|k| Complex32::new(k as f32, -1.5)).collect(),
        weight: (0..count).map(|k| 1.0 / (1.0 + k as f32)).collect(),
        flags: (0..count).map(|k| Flags(u8::from(k % 50 == 3))).collect(),
    }
}

fn frames() -> Vec<GroundFrame> {
    let mut frames = vec![GroundFrame::Instrument(instrument())];
    for window in 0..3 {
        let start = -5_000_000 + window * 9_000_000_000;
        frames.push(GroundFrame::Ephemeris(segment(start)));
        for channel in 0..2 {
            frames.push(GroundFrame::Visibilities(block(channel, 1, start, 7)));
            frames.push(GroundFrame::Visibilities(block(channel, 7, start, 1000)));
        }
        let time = MissionTime(start + 3_000_000_000);
        frames.push(GroundFrame::Housekeeping(Housekeeping { time, sampled: 2014, dropped: 3 }));
    }
    frames
}

fn encode(frames: &[GroundFrame]) -> Vec<u8> {
    let mut packetizer = Packetizer::new(&DownlinkConfig::default()).unwrap();
    let mut bytes = Vec::new();
    for frame in frames {
        packetizer.encode(frame, &mut bytes).unwrap();
    }
    bytes
}

/// The bytes of each packet, by their own length fields.
fn packets(bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut rest = bytes;
    let mut packets = Vec::new();
    while let Some(header) = PacketHeader::parse(rest) {
        let (packet, after) = rest.split_at(header.bytes);
        packets.push(packet.to_vec());
        rest = after;
    }
    assert!(rest.is_empty());
    packets
}

/// Frames and counters of bytes in chunks. The byte counters must add up.
fn receive(bytes: &[u8], chunk: usize) -> (Vec<GroundFrame>, ReceptionCounters) {
    let mut receiver = PacketReceiver::new();
    let mut decoder = Decoder::new();
    let mut frames = Vec::new();
    let mut drain = |receiver: &mut PacketReceiver| {
        while let Some(event) = receiver.next_event() {
            frames.extend(decoder.accept(&event));
        }
    };
    for part in bytes.chunks(chunk) {
        receiver.push(part);
        drain(&mut receiver);
    }
    receiver.finish();
    drain(&mut receiver);
    decoder.finish();
    let counters = decoder.counters().clone();
    let in_packets: u64 = PacketKind::ALL.iter().map(|kind| counters.kind(*kind).bytes).sum();
    let others =
        counters.bytes_garbage + counters.bytes_truncated + counters.bytes_damaged + counters.bytes_duplicate;
    assert_eq!(counters.bytes, bytes.len() as u64);
    assert_eq!(in_packets + others, counters.bytes);
    (frames, counters)
}

/// Joins blocks that were split into packets.
fn joined(frames: Vec<GroundFrame>) -> Vec<GroundFrame> {
    let mut out: Vec<GroundFrame> = Vec::new();
    for frame in frames {
        if let (GroundFrame::Visibilities(part), Some(GroundFrame::Visibilities(whole))) =
            (&frame, out.last_mut())
            && (part.channel, part.pair, part.start) == (whole.channel, whole.pair, whole.start)
        {
            whole.offset_ticks.extend(&part.offset_ticks);
            whole.duration_ticks.extend(&part.duration_ticks);
            whole.value_k_sr.extend(&part.value_k_sr);
            whole.weight.extend(&part.weight);
            whole.flags.extend(&part.flags);
        } else {
            out.push(frame);
        }
    }
    out
}

#[test]
fn a_sound_stream_returns_what_was_sent_in_any_chunks() {
    let sent = frames();
    let bytes = encode(&sent);
    for chunk in [1, 7, 1000, 8192, usize::MAX] {
        let (received, counters) = receive(&bytes, chunk);
        assert_eq!(joined(received), sent, "chunk {chunk}");
        assert_eq!(counters.visibilities_decoded, 3 * 2 * 1007);
        assert_eq!((counters.faults.total(), counters.bytes_garbage), (0, 0));
    }
}

#[test]
fn each_lost_packet_costs_its_own_visibilities_only() {
    let packets = packets(&encode(&frames()));
    let all = receive(&packets.concat(), 4096).1;
    for lost in 1..packets.len() {
        let header = PacketHeader::parse(&packets[lost]).unwrap();
        let rest: Vec<u8> =
            packets.iter().enumerate().filter(|(k, _)| *k != lost).flat_map(|(_, p)| p.clone()).collect();
        let counters = receive(&rest, 4096).1;
        let is_last = !packets[lost + 1..].iter().any(|p| p[1] == packets[lost][1]);
        let is_first = header.count == 0;
        let gap = u64::from(!is_last && !is_first);
        assert_eq!((counters.kind(header.kind).gaps, counters.kind(header.kind).missing), (gap, gap));
        let missing = all.visibilities_decoded - counters.visibilities_decoded;
        if header.kind == PacketKind::Visibilities {
            assert!(missing <= 389, "{missing}");
        } else {
            assert_eq!(missing, 0);
        }
    }
}

/// Every visibility as channel, trailing satellite, start, offset and value, which must never be wrong.
fn visibilities(frames: &[GroundFrame]) -> BTreeSet<(u16, u8, i64, u32, u32)> {
    let mut all = BTreeSet::new();
    for frame in frames {
        let GroundFrame::Visibilities(block) = frame else { continue };
        for k in 0..block.len() {
            let value = block.value_k_sr[k].re.to_bits();
            let key = (block.channel.0, block.pair.j, block.start.0, block.offset_ticks[k], value);
            assert!(all.insert(key), "twice: {key:?}");
        }
    }
    all
}

/// A packet with another payload, and matching headers and checksum.
fn forge(packet: &[u8], change: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let mut header = PacketHeader::parse(packet).unwrap();
    let mut payload = packet[HEADER_BYTES..packet.len() - TRAILER_BYTES].to_vec();
    change(&mut payload);
    header.bytes = HEADER_BYTES + payload.len() + TRAILER_BYTES;
    let mut forged = header.to_bytes().to_vec();
    forged.extend(payload);
    let check = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, &forged) as u32;
    forged.extend(check.to_be_bytes());
    forged
}

/// The packets of [`frames`], and the index of the first of each kind.
fn packets_and_first(kind: PacketKind) -> (Vec<Vec<u8>>, usize) {
    let packets = packets(&encode(&frames()));
    let first = packets.iter().position(|p| PacketHeader::parse(p).unwrap().kind == kind).unwrap();
    (packets, first)
}

#[test]
fn length_fields_beyond_all_bounds_are_refused_and_counted() {
    // Offset of the length in each record: see the payload modules.
    let huge = (1_u64 << 60).to_le_bytes();
    for (kind, at, length) in [
        (PacketKind::Instrument, 0, &huge[..]),
        (PacketKind::Ephemeris, 13, &[0xFF; 4]),
        (PacketKind::Visibilities, 12, &[0xFF; 4]),
    ] {
        let (mut packets, first) = packets_and_first(kind);
        packets[first] =
            forge(&packets[first], |payload| payload[at..at + length.len()].copy_from_slice(length));
        let (received, counters) = receive(&packets.concat(), 4096);
        assert_eq!(counters.faults.total(), 1, "{kind}");
        if kind == PacketKind::Instrument {
            assert!(received.is_empty());
            assert_eq!(counters.visibilities_before_instrument, 3 * 2 * 1007);
        } else {
            assert_eq!(received.len() + 1, receive(&encode(&frames()), 4096).0.len());
        }
    }
}

#[test]
fn bad_values_are_dropped_one_by_one() {
    let mut bad = block(0, 1, 0, 10);
    bad.value_k_sr[1].im = f32::NAN;
    bad.value_k_sr[2].re = f32::NEG_INFINITY;
    bad.weight[3] = 0.0;
    bad.weight[4] = f32::NAN;
    bad.duration_ticks[5] = 0;
    let bytes = encode(&[GroundFrame::Instrument(instrument()), GroundFrame::Visibilities(bad)]);
    let (received, counters) = receive(&bytes, 4096);
    assert_eq!((counters.visibilities_bad_value, counters.visibilities_decoded), (5, 5));
    let offsets: Vec<u32> = visibilities(&received).iter().map(|key| key.3 / 50_000).collect();
    assert_eq!(offsets, [0, 6, 7, 8, 9]);
}

#[test]
fn a_frame_that_the_ground_would_refuse_is_not_sent() {
    let mut packetizer = Packetizer::new(&DownlinkConfig::default()).unwrap();
    let mut bytes = Vec::new();
    assert!(packetizer.encode(&GroundFrame::Visibilities(block(0, 1, 0, 3)), &mut bytes).is_err());
    packetizer.encode(&GroundFrame::Instrument(instrument()), &mut bytes).unwrap();
    let length = bytes.len();
    let uneven = VisibilityBlock { weight: vec![1.0], ..block(0, 1, 0, 3) };
    let disordered = VisibilityBlock { offset_ticks: vec![3, 2, 1_000_000], ..block(0, 1, 0, 3) };
    let short = EphemerisSegment { positions_m: vec![[1.0; 3]; 8 * 7], ..segment(0) };
    let far = EphemerisSegment { positions_m: vec![[f64::NAN; 3]; 8 * 8], ..segment(0) };
    let few = EphemerisSegment { satellites: 4, ..segment(0) };
    let silent = Instrument { channels: Vec::new(), ..instrument() };
    let loud =
        Instrument { channels: vec![Channel { frequency_hz: 30.001e6, width_hz: 8e3 }], ..instrument() };
    for frame in [
        GroundFrame::Visibilities(block(2, 1, 0, 3)),
        GroundFrame::Visibilities(block(0, 8, 0, 3)),
        GroundFrame::Visibilities(block(0, 1, i64::MAX, 3)),
        GroundFrame::Visibilities(uneven),
        GroundFrame::Visibilities(disordered),
        GroundFrame::Ephemeris(short),
        GroundFrame::Ephemeris(far),
        GroundFrame::Ephemeris(few),
        GroundFrame::Ephemeris(EphemerisSegment { step_ticks: 0, ..segment(0) }),
        GroundFrame::Instrument(silent),
        GroundFrame::Instrument(loud),
        GroundFrame::Instrument(Instrument { name: "x".repeat(1000), ..instrument() }),
        GroundFrame::Instrument(Instrument { epoch_tai_s: f64::INFINITY, ..instrument() }),
        GroundFrame::Housekeeping(Housekeeping { time: MissionTime(0), sampled: 1, dropped: 2 }),
    ] {
        let error = packetizer.encode(&frame, &mut bytes);
        assert!(error.is_err(), "{frame:?}");
        assert_eq!(bytes.len(), length);
    }
    // The counters of what follows are not affected.
    packetizer.encode(&GroundFrame::Visibilities(block(0, 1, 0, 3)), &mut bytes).unwrap();
    assert_eq!(PacketHeader::parse(&bytes[length..]).unwrap().count, 0);
}

#[test]
fn what_follows_a_contradictory_instrument_is_refused() {
    let mut sent = frames();
    let other = Instrument { seed: 8, ..instrument() };
    sent.insert(3, GroundFrame::Instrument(other));
    sent.insert(5, GroundFrame::Instrument(instrument()));
    let (received, counters) = receive(&encode(&sent), 4096);
    assert_eq!((counters.instruments_contradictory, counters.payloads_foreign), (1, 3));
    assert_eq!(counters.visibilities_foreign, 1000);
    assert_eq!(counters.visibilities_decoded, 3 * 2 * 1007 - 1000);
    assert_eq!(received.iter().filter(|frame| matches!(frame, GroundFrame::Instrument(_))).count(), 1);
}

#[test]
fn reserved_kinds_and_other_versions_are_counted_and_skipped() {
    let mut packets = packets(&encode(&frames()));
    let mut header = PacketHeader::parse(&packets[0]).unwrap();
    header.kind = PacketKind::Calibration;
    let mut reserved = header.to_bytes().to_vec();
    reserved.extend(&packets[0][HEADER_BYTES..]);
    packets.insert(1, forge(&reserved, |_| ()));
    let visibilities = packets.iter().position(|p| p[1] == 3).unwrap();
    let mut header = PacketHeader::parse(&packets[visibilities]).unwrap();
    header.version += 1;
    packets[visibilities].splice(..HEADER_BYTES, header.to_bytes());
    packets[visibilities] = forge(&packets[visibilities], |_| ());
    let (_, counters) = receive(&packets.concat(), 4096);
    assert_eq!((counters.calibration.packets, counters.faults.version), (1, 1));
    assert_eq!(counters.visibilities_decoded, 3 * 2 * 1007 - 7);
}

#[test]
fn instrument_and_ephemeris_come_again_when_their_first_packets_are_lost() {
    let config = DownlinkConfig { repeat_bytes: 1 << 16, ..Default::default() };
    let mut packetizer = Packetizer::new(&config).unwrap();
    let mut bytes = Vec::new();
    packetizer.encode(&GroundFrame::Instrument(instrument()), &mut bytes).unwrap();
    packetizer.encode(&GroundFrame::Ephemeris(segment(0)), &mut bytes).unwrap();
    let lost = bytes.len();
    for k in 0..20 {
        let later = block(0, 1, k * 1_000_000_000, 1000);
        packetizer.encode(&GroundFrame::Visibilities(later), &mut bytes).unwrap();
    }
    let (received, counters) = receive(&bytes[lost..], 4096);
    assert!(received.contains(&GroundFrame::Ephemeris(segment(0))));
    // Repeats come before the first block after 64 KiB; a visibility takes 21 bytes.
    let lost = counters.visibilities_before_instrument;
    assert!(lost > 0 && 21 * (lost - 1000) < 1 << 16, "{lost}");
    assert_eq!(counters.visibilities_decoded, 20_000 - lost);
}

/// Damage to a stream whose sound packets must survive.
fn survives(bytes: &[u8], damaged_packets: u64) -> Result<ReceptionCounters, TestCaseError> {
    let sent = visibilities(&frames());
    let (received, counters) = receive(bytes, 4096);
    let found = visibilities(&received);
    prop_assert!(found.is_subset(&sent));
    // 389 visibilities fill a packet of 8192 bytes: (8192 - 26 - 16) / 21 = 388.
    let lost = (sent.len() - found.len()) as u64;
    prop_assert!(lost <= 388 * damaged_packets, "{lost} visibilities of {damaged_packets} packets");
    Ok(counters)
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]

    #[test]
    fn a_file_cut_off_anywhere_keeps_its_whole_packets(cut in 0_usize..200_000) {
        let bytes = encode(&frames());
        let cut = cut.min(bytes.len());
        let mut whole = 0;
        let mut packets = 0;
        while let Some(header) = PacketHeader::parse(&bytes[whole..]).filter(|h| whole + h.bytes <= cut) {
            whole += header.bytes;
            packets += 1;
        }
        let counters = receive(&bytes[..cut], 1000).1;
        prop_assert_eq!(counters.packets(), packets);
        prop_assert_eq!((counters.bytes_truncated, counters.bytes_garbage), ((cut - whole) as u64, 0));
    }

    #[test]
    fn flipped_bits_cost_the_packets_they_hit(flips in proptest::collection::vec(0_usize..1 << 30, 1..9)) {
        let mut bytes = encode(&frames());
        // The instrument description comes first; its loss is another test's.
        let spared = PacketHeader::parse(&bytes).unwrap().bytes;
        let bits = 8 * (bytes.len() - spared);
        for flip in &flips {
            let bit = 8 * spared + flip % bits;
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
        survives(&bytes, flips.len() as u64)?;
    }

    #[test]
    fn garbage_between_packets_costs_nothing(
        garbage in proptest::collection::vec(any::<u8>(), 1..3000),
        places in proptest::collection::btree_set(0_usize..60, 1..10),
    ) {
        let packets = packets(&encode(&frames()));
        let mut bytes = Vec::new();
        let mut inserted = 0;
        for (k, packet) in packets.iter().enumerate() {
            if places.contains(&k) {
                bytes.extend(&garbage);
                inserted += garbage.len() as u64;
            }
            bytes.extend(packet);
        }
        let counters = survives(&bytes, 0)?;
        prop_assert_eq!(counters.bytes_garbage, inserted);
    }

    #[test]
    fn a_piece_cut_out_costs_the_packets_it_touches(start in 0_usize..1 << 30, length in 1_usize..8192) {
        let mut bytes = encode(&frames());
        let spared = PacketHeader::parse(&bytes).unwrap().bytes;
        let start = spared + start % (bytes.len() - spared);
        let end = bytes.len().min(start + length);
        // A piece shorter than a packet touches few: the short blocks and housekeeping lie between long ones.
        let touched = {
            let (mut at, mut touched) = (0, 0);
            while let Some(header) = PacketHeader::parse(&bytes[at..]) {
                touched += u64::from(at < end && at + header.bytes > start);
                at += header.bytes;
            }
            touched
        };
        bytes.drain(start..end);
        survives(&bytes, touched)?;
    }

    #[test]
    fn packets_that_come_twice_or_late_are_taken_once(order in Just(()).prop_perturb(|(), mut rng| {
        let count = packets(&encode(&frames())).len();
        let mut order: Vec<usize> = (1..count).chain((1..count).step_by(3)).collect();
        for k in 0..order.len() {
            let other = (k + rng.random_range(0..12)).min(order.len() - 1);
            order.swap(k, other);
        }
        order
    })) {
        let packets = packets(&encode(&frames()));
        let mut bytes = packets[0].clone();
        for k in &order {
            bytes.extend(&packets[*k]);
        }
        let counters = survives(&bytes, 0)?;
        let duplicates: u64 = PacketKind::ALL.iter().map(|kind| counters.kind(*kind).duplicates).sum();
        prop_assert_eq!(duplicates as usize, order.len() + 1 - packets.len());
        prop_assert_eq!(counters.visibilities.missing, counters.visibilities.late);
    }

    #[test]
    fn noise_is_no_packet(noise in proptest::collection::vec(any::<u8>(), 0..70_000), chunk in 1_usize..9000) {
        let (received, counters) = receive(&noise, chunk);
        prop_assert!(received.is_empty());
        prop_assert_eq!(counters.bytes_garbage + counters.bytes_truncated, noise.len() as u64);
    }

    #[test]
    fn forged_payloads_meet_the_invariants_or_are_refused(
        which in 0_usize..60,
        changes in proptest::collection::vec((0_usize..1 << 30, any::<u8>()), 1..6),
        length in proptest::option::of(0_usize..9000),
    ) {
        let mut packets = packets(&encode(&frames()));
        let which = which % packets.len();
        packets[which] = forge(&packets[which], |payload| {
            // Most changes fall on the record, where they matter.
            for (k, (at, byte)) in changes.iter().enumerate() {
                let reach = if k == 0 { payload.len() } else { payload.len().min(64) };
                payload[at % reach] = *byte;
            }
            if let Some(length) = length {
                payload.resize(length, changes[0].1);
            }
        });
        let (received, _) = receive(&packets.concat(), 4096);
        for frame in &received {
            if let GroundFrame::Visibilities(block) = frame {
                prop_assert!(block.pair.i <= block.pair.j && block.pair.j < 8 && block.channel.0 < 2);
                prop_assert!(block.weight.iter().all(|w| *w > 0.0 && w.is_finite()));
                prop_assert!(block.value_k_sr.iter().all(|v| v.is_finite()));
                prop_assert!((1..block.len()).all(|k| block.middle_s(k - 1) < block.middle_s(k)));
            }
            // The decoded frame is valid, so it may be sent again. But packets' headers may be unable to express a
            // forged time within 136 years of the epoch.
            let mut packetizer = Packetizer::new(&DownlinkConfig::default()).unwrap();
            let mut bytes = Vec::new();
            let first = received.first().filter(|frame| matches!(frame, GroundFrame::Instrument(_)));
            packetizer.encode(first.unwrap(), &mut bytes).unwrap();
            let sent = packetizer.encode(frame, &mut bytes);
            prop_assert!(matches!(sent, Ok(()) | Err(DownlinkError::Time { .. })), "{:?}", sent);
        }
    }
}
