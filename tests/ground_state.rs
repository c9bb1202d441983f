//! A ground that remembers: every packet once, whatever comes twice, late, or is ended by force.
#![allow(clippy::unwrap_used)] // Also in the helpers.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Child, Command as Process, Stdio};
use std::time::{Duration, Instant};

use assert_cmd::Command;
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

/// Less than the downlink holds, so that packets are applied on the way and not all at the end.
const WAIT_BYTES: &str = "100000";

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

    fn downlink(&self) -> String {
        let file = self.path("small.ccsds");
        succeed(&["simulate", &self.pipeline, "--out", &file]);
        file
    }

    /// Arguments of a session.
    fn session(&self, state: &str, files: &[&str], more: &[&str]) -> Vec<String> {
        let (out, state) = (self.path(&format!("{state}.out")), self.path(state));
        let fixed = ["--map", &self.pipeline, "--out", &out, "--state", &state, "--json"];
        let wait = ["--wait-bytes", WAIT_BYTES];
        let wait = if more.contains(&"--wait-bytes") { &[] } else { wait.as_slice() };
        let all = [&["replay"], files, &fixed, wait, more].concat();
        all.into_iter().map(str::to_owned).collect()
    }

    fn replay(&self, state: &str, files: &[&str], more: &[&str]) -> Value {
        let args = self.session(state, files, more);
        serde_json::from_str(&succeed(&args.iter().map(String::as_str).collect::<Vec<_>>())).unwrap()
    }

    /// The newest checkpoint of a state.
    fn newest(&self, state: &str) -> PathBuf {
        checkpoints(Path::new(&self.path(state))).pop().unwrap()
    }

    fn bytes(&self, state: &str) -> Vec<u8> {
        std::fs::read(self.newest(state)).unwrap()
    }
}

fn checkpoints(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    found.retain(|path| path.extension().is_some_and(|extension| extension == "lunarray"));
    found.sort();
    found
}

fn run(args: &[&str]) -> std::process::Output {
    Command::cargo_bin("lunarray").unwrap().args(args).output().unwrap()
}

fn succeed(args: &[&str]) -> String {
    let output = run(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8(output.stderr).unwrap());
    String::from_utf8(output.stdout).unwrap()
}

fn maps(folder: &str, place: &Workplace) -> Vec<Vec<u8>> {
    let channel = |name: &str| Path::new(&place.path(folder)).join(name).join("map.fits");
    let mut names: Vec<PathBuf> = std::fs::read_dir(place.path(folder))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.is_dir())
        .collect();
    names.sort();
    assert_eq!(names.len(), 2);
    names.iter().map(|name| std::fs::read(channel(name.to_str().unwrap())).unwrap()).collect()
}

#[test]
fn what_comes_twice_or_in_disorder_leaves_no_trace() {
    let place = Workplace::new();
    let file = place.downlink();
    let once = place.replay("once", &[&file], &[]);
    assert!(once["ledger"]["accumulated"].as_u64().unwrap() > 1000);
    // The maps are those of a ground without a memory.
    let plain = place.path("plain.out");
    succeed(&["replay", &file, "--map", &place.pipeline, "--out", &plain]);
    assert!(maps("once.out", &place) == maps("plain.out", &place));

    let bad = place.path("bad.ccsds");
    let faults = ["--duplicate", "0.1", "--reorder", "0.2", "--seed", "5"];
    succeed(&[&["corrupt", file.as_str(), "--out", &bad], faults.as_slice()].concat());
    let disordered = place.replay("disordered", &[&bad], &[]);
    assert!(disordered["reception"]["visibilities"]["duplicates"].as_u64().unwrap() > 0);
    assert!(place.bytes("disordered") == place.bytes("once"), "doubles and disorder left a trace");
    assert_eq!(disordered["ledger"], once["ledger"]);

    let again = place.replay("once", &[&bad, &file], &[]);
    assert_eq!(again["ledger"], once["ledger"]);
    assert!(place.bytes("disordered") == place.bytes("once"), "a second session left a trace");
    assert!(maps("once.out", &place) == maps("plain.out", &place));
}

#[test]
fn killed_at_any_moment_it_goes_on_to_the_same_bits() {
    let place = Workplace::new();
    let file = place.path("longer.ccsds");
    succeed(&["simulate", &place.pipeline, "--out", &file, "--set", "spacecraft.every_nth_window=75"]);
    let every = ["--checkpoint-every", "300"];
    let since = Instant::now();
    place.replay("whole", &[&file], &every);
    let session = since.elapsed();
    let whole = place.bytes("whole");
    let binary = assert_cmd::cargo::cargo_bin("lunarray");
    let args = place.session("killed", &[&file], &every);
    let start = || -> Child {
        let mut command = Process::new(&binary);
        command.args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
    };
    let kills: u32 = std::env::var("LUNARRAY_KILLS").map_or(20, |text| text.parse().unwrap());
    let (mut killed, mut resumed) = (0, 0);
    let mut share: f64 = 0.1;
    while killed < kills {
        let mut child = start();
        // Moments spread evenly over the length of a session, in golden steps.
        share = (share + 0.618_034) % 1.0;
        std::thread::sleep(session.mul_f64(share));
        let ended = child.try_wait().unwrap().is_some();
        child.kill().unwrap();
        child.wait().unwrap();
        killed += u32::from(!ended);
        resumed += u32::from(!checkpoints(Path::new(&place.path("killed"))).is_empty());
        if ended {
            // It came to its end: that has to be right too; then from the beginning.
            assert!(place.bytes("killed") == whole);
            std::fs::remove_dir_all(place.path("killed")).unwrap();
        }
    }
    place.replay("killed", &[&file], &every);
    assert!(place.bytes("killed") == whole, "after {killed} kills, {resumed} sessions with a checkpoint");
    assert!(maps("killed.out", &place) == maps("whole.out", &place));
    eprintln!("{killed} kills; {resumed} sessions left or found a checkpoint");
}

#[test]
fn a_damaged_checkpoint_is_told_and_the_one_before_used() {
    let place = Workplace::new();
    let file = place.downlink();
    let every = ["--checkpoint-every", "2000"];
    place.replay("state", &[&file], &every);
    let good = place.bytes("state");
    let places = [0, 9, 17, 200, good.len() / 2, good.len() - 9, good.len() - 1];
    for at in places {
        let mut bad = good.clone();
        bad[at] ^= 0x20;
        let path = place.newest("state");
        std::fs::write(&path, bad).unwrap();
        let args = place.session("state", &[&file], &every);
        let output = run(&args.iter().map(String::as_str).collect::<Vec<_>>());
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "byte {at}: {said}");
        let name = path.file_name().unwrap().to_str().unwrap();
        assert!(said.contains(name) && said.contains("going on from the one before"), "byte {at}: {said}");
        assert!(place.bytes("state") == good, "byte {at}");
    }
    // With none that holds, it does not silently begin anew.
    for path in checkpoints(Path::new(&place.path("state"))) {
        std::fs::write(path, b"nothing").unwrap();
    }
    let args = place.session("state", &[&file], &every);
    let output = run(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("none of its 2 checkpoints holds"), "{said}");
}

#[test]
fn a_state_of_other_settings_is_refused() {
    let place = Workplace::new();
    let file = place.downlink();
    place.replay("state", &[&file], &[]);
    // What is made of the sums may change: no file is needed.
    place.replay("state", &[], &["--set", "map.epsilon=1e-3"]);
    let args = place.session("state", &[&file], &["--set", "map.nside=8"]);
    let output = run(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success());
    assert!(said.contains("map.nside = 4") && said.contains("expected 8"), "{said}");
}

#[test]
fn packets_that_come_before_the_instrument_are_kept() {
    let place = Workplace::new();
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

/// A file without the visibility packets of these counts.
fn leave_out(file: &str, counts: std::ops::Range<u64>) -> Vec<u8> {
    let bytes = std::fs::read(file).unwrap();
    let (mut rest, mut kept) = (bytes.as_slice(), Vec::new());
    while let [a, b, c, d, high, low, ..] = *rest {
        let (packet, after) = rest.split_at(7 + usize::from(u16::from_be_bytes([high, low])));
        let (apid, count) = (u16::from_be_bytes([a, b]) & 0x7FF, u16::from_be_bytes([c, d]) & 0x3FFF);
        if apid != 0x103 || !counts.contains(&u64::from(count)) {
            kept.extend_from_slice(packet);
        }
        rest = after;
    }
    kept
}

fn gaps(path: &str) -> Value {
    serde_json::from_str(&succeed(&["gaps", path, "--json"])).unwrap()
}

fn total(gaps: &Value, key: &str) -> f64 {
    gaps["channels"].as_array().unwrap().iter().map(|channel| channel[key].as_f64().unwrap()).sum()
}

#[test]
fn gaps_are_told_in_packets_and_in_integration_time() {
    let place = Workplace::new();
    let file = place.downlink();
    assert_eq!(gaps(&file)["gaps"].as_array().unwrap().len(), 0);
    let bad = place.path("bad.ccsds");
    std::fs::write(&bad, leave_out(&file, 21..40)).unwrap();
    let found = gaps(&bad);
    assert_eq!(found["gaps"].as_array().unwrap().len(), 1);
    let gap = &found["gaps"][0];
    assert_eq!([&gap["apid"], &gap["from"], &gap["to"]], [0x103, 21, 39]);
    // What is received and what is missing are together what was sent, as well as passes resemble each other: the
    // formation breathes, and with it the number of integrations short enough for a baseline.
    let sent = total(&gaps(&file), "integration_s");
    let (received, missing) = (total(&found, "integration_s"), total(&found, "missing_integration_s"));
    let lost = sent - received;
    assert!(lost > 0.1 * sent && (missing / lost - 1.0).abs() < 0.3, "{missing} s told, {lost} s lost");

    // A state tells the same, and nothing once the packets have come.
    place.replay("state", &[&bad], &[]);
    assert_eq!(gaps(&place.path("state")), found);
    let picture = place.path("coverage.png");
    let table = succeed(&["gaps", &place.path("state"), "--picture", &picture]);
    assert!(table.contains("0x103"), "{table}");
    assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    let whole = place.replay("state", &[&file], &[]);
    assert_eq!(gaps(&place.path("state"))["gaps"].as_array().unwrap().len(), 0);
    let once = place.replay("once", &[&file], &[]);
    assert_eq!(whole["ledger"], once["ledger"]);
}

#[test]
fn a_growing_file_is_followed_to_the_same_bits() {
    let place = Workplace::new();
    let file = place.downlink();
    place.replay("once", &[&file], &[]);
    let bytes = std::fs::read(&file).unwrap();
    let growing = place.path("growing.ccsds");
    // Cut within packets, and nothing at first.
    std::fs::write(&growing, b"").unwrap();
    let args = place.session("followed", &[&growing], &["--follow", "--idle-s", "2"]);
    let mut command = Process::new(assert_cmd::cargo::cargo_bin("lunarray"));
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
fn states_of_different_passes_make_one() {
    let place = Workplace::new();
    let file = place.downlink();
    let once = place.replay("once", &[&file], &[]);
    // Two stations: either lacks what the other has heard, but for positions and what waits for company.
    let states: [(&str, _, &[&str]); 4] = [
        ("first", 41..1000, &[]),
        ("second", 0..41, &[]),
        ("all-first", 41..1000, &["--wait-bytes", "0"]),
        ("all-both", 0..30, &["--wait-bytes", "0"]),
    ];
    for (name, lost, more) in states {
        let path = place.path(&format!("{name}.ccsds"));
        std::fs::write(&path, leave_out(&file, lost)).unwrap();
        place.replay(name, &[&path], more);
    }
    let merge = |states: &[&str], out: &str| {
        let states: Vec<String> = states.iter().map(|state| place.path(state)).collect();
        let states: Vec<&str> = states.iter().map(String::as_str).collect();
        run(&[&["merge"], states.as_slice(), &["--map", &place.pipeline, "--out", &place.path(out)]].concat())
    };
    let output = merge(&["first", "second"], "merged");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    // Nothing is missing, nothing new in the file; the ledger is that of the whole.
    let merged = place.replay("merged", &[&file], &[]);
    assert_eq!(merged["ledger"], once["ledger"]);
    assert_eq!(gaps(&place.path("merged"))["gaps"].as_array().unwrap().len(), 0);
    for (merged, once) in
        merged["channels"].as_array().unwrap().iter().zip(once["channels"].as_array().unwrap())
    {
        // The same terms in another order.
        let mean = |summary: &Value| summary["mean_k"].as_f64().unwrap();
        assert!((mean(merged) / mean(once) - 1.0).abs() < 1e-9);
    }
    // The same packets twice, and a folder that is in use, are refused.
    let said = |output: std::process::Output| {
        assert!(!output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(said(merge(&["all-first", "all-both"], "more")).contains("count 30 is in the sums of both"));
    assert!(said(merge(&["first", "second"], "once")).contains("holds a state already"));
}
