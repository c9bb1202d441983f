//! A long life: three stations that lose packets and connections, and a ground that is killed again and again.
//!
//! By hand, a year and more of passes: LUNARRAY_SOAK_WINDOWS is the thinning of the windows (default 60; 5 gives some 1000
//! passes), LUNARRAY_SOAK_DISK names a folder of a small file system, which is then filled and emptied on the way.

use std::path::Path;

use lunarray::units::{StreamKind, random_stream};
use rand::RngExt;

use super::*;

/// Share of packets that a station misses.
const LOSS: f64 = 0.3;
const STATIONS: u64 = 3;
/// Sessions that end by force before the last one.
const SESSIONS: u64 = 8;

/// What a station heard, in pieces that it sends over one connection each.
fn recording(packets: &[Vec<u8>], station: u64) -> Vec<Vec<u8>> {
    let mut random = random_stream(11, StreamKind::Probe, [station, 0]);
    // The first packet describes the instrument.
    let heard: Vec<&Vec<u8>> = packets
        .iter()
        .enumerate()
        .filter(|(k, _)| *k == 0 || !random.random_bool(LOSS))
        .map(|(_, p)| p)
        .collect();
    let length = heard.len().div_ceil(40);
    heard
        .chunks(length)
        .map(|piece| piece.iter().flat_map(|packet| packet.iter().copied()).collect())
        .collect()
}

/// Sends the pieces one by one, cuts some off within a packet, and begins again whenever the connection or the ground
/// is gone, until `over`.
fn keep_sending(pieces: &[Vec<u8>], station: u64, url: &Mutex<String>, over: &AtomicBool) {
    let mut random = random_stream(12, StreamKind::Probe, [station, 0]);
    let mut next = 0;
    while next < pieces.len() && !over.load(Ordering::Relaxed) {
        let piece = &pieces[next];
        let is_cut = random.random_bool(0.2);
        let bytes = if is_cut { &piece[..random.random_range(0..piece.len())] } else { &piece[..] };
        let address = url.lock().unwrap().strip_prefix("tcp://").unwrap().to_owned();
        let sent = TcpStream::connect(address).and_then(|mut stream| {
            stream.write_all(bytes)?;
            stream.shutdown(Shutdown::Write)?;
            let mut answer = String::new();
            stream.read_to_string(&mut answer).map(|_| answer)
        });
        let confirmed = sent.is_ok_and(|answer| answer == format!("taken {} bytes\n", bytes.len()));
        next += usize::from(confirmed && !is_cut);
        std::thread::sleep(Duration::from_millis(random.random_range(5..60)));
    }
}

/// Memory that a process holds, bytes; `None` when it has ended.
fn resident(process: u32) -> Option<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).ok()?;
    let line = status.lines().find(|line| line.starts_with("VmRSS:"))?;
    Some(1024 * line.split_whitespace().nth(1)?.parse::<u64>().ok()?)
}

/// A file that fills the small file system, until it is dropped.
struct Ballast(PathBuf);

impl Ballast {
    fn new(folder: &Path) -> Self {
        let path = folder.join("ballast");
        let mut file = std::fs::File::create(&path).unwrap();
        while file.write_all(&[0; 4096]).is_ok() {}
        Self(path)
    }
}

impl Drop for Ballast {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

#[test]
fn lossy_stations_and_kills_leave_the_bits_of_what_anyone_heard() {
    let place = Place::new();
    let windows = std::env::var("LUNARRAY_SOAK_WINDOWS").unwrap_or_else(|_| "60".to_owned());
    let disk = std::env::var("LUNARRAY_SOAK_DISK").ok();
    let thinned = format!("spacecraft.every_nth_window={windows}");
    let file = place.workplace.simulate("year.ccsds", &["--set", &thinned]);
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let recordings: Vec<Vec<Vec<u8>>> = (0..STATIONS).map(|station| recording(&packets, station)).collect();
    let anyone = place.path("anyone.ccsds");
    std::fs::write(&anyone, recordings.iter().flatten().flatten().copied().collect::<Vec<u8>>()).unwrap();
    place.replay("anyone.out", &anyone, &["--state", &place.path("anyone")]);

    let state = disk.as_ref().map_or_else(|| place.path("state"), |folder| format!("{folder}/state"));
    let session = |number: u64, more: &[&str]| {
        let fixed = ["--state", state.as_str(), "--checkpoint-every", "500"];
        place.ground(&format!("out.{number}"), &[&fixed, more].concat())
    };
    let mut random = random_stream(13, StreamKind::Probe, [0, 0]);
    let mut memory = Vec::new();
    let first = session(0, &[]);
    let url = Mutex::new(first.url.clone());
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for (station, pieces) in recordings.iter().enumerate() {
            let (url, over) = (&url, &over);
            scope.spawn(move || keep_sending(pieces, station as u64, url, over));
        }
        let mut ground = Some(first);
        for number in 0..SESSIONS {
            let mut current = ground.take().unwrap_or_else(|| session(number, &[]));
            url.lock().unwrap().clone_from(&current.url);
            let ballast =
                disk.as_ref().filter(|_| number % 2 == 1).map(|folder| Ballast::new(Path::new(folder)));
            let until = Instant::now() + Duration::from_millis(random.random_range(300..2500));
            let mut peak = 0;
            while Instant::now() < until {
                peak = peak.max(resident(current.child.id()).unwrap_or(0));
                std::thread::sleep(Duration::from_millis(50));
            }
            memory.push(peak);
            if number % 3 == 2 {
                let process = current.child.id().to_string();
                assert!(Process::new("kill").args(["-TERM", &process]).status().unwrap().success());
            } else {
                current.child.kill().unwrap();
            }
            drop(ballast);
            let (_, said) = current.end_without_summary();
            assert!(!said.contains("panicked"), "{said}");
        }
        over.store(true, Ordering::Relaxed);
    });

    // A station knows only what the ground took, not what it saved: everything once more.
    let last = session(SESSIONS, &["--connections", "3"]);
    std::thread::scope(|scope| {
        for pieces in &recordings {
            let last = &last;
            scope.spawn(move || last.send(&pieces.concat()));
        }
    });
    let process = last.child.id();
    memory.extend(resident(process));
    let summary = last.succeed();
    let read = place.replay("again.out", &anyone, &["--state", &place.path("anyone")]);
    assert_eq!(summary["ledger"], read["ledger"]);
    assert_closed(&summary["reception"]);
    assert!(place.maps(&format!("out.{SESSIONS}")) == place.maps("again.out"));
    eprintln!("{} packets, {} sessions; memory of each, bytes: {memory:?}", packets.len(), SESSIONS + 1);
    // Flat: what is kept for each packet and the buffers of three connections, not the bytes that passed.
    let (first, most) = (memory[..3].iter().max().unwrap(), memory.iter().max().unwrap());
    let bytes_a_packet = 200;
    assert!(*most < first + bytes_a_packet * packets.len() as u64 + (48 << 20), "{memory:?}");
}
