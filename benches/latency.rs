//! How late the ground is: from a packet's arrival at its socket to its visibilities in the sums, and to a map on the page, at
//! multiples of the mission's rate, alone and with browsers that look on.
//!
//! `cargo bench --bench latency`. Each of the six runs is a `lunarray replay --listen --serve` to which thirty channels are sent over
//! loopback for `LUNARRAY_LATENCY_S` seconds (60). The rate of visibilities is that of the whole mission, 1.3 years without
//! thinning, times 1, 10 and 100. Packets have an eighth of the mission's visibilities, so there are eight times as many: more
//! to measure, and more work.
//!
//! - *to sums* is what the program measures: from the read of a packet's last byte to the end of the step that added it.
//! - *to disk* is measured there too: from the arrival of the packet after which maps were due to the end of the step that wrote one.
//! - *to page* is measured here: from the write of that packet to the end of the transfer of a map's pixels to a browser, which
//!   heard of it through `/events`. Maps of thirty channels are due at a time and are made one after the other.
//!
//! The aims are a p99 of 1 s to the sums and of 2 s to the page. At the mission's own rate maps are due every 17 minutes:
//! `LUNARRAY_LATENCY_MULTIPLES=1 LUNARRAY_LATENCY_BROWSERS=20 LUNARRAY_LATENCY_S=1200` waits for a set of them.

use std::collections::BTreeMap;
use std::error::Error;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::str::FromStr;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use lunarray::downlink::{PacketHeader, PacketKind};
use lunarray::pipeline::{ConfigSource, Plan};
use serde_json::Value;

type Failure = Box<dyn Error + Send + Sync>;

/// Multiples of the mission's rate.
const MULTIPLES: [f64; 3] = [1.0, 10.0, 100.0];
const BROWSERS: [usize; 2] = [0, 20];
/// Aims for the 99th percentile, s.
const TO_SUMS_S: f64 = 1.0;
const TO_PAGE_S: f64 = 2.0;

/// Thinning of the windows of the stream; maps are due after each.
const EVERY_NTH_WINDOW: f64 = 40.0;
/// Part of the mission's integrations in a packet.
const EVERY_NTH_INTEGRATION: f64 = 8.0;
/// Mission time between maps, as a part of that between windows of the stream, so that one is due at each window.
const SNAPSHOT_PART: f64 = 0.9;

/// Settings of the mission of thirty channels.
fn settings() -> Vec<String> {
    let channels: Vec<String> = (1..=30).map(|mhz| format!("{mhz}.0e6")).collect();
    vec![
        format!("spacecraft.channels_hz=[{}]", channels.join(",")),
        "spacecraft.every_nth_window=1".to_owned(),
        "spacecraft.every_nth_integration=1".to_owned(),
        "spacecraft.baseline_wavelengths_max=31.3".to_owned(),
        "sky.nside=8".to_owned(),
        "map.nside=8".to_owned(),
        "map.epsilon=1e-4".to_owned(),
        "products.pictures=false".to_owned(),
    ]
}

fn plan(more: &[String]) -> Result<Plan, Failure> {
    let overrides = [settings(), more.to_vec()].concat();
    Ok(Plan::new(ConfigSource { overrides, ..ConfigSource::default() }.load()?)?)
}

/// What is sent: packets one by one, and whether each is the first with visibilities of its window.
struct Stream {
    packets: Vec<(Vec<u8>, PacketKind)>,
    /// Visibilities in a packet of them, on average.
    visibilities_per_packet: f64,
}

impl Stream {
    /// Number of packets of visibilities.
    fn count(&self) -> usize {
        self.packets.iter().filter(|(_, kind)| *kind == PacketKind::Visibilities).count()
    }
}

/// A percentile of sorted times.
fn at(sorted: &[f64], quantile: f64) -> f64 {
    let rank = (quantile * sorted.len() as f64).ceil().max(1.0) as usize;
    sorted.get(rank - 1).copied().unwrap_or(f64::NAN)
}

fn split(mut bytes: &[u8]) -> Result<Vec<(Vec<u8>, PacketKind)>, Failure> {
    let mut packets = Vec::new();
    while !bytes.is_empty() {
        let header = PacketHeader::parse(bytes).ok_or("not a packet")?;
        let (packet, rest) = bytes.split_at(header.bytes);
        packets.push((packet.to_vec(), header.kind));
        bytes = rest;
    }
    Ok(packets)
}

/// A ground at work, which ends when dropped.
struct GroundProcess {
    child: Child,
    page: String,
    packets: String,
}

impl GroundProcess {
    fn start(map: &[String], out: &Path) -> Result<Self, Failure> {
        let mut command = Command::new(env!("CARGO_BIN_EXE_lunarray"));
        command.args([
            "replay",
            "--listen",
            "tcp://127.0.0.1:0",
            "--connections",
            "1",
            "--serve",
            "0",
            "--json",
            "--out",
        ]);
        command.arg(out);
        map.iter().for_each(|setting| {
            command.args(["--set", setting]);
        });
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn()?;
        let mut lines = BufReader::new(child.stderr.take().ok_or("no standard error")?).lines();
        let (mut page, mut packets) = (None, None);
        while page.is_none() || packets.is_none() {
            let line = lines.next().ok_or("the ground ended before it listened")??;
            let after =
                |start: &str| line.strip_prefix(start).map(|rest| rest.trim_end_matches('/').to_owned());
            page = page.or(after("serving on http://"));
            packets = packets.or(after("listening on tcp://"));
        }
        thread::spawn(move || lines.for_each(drop));
        let (page, packets) = (page.unwrap_or_default(), packets.unwrap_or_default());
        Ok(Self { child, page, packets })
    }

    /// Its summary, once it has ended.
    fn summary(mut self) -> Result<Value, Failure> {
        let mut text = String::new();
        self.child.stdout.take().ok_or("no standard output")?.read_to_string(&mut text)?;
        Ok(serde_json::from_str(&text)?)
    }
}

impl Drop for GroundProcess {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Sends at `packets_per_s` of visibilities for a time; returns when each window after the first began, and the packets sent.
fn send(
    stream: &Stream,
    to: &str,
    packets_per_s: f64,
    length_s: f64,
) -> Result<(Vec<Instant>, u64), Failure> {
    let mut socket = TcpStream::connect(to)?;
    socket.set_nodelay(true)?;
    let (mut began, mut is_first) = (Vec::new(), true);
    let (since, mut sent) = (Instant::now(), 0_u64);
    for (packet, kind) in &stream.packets {
        if *kind == PacketKind::Visibilities {
            let due_s = sent as f64 / packets_per_s;
            if due_s > length_s {
                break;
            }
            thread::sleep(Duration::from_secs_f64(due_s).saturating_sub(since.elapsed()));
            if std::mem::take(&mut is_first) {
                began.push(Instant::now());
            }
            sent += 1;
        }
        is_first |= *kind == PacketKind::Ephemeris;
        socket.write_all(packet)?;
    }
    if (sent as f64 / packets_per_s) < length_s {
        return Err(format!("the stream ends after {sent} packets of visibilities, too early").into());
    }
    // What comes after the last packet is not measured.
    thread::sleep(Duration::from_secs(2));
    began.drain(..1);
    Ok((began, sent))
}

/// One whole answer.
fn get(address: &str, path: &str) -> std::io::Result<Vec<u8>> {
    let mut stream = TcpStream::connect(address)?;
    write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// When maps were first seen whole, by channel and number of the snapshot.
type Seen = Arc<Mutex<BTreeMap<(u64, u64), Instant>>>;

/// A browser: reads events until the server ends. With `seen`, it fetches each new map, as the page does with that of its channel.
fn browse(address: &str, seen: Option<&Seen>, over: &AtomicBool) -> std::io::Result<()> {
    let mut stream = TcpStream::connect(address)?;
    write!(stream, "GET /events HTTP/1.1\r\nHost: {address}\r\n\r\n")?;
    let mut latest: BTreeMap<u64, u64> = BTreeMap::new();
    for line in BufReader::new(stream).lines() {
        let line = line?;
        let (Some(seen), Some(data)) = (seen, line.strip_prefix("data: {")) else { continue };
        let Ok(status) = serde_json::from_str::<Value>(&format!("{{{data}")) else { continue };
        for channel in status["channels"].as_array().into_iter().flatten() {
            let number = channel["held"].as_array().and_then(|held| held.last()?.as_u64());
            let (Some(channel), Some(number)) = (channel["channel"].as_u64(), number) else { continue };
            if latest.insert(channel, number) == Some(number) || over.load(Ordering::Relaxed) {
                continue;
            }
            get(address, &format!("/api/maps/{channel}/{number}.f32"))?;
            let mut seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
            seen.entry((channel, number)).or_insert_with(Instant::now);
        }
    }
    Ok(())
}

/// Percentiles of a stage's latencies, ms, as the program measures them.
fn latencies(summary: &Value, stage: &str) -> (u64, [f64; 3]) {
    let stages = summary["report"]["stages"].as_array();
    let found = stages.into_iter().flatten().find(|found| found["name"] == stage);
    let timing = found.map_or(&Value::Null, |found| &found["since_source"]);
    let of = |key: &str| 1e3 * timing[key].as_f64().unwrap_or(f64::NAN);
    (timing["count"].as_u64().unwrap_or(0), ["p50_s", "p99_s", "p999_s"].map(of))
}

fn three(values: [f64; 3]) -> String {
    values.map(|ms| if ms.is_finite() { format!("{ms:>9.2}") } else { format!("{:>9}", "-") }).join("")
}

/// Numbers of an environment variable, separated by commas, or those that are usual.
fn numbers<T: FromStr<Err: Error + Send + Sync + 'static> + Clone>(
    name: &str,
    usual: &[T],
) -> Result<Vec<T>, Failure> {
    let Ok(text) = std::env::var(name) else { return Ok(usual.to_vec()) };
    Ok(text.split(',').map(|part| part.trim().parse()).collect::<Result<_, _>>()?)
}

/// A piece of the mission that is long enough, of all `total` visibilities.
fn simulated_stream(folder: &Path, total: f64) -> Result<Stream, Failure> {
    let thinned = [
        format!("spacecraft.every_nth_window={EVERY_NTH_WINDOW}"),
        format!("spacecraft.every_nth_integration={EVERY_NTH_INTEGRATION}"),
    ];
    let file = folder.join("stream.ccsds");
    let mut simulate = Command::new(env!("CARGO_BIN_EXE_lunarray"));
    simulate.args(["simulate", "--out"]).arg(&file);
    for setting in settings().iter().chain(&thinned) {
        simulate.args(["--set", setting]);
    }
    let simulated = simulate.output()?;
    if !simulated.status.success() {
        return Err(String::from_utf8_lossy(&simulated.stderr).into());
    }
    let packets = split(&std::fs::read(&file)?)?;
    let count = packets.iter().filter(|(_, kind)| *kind == PacketKind::Visibilities).count();
    let sent = total / (EVERY_NTH_WINDOW * EVERY_NTH_INTEGRATION);
    Ok(Stream { packets, visibilities_per_packet: sent / count as f64 })
}

/// Delays, ms: the number of them and their quantiles.
struct Delays {
    to_sums: (u64, [f64; 3]),
    to_disk: (u64, [f64; 3]),
    to_page: [f64; 3],
}

/// Sends the stream to a ground that browsers watch.
fn measure(
    stream: &Stream,
    out: &Path,
    snapshots: &str,
    (packets_per_s, length_s): (f64, f64),
    browsers: usize,
) -> Result<Delays, Failure> {
    let kept = ["map.nside=8", "map.epsilon=1e-4", "products.pictures=false", snapshots];
    let ground = GroundProcess::start(&kept.map(str::to_owned), out)?;
    let (seen, over) = (Seen::default(), AtomicBool::new(false));
    let (address, to) = (ground.page.clone(), ground.packets.clone());
    let (sent, summary) = thread::scope(|scope| {
        for browser in 0..browsers {
            let (address, seen, over) = (&address, (browser == 0).then_some(&seen), &over);
            // It ends with the server, however that ends.
            scope.spawn(move || drop(browse(address, seen, over)));
        }
        let sent = send(stream, &to, packets_per_s, length_s);
        over.store(true, Ordering::Relaxed);
        (sent, ground.summary())
    });
    let ((began, sent), summary) = (sent?, summary?);
    let seen = seen.lock().unwrap_or_else(PoisonError::into_inner);
    let mut to_page: Vec<f64> = seen
        .iter()
        .filter_map(|(&(_, number), instant)| {
            let since = began.get(usize::try_from(number).ok()?.checked_sub(1)?)?;
            Some(1e3 * instant.duration_since(*since).as_secs_f64())
        })
        .collect();
    to_page.sort_by(f64::total_cmp);
    let to_page = [0.5, 0.99, 0.999].map(|quantile| at(&to_page, quantile));
    debug_assert!(sent > 0);
    Ok(Delays { to_sums: latencies(&summary, "ground"), to_disk: latencies(&summary, "publish"), to_page })
}

fn main() -> Result<(), Failure> {
    let length_s: f64 = std::env::var("LUNARRAY_LATENCY_S").map_or(Ok(60.0), |text| text.parse())?;
    let multiples = numbers("LUNARRAY_LATENCY_MULTIPLES", &MULTIPLES)?;
    let crowds = numbers("LUNARRAY_LATENCY_BROWSERS", &BROWSERS)?;
    // The mission: how many visibilities in which time.
    let mission = plan(&[])?;
    let cost = mission.cost();
    let total: f64 = cost.channels.iter().map(|channel| channel.visibilities_sent).sum();
    let mission_s = mission.config.spacecraft.duration_s;
    let per_s = total / mission_s;
    println!(
        "the mission: 30 channels, {:.2} years, {total:.3e} visibilities, {per_s:.1} a second",
        mission_s / 31_557_600.0
    );
    drop(mission);

    // A piece of it that is long enough.
    let folder = std::env::temp_dir().join(format!("lunarray-latency-{}", std::process::id()));
    std::fs::create_dir_all(&folder)?;
    let stream = simulated_stream(&folder, total)?;
    println!(
        "the stream: {} packets of {:.1} visibilities; {length_s} s a run; load {}",
        stream.count(),
        stream.visibilities_per_packet,
        std::fs::read_to_string("/proc/loadavg").unwrap_or_default().trim()
    );
    println!("all times in ms: p50, p99, p99.9; the ratio is that of the aim to the p99");
    println!(
        "{:>5} {:>9} {:>9} {:>8}  {:>6}{:>27} {:>7}  {:>5}{:>27}  {:>27} {:>7}",
        "rate",
        "packets/s",
        "vis./s",
        "browsers",
        "pieces",
        "to sums",
        "ratio",
        "maps",
        "to disk",
        "to page",
        "ratio"
    );
    let windows_s = EVERY_NTH_WINDOW * mission_s / cost.windows as f64;
    let snapshots = format!("map.snapshot_every_s={:.1}", SNAPSHOT_PART * windows_s);
    for multiple in multiples {
        for &browsers in &crowds {
            let out = folder.join(format!("out-{multiple}-{browsers}"));
            let packets_per_s = multiple * per_s / stream.visibilities_per_packet;
            let measured = measure(&stream, &out, &snapshots, (packets_per_s, length_s), browsers)?;
            let Delays { to_sums: (pieces, to_sums), to_disk: (maps, to_disk), to_page } = measured;
            let ratio = |aim_s: f64, [_, p99, _]: [f64; 3]| match p99.is_finite() {
                true => format!("{:>7.1}", 1e3 * aim_s / p99),
                false => format!("{:>7}", "-"),
            };
            println!(
                "{multiple:>5} {packets_per_s:>9.1} {:>9.0} {browsers:>8}  {pieces:>6}{} {}  {maps:>5}{}  {} {}",
                multiple * per_s,
                three(to_sums),
                ratio(TO_SUMS_S, to_sums),
                three(to_disk),
                three(to_page),
                ratio(TO_PAGE_S, to_page),
            );
        }
    }
    std::fs::remove_dir_all(&folder)?;
    Ok(())
}
