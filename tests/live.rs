//! A ground that listens, a spacecraft that sends, and replays at a pace: the same bits as through a file.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // Also in the helpers.

mod common;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command as Process, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use assert_cmd::Command;
use common::downlink::{mission, packets_of, transmit};
use lunarray::downlink::socket::{ListenConfig, SocketSource, Until};
use lunarray::downlink::{
    CucTime, DownlinkConfig, FORMAT_VERSION, Kind, PACKET_BYTES_MAX, PacketHeader, Segment,
};
use lunarray::runtime::{Flow, Outlet, Source};
use serde_json::Value;

/// Real geometry, two channels, few visibilities.
const SMALL: &str = r#"
name = "small"
seed = 7
[sky]
nside = 8
[spacecraft]
channels_hz = [3.0e6, 10.0e6]
every_nth_window = 300
every_nth_integration = 2
baseline_wavelengths_max = 16.0
[downlink]
packet_bytes_max = 2048
[map]
nside = 4
epsilon = 1e-4
[products]
pictures = false
"#;

struct Workplace {
    folder: tempfile::TempDir,
    pipeline: String,
}

impl Workplace {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("small.toml");
        std::fs::write(&path, SMALL).unwrap();
        Self { pipeline: path.to_str().unwrap().to_owned(), folder }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn downlink(&self, format: &str) -> String {
        let file = self.path(&format!("small.{format}"));
        succeed(&["simulate", &self.pipeline, "--out", &file, "--format", format]);
        file
    }

    /// Replays a file; the summary.
    fn replay(&self, name: &str, file: &str, more: &[&str]) -> Value {
        let out = self.path(name);
        let fixed = ["replay", file, "--map", &self.pipeline, "--out", &out, "--json"];
        serde_json::from_str(&succeed(&[&fixed, more].concat())).unwrap()
    }

    /// Starts a ground that listens.
    fn ground(&self, name: &str, more: &[&str]) -> Ground {
        let out = self.path(name);
        let listen =
            if more.contains(&"--listen") { &[] } else { ["--listen", "tcp://127.0.0.1:0"].as_slice() };
        let fixed = ["replay", "--map", &self.pipeline, "--out", &out, "--json"];
        Ground::start(&[&fixed, listen, more].concat())
    }

    fn maps(&self, name: &str) -> Vec<Vec<u8>> {
        let mut folders: Vec<PathBuf> = std::fs::read_dir(self.path(name))
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.is_dir())
            .collect();
        folders.sort();
        assert!(!folders.is_empty());
        folders.iter().map(|folder| std::fs::read(folder.join("map.fits")).unwrap()).collect()
    }

    /// The newest checkpoint of a state.
    fn checkpoint(&self, state: &str) -> Vec<u8> {
        let entries = std::fs::read_dir(self.path(state)).unwrap();
        let mut found: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
        found.retain(|path| path.extension().is_some_and(|extension| extension == "lunarray"));
        std::fs::read(found.iter().max().unwrap()).unwrap()
    }
}

fn succeed(args: &[&str]) -> String {
    let output = Command::cargo_bin("lunarray").unwrap().args(args).output().unwrap();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8(output.stderr).unwrap());
    String::from_utf8(output.stdout).unwrap()
}

fn complaint(args: &[&str]) -> String {
    let output = Command::cargo_bin("lunarray").unwrap().args(args).output().unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && !text.contains("panicked"), "{args:?}: {text}");
    text
}

/// A process that listens.
struct Ground {
    child: Child,
    url: String,
    said: Arc<Mutex<String>>,
    reader: JoinHandle<()>,
}

impl Ground {
    fn start(args: &[&str]) -> Self {
        let mut command = Process::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let mut child = command.args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let said = Arc::new(Mutex::new(String::new()));
        let note = |said: &Arc<Mutex<String>>, line: &str| *said.lock().unwrap() += &format!("{line}\n");
        let url = loop {
            let line = lines.next().expect("the ground ended before it listened").unwrap();
            note(&said, &line);
            if let Some(url) = line.strip_prefix("listening on ") {
                break url.to_owned();
            }
        };
        let shared = Arc::clone(&said);
        let reader = std::thread::spawn(move || lines.for_each(|line| note(&shared, &line.unwrap())));
        Self { child, url, said, reader }
    }

    fn connect(&self) -> TcpStream {
        TcpStream::connect(self.url.strip_prefix("tcp://").unwrap()).unwrap()
    }

    /// Sends all of it, closes, and gives the answer.
    fn send(&self, bytes: &[u8]) -> String {
        finish(self.connect(), bytes)
    }

    /// Most memory that it had, bytes.
    fn memory(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
        1024 * line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
    }

    fn wait_for(&self, text: &str) {
        let since = Instant::now();
        while !self.said.lock().unwrap().contains(text) {
            assert!(
                since.elapsed() < Duration::from_secs(60),
                "no `{text}` in {}",
                self.said.lock().unwrap()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Its end: status, summary, all that it said.
    fn end(mut self) -> (ExitStatus, Value, String) {
        let mut text = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut text).unwrap();
        let status = self.child.wait().unwrap();
        self.reader.join().unwrap();
        let said = self.said.lock().unwrap().clone();
        (status, serde_json::from_str(&text).unwrap_or_else(|_| panic!("{text}{said}")), said)
    }

    fn end_without_summary(mut self) -> (ExitStatus, String) {
        let status = self.child.wait().unwrap();
        self.reader.join().unwrap();
        let said = self.said.lock().unwrap().clone();
        (status, said)
    }

    fn succeed(self) -> Value {
        let (status, summary, said) = self.end();
        assert!(status.success(), "{said}");
        summary
    }
}

/// Sends the rest, closes, and gives the answer.
fn finish(mut stream: TcpStream, bytes: &[u8]) -> String {
    stream.write_all(bytes).unwrap();
    stream.shutdown(Shutdown::Write).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

/// Every byte of packets is accounted for.
fn assert_closed(reception: &Value) {
    let of = |key: &str| reception[key].as_u64().unwrap();
    let kinds = ["instrument", "ephemeris", "visibilities", "calibration", "housekeeping"];
    let packets: u64 = kinds.iter().map(|kind| reception[kind]["bytes"].as_u64().unwrap()).sum();
    let others = ["bytes_garbage", "bytes_truncated", "bytes_damaged", "bytes_duplicate"];
    let others: u64 = others.iter().map(|key| of(key)).sum();
    assert_eq!(of("bytes"), packets + others, "{reception}");
}

#[test]
fn through_a_socket_the_maps_are_those_of_a_file() {
    let place = Workplace::new();
    for format in ["packets", "cadu"] {
        let file = place.path(&format!("sent.{format}"));
        let ground = place.ground(&format!("{format}.heard"), &["--connections", "1"]);
        let simulate = ["simulate", &place.pipeline, "--format", format, "--out", &file];
        let said = succeed(&[&simulate[..], &["--send", &ground.url]].concat());
        let length = std::fs::metadata(&file).unwrap().len();
        assert!(said.contains(&format!("took all {length} bytes")), "{said}");
        let heard = ground.succeed();
        let read = place.replay(&format!("{format}.read"), &file, &[]);
        assert!(place.maps(&format!("{format}.heard")) == place.maps(&format!("{format}.read")), "{format}");
        for key in ["ledger", "reception"] {
            assert_eq!(heard[key], read[key], "{format}");
        }
        assert_eq!(heard["listening"]["bytes"].as_u64(), Some(length));
        assert_eq!(heard["listening"]["senders"]["listed"][0]["format"], format);
    }
}

#[test]
fn two_stations_that_send_the_same_leave_the_state_of_one() {
    let place = Workplace::new();
    let [plain, coded] = ["packets", "cadu"].map(|format| place.downlink(format));
    let once = place.replay("once.out", &plain, &["--state", &place.path("once")]);
    let ground = place.ground("both.out", &["--state", &place.path("both"), "--connections", "2"]);
    let [plain, coded] = [plain, coded].map(|file| std::fs::read(file).unwrap());
    std::thread::scope(|scope| {
        for bytes in [&plain, &coded] {
            let ground = &ground;
            scope.spawn(move || assert_eq!(ground.send(bytes), format!("taken {} bytes\n", bytes.len())));
        }
    });
    let both = ground.succeed();
    assert!(place.checkpoint("both") == place.checkpoint("once"), "a second station left a trace");
    assert!(place.maps("both.out") == place.maps("once.out"));
    assert_eq!(both["ledger"], once["ledger"]);
    let count = |summary: &Value, key: &str| summary["reception"]["visibilities"][key].as_u64().unwrap();
    assert_eq!(count(&both, "duplicates"), count(&once, "packets"));
    assert_closed(&both["reception"]);

    // The other passes of two stations, at the same time, without a state.
    let packets = packets_of(&plain);
    let halves: Vec<Vec<u8>> = [0, 1]
        .map(|half| {
            let (mut pass, mut bytes) = (0, Vec::new());
            for packet in &packets {
                if pass % 2 == half {
                    bytes.extend_from_slice(packet);
                }
                let header = PacketHeader::parse(packet).unwrap();
                pass += i32::from(header.kind == Kind::Housekeeping);
            }
            bytes
        })
        .to_vec();
    let ground = place.ground("halves.out", &["--connections", "2"]);
    std::thread::scope(|scope| {
        for half in &halves {
            let ground = &ground;
            scope.spawn(move || ground.send(half));
        }
    });
    assert_eq!(ground.succeed()["ledger"], once["ledger"]);
    assert!(place.maps("halves.out") == place.maps("once.out"));
}

/// Headers that claim the greatest packet, without one.
fn claims(count: u64) -> Vec<u8> {
    let header = |count| PacketHeader {
        kind: Kind::Visibilities,
        segment: Segment::Whole,
        count: 2 * count,
        time: CucTime(1),
        version: FORMAT_VERSION,
        bytes: PACKET_BYTES_MAX,
    };
    (0..count).flat_map(|count| header(count).to_bytes()).collect()
}

#[test]
fn bad_senders_are_closed_and_counted_and_a_good_one_loses_nothing() {
    let place = Workplace::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let set = ["first_packet_s_max=4", "idle_s_max=4", "garbage_bytes_max=65536", "memory_bytes_max=4194304"];
    let set = set.map(|limit| format!("downlink.listen.{limit}"));
    let set: Vec<&str> = set.iter().flat_map(|limit| ["--set", limit.as_str()]).collect();
    // Three give sound packets: the good one, the one that falls silent, the one of another mission.
    let ground = place.ground("heard", &[&set[..], &["--connections", "3"]].concat());
    // Until the ground closes; what it says then may be lost with the connection.
    let flood = |piece: &[u8]| {
        let mut stream = ground.connect();
        let mut bytes = 0_u64;
        while bytes < 1 << 30 && stream.write_all(piece).is_ok() {
            bytes += piece.len() as u64;
        }
        assert!(bytes < 1 << 30, "the ground goes on taking garbage");
    };
    let noise: Vec<u8> =
        (0..1_u64 << 16).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 41) as u8).collect();
    let marker = [0x1A, 0xCF, 0xFC, 0x1D];
    // Each looks like a frame's beginning; the second kind stands before blocks that are codewords.
    let markers: Vec<u8> = noise.chunks(3).flat_map(|noise| [&marker, noise].concat()).collect();
    let only_markers = marker.repeat(1 << 12);
    let foreign = transmit(&mission(1, 10), &DownlinkConfig::default());
    let packets = packets_of(&good);
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let (ground, packets, foreign, over) = (&ground, &packets, &foreign, &over);
        // Sends all the while: some packets again, as long as the others are there.
        let good = scope.spawn(move || {
            let (mut stream, mut sent) = (ground.connect(), 0);
            for packets in packets.chunks(packets.len() / 20 + 1) {
                for packet in packets {
                    stream.write_all(packet).unwrap();
                    sent += packet.len();
                }
                std::thread::sleep(Duration::from_millis(100));
            }
            while !over.load(Ordering::Relaxed) {
                stream.write_all(&packets[0]).unwrap();
                sent += packets[0].len();
                std::thread::sleep(Duration::from_millis(100));
            }
            assert_eq!(finish(stream, &[]), format!("taken {sent} bytes\n"));
        });
        let answer_to = |bytes: &[u8]| {
            let mut stream = ground.connect();
            stream.write_all(bytes).unwrap();
            let mut answer = String::new();
            stream.read_to_string(&mut answer).unwrap();
            answer
        };
        let mut others = vec![
            scope.spawn(|| flood(&noise)),
            scope.spawn(|| flood(&markers)),
            scope.spawn(|| flood(&only_markers)),
            scope.spawn(|| flood(&claims(3000))),
            // A byte at a time, of sound packets.
            scope.spawn(|| {
                let mut stream = ground.connect();
                for octet in packets[0].iter().cycle() {
                    if stream.write_all(&[*octet]).is_err() {
                        break;
                    }
                    std::thread::sleep(Duration::from_millis(200));
                }
            }),
            scope.spawn(move || assert!(answer_to(&[]).contains("first_packet_s_max"))),
            scope.spawn(move || assert!(answer_to(&packets[0]).contains("idle_s_max"))),
            scope.spawn(|| assert_eq!(ground.send(&[]), "taken 0 bytes\n")),
        ];
        // Once the ground knows the instrument.
        std::thread::sleep(Duration::from_millis(500));
        others.push(scope.spawn(move || {
            let mut stream = ground.connect();
            let _ = stream.write_all(foreign);
            let _ = stream.read_to_end(&mut Vec::new());
        }));
        let ends: Vec<_> = others.into_iter().map(|other| other.join()).collect();
        over.store(true, Ordering::Relaxed);
        good.join().unwrap();
        assert!(ends.iter().all(Result::is_ok));
    });
    let memory = ground.memory();
    let (status, summary, said) = ground.end();
    assert!(status.success(), "{said}");
    assert!(place.maps("heard") == place.maps("read"));
    let ended = &summary["listening"]["ended"];
    let expected = [("whole", 2), ("garbage", 4), ("first-packet", 2), ("idle", 1), ("other-instrument", 1)];
    for (key, count) in expected {
        assert_eq!(ended[key], count, "{key} in {ended}\n{said}");
    }
    for limit in ["first_packet_s_max", "idle_s_max", "garbage_bytes_max", "another instrument"] {
        assert!(said.contains(limit), "{limit} is not in {said}");
    }
    assert_closed(&summary["reception"]);
    let garbage = summary["reception"]["bytes_garbage"].as_u64().unwrap();
    let damaged = summary["reception"]["bytes_damaged"].as_u64().unwrap();
    assert!(garbage > 2 << 16 && damaged > 0, "garbage {garbage}, damaged {damaged}");
    // Nine connections with 4 MiB each, a backlog of 8 MiB, queues of 64 pieces of 64 KiB; the rest of the program
    // takes some 30 MB. Far below what was offered.
    assert!(memory < 120 << 20, "{memory} bytes");
}

#[test]
fn connections_beyond_the_limit_are_refused() {
    let place = Workplace::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let (begin, rest) = good.split_at(good.len() / 3);
    let set = ["--set", "downlink.listen.connections_max=1", "--connections", "1"];
    let ground = place.ground("heard", &set);
    let mut stream = ground.connect();
    stream.write_all(begin).unwrap();
    // Whether the system hands over the second connection after the first is certain, when is not.
    let mut answer = String::new();
    ground.connect().read_to_string(&mut answer).unwrap();
    assert!(answer.contains("connections_max"), "{answer}");
    finish(stream, rest);
    let summary = ground.succeed();
    assert_eq!([&summary["listening"]["connections"], &summary["listening"]["refused"]], [1, 1]);
    assert!(place.maps("heard") == place.maps("read"));
}

#[test]
fn a_sender_cut_off_within_a_packet_is_counted_and_may_begin_again() {
    let place = Workplace::new();
    let file = place.downlink("packets");
    let read = place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let packets = packets_of(&good);
    let cut = (40..).find(|&k| packets[k].len() > 333).unwrap();
    let whole: usize = packets.iter().take(cut).map(Vec::len).sum();
    let ground = place.ground("heard", &["--connections", "2"]);
    assert_eq!(ground.send(&good[..whole + 333]), format!("taken {} bytes\n", whole + 333));
    ground.send(&good);
    let heard = ground.succeed();
    assert_eq!(heard["reception"]["bytes_truncated"], 333);
    assert_eq!(heard["reception"]["bytes_duplicate"], whole);
    assert_eq!(heard["ledger"], read["ledger"]);
    assert_closed(&heard["reception"]);
    assert!(place.maps("heard") == place.maps("read"));
}

#[test]
fn a_ground_that_is_slower_slows_the_sender_and_keeps_its_memory() {
    const OFFERED: usize = 200 << 20;
    let backlog = 1 << 20;
    let limits = ListenConfig { backlog_bytes_max: backlog, bytes_per_s_max: 0.0, ..ListenConfig::default() };
    let until = Until { connections: 1, ..Until::default() };
    let mut source = SocketSource::bind(&["127.0.0.1:0".parse().unwrap()], &limits, until).unwrap();
    let address = source.url().to_string();
    let address = address.strip_prefix("tcp://").unwrap().to_owned();
    let bytes = transmit(&mission(20, 2000), &DownlinkConfig::default());
    let length = bytes.len();
    let times = OFFERED / length;
    let sent = Arc::new(AtomicUsize::new(0));
    let count = Arc::clone(&sent);
    let sender = std::thread::spawn(move || {
        let mut stream = TcpStream::connect(address).unwrap();
        for _ in 0..times {
            for piece in bytes.chunks(1 << 16) {
                stream.write_all(piece).unwrap();
                count.fetch_add(piece.len(), Ordering::Relaxed);
            }
        }
        finish(stream, &[])
    });
    // One look starts the listener; then the ground takes its time.
    let mut taken = 0;
    let mut out = Outlet::collect();
    let mut take = |source: &mut SocketSource| {
        let flow = source.next(&mut out).unwrap();
        taken += out.take().iter().map(Vec::len).sum::<usize>();
        (flow, taken)
    };
    let (_, first) = take(&mut source);
    // Until nothing has moved for a while.
    let mut stood = 0;
    while stood < 10 || sent.load(Ordering::Relaxed) == 0 {
        let before = sent.load(Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(50));
        stood = if sent.load(Ordering::Relaxed) == before { stood + 1 } else { 0 };
    }
    // What is on the way: the backlog, what one connection has in hand, and what the system holds for a connection, 10
    // MiB at the most on Linux (tcp_wmem and tcp_rmem).
    let on_the_way = sent.load(Ordering::Relaxed) - first;
    assert!(on_the_way < (backlog as usize) + (2 << 20) + (32 << 20), "{on_the_way} bytes");
    assert!(source.listening().status.backlog_bytes() <= backlog);
    let all = loop {
        match take(&mut source) {
            (Flow::Continue, _) => {}
            (Flow::Done, all) => break all,
        }
    };
    source.finish(&mut Outlet::collect()).unwrap();
    assert_eq!(all, times * length);
    assert_eq!(sender.join().unwrap(), format!("taken {all} bytes\n"));
    assert!(source.listening().account().backlog_bytes_max <= backlog);
}

#[test]
fn interrupted_it_leaves_maps_of_what_was_sent() {
    let place = Workplace::new();
    let file = place.downlink("packets");
    let good = std::fs::read(&file).unwrap();
    let ground = place.ground("heard", &[]);
    let packets = packets_of(&good);
    let half: usize = packets.iter().take(packets.len() / 2).map(Vec::len).sum();
    assert_eq!(ground.send(&good[..half]), format!("taken {half} bytes\n"));
    // Another stays; when it has been taken in is not told.
    let mut stream = ground.connect();
    stream.write_all(&packets[0]).unwrap();
    std::thread::sleep(Duration::from_millis(1500));
    let killed = Process::new("kill").args(["-INT", &ground.child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let (status, summary, said) = ground.end();
    assert_eq!(status.code(), Some(130), "{said}");
    assert_eq!(
        [&summary["cancelled"], &summary["listening"]["ended"]["stopped"]],
        [&Value::Bool(true), &1.into()]
    );
    let cut = place.path("half");
    std::fs::write(&cut, &good[..half]).unwrap();
    place.replay("read", &cut, &[]);
    assert!(place.maps("heard") == place.maps("read"));
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(answer.contains("the ground has ended its run"), "{answer}");
}

#[test]
fn listening_ends_when_nobody_sends() {
    let place = Workplace::new();
    let file = place.downlink("cadu");
    let ground = place.ground("heard", &["--idle-s", "3"]);
    // Who only connects, or sends what is no packet, does not keep it up.
    let silent = ground.connect();
    ground.send(&std::fs::read(&file).unwrap());
    ground.wait_for("the sender closed it");
    let summary = ground.succeed();
    drop(silent);
    assert_eq!(summary["cancelled"], false);
    assert_eq!(summary["listening"]["ended"]["stopped"], 1);
}

/// Times of the packets of a file, s.
fn times(file: &str) -> Vec<f64> {
    let packets = packets_of(&std::fs::read(file).unwrap());
    packets.iter().map(|packet| PacketHeader::parse(packet).unwrap().time.tai_s()).collect()
}

#[test]
fn a_pace_changes_no_bit() {
    let place = Workplace::new();
    let [plain, coded] = ["packets", "cadu"].map(|format| place.downlink(format));
    let times = times(&plain);
    let span = times.last().unwrap() - times[0];
    let fast = place.replay("read", &plain, &[]);
    for (name, file) in [("plain", &plain), ("coded", &coded)] {
        let since = Instant::now();
        let found = place.replay(name, file, &["--speed", &format!("{}", span / 1.5)]);
        // By construction: the last packet may not go before.
        assert!(since.elapsed().as_secs_f64() >= 1.5);
        assert!(place.maps(name) == place.maps("read"), "{name}");
        assert_eq!(found["ledger"], fast["ledger"]);
    }
}

/// Replays step by step, with so many lines of input; what is said.
fn step(place: &Workplace, name: &str, file: &str, step: &str, lines: usize) -> String {
    let output = Command::cargo_bin("lunarray")
        .unwrap()
        .args(["replay", file, "--map", &place.pipeline, "--out", &place.path(name), "--step", step])
        .write_stdin("\n".repeat(lines))
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    said
}

#[test]
fn steps_are_passes_or_times() {
    let place = Workplace::new();
    let [plain, coded] = ["packets", "cadu"].map(|format| place.downlink(format));
    place.replay("read", &plain, &[]);
    let bytes = std::fs::read(&plain).unwrap();
    let packets = packets_of(&bytes);
    let ends = |packet: &&Vec<u8>| PacketHeader::parse(packet).unwrap().kind == Kind::Housekeeping;
    let passes = packets.iter().filter(ends).count();
    assert!(passes > 4);
    // Three passes are what two steps give.
    let (mut left, mut three) = (3, Vec::new());
    for packet in &packets {
        if left > 0 {
            three.extend_from_slice(packet);
            left -= u32::from(ends(&packet));
        }
    }
    let cut = place.path("three");
    std::fs::write(&cut, three).unwrap();
    place.replay("three.out", &cut, &[]);
    for (name, file) in [("plain", &plain), ("coded", &coded)] {
        step(&place, name, file, "pass", passes);
        assert!(place.maps(name) == place.maps("read"), "{name}");
        let begun = format!("{name}.three");
        let said = step(&place, &begun, file, "pass", 2);
        assert_eq!(said.matches("Enter goes on").count(), 3, "{said}");
        assert!(place.maps(&begun) == place.maps("three.out"), "{name}");
    }
    // Steps of a tenth of the time, and a little more: nine marks on the way.
    let times = times(&plain);
    let every = (times.last().unwrap() - times[0]) / 9.5;
    let said = step(&place, "times", &plain, &format!("{every}s"), 100);
    let mut begun: Vec<u64> = times.iter().map(|time| ((time - times[0]) / every) as u64).collect();
    begun.dedup();
    assert_eq!(said.matches("Enter goes on").count(), begun.len() - 1, "{said}");
    assert!(place.maps("times") == place.maps("read"));
}

#[test]
fn places_that_cannot_be_are_told() {
    let place = Workplace::new();
    let out = place.path("out");
    let listen = |url: &str| complaint(&["replay", "--listen", url, "--out", &out]);
    for url in ["127.0.0.1:1", "tcp://::1:5", "tcp://host", "udp://127.0.0.1:1"] {
        assert!(listen(url).contains("expected tcp://HOST:PORT"), "{url}");
    }
    for url in ["tcp://0.0.0.0:0", "tcp://[::]:0"] {
        assert!(listen(url).contains("--allow-remote"), "{url}");
    }
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", taken.local_addr().unwrap());
    let said = listen(&url);
    assert!(said.contains(&format!("cannot listen on {url}")), "{said}");
    drop(taken);
    let send = |more: &[&str]| complaint(&[&["simulate", &place.pipeline, "--send", &url], more].concat());
    let said = send(&["--connect-s", "0.1"]);
    assert!(said.contains("--listen") && said.contains(&url), "{said}");
    let said = send(&["--set", "downlink.link.frame_loss=0.1"]);
    assert!(said.contains("--out"), "{said}");
    let said =
        complaint(&["replay", "--listen", &url, "--out", &out, "--set", "downlink.listen.idle_s_max=-1"]);
    assert!(said.contains("downlink.listen.idle_s_max = -1"), "{said}");
    // With --allow-remote it may.
    let ground =
        place.ground("remote", &["--listen", "tcp://0.0.0.0:0", "--allow-remote", "--idle-s", "0.2"]);
    let (status, said) = ground.end_without_summary();
    assert!(!status.success() && said.contains("no visibility could be used"), "{said}");
}

#[test]
fn a_receiver_that_leaves_is_told_with_what_was_sent() {
    let place = Workplace::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", listener.local_addr().unwrap());
    let receiver = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.read_exact(&mut [0; 1000]).unwrap();
    });
    let said = complaint(&["simulate", &place.pipeline, "--send", &url]);
    receiver.join().unwrap();
    assert!(said.contains("bytes had been sent") && said.contains(&url), "{said}");
}

#[test]
fn a_sender_waits_for_the_ground_to_start_and_keeps_to_its_rate() {
    let place = Workplace::new();
    let length = std::fs::metadata(place.downlink("packets")).unwrap().len();
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let url = format!("tcp://127.0.0.1:{port}");
    let rate = format!("{}", length as f64 / 1.5);
    let args = ["simulate", &place.pipeline, "--send", &url, "--connect-s", "60", "--bytes-per-s", &rate];
    let since = Instant::now();
    std::thread::scope(|scope| {
        let sender = scope.spawn(|| succeed(&args));
        std::thread::sleep(Duration::from_millis(700));
        let ground = place.ground("heard", &["--listen", &url, "--connections", "1"]);
        assert!(sender.join().unwrap().contains(&format!("took all {length} bytes")));
        assert!(since.elapsed().as_secs_f64() >= 1.5);
        ground.succeed();
    });
}
