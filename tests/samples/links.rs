//! Links from the daughters that are slower than the sample rate.

use std::path::Path;
use std::sync::Arc;

use lunarray::array::ArrayConfig;
use lunarray::daughters::{DropPolicy, SampleLink};
use lunarray::runtime::{Outlet, Stage};
use serde_json::Value;

use crate::common::schema::check_summary;
use crate::craft::{Spacecraft, blocks, constant, frequencies};

const PIPELINE: &str = r#"
    name = "links"
    seed = 7
    sky.nside = 4
    [daughters]
    link_bits_per_s_max = 100e3
    [spacecraft]
    fidelity = "samples"
    channels_hz = [1.0e6]
    duration_s = 17e3
    window_s_max = 20.48
    flag_earth = false # the last daughters see the Earth for 64 s of a window
    baseline_wavelengths_max = 24.0
    [map]
    engine = 'pixel'
    nside = 4
    epsilon = 1e-2
    [products]
    pictures = false
"#;

/// Runs the program with these settings; returns its standard output.
fn lunarray(folder: &Path, command: &str, sets: &[&str]) -> String {
    let pipeline = folder.join("links.toml");
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let mut run = assert_cmd::Command::cargo_bin("lunarray").unwrap();
    run.args([command, pipeline.to_str().unwrap()]).args(sets.iter().flat_map(|set| ["--set", set]));
    if command == "run" {
        run.args(["--out", folder.to_str().unwrap()]);
    }
    let done = run.output().unwrap();
    // The run fails, with that reason, if and only if the link loses so much that there is no map.
    let said = String::from_utf8_lossy(&done.stderr);
    let summary = std::fs::read_to_string(folder.join("summary.json")).unwrap_or_else(|_| "null".to_owned());
    let summary: Value = serde_json::from_str(&summary).unwrap();
    let has_map = command != "run" || !summary["channels"].as_array().unwrap().is_empty();
    assert_eq!((done.status.success(), said.contains("so there is no map")), (has_map, !has_map), "{said}");
    String::from_utf8(done.stdout).unwrap()
}

/// The sample counters of a run.
fn samples(folder: &Path, sets: &[&str]) -> Value {
    lunarray(folder, "run", sets);
    let text = std::fs::read_to_string(folder.join("summary.json")).unwrap();
    let mut summary: Value = serde_json::from_str(&text).unwrap();
    check_summary(&summary);
    summary["samples"].take()
}

/// Blocks of 1024 samples in a window, and windows times daughters.
const BLOCKS: u64 = 160;
const STREAMS: u64 = 2 * 8;

#[test]
fn what_a_deep_buffer_holds_arrives_after_the_window_and_is_used() {
    let folder = tempfile::tempdir().unwrap();
    // 28 of 128 kbit/s wait: 35 blocks of each daughter at the window's end, more than the mother waits for of one
    // daughter while another's come.
    let samples = samples(folder.path(), &[]);
    let blocks = &samples["blocks"];
    let of = |key: &str| blocks[key].as_u64().unwrap();
    assert_eq!((of("used"), of("missing"), of("late")), (BLOCKS * STREAMS, 0, 0), "{samples}");
    assert_eq!(samples["link"]["dropped"], 0);
    assert_eq!(samples["ledger"]["sampled"], samples["ledger"]["accumulated"]);
    // Bits of 35 blocks, of one more or less.
    let waiting = samples["link"]["waiting_bits_max"].as_f64().unwrap() / 16_384.0;
    assert!((waiting - 35.0).abs() <= 1.0, "{waiting}");
}

#[test]
fn what_a_link_has_no_time_for_is_dropped_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    for policy in ["newest", "oldest"] {
        let drop = format!("daughters.link_drop={policy}");
        let sets = ["daughters.link_bits_per_s_max=100", "spacecraft.wait_blocks=1024", &drop];
        let samples = samples(folder.path(), &sets);
        // 100 bit/s for an orbit of 8248.68 s are 50.3 blocks of 16384 bits.
        let (sent, dropped) = (50 * STREAMS, (BLOCKS - 50) * STREAMS);
        assert_eq!((&samples["link"]["sent"], &samples["link"]["dropped"]), (&sent.into(), &dropped.into()));
        let blocks = &samples["blocks"];
        let of = |key: &str| blocks[key].as_u64().unwrap();
        assert_eq!((of("used"), of("missing"), of("late")), (sent, dropped, 0), "{policy}: {samples}");
        let lost: u64 =
            samples["ledger"]["lost"].as_array().unwrap().iter().map(|l| l["count"].as_u64().unwrap()).sum();
        assert_eq!(lost, dropped * 1024);
    }
}

#[test]
fn check_holds_the_rate_that_is_needed_against_the_links() {
    let folder = tempfile::tempdir().unwrap();
    let slow = lunarray(folder.path(), "check", &[]);
    assert!(slow.contains("128.000 kbit/s needed by a daughter, 100.000 there; the rest waits"), "{slow}");
    let fast = lunarray(folder.path(), "check", &["daughters.link_bits_per_s_max=128e3"]);
    assert!(fast.contains("128.000 kbit/s needed by a daughter, 128.000 there\n"), "{fast}");
    let free = lunarray(folder.path(), "check", &["daughters.link_bits_per_s_max=0"]);
    assert!(!free.contains("needed by a daughter"), "{free}");
}

#[test]
fn a_full_buffer_costs_all_channels_the_same() {
    let channels = 4;
    let mut craft = Spacecraft::new(ArrayConfig::default(), frequencies(channels), constant(0.0), 8.192);
    craft.daughters.bits = 8;
    // Four channels of 128 kbit/s on a link for less than two and a half, with a buffer of two blocks each.
    craft.daughters.link_bits_per_s_max = 300e3;
    craft.daughters.link_buffer_bytes = 8 * 2048;
    let frames = craft.sample(41).0;
    for policy in [DropPolicy::Newest, DropPolicy::Oldest] {
        craft.daughters.link_drop = policy;
        let mut link = SampleLink::new(&craft.daughters, &craft.array, Arc::default());
        let mut out = Outlet::collect();
        for frame in frames.clone() {
            link.step(frame, &mut out).unwrap();
        }
        let mut sent = vec![0; channels];
        for block in blocks(&out.into_vec()).filter(|block| block.daughter == 5) {
            sent[usize::from(block.channel.0)] += 1;
        }
        // 64 times: 150 of 256 blocks are sent, plus the buffer at the end. Channels differ by one turn at most, and by the
        // two blocks that are queued at the end.
        let share = 64.0 * 300.0 / 512.0;
        for sent in &sent {
            assert!((f64::from(*sent) - share).abs() <= 3.0, "{policy:?}: {sent} of {share}");
        }
    }
}
