//! Independent CCSDS decoders read the packets.

use crate::common;

use std::process::Command;

use lunarray::array::{Array, ArrayConfig, segments_for};
use lunarray::downlink::{DownlinkConfig, DownlinkWriter};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;
use serde_json::{Value, json};

fn instrument() -> Instrument {
    Instrument {
        name: "Hóngméng".to_owned(),
        epoch_tai_s: 2_493_072_037.25,
        moon_radius_m: 1_737_100.0,
        satellites: 8,
        channels: (1..=30).map(|k| Channel { frequency_hz: 1e6 * f64::from(k), width_hz: 8e3 }).collect(),
        response: AntennaResponse::Isotropic,
        seed: 7,
        configuration_hash: u64::MAX - 1,
        spectrometer: None,
        noiseless: false,
    }
}

fn block(channel: u16, pair: Pair, start: MissionTime, count: u32) -> VisibilityBlock {
    let wave = |k: u32, step: f32| (k as f32 * step).sin() * 1e4;
    VisibilityBlock {
        channel: ChannelId(channel),
        pair,
        start,
        offset_ticks: (0..count).map(|k| 51_234 * k + 7).collect(),
        duration_ticks: (0..count).map(|k| 51_233 + k % 2).collect(),
        value_k_sr: (0..count).map(|k| Complex32::new(wave(k, 0.37), wave(k, 0.73))).collect(),
        weight: (0..count).map(|k| 1e-7 * (1 + k) as f32).collect(),
        flags: (0..count).map(|k| Flags((k % 9) as u8 / 8)).collect(),
    }
}

/// What was sent, for comparison; derived from the frames, not from their bytes.
fn expectation(frames: &[GroundFrame]) -> Value {
    let mut expected = json!({ "instrument": null, "ephemeris": [], "visibilities": [], "housekeeping": [] });
    let mut list = |key: &str, entry: Value| expected[key].as_array_mut().unwrap().push(entry);
    for frame in frames {
        match frame {
            GroundFrame::Instrument(_) => {}
            GroundFrame::Ephemeris(segment) => list(
                "ephemeris",
                json!({
                    "start_ticks": segment.start.0,
                    "step_ticks": segment.step_ticks,
                    "satellites": segment.satellites,
                    "positions_m": segment.positions_m,
                }),
            ),
            GroundFrame::Visibilities(block) => list(
                "visibilities",
                json!({
                    "channel": block.channel.0,
                    "i": block.pair.i,
                    "j": block.pair.j,
                    "start_ticks": block.start.0,
                    "offset_ticks": block.offset_ticks,
                    "duration_ticks": block.duration_ticks,
                    "re": block.value_k_sr.iter().map(|v| v.re).collect::<Vec<_>>(),
                    "im": block.value_k_sr.iter().map(|v| v.im).collect::<Vec<_>>(),
                    "weight": block.weight,
                    "flags": block.flags.iter().map(|flags| flags.0).collect::<Vec<_>>(),
                }),
            ),
            GroundFrame::Housekeeping(counts) => {
                list("housekeeping", json!([counts.time.0, counts.sampled, counts.dropped]));
            }
        }
    }
    let instrument = instrument();
    expected["instrument"] = json!({
        "name": instrument.name,
        "epoch_tai_s": instrument.epoch_tai_s,
        "moon_radius_m": instrument.moon_radius_m,
        "satellites": instrument.satellites,
        "seed": instrument.seed,
        "configuration_hash": instrument.configuration_hash,
        "channels": instrument.channels.iter().map(|c| [c.frequency_hz, c.width_hz]).collect::<Vec<_>>(),
    });
    expected
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn ccsdspy_and_spacepackets_read_what_was_sent() {
    let python = common::python();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sent.ccsds");
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut frames = vec![GroundFrame::Instrument(instrument())];
    for window in 0..3 {
        // The second window holds a turnaround of the formation.
        let start = MissionTime::from_seconds(604_000.0 - 8_248.68 + 8_248.68 * f64::from(window));
        let end = start.plus_ticks(2_751_234_567);
        frames.extend(segments_for(&array, start, end, 60.0).into_iter().map(GroundFrame::Ephemeris));
        for (channel, pair) in [(0, Pair { i: 0, j: 1 }), (29, Pair { i: 2, j: 7 })] {
            frames.push(GroundFrame::Visibilities(block(channel, pair, start, 3_000)));
        }
        let time = end;
        frames.push(GroundFrame::Housekeeping(Housekeeping { time, sampled: 6_000, dropped: 1 }));
    }
    // Smaller packets than usual: more segments to assemble. One MiB is never reached: no repeats.
    let config = DownlinkConfig { packet_bytes_max: 2_048, ..Default::default() };
    let mut writer = DownlinkWriter::create(&path, &config).unwrap();
    for frame in &frames {
        writer.write(frame).unwrap();
    }
    writer.finish().unwrap();
    let expected = folder.path().join("expected.json");
    std::fs::write(&expected, expectation(&frames).to_string()).unwrap();

    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/python/downlink_read.py");
    let output = Command::new(python).arg(script).arg(&path).arg(&expected).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{said}{}", String::from_utf8_lossy(&output.stderr));
    assert!(said.contains("18000 visibilities"), "{said}");
}
