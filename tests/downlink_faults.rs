//! What the ground makes of a downlink, sound or damaged.
#![allow(clippy::unwrap_used)] // Also in the helpers.

use lunarray::downlink::{
    Decoder, DownlinkConfig, Kind, PacketHeader, Packetizer, Receiver, ReceptionCounters,
};
use lunarray::frames::{
    AntennaResponse, Channel, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;

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

/// Frames and account of bytes that come in chunks; the account of bytes must close.
fn receive(bytes: &[u8], chunk: usize) -> (Vec<GroundFrame>, ReceptionCounters) {
    let mut receiver = Receiver::new();
    let mut decoder = Decoder::new();
    let mut frames = Vec::new();
    let mut drain = |receiver: &mut Receiver| {
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
    let in_packets: u64 = Kind::ALL.iter().map(|kind| counters.kind(*kind).bytes).sum();
    let others =
        counters.bytes_garbage + counters.bytes_truncated + counters.bytes_damaged + counters.bytes_duplicate;
    assert_eq!(counters.bytes, bytes.len() as u64);
    assert_eq!(in_packets + others, counters.bytes);
    (frames, counters)
}

/// Blocks that were one before the packets, in one again.
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
        if header.kind == Kind::Visibilities {
            assert!(missing <= 389, "{missing}");
        } else {
            assert_eq!(missing, 0);
        }
    }
}
