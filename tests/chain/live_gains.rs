//! `calibration.hook = "solve"`: a ground that finds gains while the data arrive, and a state that gets better ones.

use crate::common;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::downlink::packets_of;
use common::process::{end, listening, signal, start, wait_until};
use common::workplace::{Workplace, fail, json, succeed};
use lunarray::downlink::{DownlinkReader, PacketHeader, PacketKind};
use lunarray::frames::GroundFrame;
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

    /// The true errors, by pass (of those that were sent, from 0), daughter (from 1) and channel, of a column: the least and
    /// the greatest at the start, middle and end of the pass.
    fn truth(&self, column: usize) -> BTreeMap<Place, [f64; 2]> {
        let text = std::fs::read_to_string(format!("{}.instrument.csv", self.file)).unwrap();
        let rows: Vec<Vec<f64>> = text
            .lines()
            .skip(1)
            .map(|line| line.split(',').map(|number| number.parse().unwrap()).collect())
            .collect();
        let windows: BTreeSet<u64> = rows.iter().map(|row| row[0] as u64).collect();
        let mut truth = BTreeMap::new();
        for row in rows {
            let pass = windows.iter().position(|window| *window == row[0] as u64).unwrap() as u64;
            let value = row[column];
            let span = truth.entry((pass, row[2] as u32, row[3] as usize)).or_insert([value; 2]);
            *span = [span[0].min(value), span[1].max(value)];
        }
        truth
    }

    /// Least and greatest true change from each pass to the next, where there is any.
    fn changes(&self, column: usize) -> BTreeMap<Place, [f64; 2]> {
        let truth = self.truth(column);
        let change = |((pass, daughter, channel), now): (&Place, &[f64; 2])| {
            let before = truth.get(&(pass.checked_sub(1)?, *daughter, *channel))?;
            let change = [now[0] - before[1], now[1] - before[0]];
            (change != [0.0; 2]).then_some(((*pass, *daughter, *channel), change))
        };
        truth.iter().filter_map(change).collect()
    }
}

/// Pass, daughter and channel.
type Place = (u64, u32, usize);

fn sets_of<'a>(sets: &[&'a str]) -> Vec<&'a str> {
    sets.iter().flat_map(|set| ["--set", set]).collect()
}

/// The lines of a file of events that tell what happened to the instrument.
fn told(text: &str) -> Vec<Value> {
    let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    lines.filter(|line| line["event"] == "instrument").map(|line| line["what"].clone()).collect()
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
    std::fs::write(&mission.place.pipeline, map.replace("rows = \"centre\"", "engine = \"harmonic\""))
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

/// Events of a mission as they were told, which are those of the summary; the settings say which kinds there can be.
fn events(mission: &Mission, file: &str, kind: &str) -> Vec<Value> {
    let lines = mission.place.path("events.jsonl");
    let summary = mission.solve(file, "live", &["--events", &lines]);
    let told = told(&std::fs::read_to_string(lines).unwrap());
    let all = summary["calibration"]["events"].as_array().unwrap();
    for event in told.iter().chain(all) {
        assert_eq!(event["event"], kind, "{event}");
    }
    // Those told live were judged by what was known then: sizes of jumps may differ a little.
    let who = |event: &Value| ["pass", "daughter", "channel", "from_s"].map(|name| event[name].clone());
    let told: Vec<_> = told.iter().map(who).collect();
    assert!(!all.is_empty() && all.iter().all(|event| told.contains(&who(event))), "{all:?} of {told:?}");
    all.clone()
}

#[test]
fn jumps_of_clocks_are_told() {
    let mission = Mission::new(&["instrument.clock_ns={step_rms=60.0,step_every_s=1.6e6}"]);
    let events = events(&mission, &mission.file, "clock-jump");
    let found: BTreeMap<(u64, u64), f64> = events
        .iter()
        .map(|event| {
            let number = |name: &str| event[name].as_u64().unwrap();
            ((number("pass"), number("daughter")), event["change_ns"].as_f64().unwrap())
        })
        .collect();
    let mut expected: BTreeMap<(u64, u64), f64> = BTreeMap::new();
    for ((pass, daughter, _), [least, greatest]) in mission.changes(7) {
        assert_eq!(least, greatest, "a jump within a pass");
        expected.insert((pass, daughter.into()), least);
    }
    eprintln!("clocks: {expected:.2?}, found {found:.2?}");
    assert!(expected.len() >= 2, "{expected:?}");
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (place, change_ns) in expected {
        // Phases are known to a degree or so: at 5 MHz a degree is 0.6 ns.
        assert!((found[&place] - change_ns).abs() < 2.0, "{place:?}: {} for {change_ns}", found[&place]);
    }
}

#[test]
fn steps_of_amplitudes_are_told() {
    let mission = Mission::new(&["instrument.amplitude={step_rms=0.3,step_every_s=3.2e6}"]);
    let events = events(&mission, &mission.file, "gain-step");
    let mut found = BTreeMap::new();
    for event in &events {
        let number = |name: &str| event[name].as_u64().unwrap();
        for channel in event["channels"].as_array().unwrap() {
            let place = (number("pass"), number("daughter") as u32, channel[0].as_u64().unwrap() as usize);
            found.insert(place, channel[1].as_f64().unwrap());
        }
    }
    let expected = mission.changes(5);
    eprintln!("amplitudes: {expected:.3?}, found factors {found:.3?}");
    // Small steps are within what the noise leaves; of one within a pass the solution has some part.
    let large: Vec<&Place> = expected
        .iter()
        .filter(|(_, [least, greatest])| *least > 0.1 || *greatest < -0.1)
        .map(|(place, _)| place)
        .collect();
    assert!(large.len() >= 2, "{expected:?}");
    assert!(large.iter().all(|place| found.contains_key(place)));
    for (place, factor) in found {
        let [least, greatest] = expected.get(&place).unwrap_or_else(|| panic!("{place:?}: nothing changed"));
        // Amplitudes are known to a percent or so.
        let change: f64 = f64::ln(factor);
        assert!(change > least - 0.05 && change < greatest + 0.05, "{place:?}: {change}");
    }
}

#[test]
fn interference_in_a_channel_is_told() {
    let mission = Mission::new(&[]);
    let sets = ["instrument.outlier_probability=0.2", "instrument.outlier_sigma=30.0"];
    let spoilt = mission.place.simulate("spoilt.ccsds", &sets_of(&sets));
    // Packets of the second channel from the data with outliers, all others from those without.
    let [clean, spoilt] = [&mission.file, &spoilt].map(|file| packets_of(&std::fs::read(file).unwrap()));
    assert_eq!(clean.len(), spoilt.len());
    let mixed: Vec<&[u8]> = clean
        .iter()
        .zip(&spoilt)
        .map(|(a, b)| if channel_of(a) == Some(1) { &b[..] } else { &a[..] })
        .collect();
    let mixed = mission.place.file("mixed.ccsds", &mixed.concat());
    let events = events(&mission, &mixed, "interference");
    let found: Vec<(u64, u64)> = events
        .iter()
        .map(|event| (event["pass"].as_u64().unwrap(), event["channel"].as_u64().unwrap()))
        .collect();
    assert_eq!(found, (0..8).map(|pass| (pass, 1)).collect::<Vec<_>>());
    for event in &events {
        // A pass has some 700 visibilities of a channel: 0.2 scatters by 0.015. Outliers within 7 of 30 sigma are 3 % of them.
        let part = event["outliers"].as_f64().unwrap();
        assert!((part - 0.2).abs() < 0.06, "{part}");
    }
}

/// The channel of a packet of visibilities: the first field of its payload.
fn channel_of(packet: &[u8]) -> Option<u16> {
    let header = PacketHeader::parse(packet)?;
    (header.kind == PacketKind::Visibilities).then(|| u16::from_le_bytes([packet[22], packet[23]]))
}

#[test]
fn bursts_are_told() {
    let mission = Mission::new(&[]);
    let sets = ["instrument.burst_every_s=1e4", "instrument.burst_s=200.0", "instrument.burst_k_sr=3e7"];
    let spoilt = mission.place.simulate("spoilt.ccsds", &sets_of(&sets));
    // When: where the visibilities differ from those without bursts.
    let read = |file: &str| {
        let mut reader = DownlinkReader::open(Path::new(file)).unwrap();
        let mut values = BTreeMap::new();
        while let Some(frame) = reader.next_frame().unwrap() {
            if let GroundFrame::Visibilities(block) = frame {
                for k in 0..block.len() {
                    let time_s = block.middle_s(k);
                    let value = block.value_k_sr[k];
                    values.insert((block.channel, block.pair, time_s.to_bits()), (time_s, value));
                }
            }
        }
        values
    };
    let (clean, other) = (read(&mission.file), read(&spoilt));
    let burst_s: Vec<f64> =
        other.iter().filter(|(key, value)| clean[key].1 != value.1).map(|(_, (time_s, _))| *time_s).collect();
    assert!(!burst_s.is_empty());
    let events = events(&mission, &spoilt, "burst");
    let number = |event: &Value, name: &str| event[name].as_f64().unwrap();
    let spans: Vec<[f64; 2]> =
        events.iter().map(|event| [number(event, "from_s"), number(event, "until_s")]).collect();
    eprintln!("bursts: {spans:.0?}");
    // A sixtieth of a pass on either side.
    let bin_s = 60.0;
    for [from_s, until_s] in &spans {
        let within = |time_s: &&f64| (from_s - bin_s..until_s + bin_s).contains(*time_s);
        let there: Vec<&f64> = burst_s.iter().filter(within).collect();
        assert!(!there.is_empty(), "nothing at {from_s} s to {until_s} s");
    }
    let missed = burst_s.iter().filter(|time_s| {
        !spans.iter().any(|[from_s, until_s]| (from_s - bin_s..until_s + bin_s).contains(*time_s))
    });
    assert_eq!(missed.count(), 0, "of {}", burst_s.len());
}

#[test]
fn better_gains_replace_those_of_a_state_exactly() {
    let mission = Mission::new(&ERRORS);
    let poor = mission.calibrate("poor", &["--set", "calibrate.amplitude_sigma=0"]);
    let good = mission.calibrate("good", &[]);
    let place = &mission.place;
    let state = |name: &str, gains: &str| {
        let args = ["--calibration", gains, "--state", &place.path(name)];
        mission.replay(&format!("{name}-maps"), &[&[mission.file.as_str()][..], &args].concat())
    };
    state("old", &poor);
    let fresh = state("fresh", &good);
    let copy = |to: &str| {
        let (from, to) = (place.path("old"), place.path(to));
        let _ = std::fs::remove_dir_all(&to);
        std::fs::create_dir(&to).unwrap();
        for entry in std::fs::read_dir(from).unwrap() {
            let entry = entry.unwrap();
            std::fs::copy(entry.path(), format!("{to}/{}", entry.file_name().to_str().unwrap())).unwrap();
        }
        to
    };
    let better = |folder: &str, files: &[&str], gains: &str| -> Vec<String> {
        let mut args = vec!["recalibrate"];
        args.extend(files);
        args.extend(["--state", folder, "--map", &place.pipeline]);
        args.extend(["--old-calibration", &poor, "--calibration", gains, "--json"]);
        args.into_iter().map(str::to_owned).collect()
    };
    // Without a map file and the old gains the state says what it needs, as it holds only their checksum.
    let (folder, merged) = (copy("unnamed"), place.path("merged"));
    for (args, by) in [
        (
            vec!["recalibrate", &mission.file, "--state", &folder, "--calibration", &good],
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
    let named = format!("calibration.gains_file={poor}");
    succeed(&["merge", &folder, "--out", &merged, "--set", &named]);
    succeed(&[
        "recalibrate",
        &mission.file,
        "--state",
        &folder,
        "--old-calibration",
        &poor,
        "--calibration",
        &good,
    ]);
    let strs = |args: &[String]| -> Vec<String> { args.to_vec() };
    let run = |args: &[String]| -> Value {
        let args: Vec<&str> = args.iter().map(String::as_str).collect();
        serde_json::from_str(&succeed(&args)).unwrap()
    };
    // The whole state, and every bit of its sums.
    let folder = copy("new");
    let told = run(&better(&folder, &[&mission.file], &good));
    assert_eq!(told["version"], 2);
    assert_eq!(told["accumulated"], fresh["ledger"]["accumulated"]);
    let same_as_fresh = |folder: &str, out: &str| {
        let args = ["--calibration", good.as_str(), "--state", folder];
        let again = mission.replay(out, &[&[mission.file.as_str()][..], &args].concat());
        assert_eq!(again["ledger"], fresh["ledger"]);
        assert!(mission.maps(out) == mission.maps("fresh-maps"), "{out}");
    };
    same_as_fresh(&folder, "new-maps");
    // The state belongs to the new gains now.
    let out = place.path("refused");
    let args = [
        "replay",
        &mission.file,
        "--map",
        &place.pipeline,
        "--calibration",
        &poor,
        "--state",
        &folder,
        "--out",
        &out,
    ];
    assert!(fail(&args).contains("calibration.gains_file"));
    // Gains that differ in one pass need that pass alone.
    let mut gains: Value = serde_json::from_slice(&std::fs::read(&poor).unwrap()).unwrap();
    let better_gains: Value = serde_json::from_slice(&std::fs::read(&good).unwrap()).unwrap();
    for (channel, better) in
        gains["channels"].as_array_mut().unwrap().iter_mut().zip(better_gains["channels"].as_array().unwrap())
    {
        // Two entries a pass: its start and its end.
        for k in [10, 11] {
            channel["solutions"][k]["gains"] = better["solutions"][k]["gains"].clone();
        }
    }
    let mixed = place.file("mixed.json", gains.to_string().as_bytes());
    // Gains are joined to those of the passes beside it: packets at their edges count as changed.
    let span_s = [9, 12].map(|k| gains["channels"][0]["solutions"][k]["time_s"].as_f64().unwrap());
    let bytes = std::fs::read(&mission.file).unwrap();
    let packets = packets_of(&bytes);
    let mut pass = vec![packets[0].clone()];
    for packet in &packets {
        let alone = place.file("one.ccsds", &[packets[0].as_slice(), packet].concat());
        let mut reader = DownlinkReader::open(Path::new(&alone)).unwrap();
        while let Some(frame) = reader.next_frame().unwrap() {
            if matches!(&frame, GroundFrame::Visibilities(block)
                if !block.is_empty()
                    && block.middle_s(block.len() - 1) > span_s[0] - 60.0
                    && block.middle_s(0) < span_s[1] + 60.0)
            {
                pass.push(packet.clone());
            }
        }
    }
    let pass = place.file("pass.ccsds", &pass.concat());
    let folder = copy("mixed");
    let told = run(&better(&folder, &[&pass], &mixed));
    assert!(
        told["unchanged"].as_u64() > told["packets"].as_u64() && told["packets"].as_u64() > Some(0),
        "{told}"
    );
    state("fresh-mixed", &mixed);
    let args = ["--calibration", mixed.as_str(), "--state", &folder];
    mission.replay("mixed-maps", &[&[mission.file.as_str()][..], &args].concat());
    assert!(mission.maps("mixed-maps") == mission.maps("fresh-mixed-maps"));
    // All gains differ, and data are missing: nothing changes.
    let folder = copy("short");
    let args = better(&folder, &[&pass], &good);
    let said = fail(&strs(&args).iter().map(String::as_str).collect::<Vec<_>>());
    assert!(said.contains("in none of the files"), "{said}");
    let args = ["--calibration", poor.as_str(), "--state", &folder];
    mission.replay("short-maps", &[&[mission.file.as_str()][..], &args].concat());
    assert!(mission.maps("short-maps") == mission.maps("old-maps"));
    // Ended by force at any moment, and again until it comes to its end: old or new.
    let folder = copy("killed");
    let args = better(&folder, &[&mission.file], &good);
    for wait_ms in [5, 15, 30, 50, 80, 120, 200] {
        let mut child = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let mut child = child.args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(wait_ms));
        child.kill().unwrap();
        child.wait().unwrap();
    }
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let output = common::workplace::lunarray(&args);
    let said = String::from_utf8(output.stderr).unwrap();
    // What came to its end before has the new gains.
    assert!(output.status.success() || said.contains("calibration.gains_file"), "{said}");
    same_as_fresh(&folder, "killed-new-maps");
    // From gains that were found while the data arrived.
    let found = place.path("found");
    mission.solve(&mission.file, "found-maps", &["--state", &found]);
    let sets = mission.solving();
    // Without the maps it says what it needs.
    let said = fail(&["retract", &mission.file, "--state", &found]);
    assert!(
        said.contains("with maps of the known sky, a file of checksum ")
            && said.contains("--set calibrate.model_files=[FILE, ...]"),
        "{said}"
    );
    let mut args = vec!["recalibrate", &mission.file, "--state", &found, "--map", &place.pipeline];
    sets.iter().for_each(|set| args.extend(["--set", set]));
    args.extend(["--calibration", &good]);
    succeed(&args);
    same_as_fresh(&found, "found-new-maps");
}
