//! Channels that are mapped group by group, or some of them alone.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use lunarray::pipeline::{ConfigSource, GroupSize, JobEvent, MapStep, Plan, RunSummary, run_in_groups};
use lunarray::runtime::Cancel;
use lunarray::units::ChannelId;
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
fn sums_that_wait_on_disk_give_the_bytes_of_those_in_memory() {
    // One channel whose sums take more than all the rest of the program.
    let place = Workplace::new(&SMALL.replace("[3.0e6, 10.0e6]", "[10.0e6]"));
    fn with<'a>(more: &[&'a str]) -> Vec<&'a str> {
        let settings = ["map.engine=harmonic", "map.nside=32", "map.snapshot_every_s=0", "map.epsilon=1e-2"];
        more.iter().copied().chain(settings.into_iter().flat_map(|setting| ["--set", setting])).collect()
    }
    let downlink = place.simulate("x.ccsds", &[]);
    let (whole, parted) = (place.path("whole"), place.path("parted"));
    let all = json(&with(&["replay", &downlink, "--map", &place.pipeline, "--out", &whole]));
    // The least memory that is enough, to ten megabytes.
    let limits = (1..200).map(|k| format!("{}MB", 10 * k));
    let found = limits.into_iter().find_map(|limit| {
        let output = lunarray(&with(&[
            "check",
            &place.pipeline,
            "--groups",
            "auto",
            "--memory-max",
            &limit,
            "--json",
        ]));
        output.status.success().then(|| (limit, serde_json::from_slice::<Value>(&output.stdout).unwrap()))
    });
    let (limit, checked) = found.unwrap();
    let parts =
        checked["groups"]["mapped"].as_array().unwrap().iter().map(|group| group["parts"].as_u64().unwrap());
    assert!(parts.clone().all(|parts| parts > 1), "{checked}");
    let args = [
        "replay",
        &downlink,
        "--map",
        &place.pipeline,
        "--out",
        &parted,
        "--groups",
        "auto",
        "--memory-max",
        &limit,
    ];
    let output = lunarray(&with(&args));
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && told.contains("part 2 of"), "{told}");
    assert!(files(parted.as_ref()) == files(whole.as_ref()));
    let summary: Value =
        serde_json::from_slice(&std::fs::read(format!("{parted}/summary.json")).unwrap()).unwrap();
    for key in ["ledger", "channels"] {
        assert_eq!(summary[key], all[key], "{key}");
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

#[test]
fn a_run_in_groups_leaves_the_bytes_of_one_of_all_channels() {
    // Harmonics, whose batches are counted over all channels; faults on the link.
    let more = ["--set", "spacecraft.model=harmonic", "--set", "downlink.link={duplicate=0.1,pass_cut=0.3}"];
    let place = place();
    let run = |name: &str, groups: &[&str]| {
        let out = place.path(name);
        let summary = json(&[&["run", &place.pipeline, "--out", &out], &more[..], groups].concat());
        (files(out.as_ref()), summary)
    };
    let (all, whole) = run("all", &[]);
    assert!(all.keys().any(|path| path.ends_with("downlink.ccsds")));
    for size in ["1", "2", "auto"] {
        let (found, summary) = run(&format!("by-{size}"), &["--groups", size]);
        assert!(found.keys().eq(all.keys()), "{size}: {:?}", found.keys());
        assert!(found == all, "{size}");
        for key in ["ledger", "reception", "completeness", "seed", "space_hash", "ground_hash", "channels"] {
            assert_eq!(summary[key], whole[key], "{size} {key}");
        }
        let (one, grouped) = (place.path("one.ccsds"), place.path(&format!("{size}.ccsds")));
        succeed(&[&["simulate", &place.pipeline, "--out", &one], &more[..]].concat());
        succeed(&[&["simulate", &place.pipeline, "--out", &grouped, "--groups", size], &more[..]].concat());
        assert!(std::fs::read(one).unwrap() == std::fs::read(grouped).unwrap(), "{size}");
    }
    let checked = json(&["check", &place.pipeline, "--groups", "2"]);
    let mapped = serde_json::json!([{"channels": [0, 1], "parts": 1}, {"channels": [2], "parts": 1}]);
    assert_eq!(checked["groups"], serde_json::json!({"simulated": [[0, 1], [2]], "mapped": mapped}));
    let samples = fail(&["run", &place.pipeline, "--groups", "1", "--set", "spacecraft.fidelity=samples"]);
    assert!(samples.contains("--groups: found spacecraft.fidelity"), "{samples}");
}

#[test]
fn a_ground_is_told_when_its_sums_will_outgrow_memory() {
    let place = place();
    let downlink = place.simulate("x.ccsds", &[]);
    let out = place.path("out");
    let harmonic = ["--set", "map.engine=harmonic", "--map", &place.pipeline, "--out", &out];
    let said = |args: &[&str]| {
        let output = lunarray(&[&["replay", &downlink], &harmonic[..], args].concat());
        assert!(output.status.success());
        String::from_utf8(output.stderr).unwrap()
    };
    let small = said(&["--memory-max", "60MB"]);
    assert!(
        small.contains("the sums of 3 channels at map.nside = ") && small.contains("--groups auto"),
        "{small}"
    );
    assert!(!said(&["--memory-max", "200GB"]).contains("the sums of"));
}

/// The only reading of a group.
fn mapped(group: usize) -> JobEvent {
    JobEvent::Map(MapStep::whole(group))
}

/// All files but `summary.json`, which has times.
fn products_of(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = files(folder);
    found.remove(Path::new(".lock"));
    // Nothing stays that is of use to a later call alone.
    let hidden = found.keys().find(|path| path.file_name().unwrap().to_string_lossy().starts_with('.'));
    assert_eq!(hidden, None);
    found
}

#[test]
fn a_run_in_groups_goes_on_where_it_was_cancelled() {
    let overrides = [
        "spacecraft.channels_hz=[1e6, 2e6, 3e6]",
        "spacecraft.duration_s=30000",
        "spacecraft.auto_powers=true",
        "spacecraft.ninth.on=true",
        "instrument.phase_deg.pass_rms=5",
        "sky.nside=8",
        "map.nside=4",
        "map.snapshot_every_s=0",
        "products.pictures=false",
        "runtime.threads=0",
    ];
    let overrides = overrides.map(str::to_owned).to_vec();
    let config = ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap();
    let plan = Plan::new(config).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let whole = folder.path().join("whole");
    let summary = lunarray::pipeline::run(&plan, &whole, &Cancel::default(), &mut |_| {}).unwrap();
    let expected = products_of(&whole);
    assert!(expected.len() > 6, "{:?}", expected.keys());
    let groups = plan.run_groups(GroupSize::Channels(1), None).unwrap();
    let steps = [
        JobEvent::Simulate(0),
        JobEvent::Simulate(1),
        JobEvent::Simulate(2),
        JobEvent::Merge,
        mapped(0),
        mapped(1),
        mapped(2),
    ];
    for (place, at) in steps.into_iter().enumerate() {
        let out = folder.path().join(format!("cancelled-{place}"));
        let cancel = Cancel::default();
        let cut = run_in_groups(&plan, &groups, &out, &cancel, &mut |step, _| {
            if step == at {
                cancel.cancel();
            }
        });
        let cut = cut.unwrap();
        assert_eq!(cut.is_none(), place < 4, "{at:?}");
        assert!(cut.is_none_or(|cut| cut.cancelled));
        let mut seen = Vec::new();
        let again = run_in_groups(&plan, &groups, &out, &Cancel::default(), &mut |step, graph| {
            seen.extend(graph.map(|_| step));
        });
        let again = again.unwrap().unwrap();
        // What was done before is not done again.
        assert_eq!(seen, steps[place..], "{at:?}");
        assert!(products_of(&out) == expected, "{at:?}");
        assert_eq!(again.ledger, summary.ledger);
        assert_eq!(again.reception, summary.reception);
        assert_eq!(again.completeness, summary.completeness);
        let of = |summary: &RunSummary| serde_json::to_value(&summary.channels).unwrap();
        assert_eq!(of(&again), of(&summary));
    }
}

#[test]
fn other_settings_begin_anew() {
    let sets = |epsilon: &str| {
        let sets = [epsilon, "spacecraft.duration_s=30000", "sky.nside=8", "map.nside=4"];
        let more = ["spacecraft.channels_hz=[1e6, 2e6]", "map.snapshot_every_s=0", "products.pictures=false"];
        let overrides = [&sets[..], &more].concat().into_iter().map(str::to_owned).collect();
        Plan::new(ConfigSource { overrides, ..ConfigSource::default() }.load().unwrap()).unwrap()
    };
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (sets("map.epsilon=1e-3"), sets("map.epsilon=1e-4"));
    let groups = first.run_groups(GroupSize::Channels(1), None).unwrap();
    let cancel = Cancel::default();
    run_in_groups(&first, &groups, folder.path(), &cancel, &mut |step, _| {
        if step == mapped(1) {
            cancel.cancel();
        }
    })
    .unwrap();
    let mut seen = Vec::new();
    run_in_groups(&second, &groups, folder.path(), &Cancel::default(), &mut |step, _| seen.push(step))
        .unwrap();
    // The downlink is the same; no map is. Skies, which take a while, are told as well.
    let of_channel = |number: u16| [JobEvent::Sky(ChannelId(number)), mapped(number.into())];
    assert_eq!(seen, [of_channel(0), of_channel(1)].concat());
    let expected = tempfile::tempdir().unwrap();
    lunarray::pipeline::run(&second, expected.path(), &Cancel::default(), &mut |_| {}).unwrap();
    assert!(products_of(folder.path()) == products_of(expected.path()));
}
