//! The chain in steps, as a browser tab runs it.

use lunarray::pipeline::{ConfigSource, Plan, StepwiseRun};
use lunarray::prelude::*;
use lunarray::sky::fits::{ReadOptions, read_map};

const KEYS: [&str; 6] = [
    "sky.nside=32",
    "spacecraft.channels_hz=[3e6]",
    "spacecraft.every_nth_integration=60",
    "spacecraft.baseline_wavelengths_max=8",
    "map.nside=4",
    "map.snapshot_every_s=2e7",
];

fn plan(more: &[&str]) -> Plan {
    let overrides = KEYS.iter().chain(more).map(|&key| key.to_owned()).collect();
    Plan::new(ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap()).unwrap()
}

#[test]
fn a_run_in_steps_makes_the_maps_of_a_run_in_threads() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path();
    let plan = plan(&[]);
    lunarray::pipeline::run(&plan, out, &Cancel::new(), &mut |_| {}).unwrap();
    let mut run = StepwiseRun::new(&plan).unwrap();
    let mut maps = Vec::new();
    while !run.is_done() {
        maps.extend(run.step().unwrap());
    }
    let last = maps.pop().unwrap();
    assert!(last.is_final && !maps.is_empty() && maps.iter().all(|map| !map.is_final));
    let written = read_map(&out.join("3.000MHz/map.fits"), &ReadOptions::default()).unwrap();
    // A file has single precision.
    let as_written: Vec<f64> = last.map_k.iter().map(|&k| f64::from(k as f32)).collect();
    assert_eq!(written.values(), as_written);
    assert_eq!(run.downlink_bytes(), std::fs::metadata(out.join("downlink.ccsds")).unwrap().len());
    assert!(run.step().unwrap().is_empty());
}

#[test]
fn what_takes_more_stages_is_refused() {
    let joint = ["joint.on=true", "spacecraft.auto_powers=true"];
    for keys in [&["spacecraft.ninth.on=true"][..], &["downlink.link.frame_loss=0.1"], &joint] {
        let error = StepwiseRun::new(&plan(keys)).err().map(|error| error.to_string()).unwrap();
        assert!(error.contains("expected none of these keys"), "{keys:?}: {error}");
    }
}
