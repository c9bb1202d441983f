//! Well-behaved stations: the maps equal those from files.

use super::*;

#[test]
fn through_a_socket_the_maps_are_those_of_a_file() {
    let place = Place::new();
    for format in ["packets", "cadu"] {
        let file = place.path(&format!("sent.{format}"));
        let ground = place.ground(&format!("{format}.heard"), &["--connections", "1"]);
        let simulate = ["simulate", place.pipeline(), "--format", format, "--out", &file];
        let said = succeed(&[&simulate[..], &["--send", &ground.url]].concat());
        let length = std::fs::metadata(&file).unwrap().len();
        assert!(said.contains(&format!("confirmed all {length} bytes")), "{said}");
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
    let place = Place::new();
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
            for (packet, ends) in packets.iter().zip(pass_ends(&packets)) {
                if pass % 2 == half {
                    bytes.extend_from_slice(packet);
                }
                pass += i32::from(ends);
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

#[test]
fn a_sender_cut_off_within_a_packet_is_counted_and_may_begin_again() {
    let place = Place::new();
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
fn interrupted_it_leaves_maps_of_what_was_sent() {
    let place = Place::new();
    let file = place.downlink("packets");
    let good = std::fs::read(&file).unwrap();
    // However busy the machine, the maps are made.
    let ground = place.ground("heard", &["--set", "runtime.grace_s=100000"]);
    let packets = packets_of(&good);
    let half: usize = packets.iter().take(packets.len() / 2).map(Vec::len).sum();
    assert_eq!(ground.send(&good[..half]), format!("taken {half} bytes\n"));
    // Another stays; when it is accepted is not reported.
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
    assert!(answer.contains("the ground ended its run"), "{answer}");
}

#[test]
fn sigterm_ends_it_with_a_checkpoint_of_all_that_it_has_confirmed() {
    let place = Place::new();
    let file = place.downlink("packets");
    let bytes = std::fs::read(&file).unwrap();
    place.replay("whole.out", &file, &["--state", &place.path("whole")]);
    // Nobody reads what it says.
    let mut ground = place.ground("cut.out", &["--state", &place.path("cut")]);
    drop(ground.child.stdout.take());
    assert_eq!(ground.send(&bytes), format!("taken {} bytes\n", bytes.len()));
    // At once: most of it is not in the sums yet.
    let killed = Process::new("kill").args(["-TERM", &ground.child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let (status, said) = ground.end_without_summary();
    assert_eq!(status.code(), Some(0), "{said}");
    // Without the file: the state has everything.
    let (out, state) = (place.path("resumed.out"), place.path("cut"));
    succeed(&["replay", "--map", place.pipeline(), "--out", &out, "--state", &state]);
    assert!(place.checkpoint("cut") == place.checkpoint("whole"));
}

#[test]
fn listening_ends_when_nobody_sends() {
    let place = Place::new();
    let file = place.downlink("cadu");
    let ground = place.ground("heard", &["--idle-s", "3"]);
    // Connections alone, or bytes without packets, do not keep it listening.
    let silent = ground.connect();
    ground.send(&std::fs::read(&file).unwrap());
    ground.wait_for("the sender closed it");
    let summary = ground.succeed();
    drop(silent);
    assert_eq!(summary["cancelled"], false);
    assert_eq!(summary["listening"]["ended"]["stopped"], 1);
}

#[test]
fn places_that_cannot_be_are_told() {
    let place = Place::new();
    let out = place.path("out");
    let listen = |url: &str| complaint(&["replay", "--listen", url, "--out", &out]);
    for url in ["127.0.0.1:1", "tcp://::1:5", "tcp://host", "sctp://127.0.0.1:1"] {
        assert!(listen(url).contains("expected tcp://HOST:PORT"), "{url}");
    }
    for url in ["tcp://0.0.0.0:0", "tcp://[::]:0", "udp://0.0.0.0:0"] {
        assert!(listen(url).contains("--allow-remote"), "{url}");
    }
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", taken.local_addr().unwrap());
    let said = listen(&url);
    assert!(said.contains(&format!("cannot listen on {url}")), "{said}");
    drop(taken);
    let send = |more: &[&str]| complaint(&[&["simulate", place.pipeline(), "--send", &url], more].concat());
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
    assert!(!status.success() && said.contains("no visibility of a pair could be used"), "{said}");
}

#[test]
fn a_receiver_that_leaves_is_told_with_what_was_sent() {
    let place = Place::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", listener.local_addr().unwrap());
    let receiver = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.read_exact(&mut [0; 1000]).unwrap();
    });
    let said = complaint(&["simulate", place.pipeline(), "--send", &url, "--connect-s", "1"]);
    receiver.join().unwrap();
    assert!(said.contains("closed the connection after") && said.contains(&url), "{said}");
    assert!(said.contains("more attempts in") && said.contains("--connect-s"), "{said}");
}

#[test]
fn a_sender_waits_for_the_ground_to_start_and_keeps_to_its_rate() {
    let place = Place::new();
    let length = std::fs::metadata(place.downlink("packets")).unwrap().len();
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let url = format!("tcp://127.0.0.1:{port}");
    let rate = format!("{}", length as f64 / 1.5);
    let args = ["simulate", place.pipeline(), "--send", &url, "--connect-s", "60", "--bytes-per-s", &rate];
    let since = Instant::now();
    std::thread::scope(|scope| {
        let sender = scope.spawn(|| succeed(&args));
        std::thread::sleep(Duration::from_millis(700));
        let ground = place.ground("heard", &["--listen", &url, "--connections", "1"]);
        assert!(sender.join().unwrap().contains(&format!("confirmed all {length} bytes")));
        assert!(since.elapsed().as_secs_f64() >= 1.5);
        ground.succeed();
    });
}

#[test]
fn a_sender_tries_a_busy_receiver_again_from_the_beginning() {
    let place = Place::new();
    let file = place.downlink("packets");
    let sent = std::fs::read(&file).unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", listener.local_addr().unwrap());
    let receiver = std::thread::spawn(move || {
        // Busy at once, busy after a part, and busy after everything.
        for bytes in [0, 10_000, usize::MAX] {
            let (mut stream, _) = listener.accept().unwrap();
            let mut taken = Vec::new();
            Read::by_ref(&mut stream).take(bytes as u64).read_to_end(&mut taken).unwrap();
            stream.write_all(b"busy: others\n").unwrap();
            stream.shutdown(Shutdown::Write).unwrap();
            let _ = stream.read_to_end(&mut Vec::new());
        }
        let (mut stream, _) = listener.accept().unwrap();
        let mut taken = Vec::new();
        stream.read_to_end(&mut taken).unwrap();
        stream.write_all(format!("taken {} bytes\n", taken.len()).as_bytes()).unwrap();
        taken
    });
    let said = succeed(&["simulate", place.pipeline(), "--send", &url, "--connect-s", "600"]);
    assert!(said.contains(&format!("confirmed all {} bytes", sent.len())), "{said}");
    assert!(receiver.join().unwrap() == sent, "not the whole downlink, once");
}

#[test]
fn a_receivers_answer_does_not_command_the_terminal() {
    let place = Place::new();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", listener.local_addr().unwrap());
    let receiver = std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.read_to_end(&mut Vec::new()).unwrap();
        stream.write_all("closed \u{1b}]0;owned\u{7}\u{9b}2J\rtaken\n".as_bytes()).unwrap();
    });
    let said = complaint(&["simulate", place.pipeline(), "--send", &url]);
    receiver.join().unwrap();
    assert!(said.contains("\\u{1b}]0;owned"), "{said}");
    assert!(said.chars().all(|c| c == '\n' || !c.is_control()), "{said:?}");
}
