//! `lunarray calibrate`: from data with errors to gains, and to maps with them.

use crate::common;

use std::path::Path;

use common::downlink::{packets_of, pass_ends};
use common::workplace::{Workplace, fail, json, succeed};
use lunarray::sky::fits::{ReadOptions, WriteOptions, read_map_file, write_map};
use lunarray::sky::{Frame, SkyMap};

/// Eight daughters whose data are direct sums over the map's own pixels, so that the input is a perfect model.
const SMALL: &str = r#"
name = "calibrated"
seed = 6
[sky]
nside = 4
[spacecraft]
channels_hz = [3.0e6, 5.0e6]
channel_width_hz = 2e5              # little noise
duration_s = 8e5
every_nth_window = 12
every_nth_integration = 60
baseline_wavelengths_max = 400.0
model = "direct"
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-4
rows = "centre"
baseline_bp_max = 60.0
[products]
pictures = false
"#;

/// 60 deg of phase, 10 % of amplitude, 30 ns of clock, 10 m of position.
const ERRORS: [&str; 6] = [
    "instrument.phase_deg={pass_rms=60.0}",
    "instrument.amplitude={pass_rms=0.1}",
    "instrument.clock_ns={pass_rms=30.0}",
    "navigation.along_m={pass_rms=10.0}",
    "navigation.across_m={pass_rms=10.0}",
    "navigation.radial_m={pass_rms=10.0}",
];

/// Those of them that are no positions.
const GAINS: [&str; 3] = [ERRORS[0], ERRORS[1], ERRORS[2]];

const MHZ: [&str; 2] = ["3.000MHz", "5.000MHz"];

fn command(place: &Workplace, command: &str, out: &str, set: &[&str]) -> String {
    let out = place.path(out);
    let mut args = vec![command, &place.pipeline, "--out", &out];
    for set in set {
        args.extend(["--set", set]);
    }
    succeed(&args);
    out
}

/// Part of the sky's power that a map keeps, by channel: the square of its projection on that of data without errors, over
/// 2 <= l <= 8.
fn kept(folder: &str, ideal: &str) -> Vec<f64> {
    let of = |channel: &&str| {
        let map = |folder: &str| format!("{folder}/{channel}/map.fits");
        let spectra = json(&["compare", &map(folder), &map(ideal), "--no-plot", "--l-max", "8"]);
        let sum = |name: &str| -> f64 {
            spectra[name].as_array().unwrap()[2..].iter().map(|power| power.as_f64().unwrap()).sum()
        };
        (sum("cl_cross") / sum("cl_truth")).powi(2)
    };
    MHZ.iter().map(of).collect()
}

/// Calibrates the downlink of a run with models of it, and maps it; returns the summary and the folder of the maps.
fn calibrated(
    place: &Workplace,
    (run, name): (&str, &str),
    models: &[String],
    set: &[&str],
) -> (serde_json::Value, String) {
    let (downlink, out, maps) =
        (format!("{run}/downlink.ccsds"), place.path(name), place.path(&format!("{name}-maps")));
    let mut args = vec!["calibrate", &downlink, "--map", &place.pipeline, "--out", &out, "--json"];
    for set in set {
        args.extend(["--set", set]);
    }
    if !models.is_empty() {
        args.push("--model");
        args.extend(models.iter().map(String::as_str));
    }
    let text = succeed(&args);
    let gains = format!("{out}/gains.json");
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--calibration", &gains, "--out", &maps]);
    (serde_json::from_str(&text).unwrap(), maps)
}

fn inputs(run: &str) -> Vec<String> {
    MHZ.iter().map(|channel| format!("{run}/{channel}/input.fits")).collect()
}

#[test]
fn a_known_sky_takes_large_errors_back() {
    let place = Workplace::new(SMALL);
    let ideal = command(&place, "run", "ideal", &[]);
    let spoilt = command(&place, "run", "spoilt", &ERRORS);
    let before = kept(&spoilt, &ideal);
    let set = [
        "calibrate.clock_sigma_ns=60.0",
        "calibrate.position_sigma_m=20.0",
        "calibrate.amplitude_sigma=0.2",
        "calibrate.position_rounds=6",
    ];
    let (summary, maps) = calibrated(&place, (&spoilt, "solved"), &inputs(&ideal), &set);
    let after = kept(&maps, &ideal);
    eprintln!(
        "sky: power kept {before:.4?} before, {after:.4?} after; chi-square {}",
        summary["rounds"][0]["chi_square"]
    );
    eprintln!("phases known to {} deg", summary["phase_sigma_deg"]);
    // Ten metres are more than a radian at 5 MHz: in some passes the search ends elsewhere, says so, and their data are left
    // out.
    let [solutions, converged] = ["solutions", "converged"].map(|name| summary[name].as_u64().unwrap());
    assert!(solutions == 8 && converged >= 6, "{converged} of {solutions}");
    assert!(before.iter().all(|kept| *kept < 0.5), "{before:?}");
    assert!(after.iter().all(|kept| *kept > 0.95 && *kept < 1.05), "{after:?}");
    // Again, on another number of threads: the same bytes.
    let again =
        calibrated(&place, (&spoilt, "again"), &inputs(&ideal), &[&set[..], &["runtime.threads=1"]].concat());
    assert_eq!(summary, again.0);
    for file in ["gains.json", "solutions.csv", "solutions.json"] {
        let read = |name: &str| std::fs::read(Path::new(&place.path(name)).join(file)).unwrap();
        assert!(read("solved") == read("again"), "{file}");
    }
}

#[test]
fn perfect_data_stay_as_they_are() {
    let place = Workplace::new(SMALL);
    let ideal = command(&place, "run", "ideal", &[]);
    let (summary, solved) = calibrated(&place, (&ideal, "solved"), &inputs(&ideal), &[]);
    let chi_square = summary["rounds"][0]["chi_square"].as_f64().unwrap();
    // 1,400 visibilities of a pass less some 30 parameters, 8 passes.
    assert!((chi_square - 1.0).abs() < 0.05, "{chi_square}");
    for channel in MHZ {
        let of = |folder: &str, name: &str| {
            let path = format!("{folder}/{channel}/{name}.fits");
            let options = lunarray::sky::fits::ReadOptions::default();
            lunarray::sky::fits::read_whole_map(Path::new(&path), &options).unwrap().into_values()
        };
        let rms = |values: &[f64]| (values.iter().map(|x| x * x).sum::<f64>() / values.len() as f64).sqrt();
        let changed: Vec<f64> =
            of(&ideal, "map").iter().zip(of(&solved, "map")).map(|(before, after)| after - before).collect();
        let (changed, noise) = (rms(&changed), rms(&of(&ideal, "noise")));
        eprintln!("{channel}: the map changes by {:.3} of its noise", changed / noise);
        assert!(changed < noise, "{channel}: {changed} K for a noise of {noise} K");
    }
}

#[test]
fn a_source_that_the_model_lacks_is_named_with_its_place_and_flux() {
    let place = Workplace::new(SMALL);
    let ideal = command(&place, "run", "ideal", &[]);
    let source = "sky.moving=[{ direction = [130.0, 35.0], steady_jy = 1e6 }]";
    let with_source = command(&place, "run", "source", &[&GAINS[..], &[source]].concat());
    let set = ["calibrate.clock_sigma_ns=60.0", "calibrate.amplitude_sigma=0.2"];
    let (summary, _) = calibrated(&place, (&with_source, "solved"), &inputs(&ideal), &set);
    let events = summary["events"].as_array().unwrap();
    for channel in [0, 1] {
        let named: Vec<_> = events
            .iter()
            .filter(|event| event["event"] == "missing-source" && event["channel"] == channel)
            .collect();
        // A pass may have too few short baselines for a name.
        let others = ["wrong-frequency", "wrong-strength", "dead"];
        let is_other = |event: &&serde_json::Value| others.iter().any(|name| event["event"] == *name);
        assert!(!named.is_empty() && !events.iter().any(|event| is_other(&event)), "{events:?}");
        for event in named {
            let [longitude, latitude] = [0, 1].map(|k| event["position_deg"][k].as_f64().unwrap());
            let flux_jy = event["flux_jy"].as_f64().unwrap();
            // Baselines of 60 wavelengths have fringes of 1 deg; amplitudes have an error of 10 %, squared.
            assert!((longitude - 130.0).abs() < 0.3 && (latitude - 35.0).abs() < 0.3, "{event}");
            assert!((flux_jy / 1e6).ln().abs() < 0.3, "{event}");
        }
    }
}

const BEACON: [&str; 4] = [
    "instrument.beacon={k_sr=1e10,direction_deg=[40.0,10.0],on_s=300.0,every_s=1000.0}",
    "calibrate.beacon_k_sr=1e10",
    "calibrate.beacon_direction_deg=[40.0,10.0]",
    "calibrate.clock_sigma_ns=60.0",
];

#[test]
fn a_beacon_takes_large_gains_back_without_a_map() {
    let place = Workplace::new(SMALL);
    let ideal = command(&place, "run", "ideal", &BEACON);
    let spoilt = command(&place, "run", "spoilt", &[&GAINS[..], &BEACON].concat());
    let before = kept(&spoilt, &ideal);
    let mode = |mode: &'static str| [&BEACON[..], &[mode]].concat();
    let (_, maps) = calibrated(&place, (&spoilt, "beacon"), &[], &mode("calibrate.mode=beacon"));
    let after = kept(&maps, &ideal);
    eprintln!("beacon: power kept {before:.4?} before, {after:.4?} after");
    assert!(before.iter().all(|kept| *kept < 0.5), "{before:?}");
    assert!(after.iter().all(|kept| *kept > 0.95 && *kept < 1.05), "{after:?}");
}

#[test]
fn map_and_gains_settle_in_turn_from_the_beacon() {
    let place = Workplace::new(SMALL);
    let ideal = command(&place, "run", "ideal", &BEACON);
    let spoilt = command(&place, "run", "spoilt", &[&GAINS[..], &BEACON].concat());
    let joint = ["calibrate.mode=joint", "calibrate.map_rounds=2", "calibrate.hold_out_every=4"];
    let (summary, maps) = calibrated(&place, (&spoilt, "joint"), &[], &[&BEACON[..], &joint].concat());
    let after = kept(&maps, &ideal);
    let rounds = summary["rounds"].as_array().unwrap();
    for round in rounds {
        let of = |name: &str| round[name].to_string();
        eprintln!(
            "joint: chi-square {}, held out {}, change {}",
            of("chi_square"),
            of("chi_square_held_out"),
            of("change_rms")
        );
    }
    eprintln!("joint: power kept {after:.4?} after");
    assert!(after.iter().all(|kept| *kept > 0.95 && *kept < 1.05), "{after:?}");
    // Guard: what is told of the maps' power, by degree and channel.
    assert_eq!(rounds.last().unwrap()["map_cl_k2"].as_array().unwrap().len(), 2);
    assert!(rounds.last().unwrap()["chi_square_held_out"].as_f64().unwrap() > 0.0);
}

/// Errors of the data, with and without calibration.
const STUDY: &str = r#"
name = "kept"
pipeline = "pipeline.toml"
calibrated = true
[[axis]]
cases = [
    { label = "none", set = [] },
    { label = "large", set = ["instrument.phase_deg.pass_rms=60.0", "instrument.clock_ns.pass_rms=30.0"] },
]
"#;

#[test]
fn a_study_has_each_case_as_sent_and_calibrated() {
    let place = Workplace::new(SMALL);
    // Spectra of summaries are those of maps without noise.
    let beacon = [&BEACON[..], &["calibrate.mode=beacon", "spacecraft.thermal_noise=false"]].concat();
    let errors = ["instrument.phase_deg.pass_rms=60.0", "instrument.clock_ns.pass_rms=30.0"];
    let ideal = command(&place, "run", "ideal", &beacon);
    let spoilt = command(&place, "run", "spoilt", &[&errors[..], &beacon].concat());
    let (_, maps) = calibrated(&place, (&spoilt, "solved"), &[], &beacon);
    let study = place.file("study.toml", STUDY.as_bytes());
    let out = place.path("study");
    let mut args = vec!["study", &study, "--out", &out, "--json"];
    beacon.iter().for_each(|set| args.extend(["--set", set]));
    let summary: serde_json::Value = serde_json::from_str(&succeed(&args)).unwrap();
    let labels: Vec<&str> = summary["cases"]
        .as_array()
        .unwrap()
        .iter()
        .map(|case| case["figures"]["name"].as_str().unwrap())
        .collect();
    assert_eq!(labels, ["as sent, none", "calibrated, none", "as sent, large", "calibrated, large"]);
    // The maps of separate commands.
    for (case, alone) in [("as-sent-none", &ideal), ("as-sent-large", &spoilt), ("calibrated-large", &maps)] {
        let [case, alone] = [format!("{out}/case-{case}"), alone.clone()];
        let values = |folder: &str| {
            let path = format!("{folder}/{}/map.fits", MHZ[1]);
            let options = lunarray::sky::fits::ReadOptions::default();
            lunarray::sky::fits::read_whole_map(Path::new(&path), &options).unwrap().into_values()
        };
        assert_eq!(values(&case), values(&alone), "{case}");
    }
    let gains = |folder: &str| std::fs::read(format!("{folder}/gains.json")).unwrap();
    assert!(gains(&format!("{out}/case-calibrated-large/calibration")) == gains(&place.path("solved")));
    // What is kept, by the spectra of separate commands.
    let power = |folder: &str, name: &str, l: usize| {
        let text = std::fs::read_to_string(format!("{folder}/summary.json")).unwrap();
        let summary: serde_json::Value = serde_json::from_str(&text).unwrap();
        summary["channels"][1]["power"][name][l].as_f64().unwrap()
    };
    let kept = &summary["cases"][2]["figures"]["channels"][1]["power_kept"];
    for l in 0..=8 {
        for (name, of, square) in [("cl_ratio", "map_k2", false), ("coherent", "cross_k2", true)] {
            let ratio = power(&spoilt, of, l) / power(&ideal, of, l);
            let expected = if square { ratio * ratio } else { ratio };
            assert!((kept[name][l].as_f64().unwrap() / expected - 1.0).abs() < 1e-12, "{name}, {l}");
        }
    }
    let coherent = |number: usize, l: usize| {
        summary["cases"][number]["figures"]["channels"][1]["power_kept"]["coherent"][l].as_f64().unwrap()
    };
    let mean = |number| (2..=8).map(|l| coherent(number, l)).sum::<f64>() / 7.0;
    eprintln!("coherent: {:.3} as sent, {:.3} calibrated", mean(2), mean(3));
    // The bounds of the tests above.
    assert!(mean(2) < 0.5 && mean(3) > 0.95 && mean(3) < 1.05);
    assert!(summary["cases"][0]["figures"]["channels"][1]["power_kept"]["coherent"][4].as_f64() == Some(1.0));
    // Nothing is made again; with a map to calibrate with, only what is calibrated.
    let made =
        |case: &str| std::fs::metadata(format!("{out}/case-{case}/case.json")).unwrap().modified().unwrap();
    let before = ["as-sent-large", "calibrated-large"].map(made);
    assert_eq!(serde_json::from_str::<serde_json::Value>(&succeed(&args)).unwrap(), summary);
    assert_eq!(["as-sent-large", "calibrated-large"].map(made), before);
    // A map of nside 4 has no means of degrees from 20 on.
    let plain: Vec<&str> = args.iter().copied().filter(|arg| *arg != "--json").collect();
    let told = succeed(&plain);
    assert!(told.contains("5.000 MHz: the map ends at l = 8, before l = 20"), "{told}");
    assert!(!told.contains("l = 20 to"), "{told}");
    // The model is of the sky of both channels: one is missing.
    let model = format!("model = [\"{ideal}/{}/input.fits\"]\n{STUDY}", MHZ[0]);
    let study = place.file("modelled.toml", model.as_bytes());
    args[1] = &study;
    assert!(fail(&args).contains("one for each channel of the downlink"));
    assert_eq!(made("as-sent-large"), before[0]);
}

#[test]
fn what_does_not_fit_is_refused() {
    let place = Workplace::new(SMALL);
    let file = command(&place, "simulate", "a.ccsds", &["spacecraft.duration_s=1e5"]);
    let out = place.path("out");
    let said = |more: &[&str]| {
        fail(&[&["calibrate", &file, "--map", &place.pipeline, "--out", &out][..], more].concat())
    };
    assert!(said(&[]).contains("--model = (none): expected maps of the sky"));
    assert!(said(&["--set", "calibrate.mode=beacon"]).contains("calibrate.beacon_k_sr = 0"));
    let zero = ["calibrate.phase_sigma_deg=0", "calibrate.amplitude_sigma=0"];
    assert!(said(&["--set", zero[0], "--set", zero[1]]).contains("something to solve for"));
    // Nothing is left of what came to nothing.
    let sky = place.path("one.fits");
    succeed(&["sky", &place.pipeline, "--no-picture", "--freq-hz", "3MHz", "--nside", "4", "--out", &sky]);
    assert!(said(&["--model", &sky]).contains("one for each channel of the downlink"));
    assert!(!Path::new(&out).exists());
}

#[test]
fn files_are_of_one_instrument_and_taken_in_the_order_of_time() {
    let place = Workplace::new(SMALL);
    let run = command(&place, "run", "spoilt", &GAINS);
    let bytes = std::fs::read(format!("{run}/downlink.ccsds")).unwrap();
    let packets = packets_of(&bytes);
    let ends = pass_ends(&packets);
    // The first packet describes the instrument.
    let middle = (packets.len() / 2..packets.len()).find(|&k| ends[k - 1]).unwrap();
    let first = place.file("first.ccsds", &packets[..middle].concat());
    let second = place.file("second.ccsds", &[&packets[..1], &packets[middle..]].concat().concat());
    let models = inputs(&run);
    let gains = |files: &[&str], name: &str| {
        let out = place.path(name);
        let mut args = vec!["calibrate"];
        args.extend(files);
        args.extend(["--map", &place.pipeline, "--out", &out, "--json", "--model"]);
        args.extend(models.iter().map(String::as_str));
        let summary: serde_json::Value = serde_json::from_str(&succeed(&args)).unwrap();
        assert_eq!((&summary["late"], &summary["warnings"]), (&0.into(), &serde_json::json!([])));
        std::fs::read_to_string(format!("{out}/gains.json")).unwrap()
    };
    let expected = gains(&[&format!("{run}/downlink.ccsds")], "one");
    assert!(gains(&[&second, &first], "two") == expected);

    let other = command(&place, "simulate", "other.ccsds", &["spacecraft.channels_hz=[3e6]"]);
    let out = place.path("refused");
    let said = |files: &[&str]| {
        let models: Vec<&str> = models.iter().map(String::as_str).collect();
        let args = [&["calibrate"], files, &["--map", &place.pipeline, "--out", &out, "--model"], &models];
        fail(&args.concat())
    };
    let told = said(&[&first, &other]);
    assert!(told.contains("one mission at a time") && told.contains("other.ccsds"), "{told}");
    let described = place.file("described.ccsds", &packets[0]);
    let told = said(&[&described]);
    assert!(told.contains("there is nothing to solve"), "{told}");
    assert!(!Path::new(&format!("{out}/gains.json")).exists());
}

#[test]
fn known_skies_and_priors_are_of_the_frequencies_of_the_channels() {
    let place = Workplace::new(SMALL);
    let file = command(&place, "simulate", "a.ccsds", &["spacecraft.duration_s=1e5"]);
    let sky = |name: &str, more: &[&str]| {
        let out = place.path(name);
        succeed(&[&["sky", &place.pipeline, "--no-picture", "--out", &out], more].concat());
        let options = ReadOptions::default();
        let header = read_map_file(Path::new(&out), &options).unwrap().header;
        (out, header.real("FREQ").unwrap())
    };
    let (three, three_hz) = sky("three.fits", &["--freq-hz", "3MHz", "--nside", "4"]);
    let (five, five_hz) = sky("five.fits", &["--freq-hz", "5MHz", "--nside", "4"]);
    // A wrong sky is of the frequency that it stands for.
    let (_, law_hz) = sky("law.fits", &["--freq-hz", "3MHz", "--extrapolate-from", "10MHz", "--nside", "4"]);
    let (_, like_hz) = sky("like.fits", &["--like", &three, "--correlation", "0.5"]);
    assert_eq!([three_hz, five_hz, law_hz, like_hz], [3e6, 5e6, 3e6, 3e6]);

    let out = place.path("out");
    let says = |args: &[&str]| {
        let said = fail(args);
        let expected = "five.fits: the keyword FREQ is 5 MHz; expected 3 MHz, the channel's: give a map of that frequency";
        assert!(said.contains(expected) && !said.contains("sky.frequency"), "{args:?}: {said}");
    };
    let list = |key: &str, files: [&str; 2]| format!("{key}={files:?}");
    let (models, priors) =
        (list("calibrate.model_files", [&five, &three]), list("map.prior_files", [&five, &three]));
    let calibrate = ["calibrate", &file, "--map", &place.pipeline, "--out", &out];
    says(&[&calibrate[..], &["--model", &five, &three]].concat());
    says(&[&calibrate[..], &["--set", &models]].concat());
    let replay = ["replay", &file, "--map", &place.pipeline, "--out", &out];
    says(&[&replay[..], &["--set", "calibration.hook=solve", "--set", &models]].concat());
    says(&[&replay[..], &["--set", &priors]].concat());
    says(&[&replay[..], &["--set", &priors, "--groups", "1"]].concat());
    says(&["check", &place.pipeline, "--set", &models]);
    says(&["check", &place.pipeline, "--set", &priors]);
    // A study says so before it simulates.
    let study = "pipeline = \"pipeline.toml\"\ncalibrated = true\nmodel = [\"five.fits\", \"three.fits\"]\n";
    let study = place.file("study.toml", study.as_bytes());
    let out = place.path("studied");
    says(&["study", &study, "--out", &out]);
    assert!(!Path::new(&out).exists());

    // A map that does not say it is taken, whatever its frequency; one without power is no known sky, but may be a prior.
    let write = |name: &str, value: f64| {
        let path = place.path(name);
        let map = SkyMap::new(Frame::Ecliptic, vec![value; 192]).unwrap();
        write_map(Path::new(&path), &map, &WriteOptions::default()).unwrap();
        path
    };
    let (bare, zero) = (write("bare.fits", 1e5), write("zero.fits", 0.0));
    succeed(&["check", &place.pipeline, "--set", &list("calibrate.model_files", [&bare, &bare])]);
    succeed(&["check", &place.pipeline, "--set", &list("map.prior_files", [&zero, &zero])]);
    let dark = "zero.fits: the mean of the pixels is 0e0 K";
    let said = fail(&["check", &place.pipeline, "--set", &list("calibrate.model_files", [&zero, &zero])]);
    assert!(said.contains(dark) && !said.contains("receiver"), "{said}");
    assert!(fail(&[&calibrate[..], &["--model", &zero, &zero]].concat()).contains(dark));
}
