//! Maps of several channels together, from a state to files, against the sky that was put in.

use std::path::Path;

use lunarray::imaging::joint::{JointMap, JointRequest, PowerPriors, PowerSample, solve_jointly};
use lunarray::imaging::{SolveWatch, StoppingRule};
use lunarray::pipeline::{ConfigSource, SumsStorage, joint_channels};
use lunarray::sky::fits::{WriteOptions, write_map};
use lunarray::sky::{Frame, SkyMap};
use serde_json::Value;

use crate::common::workplace::{Workplace, fail, json, maps, succeed};

const PIPELINE: &str = r#"
name = "joint"
seed = 7
[sky]
nside = 32
[spacecraft]
channels_hz = [5.0e6, 7.0e6, 10.0e6]
every_nth_window = 120
every_nth_integration = 2
baseline_wavelengths_max = 15.6
[map]
engine = "harmonic"
nside = 8
snapshot_every_s = 0.0
[products]
pictures = false
"#;

fn all_rho(map: &str, sky: &str) -> Vec<f64> {
    let compared = json(&["compare", map, sky]);
    compared["rho"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

/// Mean rho_l of l = 6 to 10, which 10 MHz alone sees least.
fn rho(map: &str, sky: &str) -> f64 {
    all_rho(map, sky)[6..=10].iter().sum::<f64>() / 5.0
}

fn mean_of(map: &str) -> f64 {
    let monopole = json(&["compare", map, map])["cl_map"][0].as_f64().unwrap();
    (monopole / (4.0 * std::f64::consts::PI)).sqrt()
}

#[test]
fn channels_see_together_what_one_misses() {
    let place = Workplace::new(PIPELINE);
    let file = place.simulate("all.ccsds", &[]);
    let (state, alone, joint) = (place.path("state"), place.path("alone"), place.path("joint"));
    succeed(&["replay", &file, "--map", &place.pipeline, "--state", &state, "--out", &alone]);
    let report = json(&["joint", &state, "--at", "8.5MHz", "--count", "4", "--out", &joint]);
    let maps: Vec<&Value> = report["maps"].as_array().unwrap().iter().collect();
    let frequencies: Vec<f64> = maps.iter().map(|map| map["frequency_hz"].as_f64().unwrap()).collect();
    assert_eq!(frequencies, [5e6, 7e6, 8.5e6, 10e6]);
    assert_eq!(report["converged"], true);
    for (map, name) in maps.iter().zip(["5.000", "7.000", "8.500", "10.000"]) {
        let sky = place.path(&format!("sky-{name}.fits"));
        let hz = map["frequency_hz"].to_string();
        succeed(&["sky", &place.pipeline, "--freq-hz", &hz, "--nside", "8", "--out", &sky]);
        let together = format!("{joint}/{name}MHz/map.fits");
        let found = rho(&together, &sky);
        // At 8.5 MHz nothing was measured: its neighbours alone tell.
        assert!(found > 0.85, "{name} MHz: {found}");
        if name == "10.000" {
            let before = rho(&format!("{alone}/{name}MHz/map.fits"), &sky);
            assert!(found > before + 0.05, "{found} {before}");
            assert!(map["agreement"]["strain"].as_f64().unwrap() < 2.0, "{map}");
        } else if name == "8.500" {
            assert!(map["agreement"].is_null());
        }
        // The error of the mean is of its size: within five of them, and below a tenth.
        let truth = mean_of(&sky);
        let [mean, sigma] = ["mean_k", "mean_sigma_k"].map(|key| map[key].as_f64().unwrap());
        assert!((mean - truth).abs() < 5.0 * sigma && sigma < 0.1 * truth, "{name}: {mean} {sigma} {truth}");
    }
    assert!(std::fs::metadata(format!("{joint}/spectra.fits")).unwrap().len() > 0);
    let said = fail(&["joint", &state, "--at", "12MHz", "--out", &place.path("beyond")]);
    assert!(said.contains("between 5.000 and 10.000 MHz"), "{said}");
    // Settings of the state's maps that joint maps do not have are not passed over.
    for key in ["map.moon_reflection=0.07", "map.prior_k=1e5"] {
        let said = fail(&["joint", &state, "--set", key, "--out", &place.path("without")]);
        assert!(
            said.contains(key.split('=').next().unwrap()) && said.contains("joint maps do not have"),
            "{said}"
        );
    }
    // An iteration that may not go on says so, where people and where programs look.
    let (short, cut) = (place.path("cut"), ["--set", "map.iterations_max=3", "--count", "2", "--out"]);
    let said = succeed(&[&["joint", &state], &cut[..], &[&short]].concat());
    assert!(said.contains("not converged"), "{said}");
    let header = std::fs::read(format!("{short}/10.000MHz/map.fits")).unwrap();
    let header = String::from_utf8_lossy(&header[..8640]).into_owned();
    assert!(header.contains("CONVERGD=                    F"), "{header}");
    // Sums that memory does not hold are on disk, and a state is then read channel by channel; maps have the same bytes.
    let small = place.path("small");
    succeed(&[&["joint", &state, "--memory-max", "1MB"], &cut[..], &[&small]].concat());
    for file in ["5.000MHz/map.fits", "10.000MHz/map.fits", "spectra.fits"] {
        let [a, b] = [&short, &small].map(|folder| std::fs::read(format!("{folder}/{file}")).unwrap());
        assert!(a == b, "{file}");
    }
}

/// Settings of joint maps that differ from the defaults; constants of powers are by channel, and those of the command by frequency.
const JOINT: &str = r#"
[joint]
on = true
at_hz = ["6.5MHz"]
count = 3
power_priors_percent = [5.0, 2.0, 3.0]
power_constant_k_sr = [2e4, 0.0, 1e4]
"#;

/// A few windows of three channels with total powers.
fn few_windows(section: &str) -> Workplace {
    few_windows_of("[7.0e6, 5.0e6, 6.0e6]\nauto_powers = true\nauto_integration_s = 100.0", section)
}

fn few_windows_of(channels: &str, section: &str) -> Workplace {
    let changes = [
        ("[5.0e6, 7.0e6, 10.0e6]", channels),
        ("nside = 32", "nside = 4"),
        ("nside = 8", "nside = 2\nresidual_max = 1e-2"),
        ("every_nth_window = 120", "every_nth_window = 1000"),
        ("every_nth_integration = 2", "every_nth_integration = 20"),
        ("wavelengths_max = 15.6", "wavelengths_max = 6.0"),
    ];
    let pipeline = changes.iter().fold(PIPELINE.to_owned(), |text, (from, to)| text.replace(from, to));
    Workplace::new(&format!("{pipeline}{section}"))
}

/// Requires that a run leaves the joint maps that `joint` makes of a state of the same downlink. Returns the number of maps' files.
fn require_maps_of_the_state(place: &Workplace, command: &[&str]) -> usize {
    let [out, state, joint, alone] = ["run", "state", "joint", "alone"].map(|name| place.path(name));
    let summary = json(&["run", &place.pipeline, "--out", &out]);
    let downlink = format!("{out}/downlink.ccsds");
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--state", &state, "--out", &alone]);
    // A state keeps what decides its sums, and not when an iteration stops.
    let rule = ["--set", "map.residual_max=1e-2"];
    let expected = json(&[&["joint", &state, "--out", &joint], &rule[..], command].concat()).to_string();
    let expected: Value = serde_json::from_str(&expected.replace(&joint, &format!("{out}/joint"))).unwrap();
    assert_eq!(summary["joint"], expected);
    let written = std::fs::read(format!("{out}/joint/joint.json")).unwrap();
    assert_eq!(serde_json::from_slice::<Value>(&written).unwrap(), expected);
    let [ours, theirs] = [format!("{out}/joint"), joint].map(|folder| maps(&folder));
    assert!(ours == theirs, "{:?} {:?}", ours.keys(), theirs.keys());
    ours.len()
}

#[test]
fn joint_maps_of_a_run_are_those_of_its_state() {
    let place = few_windows(JOINT);
    let command =
        ["--at", "6.5MHz", "--count", "3", "--power-priors", "5,2,3", "--power-constant-k-sr", "0,1e4,2e4"];
    // Those of three channels, of 6.5 MHz, and spectra.
    assert_eq!(require_maps_of_the_state(&place, &command), 5);
    let report = std::fs::read(place.path("run/joint/joint.json")).unwrap();
    let report: Value = serde_json::from_slice(&report).unwrap();
    assert!(report["maps"][0]["powers"]["rows"].as_u64().unwrap() > 0, "{report}");
    let said =
        fail(&["joint", &place.path("state"), "--power-constant-k-sr", "0,1", "--out", &place.path("no")]);
    assert!(said.contains("2 constants of the total powers for 3 channels"), "{said}");
}

#[test]
fn joint_maps_of_a_run_may_leave_out_powers() {
    let place = few_windows("[joint]\non = true\npowers = false");
    assert_eq!(require_maps_of_the_state(&place, &["--no-powers"]), 4);
    // Joint maps of an earlier run do not stay beside those of the channels.
    let joint = std::path::PathBuf::from(place.path("run/joint"));
    let files = || ["5.000MHz/map.fits", "spectra.fits", "joint.json"].map(|name| joint.join(name).exists());
    assert_eq!(files(), [true; 3]);
    let off = ["--set", "joint.on=false", "--set", "joint.powers=true"];
    succeed(&[&["run", &place.pipeline, "--out", &place.path("run")], &off[..]].concat());
    assert_eq!(files(), [false; 3]);
}

#[test]
fn states_and_options_that_do_not_fit_are_refused() {
    let place = few_windows_of("[7.0e6, 5.0e6, 6.0e6]", "");
    let file = place.simulate("all.ccsds", &[]);
    let [one, other, out] = ["one", "other", "out"].map(|name| place.path(name));
    for state in [&one, &other] {
        succeed(&["replay", &file, "--map", &place.pipeline, "--state", state, "--out", &out]);
    }
    let refused = |words: &[&str], expected: &str| {
        let joint = place.path("joint");
        let said = fail(&[&["joint", &one], words, &["--out", &joint]].concat());
        assert!(said.contains(expected), "{words:?}: {said}");
        assert!(!Path::new(&joint).join("joint.json").exists(), "{words:?}");
    };
    refused(&[&format!("{one}/")], "the state is given twice; expected each state once");
    refused(&[&other], "7.000 MHz is in ");
    refused(&["--power-priors", "5,1,1"], "--power-priors has no effect, as there are no total powers in ");
    refused(&["--power-constant-k-sr", "5"], "--power-constant-k-sr has no effect");
    refused(&["--no-powers"], "--no-powers has no effect");
    refused(&["--no-powers", "--power-priors", "5,1,1"], "cannot be used with");
    // What a few samples tell of errors is told, too: 1 / sqrt(2 * 8) = 0.25.
    let joint = place.path("few");
    let report = json(&["joint", &one, "--set", "map.residual_max=1e-2", "--count", "8", "--out", &joint]);
    assert_eq!((report["samples"].as_u64(), report["sigma_uncertainty"].as_f64()), (Some(8), Some(0.25)));
}

#[test]
fn joint_maps_that_cannot_be_made_are_refused() {
    let place = few_windows(JOINT);
    let refused = |more: &[&str], expected: &str| {
        let said = fail(&[&["run", &place.pipeline, "--out", &place.path("refused")], more].concat());
        assert!(said.contains(expected), "{more:?}: {said}");
    };
    refused(&["--groups", "1"], "--groups: found joint.on = true, expected false; `lunarray joint`");
    refused(&["--set", "joint.at_hz=[12MHz]"], "between 5.000 and 7.000 MHz");
    refused(&["--set", "joint.at_hz=[5.0002MHz]"], "at 5000000 and 5000200 Hz would have one folder");
    refused(&["--set", "joint.count=1"], "joint.count = 1: expected 2 to 1000");
    refused(&["--set", "joint.power_constant_k_sr=[1.0, 2.0]"], "one value, or 3, one for each channel");
    refused(&["--set", "joint.on=false"], "joint.count = 3 has an effect only with joint.on = true");
    refused(
        &["--set", "spacecraft.auto_powers=false"],
        "has an effect only with joint.on = true and joint.powers = true and spacecraft.auto_powers = true or",
    );
    refused(&["--set", "spacecraft.antenna='dipole-normal'"], "total powers of dipoles");
    refused(
        &["--set", "map.engine='pixel'"],
        "joint.on = true has an effect only with map.engine = \"harmonic\"",
    );
    refused(&["--set", "map.refine.passes_max=2"], "joint.on = true has an effect only");
    refused(&["--set", "map.moon_reflection=0.07"], "joint.on = true has an effect only");
    let one = few_windows("[joint]\non = true\npowers = false");
    let said = fail(&["run", &one.pipeline, "--set", "map.channels=[1]", "--out", &one.path("one")]);
    assert!(said.contains("[joint]: a joint map of 1 channels"), "{said}");
}

/// Gains of 10 %, and offsets and slopes of 1 % of the power, each for every pass of a daughter; evenly spread numbers of unit variance.
fn perturb(powers: &mut [PowerSample]) {
    let mut step = 0.0;
    let mut number = || {
        step = (step + 0.618_033_988_749_895) % 1.0;
        12.0_f64.sqrt() * (step - 0.5)
    };
    let goes_on = |a: &PowerSample, b: &PowerSample| a.daughter == b.daughter && b.time_s - a.time_s < 600.0;
    for pass in powers.chunk_by_mut(goes_on) {
        let [gain, offset, slope] = [1.0 + 0.1 * number(), 0.01 * number(), 0.01 * number()];
        let mean = pass.iter().map(|one| one.power_k_sr).sum::<f64>() / pass.len() as f64;
        let [start, end] = [pass[0].time_s, pass[pass.len() - 1].time_s];
        for one in pass {
            let before = one.power_k_sr;
            let time = (one.time_s - 0.5 * (start + end)) / (end - start);
            one.power_k_sr = gain * before + mean * (offset + slope * time);
            one.sigma_k_sr *= one.power_k_sr / before;
        }
    }
}

/// The map of one channel with powers that are first changed.
fn map_with(state: &str, change: &dyn Fn(&mut [PowerSample])) -> JointMap {
    let folder = Path::new(state);
    let config = ConfigSource::default().with_state_settings(folder).unwrap().load_ground().unwrap();
    let priors = PowerPriors { gain: 0.1, offset: 0.01, slope: 0.01, constant_k_sr: vec![0.0] };
    let rule = StoppingRule { residual_max: 1e-4, iterations_max: 300 };
    let request = JointRequest { rule, samples: 8, at_hz: Vec::new(), powers: Some(priors) };
    let place = SumsStorage { limit: None, folder };
    let watch = SolveWatch::default();
    let mut channels = joint_channels(&[(folder, config)], &request, place, &watch).unwrap();
    change(&mut channels[0].powers);
    solve_jointly(channels, &request, &watch).unwrap().maps.remove(0)
}

#[test]
fn powers_with_unknown_gains_see_the_largest_scales_and_the_mean() {
    let one = "channels_hz = [10.0e6]\nauto_powers = true\nauto_integration_s = 30.0";
    let place = Workplace::new(&PIPELINE.replace("channels_hz = [5.0e6, 7.0e6, 10.0e6]", one));
    let file = place.simulate("all.ccsds", &[]);
    let (state, alone, joint) = (place.path("state"), place.path("alone"), place.path("joint"));
    succeed(&["replay", &file, "--map", &place.pipeline, "--state", &state, "--out", &alone]);
    let report = json(&["joint", &state, "--count", "8", "--out", &joint]);
    let found = &report["maps"][0];
    assert!(
        report["likeness"].as_array().is_some_and(Vec::is_empty) && report["spectra"].is_null(),
        "{report}"
    );
    // 42 of every 120th of some 5000 windows, with a pass of each daughter.
    assert_eq!(found["powers"]["passes"].as_u64().unwrap() % 8, 0, "{found}");
    let sky = place.path("sky.fits");
    succeed(&["sky", &place.pipeline, "--freq-hz", "1e7", "--nside", "8", "--out", &sky]);
    let truth = mean_of(&sky);
    let [mean, sigma] = ["mean_k", "mean_sigma_k"].map(|key| found[key].as_f64().unwrap());
    assert!((mean - truth).abs() < 4.0 * sigma && sigma < 0.01 * truth, "{mean} {sigma} {truth}");
    let with_powers = all_rho(&format!("{joint}/10.000MHz/map.fits"), &sky);
    let before = all_rho(&format!("{alone}/10.000MHz/map.fits"), &sky);
    let map = map_with(&state, &perturb);
    let perturbed = place.path("perturbed.fits");
    let written = SkyMap::new(Frame::Ecliptic, map.map_k.clone()).unwrap();
    write_map(Path::new(&perturbed), &written, &WriteOptions::default()).unwrap();
    let mean = map.map_k.iter().sum::<f64>() / map.map_k.len() as f64;
    assert!((mean - truth).abs() < 4.0 * map.mean_sigma_k, "{mean} {} {truth}", map.mean_sigma_k);
    let perturbed = all_rho(&perturbed, &sky);
    let mean = |rho: &[f64], l: std::ops::RangeInclusive<usize>| {
        let count = l.clone().count() as f64;
        rho[l].iter().sum::<f64>() / count
    };
    // Powers see what baselines of some wavelengths hardly do.
    assert!(mean(&with_powers, 3..=8) > mean(&before, 3..=8) + 0.05, "{with_powers:?} {before:?}");
    assert!(mean(&with_powers, 2..=16) > mean(&before, 2..=16), "{with_powers:?} {before:?}");
    assert!(mean(&perturbed, 2..=16) > mean(&with_powers, 2..=16) - 0.01, "{perturbed:?} {with_powers:?}");
    let said = fail(&["joint", &state, "--no-powers", "--out", &place.path("none")]);
    assert!(said.contains("or one with total powers"), "{said}");
}
