//! Packets of format version 1, made by other code, read back. As long as this passes, old files can be read.

use std::path::Path;

use lunarray::downlink::{Contents, DownlinkReader, Kind};
use lunarray::frames::{
    AntennaResponse, Channel, EphemerisSegment, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;

/// What `tests/python/downlink_make.py` wrote, by the same formulas.
fn sent() -> Vec<GroundFrame> {
    let channel = |frequency_hz, width_hz| Channel { frequency_hz, width_hz };
    let position =
        |node: u32, satellite: u32| [1e6 + f64::from(1000 * node + satellite), -f64::from(node), 0.5];
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
            value_k_sr: (0..4_u8).map(|k| Complex32::new(f32::from(k) + 0.25, -f32::from(k))).collect(),
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
    let visibilities = contents.packets.iter().find(|row| row.kind == Kind::Visibilities).unwrap();
    assert_eq!(visibilities.first_count, Some(3 << 14));
}
