//! `lunarray bench`: every stage is measured in consistent units, on a named machine.

use assert_cmd::Command;
use serde_json::Value;

/// Two channels for 125 hops of 64 samples, and a remainder that is not sampled.
const PIPELINE: &str = r#"
name = "bench"
sky.nside = 4
map.nside = 4
[spacecraft]
fidelity = "samples"
channels_hz = [1.0e6, 20.0e6]
duration_s = 26e3
window_s_max = 1.004
flag_earth = false # the last daughters see the Earth for 64 s of a window
"#;

const STAGES: [&str; 6] = ["sample", "link", "correlate", "transmit", "receive", "chain"];

fn bench(more: &[&str]) -> std::process::Output {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pipeline.toml");
    std::fs::write(&path, PIPELINE).unwrap();
    let mut command = Command::cargo_bin("lunarray").unwrap();
    command.args(["bench", path.to_str().unwrap()]).args(more).output().unwrap()
}

fn json(more: &[&str]) -> Value {
    let output = bench(&[more, &["--json"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is not a number"))
}

fn close(found: f64, expected: f64) -> bool {
    // Quotients of the same numbers, printed with all digits.
    (found / expected - 1.0).abs() < 1e-9
}

#[test]
fn every_stage_is_measured_in_consistent_units() {
    let found = json(&["--runs", "3"]);
    assert!(!found["machine"]["processor"].as_str().unwrap().is_empty());
    assert!(number(&found["machine"]["threads"]) >= 1.0);
    assert_eq!(found["machine"]["version"], env!("CARGO_PKG_VERSION"));
    assert!(found["machine"]["date"].as_str().unwrap().ends_with('Z'));
    for (key, expected) in [("channels", 2.0), ("daughters", 8.0), ("bits", 8.0), ("sky_pixels", 192.0)] {
        assert_eq!(number(&found[key]), expected, "{key}");
    }
    // Times are whole microseconds.
    assert!((number(&found["mission_s"]) - 1.004).abs() < 2e-6, "{}", found["mission_s"]);
    let rates = found["rates"].as_array().unwrap();
    let names: Vec<&str> = rates.iter().map(|rate| rate["stage"].as_str().unwrap()).collect();
    assert_eq!(names, STAGES);
    for rate in rates {
        let samples_per_s = number(&rate["samples_per_s"]);
        let [slow, fast] = [0, 1].map(|k| number(&rate["samples_per_s_range"][k]));
        assert!(0.0 < slow && slow <= samples_per_s && samples_per_s <= fast, "{rate}");
        // Real time is that of what is measured: eight daughters, two channels of 8 kHz.
        assert!(close(number(&rate["times_real_time"]), samples_per_s / (8.0 * 2.0 * 8e3)), "{rate}");
        let mut runs: Vec<f64> = rate["runs_s"].as_array().unwrap().iter().map(number).collect();
        runs.sort_by(f64::total_cmp);
        // Of three runs the quartiles are the ends.
        let told = [&rate["quartiles_s"][0], &rate["median_s"], &rate["quartiles_s"][1]].map(number);
        assert_eq!(runs, told);
        let stage = rate["stage"].as_str().unwrap();
        assert_eq!(number(&rate["visibilities_per_s"]) > 0.0, !["sample", "link"].contains(&stage), "{rate}");
        let bytes_a_sample = number(&rate["bytes_per_s"]) / samples_per_s;
        match stage {
            // Two parts of 8 bits.
            "sample" | "link" | "correlate" | "chain" => assert!(close(bytes_a_sample, 2.0), "{rate}"),
            _ => assert!(bytes_a_sample > 0.0, "{rate}"),
        }
        if let Some(core_s) = rate["core_s_per_mission_s"].as_f64() {
            // Processor time is at most elapsed time times the number of processors. A dozen threads may each be counted a
            // tick of 10 ms too much.
            let processors = std::thread::available_parallelism().unwrap().get() as f64;
            let longest_s = 2.0 * 8.0 * 8e3 / slow;
            assert!(core_s >= 0.0 && core_s * 1.004 <= longest_s * processors + 0.12, "{rate}");
        }
    }
    let stages = found["chain"]["report"]["stages"].as_array().unwrap();
    let names: Vec<&str> = stages.iter().map(|stage| stage["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["sample", "link", "correlate", "store", "transmit", "receive", "drop"]);
    assert_eq!((number(&stages[0]["units"]), &stages[0]["unit"]), (2.0 * 8.0 * 8e3, &Value::from("samples")));
    let queues = found["chain"]["queues"].as_array().unwrap();
    assert_eq!(queues.len(), names.len() - 1);
    let looks = found["chain"]["times_s"].as_array().unwrap().len();
    assert!(queues.iter().all(|queue| queue["series"].as_array().unwrap().len() == looks));
    assert!(names.contains(&found["saturates_first"].as_str().unwrap()));
    assert!(!found["ground"]["report"]["stages"].as_array().unwrap().is_empty());
    assert!(found["growth"].as_array().unwrap().is_empty());
}

#[test]
fn one_stage_is_measured_alone_and_unknown_ones_are_refused() {
    let found = json(&["--runs", "1", "--stage", "link"]);
    assert_eq!(found["rates"].as_array().unwrap().len(), 1);
    assert_eq!(found["rates"][0]["stage"], "link");
    assert!(found["chain"].is_null() && found["ground"].is_null() && found["saturates_first"].is_null());

    let output = bench(&["--runs", "1", "--stage", "correlate"]);
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    let mut lines = text.lines();
    assert!(lines.next().unwrap().starts_with(concat!("lunarray ", env!("CARGO_PKG_VERSION"))), "{text}");
    assert!(lines.next().unwrap().ends_with("worker threads") && text.contains("\ncorrelate "), "{text}");

    // Beside itself, and beside something else.
    let folder = tempfile::tempdir().unwrap();
    let baseline = folder.path().join("baseline.json");
    std::fs::write(&baseline, found.to_string()).unwrap();
    let baseline = baseline.to_str().unwrap();
    let compared = json(&["--runs", "1", "--stage", "link", "--compare", baseline]);
    let stage = &compared["comparison"]["stages"][0];
    assert_eq!((&stage["stage"], &stage["before_s"]), (&Value::from("link"), &found["rates"][0]["median_s"]));
    assert_eq!(stage["now_s"], compared["rates"][0]["median_s"]);
    let output =
        bench(&["--runs", "1", "--stage", "link", "--set", "daughters.bits=4", "--compare", baseline]);
    assert!(String::from_utf8(output.stderr).unwrap().contains("bits = 8; expected 4"));

    for (wrong, word) in [(["--stage", "sky"], "sample"), (["--runs", "0"], "1..=1000")] {
        let output = bench(&wrong);
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(text.contains(word), "{text}");
    }
}
