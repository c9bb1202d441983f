//! Packets and frames in datagrams.

use std::net::UdpSocket;

use super::*;

/// Bytes of a coded frame with its marker.
const CADU_BYTES: usize = 1279;

fn send(url: &str, datagrams: &[&[u8]]) {
    let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
    let to = url.strip_prefix("udp://").unwrap();
    for some in datagrams.chunks(8) {
        for datagram in some {
            socket.send_to(datagram, to).unwrap();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn datagrams_of_packets_or_frames_give_the_maps_of_the_file() {
    for format in ["packets", "cadu"] {
        let place = Place::new();
        let file = place.downlink(format);
        let read = place.replay("read", &file, &[]);
        let bytes = std::fs::read(&file).unwrap();
        let packets = if format == "packets" { packets_of(&bytes) } else { Vec::new() };
        let whole: Vec<&[u8]> = match format {
            "packets" => packets.iter().map(Vec::as_slice).collect(),
            _ => bytes.chunks(CADU_BYTES).collect(),
        };
        let ground = place.ground("heard", &["--listen", "udp://127.0.0.1:0", "--idle-s", "3"]);
        // Bad ones, each of its own kind: no packet; half of one, which must not swallow the next; a marker alone.
        let bad: [&[u8]; 3] = [b"hello", &whole[0][..whole[0].len() / 2], &[0x1A, 0xCF, 0xFC, 0x1D]];
        send(&ground.url, &bad);
        // Three times, as nobody sends again what a busy machine has dropped.
        for _ in 0..3 {
            send(&ground.url, &whole);
        }
        let summary = ground.succeed();
        assert_eq!(summary["ledger"]["accumulated"], read["ledger"]["accumulated"]);
        assert!(place.maps("heard") == place.maps("read"));
        let counts = &summary["listening"]["datagrams"];
        let count = |key: &str| counts[key].as_u64().unwrap();
        let dropped = counts["dropped_by_system"].as_u64().unwrap_or(0);
        assert_eq!(count("received") + dropped, (bad.len() + 3 * whole.len()) as u64, "{counts}");
        assert!((2..=3).contains(&count("malformed")) && count("refused") == 0, "{counts}");
        assert_eq!(summary["listening"]["connections"], 0);
    }
}

#[test]
fn connections_and_datagrams_come_to_one_ground() {
    let place = Place::new();
    let file = place.downlink("packets");
    let read = place.replay("read", &file, &[]);
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let both = ["--listen", "tcp://127.0.0.1:0", "--listen", "udp://127.0.0.1:0", "--connections", "1"];
    let ground = place.ground("heard", &both);
    ground.wait_for("udp://");
    let said = ground.said.lock().unwrap().clone();
    let udp = said.lines().find_map(|line| line.strip_prefix("listening on udp")).unwrap();
    let (first, second) = packets.split_at(packets.len() / 2);
    let few: Vec<&[u8]> = second.iter().map(Vec::as_slice).collect();
    for _ in 0..2 {
        send(&format!("udp{udp}"), &few);
    }
    // The positions of what came before have come by the other way.
    let whole = [first.concat(), second.concat()].concat();
    assert_eq!(ground.send(&whole), format!("taken {} bytes\n", whole.len()));
    assert_eq!(ground.succeed()["ledger"]["accumulated"], read["ledger"]["accumulated"]);
    assert!(place.maps("heard") == place.maps("read"));
}

#[test]
fn datagrams_have_no_token_and_come_from_this_machine() {
    let place = Place::new();
    let out = place.path("out");
    // A supervisor does not start again what can never listen: exit code 2.
    let with = |more: &[&str]| {
        let output =
            lunarray(&[&["replay", "--map", place.pipeline(), "--out", &out, "--listen"], more].concat());
        assert_eq!(output.status.code(), Some(2), "{more:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(with(&["udp://0.0.0.0:0"]).contains("other machines may reach this address"));
    let stations = place.workplace.file("stations", b"malargue 0123456789abcdef\n");
    assert!(with(&["udp://127.0.0.1:0", "--stations", &stations]).contains("datagrams have no token"));
    assert!(with(&["udp://127.0.0.1:0", "--listen", "udp://127.0.0.1:0"]).contains("given twice"));
}

#[test]
fn a_simulation_writes_to_standard_output() {
    let place = Place::new();
    let file = place.downlink("packets");
    let output = Process::new(assert_cmd::cargo::cargo_bin("lunarray"))
        .args(["simulate", place.pipeline(), "--out", "-"])
        .output()
        .unwrap();
    assert!(output.status.success());
    assert!(output.stdout == std::fs::read(&file).unwrap());
    assert!(complaint(&["simulate", place.pipeline(), "--out", "-", "--json"]).contains("none of --json"));
}
