//! Runs that lose blocks, last long, stall or fail.

use std::path::Path;
use std::sync::mpsc;
use std::time::Duration;

use lunarray::downlink::{FileSource, Recorder, Transmitter};
use lunarray::frames::{GroundFrame, SpaceFrame};
use lunarray::ground::Reception;
use lunarray::mother::Store;
use lunarray::pipeline::{ConfigSource, Plan, SampleCounts, sample_stages};
use lunarray::runtime::{Cancel, Flow, Graph, Outlet, RuntimeError, Source, Stage};

use crate::craft::constant;

const PIPELINE: &str = r#"
    name = "robust"
    seed = 5
    sky.nside = 4
    [spacecraft]
    fidelity = "samples"
    channels_hz = [1.0e6]
    duration_s = 26e3
    window_s_max = 4.0
    flag_earth = false # the last daughters see the Earth for 64 s of a window
    baseline_wavelengths_max = 24.0
    [map]
    engine = 'pixel'
    nside = 4
    epsilon = 1e-2
    [products]
    pictures = false
"#;

fn pipeline(folder: &Path) -> std::path::PathBuf {
    let path = folder.join("robust.toml");
    std::fs::write(&path, PIPELINE).unwrap();
    path
}

/// Runs the whole chain; returns its summary and the peak memory of the process, kB.
fn run(folder: &Path, name: &str, sets: &[&str]) -> (serde_json::Value, u64) {
    let out = folder.join(name);
    let mut command = std::process::Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
    command.args(["run", pipeline(folder).to_str().unwrap(), "--out", out.to_str().unwrap()]);
    command.args(sets.iter().flat_map(|set| ["--set", set]));
    command.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::piped());
    let mut child = command.spawn().unwrap();
    let status = format!("/proc/{}/status", child.id());
    let mut peak_kb = 0;
    while child.try_wait().unwrap().is_none() {
        let text = std::fs::read_to_string(&status).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:"));
        let found = line.and_then(|line| line.trim().strip_suffix(" kB")?.parse().ok());
        peak_kb = found.unwrap_or(0).max(peak_kb);
        std::thread::sleep(Duration::from_millis(10));
    }
    let done = child.wait_with_output().unwrap();
    let text = std::fs::read_to_string(out.join("summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
    // The run fails, with that reason, if and only if the link loses so much that there is no map.
    let said = String::from_utf8_lossy(&done.stderr);
    let has_map = !summary["channels"].as_array().unwrap().is_empty();
    assert_eq!((done.status.success(), said.contains("so there is no map")), (has_map, !has_map), "{said}");
    (summary, peak_kb)
}

fn count(value: &serde_json::Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value} is no count"))
}

/// Sampled, accumulated, flagged and lost of a ledger.
fn ledger_counts(ledger: &serde_json::Value) -> [u64; 4] {
    let flagged = ledger["flagged"].as_object().unwrap().values().map(count).sum();
    let lost = ledger["lost"].as_array().unwrap().iter().map(|loss| count(&loss["count"])).sum();
    [count(&ledger["sampled"]), count(&ledger["accumulated"]), flagged, lost]
}

#[test]
fn lost_blocks_are_in_the_ledgers_of_samples_and_of_visibilities() {
    let folder = tempfile::tempdir().unwrap();
    // Eight bits need 128 kbit/s; a block is 2 kB.
    let sets = ["daughters.link_bits_per_s_max=110e3", "daughters.link_buffer_bytes=4096"];
    let (summary, _) = run(folder.path(), "slow", &sets);
    let samples = &summary["samples"];
    let [sampled, used, flagged, lost] = ledger_counts(&samples["ledger"]);
    // Three windows of 4 s, eight daughters.
    assert_eq!(sampled, 3 * 4 * 8_000 * 8);
    assert_eq!((sampled, flagged), (used + lost, 0));
    let dropped = count(&samples["link"]["dropped_samples"]);
    // 18 of 128 kbit/s exceed the link, except what the buffer holds at the end.
    assert!(lost == dropped && dropped > sampled / 20, "{samples}");
    let blocks = &samples["blocks"];
    assert_eq!(count(&blocks["missing"]), count(&samples["link"]["dropped"]));
    let [sampled, accumulated, flagged, lost] = ledger_counts(&summary["ledger"]);
    assert_eq!(sampled, count(&samples["visibilities"]));
    assert_eq!(sampled, accumulated + flagged + lost);
    let incomplete = count(&summary["ledger"]["flagged"]["incomplete integration"]);
    assert!(incomplete > 0 && accumulated + flagged == sampled, "{}", summary["ledger"]);
    // A fast enough link loses nothing.
    let (summary, _) = run(folder.path(), "fast", &["daughters.link_bits_per_s_max=128e3"]);
    let [sampled, used, ..] = ledger_counts(&summary["samples"]["ledger"]);
    assert_eq!((sampled, count(&summary["samples"]["blocks"]["missing"])), (used, 0));
}

#[test]
#[cfg_attr(not(target_os = "linux"), ignore = "needs /proc")]
fn an_hour_takes_the_memory_of_ten_minutes() {
    let folder = tempfile::tempdir().unwrap();
    // Two windows of half an hour, and of five minutes.
    let sets = |seconds: &'static str| ["spacecraft.duration_s=17e3", seconds];
    let (summary, short_kb) = run(folder.path(), "short", &sets("spacecraft.window_s_max=300"));
    assert_eq!(ledger_counts(&summary["samples"]["ledger"])[0], 2 * 300 * 8_000 * 8);
    let (summary, long_kb) = run(folder.path(), "long", &sets("spacecraft.window_s_max=1800"));
    assert_eq!(ledger_counts(&summary["samples"]["ledger"])[0], 2 * 1800 * 8_000 * 8);
    eprintln!("{short_kb} kB in ten minutes, {long_kb} kB in an hour");
    // Visibilities and auto-correlations grow, by 21 bytes each in the store and some hundred in the final table: 29000
    // auto-correlations in an hour and some thousand visibilities. With doubling buffers and the allocator 16 MB is a
    // cautious bound; the samples alone, of one byte per part, are 77 MB and 461 MB.
    assert!(long_kb < short_kb + 16_384, "{short_kb} kB, {long_kb} kB");
}

/// Passes a number of frames through; then it panics, or blocks for ever.
struct Faulty {
    left: u32,
    hold: Option<mpsc::Receiver<()>>,
}

impl Stage for Faulty {
    type In = SpaceFrame;
    type Out = SpaceFrame;
    type Error = std::convert::Infallible;

    fn step(&mut self, frame: SpaceFrame, out: &mut Outlet<SpaceFrame>) -> Result<(), Self::Error> {
        if self.left == 0 {
            let Some(hold) = &self.hold else { panic!("a bit of radiation") };
            hold.recv().ok();
        }
        self.left = self.left.saturating_sub(1);
        out.push(frame);
        Ok(())
    }
}

/// Runs the space segment with a stage that fails in the last window; returns the error, and how much of the unfinished
/// file is readable.
fn broken(hold: Option<mpsc::Receiver<()>>) -> (RuntimeError, usize) {
    let folder = tempfile::tempdir().unwrap();
    let source = ConfigSource { file: Some(pipeline(folder.path())), ..ConfigSource::default() };
    let plan = Plan::new(source.load().unwrap()).unwrap();
    let models = vec![constant(0.0)(1e6)];
    let (sampler, link, correlator) = sample_stages(&plan, models, &SampleCounts::default());
    let mut graph = Graph::new();
    let sent = graph.source("sample", 8, sampler);
    let received = graph.stage("link", 8, sent, link);
    // Printing the backtrace of a panic takes seconds on a busy machine, so the deadline is long unless a stall is wanted.
    let stall_s = if hold.is_some() { 2 } else { 60 };
    // A window of 4 s has 32 blocks of each daughter, a start and an end.
    let passed = graph.stage("faulty", 8, received, Faulty { left: 2 * (32 * 8 + 2) + 100, hold });
    let frames = graph.stage("correlate", 8, passed, correlator);
    let passes = graph.stage("store", 8, frames, Store::new(&plan.config.spacecraft, None));
    let bytes = graph.stage("transmit", 8, passes, Transmitter::new(&plan.config.downlink).unwrap());
    let file = folder.path().join("downlink.ccsds");
    graph.sink("record", bytes, Recorder::create(&file).unwrap());
    graph.fail_after_stall(Duration::from_secs(stall_s));
    let error = graph.run(&Cancel::new(), Duration::from_secs(1)).unwrap_err();
    assert!(!file.exists());
    let partial = folder.path().join("downlink.ccsds.partial");
    let mut source = FileSource::open(&[partial]).unwrap();
    let (mut bytes, mut out) = (Outlet::collect(), Outlet::collect());
    while source.next(&mut bytes).unwrap() == Flow::Continue {}
    let account = std::sync::Arc::default();
    let mut reception = Reception::new(0, 1024, std::sync::Arc::clone(&account));
    for bytes in bytes.into_vec() {
        reception.step(bytes, &mut out).unwrap();
    }
    reception.finish(&mut out).unwrap();
    let account = account.lock().unwrap();
    assert_eq!((account.bytes_damaged, account.bytes_garbage, account.bytes_truncated), (0, 0, 0));
    let reports = out.items().iter().filter(|frame| matches!(frame, GroundFrame::Housekeeping(_)));
    (error, reports.count())
}

#[test]
fn a_stage_that_panics_is_named_and_leaves_a_readable_file() {
    let (error, windows) = broken(None);
    let RuntimeError::Panicked { stage, message, .. } = &error else { panic!("{error:?}") };
    assert_eq!((stage.as_str(), message.as_str()), ("faulty", "a bit of radiation"));
    // The second window may still be in the queues.
    assert!((1..=2).contains(&windows), "{windows}");
}

#[test]
fn a_stage_that_stalls_is_named_and_leaves_a_readable_file() {
    let (release, hold) = mpsc::channel();
    let (error, windows) = broken(Some(hold));
    drop(release);
    let RuntimeError::Stalled { stages, .. } = &error else { panic!("{error:?}") };
    assert!(stages.contains(&"faulty".to_owned()), "{stages:?}");
    // Nothing else was left to do.
    assert_eq!(windows, 2);
}
