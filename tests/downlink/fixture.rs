//! Packets of format version 1, made by other code, read back. As long as this passes, old files can be read.

use std::path::Path;

use lunarray::downlink::{
    Contents, DownlinkConfig, DownlinkReader, HEADER_BYTES, PacketKind, Packetizer, TRAILER_BYTES,
};
use lunarray::frames::{
    AntennaResponse, Channel, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;

/// What `tests/python/downlink_make.py` wrote, by the same formulas: `0.0 - x` as Python's integers have no negative zero.
fn sent() -> Vec<GroundFrame> {
    let channel = |frequency_hz, width_hz| Channel { frequency_hz, width_hz };
    let position =
        |node: u32, satellite: u32| [1e6 + f64::from(1000 * node + satellite), 0.0 - f64::from(node), 0.5];
    vec![
        GroundFrame::Instrument(Instrument {
            name: "made elsewhere".to_owned(),
            epoch_tai_s: 2_000_000_000.5,
            moon_radius_m: 1_737_100.0,
            satellites: 3,
            channels: vec![channel(1e6, 8e3), channel(2e6, 4e3)],
            response: AntennaResponse::DipoleNormal,
            seed: 11,
            configuration_hash: 12,
            spectrometer: None,
            noiseless: false,
        }),
        GroundFrame::Ephemeris(EphemerisSegment {
            start: MissionTime(-1_000_000),
            step_ticks: 1_000_000,
            satellites: 3,
            positions_m: (0..8).flat_map(|node| (0..3).map(move |n| position(node, n))).collect(),
        }),
        GroundFrame::Visibilities(VisibilityBlock {
            channel: ChannelId(1),
            pair: Pair { i: 0, j: 2 },
            start: MissionTime(500_000),
            offset_ticks: (0..4).map(|k| 250_000 * k).collect(),
            duration_ticks: (0..4).map(|k| 200_000 + k).collect(),
            value_k_sr: (0..4_u8).map(|k| Complex32::new(f32::from(k) + 0.25, 0.0 - f32::from(k))).collect(),
            weight: vec![1.0, 2.0, 4.0, 8.0],
            flags: vec![Flags::GOOD, Flags::INTERFERENCE, Flags::INCOMPLETE, Flags::GOOD],
        }),
        GroundFrame::Housekeeping(Housekeeping { time: MissionTime(2_000_000), sampled: 5, dropped: 1 }),
    ]
}

#[test]
fn version_1_is_read() {
    let path = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/fixtures/downlink_v1.ccsds"));
    let mut reader = DownlinkReader::open(path).unwrap();
    let mut received = Vec::new();
    while let Some(frame) = reader.next_frame().unwrap() {
        received.push(frame);
    }
    assert_eq!(received, sent());
    let counters = reader.counters();
    assert_eq!((counters.packets(), counters.calibration.packets), (6, 1));
    let contents = Contents::read(path).unwrap();
    assert!(contents.is_sound());
    // The file begins in the middle of a mission: counts do not start at 0.
    let visibilities = contents.packets.iter().find(|row| row.kind == PacketKind::Visibilities).unwrap();
    assert_eq!(visibilities.first_count, Some(3 << 14));
}

const FILE: &[u8] = include_bytes!("../../fixtures/downlink_v1.ccsds");

/// The packets of a stream, by the lengths in their primary headers, with their APIDs.
fn packets(mut bytes: &[u8]) -> Vec<(u16, &[u8])> {
    let mut found = Vec::new();
    while !bytes.is_empty() {
        let length = usize::from(u16::from_be_bytes([bytes[4], bytes[5]])) + 7;
        let (packet, rest) = bytes.split_at(length);
        found.push((u16::from_be_bytes([packet[0], packet[1]]) & 0x7FF, packet));
        bytes = rest;
    }
    found
}

/// The payload of an APID, segments put together.
fn payload(packets: &[(u16, &[u8])], apid: u16) -> Vec<u8> {
    let of_kind = packets.iter().filter(|(of, _)| *of == apid);
    of_kind.flat_map(|(_, packet)| &packet[HEADER_BYTES..packet.len() - TRAILER_BYTES]).copied().collect()
}

#[test]
fn what_is_written_has_the_bytes_that_other_code_made() {
    let mut packetizer = Packetizer::new(&DownlinkConfig::default()).unwrap();
    let mut written = Vec::new();
    for frame in sent() {
        packetizer.encode(&frame, &mut written).unwrap();
    }
    let (written, made) = (packets(&written), packets(FILE));
    for apid in [0x101, 0x102, 0x103, 0x105] {
        assert_eq!(payload(&written, apid), payload(&made, apid), "{apid:#x}");
        assert!(!payload(&made, apid).is_empty());
    }
    // Headers differ in the counts alone, with which the file begins late, and in the ephemeris, which it has in two segments: the
    // instrument's is the first of its kind in both.
    assert_eq!(written[0].1, made[0].1);
}

#[test]
fn the_page_on_the_format_shows_these_bytes() {
    let page = include_str!("../../docs/packets.md");
    let made = packets(FILE);
    let mut shown = 0;
    for block in page.split("```text\n").skip(1) {
        let lines: Vec<&str> = block.split("```").next().unwrap().lines().collect();
        let is_cut = lines.last() == Some(&"...");
        // Bytes come before column 48, what they are after it.
        let hex = lines.iter().filter(|line| **line != "...").flat_map(|line| {
            line.get(..48)
                .unwrap_or(line)
                .split_whitespace()
                .map(|byte| u8::from_str_radix(byte, 16).unwrap())
        });
        let bytes: Vec<u8> = hex.collect();
        // It fails here if no packet of the file begins so.
        let (apid, packet) = made.iter().find(|(_, packet)| packet.starts_with(&bytes)).unwrap();
        assert!(is_cut || packet.len() == bytes.len(), "{apid:#x}");
        assert!(bytes.len() > HEADER_BYTES && page.contains(&format!("APID {apid:#x}")));
        shown += 1;
    }
    assert_eq!(shown, 4, "one of each kind");
}
