//! Doubles, disorder, files that grow: the same bits.

use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Duration;

use super::common::workplace::succeed;
use super::{ENGINES, Ground};

#[test]
fn what_comes_twice_or_in_disorder_leaves_no_trace() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.downlink();
        let once = place.replay("once", &[&file], &[]);
        assert!(once["ledger"]["accumulated"].as_u64().unwrap() > 1000);
        // The maps are those of a ground without a memory.
        let plain = place.path("plain.out");
        succeed(&["replay", &file, "--map", &place.pipeline, "--out", &plain]);
        assert!(place.maps("once") == place.maps("plain"), "{engine}");

        let bad = place.path("bad.ccsds");
        let faults = ["--duplicate", "0.1", "--reorder", "0.2", "--seed", "5"];
        succeed(&[&["corrupt", file.as_str(), "--out", &bad], faults.as_slice()].concat());
        let disordered = place.replay("disordered", &[&bad], &[]);
        assert!(disordered["reception"]["visibilities"]["duplicates"].as_u64().unwrap() > 0);
        assert!(
            place.bytes("disordered") == place.bytes("once"),
            "{engine}: doubles and disorder left a trace"
        );
        assert_eq!(disordered["ledger"], once["ledger"]);

        let again = place.replay("once", &[&bad, &file], &[]);
        assert_eq!(again["ledger"], once["ledger"]);
        assert!(place.bytes("disordered") == place.bytes("once"), "{engine}: a second session left a trace");
        assert!(place.maps("once") == place.maps("plain"), "{engine}");
    }
}

#[test]
fn a_pass_that_comes_last_of_all_leaves_no_trace() {
    let place = Ground::new();
    let file = place.downlink();
    // Snapshots on the way are others; they are no part of a state.
    let whole = ["--wait-bytes", "10000000", "--snapshot-every", "60d"];
    place.replay("once", &[&file], &whole);
    let packets = super::packets(&file);
    let third = packets.len() / 3;
    // The description first: nothing can be read without it.
    let parts = [&packets[..third], &packets[2 * third..], &packets[third..2 * third]];
    for (name, part) in ["first", "last", "middle"].iter().zip(parts) {
        let part = place.file(name, &part.concat());
        place.replay("late", &[&part], &whole);
    }
    assert!(place.bytes("late") == place.bytes("once"));
}

#[test]
fn visibilities_wait_for_their_positions() {
    let place = Ground::new();
    let file = place.downlink();
    let once = place.replay("once", &[&file], &[]);
    // All positions after everything else: within reach; out of reach they are missed.
    let (positions, others): (Vec<_>, Vec<_>) =
        super::packets(&file).into_iter().partition(|packet| super::identity(packet).0 == 0x102);
    let (others, positions) =
        (place.file("others", &others.concat()), place.file("positions", &positions.concat()));
    let reach = ["--wait-bytes", "10000000"];
    // Nothing can be made of it yet, which the command says.
    assert!(!place.output("waited", &[&others], &reach).status.success());
    let waited = place.replay("waited", &[&positions], &reach);
    assert_eq!(waited["ledger"], once["ledger"]);
    assert!(place.maps("waited") == place.maps("once"));
    assert!(!place.output("missed", &[&others, &positions], &["--wait-bytes", "0"]).status.success());
    let missed = std::fs::read(place.path("missed.out/summary.json")).unwrap();
    let missed: serde_json::Value = serde_json::from_slice(&missed).unwrap();
    assert_eq!(missed["ledger"]["flagged"]["no ephemeris"], once["ledger"]["sampled"]);
}

#[test]
fn packets_that_come_before_the_instrument_are_kept() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("whole", &[&file], &[]);
    // The description is the first packet; its length is in bytes 4 and 5, less 7.
    let bytes = std::fs::read(&file).unwrap();
    let length = 7 + usize::from(u16::from_be_bytes([bytes[4], bytes[5]]));
    let (description, rest) = bytes.split_at(length);
    let swapped = place.path("swapped.ccsds");
    std::fs::write(&swapped, [rest, description].concat()).unwrap();
    place.replay("swapped", &[&swapped], &[]);
    assert!(place.bytes("swapped") == place.bytes("whole"));
}

#[test]
fn a_growing_file_is_followed_to_the_same_bits() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("once", &[&file], &[]);
    let bytes = std::fs::read(&file).unwrap();
    let growing = place.path("growing.ccsds");
    // Cut within packets, and nothing at first.
    std::fs::write(&growing, b"").unwrap();
    let args = place.session("followed", &[&growing], &["--follow", "--idle-s", "2"]);
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
    let mut child = command.args(&args).stdout(Stdio::null()).spawn().unwrap();
    let mut out = std::fs::OpenOptions::new().append(true).open(&growing).unwrap();
    for part in bytes.chunks(bytes.len() / 5 + 7) {
        std::thread::sleep(Duration::from_millis(150));
        out.write_all(part).unwrap();
    }
    assert!(child.wait().unwrap().success());
    assert!(place.bytes("followed") == place.bytes("once"));
}
