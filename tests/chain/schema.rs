//! The published schema of summaries, by a validator of other people. (Summaries that other tests read are held to it by
//! `common::schema`.)

use crate::common;

use std::path::Path;
use std::process::Command;

use common::process::{output, start};
use common::schema::problems;
use common::workplace::{SMALL, Workplace, lunarray, succeed};
use serde_json::{Value, json};

fn schema() -> Value {
    serde_json::from_str(&succeed(&["config", "--schema", "summary"])).unwrap()
}

/// Summaries of runs that leave something in every part of the schema.
fn summaries(place: &Workplace) -> Vec<String> {
    let pipeline = place.pipeline.as_str();
    let mut found = Vec::new();
    let mut ran = |name: &str, args: &[&str]| {
        let out = place.path(name);
        let done = lunarray(&[args, &["--out", &out]].concat());
        assert!(done.status.success(), "{args:?}: {}", String::from_utf8_lossy(&done.stderr));
        found.push(format!("{out}/summary.json"));
    };
    let whole = ["products.smooth_fwhm_deg=20", "map.snapshot_every_s=1e7", "map.trace_probes=2"];
    let refined = ["map.engine=\"harmonic\"", "map.refine.passes_max=1"];
    for (name, settings) in [("whole", &whole[..]), ("refined", &refined[..])] {
        let set: Vec<&str> = settings.iter().flat_map(|set| ["--set", set]).collect();
        ran(name, &[&["run", pipeline], set.as_slice()].concat());
    }
    // Coded frames with faults on the way, to a ground with a state.
    let lossy = ["--set", "downlink.link.bit_error_rate=1e-5"];
    let coded = place.simulate("coded.cadu", &[&["--format", "cadu"], lossy.as_slice()].concat());
    let state = place.path("state");
    ran("ground", &["replay", &coded, "--map", pipeline, "--state", &state]);
    let plain = place.simulate("plain.ccsds", &[]);
    ran("groups", &["replay", &plain, "--map", pipeline, "--groups", "1"]);

    // Live.
    let out = place.path("live");
    let listen = ["--listen", "tcp://127.0.0.1:0", "--connections", "1", "--out", &out];
    let mut ground = start(&[&["replay", "--map", pipeline], listen.as_slice()].concat());
    let url = common::process::listening(&mut ground);
    succeed(&["simulate", pipeline, "--send", &url]);
    assert!(output(ground).status.success());
    found.push(format!("{out}/summary.json"));
    found
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn summaries_are_as_the_published_schema_says() {
    let place = Workplace::new(SMALL);
    let schema_file = place.file("schema.json", schema().to_string().as_bytes());
    let mut files = summaries(&place);
    let read = |file: &String| -> Value { serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap() };
    for file in &files {
        common::schema::check_summary(&read(file));
    }
    // Parts that are there or not.
    let has =
        |path: &str| files.iter().any(|file| read(file).pointer(path).is_some_and(|part| !part.is_null()));
    for part in
        ["/listening/senders/listed/0", "/saving", "/earlier_reports/0", "/reception/frames/channels/0"]
    {
        assert!(has(part), "no summary with {part}");
    }
    for part in ["post_processing", "refinement", "diagnostics/traces", "diagnostics/convergence", "power"] {
        assert!(has(&format!("/channels/0/{part}")), "no channel with {part}");
    }

    // What it must not accept: named so that the reader knows.
    let whole = read(&files[0]);
    type Change = fn(&mut Value);
    let wrong: [(&str, Change); 6] = [
        ("unknown", |summary| summary["more"] = json!(1)),
        ("deep", |summary| summary["channels"][0]["diagnostics"]["more"] = json!(1)),
        ("missing", |summary| drop(summary.as_object_mut().unwrap().remove("ledger"))),
        ("type", |summary| summary["reception"]["bytes"] = json!("many")),
        ("negative", |summary| summary["ledger"]["sampled"] = json!(-1)),
        ("hash", |summary| summary["ground_hash"] = json!("0x12")),
    ];
    for (name, change) in wrong {
        let mut changed = whole.clone();
        change(&mut changed);
        let mut found = Vec::new();
        problems(&schema(), &schema(), &changed, "summary", &mut found);
        assert!(!found.is_empty(), "{name} was accepted");
        files.push(place.file(&format!("wrong-{name}.json"), changed.to_string().as_bytes()));
    }
    let python = common::python();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/summary_schema.py");
    let done = Command::new(python).arg(script).arg(schema_file).args(&files).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert_eq!(String::from_utf8_lossy(&done.stdout).lines().count(), files.len());
}

#[test]
fn a_schema_is_printed_instead_of_a_pipeline() {
    let text = succeed(&["config", "--schema", "summary"]);
    assert_eq!(text.trim_end(), include_str!("../../docs/summary.schema.json").trim_end());
    let both = lunarray(&["config", "--schema", "summary", "--print", "quicklook"]);
    assert_eq!(both.status.code(), Some(2));
}

#[test]
fn the_page_of_keys_is_that_of_the_program() {
    let page = succeed(&["explain", "--markdown"]);
    let kept = std::fs::read_to_string("docs/keys.md").unwrap();
    assert!(page == kept, "docs/keys.md is not current: write it anew with `lunarray explain --markdown`");
    // The table has the everyday keys, the file that the page includes all.
    assert!(page.contains("{{#include ../pipelines/reference.toml}}"));
    let reference = std::fs::read_to_string("pipelines/reference.toml").unwrap();
    let lines = succeed(&["explain", "map", "--json"]);
    for line in lines.lines() {
        let described = serde_json::from_str::<Value>(line).unwrap();
        let key = described["key"].as_str().unwrap();
        let name = key.rsplit('.').next().unwrap();
        let forms = [format!("\n{name} ="), format!("\n#{name} ="), format!("\n[{key}]\n")];
        let found: Vec<bool> = forms.iter().map(|form| reference.contains(form)).collect();
        assert!(found.contains(&true), "{key}");
        let is_in_table = page.contains(&format!("| `{key}` |")) || page.contains(&format!("| `{key} = "));
        let is_section = found[2];
        assert!(is_section || is_in_table == (described["everyday"] == true), "{key}");
    }
}
