//! Packets: how fast frames become bytes and bytes frames.
//!
//! `cargo bench --bench downlink`. Limits, measured in the same run over the same bytes: a plain copy, and a pass
//! that only forms the checksum. One thread, but for the replays of a file, whose stages have one each.
#![allow(clippy::unwrap_used)] // A bench may stop at anything.

use std::convert::Infallible;
use std::hint::black_box;
use std::io::Read;
use std::marker::PhantomData;
use std::path::Path;
use std::time::{Duration, Instant};

use lunarray::array::{Array, ArrayConfig, Ephemeris, segments_for};
use lunarray::calibration::{CalibrationConfig, Calibrator, MissingPackets};
use lunarray::downlink::receive::cadu::CaduReceiver;
use lunarray::downlink::wire::cadu::{CaduEncoder, ReedSolomon, randomize};
use lunarray::downlink::{DownlinkConfig, DownlinkReader, FileSource, PacketReceiver, Packetizer};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Instrument, PlacedFrame, VisibilityBlock,
};
use lunarray::ground::{Collector, Ground, GroundConfig, GroundError, WAIT_BYTES};
use lunarray::imaging::{EngineKind, MapConfig};
use lunarray::runtime::{Cancel, Graph, Ledger, Outlet, Sink, Stage, Units};
use lunarray::units::{ChannelId, MissionTime, Pair, StreamKind, all_pairs, random_stream};
use num_complex::Complex32;
use rand::{Rng, RngExt};

/// Best of so many runs.
const RUNS: usize = 7;
/// Visibilities of one block: the longest baseline at 10 MHz in one window.
const VISIBILITIES: u32 = 50_000;

fn instrument() -> Instrument {
    Instrument {
        name: "bench".to_owned(),
        epoch_tai_s: 2.5e9,
        moon_radius_m: 1_737_100.0,
        satellites: 8,
        channels: vec![Channel { frequency_hz: 1e7, width_hz: 8e3 }; 3],
        response: AntennaResponse::Isotropic,
        seed: 0,
        configuration_hash: 0,
        spectrometer: None,
        noiseless: false,
    }
}

fn frames() -> Vec<GroundFrame> {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let (start, end) = (MissionTime(0), MissionTime(2_750_000_000));
    let mut frames = vec![GroundFrame::Instrument(instrument())];
    frames.extend(segments_for(&array, start, end, 60.0).into_iter().map(GroundFrame::Ephemeris));
    for channel in 0..3 {
        frames.extend(all_pairs(8).into_iter().map(|pair| GroundFrame::Visibilities(block(channel, pair))));
    }
    frames
}

fn block(channel: u16, pair: Pair) -> VisibilityBlock {
    let n = VISIBILITIES as usize;
    VisibilityBlock {
        channel: ChannelId(channel),
        pair,
        start: MissionTime(0),
        offset_ticks: (0..VISIBILITIES).map(|k| 54_000 * k).collect(),
        duration_ticks: vec![54_000; n],
        value_k_sr: (0..n).map(|k| Complex32::new(k as f32, 0.5)).collect(),
        weight: vec![0.25; n],
        flags: vec![Flags::GOOD; n],
    }
}

/// Shortest time of a few runs, s.
fn best_s(mut run: impl FnMut()) -> f64 {
    let time = |_| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64()
    };
    (0..RUNS).map(time).fold(f64::INFINITY, f64::min)
}

struct Report {
    bytes: f64,
    copy_s: f64,
    crc_s: f64,
}

impl Report {
    fn line(&self, what: &str, s: f64) {
        println!(
            "{what:<38} {:>7.2} GB/s   {:>5.1} % of a copy   {:>5.1} % of CRC-32C alone",
            self.bytes / s / 1e9,
            100.0 * self.copy_s / s,
            100.0 * self.crc_s / s
        );
    }
}

fn encode(frames: &[GroundFrame], out: &mut Vec<u8>) {
    let mut packetizer = Packetizer::new(&DownlinkConfig::default()).unwrap();
    out.clear();
    for frame in frames {
        packetizer.encode(frame, out).unwrap();
    }
}

fn decode(bytes: &[u8], mut each: impl FnMut(GroundFrame)) -> u64 {
    let mut reader = DownlinkReader::new(bytes, Path::new("memory"));
    while let Some(frame) = reader.next_frame().unwrap() {
        each(frame);
    }
    reader.counters().visibilities_decoded
}

fn receive(bytes: &[u8]) -> u64 {
    let mut receiver = PacketReceiver::new();
    let (mut source, mut events) = (bytes, 0);
    while receiver.fill_from(&mut source).unwrap() > 0 {
        while receiver.next_event().is_some() {
            events += 1;
        }
    }
    events
}

/// The layers of the coded link, each over the bytes that pass it.
fn layers(packets: &[u8], copy_gb_s: f64) {
    let code = ReedSolomon::new(5).unwrap();
    let line = |what: &str, bytes: usize, s: f64| {
        let gb_s = bytes as f64 / s / 1e9;
        println!("{what:<38} {gb_s:>7.3} GB/s   {:>5.1} % of a copy", 100.0 * gb_s / copy_gb_s);
    };
    let mut blocks = vec![0; packets.len() / code.block_bytes() * code.block_bytes()];
    random_stream(3, StreamKind::Probe, [0, 0]).fill_bytes(&mut blocks);
    let each = |blocks: &mut [u8], run: &mut dyn FnMut(&mut [u8])| {
        blocks.chunks_exact_mut(code.block_bytes()).for_each(run);
    };
    line("randomizer", blocks.len(), best_s(|| each(&mut blocks, &mut |block| randomize(block))));
    line("Reed-Solomon: encode", blocks.len(), best_s(|| each(&mut blocks, &mut |block| code.encode(block))));
    let decode = |what: &str, blocks: &[u8]| {
        let mut spoilt = blocks.to_vec();
        let s = (0..RUNS).fold(f64::INFINITY, |best, _| {
            spoilt.copy_from_slice(blocks);
            let start = Instant::now();
            each(&mut spoilt, &mut |block| {
                let _ = black_box(code.decode(block));
            });
            best.min(start.elapsed().as_secs_f64())
        });
        line(what, blocks.len(), s);
    };
    decode("Reed-Solomon: decode, clean", &blocks);
    for (what, wrong) in [("1", 1), ("5", 5), ("16", 16), ("17 (too many)", 17)] {
        let mut spoilt = blocks.clone();
        // So many of every codeword, evenly spread.
        each(&mut spoilt, &mut |block| (0..5 * wrong).for_each(|k| block[13 * k] ^= 1 + (k % 255) as u8));
        decode(&format!("Reed-Solomon: decode, {what} wrong each"), &spoilt);
    }
    let mut coded = Vec::with_capacity(2 * packets.len());
    let encode = |coded: &mut Vec<u8>| {
        let mut encoder = CaduEncoder::new(code, 1, 2);
        coded.clear();
        encoder.encode(packets, coded);
        encoder.flush(coded);
    };
    line("packets to CADUs", packets.len(), best_s(|| encode(&mut coded)));
    let mut recovered = Vec::with_capacity(packets.len());
    let mut receive = |what: &str, coded: &[u8]| {
        let s = best_s(|| {
            let mut receiver = CaduReceiver::new();
            recovered.clear();
            coded.chunks(1 << 18).for_each(|chunk| receiver.push(chunk, &mut recovered));
            receiver.finish(&mut recovered);
        });
        line(what, coded.len(), s);
        assert!(recovered == packets);
    };
    receive("CADUs to packets, clean", &coded);
    let mut slipped = vec![0_u8];
    slipped.extend(coded.windows(2).map(|pair| pair[0] << 3 | pair[1] >> 5));
    slipped.push(coded[coded.len() - 1] << 3);
    slipped[0] = coded[0] >> 5;
    receive("CADUs to packets, three bits off", &slipped);
    let mut noisy = coded.clone();
    let bits = 8 * noisy.len();
    let mut random = random_stream(4, StreamKind::Probe, [0, 0]);
    for _ in 0..bits / 10_000 {
        let bit = random.random_range(0..bits);
        noisy[bit / 8] ^= 1 << (bit % 8);
    }
    receive("CADUs to packets, bit error rate 1e-4", &noisy);
    let mut noise = vec![0; packets.len()];
    random.fill_bytes(&mut noise);
    let s = best_s(|| {
        let mut receiver = CaduReceiver::new();
        let mut none = Vec::new();
        noise.chunks(1 << 18).for_each(|chunk| receiver.push(chunk, &mut none));
        receiver.finish(&mut none);
        assert!(none.is_empty());
    });
    line("search for CADUs in noise", noise.len(), s);
}

fn main() {
    let frames = frames();
    let sent = 3 * 28 * u64::from(VISIBILITIES);
    let mut bytes = Vec::new();
    encode(&frames, &mut bytes);
    let mut copy = vec![0_u8; bytes.len()];
    let copy_s = best_s(|| black_box(&mut copy).copy_from_slice(black_box(&bytes)));
    let crc_s = best_s(|| {
        black_box(crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, black_box(&bytes)));
    });
    let report = Report { bytes: bytes.len() as f64, copy_s, crc_s };
    println!("downlink: {:.1} MB, {sent} visibilities, best of {RUNS} runs, one thread", report.bytes / 1e6);
    report.line("copy", copy_s);
    report.line("CRC-32C alone", crc_s);
    let mut out = Vec::with_capacity(bytes.len());
    report.line("encode frames", best_s(|| encode(black_box(&frames), &mut out)));
    report.line(
        "receive packets",
        best_s(|| {
            black_box(receive(black_box(&bytes)));
        }),
    );
    report.line("decode frames", best_s(|| assert_eq!(decode(black_box(&bytes), drop), sent)));
    layers(&bytes, report.bytes / copy_s / 1e9);
    place(&bytes, sent);
    replay(&bytes, sent);
    resynchronise(report.bytes as usize);
}

/// Decoding and placing: what a map-maker waits for.
fn place(bytes: &[u8], sent: u64) {
    let mut placed = 0;
    let s = best_s(|| {
        let mut ephemeris = Ephemeris::default();
        placed = 0;
        decode(bytes, |frame| match frame {
            GroundFrame::Ephemeris(segment) => {
                ephemeris.insert(segment);
            }
            GroundFrame::Visibilities(block) => placed += black_box(ephemeris.place(&block, 1e7)).1.placed,
            _ => {}
        });
    });
    assert_eq!(placed, sent);
    println!("{:<38} {:>7.2} M visibilities/s", "decode and place", sent as f64 / s / 1e6);
}

/// Counts what comes to an end.
struct End<T>(u64, PhantomData<T>);

impl<T: Send> Sink for End<T> {
    type In = T;
    type Error = Infallible;

    fn take(&mut self, item: T) -> Result<(), Infallible> {
        black_box(item);
        self.0 += 1;
        Ok(())
    }

    fn units(&self) -> Units {
        Units::of(self.0, "items")
    }
}

/// The ground up to its sums, as [`Ground`] does it: collects packets, places and calibrates visibilities.
struct Door {
    collector: Collector,
    calibrator: Calibrator,
}

impl Stage for Door {
    type In = Vec<u8>;
    type Out = PlacedFrame;
    type Error = GroundError;

    fn step(&mut self, bytes: Vec<u8>, _: &mut Outlet<PlacedFrame>) -> Result<(), GroundError> {
        self.collector.push(&bytes);
        loop {
            let ephemeris = self.calibrator.ephemeris();
            let Some(delivery) = self.collector.next_delivery(&|outline| ephemeris.covers(outline.span))?
            else {
                return Ok(());
            };
            if let Some(frame) = delivery.frame {
                black_box(self.calibrator.accept(frame)?);
            }
        }
    }

    fn finish(&mut self, _: &mut Outlet<PlacedFrame>) -> Result<(), GroundError> {
        black_box(self.calibrator.post_losses(MissingPackets::default()));
        Ok(())
    }
}

/// A replay, stages on threads as `lunarray replay` has them: from the file to the engines' door, and through the
/// engines; beside one thread that reads the same file and forms a checksum.
fn replay(bytes: &[u8], sent: u64) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bench.ccsds");
    std::fs::write(&path, bytes).unwrap();
    let checksum = || {
        let (mut file, mut chunk) = (std::fs::File::open(&path).unwrap(), vec![0; 1 << 18]);
        let mut digest = crc_fast::Digest::new(crc_fast::CrcAlgorithm::Crc32Iscsi);
        while let count @ 1.. = file.read(&mut chunk).unwrap() {
            digest.update(&chunk[..count]);
        }
        digest.finalize()
    };
    let read =
        |graph: &mut Graph| graph.source("read", 64, FileSource::open(std::slice::from_ref(&path)).unwrap());
    let run = |graph: Graph| {
        graph.run(&Cancel::new(), Duration::from_secs(10)).unwrap();
    };
    let to_door = || {
        let (mut graph, ledger) = (Graph::new(), Ledger::new());
        let bytes = read(&mut graph);
        let hook = CalibrationConfig::default().build(Path::new("")).unwrap();
        let calibrator = Calibrator::new(hook, ledger.clone()).with_segments(8192);
        let placed =
            graph.stage("ground", 64, bytes, Door { collector: Collector::new(WAIT_BYTES), calibrator });
        graph.sink("door", placed, End(0, PhantomData));
        run(graph);
        assert_eq!((ledger.report().sampled, ledger.report().flagged_total()), (sent, 0));
        sent
    };
    let through = || {
        let mut graph = Graph::new();
        let bytes = read(&mut graph);
        let map = MapConfig { engine: EngineKind::Harmonic, ..MapConfig::default() };
        let calibration = CalibrationConfig::default();
        let ground = Ground::new(&GroundConfig {
            calibration,
            calibrate: Default::default(),
            map,
            wait_bytes: WAIT_BYTES,
            memory_max_bytes: None,
            group: None,
            part: None,
        })
        .unwrap();
        let outcome = ground.outcome();
        let sums = graph.stage("ground", 1, bytes, ground);
        graph.sink("end", sums, End(0, PhantomData));
        run(graph);
        outcome.ledger.balanced_report().unwrap().accumulated
    };
    let time = |run: &dyn Fn() -> u64| {
        let start = Instant::now();
        let found = black_box(run());
        (start.elapsed().as_secs_f64(), found)
    };
    // In turns, so that whatever else the machine does meets both.
    let mut best = [f64::INFINITY; 2];
    for _ in 0..RUNS {
        best = [best[0].min(time(&checksum).0), best[1].min(time(&to_door).0)];
    }
    let (through_s, summed) = time(&through);
    let line = |what: &str, s: f64| {
        let gb_s = bytes.len() as f64 / s / 1e9;
        println!("{what:<38} {gb_s:>7.2} GB/s   {:>5.1} % of the checksum", 100.0 * best[0] / s);
    };
    line("file: read and checksum", best[0]);
    line("file: replay to the engines' door", best[1]);
    line("file: replay through harmonic engines", through_s);
    println!("  of {sent} visibilities {summed} within the maps' longest baselines, nside 16, 3 channels");
}

/// Noise, and the worst that a forger can do: headers that each ask for a check of 64 KiB.
fn resynchronise(bytes: usize) {
    let mut noise = vec![0; bytes];
    random_stream(1, StreamKind::Probe, [0, 0]).fill_bytes(&mut noise);
    let start = Instant::now();
    black_box(receive(&noise));
    println!("{:<38} {:>7.2} GB/s", "noise", bytes as f64 / start.elapsed().as_secs_f64() / 1e9);
    let header = lunarray::downlink::PacketHeader {
        kind: lunarray::downlink::PacketKind::Visibilities,
        segment: lunarray::downlink::PacketSegment::Whole,
        count: 0,
        time: lunarray::downlink::CucTime(0),
        version: lunarray::downlink::FORMAT_VERSION,
        bytes: lunarray::downlink::PACKET_BYTES_MAX,
    };
    let forged = header.to_bytes().repeat(100_000);
    let start = Instant::now();
    black_box(receive(&forged));
    let rate = forged.len() as f64 / start.elapsed().as_secs_f64() / 1e6;
    println!("{:<38} {rate:>7.2} MB/s", "forged headers, 64 KiB each");
}
