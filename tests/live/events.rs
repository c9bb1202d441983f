//! `--events`: a run told line by line.

use super::common::process::{output, start};
use super::common::workplace::maps;
use super::serving::SNAPSHOTS;
use super::*;

/// The lines of a file of events.
fn events_of(text: &str) -> Vec<Value> {
    assert!(text.ends_with('\n'));
    let events: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    for event in &events {
        assert!(event["event"].is_string() && event["unix_s"].as_f64().unwrap() > 1.7e9, "{event}");
    }
    assert!(events.is_sorted_by_key(|event| event["elapsed_s"].as_f64().unwrap()));
    assert_eq!(events[0]["event"], "begin");
    let ends = events.iter().filter(|event| event["event"] == "end").count();
    assert!(ends == 1 && events[events.len() - 1]["event"] == "end", "{text}");
    events
}

fn of_kind<'a>(events: &'a [Value], kind: &str) -> Vec<&'a Value> {
    events.iter().filter(|event| event["event"] == kind).collect()
}

fn summary_in(folder: &str) -> Value {
    serde_json::from_slice(&std::fs::read(format!("{folder}/summary.json")).unwrap()).unwrap()
}

#[test]
fn events_agree_with_the_summary() {
    let place = Place::new();
    let (out, file) = (place.path("out"), place.path("events.ndjson"));
    let run = ["run", place.pipeline(), "--out", &out, "--events", &file];
    succeed(&[&run[..], &SNAPSHOTS].concat());
    let events = events_of(&std::fs::read_to_string(&file).unwrap());
    let (summary, last) = (summary_in(&out), &events[events.len() - 1]);
    assert_eq!((&last["status"], &last["summary"]), (&"complete".into(), &summary));
    assert_eq!((&events[0]["name"], &events[0]["segment"]), (&"small".into(), &"whole".into()));
    // Each map, as it was made, with the figures of the summary.
    for (number, channel) in summary["channels"].as_array().unwrap().iter().enumerate() {
        let told: Vec<&Value> =
            of_kind(&events, "map").into_iter().filter(|map| map["channel"] == number).collect();
        let snapshots = channel["snapshots"].as_array().unwrap();
        assert_eq!(told.len(), snapshots.len());
        for (map, snapshot) in told.iter().zip(snapshots) {
            assert_eq!(map["is_final"], *snapshot == snapshots[snapshots.len() - 1]);
            for (key, value) in snapshot.as_object().unwrap() {
                assert_eq!(&map[key], value, "{key}");
            }
        }
    }
    let progress = of_kind(&events, "progress");
    let whole = progress[progress.len() - 1];
    assert_eq!((&whole["ledger"], &whole["reception"]), (&summary["ledger"], &summary["reception"]));
    let stages = summary["report"]["stages"].as_array().unwrap();
    for (told, stage) in whole["stages"].as_array().unwrap().iter().zip(stages) {
        for key in ["name", "items_in", "items_out", "units"] {
            assert_eq!(told[key], stage[key], "{key}");
        }
    }
    assert_eq!(of_kind(&events, "stage-ended").len(), stages.len());

    // A replay on standard output, with a state; then a simulation; then a failure.
    let (out, state, downlink) = (place.path("again"), place.path("state"), place.path("out/downlink.ccsds"));
    let replay = ["replay", &downlink, "--map", place.pipeline(), "--out", &out, "--state", &state];
    let events = events_of(&succeed(&[&replay[..], &["--events", "-"]].concat()));
    assert_eq!(events[events.len() - 1]["summary"], summary_in(&out));
    let checkpoints = of_kind(&events, "checkpoint");
    assert_eq!(checkpoints[checkpoints.len() - 1]["written"], summary_in(&out)["saving"]["written"]);
    let file = place.path("simulated.ccsds");
    let events = events_of(&succeed(&["simulate", place.pipeline(), "--out", &file, "--events", "-"]));
    let last = &events[events.len() - 1];
    assert_eq!((&last["status"], &last["summary"]["cancelled"]), (&"complete".into(), &false.into()));
    let empty = place.workplace.file("empty.ccsds", b"");
    let failing = ["replay", &empty, "--map", place.pipeline(), "--out", &out, "--events", "-"];
    let ended = lunarray(&failing);
    assert!(!ended.status.success());
    let events = events_of(&String::from_utf8(ended.stdout).unwrap());
    let last = &events[events.len() - 1];
    assert_eq!(last["status"], "failed");
    assert!(String::from_utf8(ended.stderr).unwrap().contains(last["error"].as_str().unwrap()));
}

/// A pipe with a name, so full that nothing more goes into it while it is held.
fn full_pipe(path: &str) -> std::fs::File {
    use std::os::unix::fs::OpenOptionsExt;
    const O_NONBLOCK: i32 = 0o4000; // Of Linux.
    assert!(Process::new("mkfifo").arg(path).status().unwrap().success());
    let mut pipe =
        std::fs::File::options().read(true).write(true).custom_flags(O_NONBLOCK).open(path).unwrap();
    while pipe.write(&[b' '; 4096]).is_ok() {}
    pipe
}

#[test]
fn a_reader_of_events_who_goes_or_sleeps_does_not_stop_the_run() {
    let place = Place::new();
    let expected = place.path("expected");
    succeed(&[&["run", place.pipeline(), "--out", &expected][..], &SNAPSHOTS].concat());
    let pipe = place.path("pipe");
    let asleep = full_pipe(&pipe);
    for (name, events, note) in
        [("gone", "-", "no more events are written"), ("asleep", pipe.as_str(), "nobody reads the events")]
    {
        let out = place.path(name);
        let run = ["run", place.pipeline(), "--out", &out, "--events", events];
        let mut child = start(&[&run[..], &SNAPSHOTS].concat());
        drop(child.stdout.take());
        let ended = output(child);
        let said = String::from_utf8(ended.stderr).unwrap();
        assert!(ended.status.success() && said.contains(note), "{name}: {said}");
        assert!(maps(&out) == maps(&expected), "{name}");
    }
    drop(asleep);
    assert!(complaint(&["run", place.pipeline(), "--events", "/nowhere/events"]).contains("/nowhere/events"));
}
