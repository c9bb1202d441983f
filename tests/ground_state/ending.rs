//! Told to end: what was received is saved, and the next session goes on to the same bits.
#![cfg(unix)]

use std::path::Path;
use std::time::Duration;

use lunarray::downlink::DownlinkError;
use lunarray::ground::{Ground as Core, WAIT_BYTES};
use lunarray::pipeline::{ConfigSource, GroundSource, replay};
use lunarray::runtime::{Cancel, Flow, Outlet, Source, Stage};

use super::common::process::{end, output, signal, start, wait_until};
use super::{ENGINES, Ground, checkpoints};

/// A ground with the state `state`, at work in this process.
fn core(place: &Ground, state: &str, wait_bytes: u64, cancel: &Cancel) -> Core {
    let source = ConfigSource { file: Some(place.pipeline.clone().into()), ..ConfigSource::default() };
    let settings = source.load_ground().unwrap().ground(wait_bytes);
    let ground = Core::open(Path::new(&place.path(state)), &settings, u64::MAX).unwrap();
    ground.with_cancel(cancel, Duration::ZERO)
}

#[test]
fn what_arrives_after_an_interrupt_is_held_and_added_by_the_next_session() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.downlink();
        let bytes = std::fs::read(&file).unwrap();
        // As ever, with little room in the hold buffer, and with none.
        for wait_bytes in [WAIT_BYTES, 100_000, 0] {
            let session = |state: &str, parts: [&[u8]; 2]| {
                let cancel = Cancel::new();
                let mut ground = core(&place, state, wait_bytes, &cancel);
                let (outcome, mut out) = (ground.outcome(), Outlet::collect());
                ground.step(parts[0].to_vec(), &mut out).unwrap();
                cancel.cancel();
                ground.step(parts[1].to_vec(), &mut out).unwrap();
                ground.finish(&mut out).unwrap();
                outcome.ledger.balanced_report().unwrap()
            };
            let name = |name: &str| format!("{name}.{wait_bytes}");
            let whole = session(&name("whole"), [&bytes, &[]]);
            // Within a packet.
            let (before, after) = bytes.split_at(bytes.len() / 3 + 5);
            let cut = session(&name("cut"), [before, after]);
            assert_eq!(
                cut.sampled, whole.sampled,
                "{engine}: of what was received nothing is unaccounted for"
            );
            assert_eq!(cut.accumulated == whole.accumulated, wait_bytes == 0, "{engine} {wait_bytes}");
            let resumed = session(&name("cut"), [&[], &[]]);
            assert_eq!(resumed, whole, "{engine} {wait_bytes}");
            assert!(place.bytes(&name("cut")) == place.bytes(&name("whole")), "{engine} {wait_bytes}");
        }
    }
}

/// A source whose end is read before the run is cancelled, which the ground sees before it adds anything.
struct CancelledAtEnd {
    bytes: Vec<u8>,
    cancel: Cancel,
}

impl Source for CancelledAtEnd {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        self.cancel.cancel();
        out.push(std::mem::take(&mut self.bytes));
        Ok(Flow::Done)
    }
}

impl GroundSource for CancelledAtEnd {}

#[test]
fn an_interrupt_after_the_last_byte_was_read_is_one() {
    let place = Ground::new();
    let bytes = std::fs::read(place.downlink()).unwrap();
    let source = ConfigSource { file: Some(place.pipeline.clone().into()), ..ConfigSource::default() };
    let config = source.load_ground().unwrap();
    let session = |bytes: &[u8], cancel: Cancel| {
        let ground = core(&place, "state", WAIT_BYTES, &cancel);
        let source = CancelledAtEnd { bytes: bytes.to_vec(), cancel: cancel.clone() };
        replay(source, &config, ground, Path::new(&place.path("out")), &cancel, &mut |_| {})
    };
    let summary = session(&bytes, Cancel::new()).unwrap();
    assert!(summary.cancelled && summary.channels.is_empty());
    let sampled = summary.ledger.sampled;
    assert!(sampled > 0 && summary.ledger.accumulated == 0);
    let next = place.replay("state", &[], &["--wait-bytes", &WAIT_BYTES.to_string()]);
    assert_eq!((&next["cancelled"], &next["ledger"]["sampled"]), (&false.into(), &sampled.into()));
    assert!(next["ledger"]["accumulated"].as_u64() > Some(0));
}

#[test]
fn interrupted_at_any_moment_it_goes_on_to_the_same_bits() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.simulate("longer.ccsds", &["--set", "spacecraft.every_nth_window=100"]);
        let every = ["--checkpoint-every", "3000"];
        let since = std::time::Instant::now();
        place.replay("whole", &[&file], &every);
        let length = since.elapsed();
        let args = place.session("cut", &[&file], &every);
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        let (mut share, mut cut): (f64, u32) = (0.1, 0);
        for _ in 0..10 {
            let child = start(&args);
            share = (share + 0.618_034) % 1.0;
            std::thread::sleep(length.mul_f64(share));
            signal(&child, ["INT", "TERM"][cut as usize % 2]);
            let output = output(child);
            // Ended, told to end, or gone before it began.
            let code = output.status.code();
            let said = String::from_utf8_lossy(&output.stderr);
            assert!([None, Some(0), Some(130), Some(143)].contains(&code), "{code:?}: {said}");
            assert!(!said.contains("panicked"), "{said}");
            cut += u32::from(matches!(code, Some(130 | 143)));
        }
        place.replay("cut", &[&file], &every);
        assert!(place.bytes("cut") == place.bytes("whole"), "{engine}");
        assert!(place.maps("cut") == place.maps("whole"), "{engine}");
        eprintln!("{engine}: {cut} sessions were cut short");
    }
}

/// A session that waits for its file to grow, after it has received all of it.
fn waiting(place: &Ground, file: &str) -> std::process::Child {
    let args = place.session("state", &[file], &["--follow", "--checkpoint-every", "1000"]);
    let mut child = start(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let state = place.path("state");
    wait_until("a checkpoint that no other follows", || {
        assert!(child.try_wait().unwrap().is_none());
        let found = checkpoints(Path::new(&state));
        // A checkpoint takes milliseconds.
        std::thread::sleep(Duration::from_millis(if found.is_empty() { 0 } else { 1000 }));
        !found.is_empty() && found == checkpoints(Path::new(&state))
    });
    child
}

#[test]
fn a_state_that_is_moved_away_is_not_saved_elsewhere() {
    let place = Ground::new();
    let file = place.downlink();
    let (state, elsewhere) = (place.path("state"), place.path("elsewhere"));
    for (case, expected) in [
        ("moved", "was moved or removed"),
        ("replaced", "was moved and replaced"),
        ("unlocked", "has lost its lock"),
    ] {
        let child = waiting(&place, &file);
        match case {
            "unlocked" => std::fs::remove_file(Path::new(&state).join("lock")).unwrap(),
            _ => std::fs::rename(&state, &elsewhere).unwrap(),
        }
        if case == "replaced" {
            std::fs::create_dir(&state).unwrap();
        }
        let before = checkpoints(Path::new(if case == "unlocked" { &state } else { &elsewhere }));
        signal(&child, "TERM");
        let output = output(child);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(3), "{case}: {said}");
        assert!(said.contains(expected) && said.contains(&state), "{case}: {said}");
        let after = checkpoints(Path::new(if case == "unlocked" { &state } else { &elsewhere }));
        assert_eq!(before, after, "{case}");
        if case != "unlocked" {
            assert!(checkpoints(Path::new(&state)).is_empty(), "{case}");
            std::fs::remove_dir_all(&elsewhere).unwrap();
        }
        let _ = std::fs::remove_dir_all(&state);
    }
}

#[test]
fn sigterm_is_the_regular_end_of_a_session_that_follows() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("whole", &[&file], &[]);
    let mut child = waiting(&place, &file);
    signal(&child, "TERM");
    drop((child.stdout.take(), child.stderr.take()));
    assert_eq!(end(&mut child).0.code(), Some(0));
    place.replay("state", &[&file], &[]);
    assert!(place.bytes("state") == place.bytes("whole"));
}

#[test]
fn a_failure_says_by_its_code_of_which_sort_it_is() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("state", &[&file], &[]);
    let code = |state: &str, files: &[&str], more: &[&str]| place.output(state, files, more).status.code();
    // A configuration that does not fit, or cannot be read.
    assert_eq!(code("state", &[], &["--set", "map.nside=8"]), Some(2));
    assert_eq!(code("new", &[&file], &["--set", "map.nside=7"]), Some(2));
    // Data.
    let foreign = place.file("foreign", &[7; 5000]);
    assert_eq!(code("new", &[&foreign], &[]), Some(1));
    // The system: a folder that cannot be made, as a file is in its place.
    place.file("file", b"x");
    assert_eq!(code("file/state", &[&file], &[]), Some(3));
}

#[test]
fn a_state_that_is_nowhere_is_not_made_of_nothing() {
    let place = Ground::new();
    let said = String::from_utf8(place.output("nosuch", &[], &[]).stderr).unwrap();
    assert!(said.contains("no such state") && said.contains("nosuch"), "{said}");
    assert!(!Path::new(&place.path("nosuch")).exists());
    let (file, both) = (place.downlink(), place.path("both"));
    let said = super::common::workplace::fail(&[
        "replay",
        &file,
        "--state",
        &both,
        "--out",
        &format!("{both}/../both"),
    ]);
    assert!(said.contains("two folders") && !Path::new(&both).exists(), "{said}");
}
