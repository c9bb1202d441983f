//! Commands that are told to end: by whom, when and how often.
#![cfg(unix)]

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use super::common::process::{end, hidden, output, signal, start, wait_until, written};
use super::common::workplace::{SMALL, Workplace, files, succeed};

/// Far more than the slowest machine needs from a signal to the end, far less than what is interrupted would take.
const SOON: Duration = Duration::from_secs(60);

/// Number of the signal.
const SIGINT: i32 = 2;

/// A run of many windows.
const LONG: [&str; 4] = ["--set", "spacecraft.every_nth_window=1", "--set", "sky.nside=64"];

fn long_run(place: &Workplace, more: &[&str]) -> Vec<String> {
    let out = place.path("out");
    let fixed = ["run", &place.pipeline, "--out", &out, "--json"];
    [&fixed[..], &LONG, more].concat().into_iter().map(str::to_owned).collect()
}

/// Waits until a megabyte of the downlink of a run is written.
fn wait_for_data(place: &Workplace, child: &mut Child) {
    let out = PathBuf::from(place.path("out"));
    wait_until("data", || {
        assert!(child.try_wait().unwrap().is_none(), "it has ended by itself");
        written(&out, "downlink.ccsds") >= 1 << 20
    });
}

/// Waits for a line of progress, which says that signals are handled; the first comes after ten seconds. Returns what is
/// said from then on.
fn progress(child: &mut Child) -> impl Iterator<Item = String> + use<> {
    let lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let mut lines = lines.map(|line| line.unwrap());
    assert!(lines.any(|line| line.trim_start().split_once(" s:").is_some()), "it has ended by itself");
    lines
}

/// A named pipe.
fn pipe(place: &Workplace) -> String {
    let path = place.path("pipe");
    assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
    path
}

#[test]
fn an_interrupt_ends_a_run_whose_standard_error_nobody_reads() {
    let place = Workplace::new(SMALL);
    for name in ["INT", "TERM", "HUP"] {
        let args = long_run(&place, &[]);
        let mut child = start(&args.iter().map(String::as_str).collect::<Vec<_>>());
        drop(child.stderr.take());
        drop(child.stdout.take());
        wait_for_data(&place, &mut child);
        signal(&child, name);
        let (status, took) = end(&mut child);
        let code =
            128 + ["HUP", "INT"].iter().position(|other| *other == name).map_or(15, |at| at as i32 + 1);
        assert_eq!(status.code(), Some(code), "{name}: {status:?}");
        assert!(took < SOON, "{name}: {took:?}");
        succeed(&["inspect", &place.path("out/downlink.ccsds")]);
        assert!(Path::new(&place.path("out/summary.json")).exists());
        assert_eq!(hidden(Path::new(&place.path("out"))), [] as [PathBuf; 0]);
        std::fs::remove_dir_all(place.path("out")).unwrap();
    }
}

#[test]
fn a_run_without_time_for_its_final_maps_lists_the_others() {
    let free = "matrix = 'free'\nsnapshot_every_s = 2e6";
    let place = Workplace::new(&SMALL.replace("epsilon = 1e-4", free).replace("nside = 4", "nside = 8"));
    let out = PathBuf::from(place.path("out"));
    let mut child = start(
        &[
            &["run", &place.pipeline, "--out", &place.path("out"), "--json"][..],
            &["--set", "runtime.grace_s=0"],
        ]
        .concat(),
    );
    wait_until("a map", || {
        assert!(child.try_wait().unwrap().is_none(), "it has ended by itself");
        out.join("3.000MHz/latest.fits").exists()
    });
    signal(&child, "INT");
    assert_eq!(end(&mut child).0.code(), Some(130));
    let summary: serde_json::Value =
        serde_json::from_slice(&std::fs::read(out.join("summary.json")).unwrap()).unwrap();
    assert_eq!(summary["channels"].as_array().unwrap().len(), 0);
    let mut listed: Vec<PathBuf> = summary["intermediate_files"]
        .as_array()
        .unwrap()
        .iter()
        .map(|file| file.as_str().unwrap().into())
        .collect();
    listed.sort();
    let there =
        files(&out).into_keys().filter(|name| name.starts_with("3.000MHz") || name.starts_with("10.000MHz"));
    assert_eq!(listed, there.collect::<Vec<PathBuf>>());
}

#[test]
fn a_signal_that_was_ignored_at_the_start_stays_ignored() {
    let place = Workplace::new(SMALL);
    let mut child = Command::new("sh")
        .args(["-c", "trap '' HUP; exec \"$0\" \"$@\""])
        .arg(assert_cmd::cargo::cargo_bin("lunarray"))
        .args(long_run(&place, &[]))
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    wait_for_data(&place, &mut child);
    signal(&child, "HUP");
    let out = PathBuf::from(place.path("out"));
    // It goes on: there is more, long after the signal.
    let before = written(&out, "downlink.ccsds");
    wait_until("more data", || {
        assert!(child.try_wait().unwrap().is_none(), "SIGHUP ended it");
        written(&out, "downlink.ccsds") > before + (4 << 20)
    });
    signal(&child, "TERM");
    assert_eq!(end(&mut child).0.code(), Some(143));
}

#[test]
fn while_it_sets_up_a_signal_ends_it_at_once() {
    let place = Workplace::new(SMALL);
    // Patterns of baselines of 10,000 wavelengths take minutes, and nothing can be saved.
    let out = place.path("out");
    let mut child = start(
        &[
            &["run", &place.pipeline, "--out", &out][..],
            &["--set", "spacecraft.channels_hz=[30e6]", "--set", "spacecraft.baseline_wavelengths_max=0"],
            &["--set", "spacecraft.model=\"harmonic\"", "--set", "sky.nside=512", "--set", "sky.l_max=1024"],
            // It does not come so far as to need it.
            &["--memory-max", "1000GB"],
        ]
        .concat(),
    );
    wait_until("its folder", || Path::new(&out).join(".lock").exists());
    std::thread::sleep(Duration::from_millis(300));
    assert!(child.try_wait().unwrap().is_none());
    signal(&child, "INT");
    let (status, took) = end(&mut child);
    assert_eq!(status.signal(), Some(SIGINT), "{status:?}");
    assert!(took < SOON, "{took:?}");
    // No file but its settings, and the lock, which nobody holds.
    assert_eq!(hidden(Path::new(&out)), [Path::new(&out).join(".lock")]);
    assert!(Path::new(&out).join("pipeline.toml").exists());
    assert_eq!(std::fs::read_dir(&out).unwrap().count(), 2);
}

#[test]
fn before_the_first_window_there_is_no_downlink() {
    let place = Workplace::new(SMALL);
    let (folder, pipeline) = (place.path("new"), &place.pipeline);
    let file = format!("{folder}/sky.ccsds");
    let mut child = start(
        &[
            &["simulate", pipeline, "--out", &file][..],
            // The first window takes minutes: all pairs and times, each over twelve million pixels.
            &["--set", "sky.nside=1024", "--set", "sky.generated.small_scales=false"],
            &["--set", "spacecraft.model=\"direct\"", "--set", "spacecraft.channels_hz=[3e6]"],
            &["--set", "spacecraft.baseline_wavelengths_max=0"],
            &["--set", "spacecraft.every_nth_integration=1"],
        ]
        .concat(),
    );
    drop(progress(&mut child));
    signal(&child, "INT");
    let (status, took) = end(&mut child);
    assert_eq!(status.code(), Some(130), "{status:?}");
    assert!(took < SOON, "{took:?}");
    let mut printed = String::new();
    child.stdout.take().unwrap().read_to_string(&mut printed).unwrap();
    assert!(printed.contains("There is nothing to write"), "{printed}");
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 0);
}

#[test]
fn the_second_signal_ends_it_at_once() {
    let place = Workplace::new(SMALL);
    let (pipe, file) = (pipe(&place), place.simulate("small.ccsds", &[]));
    let mut child = start(
        &[
            &["replay", &pipe, "--map", &place.pipeline, "--out", &place.path("out")][..],
            &["--set", "runtime.grace_s=100000"],
        ]
        .concat(),
    );
    let mut feed = File::options().write(true).open(&pipe).unwrap();
    feed.write_all(&std::fs::read(&file).unwrap()[..10_000]).unwrap();
    let mut said = progress(&mut child);
    // `timeout` signals its child and then the group: one request.
    signal(&child, "INT");
    signal(&child, "INT");
    assert!(said.any(|line| line.contains("interrupt again to stop immediately")));
    std::thread::sleep(Duration::from_millis(500));
    assert!(child.try_wait().unwrap().is_none(), "the first signal ended it, with time left");
    signal(&child, "TERM");
    let (status, took) = end(&mut child);
    assert_eq!(status.code(), Some(143), "{status:?}");
    assert!(took < SOON, "{took:?}");
    drop(feed);
}

#[test]
fn a_pipe_that_says_nothing_does_not_hold_it() {
    let place = Workplace::new(SMALL);
    let (pipe, file) = (pipe(&place), place.simulate("small.ccsds", &[]));
    let session = |from: &str, state: &str| -> Vec<String> {
        let (out, state) = (place.path(&format!("{state}.out")), place.path(state));
        let args = ["replay", from, "--map", &place.pipeline, "--out", &out, "--state", &state, "--json"];
        args.map(str::to_owned).to_vec()
    };
    let run = |args: &[String]| start(&args.iter().map(String::as_str).collect::<Vec<_>>());
    let newest = |state: &str| {
        let entries = std::fs::read_dir(place.path(state)).unwrap().map(|entry| entry.unwrap().path());
        let checkpoint = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "lunarray");
        std::fs::read(entries.filter(checkpoint).max().unwrap()).unwrap()
    };
    assert!(output(run(&session(&file, "whole"))).status.success());
    let mut child = run(&session(&pipe, "cut"));
    let mut feed = File::options().write(true).open(&pipe).unwrap();
    // More than is read at a time, and not all: the rest never comes.
    let bytes = std::fs::read(&file).unwrap();
    feed.write_all(&bytes[..bytes.len() / 2]).unwrap();
    let said = progress(&mut child);
    signal(&child, "INT");
    let (status, took) = end(&mut child);
    assert_eq!(status.code(), Some(130), "{:?}", said.collect::<Vec<_>>());
    assert!(took < SOON, "{took:?}");
    drop(feed);
    let _ = newest("cut");
    assert!(output(run(&session(&file, "cut"))).status.success());
    assert!(newest("cut") == newest("whole"));
}

#[test]
fn nobody_reads_and_nothing_panics() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("small.ccsds", &[]);
    let out = place.path("out");
    for args in [
        &["check", &place.pipeline][..],
        &["inspect", &file],
        &["inspect", &file, "--json"],
        &["geometry", "--at", "2h"],
        &["--help"],
        &["replay", &file, "--map", &place.pipeline, "--out", &out],
        &["check", "no such file"],
        &["no such command"],
    ] {
        for closes in ["stdout", "stderr", "both"] {
            let mut child = start(args);
            // Whatever is printed later finds no reader.
            let stdout = child.stdout.take().filter(|_| closes == "stderr");
            let stderr = child.stderr.take().filter(|_| closes == "stdout");
            let mut said = String::new();
            stderr.map(|mut stderr| stderr.read_to_string(&mut said));
            stdout.map(|mut stdout| stdout.read_to_end(&mut Vec::new()));
            let (status, _) = end(&mut child);
            // A wrong command and a configuration that cannot be read are told alike.
            let code = if args.concat().contains("no such") { 2 } else { 0 };
            assert_eq!(status.code(), Some(code), "{args:?}, {closes}: {said}");
            assert!(!said.contains("panicked"), "{args:?}: {said}");
        }
    }
}

#[test]
fn interrupted_samples_leave_the_state_and_say_so() {
    let finer =
        SMALL.replace("epsilon = 1e-4", "").replace("engine = 'pixel'", "").replace("nside = 4", "nside = 8");
    let place = Workplace::new(&finer);
    let file = place.simulate("all.ccsds", &["--set", "spacecraft.channels_hz=[3.0e6]"]);
    let (state, maps, out) = (place.path("state"), place.path("maps"), place.path("samples"));
    succeed(&["replay", &file, "--map", &place.pipeline, "--state", &state, "--out", &maps]);
    let before = files(Path::new(&state));
    // Minutes.
    let mut child = start(&["sample", &state, "--count", "10000", "--gibbs", "--out", &out]);
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(|line| line.unwrap());
    // The first line of progress comes after ten seconds.
    assert!(lines.any(|line| line.contains("of 10000")), "it has ended by itself");
    signal(&child, "INT");
    let (status, took) = end(&mut child);
    assert_eq!(status.code(), Some(130), "{status:?}");
    assert!(took < SOON, "{took:?}");
    assert!(lines.any(|line| line.contains("ended early: samples of 0 channels")));
    assert!(!Path::new(&out).exists() && files(Path::new(&state)) == before);
}

/// Maps of two channels, whose solutions take a while.
const ITERATED: &str = r#"
name = "iterated"
[sky]
nside = 16
[spacecraft]
channels_hz = ["3MHz", "10MHz"]
thin = 600
baseline_wavelengths_max = 16.0
[map]
engine = "harmonic"
nside = 8
[products]
pictures = false
"#;

/// Requires of every channel the maps of `whole`, or, where there were none, maps that say that they are not converged.
fn require_whole_or_marked(out: &Path, whole: &Path, had_maps: bool, said: &str) -> usize {
    let mut marked = 0;
    for channel in ["3.000MHz", "10.000MHz"] {
        let read = |folder: &Path, name: &str| std::fs::read(folder.join(channel).join(name)).ok();
        let names = ["map.fits", "latest.fits", "noise.fits", "sigma.fits", "mask.fits"];
        if names.iter().all(|name| read(out, name) == read(whole, name)) {
            continue;
        }
        assert!(!had_maps, "{channel}: a map was replaced\n{said}");
        assert!(["noise.fits", "sigma.fits", "mask.fits"].iter().all(|name| read(out, name).is_none()));
        // Or there was no time for any.
        if let Some(map) = read(out, "map.fits") {
            assert!(String::from_utf8_lossy(&map).contains("CONVERGD=                    F"), "{said}");
            assert!(said.contains("not converged: interrupted after"), "{said}");
            marked += 1;
        }
    }
    marked
}

#[test]
fn maps_whose_solution_is_interrupted_replace_none_and_say_so() {
    let place = Workplace::new(ITERATED);
    let file = place.simulate("sent.ccsds", &[]);
    let (state, whole) = (place.path("state"), place.path("whole"));
    let replay = |out: &str, more: &[&str]| {
        let fixed = ["replay", &file, "--map", &place.pipeline, "--state", &state, "--out", out];
        start(&[&fixed[..], more].concat())
    };
    let begun = std::time::Instant::now();
    assert!(output(replay(&whole, &[])).status.success());
    // A second session reads nothing anew: its time is that of the solutions.
    let step = begun.elapsed() / 24;
    let (mut cancelled, mut marked) = (0, 0);
    for grace in ["0", "0.05"] {
        for number in 0..12_u32 {
            for had_maps in [false, true] {
                let out = place.path(&format!("out-{grace}-{number}-{had_maps}"));
                if had_maps {
                    assert!(output(replay(&out, &[])).status.success());
                }
                let mut child = replay(&out, &["--set", &format!("runtime.grace_s={grace}")]);
                std::thread::sleep(number * step);
                let has_ended = child.try_wait().unwrap().is_some();
                if !has_ended {
                    signal(&child, "TERM");
                }
                let ended = output(child);
                let said = String::from_utf8_lossy(&ended.stdout);
                let out = Path::new(&out);
                marked += require_whole_or_marked(out, Path::new(&whole), had_maps, &said);
                // The signal may come before there is anything to save, or after the end.
                match (ended.status.code(), ended.status.signal()) {
                    (Some(143), _) => {
                        let summary = std::fs::read_to_string(out.join("summary.json")).unwrap();
                        assert!(summary.contains("\"cancelled\": true"), "{said}");
                        assert!(said.contains("Ended early"), "{said}");
                        cancelled += 1;
                    }
                    (Some(0), _) => assert!(!said.contains("Ended early"), "{said}"),
                    (code, signal) => assert_eq!((code, signal), (None, Some(15)), "{said}"),
                }
            }
        }
    }
    assert!(cancelled > 0, "no signal came in time");
    println!("{cancelled} interrupted, {marked} maps marked");
}
