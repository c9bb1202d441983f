//! Channels that are mapped group by group, or some of them alone.

use serde_json::Value;

use crate::common::workplace::{SMALL, Workplace, fail, files, json, lunarray, succeed};

/// Three channels.
fn place() -> Workplace {
    Workplace::new(&SMALL.replace("[3.0e6, 10.0e6]", "[3.0e6, 5.0e6, 10.0e6]"))
}

#[test]
fn groups_of_channels_give_the_bytes_of_all_at_once() {
    let place = place();
    let downlink = place.simulate("x.ccsds", &["--set", "downlink.link={duplicate=0.1,pass_cut=0.3}"]);
    let replay = |name: &str, more: &[&str]| {
        let out = place.path(name);
        let summary = json(&[&["replay", &downlink, "--map", &place.pipeline, "--out", &out], more].concat());
        (files(out.as_ref()), summary)
    };
    let (all, whole) = replay("all", &[]);
    assert_eq!(all.keys().filter(|path| path.ends_with("map.fits")).count(), 3);
    for size in ["1", "2", "auto"] {
        let (found, summary) = replay(&format!("by-{size}"), &["--groups", size]);
        assert!(found.keys().eq(all.keys()), "{size}");
        assert!(found == all, "{size}");
        for key in ["ledger", "reception", "completeness", "seed", "space_hash", "ground_hash"] {
            assert_eq!(summary[key], whole[key], "{size} {key}");
        }
        let maps = |summary: &Value| -> Vec<Value> {
            let channels = summary["channels"].as_array().unwrap().iter();
            channels.map(|channel| channel["files"].clone()).collect()
        };
        assert_eq!(maps(&summary), maps(&whole), "{size}");
    }
}

#[test]
fn some_channels_are_mapped_and_the_others_counted() {
    let place = place();
    let downlink = place.simulate("x.ccsds", &[]);
    let replay = |name: &str, channels: &str| {
        let out = place.path(name);
        json(&["replay", &downlink, "--map", &place.pipeline, "--out", &out, "--channels", channels])
    };
    let [all, some, rest] =
        [("all", "0-2"), ("some", "0,2"), ("rest", "1")].map(|(name, list)| replay(name, list));
    let ledger = |summary: &Value, key: &str| summary["ledger"][key].as_u64().unwrap();
    let flagged = |summary: &Value, reason: &str| summary["ledger"]["flagged"][reason].as_u64().unwrap_or(0);
    let not_mapped = |summary: &Value| flagged(summary, "channel not among map.channels");
    assert_eq!(ledger(&some, "sampled"), ledger(&all, "sampled"));
    assert_eq!(ledger(&some, "accumulated") + ledger(&rest, "accumulated"), ledger(&all, "accumulated"));
    // What one leaves to the other.
    assert_eq!(not_mapped(&all), 0);
    for (here, there) in [(&some, &rest), (&rest, &some)] {
        let offered = ledger(there, "accumulated") + flagged(there, "baseline beyond the map's limit");
        assert!(offered > 0 && not_mapped(here) == offered);
    }
    let mapped = |summary: &Value| summary["channels"].as_array().unwrap().len();
    assert_eq!([&all, &some, &rest].map(mapped), [3, 2, 1]);
    let estimate = |channels: &str| json(&["check", &place.pipeline, "--channels", channels]);
    let mapped = |channels: &str| -> Vec<f64> {
        let estimate = estimate(channels);
        let channels = estimate["channels"].as_array().unwrap().iter();
        channels.map(|channel| channel["visibilities_mapped"].as_f64().unwrap()).collect()
    };
    let (all, one) = (mapped("0-2"), mapped("1"));
    assert_eq!(one, [0.0, all[1], 0.0]);
}

#[test]
fn groups_that_cannot_be_made_say_why() {
    let place = place();
    let downlink = place.simulate("x.ccsds", &[]);
    let out = place.path("out");
    let said = |args: &[&str]| fail(&[&["replay", "--map", &place.pipeline, "--out", &out], args].concat());
    assert!(said(&[&place.path(""), "--groups", "1"]).contains("expected one with --groups"));
    assert!(
        said(&[&downlink, "--channels", "3"])
            .contains("map.channels[0] = 3: expected a channel of the instrument, 0 to 2")
    );
    let tail = std::fs::read(&downlink).unwrap();
    // Each pass describes the instrument at its beginning.
    let tail = place.file("tail.ccsds", &tail[tail.len() - 1000..]);
    assert!(said(&[&tail, "--groups", "1"]).contains("no description of the instrument"));
    let output = lunarray(&["replay", &downlink, "--out", &out, "--groups", "0"]);
    assert!(String::from_utf8(output.stderr).unwrap().contains("expected auto, or a number"));
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--out", &out, "--groups", "2"]);
}
