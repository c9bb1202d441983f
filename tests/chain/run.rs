//! The whole chain through the command: space and ground segment run separately give the same result as together, and
//! the output depends on the seed and the configuration alone.

use crate::common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use common::process::{wait_until, written};
use common::workplace::{Workplace, fail, files, lunarray, succeed};
use lunarray::sky::fits::{ReadOptions, read_map};
use serde_json::Value;

/// A small mission: real geometry, small maps, at most a few minutes of work.
const SMALL: &str = r#"
name = "small"
seed = 7
[sky]
nside = 16
[spacecraft]
channels_hz = [3.0e6, 10.0e6]
every_nth_window = 200
every_nth_integration = 3
baseline_wavelengths_max = 16.0
[map]
engine = 'pixel'
nside = 8
epsilon = [1e-6, 1e-4]
snapshot_every_s = 1.5e7
"#;

const NO_PICTURES: [&str; 2] = ["--set", "products.pictures=false"];

fn run(place: &Workplace, out: &str, more: &[&str]) -> BTreeMap<PathBuf, Vec<u8>> {
    let out = place.path(out);
    succeed(&[&["run", place.pipeline.as_str(), "--out", &out], more].concat());
    files(Path::new(&out))
}

fn assert_same(one: &BTreeMap<PathBuf, Vec<u8>>, other: &BTreeMap<PathBuf, Vec<u8>>) {
    assert!(one.keys().eq(other.keys()), "{:?} {:?}", one.keys(), other.keys());
    for (path, bytes) in one {
        assert!(bytes == &other[path], "{} differs", path.display());
    }
}

#[test]
fn space_and_ground_give_the_same_apart_as_together() {
    let place = Workplace::new(SMALL);
    let whole = run(&place, "whole", &[]);
    let downlink = place.simulate("small.ccsds", &[]);
    assert!(std::fs::read(&downlink).unwrap() == whole[Path::new("downlink.ccsds")]);
    let out = place.path("ground");
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--out", &out]);
    let ground = files(Path::new(&out));
    let maps = |files: &BTreeMap<PathBuf, Vec<u8>>| {
        files.iter().filter(|(path, _)| path.extension().is_some_and(|e| e == "fits")).count()
    };
    assert!(maps(&ground) >= 4, "a map and a noise map for each of two channels");
    // The ground segment does not know the truth, so it draws fewer pictures; the others are the same.
    for (path, bytes) in &ground {
        if path.extension().is_some_and(|e| e == "fits") {
            assert!(bytes == &whole[path], "{} differs", path.display());
        }
    }
}

#[test]
fn capacities_and_threads_do_not_change_a_byte() {
    let place = Workplace::new(SMALL);
    let reference = run(&place, "reference", &[]);
    for (name, capacity, threads) in [("one", "1", "1"), ("three", "3", "3"), ("many", "999", "2")] {
        let capacity = format!("runtime.queue_capacity={capacity}");
        let threads = format!("runtime.threads={threads}");
        let other = run(&place, name, &["--set", &capacity, "--set", &threads]);
        assert_same(&reference, &other);
    }
}

#[test]
fn the_settings_that_a_run_leaves_repeat_it() {
    let place = Workplace::new(SMALL);
    let first =
        run(&place, "first", &["--set", "map.epsilon=[1e-3, 1e-5]", "--seed", "3", "--format", "cadu"]);
    let settings = place.path("first/pipeline.toml");
    succeed(&["check", &settings]);
    let second = place.path("second");
    succeed(&["run", &settings, "--out", &second]);
    assert_same(&first, &files(Path::new(&second)));
    let text = |folder: &str| std::fs::read_to_string(place.path(folder) + "/pipeline.toml").unwrap();
    assert_eq!(text("first"), text("second"));
}

#[test]
fn the_seed_changes_the_noise() {
    let place = Workplace::new(SMALL);
    let one = run(&place, "one", &["--set", "products.pictures=false"]);
    let other = run(&place, "other", &["--set", "products.pictures=false", "--seed", "8"]);
    assert!(one[Path::new("downlink.ccsds")] != other[Path::new("downlink.ccsds")]);
}

#[test]
fn the_ledger_closes_and_the_summary_is_complete() {
    let place = Workplace::new(SMALL);
    let out = place.path("out");
    let text = succeed(&["run", &place.pipeline, "--out", &out, "--json"]);
    let printed: Value = serde_json::from_str(&text).unwrap();
    let written: Value =
        serde_json::from_slice(&std::fs::read(Path::new(&out).join("summary.json")).unwrap()).unwrap();
    assert_eq!(printed, written);
    let count = |value: &Value| value.as_u64().unwrap();
    let ledger = &written["ledger"];
    let flagged: u64 = ledger["flagged"].as_object().unwrap().values().map(count).sum();
    assert!(ledger["lost"].as_array().unwrap().is_empty());
    assert_eq!(count(&ledger["sampled"]), count(&ledger["accumulated"]) + flagged);
    assert_eq!(written["channels"].as_array().unwrap().len(), 2);
    for channel in written["channels"].as_array().unwrap() {
        for file in channel["files"].as_array().unwrap() {
            assert!(Path::new(&out).join(file.as_str().unwrap()).exists(), "{file}");
        }
    }
}

/// With fewer visibilities than the sky has structure the map is smooth, not wild: 1,410 visibilities of a sky that is much finer than the map.
#[test]
fn few_data_of_a_fine_sky_give_a_smooth_map() {
    let place = Workplace::new("");
    let settings =
        ["spacecraft.channels_hz=[10e6]", "spacecraft.every_nth_window=410", "sky.nside=128", "map.nside=8"];
    let out = place.path("few");
    let mut args = vec!["run", "--out", &out, NO_PICTURES[0], NO_PICTURES[1]];
    args.extend(settings.iter().flat_map(|setting| ["--set", *setting]));
    succeed(&args);
    let of = |name: &str| {
        read_map(&Path::new(&out).join("10.000MHz").join(name), &ReadOptions::default()).unwrap()
    };
    let (map, sky) = (of("map.fits"), of("input.fits"));
    let differences = map.values().iter().zip(sky.values()).map(|(a, b)| a - b);
    let rms = |squares: f64| (squares / sky.values().len() as f64).sqrt();
    let error_k = rms(differences.map(|off| off * off).sum());
    let sky_k = rms(sky.values().iter().map(|value| value * value).sum());
    // The map that says nothing, 0 K, has 1; the sky's mean alone is wrong by some 0.4, its structure.
    assert!(error_k < 0.4 * sky_k, "{error_k} {sky_k}");
}

#[test]
fn a_lost_span_is_counted_and_the_rest_is_used() {
    let place = Workplace::new(SMALL);
    let downlink = place.simulate("small.ccsds", &[]);
    let mut bytes = std::fs::read(&downlink).unwrap();
    let middle = bytes.len() / 2;
    bytes.drain(middle..middle + bytes.len() / 20);
    let damaged = place.path("damaged.ccsds");
    std::fs::write(&damaged, bytes).unwrap();
    let out = place.path("out");
    let text = succeed(&["replay", &damaged, "--map", &place.pipeline, "--out", &out, "--json"]);
    let summary: Value = serde_json::from_str(&text).unwrap();
    let lost = &summary["ledger"]["lost"];
    assert!(lost.as_array().unwrap().iter().any(|loss| loss["count"].as_u64().unwrap() > 0), "{lost}");
    assert!(summary["ledger"]["accumulated"].as_u64().unwrap() > 0);
}

#[test]
fn a_channel_without_usable_data_does_not_affect_others() {
    let place = Workplace::new(SMALL);
    let out = place.path("out");
    // At nside 1, 10 MHz, no baseline is short enough.
    let sets = ["--set", "map.nside=1", "--set", "map.epsilon=1e-4", "--set", "products.pictures=false"];
    let text = succeed(&[&["run", place.pipeline.as_str(), "--out", &out, "--json"], &sets[..]].concat());
    let summary: Value = serde_json::from_str(&text).unwrap();
    let channels = summary["channels"].as_array().unwrap();
    assert_eq!(channels.len(), 1, "{channels:?}");
    assert_eq!(channels[0]["frequency_hz"], 3e6);
}

#[test]
fn files_out_of_order_lose_nothing_but_the_cut_packet() {
    let place = Workplace::new(SMALL);
    let downlink = place.simulate("small.ccsds", &[]);
    let bytes = std::fs::read(&downlink).unwrap();
    let (first, second) = bytes.split_at(bytes.len() / 2);
    let (one, two) = (place.path("one"), place.path("two"));
    std::fs::write(&one, first).unwrap();
    std::fs::write(&two, second).unwrap();
    let ledger = |files: &[&str]| {
        let out = place.path("ground");
        let args = ["--map", &place.pipeline, "--out", &out, "--json"];
        let text = succeed(&[&["replay"], files, &args].concat());
        serde_json::from_str::<Value>(&text).unwrap()["ledger"].clone()
    };
    let whole = ledger(&[&downlink]);
    let swapped = ledger(&[&two, &one]);
    assert_eq!(whole["sampled"], swapped["sampled"]);
    let lost: u64 =
        swapped["lost"].as_array().unwrap().iter().map(|loss| loss["count"].as_u64().unwrap()).sum();
    // A packet of 8192 bytes holds visibilities of 21 bytes.
    assert!(lost <= 8192 / 21, "{lost}");
}

#[test]
fn a_file_given_twice_counts_once() {
    let place = Workplace::new(SMALL);
    let downlink = place.simulate("small.ccsds", &[]);
    let replay = |out: &str, files: &[&str]| {
        let out = place.path(out);
        let args = ["--map", &place.pipeline, "--out", &out, "--json"];
        let text = succeed(&[&["replay"], files, &args].concat());
        (serde_json::from_str::<Value>(&text).unwrap(), files_of_maps(Path::new(&out)))
    };
    let (once, maps_once) = replay("once", &[&downlink]);
    let (twice, maps_twice) = replay("twice", &[&downlink, &downlink]);
    assert_eq!(once["ledger"]["accumulated"], twice["ledger"]["accumulated"]);
    assert_same(&maps_once, &maps_twice);
}

fn files_of_maps(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = files(folder);
    found.retain(|path, _| path.file_name().is_some_and(|name| name == "map.fits"));
    found
}

#[cfg(unix)]
#[test]
fn an_interrupt_leaves_maps_of_the_data_so_far() {
    let place = Workplace::new(SMALL);
    let out = place.path("out");
    let binary = assert_cmd::cargo::cargo_bin("lunarray");
    let mut child = std::process::Command::new(binary)
        .args(["run", &place.pipeline, "--out", &out, "--json"])
        // Far longer than the test runs.
        .args(["--set", "spacecraft.every_nth_window=1", "--set", "sky.nside=64"])
        // However busy the machine, the maps are made.
        .args(["--set", "runtime.grace_s=100000"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::null())
        .spawn()
        .unwrap();
    // Wait until the downlink has more than the queues hold, so that some of it is in the sums, however busy the machine.
    wait_until("four megabytes", || {
        assert!(child.try_wait().unwrap().is_none(), "it has ended by itself");
        written(Path::new(&out), "downlink.ccsds") >= 4 << 20
    });
    let id = child.id().to_string();
    assert!(std::process::Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    let since = Instant::now();
    while child.try_wait().unwrap().is_none() {
        assert!(since.elapsed() < Duration::from_secs(120), "still running two minutes after Ctrl-C");
        std::thread::sleep(Duration::from_millis(50));
    }
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(130));
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(summary["cancelled"], true);
    assert!(summary["channels"][0]["visibilities"].as_u64().unwrap() > 0);
    let downlink = Path::new(&out).join("downlink.ccsds");
    let contents = succeed(&["inspect", downlink.to_str().unwrap(), "--json"]);
    assert!(serde_json::from_str::<Value>(&contents).is_ok());
}

#[test]
fn a_run_without_a_map_fails_and_says_why() {
    let place = Workplace::new(SMALL);
    let out = place.path("none");
    let none = [&["run", place.pipeline.as_str(), "--out", &out], &NO_PICTURES[..]].concat();
    let short = fail(&[&none[..], &["--set", "spacecraft.duration_s=100"]].concat());
    assert!(short.contains("spacecraft.duration_s = 100: there is no observing window"), "{short}");
    assert!(
        fail(&["check", &place.pipeline, "--set", "spacecraft.duration_s=100"])
            .contains("no observing window")
    );
    // Weights above the limit: nothing is accumulated, and the ledger says so.
    let refused =
        fail(&[&none[..], &["--set", "map.weight_max=1e-30", "--set", "map.snapshot_every_s=0"]].concat());
    assert!(refused.contains("no visibility of a pair could be used"), "{refused}");
    assert!(refused.contains("weight above map.weight_max"), "{refused}");
}

#[test]
fn a_reused_folder_holds_only_the_products_of_its_last_run() {
    let place = Workplace::new(SMALL);
    run(&place, "used", &NO_PICTURES);
    let own = place.file("used/3.000MHz/notes.txt", b"mine");
    assert!(Path::new(&place.path("used/10.000MHz/map.fits")).exists());
    let one = ["--set", "spacecraft.channels_hz=[3e6]", "--set", "map.epsilon=1e-6"];
    let found = run(&place, "used", &[&NO_PICTURES[..], &one].concat());
    let fresh = run(&place, "fresh", &[&NO_PICTURES[..], &one].concat());
    assert!(!Path::new(&place.path("used/10.000MHz")).exists());
    assert_eq!(std::fs::read(own).unwrap(), b"mine");
    assert_eq!(found.len(), fresh.len() + 1);
}

#[test]
fn the_sky_command_writes_the_sky_of_a_run() {
    let place = Workplace::new(SMALL);
    let sky = place.path("sky.fits");
    succeed(&["sky", &place.pipeline, "--freq-hz", "3e6", "--nside", "8", "--no-picture", "--out", &sky]);
    // A run generates its sky at sky.nside and averages; the command generates it directly.
    let found = run(&place, "out", &[&NO_PICTURES[..], &["--set", "sky.nside=8"]].concat());
    let read = |path: &str| {
        let options = lunarray::sky::fits::ReadOptions::default();
        lunarray::sky::fits::read_whole_map(Path::new(path), &options).unwrap().into_values()
    };
    assert!(found.contains_key(Path::new("3.000MHz/input.fits")));
    assert_eq!(read(&sky), read(&place.path("out/3.000MHz/input.fits")));
}

#[test]
fn a_replay_that_is_told_nothing_gives_the_maps_of_the_run() {
    // Settings that are not the defaults, in a folder that `run` leaves.
    let place = Workplace::new(SMALL);
    let out = place.path("ran");
    let set = ["--set", "map.epsilon=[1e-3,1e-5]", "--set", "map.nside=4"];
    succeed(&[&["run", &place.pipeline, "--out", &out], &set[..]].concat());
    let downlink = format!("{out}/downlink.ccsds");
    let replay = |name: &str, file: &str, more: &[&str]| {
        let out = place.path(name);
        let done = lunarray(&[&["replay", file, "--out", &out], more].concat());
        let said = String::from_utf8(done.stderr).unwrap();
        assert!(done.status.success(), "{said}");
        (files_of_maps(Path::new(&out)), said)
    };
    let (maps, said) = replay("told-nothing", &downlink, &[]);
    assert_same(&maps, &files_of_maps(Path::new(&out)));
    assert!(said.contains(&format!("settings of the maps: those of {out}/pipeline.toml")), "{said}");
    // What is said on the command line counts more; and so does a map file, of which the rest are defaults.
    let first = |maps: &BTreeMap<PathBuf, Vec<u8>>| maps.values().next().unwrap().clone();
    let epsilon = ["--set", "map.epsilon=1e-4"];
    let (other, _) = replay("set", &downlink, &epsilon);
    assert!(first(&other) != first(&maps));
    let of_file = [&["--map", &place.pipeline], &epsilon[..]].concat();
    let (plain, said) = replay("file", &downlink, &of_file);
    assert!(first(&plain) != first(&other) && !said.contains("settings of the maps"), "{said}");
    let (same, _) = replay("file-and-set", &downlink, &[&of_file[..], &set[2..]].concat());
    assert!(first(&same) == first(&other), "nothing else differs");

    // The pipeline of another space segment says nothing about this one.
    let elsewhere = place.path("elsewhere");
    std::fs::create_dir(&elsewhere).unwrap();
    let copied = format!("{elsewhere}/copy.ccsds");
    std::fs::copy(&downlink, &copied).unwrap();
    let changed = std::fs::read_to_string(format!("{out}/pipeline.toml")).unwrap();
    std::fs::write(format!("{elsewhere}/pipeline.toml"), changed.replacen("seed = 7", "seed = 8", 1))
        .unwrap();
    let (defaults, said) = replay("defaults", &copied, &epsilon);
    assert!(!said.contains("settings of the maps"), "{said}");
    assert!(said.contains(&format!("the settings in {elsewhere}/pipeline.toml are not used")), "{said}");
    assert!(said.contains("its seed or its mission is not the downlink's"), "{said}");
    std::fs::write(format!("{elsewhere}/pipeline.toml"), changed.replacen("seed = 7", "seed = [", 1))
        .unwrap();
    let (_, said) = replay("unreadable", &copied, &["--set", "map.nside=2"]);
    assert!(said.contains("are not used, as it cannot be loaded"), "{said}");
    // nside 16 by default.
    assert!(first(&defaults).len() > first(&maps).len());

    // A state keeps to its settings, whatever lies beside later files.
    let state = place.path("state");
    replay("begun", &copied, &["--set", "map.nside=2", "--state", &state]);
    let (maps, _) = replay("again", &downlink, &["--state", &state]);
    let nside = |bytes: &[u8]| String::from_utf8_lossy(bytes).contains("NSIDE   =                    2");
    assert!(nside(&first(&maps)));
}

#[test]
fn the_quicklook_is_known_wherever_its_downlink_lies() {
    let place = Workplace::new(SMALL);
    let file = place.path("alone.ccsds");
    // The space segment of the quicklook; its packets in other pieces, which is no matter of the hash.
    succeed(&["simulate", "--out", &file, "--set", "downlink.packet_bytes_max=60000"]);
    let out = place.path("out");
    let done = lunarray(&[
        "replay",
        &file,
        "--out",
        &out,
        "--set",
        "map.nside=4",
        "--set",
        "products.pictures=false",
    ]);
    let said = String::from_utf8(done.stderr).unwrap();
    assert!(
        done.status.success() && said.contains("settings of the maps: those of embedded quicklook"),
        "{said}"
    );
    let summary: Value =
        serde_json::from_slice(&std::fs::read(format!("{out}/summary.json")).unwrap()).unwrap();
    // R from the data, without an epsilon, for its three channels.
    let channels = summary["channels"].as_array().unwrap();
    assert_eq!(channels.len(), 3);
    assert!(channels.iter().all(|channel| channel["diagnostics"]["epsilon"].as_f64().is_none()));
    assert_eq!(channels[0]["snapshots"].as_array().unwrap().len(), 6);
}
