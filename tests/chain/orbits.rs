//! Satellites on orbits of their own, through the whole chain.

use crate::common;

use std::path::Path;

use common::workplace::{Workplace, fail, json, maps, succeed};
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
        let (key, _) = set.split_once('=').unwrap();
        let told = format!("{key} = ");
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

/// Tilts of the daughters' antennas, and patterns of their voltages, as flown and as known.
const TILTED: [&str; 2] = [
    "instrument.tilt_along_deg.constant=[20.0, 0.0, -15.0]",
    "instrument.tilt_radial_deg.constant=[0.0, 10.0, 0.0]",
];
const KNOWN_TILTED: [&str; 2] =
    ["map.antennas.tilt_along_deg=[20.0, 0.0, -15.0]", "map.antennas.tilt_radial_deg=[0.0, 10.0]"];
const KNOWN_PATTERN: &str = "map.antennas.pattern=[0.2, 0.0, -0.1]";
const SMEARED: &str = "map.refine.smear_integrations=true";

/// Flies the followers with these settings under a sky that the map's degrees hold, averaged over instants at the array's positions; gives what
/// refinement leaves of the data, chi-square, knowing each of several sets of settings.
fn left_by_refinement(flown: &[&str], known: &[&[&str]]) -> Vec<f64> {
    let place = Workplace::new(&followers());
    let downlink = place.path("flown.ccsds");
    let space = [
        "sky.nside=8",
        "sky.l_max=10",
        "spacecraft.model=general",
        // Half a wavelength of motion: four times what the mission has.
        "spacecraft.motion_wavelengths_max=0.5",
        "spacecraft.smear_integrations=true",
    ];
    let ground = [
        "map.engine=harmonic",
        "map.rows=average",
        "map.refine.passes_max=20",
        "map.refine.residual_max=1e-6",
        "map.epsilon=1e-9",
    ];
    let run = |command: &[&str], sets: &[&[&str]]| -> Vec<String> {
        let sets = sets.iter().copied().flatten().flat_map(|set| ["--set", set]);
        command.iter().copied().chain(sets).map(str::to_owned).collect()
    };
    let simulate = run(&["simulate", &place.pipeline, "-o", &downlink], &[&space, &ground, flown]);
    succeed(&simulate.iter().map(String::as_str).collect::<Vec<_>>());
    let left = |(k, more): (usize, &&[&str])| {
        let out = place.path(&format!("map-{k}"));
        let replay = run(&["replay", &downlink, "--map", &place.pipeline, "--out", &out], &[&ground, more]);
        let summary = json(&replay.iter().map(String::as_str).collect::<Vec<_>>());
        let refinement = summary["channels"][0]["refinement"].clone();
        assert_eq!(refinement["taken_as_instants"], 0, "{refinement}");
        let file = format!("{out}/3.000MHz/map.fits");
        let header = read_map_file(Path::new(&file), &ReadOptions::default()).unwrap().header;
        let mut keys: Vec<&str> = more
            .iter()
            .filter_map(|set| set.strip_prefix("map.antennas.")?.split(['=', '.']).next())
            .collect();
        keys.dedup();
        let expected = if keys.is_empty() { "ideal".to_owned() } else { keys.join(", ") };
        assert_eq!(header.text("ANTROWS"), Some(expected.as_str()));
        for (key, of) in [("PASSES", "iterations"), ("RESIDUAL", "residual")] {
            // To the digits that a card holds.
            let expected = refinement["convergence"][of].as_f64().unwrap();
            assert!((header.real(key).unwrap() / expected - 1.0).abs() < 1e-9, "{key}");
        }
        refinement["chi_square"]["all"].as_f64().unwrap()
    };
    known.iter().enumerate().map(left).collect()
}

/// Each daughter has its own dipole: refinement leaves nothing of the sky if it knows antennas and averages, and only then. (That either is
/// right is held against direct sums in `physics general`.)
#[test]
fn averages_and_antennas_that_differ_are_in_the_rows_of_a_refined_map() {
    let pattern = "instrument.pattern.constant=[0.2, 0.0, -0.1]";
    let flown = [&TILTED[..], &["spacecraft.antenna=dipole-normal", pattern]].concat();
    let antennas = [&KNOWN_TILTED[..], &[KNOWN_PATTERN]].concat();
    let both = [&antennas[..], &[SMEARED]].concat();
    let left = left_by_refinement(&flown, &[&[], &antennas, &[SMEARED], &both]);
    eprintln!("left of the data knowing neither, antennas, averages, both: {left:?}");
    let &[neither, instants, straight, both] = &left[..] else { panic!("{left:?}") };
    // Rows are in f32, and an iteration ends: something is left of what is known in full.
    assert!(both < 0.5 * instants && both < 1e-4 * straight && both < 1e-4 * neither, "{left:?}");
}

/// The same of three dipoles across each other, whose patterns change with frequency: at 3 MHz, half way between the rows of the table, they are
/// those of the list.
#[test]
fn three_dipoles_with_patterns_by_frequency_are_in_the_rows_of_a_refined_map() {
    const TABLE: &str = "pattern_by_frequency=[[1e6, 0.0, 0.0, 0.0], [5e6, 0.4, 0.0, -0.2]]";
    let table = format!("instrument.{TABLE}");
    let flown = [&TILTED[..], &["spacecraft.antenna=three-dipoles", &table]].concat();
    let straight = [KNOWN_PATTERN, SMEARED];
    let list = [&KNOWN_TILTED[..], &straight].concat();
    let table = format!("map.antennas.{TABLE}");
    let by_frequency = [&KNOWN_TILTED[..], &[&table, SMEARED]].concat();
    let left = left_by_refinement(&flown, &[&[SMEARED], &straight, &list, &by_frequency]);
    eprintln!("left of the data knowing averages, patterns too, all by a list, all by a table: {left:?}");
    let &[neither, straight, list, by_frequency] = &left[..] else { panic!("{left:?}") };
    assert!(list < 1e-4 * straight && list < 1e-4 * neither, "{left:?}");
    // 0.2 and -0.1 are not the interpolated numbers to the last bit.
    assert!((by_frequency / list - 1.0).abs() < 0.1, "{left:?}");
}

/// A CCSDS AEM of the satellites that the tilts above describe, in windows of the mission; `first` from 0 on.
fn attitude_message(plan: &Plan, first: usize) -> String {
    let [along_deg, radial_deg] = [[20.0_f64, 0.0, -15.0], [0.0, 10.0, 0.0]];
    let mut text =
        "CCSDS_AEM_VERS = 2.0\nCREATION_DATE = 2030-01-01T00:00:00\nORIGINATOR = TEST\n".to_owned();
    let epoch = plan.instrument.epoch_tai_s;
    for (satellite, window) in (first..3).flat_map(|n| plan.windows.iter().map(move |window| (n, window))) {
        text += &format!(
            "META_START\nOBJECT_NAME = D{satellite}\nOBJECT_ID = 2030-00{satellite}A\nREF_FRAME_A = ECLIPJ2000\nREF_FRAME_B = \
             SC_BODY_1\nTIME_SYSTEM = TAI\nATTITUDE_TYPE = QUATERNION\nINTERPOLATION_METHOD = LAGRANGE\nINTERPOLATION_DEGREE = 5\n\
             META_STOP\nDATA_START\n"
        );
        let (from_s, until_s) = (window.start.seconds().floor(), window.end.seconds().ceil() + 60.0);
        let steps = ((until_s - from_s) / 60.0).ceil() as usize;
        for k in 0..=steps {
            let t_s = from_s + 60.0 * k as f64;
            let (r, normal) = (plan.array.position_m(satellite, t_s), plan.array.normal_hat(satellite, t_s));
            let up = unit(r);
            let along = cross(normal, up);
            let tan = |deg: f64| deg.to_radians().tan();
            let lean = add(scale(tan(along_deg[satellite]), along), scale(tan(radial_deg[satellite]), up));
            let z = unit(add(normal, lean));
            let x = unit(sub(along, scale(dot(along, z), z)));
            let [a, b, c, d] = quaternion([x, cross(z, x), z]);
            // Whole seconds from an epoch on a whole second.
            let date = date_tai(epoch + t_s);
            text += &format!("{date} {a:.10} {b:.10} {c:.10} {d:.10}\n");
        }
        text += "DATA_STOP\n";
    }
    text
}

/// The same message, whose first daughter has nothing for three minutes within the first window: it is known at both ends of it.
fn with_a_gap(plan: &Plan) -> String {
    let text = attitude_message(plan, 0);
    let end = text.find("DATA_STOP\n").unwrap() + "DATA_STOP\n".len();
    let (first, rest) = text.split_at(end);
    let (header, segment) = first.split_at(first.find("META_START").unwrap());
    let window = &plan.windows[0];
    assert!(window.end.seconds() - window.start.seconds() > 400.0);
    let begin_s = plan.instrument.epoch_tai_s + window.start.seconds().floor();
    let used = |key: &str, after_s: f64| {
        segment.replace("META_STOP", &format!("{key} = {}\nMETA_STOP", date_tai(begin_s + after_s)))
    };
    [header, &used("USEABLE_STOP_TIME", 120.0), &used("USEABLE_START_TIME", 300.0), rest].concat()
}

/// The quaternion, scalar last, of the matrix with these rows, which takes components on fixed axes to those on the rows' (504.0-B).
fn quaternion(m: [[f64; 3]; 3]) -> [f64; 4] {
    // The eigenvector of Shepperd's largest pivot.
    let squares = [
        1.0 + m[0][0] - m[1][1] - m[2][2],
        1.0 - m[0][0] + m[1][1] - m[2][2],
        1.0 - m[0][0] - m[1][1] + m[2][2],
        1.0 + m[0][0] + m[1][1] + m[2][2],
    ];
    let [p01, p02, p12] = [m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]];
    let [q0, q1, q2] = [m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]];
    let rows = [
        [squares[0], p01, p02, q0],
        [p01, squares[1], p12, q1],
        [p02, p12, squares[2], q2],
        [q0, q1, q2, squares[3]],
    ];
    let largest = (0..4).max_by(|a, b| squares[*a].total_cmp(&squares[*b])).unwrap();
    let length = rows[largest].iter().map(|x| x * x).sum::<f64>().sqrt();
    rows[largest].map(|x| x / length)
}

/// A date such as 2030-031T12:00:00 on TAI.
fn date_tai(tai_s: f64) -> String {
    let second = tai_s.round() as i64;
    let (mut day, of_day) = (second.div_euclid(86_400), second.rem_euclid(86_400));
    let mut year = 1958;
    while day >= 365 + i64::from(year % 4 == 0) {
        day -= 365 + i64::from(year % 4 == 0);
        year += 1;
    }
    format!("{year}-{:03}T{:02}:{:02}:{:02}", day + 1, of_day / 3600, of_day / 60 % 60, of_day % 60)
}

/// Fields of a dipole along z with a factor 1 + q P_2, each 5 deg, at two frequencies about the channel's.
fn dipole_table(q: f64) -> String {
    let mut text = "frequency_hz,theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im\n".to_owned();
    for (hz, theta_deg, phi_deg) in [1e6, 5e6].into_iter().flat_map(|hz| {
        (0..=180).step_by(5).flat_map(move |theta| (0..360).step_by(10).map(move |phi| (hz, theta, phi)))
    }) {
        let (sin, cos) = f64::from(theta_deg).to_radians().sin_cos();
        // Gains are left to calibration: an amplitude and a phase of no matter.
        let field = -2.5 * sin * (1.0 + q * (1.5 * cos * cos - 0.5));
        text += &format!("{hz},{theta_deg},{phi_deg},{},{},0,0\n", 0.6 * field, 0.8 * field);
    }
    text
}

/// Attitudes by messages and patterns by tables are those that keys describe: what flies by one is known by the other.
#[test]
fn antennas_by_files_are_those_of_keys() {
    let place = Workplace::new(&followers());
    let source = ConfigSource { file: Some(place.pipeline.clone().into()), ..ConfigSource::default() };
    let plan = Plan::new(source.load().unwrap()).unwrap();
    let attitudes = place.file("all.aem", attitude_message(&plan, 0).as_bytes());
    let tables: Vec<String> = [0.2, 0.0, -0.1]
        .iter()
        .enumerate()
        .map(|(k, q)| place.file(&format!("{k}.csv"), dipole_table(*q).as_bytes()))
        .collect();
    let [attitudes, tables] = [vec![attitudes], tables].map(|paths| format!("{paths:?}"));
    let antenna = "spacecraft.antenna=dipole-normal";
    let known = [&KNOWN_TILTED[..], &[KNOWN_PATTERN, SMEARED]].concat();
    let by_files =
        [format!("map.antennas.files.attitudes={attitudes}"), format!("map.antennas.files.tables={tables}")];
    let by_files = [&by_files[0], &by_files[1], SMEARED];
    let flown = [&TILTED[..], &[antenna, "instrument.pattern.constant=[0.2, 0.0, -0.1]"]].concat();
    let left = left_by_refinement(&flown, &[&known, &by_files, &[SMEARED]]);
    eprintln!("flown by keys; left of the data known by keys, by files, not at all: {left:?}");
    // Rows are in f32, and an iteration ends. Normals of orbits come from the data's positions, attitudes from messages: those leave less.
    assert!(left[1] < left[0] && left[0] < 1e-4 * left[2], "{left:?}");

    let flown = [
        format!("instrument.antenna_files.attitudes={attitudes}"),
        format!("instrument.antenna_files.tables={tables}"),
    ];
    let left = left_by_refinement(&[&flown[0], &flown[1], antenna], &[&known, &by_files, &[SMEARED]]);
    eprintln!("flown by files; left of the data known by keys, by files, not at all: {left:?}");
    assert!(left[1] < left[0] && left[0] < 1e-4 * left[2], "{left:?}");

    // What files do not say is refused with their key.
    let short = place.file("short.aem", attitude_message(&plan, 1).as_bytes());
    let gap = place.file("gap.aem", with_a_gap(&plan).as_bytes());
    for (set, expected) in [
        (format!("attitudes=[{short:?}]"), "attitudes: 2 objects (2030-001A, 2030-002A); expected 3"),
        (format!("attitudes=[{gap:?}]"), "attitudes: nothing of daughter 1 at "),
        (
            format!(
                "tables=[{:?}]",
                place.file("far.csv", dipole_table(0.1).replace("\n1000000,", "\n4000000,").as_bytes())
            ),
            "expected 3000000 Hz, a channel, in between",
        ),
    ] {
        let set = format!("instrument.antenna_files.{set}");
        let out = place.path("refused.ccsds");
        let said = fail(&[
            "simulate",
            &place.pipeline,
            "-o",
            &out,
            "--set",
            antenna,
            "--set",
            "map.engine=harmonic",
            "--set",
            "map.rows=average",
            "--set",
            "map.refine.passes_max=1",
            "--set",
            "spacecraft.model=general",
            "--set",
            &set,
        ]);
        assert!(said.contains("instrument.antenna_files: ") && said.contains(expected), "{said}");
    }
}

/// Three dipoles see what an isotropic antenna sees, by three receivers: three times the weight, of which a receiver's noise costs half as
/// much again as it does there.
#[test]
fn three_dipoles_have_the_noise_of_three_receivers() {
    let place = Workplace::new(&TRIPLE.replace("every_nth_window = 100", "every_nth_window = 1000"));
    let weights = |name: &str, receiver_k_sr: &str, antenna: &str| -> Vec<f64> {
        let file = place.path(name);
        let noise = format!("spacecraft.receiver_noise_k_sr={receiver_k_sr}");
        let antenna = format!("spacecraft.antenna={antenna}");
        let sets = ["--set", &noise, "--set", &antenna, "--set", "spacecraft.model=direct"];
        let more =
            ["--set", "map.refine.passes_max=1", "--set", "map.engine=harmonic", "--set", "map.rows=average"];
        succeed(&[&["simulate", &place.pipeline, "-o", &file][..], &sets, &more].concat());
        let mut reader = DownlinkReader::open(Path::new(&file)).unwrap();
        let mut found = Vec::new();
        while let Some(frame) = reader.next_frame().unwrap() {
            if let GroundFrame::Visibilities(block) = frame {
                found.extend(block.weight.iter().map(|weight| f64::from(*weight)));
            }
        }
        found
    };
    // A receiver as noisy as the sky here, some 4e7 K sr, and one of no noise.
    for receiver_k_sr in [0.0, 4e7] {
        let one = weights("one.ccsds", &(1.5 * receiver_k_sr).to_string(), "isotropic");
        let three = weights("three.ccsds", &receiver_k_sr.to_string(), "three-dipoles");
        assert!(one.len() > 20 && one.len() == three.len(), "{} {}", one.len(), three.len());
        for (one, three) in one.iter().zip(&three) {
            // Sums of pixels and weights are in f32.
            assert!((three / one / 3.0 - 1.0).abs() < 3e-6, "{one} {three}");
        }
    }
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
