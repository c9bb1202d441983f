//! A small mission and its downlink.

use lunarray::downlink::{DownlinkConfig, PacketHeader, PacketKind, Transmission};
use lunarray::frames::{
    AntennaResponse, Channel, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;

/// A number of passes with two channels and two pairs, and a number of visibilities per block.
pub fn mission(passes: i64, visibilities: u32) -> Vec<GroundFrame> {
    let channel = |frequency_hz| Channel { frequency_hz, width_hz: 8e3 };
    let mut frames = vec![GroundFrame::Instrument(Instrument {
        name: "test".to_owned(),
        epoch_tai_s: 2_493_072_037.25,
        moon_radius_m: 1_737_100.0,
        satellites: 8,
        channels: vec![channel(3e6), channel(1e7)],
        response: AntennaResponse::Isotropic,
        seed: 7,
        configuration_hash: 1,
        spectrometer: None,
        noiseless: false,
    })];
    for pass in 0..passes {
        let start = MissionTime(9_000_000_000 * pass);
        frames.push(GroundFrame::Ephemeris(EphemerisSegment {
            start,
            step_ticks: 60_000_000,
            satellites: 8,
            positions_m: (0..8 * 50).map(|k| [f64::from(k), -2e6, 0.5]).collect(),
        }));
        for (channel, j) in [(0, 1), (0, 7), (1, 1), (1, 7)] {
            frames.push(GroundFrame::Visibilities(block(channel, j, start, visibilities)));
        }
        let sampled = 4 * u64::from(visibilities) * (pass as u64 + 1);
        let time = start.plus_ticks(3_000_000_000);
        frames.push(GroundFrame::Housekeeping(Housekeeping { time, sampled, dropped: 0 }));
    }
    frames
}

fn block(channel: u16, j: u8, start: MissionTime, count: u32) -> VisibilityBlock {
    VisibilityBlock {
        channel: ChannelId(channel),
        pair: Pair { i: 0, j },
        start,
        offset_ticks: (0..count).map(|k| 50_000 * k).collect(),
        duration_ticks: vec![50_000; count as usize],
        value_k_sr: (0..count).map(|k| Complex32::new((k as f32).sin(), 0.37 * k as f32)).collect(),
        weight: (0..count).map(|k| 1.0 / (1.0 + k as f32)).collect(),
        flags: vec![Flags::GOOD; count as usize],
    }
}

/// Encodes frames as bytes.
pub fn transmit(frames: &[GroundFrame], config: &DownlinkConfig) -> Vec<u8> {
    let mut transmission = Transmission::new(config).unwrap();
    let mut bytes = Vec::new();
    for frame in frames {
        transmission.send(frame, &mut bytes).unwrap();
    }
    transmission.finish(&mut bytes);
    bytes
}

/// Splits bytes into packets by their length fields.
pub fn packets_of(mut bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut packets = Vec::new();
    while let [_, _, _, _, high, low, ..] = *bytes {
        let (packet, rest) = bytes.split_at(7 + usize::from(u16::from_be_bytes([high, low])));
        packets.push(packet.to_vec());
        bytes = rest;
    }
    assert!(bytes.is_empty());
    packets
}

/// Whether each packet is the last of its pass: a report that something else than a description came before.
pub fn pass_ends(packets: &[Vec<u8>]) -> Vec<bool> {
    let mut in_pass = false;
    let mut ends = |packet: &Vec<u8>| match PacketHeader::parse(packet).unwrap().kind {
        PacketKind::Housekeeping => std::mem::take(&mut in_pass),
        PacketKind::Ephemeris | PacketKind::Visibilities => {
            in_pass = true;
            false
        }
        PacketKind::Instrument | PacketKind::Calibration => false,
    };
    packets.iter().map(&mut ends).collect()
}
