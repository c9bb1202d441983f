//! Coded downlinks through the commands: the same maps, and ledgers that close for any faults of the link.

use crate::common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use common::workplace::{Workplace, fail, json, maps, succeed};
use serde_json::Value;

/// Real geometry, one channel, few visibilities.
const SMALL: &str = r#"
name = "small"
seed = 7
[sky]
nside = 16
[spacecraft]
channels_hz = [3.0e6]
every_nth_window = 300
every_nth_integration = 2
baseline_wavelengths_max = 24.0
[map]
engine = 'pixel'
nside = 8
epsilon = 1e-4
[products]
pictures = false
"#;

/// The summary of a replay and its maps.
fn replay(place: &Workplace, downlink: &str) -> (Value, BTreeMap<PathBuf, Vec<u8>>) {
    let out = format!("{downlink}.out");
    let summary = json(&["replay", downlink, "--map", &place.pipeline, "--out", &out]);
    (summary, maps(&out))
}

fn lost(summary: &Value) -> u64 {
    let all = summary["ledger"]["lost"].as_array().unwrap();
    all.iter().map(|loss| loss["count"].as_u64().unwrap()).sum()
}

#[test]
fn coded_frames_give_the_maps_that_packets_give() {
    let place = Workplace::new(SMALL);
    let plain = place.simulate("plain.ccsds", &[]);
    let coded = place.simulate("coded.cadu", &["--format", "cadu"]);
    let (of_plain, maps) = replay(&place, &plain);
    let (of_coded, same) = replay(&place, &coded);
    assert!(maps == same);
    assert_eq!(of_plain["ledger"], of_coded["ledger"]);
    assert!(of_plain["reception"]["frames"].is_null());

    let inspected = [&plain, &coded].map(|file| json(&["inspect", file]));
    assert_eq!((&inspected[0]["format"], &inspected[1]["format"]), (&"packets".into(), &"cadu".into()));
    for key in ["packets", "visibilities", "baselines", "span", "ephemeris", "housekeeping"] {
        assert_eq!(inspected[0][key], inspected[1][key], "{key}");
    }
    let frames = &inspected[1]["reception"]["frames"];
    assert_eq!(frames["interleave"], 5);
    assert_eq!(frames["frames"].as_u64().unwrap() * 1279, std::fs::metadata(&coded).unwrap().len());
    assert!(succeed(&["inspect", &coded]).contains("sound: no gaps"));

    // One wrong bit in ten thousand: not a byte of the maps differs.
    let noisy = place.path("noisy.cadu");
    succeed(&["corrupt", &coded, "--out", &noisy, "--bit-error-rate", "1e-4"]);
    assert!(maps == replay(&place, &noisy).1);
    assert!(json(&["inspect", &noisy])["reception"]["frames"]["bytes_corrected"].as_u64().unwrap() > 100);

    // Both in one command: what is in the second has come, in either order.
    for files in [[&plain, &coded], [&coded, &plain]] {
        let out = place.path("both");
        let both = json(&["replay", files[0], files[1], "--map", &place.pipeline, "--out", &out]);
        assert_eq!(both["ledger"], replay(&place, &plain).0["ledger"]);
        assert!(maps == common::workplace::maps(&out));
    }
}

#[test]
fn a_bad_link_is_accounted_for() {
    let place = Workplace::new(SMALL);
    for format in ["packets", "cadu"] {
        let sound = place.path(&format!("sound.{format}"));
        let bad = place.path(&format!("bad.{format}"));
        succeed(&["simulate", &place.pipeline, "--out", &sound, "--format", format]);
        let faults =
            ["downlink.link.frame_loss=0.02", "downlink.link.duplicate=0.1", "downlink.link.pass_cut=0.1"];
        let set: Vec<&str> = faults.iter().flat_map(|fault| ["--set", *fault]).collect();
        let simulate = ["simulate", &place.pipeline, "--out", &bad, "--format", format];
        succeed(&[&simulate[..], &set].concat());
        // The same link between files does the same.
        let again = place.path(&format!("again.{format}"));
        let corrupt = ["corrupt", &sound, "--out", &again, "--seed", "7"];
        let truth = json(
            &[&corrupt[..], &["--frame-loss", "0.02", "--duplicate", "0.1", "--pass-cut", "0.1"]].concat(),
        );
        assert!(std::fs::read(&bad).unwrap() == std::fs::read(&again).unwrap());
        let written: Value =
            serde_json::from_slice(&std::fs::read(format!("{bad}.truth.json")).unwrap()).unwrap();
        assert_eq!(written, truth);
        assert!(!Path::new(&format!("{sound}.truth.json")).exists());

        // The ledger counts what does not arrive as lost, and closes, or the command fails.
        let (of_sound, _) = replay(&place, &sound);
        let (of_bad, _) = replay(&place, &bad);
        let total = |summary: &Value, key: &str| summary["ledger"][key].as_u64().unwrap();
        assert_eq!(lost(&of_sound), 0);
        assert!(lost(&of_bad) > 0 && total(&of_bad, "accumulated") > 0);
        let range = |range: &Value| range["to"].as_u64().unwrap() - range["from"].as_u64().unwrap() + 1;
        let packets_lost: u64 = truth["packets_lost"].as_array().unwrap().iter().map(range).sum();
        let kinds = ["instrument", "ephemeris", "visibilities", "housekeeping"];
        let of_kinds = |summary: &Value, count: &str| -> u64 {
            kinds.iter().map(|kind| summary["reception"][kind][count].as_u64().unwrap()).sum()
        };
        assert_eq!(of_kinds(&of_bad, "packets") + packets_lost, of_kinds(&of_sound, "packets"));
    }
}

/// A command in the background, and its output at the end.
fn replay_of(place: &Workplace, file: &str, out: &str, more: &[&str]) -> std::process::Child {
    let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
    command.args(["replay", file, "--map", &place.pipeline, "--out", &place.path(out), "--json"]).args(more);
    command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped()).spawn().unwrap()
}

#[cfg(unix)]
#[test]
fn a_pipe_is_read_from_its_first_byte() {
    let place = Workplace::new(SMALL);
    for (name, format) in [("plain.ccsds", "packets"), ("coded.cadu", "cadu")] {
        let file = place.simulate(name, &["--format", format]);
        let (whole, _) = replay(&place, &file);
        let pipe = place.path(&format!("{name}.pipe"));
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        let child = replay_of(&place, &pipe, "piped", &[]);
        std::fs::write(&pipe, std::fs::read(&file).unwrap()).unwrap();
        let output = child.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let piped: Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!(piped["ledger"], whole["ledger"]);
    }
}

#[test]
fn a_followed_file_has_the_format_of_those_before_it_and_stays_the_same_file() {
    let place = Workplace::new(SMALL);
    let plain = place.simulate("plain.ccsds", &[]);
    let coded = place.simulate("coded.cadu", &["--format", "cadu"]);
    let follow = ["--follow", "--idle-s", "1"];
    let both = ["replay", &plain, &coded, "--map", &place.pipeline, "--out", &place.path("both")];
    assert!(fail(&[&both[..], &follow].concat()).contains("different formats"));

    let bytes = std::fs::read(&plain).unwrap();
    let growing = place.file("growing", &bytes[..bytes.len() / 2]);
    let child = replay_of(&place, &growing, "followed", &["--follow", "--idle-s", "60s"]);
    // It has read the file a moment after it made a folder. Cut earlier, the file would only be short, and not shrink
    // while it is read: give it time.
    while !Path::new(&place.path("followed")).exists() {
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    std::thread::sleep(std::time::Duration::from_secs(2));
    std::fs::write(&growing, &bytes[..bytes.len() / 4]).unwrap();
    let output = child.wait_with_output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("truncated or replaced"), "{said}");
}

#[test]
fn a_sound_file_is_not_written_over_by_its_damaged_self() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("plain.ccsds", &[]);
    let before = std::fs::read(&file).unwrap();
    let said = fail(&["corrupt", &file, "--out", &file, "--frame-loss", "0.5"]);
    assert!(said.contains("read as an input"), "{said}");
    assert!(std::fs::read(&file).unwrap() == before);
}

#[test]
fn a_downlink_of_any_number_of_channels_needs_no_map_file() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("plain.ccsds", &[]);
    let out = place.path("default");
    let summary =
        json(&["replay", &file, "--out", &out, "--set", "map.nside=4", "--set", "products.pictures=false"]);
    assert_eq!(summary["channels"][0]["diagnostics"]["epsilon"], 1e-4);
}
