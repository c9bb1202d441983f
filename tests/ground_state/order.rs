//! Doubles, disorder, files that grow: the same bits.

use std::io::Write;
use std::process::{Command, Stdio};
use std::time::Duration;

use lunarray::downlink::{HEADER_BYTES, PacketHeader, TRAILER_BYTES};

use super::common::workplace::{json, succeed};
use super::{ENGINES, Ground, identity, packets};

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
    // Some were flagged on the spacecraft.
    let flagged = |reason: &str| missed["ledger"]["flagged"][reason].as_u64().unwrap_or(0);
    let all = flagged("no ephemeris") + flagged("Earth in sight of a daughter");
    assert_eq!(Some(all), once["ledger"]["sampled"].as_u64());
    assert!(flagged("no ephemeris") > 0);
}

#[test]
fn a_plain_replay_waits_as_a_state_does() {
    let place = Ground::new();
    let file = place.downlink();
    let plain = |name: &str, file: &str, more: &[&str]| {
        let out = place.path(&format!("{name}.out"));
        json(&[&["replay", file, "--map", &place.pipeline, "--out", &out], more].concat())
    };
    let once = plain("once", &file, &[]);
    // The other way round: the spacecraft's counts and visibilities, then positions, then the description.
    let mut turned = packets(&file);
    turned.sort_by_key(|packet| std::cmp::Reverse(identity(packet).0));
    let turned = place.file("turned", &turned.concat());
    let waited = plain("turned", &turned, &[]);
    assert_eq!(waited["ledger"], once["ledger"]);
    assert!(place.maps("turned") == place.maps("once"));
    // It is as sound as the replay that is made of it.
    for file in [&file, &turned] {
        assert!(succeed(&["inspect", file]).contains("\nsound"));
        assert_eq!(json(&["inspect", file])["geometry"]["without_ephemeris"], 0);
    }
}

/// A packet with another count, its checks made anew.
fn counted(packet: &[u8], count: u64) -> Vec<u8> {
    let header = PacketHeader { count, ..PacketHeader::parse(packet).unwrap() };
    let mut bytes = header.to_bytes().to_vec();
    bytes.extend(&packet[HEADER_BYTES..packet.len() - TRAILER_BYTES]);
    let check = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc32Iscsi, &bytes) as u32;
    bytes.extend(check.to_be_bytes());
    bytes
}

#[test]
fn passes_of_both_sides_of_a_restart_may_come_in_any_order() {
    let place = Ground::new();
    let mut passes: Vec<Vec<Vec<u8>>> = Vec::new();
    for packet in packets(&place.downlink()) {
        match passes.last_mut() {
            Some(pass) if identity(&packet).0 != 0x101 => pass.push(packet),
            _ => passes.push(vec![packet]),
        }
    }
    // From the middle on, every kind is counted from 0 again.
    let middle = passes.len() / 2;
    let mut first = std::collections::BTreeMap::new();
    for packet in passes[middle..].iter_mut().flatten() {
        let (kind, count) = identity(packet);
        *packet = counted(packet, count - *first.entry(kind).or_insert(count));
    }
    let number = passes.len();
    assert!(number >= 6);
    let orders = [
        (0..number).collect::<Vec<_>>(),
        (middle..number).chain(0..middle).collect(),
        (0..number).rev().collect(),
        (0..number).map(|k| k * (number / 2 * 2 - 1) % number).collect(),
    ];
    let reach = ["--wait-bytes", "10000000"];
    for (k, order) in orders.iter().enumerate() {
        assert_eq!(order.iter().collect::<std::collections::BTreeSet<_>>().len(), number);
        let bytes: Vec<u8> = order.iter().flat_map(|pass| passes[*pass].concat()).collect();
        let (name, file) = (format!("order {k}"), place.file(&format!("{k}.ccsds"), &bytes));
        let told = place.replay(&name, &[&file], &reach);
        let counts = &told["reception"]["visibilities"];
        assert_eq!([&counts["duplicates"], &counts["missing"], &counts["restarts"]], [0, 0, 1], "{order:?}");
        assert!(place.bytes(&name) == place.bytes("order 0"), "{order:?}");
        // A ground without a memory knows them apart as well, and all say that there was a restart.
        let out = place.path("plain.out");
        let plain = succeed(&["replay", &file, "--map", &place.pipeline, "--out", &out]);
        assert!(place.maps("plain") == place.maps("order 0"), "{order:?}");
        let (contents, gaps) = (succeed(&["inspect", &file]), succeed(&["gaps", &place.path(&name)]));
        for text in [&plain, &contents, &gaps] {
            assert!(text.contains("restarted its packet counts"), "{text}");
        }
        let inspected = json(&["inspect", &file]);
        assert_eq!(inspected["reception"]["visibilities"]["duplicates"], 0, "{order:?}");
    }
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

#[test]
fn a_state_remembers_how_its_maps_were_made() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("state", &[&file], &[]);
    let made = place.maps("state");
    let (state, out) = (place.path("state"), place.path("state.out"));
    let again = |more: &[&str]| {
        json(&[&["replay", "--state", &state, "--out", &out], more].concat());
        place.maps("state")
    };
    // The pipeline has an epsilon of 1e-4, which is not the default.
    assert!(again(&[]) == made);
    assert!(again(&["--set", "map.epsilon=1e-3"]) != made);
    // The latest counts, and a choice of R does not meet an epsilon of another.
    let latest = place.maps("state");
    assert!(again(&[]) == latest);
    assert!(again(&["--set", "map.regulariser=data"]) != latest);
    let (regulariser, latest) = (place.maps("state"), again(&[]));
    assert!(latest == regulariser);
}
