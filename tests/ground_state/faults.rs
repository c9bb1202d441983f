//! Calls of the system that fail, one after another: each command ends well or by name, and goes on to the same bits.
//!
//! A library that is compiled here and loaded before the command makes the calls fail (`fault.c`). The gate takes a
//! sample of all calls; `LUNARRAY_LONG=1` takes each in turn.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use std::time::Duration;

use super::common::workplace::{Workplace, files, lunarray, succeed};
use super::{Ground, checkpoints, packets};

/// Kinds of faults, each with what the system says of it; `None` for those that nobody notices.
const KINDS: [(&str, Option<&str>); 6] = [
    ("EIO", Some("Input/output error")),
    ("ENOSPC", Some("No space left on device")),
    ("EMFILE", Some("Too many open files")),
    ("EACCES", Some("Permission denied")),
    ("EINTR", None),
    ("SHORT", None),
];

/// Real geometry and little else: a command takes a moment.
const TINY: &str = r#"
name = "tiny"
seed = 7
[sky]
nside = 4
[spacecraft]
channels_hz = [3.0e6]
every_nth_window = 900
every_nth_integration = 5
baseline_wavelengths_max = 16.0
[downlink]
packet_bytes_max = 1024
[map]
engine = 'pixel'
nside = 2
epsilon = 1e-4
[products]
pictures = false
"#;

/// Calls of each kind and command that fail in the gate.
const SAMPLE: u64 = 4;

/// Much longer than any of these commands takes: one that takes more hangs.
const LIMIT: Duration = Duration::from_secs(120);

/// The library, compiled once.
fn library() -> &'static Path {
    static LIBRARY: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, path) = LIBRARY.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("fault.so");
        let source = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ground_state/fault.c");
        // The linker of Rust's own programs.
        let mut compiler = Command::new("cc");
        compiler.args(["-O1", "-shared", "-fPIC", "-o"]).arg(&path).args([source, "-ldl"]);
        assert!(compiler.status().unwrap().success());
        (folder, path)
    });
    path
}

/// A fault at one call of a command, counted from 1; at none for 0.
#[derive(Clone, Copy, Debug)]
struct Fault {
    kind: &'static str,
    at: u64,
    /// Whether all calls after it fail as well.
    goes_on: bool,
}

/// Runs a command with a fault in its calls on files below a folder; what it prints, and the calls that could have
/// failed, those that did with a `!`.
fn run(args: &[String], below: &Path, fault: Fault) -> (Output, Vec<String>) {
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut command = assert_cmd::Command::cargo_bin("lunarray").unwrap();
    command.args(args).timeout(LIMIT);
    command.env("LD_PRELOAD", library()).env("FAULT_BELOW", below).env("FAULT_LOG", log.path());
    command.env("FAULT_KIND", fault.kind).env("FAULT_AT", fault.at.to_string());
    if fault.goes_on {
        command.env("FAULT_ON", "1");
    }
    let output = command.output().unwrap();
    let calls = std::fs::read_to_string(log.path()).unwrap();
    (output, calls.lines().map(str::to_owned).collect())
}

/// Files with their contents.
type Contents = Vec<(PathBuf, Vec<u8>)>;

/// A command that is to survive.
struct Victim<'a> {
    name: &'static str,
    /// Files and folders that it begins with.
    before: PathBuf,
    /// Its arguments, in a copy of that folder.
    args: &'a dyn Fn(&Path) -> Vec<String>,
    /// What counts of that which it leaves.
    result: &'a dyn Fn(&Path) -> Contents,
    /// What it may say when it is repeated after a failure that came when all was done.
    is_done: &'static str,
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let there = to.join(path.file_name().unwrap());
        match path.is_dir() {
            true => copy(&path, &there),
            false => drop(std::fs::copy(&path, there).unwrap()),
        }
    }
}

impl Victim<'_> {
    /// A copy of what it begins with, on a file system in memory if there is one: nothing here has to last.
    fn place(&self) -> tempfile::TempDir {
        let memory = Path::new("/dev/shm");
        let place = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() }.unwrap();
        copy(&self.before, place.path());
        place
    }

    fn undisturbed(&self) -> Vec<(PathBuf, Vec<u8>)> {
        let place = self.place();
        let args = (self.args)(place.path());
        succeed(&args.iter().map(String::as_str).collect::<Vec<_>>());
        let result = (self.result)(place.path());
        assert!(!result.is_empty());
        result
    }

    /// Number of calls that a kind of fault can befall.
    fn calls(&self, kind: &'static str) -> u64 {
        let place = self.place();
        let (output, calls) =
            run(&(self.args)(place.path()), place.path(), Fault { kind, at: 0, goes_on: false });
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        calls.len() as u64
    }

    /// Number of the first such call on files in a folder.
    fn number(&self, kind: &'static str, folder: &str, is_meant: impl Fn(&str) -> bool) -> u64 {
        let place = self.place();
        let fault = Fault { kind, at: 0, goes_on: false };
        let (_, calls) = run(&(self.args)(place.path()), &place.path().join(folder), fault);
        calls.iter().position(|call| is_meant(call)).unwrap() as u64 + 1
    }

    /// Whether the fault was met; what follows from it is judged here.
    fn attack(&self, fault: Fault, says: Option<&str>, expected: &[(PathBuf, Vec<u8>)]) -> bool {
        let place = self.place();
        let args = (self.args)(place.path());
        let (output, calls) = run(&args, place.path(), fault);
        let said = String::from_utf8_lossy(&output.stderr);
        let hit: Vec<&String> = calls.iter().filter(|call| call.starts_with('!')).take(3).collect();
        let at = format!("{}: {fault:?}, {hit:?}: {:?}, {said}", self.name, output.status);
        assert!(!said.contains("panicked"), "{at}");
        match output.status.code() {
            Some(0) => {}
            // The system refused; or what it gave was taken for damaged data, or for a configuration that cannot be read.
            Some(1..=3) => {
                let says = says.unwrap_or_else(|| panic!("{at}"));
                assert!(said.contains("error: ") && said.contains(says), "{at}");
                // It names the file or folder.
                assert!(said.contains(place.path().to_str().unwrap()), "{at}");
            }
            _ => panic!("{at}"),
        }
        if !output.status.success() {
            let again = lunarray(&args.iter().map(String::as_str).collect::<Vec<_>>());
            let said = String::from_utf8_lossy(&again.stderr);
            let is_done = !self.is_done.is_empty() && said.contains(self.is_done);
            assert!(again.status.success() || is_done, "{at}; again: {said}");
        }
        let found = (self.result)(place.path());
        let names =
            |files: &[(PathBuf, Vec<u8>)]| files.iter().map(|(path, _)| path.clone()).collect::<Vec<_>>();
        assert_eq!(names(&found), names(expected), "{at}");
        for ((path, found), (_, expected)) in found.iter().zip(expected) {
            assert!(found == expected, "{at}: {} differs", path.display());
        }
        // Nothing that was sound was put away as damaged.
        let damaged =
            files(place.path()).into_keys().find(|path| path.to_str().unwrap().ends_with(".damaged"));
        assert_eq!(damaged, None, "{at}");
        !hit.is_empty()
    }

    /// Each call in turn, or a sample.
    fn survive(&self) {
        let expected = self.undisturbed();
        let is_long = std::env::var("LUNARRAY_LONG").is_ok_and(|text| text == "1");
        for (kind, says) in KINDS {
            let calls = self.calls(kind);
            let mut met = 0;
            let sample = if is_long { calls } else { SAMPLE.min(calls) };
            for k in 0..sample {
                // Evenly, at a place in each part that differs from part to part.
                let part = k * 7919 % 100;
                let at = if is_long { k + 1 } else { (100 * k + part) * calls / (100 * sample) + 1 };
                met += u64::from(self.attack(Fault { kind, at, goes_on: false }, says, &expected));
                // As a disk that stays full, or a limit that stays reached.
                let stays = matches!(kind, "ENOSPC" | "EIO" | "EMFILE");
                if stays && (is_long && k % 4 == 0 || k % 4 == 1) {
                    self.attack(Fault { kind, at, goes_on: true }, says, &expected);
                }
            }
            eprintln!("{}: {kind} at {sample} of {calls} calls, met {met}", self.name);
            // Calls of several threads interleave: the last ones may not come.
            assert!(met + 2 >= sample);
        }
    }
}

/// The newest checkpoint of each of these folders.
fn newest(place: &Path, folders: &[&str]) -> Vec<(PathBuf, Vec<u8>)> {
    let newest = |folder: &&str| checkpoints(&place.join(folder)).pop();
    let found = folders.iter().zip(folders.iter().filter_map(newest));
    found.map(|(folder, path)| (PathBuf::from(folder), std::fs::read(path).unwrap())).collect()
}

fn strings(args: &[&str]) -> Vec<String> {
    args.iter().map(|&arg| arg.to_owned()).collect()
}

fn path(place: &Path, name: &str) -> String {
    place.join(name).to_str().unwrap().to_owned()
}

fn ground() -> (Ground, PathBuf) {
    ground_of(TINY, "30")
}

/// A ground whose folders are copied from: the pipeline file, a downlink, and a state of its first half with so many visibilities from one
/// checkpoint to the next.
fn ground_of(pipeline: &str, every: &str) -> (Ground, PathBuf) {
    let ground = Ground(Workplace::new(pipeline));
    let before = PathBuf::from(ground.path("before"));
    std::fs::create_dir(&before).unwrap();
    std::fs::copy(&ground.pipeline, before.join("pipeline.toml")).unwrap();
    let file = ground.simulate("before/small.ccsds", &[]);
    let packets = packets(&file);
    let first = ground.file("first.ccsds", &packets[..packets.len() / 2].concat());
    ground.replay("before/state", &[&first], &["--checkpoint-every", every]);
    std::fs::remove_dir_all(before.join("state.out")).unwrap();
    assert_eq!(checkpoints(&before.join("state")).len(), 2);
    (ground, before)
}

fn replay(place: &Path) -> Vec<String> {
    let fixed = ["--checkpoint-every", "200", "--json"];
    let [file, map, out, state] =
        ["small.ccsds", "pipeline.toml", "out", "state"].map(|name| path(place, name));
    strings(&[&["replay", &file, "--map", &map, "--out", &out, "--state", &state], &fixed[..]].concat())
}

/// The newest checkpoint and the maps.
fn replayed(place: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = newest(place, &["state"]);
    found.extend(files(&place.join("out")).into_iter().filter(|(path, _)| path.ends_with("map.fits")));
    found
}

#[test]
fn a_replay_survives_every_fault() {
    let (_ground, before) = ground();
    Victim { name: "replay", before, args: &replay, result: &replayed, is_done: "" }.survive();
}

#[test]
fn a_merge_survives_every_fault() {
    let (ground, before) = ground();
    let packets = packets(before.join("small.ccsds").to_str().unwrap());
    let second = ground.file("second.ccsds", &packets[packets.len() / 2..].concat());
    let description = ground.file("description.ccsds", &packets[0]);
    ground.replay("before/other", &[&description, &second], &[]);
    std::fs::remove_dir_all(before.join("other.out")).unwrap();
    let args = |place: &Path| {
        let [a, b, map, out] = ["state", "other", "pipeline.toml", "both"].map(|name| path(place, name));
        strings(&["merge", &a, &b, "--map", &map, "--out", &out])
    };
    let result = |place: &Path| newest(place, &["both", "state", "other"]);
    Victim { name: "merge", before, args: &args, result: &result, is_done: "holds a state already" }
        .survive();
}

#[test]
fn a_retraction_survives_every_fault() {
    let (_ground, before) = ground();
    let packets = packets(before.join("small.ccsds").to_str().unwrap());
    let part = &packets[packets.len() / 4..packets.len() / 2];
    std::fs::write(before.join("part.ccsds"), part.concat()).unwrap();
    let args = |place: &Path| {
        let [part, state, map] = ["part.ccsds", "state", "pipeline.toml"].map(|name| path(place, name));
        strings(&["retract", &part, "--state", &state, "--map", &map])
    };
    // Both: the one before the newest does not bring the packets back.
    let result = |place: &Path| {
        let bytes = |path: &PathBuf| std::fs::read(path).unwrap();
        let found = checkpoints(&place.join("state"));
        found.iter().enumerate().map(|(k, path)| (PathBuf::from(k.to_string()), bytes(path))).collect()
    };
    Victim { name: "retract", before, args: &args, result: &result, is_done: "" }.survive();
}

#[test]
fn a_simulation_survives_every_fault() {
    let ground = Ground(Workplace::new(TINY));
    let before = PathBuf::from(ground.path("before"));
    std::fs::create_dir(&before).unwrap();
    std::fs::copy(&ground.pipeline, before.join("pipeline.toml")).unwrap();
    let args = |place: &Path| {
        let [pipeline, out] = ["pipeline.toml", "small.ccsds"].map(|name| path(place, name));
        strings(&["simulate", &pipeline, "--out", &out])
    };
    let result = |place: &Path| {
        let found = std::fs::read(place.join("small.ccsds"));
        found.into_iter().map(|bytes| (PathBuf::from("small.ccsds"), bytes)).collect()
    };
    Victim { name: "simulate", before, args: &args, result: &result, is_done: "" }.survive();
}

fn summary(place: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(place.join("out/summary.json")).unwrap()).unwrap()
}

#[test]
fn a_full_disk_costs_no_maps_and_is_told() {
    let (_ground, before) = ground();
    let victim = Victim { name: "replay", before, args: &replay, result: &replayed, is_done: "" };
    let expected = victim.undisturbed();
    // At first there is room once the older checkpoint has gone, and a disk that fails once serves the second time.
    let is_new = |call: &str| call.starts_with("open /.checkpoint") && call.contains(".partial");
    for (kind, failed) in [("ENOSPC", 0), ("EIO", 1)] {
        let place = victim.place();
        let fault = Fault { kind, at: victim.number(kind, "state", is_new), goes_on: false };
        let (output, _) = run(&replay(place.path()), &place.path().join("state"), fault);
        assert!(output.status.success());
        let saving = &summary(place.path())["saving"];
        assert!(saving["failed"] == failed && saving["unsaved"].is_null(), "{saving}");
        assert!(saving["written"].as_u64() >= Some(1) && replayed(place.path()) == expected, "{saving}");
    }
    // One that stays full: the maps are there, and what is missing is said.
    let place = victim.place();
    let old = newest(place.path(), &["state"]);
    let fault = Fault { kind: "ENOSPC", at: victim.number("ENOSPC", "state", is_new), goes_on: true };
    let (output, _) = run(&replay(place.path()), &place.path().join("state"), fault);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(3));
    for part in [
        "the state was not saved",
        "No space left on device",
        path(place.path(), "state/checkpoint-").as_str(),
    ] {
        assert!(said.contains(part), "{said}");
    }
    assert!(replayed(place.path())[1..] == expected[1..]);
    assert!(newest(place.path(), &["state"]) == old);
    let saving = &summary(place.path())["saving"];
    assert_eq!((&saving["written"], saving["unsaved"].is_string()), (&0.into(), true), "{saving}");
}

/// Two channels whose visibilities are held one by one, in files beside the checkpoints.
const TINY_REFINED: &str = r#"
[spacecraft]
channels_hz = [3.0e6, 5.0e6]
every_nth_window = 300
[map]
engine = "harmonic"
residual_max = 1e-9
refine = { passes_max = 2 }
[runtime]
threads = 1
"#;

#[test]
fn a_disk_that_fills_up_takes_no_held_visibility() {
    let mut settings: toml::Table = TINY.parse().unwrap();
    let more: toml::Table = TINY_REFINED.parse().unwrap();
    for (section, keys) in more {
        let known =
            settings.entry(section).or_insert_with(|| toml::Table::new().into()).as_table_mut().unwrap();
        known.extend(keys.as_table().unwrap().clone());
    }
    let (_ground, before) = ground_of(&settings.to_string(), "60");
    let args = |place: &Path| {
        let [file, map, out, state] =
            ["small.ccsds", "pipeline.toml", "out", "state"].map(|name| path(place, name));
        strings(&[
            "replay",
            &file,
            "--map",
            &map,
            "--out",
            &out,
            "--state",
            &state,
            "--checkpoint-every",
            "60",
        ])
    };
    // A later session without data finds all that the state was said to hold.
    let result = |place: &Path| {
        let [map, again, state] = ["pipeline.toml", "again", "state"].map(|name| path(place, name));
        let output = lunarray(&["replay", "--map", &map, "--out", &again, "--state", &state]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !said.contains("segment"), "{said}");
        files(again.as_ref()).into_iter().filter(|(path, _)| path.ends_with("map.fits")).collect()
    };
    let victim = Victim { name: "held", before, args: &args, result: &result, is_done: "" };
    let expected = victim.undisturbed();
    let calls = victim.calls("ENOSPC");
    let every = if std::env::var("LUNARRAY_LONG").is_ok_and(|text| text == "1") { 1 } else { 3 };
    let tried: Vec<u64> = (1..=calls).step_by(every).collect();
    let met = tried
        .iter()
        .filter(|&&at| {
            let fault = Fault { kind: "ENOSPC", at, goes_on: false };
            victim.attack(fault, Some("No space left on device"), &expected)
        })
        .count();
    eprintln!("held: ENOSPC at {} of {calls} calls, met {met}", tried.len());
    assert!(met + 2 >= tried.len());
}

#[test]
fn a_checkpoint_that_cannot_be_read_is_not_damaged() {
    let (_ground, before) = ground();
    let victim = Victim { name: "replay", before, args: &replay, result: &replayed, is_done: "" };
    for (kind, call) in [("EMFILE", "open"), ("EIO", "read"), ("EACCES", "open")] {
        let place = victim.place();
        let state = place.path().join("state");
        let newest = checkpoints(&state).pop().unwrap();
        let name = newest.file_name().unwrap().to_str().unwrap();
        let at = match call {
            "open" => victim.number(kind, "state", |call| call == format!("open /{name}")),
            _ => victim.number(kind, "state", |found| found.trim() == call),
        };
        let (output, _) = run(&replay(place.path()), &state, Fault { kind, at, goes_on: false });
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(3) && said.contains(newest.to_str().unwrap()), "{kind}: {said}");
        assert!(newest.exists() && checkpoints(&state).len() == 2, "{kind}");
    }
}
