//! Satellites on orbits of their own, through the whole chain.

mod antennas;

use crate::common;

use std::path::Path;

use common::workplace::{Workplace, fail, json, lunarray, maps, succeed};
use lunarray::downlink::{Contents, DownlinkReader};
use lunarray::frames::GroundFrame;
use lunarray::pipeline::{ConfigSource, Plan};
use lunarray::sky::fits::{ReadOptions, read_map_file};
use lunarray::units::vector::{add, cross, dot, scale, sub, unit};

/// A triple whose altitudes differ by tens of kilometres and whose planes are tilted against each other: a circle's rows
/// would be of no use.
const TRIPLE: &str = r#"
name = "triple"
seed = 3
[sky]
nside = 4
[array]
satellites = 3
kepler = [
    { semi_major_axis_m = 2037.1e3, eccentricity = 0.010, inclination_deg = 60.00, node_longitude_deg = 0.0, periapsis_deg = 90.0, mean_anomaly_deg = 0.000, node_rate_deg_per_day = -0.75 },
    { semi_major_axis_m = 2037.1e3, eccentricity = 0.012, inclination_deg = 60.02, node_longitude_deg = 0.0, periapsis_deg = 90.0, mean_anomaly_deg = 0.015, node_rate_deg_per_day = -0.75 },
    { semi_major_axis_m = 2037.1e3, eccentricity = 0.010, inclination_deg = 60.00, node_longitude_deg = 0.02, periapsis_deg = 90.0, mean_anomaly_deg = 0.005, node_rate_deg_per_day = -0.75 },
]
[spacecraft]
channels_hz = [3.0e6]
every_nth_window = 100
thermal_noise = false
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-6
baseline_bp_max = 10.0
rows = "centre"
[products]
pictures = false
"#;

/// The ground makes the run's maps of the downlink alone, whose path is returned: it knows the orbits.
fn assert_replayed(place: &Workplace, out: &str) -> String {
    let (downlink, ground) = (format!("{out}/downlink.ccsds"), place.path("ground"));
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--out", &ground]);
    for (path, bytes) in maps(&ground) {
        assert!(bytes == maps(out)[&path], "{} differs", path.display());
    }
    downlink
}

#[test]
fn a_triple_on_ellipses_is_flown_and_mapped() {
    let place = Workplace::new(TRIPLE);
    let out = place.path("out");
    let summary = json(&["run", &place.pipeline, "--out", &out]);
    let ledger = &summary["ledger"];
    assert!(ledger["accumulated"].as_u64().unwrap() > 1000, "{ledger}");
    // Data of the map's own pixels without noise come back, but for what the regularisation takes.
    let error = summary["channels"][0]["snapshots"][0]["rms_error_over_rms_truth"].as_f64().unwrap();
    assert!(error < 0.05, "{error}");
    let downlink = assert_replayed(&place, &out);
    assert!(Contents::read(Path::new(&downlink)).unwrap().visibilities.count > 1000);
}

/// Six stations near the equator of the far side, over one turn of the Moon.
const SURFACE: &str = r#"
name = "surface"
seed = 3
[sky]
nside = 4
[array]
satellites = 6
stations_epoch = "2030-01-01T00:00:00"
stations = [
    { longitude_deg = 170.0, latitude_deg = 0.0 },
    { longitude_deg = 170.0007, latitude_deg = 0.0004, height_m = 15.0 },
    { longitude_deg = 169.9985, latitude_deg = 0.0011 },
    { longitude_deg = 170.0021, latitude_deg = -0.0017 },
    { longitude_deg = 169.9979, latitude_deg = -0.0024, height_m = -30.0 },
    { longitude_deg = 170.0004, latitude_deg = 0.0043 },
]
[spacecraft]
channels_hz = [10.0e6]
duration_s = 2.3606e6
every_nth_window = 40
integration_s_max = 600.0
thermal_noise = false
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-6
baseline_bp_max = 10.0
rows = "centre"
[products]
pictures = false
"#;

#[test]
fn stations_on_the_moon_map_the_sky() {
    let place = Workplace::new(SURFACE);
    let out = place.path("out");
    let summary = json(&["run", &place.pipeline, "--out", &out]);
    // Every 40th of 656 hours, six integrations of ten minutes, 15 pairs.
    assert_eq!(summary["ledger"]["accumulated"].as_u64().unwrap(), 17 * 6 * 15);
    // Data of the map's own pixels without noise come back, but for what the regularisation takes: 1e-6 of the largest eigenvalue, of
    // which the smallest is 0.0207, as numpy finds from rows at the pixels' centres.
    let error = summary["channels"][0]["snapshots"][0]["rms_error_over_rms_truth"].as_f64().unwrap();
    assert!(error < 1e-6 / 0.0207, "{error}");
    assert_replayed(&place, &out);
}

/// From latitude 30 a cap of the sky is always below the horizon. What the map cannot have of the rest, structure within its pixels, must not
/// be fitted by an enormous sky in there, which would pass for the sky's power.
#[test]
fn stations_that_never_see_a_part_of_the_sky_map_the_rest() {
    let text = include_str!("../../pipelines/surface.toml");
    let of_line = |line: &str| -> String {
        let Some((_, rest)) = line.split_once("longitude_deg = ") else { return line.to_owned() };
        let (east, north) = rest.split_once(", latitude_deg = ").unwrap();
        let north: f64 = north.trim_end_matches([' ', '}', ',']).parse().unwrap();
        // The same distances to the east.
        let east = 170.0 + (east.parse::<f64>().unwrap() - 170.0) / 30.0_f64.to_radians().cos();
        format!("{{ longitude_deg = {east:.7}, latitude_deg = {:.7} }},", 30.0 + north)
    };
    let place = Workplace::new(&text.lines().map(of_line).collect::<Vec<_>>().join("\n"));
    let out = place.path("out");
    let sets = ["spacecraft.every_nth_window=64", "sky.nside=32", "products.pictures=false"];
    let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", set]).collect();
    let summary = json(&[&["run", &place.pipeline, "--out", &out], &sets[..]].concat());
    let rho = |l: usize| summary["channels"][0]["rho"][l].as_f64().unwrap();
    // The hidden cap is 7 % of the sky, and its smooth continuation is not wholly wrong.
    assert!((2..=8).all(|l| rho(l) > 0.9), "{:?}", (2..=8).map(rho).collect::<Vec<_>>());
}

#[test]
fn what_stations_cannot_do_is_refused() {
    let place = Workplace::new(SURFACE);
    let near = "array.stations=[{longitude_deg=0.0,latitude_deg=0.0},{longitude_deg=0.1,latitude_deg=0.0},{longitude_deg=0.2,latitude_deg=0.0}]";
    for (sets, told) in [
        (
            &["spacecraft.fidelity=samples"][..],
            "expected \"visibilities\" with array.kepler, array.oem, array.stations",
        ),
        (&["map.engine=harmonic", "map.rows=average"], "array.stations"),
        (&["spacecraft.moon_reflection=0.07"], "expected 0 with array.stations"),
        (&["spacecraft.antenna=dipole-normal"], "expected \"isotropic\" with array.stations"),
        (&["downlink.rate_bits_per_s_max=1e6"], "a relay that is not simulated"),
        (&["array.eccentricity=0.1"], "without array.kepler, array.oem or array.stations"),
        (&["array.satellites=7"], "at most 64: the limit of the downlink's format"),
        (&["array.satellites=3", near], "the Earth is above the horizon of station 1"),
    ] {
        let mut arguments = vec!["run", &place.pipeline, "--out", "none"];
        arguments.extend(sets.iter().flat_map(|set| ["--set", set]));
        let said = fail(&arguments);
        assert!(said.contains(told), "{said}: expected {told}");
    }
}

/// Visibilities of harmonics at the true positions are those of direct sums, and the same bytes whatever the threads.
#[test]
fn ellipses_are_simulated_with_harmonics() {
    // Baselines of up to 1 km: pixels have to be small against a fringe.
    let pipeline = TRIPLE
        .replace(
            "eccentricity = 0.012, inclination_deg = 60.02",
            "eccentricity = 0.01001, inclination_deg = 60.0005",
        )
        .replace("node_longitude_deg = 0.02", "node_longitude_deg = 0.0005");
    let place = Workplace::new(&pipeline);
    let fine = [
        "--set",
        "sky.nside=64",
        "--set",
        "sky.l_max=96",
        "--set",
        "spacecraft.every_nth_window=400",
        "--set",
        "spacecraft.baseline_wavelengths_max=10",
    ];
    let simulate = |name: &str, threads: &str, model: &str| {
        let (file, model) = (place.path(name), format!("spacecraft.model={model}"));
        let mut command = assert_cmd::Command::cargo_bin("lunarray").unwrap();
        command.env("RAYON_NUM_THREADS", threads).args(["simulate", &place.pipeline, "--out", &file]);
        command.args(fine).args(["--set", &model]).assert().success();
        file
    };
    let (alone, beside) = (simulate("alone", "1", "general"), simulate("beside", "3", "general"));
    assert!(std::fs::read(&alone).unwrap() == std::fs::read(&beside).unwrap());
    let visibilities = |file: &str| -> Vec<[f64; 2]> {
        let path = format!("{file}.csv");
        succeed(&["export", "visibilities", file, "--out", &path]);
        let table = std::fs::read_to_string(path).unwrap();
        let mut lines = table.lines().filter(|line| !line.starts_with('#'));
        let names: Vec<&str> = lines.next().unwrap().split(',').collect();
        let at = |name: &str| names.iter().position(|other| *other == name).unwrap();
        let columns = [at("re_k_sr"), at("im_k_sr")];
        let values = |line: &str| {
            let fields: Vec<&str> = line.split(',').collect();
            columns.map(|column| fields[column].parse().unwrap())
        };
        lines.map(values).collect()
    };
    let direct = visibilities(&simulate("direct", "2", "direct"));
    let rows = visibilities(&alone);
    assert!(rows.len() == direct.len() && rows.len() > 500, "{} {}", rows.len(), direct.len());
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let all = norm(&mut direct.iter().flatten().copied());
    let apart = norm(&mut rows.iter().flatten().zip(direct.iter().flatten()).map(|(a, b)| a - b));
    // Pixels of 0.9 deg as points: some 400 of them on the limb err by 0.3 of themselves at random, 1e-3 of the power; direct sums at
    // nside 64 and 128 differ by 3e-3.
    assert!(apart < 0.01 * all, "{apart} of {all}");
}

#[test]
fn what_needs_a_circle_is_refused_for_ellipses() {
    let place = Workplace::new(TRIPLE);
    for set in [
        "map.engine=harmonic",
        "spacecraft.fidelity=samples",
        "spacecraft.model=harmonic",
        "spacecraft.antenna=dipole-normal",
        "spacecraft.ninth.on=true",
    ] {
        let said = fail(&["check", &place.pipeline, "--set", set]);
        let (key, value) = set.split_once('=').unwrap();
        let shown = if value == "true" { value.to_owned() } else { format!("{value:?}") };
        let told = format!("{key} = {shown}");
        assert!(said.contains(&told) && said.contains("needs a common circle"), "{set}: {said}");
    }
}

/// The triple with altitudes that breathe by 20 km, and satellites that follow each other with cross-track offsets and pitch.
fn followers() -> String {
    TRIPLE
        .replace(
            "eccentricity = 0.012, inclination_deg = 60.02",
            "eccentricity = 0.01001, inclination_deg = 60.0005",
        )
        .replace("node_longitude_deg = 0.02", "node_longitude_deg = 0.0005")
}

#[test]
fn a_triple_on_ellipses_is_mapped_by_refinement() {
    let pipeline = followers();
    let place = Workplace::new(&pipeline);
    let out = place.path("out");
    let harmonic = [
        "sky.nside=32", // Direct sums count pixels as points: far finer than the map's degrees.
        "map.engine=harmonic",
        "map.rows=average",
        "map.refine.passes_max=20",
    ];
    let sets: Vec<&str> = harmonic.iter().flat_map(|set| ["--set", set]).collect();
    let run = [&["run", &place.pipeline, "--out", &out], sets.as_slice()].concat();
    let summary = json(&run);
    let ledger = &summary["ledger"];
    // Nothing is refused for its geometry; what is left out is beyond the map's baselines.
    let sampled = ledger["sampled"].as_u64().unwrap();
    assert!(ledger["accumulated"].as_u64().unwrap() > 1000, "{ledger}");
    for reason in ["plane", "altitude", "altitudes"] {
        assert!(!ledger.to_string().contains(reason), "{sampled}: {ledger}");
    }
    let channel = &summary["channels"][0];
    let refinement = &channel["refinement"];
    assert!(refinement["convergence"]["converged"].as_bool().unwrap(), "{refinement}");
    assert!(refinement["departures"]["by_refinement"].as_u64().unwrap() > 500, "{refinement}");
    assert!(refinement["chi_square"]["by_pair"].as_object().unwrap().len() == 3, "{refinement}");
    let table = std::fs::read_to_string(format!("{out}/3.000MHz/residuals.csv")).unwrap();
    let lines = |by: &str| table.lines().filter(|line| line.starts_with(by)).count();
    assert_eq!((lines("all,"), lines("pair,"), lines("daughter,")), (1, 3, 3), "{table}");
    assert!(lines("phase,") > 3 && lines("day,") > 3, "{table}");
    let rho: Vec<f64> =
        channel["rho"].as_array().unwrap().iter().map(|rho| rho.as_f64().unwrap_or(0.0)).collect();
    assert!(rho[1..=6].iter().all(|rho| *rho > 0.9), "{rho:?}");
    // A ground with a file for satellites on a circle says what to do.
    let (sent, lone) =
        (format!("{out}/downlink.ccsds"), place.file("lone.toml", b"[array]\n[map]\nnside = 4\n"));
    let found = lunarray(&["replay", &sent, "--map", &lone, "--out", &place.path("lone")]);
    let said = [found.stdout, found.stderr].concat();
    assert!(String::from_utf8_lossy(&said).contains("the satellites do not share a circle: map.engine"));
    // The ground alone makes the same map.
    let (downlink, ground) = (format!("{out}/downlink.ccsds"), place.path("ground"));
    let replay =
        [&["replay", &downlink, "--map", &place.pipeline, "--out", &ground], sets.as_slice()].concat();
    succeed(&replay);
    for (path, bytes) in maps(&ground) {
        assert!(bytes == maps(&out)[&path], "{} differs", path.display());
    }
}

/// The paper's array and baselines at nside 16, from every sixth window, without noise.
const CIRCLE: &str = r#"
name = "circle"
seed = 5
[sky]
nside = 64
l_max = 80
[spacecraft]
channels_hz = [10.0e6]
model = "harmonic"
baseline_wavelengths_max = 31.3
every_nth_window = 6
thermal_noise = false
[map]
nside = 16
engine = "harmonic"
baseline_bp_max = 2.0
epsilon = 1e-4
[products]
pictures = false
"#;

/// Iterated to the end, refinement of data of a circle changes the map by what the fast sums approximate; as usual it finds that their map
/// will do.
#[test]
fn refinement_hardly_changes_the_map_of_a_circle() {
    let place = Workplace::new(CIRCLE);
    let downlink = place.path("circle.ccsds");
    succeed(&["simulate", &place.pipeline, "-o", &downlink]);
    let map = |name: &str, sets: &[&str]| {
        let out = place.path(name);
        let sets = sets.iter().flat_map(|set| ["--set", *set]);
        let replay = ["replay", &downlink, "--map", &place.pipeline, "--out", &out].into_iter().chain(sets);
        let summary = json(&replay.collect::<Vec<&str>>());
        let file = format!("{out}/10.000MHz/map.fits");
        let values = read_map_file(Path::new(&file), &ReadOptions::default()).unwrap().map.values().to_vec();
        (values, summary["channels"][0]["refinement"]["convergence"]["iterations"].as_u64())
    };
    // Iterations left to themselves end where they differ by as much as the sums.
    let to_the_end = ["map.residual_max=1e-7", "map.iterations_max=2000"];
    let (fast, none) = map("fast", &to_the_end);
    let refined = [&to_the_end[..], &["map.refine.passes_max=12", "map.refine.residual_max=1e-7"]].concat();
    let (refined, _) = map("refined", &refined);
    let square = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>();
    let apart = square(&mut fast.iter().zip(&refined).map(|(a, b)| a - b));
    let error = (apart / square(&mut refined.iter().copied())).sqrt();
    // 8e-5 of a fringe between nodes in the mean, and some ten times as much where epsilon has little to add to what is measured.
    assert!(error < 1e-3, "{error:e}");
    // As usual: the fast sums' map is what refinement begins with. A pass finds its residual, and one may be for the noise map.
    let (fast, _) = map("fast-usual", &[]);
    let (refined, passes) = map("refined-usual", &["map.refine.passes_max=12"]);
    assert!(none.is_none() && passes.unwrap() <= 2, "{passes:?}");
    let apart = square(&mut fast.iter().zip(&refined).map(|(a, b)| a - b));
    let apart = (apart / square(&mut refined.iter().copied())).sqrt();
    // Iterated to 1e-4 each is some 2e-3 from the end of its own iteration.
    assert!(apart < 3e-3, "{apart:e}");
}

/// A day of three satellites under the Moon's oblateness, integrated by other code.
#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn orbits_from_files_are_flown_and_mapped() {
    let python = common::python();
    let kepler = TRIPLE.find("kepler").unwrap()..TRIPLE.find("[spacecraft]").unwrap();
    let mut pipeline = TRIPLE.replace("every_nth_window = 100", "duration_s = 86400.0\nevery_nth_window = 3");
    pipeline.replace_range(kepler, "");
    let place = Workplace::new(&pipeline);
    let folder = place.path("orbits");
    std::fs::create_dir(&folder).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/oem_orbits.py");
    let made = std::process::Command::new(python).arg(script).args([&folder, "1.1"]).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let files = format!("array.oem=[\"{folder}/sat1.oem\", \"{folder}/sat2.oem\", \"{folder}/sat3.oem\"]");
    let out = place.path("out");
    let run = [
        "run",
        &place.pipeline,
        "--out",
        &out,
        "--set",
        &files,
        "--set",
        "map.engine=harmonic",
        "--set",
        "map.rows=average",
        "--set",
        "map.refine.passes_max=3",
    ];
    let summary = json(&run);
    let accumulated = summary["ledger"]["accumulated"].as_u64().unwrap();
    let departures = &summary["channels"][0]["refinement"]["departures"];
    let held = ["on_the_circle", "by_refinement"].map(|key| departures[key].as_u64().unwrap());
    assert!(accumulated > 100 && held[0] + held[1] == accumulated, "{departures} {accumulated}");
    assert!((departures["circle_inclination_deg"].as_f64().unwrap() - 60.0).abs() < 0.2, "{departures}");
    // A mission that lasts longer than the files is refused.
    let long = [run.as_slice(), &["--set", "spacecraft.duration_s=1e6"]].concat();
    let said = fail(&long);
    assert!(said.contains("spacecraft.duration_s = ") && said.contains("array.oem"), "{said}");
}

/// Positions of all satellites at some times, m, as `geometry` prints them.
fn places(pipeline: &str, sets: &[&str]) -> Vec<f64> {
    let times = ["geometry", "--json", "--pipeline", pipeline, "--at", "0", "12345.6", "80000"];
    let out = succeed(&[&times[..], sets].concat());
    let line = |line: &str| -> serde_json::Value { serde_json::from_str(line).unwrap() };
    let numbers = |value: serde_json::Value| -> Vec<f64> {
        let rows = value["satellites_m"].as_array().unwrap().iter();
        rows.flat_map(|row| row.as_array().unwrap()).map(|x| x.as_f64().unwrap()).collect()
    };
    out.lines().map(line).flat_map(numbers).collect()
}

/// A day in the Moon's field: looked at, written to files and read again, flown.
#[test]
fn propagated_orbits_are_flown_and_exported() {
    let kepler = TRIPLE.find("kepler").unwrap()..TRIPLE.find("[spacecraft]").unwrap();
    let mut pipeline = TRIPLE.replace("every_nth_window = 100", "duration_s = 86400.0\nevery_nth_window = 5");
    pipeline.replace_range(
        kepler,
        "arcs_m = [600.0, 1500.0]\n[array.propagate]\ndays = 1.25\nkeep_every_days = 0.5\n",
    );
    let place = Workplace::new(&pipeline);
    succeed(&["check", &place.pipeline]);
    let figures = place.path("figures");
    succeed(&["figure", "baselines", &place.pipeline, "--out", &figures]);
    let folder = place.path("orbits");
    let made = json(&["export", "orbits", "--pipeline", &place.pipeline, "--out", &folder]);
    // 1.25 days in steps of 120 s, and twice the state of each correction.
    assert_eq!((made["files"].as_u64(), made["states"].as_u64()), (Some(3), Some(3 * (901 + 2))), "{made}");
    let files = format!("array.oem=[\"{folder}/sat1.oem\", \"{folder}/sat2.oem\", \"{folder}/sat3.oem\"]");
    let plain = ["--set", "array.arcs_m=[]", "--set", "array.propagate={}", "--set", &files];
    let (flown, read) = (places(&place.pipeline, &[]), places(&place.pipeline, &plain));
    assert_eq!((flown.len(), read.len()), (27, 27));
    for (flown, read) in flown.iter().zip(&read) {
        assert!((flown - read).abs() < 1e-3, "{flown} {read}");
    }
    let summary = json(&["run", &place.pipeline, "--out", &place.path("out")]);
    assert!(summary["ledger"]["accumulated"].as_u64().unwrap() > 100, "{}", summary["ledger"]);
    let said = fail(&["check", &place.pipeline, "--set", "spacecraft.duration_s=1e6"]);
    assert!(said.contains("spacecraft.duration_s = ") && said.contains("array.propagate.days"), "{said}");
}

/// Orbits of files with dates: the epoch, the Earth and the windows are those of the dates, and nothing is known beyond them.
#[test]
fn dates_of_orbits_give_epoch_earth_and_windows() {
    let kepler = TRIPLE.find("kepler").unwrap()..TRIPLE.find("[spacecraft]").unwrap();
    let mut pipeline = TRIPLE.replace("every_nth_window = 100", "duration_s = 21000.0");
    pipeline.replace_range(kepler, "arcs_m = [600.0, 1500.0]\n");
    let place = Workplace::new(&pipeline);
    let folder = place.path("orbits");
    // 2024-03-01T00:00:00 UTC, 24,166 days and 37 s after 1958-01-01T00:00:00 TAI.
    let export = ["export", "orbits", "--pipeline", &place.pipeline, "--out", &folder, "--set"];
    succeed(&[&export[..], &["spacecraft.epoch_tai_s=2_087_942_437.0", "--duration", "6h"]].concat());
    let written = std::fs::read_to_string(format!("{folder}/sat1.oem")).unwrap();
    assert!(
        written.contains("TIME_SYSTEM = UTC\nSTART_TIME = 2024-03-01T00:00:00.000000000\n"),
        "{}",
        &written[..400]
    );
    let files = format!("array.oem=[\"{folder}/sat1.oem\", \"{folder}/sat2.oem\", \"{folder}/sat3.oem\"]");
    let sets = ["--pipeline", &place.pipeline, "--set", "array.arcs_m=[]", "--set", &files];
    let at = |time: &'static str| [&["geometry", "--at", time][..], &sets].concat();
    let geometry = json(&at("2024-03-01T00:00:37"));
    assert_eq!(
        (geometry["t_s"].as_f64(), geometry["utc"].as_str()),
        (Some(0.0), Some("2024-03-01T00:00:00.000"))
    );
    assert_eq!(json(&at("2024-03-01T01:00:00Z"))["t_s"].as_f64(), Some(3600.0));
    let degrees = |hat: &serde_json::Value| {
        let [x, y, z] = [0, 1, 2].map(|k| hat[k].as_f64().unwrap());
        [y.atan2(x).to_degrees().rem_euclid(360.0), z.asin().to_degrees()]
    };
    // As astropy 8.0.2 has them with DE421 (`src/core/array/bodies`).
    for (key, expected) in [("earth_hat", [40.1461, 2.1637]), ("sun_hat", [340.6916, 0.0065])] {
        let found = degrees(&geometry[key]);
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.01), "{key}: {found:?}");
    }
    for time in ["7h", "-1", "2027-01-01T00:00:00"] {
        let said = fail(&at(time));
        assert!(
            said.contains("expected a time at which positions are known, 0.000 s to 21600.000 s"),
            "{said}"
        );
    }
    let sky = place.path("sky.fits");
    succeed(&["sky", &place.pipeline, "--no-picture", "--freq-hz", "3MHz", "--nside", "4", "--out", &sky]);
    let predict = ["predict", "--sky", &sky, "--pair", "1-2", "--freq-hz", "3MHz", "--at"];
    assert!(fail(&[&predict[..], &["7h"], &sets].concat()).contains("positions are known"));
    let export =
        [&["export", "orbits", "--out", &folder, "--epoch", "2030-01-01T00:00:00"][..], &sets].concat();
    assert!(fail(&export).contains("dates of their own, from 2024-03-01T00:00:00.000 UTC"));
    for set in ["spacecraft.epoch_tai_s=0", "array.earth_longitude_deg=10"] {
        assert!(fail(&[&at("0")[..], &["--set", set]].concat()).contains("array.oem"));
    }
    // What comes down says the same.
    let (dated, circle) = (place.path("dated.ccsds"), place.path("circle.ccsds"));
    succeed(&["simulate", &place.pipeline, "--out", &dated, "--set", "array.arcs_m=[]", "--set", &files]);
    succeed(&["simulate", &place.pipeline, "--out", &circle, "--set", "array.earth_longitude_deg=180"]);
    let contents = json(&["inspect", &dated]);
    assert_eq!(contents["instrument"]["epoch_utc"], "2024-03-01T00:00:00.000");
    assert!(
        contents["span"]["start_utc"].as_str().unwrap().starts_with("2024-03-01T0"),
        "{}",
        contents["span"]
    );
    let hidden = |contents: &serde_json::Value| {
        ["earth_hidden_by_date", "segments"].map(|key| contents["ephemeris"][key].as_u64().unwrap())
    };
    let [by_date, segments] = hidden(&contents);
    assert!(segments > 1 && by_date == segments, "{by_date} {segments}");
    // The Earth of 1 January 2027 is at longitude 24 degrees, the idealised one at 180.
    assert!(hidden(&json(&["inspect", &circle]))[0] == 0);
    assert!(
        succeed(&["check", &place.pipeline])
            .contains("epoch 2026-12-31T23:59:23.000 UTC; the Earth is idealised")
    );
}

#[test]
fn ellipses_take_any_number_of_threads() {
    let pipeline = r#"
        name = "e"
        [sky]
        nside = 8
        [array]
        eccentricity = 0.02
        [spacecraft]
        thin = 20000
        baseline_wavelengths_max = 8
        [map]
        nside = 4
        engine = "harmonic"
        [map.refine]
        passes_max = 6
    "#;
    let place = Workplace::new(pipeline);
    for threads in ["1", "3"] {
        let file = place.path(&format!("{threads}.ccsds"));
        let set = format!("runtime.threads={threads}");
        succeed(&["simulate", &place.pipeline, "--out", &file, "--set", &set]);
    }
    let read = |threads: &str| std::fs::read(place.path(&format!("{threads}.ccsds"))).unwrap();
    assert!(read("1") == read("3"));
}
