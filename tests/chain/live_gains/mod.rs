//! `calibration.hook = "solve"`: a ground that finds gains while the data arrive, and a state that gets better ones.

mod events;
mod recalibrate;

use crate::common;

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::downlink::packets_of;
use common::process::{end, listening, signal, start, wait_until};
use common::workplace::{Workplace, fail, json, succeed};
use lunarray::sky::fits::{ReadOptions, read_whole_map};
use serde_json::Value;

/// Eight daughters whose data are direct sums over the map's own pixels, so that the input is a perfect model; three channels
/// tell a clock from phases. Eight passes.
const SMALL: &str = r#"
name = "live"
seed = 6
[sky]
nside = 4
[spacecraft]
channels_hz = [3.0e6, 4.0e6, 5.0e6]
channel_width_hz = 2e5              # little noise
duration_s = 8e5
every_nth_window = 12
every_nth_integration = 60
baseline_wavelengths_max = 400.0
model = "direct"
[downlink]
packet_bytes_max = 2048
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-4
rows = "centre"
baseline_bp_max = 60.0
[products]
pictures = false
"#;

const MHZ: [&str; 3] = ["3.000MHz", "4.000MHz", "5.000MHz"];

/// 60 deg of phase, 10 % of amplitude, 30 ns of clock, new in each pass.
const ERRORS: [&str; 3] = [
    "instrument.phase_deg={pass_rms=60.0}",
    "instrument.amplitude={pass_rms=0.1}",
    "instrument.clock_ns={pass_rms=30.0}",
];

/// A mission with errors, and the maps of its sky.
struct Mission {
    place: Workplace,
    file: String,
    models: Vec<String>,
}

impl Mission {
    fn new(errors: &[&str]) -> Self {
        let place = Workplace::new(SMALL);
        let ideal = place.path("ideal");
        let sets = ["--set", "spacecraft.duration_s=1e5"];
        succeed(&[&["run", &place.pipeline, "--out", &ideal][..], &sets].concat());
        let models = MHZ.iter().map(|channel| format!("{ideal}/{channel}/input.fits")).collect();
        let file = place.simulate("sent.ccsds", &sets_of(errors));
        Self { place, file, models }
    }

    /// Settings of a ground that finds gains.
    fn solving(&self) -> Vec<String> {
        vec!["calibration.hook=solve".to_owned(), format!("calibrate.model_files={:?}", self.models)]
    }

    /// A replay with these arguments; returns its summary.
    fn replay(&self, out: &str, more: &[&str]) -> Value {
        let out = self.place.path(out);
        json(&[&["replay", "--map", &self.place.pipeline, "--out", &out][..], more].concat())
    }

    /// A replay that finds gains.
    fn solve(&self, file: &str, out: &str, more: &[&str]) -> Value {
        let sets = self.solving();
        let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
        self.replay(out, &[&[file][..], &sets, more].concat())
    }

    /// The gains that `lunarray calibrate` finds, with these settings.
    fn calibrate(&self, out: &str, more: &[&str]) -> String {
        let folder = self.place.path(out);
        let mut args = vec!["calibrate", &self.file, "--map", &self.place.pipeline, "--out", &folder];
        args.extend(more);
        args.push("--model");
        args.extend(self.models.iter().map(String::as_str));
        succeed(&args);
        format!("{folder}/gains.json")
    }

    fn bytes(&self, name: &str) -> Vec<u8> {
        std::fs::read(self.place.path(name)).unwrap()
    }

    fn maps(&self, out: &str) -> Vec<Vec<u64>> {
        let map = |channel: &&str| {
            let path = self.place.path(&format!("{out}/{channel}/map.fits"));
            let map = read_whole_map(Path::new(&path), &ReadOptions::default()).unwrap();
            map.into_values().into_iter().map(f64::to_bits).collect()
        };
        MHZ.iter().map(map).collect()
    }
}

fn sets_of<'a>(sets: &[&'a str]) -> Vec<&'a str> {
    sets.iter().flat_map(|set| ["--set", set]).collect()
}

#[test]
fn a_ground_finds_the_gains_of_calibrate_and_makes_the_maps_of_a_replay_with_them() {
    let mission = Mission::new(&ERRORS);
    let gains = mission.calibrate("solved", &[]);
    let replayed = mission.replay("replayed", &[&mission.file, "--calibration", &gains]);
    let live = mission.solve(&mission.file, "live", &[]);
    for file in ["gains.json", "solutions.csv", "solutions.json"] {
        assert!(mission.bytes(&format!("solved/{file}")) == mission.bytes(&format!("live/{file}")), "{file}");
    }
    assert!(mission.maps("live") == mission.maps("replayed"));
    for part in ["ledger", "completeness"] {
        assert_eq!(live[part], replayed[part], "{part}");
    }
    let solved: Value = serde_json::from_slice(&mission.bytes("solved/solutions.json")).unwrap();
    assert_eq!(live["calibration"], solved["summary"]);
    assert_eq!((&live["calibration"]["passes"], &live["calibration"]["late"]), (&8.into(), &0.into()));
    // A ground that listens.
    let sets = mission.solving();
    let out = mission.place.path("heard");
    let mut args = vec!["replay", "--listen", "tcp://127.0.0.1:0", "--connections", "1"];
    args.extend(["--map", &mission.place.pipeline, "--out", &out]);
    sets.iter().for_each(|set| args.extend(["--set", set]));
    let mut ground = start(&args);
    let url = listening(&mut ground);
    let mut stream = std::net::TcpStream::connect(url.strip_prefix("tcp://").unwrap()).unwrap();
    std::io::Write::write_all(&mut stream, &std::fs::read(&mission.file).unwrap()).unwrap();
    drop(stream);
    assert!(end(&mut ground).0.success());
    assert!(mission.bytes("solved/gains.json") == mission.bytes("heard/gains.json"));
    assert!(mission.maps("heard") == mission.maps("replayed"));
    // A later pass before an earlier one: late data are a pass of their own.
    let packets = packets_of(&std::fs::read(&mission.file).unwrap());
    let middle = packets.len() / 2;
    let swapped = [&packets[..2], &packets[middle..], &packets[2..middle]].concat().concat();
    let swapped = mission.place.file("swapped.ccsds", &swapped);
    let late = mission.solve(&swapped, "swapped", &[]);
    assert_eq!(late["ledger"]["sampled"], live["ledger"]["sampled"]);
    let passes = late["calibration"]["passes"].as_u64().unwrap();
    // The pass that was cut in two is one or two.
    assert!((8..=9).contains(&passes), "{passes}");
}

#[test]
fn a_pass_is_told_when_the_next_begins_and_the_last_when_it_is_interrupted() {
    let mission = Mission::new(&ERRORS);
    let bytes = std::fs::read(&mission.file).unwrap();
    let gains = mission.calibrate("solved", &[]);
    // All but the end: the last pass is open, and nobody knows how long it is.
    let part = mission.place.file("part.ccsds", &bytes[..bytes.len() * 7 / 10]);
    let sets = mission.solving();
    let out = mission.place.path("followed");
    let mut args = vec!["replay", &part, "--follow", "--map", &mission.place.pipeline, "--out", &out];
    sets.iter().for_each(|set| args.extend(["--set", set]));
    let mut ground = start(&args);
    wait_until("the first gains", || Path::new(&format!("{out}/gains.json")).exists());
    // Products are there while it follows.
    assert!(!Path::new(&format!("{out}/summary.json")).exists());
    std::thread::sleep(Duration::from_millis(500));
    signal(&ground, "INT");
    end(&mut ground);
    let summary: Value = serde_json::from_slice(&mission.bytes("followed/summary.json")).unwrap();
    let passes = summary["calibration"]["passes"].as_u64().unwrap();
    assert!((1..=6).contains(&passes), "{passes}");
    // Complete passes have the gains of the whole file.
    let table = |name: &str| String::from_utf8(mission.bytes(name)).unwrap();
    let (part, whole) = (table("followed/solutions.csv"), table("solved/solutions.csv"));
    let complete = |text: &str| -> Vec<String> {
        let of =
            |line: &&str| line.split(',').next().unwrap().parse::<u64>().is_ok_and(|pass| pass + 1 < passes);
        text.lines().filter(of).map(str::to_owned).collect()
    };
    assert_eq!(complete(&part), complete(&whole));
    drop(gains);
}

#[test]
fn killed_and_resumed_a_state_has_every_bit() {
    let mission = Mission::new(&ERRORS);
    let whole = mission.solve(
        &mission.file,
        "whole",
        &["--state", &mission.place.path("state"), "--checkpoint-every", "1500"],
    );
    let sets = mission.solving();
    let (state, out) = (mission.place.path("killed"), mission.place.path("killed-maps"));
    let mut args = vec!["replay", &mission.file, "--map", &mission.place.pipeline, "--out", &out];
    args.extend(["--state", &state, "--checkpoint-every", "1500"]);
    sets.iter().for_each(|set| args.extend(["--set", set]));
    let newest = |folder: &str| {
        let mut names: Vec<String> = std::fs::read_dir(folder)
            .map(|entries| entries.map(|entry| entry.unwrap().path().display().to_string()).collect())
            .unwrap_or_default();
        names.retain(|name| name.ends_with(".lunarray"));
        names.sort();
        names.pop()
    };
    // Ended by force once it has written a checkpoint, and another.
    for number in [1, 3] {
        let mut child = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let mut child = child.args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let name = format!("checkpoint-{number:08}.lunarray");
        wait_until("a checkpoint, or the end", || {
            newest(&state).is_some_and(|found| found >= format!("{state}/{name}"))
                || child.try_wait().unwrap().is_some()
        });
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let resumed =
        mission.solve(&mission.file, "killed-maps", &["--state", &state, "--checkpoint-every", "1500"]);
    assert_eq!(resumed["calibration"], whole["calibration"]);
    assert_eq!(resumed["ledger"], whole["ledger"]);
    assert!(mission.bytes("killed-maps/gains.json") == mission.bytes("whole/gains.json"));
    assert!(mission.maps("killed-maps") == mission.maps("whole"));
    assert!(
        std::fs::read(newest(&state).unwrap()).unwrap()
            == std::fs::read(newest(&mission.place.path("state")).unwrap()).unwrap()
    );
    // In halves, cut within a packet of a pass; and without a state at all.
    let bytes = std::fs::read(&mission.file).unwrap();
    let half = mission.place.file("half.ccsds", &bytes[..bytes.len() * 55 / 100]);
    let state = mission.place.path("halves");
    mission.solve(&half, "half-maps", &["--state", &state]);
    let resumed = mission.solve(&mission.file, "halves-maps", &["--state", &state]);
    assert_eq!(resumed["calibration"], whole["calibration"]);
    assert!(mission.maps("halves-maps") == mission.maps("whole"));
    mission.solve(&mission.file, "alone", &[]);
    assert!(mission.maps("alone") == mission.maps("whole"));
    // Other settings of the solver are of another state.
    let more = ["--state", &state, "--set", "calibrate.outlier_sigma=7.0"];
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
    let out = mission.place.path("refused");
    let args =
        [&["replay", &mission.file, "--map", &mission.place.pipeline, "--out", &out][..], &sets, &more]
            .concat();
    assert!(fail(&args).contains("calibrate.outlier_sigma"));
}

#[test]
fn parts_of_ranks_that_solved_alike_are_one_checkpoint() {
    // A pass without visibilities in some of its sixtieths has parts of outliers that are not numbers.
    let mission = Mission::new(&ERRORS);
    let state = mission.place.path("state");
    let solving = mission.solving();
    let sets = sets_of(&solving.iter().map(String::as_str).collect::<Vec<_>>());
    let out = mission.place.path("out");
    let replay =
        [&["replay", "--map", &mission.place.pipeline, "--out", &out, "--state", &state][..], &sets].concat();
    let map = std::fs::read_to_string(&mission.place.pipeline).unwrap();
    std::fs::write(
        &mission.place.pipeline,
        map.replace("rows = \"centre\"\n", "").replace("engine = 'pixel'", "engine = 'harmonic'"),
    )
    .unwrap();
    succeed(&[&replay[..], &[&mission.file]].concat());
    let checkpoints = || -> Vec<std::path::PathBuf> {
        let found = std::fs::read_dir(&state).unwrap().map(|entry| entry.unwrap().path());
        found.filter(|path| path.to_str().unwrap().contains("checkpoint-")).collect()
    };
    let newest = checkpoints().into_iter().max().unwrap();
    let bytes = std::fs::read(&newest).unwrap();
    let name = newest.to_str().unwrap().strip_suffix(".lunarray").unwrap().to_owned();
    checkpoints().iter().for_each(|path| std::fs::remove_file(path).unwrap());
    for part in [1, 2] {
        std::fs::write(format!("{name}.{part}-of-2.lunarray"), &bytes).unwrap();
    }
    // They are of one job as far as their heads tell; that both have all sums is what is wrong with them.
    let said = fail(&replay);
    assert!(said.contains("sums of block") && !said.contains("a different state"), "{said}");
}

#[test]
fn perfect_data_stay_as_they_are() {
    let mission = Mission::new(&[]);
    let plain = mission.replay("plain", &[&mission.file]);
    let live = mission.solve(&mission.file, "live", &[]);
    assert_eq!(live["calibration"]["events"], serde_json::json!([]));
    assert_eq!(live["ledger"]["sampled"], plain["ledger"]["sampled"]);
    for channel in MHZ {
        let of = |name: &str| {
            let path = mission.place.path(&format!("{name}.fits"));
            read_whole_map(Path::new(&path), &ReadOptions::default()).unwrap().into_values()
        };
        let rms = |values: &[f64]| (values.iter().map(|x| x * x).sum::<f64>() / values.len() as f64).sqrt();
        let (before, after) = (of(&format!("plain/{channel}/map")), of(&format!("live/{channel}/map")));
        let changed: Vec<f64> = before.iter().zip(after).map(|(before, after)| after - before).collect();
        let (changed, noise) = (rms(&changed), rms(&of(&format!("plain/{channel}/noise"))));
        eprintln!("{channel}: the map changes by {:.3} of its noise", changed / noise);
        assert!(changed < noise, "{channel}: {changed} K for a noise of {noise} K");
    }
}
