//! Generates the seeds of all targets in `fuzz/seeds`: `cargo run --release --example fuzz_seeds`.
#![allow(clippy::expect_used)] // It may stop at anything.

use std::fs;
use std::path::Path;

use lunarray::array::{Array, ArrayConfig, segments_for};
use lunarray::downlink::wire::cadu::{DATA_BYTES, randomize};
use lunarray::downlink::{DownlinkConfig, Format, HEADER_BYTES, PacketHeader, TRAILER_BYTES, Transmission};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, PlacedVisibilities,
    VisibilityBlock,
};
use lunarray::ground::Ground;
use lunarray::imaging::circle::{HarmonicEngine, HarmonicSetup};
use lunarray::imaging::{NormalEngine, PixelEngine, PixelSetup};
use lunarray::pipeline::{Config, ConfigSource};
use lunarray::response::harmonic::NominalOrbit;
use lunarray::response::pixel::PixelMethod;
use lunarray::runtime::{Outlet, Stage};
use lunarray::sky::Frame;
use lunarray::sky::fits::{Column, Ordering, Precision, WriteOptions, write_columns};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::{Complex32, Complex64};

const FREQUENCY_HZ: f64 = 3e6;
/// Of blocks 4 and 80 octets long, in FITS files.
const CARD: usize = 80;
const BLOCK: usize = 2880;

fn save(target: &str, name: &str, bytes: &[u8]) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz/seeds").join(target);
    fs::create_dir_all(&folder).expect("a folder");
    fs::write(folder.join(name), bytes).expect("a file");
}

fn array() -> Array {
    Array::new(&ArrayConfig { satellites: 4, ..ArrayConfig::default() }).expect("the default")
}

fn block(pair: Pair, start: MissionTime) -> GroundFrame {
    const COUNT: u32 = 4;
    GroundFrame::Visibilities(VisibilityBlock {
        channel: ChannelId(0),
        pair,
        start,
        offset_ticks: (0..COUNT).map(|k| 5_000_000 * k).collect(),
        duration_ticks: vec![5_000_000; COUNT as usize],
        value_k_sr: (0..COUNT).map(|k| Complex32::new(k as f32, 0.5)).collect(),
        weight: vec![0.25; COUNT as usize],
        flags: vec![Flags::GOOD; COUNT as usize],
    })
}

/// Two passes of four satellites.
fn mission() -> Vec<GroundFrame> {
    let array = array();
    let mut frames = vec![GroundFrame::Instrument(Instrument {
        name: "seed".to_owned(),
        epoch_tai_s: 2.5e9,
        moon_radius_m: array.moon_radius_m(),
        satellites: 4,
        channels: vec![Channel { frequency_hz: FREQUENCY_HZ, width_hz: 8e3 }],
        response: AntennaResponse::Isotropic,
        seed: 1,
        configuration_hash: 2,
        spectrometer: None,
        noiseless: false,
    })];
    for pass in 0..2 {
        let start = MissionTime(8_000_000_000 * pass);
        let end = start.plus_ticks(60_000_000);
        frames.extend(segments_for(&array, start, end, 60.0).into_iter().map(GroundFrame::Ephemeris));
        frames.extend([(0, 1), (1, 2)].map(|(i, j)| block(Pair { i, j }, start)));
        let sampled = 8 * (pass as u64 + 1);
        frames.push(GroundFrame::Housekeeping(Housekeeping { time: end, sampled, dropped: 0 }));
    }
    frames
}

fn transmit(config: &DownlinkConfig) -> Vec<u8> {
    let mut transmission = Transmission::new(config).expect("good");
    let mut bytes = Vec::new();
    for frame in &mission() {
        transmission.send(frame, &mut bytes).expect("sound");
    }
    transmission.finish(&mut bytes);
    bytes
}

fn downlink() {
    let plain = transmit(&DownlinkConfig { packet_bytes_max: 256, ..DownlinkConfig::default() });
    save("packet", "mission", &plain);
    let mut rest = plain.as_slice();
    while let Some(header) = PacketHeader::parse(rest) {
        let (packet, after) = rest.split_at(header.bytes);
        let mut payload = vec![header.kind.index() as u8];
        payload.extend(&packet[HEADER_BYTES..packet.len() - TRAILER_BYTES]);
        save("payload", &header.kind.to_string(), &payload);
        rest = after;
    }
    let coded =
        DownlinkConfig { format: Format::Cadu, interleave: 1, idle_frames: 1, ..DownlinkConfig::default() };
    let coded = transmit(&coded);
    let mut stream = vec![1];
    stream.extend(&coded);
    save("cadu", "mission", &stream);
    let mut frames = Vec::new();
    for cadu in coded.chunks_exact(4 + 255) {
        let mut frame = cadu[4..].to_vec();
        randomize(&mut frame);
        frames.extend(&frame[..DATA_BYTES]);
    }
    save("frame", "mission", &frames);
}

fn placed() -> PlacedVisibilities {
    let array = array();
    let mut placed = PlacedVisibilities {
        frequency_hz: FREQUENCY_HZ,
        pair: Pair { i: 0, j: 1 },
        ..PlacedVisibilities::default()
    };
    for k in 0..3 {
        let time_s = 60.0 * f64::from(k);
        placed.time_s.push(time_s);
        placed.r_i_m.push(array.position_m(0, time_s));
        placed.r_j_m.push(array.position_m(1, time_s));
        placed.value_k_sr.push(Complex64::new(f64::from(k), 1.0));
        placed.weight.push(1.0);
    }
    placed
}

fn save_engine<E: NormalEngine>(mut engine: E, kind: u8, name: &str) {
    let _ = engine.add(&placed()).expect("its channel");
    let mut bytes = vec![kind];
    engine.checkpoint(&mut bytes).expect("memory");
    bytes.truncate(bytes.len() - 4);
    save("checkpoint", name, &bytes);
}

fn engines() {
    let array = array();
    let (moon_radius_m, response) = (array.moon_radius_m(), AntennaResponse::Isotropic);
    let method = PixelMethod::Centre;
    let setup = PixelSetup {
        nside: 1,
        frequency_hz: FREQUENCY_HZ,
        method,
        moon_radius_m,
        response,
        companion_seed: 1,
        weight_max: 10.0,
    };
    save_engine(PixelEngine::new(setup).expect("good"), 2, "pixel");
    let orbit = NominalOrbit {
        inclination_rad: array.inclination_rad(),
        radius_m: array.orbit_radius_m(),
        limits: Config::default().map.limits,
    };
    let setup = HarmonicSetup {
        l_max: 2,
        frequency_hz: FREQUENCY_HZ,
        baseline_m_max: 700.0,
        moon_radius_m,
        response,
        orbit,
        companion_seed: 1,
        weight_max: 10.0,
    };
    save_engine(HarmonicEngine::new(setup).expect("good"), 3, "harmonic");
}

fn state() {
    let folder = tempfile();
    let overrides = ["map.nside=1", "map.baseline_bp_max=1000.0"].map(str::to_owned).to_vec();
    let source = ConfigSource { overrides, ..ConfigSource::default() };
    let config = source.parse_text("").expect("good");
    let mut ground = Ground::open(&folder, &config.ground(300), u64::MAX).expect("a new state");
    let bytes = transmit(&DownlinkConfig { packet_bytes_max: 256, ..DownlinkConfig::default() });
    ground.step(bytes, &mut Outlet::collect()).expect("sound");
    ground.finish(&mut Outlet::collect()).expect("sound");
    let file = fs::read(folder.join("checkpoint-00000001.lunarray")).expect("written");
    let head = u64::from_le_bytes(file[8..16].try_into().expect("8")) as u16;
    let mut seed = vec![0];
    seed.extend(head.to_le_bytes());
    seed.extend(&file[16..file.len() - 8]);
    save("checkpoint", "state", &seed);
    fs::remove_dir_all(folder).expect("removed");
}

fn tempfile() -> std::path::PathBuf {
    let folder = std::env::temp_dir().join(format!("lunarray-seeds-{}", std::process::id()));
    fs::create_dir_all(&folder).expect("a folder");
    folder
}

fn texts() {
    let small = "name = \"a\"\nseed = 1\n[sky]\nnside = 8\n[spacecraft]\nchannels_hz = [3e6, 1e7]\n\
                 duration_s = 20000.0\nevery_nth_integration = [2, 1]\n[downlink]\nformat = \"cadu\"\n\
                 [downlink.link]\nframe_loss = 0.1\n[map]\nnside = 4\nengine = \"harmonic\"\n";
    save("toml", "small", &[b"\0", small.as_bytes()].concat());
    let all = toml::to_string(&Config::default()).expect("it has a form");
    save("toml", "all", &[b"\0", all.as_bytes()].concat());
    save(
        "toml",
        "overrides",
        b"\x02map.nside=8\nspacecraft.duration_s=9e3\nsky.file=[\"a\"]\narray.breathing.ratio=2.0",
    );
    let gains = include_str!("../src/core/calibration/gains_example.toml");
    save("toml", "gains", &[b"\x03", gains.as_bytes()].concat());
}

fn maps() {
    let folder = tempfile();
    let path = folder.join("map.fits");
    for (name, options) in [
        ("ring", WriteOptions::default()),
        (
            "nested",
            WriteOptions {
                ordering: Ordering::Nested,
                precision: Precision::Double,
                ..WriteOptions::default()
            },
        ),
        ("partial", WriteOptions { partial: true, ..WriteOptions::default() }),
    ] {
        let mut values: Vec<f64> = (0..48).map(f64::from).collect();
        values[5] = lunarray::units::constants::HEALPIX_UNSEEN;
        let columns = [Column { name: "TEMPERATURE", unit: "K", values: &values }];
        write_columns(&path, Frame::Ecliptic, &columns, &options).expect("written");
        let file = fs::read(&path).expect("written");
        let (header, rest) = split_header(&file);
        let (table, data) = split_header(rest);
        save("fits", name, &[&[0], header.as_slice(), &[0], &table, &[0], data].concat());
    }
    fs::remove_dir_all(folder).expect("removed");
}

/// The cards of a header, one per line, without END; and what follows the header.
fn split_header(file: &[u8]) -> (Vec<u8>, &[u8]) {
    let cards: Vec<&[u8]> = file.chunks(CARD).take_while(|card| !card.starts_with(b"END ")).collect();
    let lines: Vec<&[u8]> = cards.iter().map(|card| card.trim_ascii_end()).collect();
    let bytes = ((cards.len() + 1) * CARD).next_multiple_of(BLOCK);
    (lines.join(&b'\n'), &file[bytes..])
}

fn main() {
    downlink();
    engines();
    state();
    texts();
    maps();
}
