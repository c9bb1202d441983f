//! Coded downlinks through the commands: the same maps, and ledgers that close whatever the link did.
#![allow(clippy::unwrap_used)] // Also in the helpers.

use std::path::{Path, PathBuf};

use assert_cmd::Command;
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
nside = 8
epsilon = 1e-4
[products]
pictures = false
"#;

fn succeed(args: &[&str]) -> String {
    let output = Command::cargo_bin("lunarray").unwrap().args(args).output().unwrap();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8(output.stderr).unwrap());
    String::from_utf8(output.stdout).unwrap()
}

fn json(args: &[&str]) -> Value {
    serde_json::from_str(&succeed(&[args, &["--json"]].concat())).unwrap()
}

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

    /// The summary of a replay and its maps.
    fn replay(&self, downlink: &str) -> (Value, Vec<(PathBuf, Vec<u8>)>) {
        let out = format!("{downlink}.out");
        let summary = json(&["replay", downlink, "--map", &self.pipeline, "--out", &out]);
        let mut maps = Vec::new();
        let mut folders = vec![PathBuf::from(&out)];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else if path.extension().is_some_and(|ending| ending == "fits") {
                    let name = path.strip_prefix(&out).unwrap().to_owned();
                    maps.push((name, std::fs::read(&path).unwrap()));
                }
            }
        }
        maps.sort();
        assert!(!maps.is_empty());
        (summary, maps)
    }
}

fn lost(summary: &Value) -> u64 {
    let all = summary["ledger"]["lost"].as_array().unwrap();
    all.iter().map(|loss| loss["count"].as_u64().unwrap()).sum()
}

#[test]
fn coded_frames_give_the_maps_that_packets_give() {
    let place = Workplace::new();
    let (plain, coded) = (place.path("plain.ccsds"), place.path("coded.cadu"));
    succeed(&["simulate", &place.pipeline, "--out", &plain]);
    succeed(&["simulate", &place.pipeline, "--out", &coded, "--format", "cadu"]);
    let (of_plain, maps) = place.replay(&plain);
    let (of_coded, same) = place.replay(&coded);
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
    assert!(maps == place.replay(&noisy).1);
    assert!(json(&["inspect", &noisy])["reception"]["frames"]["bytes_corrected"].as_u64().unwrap() > 100);

    let refused = Command::cargo_bin("lunarray").unwrap();
    let output = { refused }.args(["replay", &plain, &coded, "--out", &place.path("both")]).output().unwrap();
    assert!(!output.status.success());
    assert!(String::from_utf8(output.stderr).unwrap().contains("different formats"));
}

#[test]
fn a_bad_link_is_accounted_for() {
    let place = Workplace::new();
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

        // What does not arrive is lost in the ledger, which closes or the command fails.
        let (of_sound, _) = place.replay(&sound);
        let (of_bad, _) = place.replay(&bad);
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
