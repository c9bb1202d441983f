//! What is refused at the start, and what is not.

use crate::common;

use common::workplace::{SMALL, Workplace, fail, json, lunarray, succeed};

/// A name that no header can hold as it stands.
const UMLAUT: &str = "m\u{e4}rz";

#[test]
fn a_name_in_any_script_runs_and_its_downlink_is_replayed() {
    let place = Workplace::new(&SMALL.replace("name = \"small\"\n", ""));
    let pipeline = place.path(&format!("{UMLAUT}.toml"));
    std::fs::copy(&place.pipeline, &pipeline).unwrap();
    let (out, maps) = (place.path("out"), place.path("maps"));
    succeed(&["check", &pipeline]);
    let summary = json(&["run", &pipeline, "--out", &out]);
    assert_eq!(summary["name"], UMLAUT);
    let downlink = format!("{out}/downlink.ccsds");
    assert_eq!(json(&["inspect", &downlink])["instrument"]["name"], UMLAUT);
    succeed(&["replay", &downlink, "--map", &pipeline, "--out", &maps]);
    for folder in [out, maps] {
        let bytes = std::fs::read(format!("{folder}/3.000MHz/map.fits")).unwrap();
        // U+00E4 in UTF-8 (RFC 3629), percent-encoded (RFC 3986).
        let card = b"PIPELINE= 'm%C3%A4rz'";
        assert!(bytes.windows(card.len()).any(|found| found == card), "{folder}");
    }
}

/// 49152 pixels: half of a symmetric matrix of 8 bytes each is 9.7 GB a channel, and three more for snapshots.
const LARGE: [&str; 4] = ["--set", "map.nside=64", "--set", "map.snapshot_every_s=1e7"];

#[test]
fn more_memory_than_there_is_is_refused_before_anything_starts() {
    let place = Workplace::new(SMALL);
    let out = place.path("out");
    let limited = [&LARGE[..], &["--memory-max", "8GB"]].concat();
    let downlink = place.path("x.ccsds");
    for command in [vec!["check", &place.pipeline], vec!["run", &place.pipeline, "--out", &out]] {
        let said = fail(&[&command[..], &limited].concat());
        for part in ["of memory are needed, but 8.00 GB are available", "--memory-max "] {
            assert!(said.contains(part), "{command:?}: {said}");
        }
    }
    assert!(!std::path::Path::new(&out).exists());
    // The estimate is printed all the same, for people and for programs.
    let output = lunarray(&[&["check", place.pipeline.as_str()], &limited[..]].concat());
    assert!(String::from_utf8(output.stdout).unwrap().contains("\nmemory "));
    let allowed = [&["check", place.pipeline.as_str()], &LARGE[..], &["--memory-max", "1TB"]].concat();
    let needed = json(&allowed)["memory_bytes"].as_f64().unwrap();
    // Two channels, and three snapshots.
    let matrix = 8.0 * 0.5 * 49152.0_f64.powi(2);
    assert!((5.0..6.0).contains(&(needed / matrix)), "{needed}");
    // The space segment alone makes no maps.
    succeed(&[&["simulate", &place.pipeline, "--out", &downlink], &limited[..]].concat());
    // A ground learns from the downlink how many channels there are.
    let said =
        fail(&[&["replay", &downlink, "--map", &place.pipeline, "--out", &out], &limited[..]].concat());
    let least = said.split("2 channels take at least ").nth(1).and_then(|rest| rest.split(' ').next());
    let least_bytes = 1e9 * least.unwrap_or_else(|| panic!("{said}")).parse::<f64>().unwrap();
    // Two matrices, and blocks of rows that wait.
    assert!((2.0..2.2).contains(&(least_bytes / matrix)), "{said}");
    for part in ["expected at most 8.00 GB", "--groups auto", "--memory-max "] {
        assert!(said.contains(part), "{said}");
    }
    assert!(!std::path::Path::new(&out).join("summary.json").exists());
    let said = fail(&["replay", &downlink, "--map", &place.pipeline, "--out", &out, "--memory-max", "1kB"]);
    assert!(said.contains("MB: expected at most 1000 bytes"), "{said}");
    assert!(fail(&["check", "--memory-max", "much"]).contains("expected a size"));
}

#[test]
fn what_takes_time_and_memory_by_the_million_is_in_the_estimate() {
    let place = Workplace::new(SMALL);
    let check = |sets: &[&str]| {
        let sets = sets.iter().flat_map(|set| ["--set", *set]);
        json(&["check", &place.pipeline, "--memory-max", "1TB"].into_iter().chain(sets).collect::<Vec<_>>())
    };
    let number = |cost: &serde_json::Value, key: &str| cost[key].as_f64().unwrap();
    let with_probes = |probes: &str| {
        let cost = check(&[
            "map.engine=harmonic",
            "map.regulariser=identity",
            &format!("map.trace_probes={probes}"),
        ]);
        number(&cost, "predicted_s")
    };
    let [none, one, two] = ["0", "1000000", "2000000"].map(with_probes);
    // Each takes some products with a matrix, and so more than a microsecond.
    assert!(one - none > 1.0, "{none} {one}");
    // In proportion, to the rounding of times that are printed in full.
    assert!(((two - none) / (one - none) - 2.0).abs() < 1e-6, "{none} {one} {two}");
    // An average over an integration is of two instants at least.
    let direct_s = |smeared: &str| number(&check(&[smeared])["channels"][0], "simulation_direct_s");
    let [instants_s, averages_s] =
        ["false", "true"].map(|smeared| direct_s(&format!("spacecraft.smear_integrations={smeared}")));
    assert!((2.0..4.0).contains(&(averages_s / instants_s)), "{instants_s} {averages_s}");
    // A snapshot at every visibility at most: the summary keeps a line of each.
    let (rare, often) = (check(&["map.snapshot_every_s=1e7"]), check(&["map.snapshot_every_s=1e-3"]));
    let most = number(&often, "solutions");
    let sent: f64 = often["channels"]
        .as_array()
        .unwrap()
        .iter()
        .map(|channel| number(channel, "visibilities_sent"))
        .sum();
    assert!(most > number(&rare, "solutions") && most <= sent + 1.0, "{often}");
    assert!(number(&often, "memory_bytes") > number(&rare, "memory_bytes"), "{rare} {often}");
}

#[test]
fn a_sky_from_which_gains_are_found_is_in_the_estimate() {
    let place = Workplace::new(SMALL);
    let memory = |nside: &str, more: &[&str]| {
        let sky = place.path(&format!("{nside}.fits"));
        succeed(&[
            "sky",
            &place.pipeline,
            "--no-picture",
            "--freq-hz",
            "3MHz",
            "--nside",
            nside,
            "--out",
            &sky,
        ]);
        let models = format!("calibrate.model_files={:?}", [&sky]);
        let sets = ["spacecraft.channels_hz=[3e6]", &models, "calibrate.sky_model=direct"];
        let sets = sets.iter().chain(more).flat_map(|set| ["--set", *set]);
        json(&["check", &place.pipeline, "--memory-max", "1TB"].into_iter().chain(sets).collect::<Vec<_>>())
            ["memory_bytes"]
            .as_f64()
            .unwrap()
    };
    let solve = ["calibration.hook=solve"];
    let apart = memory("256", &solve) - memory("16", &solve);
    // A direct sum needs three coordinates and a value of each pixel, in f64; the map itself is another 8 bytes, and there may be as much of
    // either once more.
    let pixels = 12.0 * (256.0_f64.powi(2) - 16.0_f64.powi(2));
    assert!((32.0..=64.0).contains(&(apart / pixels)), "{apart}");
    // Without the hook no map is read while data arrive.
    assert_eq!(memory("256", &[]), memory("16", &[]));
}

#[test]
fn errors_of_all_kinds_come_at_once_and_not_too_many() {
    let place = Workplace::new(
        "[sat]\na = 1\n[map]\nnside = \"big\"\nepsilon = 0.0\n[spacecraft]\nchannels_hz = [1e3]\n",
    );
    let said = fail(&["check", &place.pipeline, "--set", "map.depth=3"]);
    for part in [
        "6 problem(s)",
        "line 1: sat: no such key",
        "line 4: map.nside: invalid type",
        "--set map.depth=3: map.depth: no such key",
        "map.epsilon = 0: expected",
        "spacecraft.channels_hz[0] = 1000: expected",
    ] {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
    let many: Vec<String> = (0..6000).map(|k| format!("{k}.0")).collect();
    let place = Workplace::new(&format!("[spacecraft]\nchannels_hz = [{}]\n", many.join(", ")));
    let said = fail(&["check", &place.pipeline]);
    assert!(said.contains("spacecraft.channels_hz = (6000 channels): expected 1 to 30"), "{said}");
    assert!(said.len() < 10_000, "{} bytes", said.len());
}
