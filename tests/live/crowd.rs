//! Ten thousand who mean no good, at the page and at the port for packets, while a station sends.

use super::common::process::wait_until;
use super::serving::Served;
use super::*;

/// Connections to the page that are open at a time.
const CROWD: usize = 10_000;

/// Files that the test needs beside them.
const OTHER_FILES: usize = 1_000;

/// Connections to the port for packets.
const LOST_BROWSERS: usize = 1_000;

/// How much the server's memory may grow by the crowd: 128 places with two buffers of at most 16 KiB and a task each are 5 MB, the other
/// 9,872 are closed at once. A kilobyte kept for each of those would be 10 MB.
const CROWD_BYTES: u64 = 8 << 20;

/// And with the mission that is received meanwhile: threads, what is read for those who lose their way to its port, sums,
/// maps. A buffer of 16 KiB kept for each of the crowd would be 160 MB.
const GROWTH_BYTES: u64 = 24 << 20;

/// Raises the limit of open files of this process as far as it may; returns how many connections that allows.
fn connections_allowed() -> usize {
    let process = std::process::id().to_string();
    let wanted = format!("--nofile={}:", CROWD + OTHER_FILES);
    let _ = Process::new("prlimit").args(["--pid", &process, &wanted]).stderr(Stdio::null()).status();
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap();
    let line = limits.lines().find(|line| line.starts_with("Max open files")).unwrap();
    let files: usize = line.split_whitespace().nth(3).unwrap().parse().unwrap_or(usize::MAX);
    CROWD.min(files.saturating_sub(OTHER_FILES))
}

/// What each of the crowd sends: silence, halves, giants, nonsense, foreign names, paths that lead elsewhere, and
/// requests whose answers nobody reads.
fn requests(own: &str) -> Vec<Vec<u8>> {
    let get = |path: &str, host: &str| format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n").into_bytes();
    vec![
        Vec::new(),
        format!("GET / HTTP/1.1\r\nHost: {own}\r\n").into_bytes(),
        [format!("GET / HTTP/1.1\r\nHost: {own}\r\nX: ").into_bytes(), vec![b'x'; 20 << 10]].concat(),
        vec![0; 1000],
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03".to_vec(),
        b"GET / HTTP/9.9\r\n\r\n".to_vec(),
        format!("GET / HTTP/1.1\r\nHost: {own}\r\nOrigin: http://evil.example\r\nContent-Length: -1\r\n\r\n")
            .into_bytes(),
        get("/", "evil.example"),
        get("/../../../../etc/passwd", own),
        get("/api/maps/0/..%2f..%2fetc%2fpasswd", own),
        get("/page.js", own),
    ]
}

/// The server's resident memory, bytes: now, and the most so far.
fn memory(served: &Served) -> [u64; 2] {
    let status = std::fs::read_to_string(format!("/proc/{}/status", served.process())).unwrap();
    ["VmRSS:", "VmHWM:"].map(|key| {
        let line = status.lines().find(|line| line.starts_with(key)).unwrap();
        1024 * line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
    })
}

/// Sends one request of each kind at a time, and reads the answers.
fn send_all_kinds(address: &str, kinds: &[Vec<u8>]) {
    let send = |kind: &Vec<u8>| {
        let mut guest = TcpStream::connect(address).unwrap();
        let _ = guest.write_all(kind);
        let _ = guest.shutdown(Shutdown::Write);
        guest
    };
    let guests: Vec<TcpStream> = kinds.iter().map(send).collect();
    for mut guest in guests {
        let _ = guest.read_to_end(&mut Vec::new());
    }
}

/// Whether the server has closed a connection that does not block.
fn is_closed(guest: &mut TcpStream) -> bool {
    let mut bytes = [0; 4096];
    loop {
        match guest.read(&mut bytes) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(error) => return error.kind() != std::io::ErrorKind::WouldBlock,
        }
    }
}

#[test]
fn ten_thousand_bad_guests_cost_no_memory_and_no_bit() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let good = std::fs::read(&file).unwrap();
    let out = place.path("heard");
    let listen = ["replay", "--listen", "tcp://127.0.0.1:0", "--connections", "1", "--map", place.pipeline()];
    let served = Served::start(&[&listen[..], &["--out", &out, "--serve-after"]].concat());
    let packets = served.listening();
    for path in ["/", "/page.js", "/api/status", "/metrics", "/api/passes"] {
        served.get(path);
    }
    // One who came before them, and stays.
    let mut early = BufReader::new(TcpStream::connect(&served.address).unwrap());
    let request = format!("GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", served.address);
    early.get_mut().write_all(request.as_bytes()).unwrap();
    early.get_ref().set_read_timeout(Some(Duration::from_secs(120))).unwrap();
    let mut next_status = || {
        let mut line = String::new();
        while !line.starts_with("event: status") {
            line.clear();
            assert!(early.read_line(&mut line).unwrap() > 0, "the one who was there first was cut");
        }
    };
    next_status();

    let [before, _] = memory(&served);
    let count = connections_allowed();
    assert!(count >= 1000, "{count} connections are allowed here; that is no crowd");
    let kinds = requests(&served.address);
    let mut crowd = Vec::with_capacity(count);
    for k in 0..count {
        let mut guest = TcpStream::connect(&served.address).unwrap();
        // What is refused is closed at once, perhaps while they write.
        guest.set_nonblocking(true).unwrap();
        // The first take the places: those who read nothing of much, then all kinds in turn.
        let kind = &kinds[if k < 20 { kinds.len() - 1 } else { k % kinds.len() }];
        let bytes = if k < 20 { kind.repeat(400) } else { kind.clone() };
        let _ = guest.write(&bytes);
        crowd.push(guest);
    }
    next_status();
    let [during, _] = memory(&served);

    // Those who take the port for packets for a page; as many at a time as there are places.
    for _ in 0..LOST_BROWSERS / kinds.len() {
        send_all_kinds(&packets, &kinds);
    }
    // With all ten thousand still there, a station sends a mission.
    let answer = finish(TcpStream::connect(&packets).unwrap(), &good);
    assert_eq!(answer, format!("taken {} bytes\n", good.len()));
    // Somebody new is let in as soon as places are free, beside them.
    wait_until("an answer", || served.get("/healthz").text().contains("ended"));
    next_status();

    // Nobody of the crowd is still connected: the server has closed every one.
    for guest in &mut crowd {
        wait_until("the server to close a connection", || is_closed(guest));
    }
    wait_until("places", || served.metric("lunarray_http_connections") <= 2.0);
    let refused = served.metric("lunarray_http_refused_total");
    let [after, most] = memory(&served);
    println!(
        "{count} connections, {refused} refused; memory in MB: {:.1} before, {:.1} with all, {:.1} after, {:.1} at most",
        before as f64 / 1e6,
        during as f64 / 1e6,
        after as f64 / 1e6,
        most as f64 / 1e6
    );
    // 128 places, each free again after ten seconds at the earliest.
    assert!(refused >= 0.5 * count as f64, "{refused} of {count}");
    assert!(during < before + CROWD_BYTES, "{before} bytes before, {during} with all");
    assert!(most < before + GROWTH_BYTES, "{before} bytes before, {most} at most");

    // Each lost browser is counted, and none of what they sent is in a map.
    let status = served.json("/api/status");
    let listening = &status["listening"]["report"];
    let ended: u64 =
        listening["ended"].as_object().unwrap().values().map(|count| count.as_u64().unwrap()).sum();
    let came = (LOST_BROWSERS / kinds.len() * kinds.len() + 1) as u64;
    assert_eq!(ended + listening["refused"].as_u64().unwrap(), came, "{listening}");
    assert_eq!(status["ledger"]["unaccounted"], 0);
    assert!(place.maps("heard") == place.maps("read"));
    assert!(served.end().success());
}
