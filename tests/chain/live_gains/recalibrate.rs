//! `lunarray recalibrate`: better gains replace those of a state.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use lunarray::downlink::DownlinkReader;
use lunarray::frames::GroundFrame;
use serde_json::Value;

use super::{ERRORS, Mission, sets_of};
use crate::common::downlink::packets_of;
use crate::common::workplace::{fail, lunarray, succeed};

/// A state of poor gains, `old`, and one of good gains, `fresh`, of the same data.
struct States {
    mission: Mission,
    poor: String,
    good: String,
    /// Summary of the state of good gains.
    fresh: Value,
}

impl States {
    fn new() -> Self {
        let mission = Mission::new(&ERRORS);
        let poor = mission.calibrate("poor", &["--set", "calibrate.amplitude_sigma=0"]);
        let good = mission.calibrate("good", &[]);
        let mut states = Self { mission, poor, good, fresh: Value::Null };
        states.replay("old", &states.poor, "old-maps");
        states.fresh = states.replay("fresh", &states.good, "fresh-maps");
        states
    }

    fn path(&self, name: &str) -> String {
        self.mission.place.path(name)
    }

    /// A replay of all data into a state; returns its summary.
    fn replay(&self, state: &str, gains: &str, out: &str) -> Value {
        let state = self.path(state);
        self.mission.replay(out, &[&self.mission.file, "--calibration", gains, "--state", &state])
    }

    /// A copy of the state of poor gains.
    fn copy(&self, to: &str) -> String {
        let (from, to) = (self.path("old"), self.path(to));
        std::fs::create_dir(&to).unwrap();
        for entry in std::fs::read_dir(from).unwrap() {
            let entry = entry.unwrap();
            std::fs::copy(entry.path(), format!("{to}/{}", entry.file_name().to_str().unwrap())).unwrap();
        }
        to
    }

    /// The command that gives a state of poor gains others.
    fn command<'a>(&'a self, state: &'a str, file: &'a str, gains: &'a str) -> Vec<&'a str> {
        let map = &self.mission.place.pipeline;
        let mut args = vec!["recalibrate", file, "--state", state, "--map", map];
        args.extend(["--old-calibration", &self.poor, "--calibration", gains, "--json"]);
        args
    }

    fn assert_as_fresh(&self, state: &str, out: &str) {
        let again = self.replay(state, &self.good, out);
        assert_eq!(again["ledger"], self.fresh["ledger"]);
        assert!(self.mission.maps(out) == self.mission.maps("fresh-maps"), "{out}");
    }
}

#[test]
fn better_gains_replace_those_of_a_state_exactly() {
    let states = States::new();
    without_old_gains_a_state_says_what_it_needs(&states);
    a_whole_state_has_every_bit(&states);
    gains_that_differ_in_a_pass_need_that_pass_alone(&states);
    killed_it_has_old_or_new_gains(&states);
    gains_that_a_ground_found_are_replaced(&states);
}

/// Without a map file and the old gains, as the state holds only their checksum.
fn without_old_gains_a_state_says_what_it_needs(states: &States) {
    let States { mission, poor, good, .. } = states;
    let (folder, merged) = (states.copy("unnamed"), states.path("merged"));
    for (args, by) in [
        (
            vec!["recalibrate", &mission.file, "--state", &folder, "--calibration", good],
            "--old-calibration FILE",
        ),
        (vec!["retract", &mission.file, "--state", &folder], "--set calibration.gains_file=FILE"),
        (vec!["merge", &folder, "--out", &merged], "--set calibration.gains_file=FILE"),
        (vec!["replay", &mission.file, "--state", &folder, "--out", &merged], "--calibration FILE"),
    ] {
        let said = fail(&args);
        let expected = format!("{folder}: the state was accumulated with gains of a file of checksum ");
        assert!(said.contains(&expected) && said.contains(by), "{args:?}: {said}");
    }
    assert!(!Path::new(&merged).exists());
    succeed(&["merge", &folder, "--out", &merged, "--set", &format!("calibration.gains_file={poor}")]);
    let old = ["--old-calibration", poor];
    succeed(&[&["recalibrate", &mission.file, "--state", &folder, "--calibration", good][..], &old].concat());
}

fn a_whole_state_has_every_bit(states: &States) {
    let States { mission, poor, good, fresh } = states;
    let folder = states.copy("new");
    let told: Value = serde_json::from_str(&succeed(&states.command(&folder, &mission.file, good))).unwrap();
    assert_eq!(told["version"], 2);
    assert_eq!(told["accumulated"], fresh["ledger"]["accumulated"]);
    states.assert_as_fresh("new", "new-maps");
    // The state belongs to the new gains now.
    let out = states.path("refused");
    let map = ["--map", &mission.place.pipeline, "--calibration", poor];
    let said = fail(&[&["replay", &mission.file, "--state", &folder, "--out", &out][..], &map].concat());
    assert!(said.contains("calibration.gains_file"), "{said}");
}

fn gains_that_differ_in_a_pass_need_that_pass_alone(states: &States) {
    let States { mission, poor, good, .. } = states;
    let [mut gains, better]: [Value; 2] =
        [poor, good].map(|file| serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap());
    let channels = gains["channels"].as_array_mut().unwrap();
    for (channel, better) in channels.iter_mut().zip(better["channels"].as_array().unwrap()) {
        // Two entries a pass: its start and its end.
        for k in [10, 11] {
            channel["solutions"][k]["gains"] = better["solutions"][k]["gains"].clone();
        }
    }
    let mixed = mission.place.file("mixed.json", gains.to_string().as_bytes());
    // Gains are joined to those of the passes beside it: packets at their edges count as changed.
    let span_s = [9, 12].map(|k| gains["channels"][0]["solutions"][k]["time_s"].as_f64().unwrap());
    let pass = visibilities_within(mission, [span_s[0] - 60.0, span_s[1] + 60.0]);
    let folder = states.copy("mixed");
    let told: Value = serde_json::from_str(&succeed(&states.command(&folder, &pass, &mixed))).unwrap();
    let [unchanged, packets] = ["unchanged", "packets"].map(|name| told[name].as_u64());
    assert!(unchanged > packets && packets > Some(0), "{told}");
    states.replay("fresh-mixed", &mixed, "fresh-mixed-maps");
    states.replay("mixed", &mixed, "mixed-maps");
    assert!(mission.maps("mixed-maps") == mission.maps("fresh-mixed-maps"));
    // All gains differ, and data are missing: nothing changes.
    let said = fail(&states.command(&states.copy("short"), &pass, good));
    assert!(said.contains("in none of the files"), "{said}");
    states.replay("short", poor, "short-maps");
    assert!(mission.maps("short-maps") == mission.maps("old-maps"));
}

/// A file of the instrument and the packets of visibilities within a span.
fn visibilities_within(mission: &Mission, [from_s, until_s]: [f64; 2]) -> String {
    let packets = packets_of(&std::fs::read(&mission.file).unwrap());
    let mut found = vec![packets[0].clone()];
    for packet in &packets {
        let alone = mission.place.file("one.ccsds", &[packets[0].as_slice(), packet].concat());
        let mut reader = DownlinkReader::open(Path::new(&alone)).unwrap();
        while let Some(frame) = reader.next_frame().unwrap() {
            if matches!(&frame, GroundFrame::Visibilities(block)
                if !block.is_empty()
                    && block.middle_s(block.len() - 1) > from_s
                    && block.middle_s(0) < until_s)
            {
                found.push(packet.clone());
            }
        }
    }
    mission.place.file("pass.ccsds", &found.concat())
}

/// Ended by force at any moment, and again until it comes to its end: old or new.
fn killed_it_has_old_or_new_gains(states: &States) {
    let folder = states.copy("killed");
    let args = states.command(&folder, &states.mission.file, &states.good);
    for wait_ms in [5, 15, 30, 50, 80, 120, 200] {
        let mut child = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let mut child = child.args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(wait_ms));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let output = lunarray(&args);
    let said = String::from_utf8(output.stderr).unwrap();
    // What came to its end before has the new gains.
    assert!(output.status.success() || said.contains("calibration.gains_file"), "{said}");
    states.assert_as_fresh("killed", "killed-new-maps");
}

/// From gains that were found while the data arrived.
fn gains_that_a_ground_found_are_replaced(states: &States) {
    let mission = &states.mission;
    let found = states.path("found");
    mission.solve(&mission.file, "found-maps", &["--state", &found]);
    // Without the maps it says what it needs.
    let said = fail(&["retract", &mission.file, "--state", &found]);
    assert!(
        said.contains("with maps of the known sky, a file of checksum ")
            && said.contains("--set calibrate.model_files=[FILE, ...]"),
        "{said}"
    );
    let sets = mission.solving();
    let sets = sets_of(&sets.iter().map(String::as_str).collect::<Vec<_>>());
    let args = ["recalibrate", &mission.file, "--state", &found, "--map", &mission.place.pipeline];
    succeed(&[&args[..], &sets, &["--calibration", &states.good]].concat());
    states.assert_as_fresh("found", "found-new-maps");
}
