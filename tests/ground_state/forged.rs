//! States that announce more than they hold, with checksums that are right.
#![cfg(target_os = "linux")] // Of those that tests run on, it alone limits the memory of one process.

use std::path::Path;
use std::process::Command;

use super::{Ground, checkpoints};

/// Address space of a process, KiB: sessions of this test take a third of it, threads and all.
const LIMIT_KIB: u64 = 2 << 20;

/// How the program ends that has no more memory than this, and what it says; memory that ran out is an abort, of no
/// code.
fn within_the_limit(args: &[String]) -> (Option<i32>, String) {
    let mut command = Command::new("sh");
    let limited = format!("ulimit -v {LIMIT_KIB} && exec \"$@\"");
    command.args(["-c", &limited, "sh"]).arg(assert_cmd::cargo::cargo_bin("lunarray")).args(args);
    // Stacks and arenas of as many threads as the machine has would tell of the machine.
    command.env("RAYON_NUM_THREADS", "2").env("MALLOC_ARENA_MAX", "2");
    let output = command.output().unwrap();
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

/// Writes bytes over those at a place of all checkpoints, and a checksum that holds.
fn forge(state: &str, at: impl Fn(&[u8]) -> usize, new: &[u8]) {
    for path in checkpoints(Path::new(state)) {
        let mut bytes = std::fs::read(&path).unwrap();
        let (at, body) = (at(&bytes), bytes.len() - 8);
        bytes[at..at + new.len()].copy_from_slice(new);
        let crc = crc_fast::checksum(crc_fast::CrcAlgorithm::Crc64Nvme, &bytes[..body]);
        bytes[body..].copy_from_slice(&crc.to_le_bytes());
        std::fs::write(path, bytes).unwrap();
    }
}

#[test]
fn memory_follows_what_a_state_holds_not_what_it_announces() {
    let place = Ground::new();
    let file = place.downlink();
    let again = place.session("state", &[&file], &[]);
    assert_eq!([within_the_limit(&again).0, within_the_limit(&again).0], [Some(0); 2]);

    // The pixel engine's head, behind its magic, version, kind and length: nside 64, of 9.7 GB.
    let nside = |bytes: &[u8]| bytes.windows(8).position(|eight| eight == b"LNRENGIN").unwrap() + 15;
    let good = place.bytes("state");
    assert_eq!(good[nside(&good)..][..4], 4_u32.to_le_bytes());
    forge(&place.path("state"), nside, &64_u32.to_le_bytes());
    let (code, said) = within_the_limit(&again);
    assert!(code == Some(1) && said.starts_with("error: checkpoint"), "{code:?} {said}");

    // The first list of the head: settings that take 4 GiB less 16 MiB.
    let announced = (u64::from(u32::MAX) - (16 << 20)) / size_of::<(String, String)>() as u64;
    forge(&place.path("state"), |_| 16, &[&[0xFD][..], &announced.to_le_bytes()].concat());
    let (code, said) = within_the_limit(&["gaps".to_owned(), place.path("state")]);
    assert!(code == Some(1) && said.contains("checkpoints can be used"), "{code:?} {said}");
}
