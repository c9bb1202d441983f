//! Bursts of the Sun through the whole chain: made, found, left out of the map.

use std::io::Write;
use std::path::Path;

use lunarray::downlink::{DownlinkConfig, DownlinkReader};
use lunarray::frames::{GroundFrame, VisibilityBlock};
use lunarray::sky::fits::{ReadOptions, read_whole_map};
use serde_json::Value;

use super::common::downlink::{packets_of, pass_ends, transmit};
use super::common::process::{end, listening, start, wait_until};
use super::common::workplace::{Workplace, fail, json, succeed};

/// Three passes at 10 MHz, with daughters near each other, as a map of nside 4 asks for.
const MISSION: &str = r#"
name = "bursts"
seed = 5
[sky]
nside = 8
[array]
arcs_m = [15.0, 32.0, 52.0, 80.0, 120.0, 170.0, 240.0]
[spacecraft]
channels_hz = [10.0e6]
duration_s = 46_000.0
every_nth_window = 2
model = "harmonic"
[map]
nside = 4
engine = "pixel"
epsilon = 1e-5
[products]
pictures = false
[calibration]
bursts = "flag"
"#;

/// A type III burst of 1e8 Jy at 10 MHz, while the Sun is in sight.
const BURST: &str = "sky.moving=[{ direction = 'sun', starts_s = [38_000.0], peak_jy = 1e8 }]";

/// Mean of rho_l of the map from l = 1 to 8.
fn rho(summary: &Value) -> f64 {
    let rho = summary["channels"][0]["rho"].as_array().unwrap();
    (1..=8).map(|l| rho[l].as_f64().unwrap()).sum::<f64>() / 8.0
}

fn without(block: &mut VisibilityBlock, [from_s, until_s]: [f64; 2]) {
    let half_s = |k: usize| 0.5e-6 * f64::from(block.duration_ticks[k]);
    let is_in =
        |k: &usize| block.middle_s(*k) + half_s(*k) > from_s && block.middle_s(*k) - half_s(*k) < until_s;
    let kept: Vec<usize> = (0..block.len()).filter(|k| !is_in(k)).collect();
    let mut less = VisibilityBlock {
        channel: block.channel,
        pair: block.pair,
        start: block.start,
        ..Default::default()
    };
    for k in kept {
        less.offset_ticks.push(block.offset_ticks[k]);
        less.duration_ticks.push(block.duration_ticks[k]);
        less.value_k_sr.push(block.value_k_sr[k]);
        less.weight.push(block.weight[k]);
        less.flags.push(block.flags[k]);
    }
    *block = less;
}

/// The frames of a downlink, without the visibilities in a span of time.
fn frames_without(file: &str, span_s: [f64; 2]) -> Vec<GroundFrame> {
    let mut reader = DownlinkReader::open(Path::new(file)).unwrap();
    let mut frames = Vec::new();
    while let Some(mut frame) = reader.next_frame().unwrap() {
        if let GroundFrame::Visibilities(block) = &mut frame {
            without(block, span_s);
            if block.is_empty() {
                continue;
            }
        }
        frames.push(frame);
    }
    frames
}

/// The middle and length of each integration, s, and the system's power of a pair, K sr, from a weight: 1 / weight = P_i P_j / (2 dnu dt).
fn powers_k_sr(file: &str) -> Vec<([f64; 2], f64)> {
    let mut found = Vec::new();
    for frame in frames_without(file, [0.0, 0.0]) {
        let GroundFrame::Visibilities(block) = frame else { continue };
        found.extend((0..block.len()).map(|k| {
            let dt_s = 1e-6 * f64::from(block.duration_ticks[k]);
            ([block.middle_s(k), dt_s], (2.0 * 8e3 * dt_s / f64::from(block.weight[k])).sqrt())
        }));
    }
    found
}

/// Powers rise by the flux density of the light curve, 3.2548e7 K sr at its peak (numpy: 1e-18 (c / 1e7)^2 / 2 k).
fn noise_rises_with_the_burst([quiet, burst]: &[String; 2]) {
    let mut bright = 0;
    let light_curve = |after_s: f64| match after_s {
        after_s if after_s <= -5.0 => 0.0,
        after_s if after_s < 0.0 => 3.2548e7 * (1.0 + after_s / 5.0),
        after_s => 3.2548e7 * (-after_s / 11.5).exp(),
    };
    for (([t_s, dt_s], quiet_k_sr), (_, k_sr)) in powers_k_sr(quiet).into_iter().zip(powers_k_sr(burst)) {
        // The mean over the integration, of 1,000 instants.
        let instants = (0..1000).map(|k| t_s - 38_005.0 + dt_s * ((f64::from(k) + 0.5) / 1000.0 - 0.5));
        let expected = instants.map(light_curve).sum::<f64>() / 1000.0;
        // The square root of the product of two powers is their mean, to the square of their difference of some percent.
        assert!((k_sr - quiet_k_sr - expected).abs() < 2e-3 * k_sr, "{t_s}: {quiet_k_sr} {k_sr} {expected}");
        bright += usize::from(expected > 1e7);
    }
    assert!(bright > 10, "{bright}");
}

#[test]
fn a_burst_of_the_sun_is_found_and_left_out() {
    let place = Workplace::new(MISSION);
    let run = |name: &str, more: &[&str]| {
        json(&[&["run", &place.pipeline, "--out", &place.path(name)], more].concat())
    };
    let quiet = run("quiet", &[]);
    assert_eq!(quiet["bursts"]["found"], 0);
    // Three passes of 28 pairs.
    let searched = &quiet["bursts"]["searched"][0];
    assert_eq!((&searched["passes"], &searched["not_searched"]), (&3.into(), &0.into()));
    let flagged = run("flag", &["--set", BURST]);
    let kept = run("keep", &["--set", BURST, "--set", "calibration.bursts=keep"]);
    let [of_quiet, of_flagged, of_kept] = [&quiet, &flagged, &kept].map(rho);
    assert!((of_flagged - of_quiet).abs() < 0.01, "{of_quiet} {of_flagged} {of_kept}");
    assert!(of_kept < of_quiet - 0.1, "{of_quiet} {of_flagged} {of_kept}");

    let found = &flagged["bursts"];
    assert_eq!((&found["action"], &found["found"]), (&"flag".into(), &1.into()));
    let burst = &found["bursts"][0];
    // The Sun on 2 January, by the date of the mission's epoch: the truth's file has 280.54, 0.02. Some 300 m in a line, by which places of a
    // circle are alike: one of the directions is within three standard deviations, as 99.7 % are.
    let numbers = |value: &Value| -> Vec<f64> {
        value.as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect()
    };
    let places = burst["positions_deg"].as_array().unwrap().iter().map(numbers);
    let errors = burst["position_errors_deg"].as_array().unwrap().iter().map(numbers);
    let off = |(place, error): (Vec<f64>, Vec<f64>)| (place[0] - 280.54).hypot(place[1]) / error[0];
    let nearest = places.zip(errors).map(off).fold(f64::INFINITY, f64::min);
    assert!(nearest < 3.0, "{burst}");
    let number = |key: &str| burst[key].as_f64().unwrap();
    // The truth has the peak and the flux density; a bin is at least 10 s wide, and its mean less than the peak.
    let truth = std::fs::read_to_string(place.path("flag/downlink.ccsds.moving.csv")).unwrap();
    let line: Vec<&str> = truth.lines().nth(1).unwrap().split(',').collect();
    let peak_s: f64 = line[4].parse().unwrap();
    assert!((number("peak_s") - peak_s).abs() < 30.0, "{truth} {burst}");
    assert!(number("flux_jy") > 1e7 && number("flux_jy") < 1e8, "{burst}");
    let hours = found["channels"][0]["hours"].as_f64().unwrap();
    assert!(
        (3600.0 * hours - (number("until_s") - number("from_s"))).abs() < 1e-6 && hours < 0.15,
        "{found}"
    );
    // The Sun was in sight, and what is behind the Moon was not: from 300 km above it covers 0.24 of the sky; of 48 directions
    // some three lie at its edge.
    let by_direction: Vec<f64> = found["channels"][0]["hours_left_out_by_direction"]
        .as_array()
        .unwrap()
        .iter()
        .map(|hours| hours.as_f64().unwrap())
        .collect();
    assert_eq!((by_direction.len(), found["channels"][0]["hours_left_out"].as_f64()), (48, Some(hours)));
    let seen = by_direction.iter().sum::<f64>() / (48.0 * hours);
    assert!((seen - 0.76).abs() < 0.06, "{by_direction:?}");

    let reasons = &flagged["ledger"]["flagged"];
    let left_out = reasons["burst of a point source"].as_u64().unwrap();
    assert!(left_out > 100, "{reasons}");
    assert_eq!(kept["ledger"]["flagged"]["burst of a point source"], Value::Null);

    noise_rises_with_the_burst(&["quiet", "flag"].map(|run| place.path(&format!("{run}/downlink.ccsds"))));

    // A ground that never had these visibilities makes the same map.
    let frames = frames_without(&place.path("flag/downlink.ccsds"), ["from_s", "until_s"].map(number));
    let never = place.file("never.ccsds", &transmit(&frames, &DownlinkConfig::default()));
    let out = place.path("never");
    succeed(&["replay", &never, "--map", &place.pipeline, "--out", &out]);
    for name in ["map.fits", "noise.fits"] {
        let bytes = |run: &str| std::fs::read(place.path(&format!("{run}/10.000MHz/{name}"))).unwrap();
        assert!(bytes("flag") == bytes("never"), "{name}");
    }
}

#[test]
fn a_burst_is_subtracted_with_its_error() {
    let place = Workplace::new(MISSION);
    let run = |name: &str, more: &[&str]| {
        json(&[&["run", &place.pipeline, "--out", &place.path(name)], more].concat())
    };
    let quiet = run("quiet", &[]);
    let peel = ["--set", BURST, "--set", "calibration.bursts=peel"];
    let peeled = run("peel", &peel);
    let [of_quiet, of_peeled] = [&quiet, &peeled].map(rho);
    // Kept it costs more than 0.1, as above.
    assert!((of_peeled - of_quiet).abs() < 0.01, "{of_quiet} {of_peeled}");
    let hours = &peeled["bursts"]["channels"][0];
    let number = |key: &str| hours[key].as_f64().unwrap();
    assert!(number("hours") > 0.01 && number("hours_left_out") < 0.5 * number("hours"), "{hours}");

    // A state subtracts the same from what arrives again, and gives the packets back: its sums are those that were added.
    let (file, state) = (place.path("peel/downlink.ccsds"), place.path("state"));
    let replay = |name: &str| {
        let out = place.path(name);
        let set = "calibration.bursts=peel";
        json(&["replay", &file, "--map", &place.pipeline, "--set", set, "--state", &state, "--out", &out])
    };
    let [first, again] = ["first", "again"].map(replay);
    let map = |name: &str| std::fs::read(place.path(&format!("{name}/10.000MHz/map.fits"))).unwrap();
    assert!(map("first") == map("again") && first["ledger"] == again["ledger"]);
    // What was fitted with the old gains is not subtracted from what has new ones.
    let gains = "[[channels]]\nfrequency_hz = 1e7\nsolutions = [{ time_s = 0, gains = [[2, 0], [1, 0], [1, 0], [1, 0], [1, 0], [1, 0], \
                 [1, 0], [1, 0]] }]";
    let gains = place.file("gains.toml", gains.as_bytes());
    let common = ["--state", &state, "--map", &place.pipeline, "--set", "calibration.bursts=peel"];
    let said = fail(&[&["recalibrate", &file, "--calibration", &gains], &common[..]].concat());
    assert!(
        said.contains("whose flux was fitted with the old gains") && said.contains("lunarray rebuild"),
        "{said}"
    );
    let report = json(&[&["retract", &file, "--from-s", "0"], &common[..]].concat());
    assert_eq!(report["refused"], 0);
    assert_eq!(report["accumulated"], first["ledger"]["accumulated"]);
}

#[test]
fn a_state_knows_its_bursts_and_gives_their_packets_back() {
    let place = Workplace::new(MISSION);
    let file = place.simulate("bursts.ccsds", &["--set", BURST]);
    let state = place.path("state");
    let replay = |name: &str, more: &[&str]| {
        json(&[&["replay", &file, "--map", &place.pipeline, "--out", &place.path(name)], more].concat())
    };
    let maps = |name: &str| std::fs::read(place.path(&format!("{name}/10.000MHz/map.fits"))).unwrap();
    let once = replay("once", &[]);
    let [first, again] = ["first", "again"].map(|name| replay(name, &["--state", &state]));
    assert!(maps("once") == maps("first") && maps("once") == maps("again"));
    for later in [&first, &again] {
        assert_eq!(later["ledger"], once["ledger"]);
        assert_eq!(later["bursts"], once["bursts"]);
    }
    // What is subtracted is what is in the sums: the visibilities in the burst are not.
    let report = json(&["retract", &file, "--state", &state, "--map", &place.pipeline, "--from-s", "0"]);
    assert_eq!(report["refused"], 0);
    assert_eq!(report["accumulated"], once["ledger"]["accumulated"]);
}

/// A downlink in two files, divided after a part of its packets.
fn divided(place: &Workplace, file: &str, part: f64) -> [String; 2] {
    let bytes = std::fs::read(file).unwrap();
    let mut starts = vec![0];
    while let Some(&at) = starts.last().filter(|at| **at < bytes.len()) {
        starts.push(at + 7 + usize::from(bytes[at + 4]) * 256 + usize::from(bytes[at + 5]));
    }
    let (first, second) = bytes.split_at(starts[(part * starts.len() as f64) as usize]);
    [place.file("first.ccsds", first), place.file("second.ccsds", second)]
}

/// Correlation of the maps of two outputs.
fn correlation(outs: [&str; 2]) -> f64 {
    let [a, b] = outs.map(|out| {
        let path = format!("{out}/10.000MHz/map.fits");
        let map = read_whole_map(Path::new(&path), &ReadOptions::default()).unwrap().into_values();
        let mean = map.iter().sum::<f64>() / map.len() as f64;
        map.into_iter().map(|value| value - mean).collect::<Vec<f64>>()
    });
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    product(&a, &b) / (product(&a, &a) * product(&b, &b)).sqrt()
}

#[test]
fn two_sessions_of_a_pass_find_its_burst_once_and_give_its_packets_back() {
    let place = Workplace::new(MISSION);
    let (downlink, quiet) = (place.simulate("quiet.ccsds", &[]), place.path("quiet"));
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--out", &quiet]);
    let mut alike = Vec::new();
    for choice in ["calibration.bursts=peel", "calibration.bursts=keep"] {
        let place = Workplace::new(MISSION);
        let file = place.simulate("bursts.ccsds", &["--set", BURST]);
        let state = place.path("state");
        let out = place.path("second");
        let common = ["--state", &state, "--map", &place.pipeline, "--set", choice];
        // The burst lies in the last pass, whose packets are those of its pairs, one after the other.
        let files = divided(&place, &file, 0.8);
        for (file, name) in files.iter().zip(["first", "second"]) {
            let summary = json(&[&["replay", file, "--out", &place.path(name)], &common[..]].concat());
            assert_eq!(summary["bursts"]["found"], 1, "{choice} {name}");
        }
        alike.push(correlation([&quiet, &out]));
        for file in &files {
            let report = json(&[&["retract", file, "--from-s", "0"], &common[..]].concat());
            assert_eq!(report["refused"], 0, "{choice} {report}");
        }
    }
    // A loss of 0.01 in rho, as above, and one of 0.1.
    assert!(alike[0] > 0.98 && alike[1] < 0.9, "{alike:?}");
}

/// Two bursts while the Sun is in sight; at 12 MHz they are 1.44 times fainter and shorter, and come earlier.
const BURSTS: &str = "sky.moving=[{ direction = 'sun', starts_s = [37_300.0, 38_000.0], peak_jy = 1e8, spectral_index = -2.0 }]";

/// The rows of a table (CSV); NaN for text.
fn table(path: &str) -> Vec<Vec<f64>> {
    let text = std::fs::read_to_string(path).unwrap();
    let row = |line: &str| line.split(',').map(|field| field.parse().unwrap_or(f64::NAN)).collect();
    text.lines().skip(1).map(row).collect()
}

#[test]
fn light_curves_are_those_of_the_truth_within_their_errors() {
    // Integrations of some seconds, shorter than the bursts.
    let mission = MISSION.replace("channels_hz = [10.0e6]", "channels_hz = [10.0e6, 12.0e6]");
    let mission = mission.replace("every_nth_window = 2", "every_nth_window = 4");
    let arcs = "[100.0, 250.0, 500.0, 900.0, 1500.0, 2300.0, 3300.0]";
    let place = Workplace::new(&mission.replace("[15.0, 32.0, 52.0, 80.0, 120.0, 170.0, 240.0]", arcs));
    let file = place.simulate("bursts.ccsds", &["--set", BURSTS]);
    let out = place.path("light-curves");
    // An earlier command had three events.
    std::fs::create_dir(&out).unwrap();
    std::fs::write(format!("{out}/summary.json"), r#"{"events": [{}, {}, {}]}"#).unwrap();
    std::fs::write(format!("{out}/event-0003.csv"), "old").unwrap();
    let report = json(&["bursts", &file, "--out", &out]);
    assert!(!std::fs::exists(format!("{out}/event-0003.csv")).unwrap());
    let found: Vec<usize> =
        report["events"].as_array().unwrap().iter().map(|e| e["bursts"].as_array().unwrap().len()).collect();
    assert_eq!(found, [2, 2], "{report}");
    // Of the truth: channel, start, peak, decay and flux density at the peak of each burst.
    let truth = table(&format!("{file}.moving.csv"));
    // Integral of a linear rise and an exponential decay, until a time.
    let until = |burst: &[f64], t_s: f64| {
        let [start_s, peak_s, decay_s, peak_jy] = [burst[3], burst[4], burst[5], burst[6]];
        let (risen, fallen) = ((t_s - start_s).clamp(0.0, peak_s - start_s), (t_s - peak_s).max(0.0));
        peak_jy * (0.5 * risen * risen / (peak_s - start_s) + decay_s * (1.0 - (-fallen / decay_s).exp()))
    };
    let mut errors = Vec::new();
    for number in 1..=2 {
        let path = format!("{out}/event-{number:04}");
        for value in table(&format!("{path}.csv")) {
            let [channel, from_s, until_s, flux_jy, error_jy] = [0, 3, 4, 5, 6].map(|column| value[column]);
            let of_channel = truth.iter().filter(|burst| burst[1] == channel);
            let total = of_channel.map(|burst| until(burst, until_s) - until(burst, from_s)).sum::<f64>();
            let true_jy = total / (until_s - from_s);
            if true_jy > 1e6 {
                errors.push((flux_jy - true_jy).abs() / error_jy);
            }
        }
        assert!(std::fs::read(format!("{path}.png")).unwrap().starts_with(b"\x89PNG"));
    }
    let share =
        |sigma: f64| errors.iter().filter(|error| **error < sigma).count() as f64 / errors.len() as f64;
    let [one, two] = [1.0, 1.96].map(share);
    // Decays of 11.5 and 9.7 s from 1e8 and 6.9e7 Jy to 1e6 Jy: 53 and 41 s in steps of 3 s. As if half of them were independent, of 0.68 and
    // 0.95 three standard deviations are 0.23 and 0.11; errors of half or twice the scatter would have 0.38 and 0.67, or 0.95 and 1.
    assert!(errors.len() > 50 && (0.45..0.91).contains(&one) && two > 0.84, "{one} {two}: {errors:?}");
}

#[test]
fn bursts_are_not_looked_for_unless_asked() {
    let place = Workplace::new(MISSION);
    let file = place.simulate("bursts.ccsds", &["--set", BURST]);
    let replay = |choice: &str| {
        let (set, out) = (format!("calibration.bursts={choice}"), place.path(choice));
        let summary = json(&["replay", &file, "--map", &place.pipeline, "--out", &out, "--set", &set]);
        let map = std::fs::read(place.path(&format!("{choice}/10.000MHz/map.fits"))).unwrap();
        // The header names the settings; the pixels fill the last block.
        (summary, map[map.len() - 2880..].to_vec())
    };
    let [(off, map), (keep, kept)] = ["off", "keep"].map(replay);
    assert!(map == kept && off["ledger"] == keep["ledger"]);
    assert_eq!((&off["bursts"], &keep["bursts"]["found"]), (&Value::Null, &1.into()));
}

#[test]
fn an_alert_comes_while_the_pass_is_open() {
    let place = Workplace::new(MISSION);
    for (name, sets, alerts) in [("burst", &["--set", BURST][..], 1), ("quiet", &[], 0)] {
        let file = place.simulate(&format!("{name}.ccsds"), sets);
        let packets = packets_of(&std::fs::read(&file).unwrap());
        // The last report closes the last pass, in which the burst lies.
        let last = pass_ends(&packets).iter().rposition(|ends| *ends).unwrap();
        let [events, out] = ["jsonl", "out"].map(|end| place.path(&format!("{name}.{end}")));
        let listen = ["replay", "--listen", "tcp://127.0.0.1:0", "--connections", "1", "--events", &events];
        let mut ground = start(&[&listen[..], &["--map", &place.pipeline, "--out", &out]].concat());
        let url = listening(&mut ground);
        let told = |event: &str| -> Vec<Value> {
            let text = std::fs::read_to_string(&events).unwrap();
            let lines = text.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
            lines.filter(|line| line["event"] == event).map(|line| line["what"].clone()).collect()
        };
        let mut stream = std::net::TcpStream::connect(url.strip_prefix("tcp://").unwrap()).unwrap();
        stream.write_all(&packets[..last].concat()).unwrap();
        if alerts > 0 {
            wait_until("the alert", || !told("burst-alert").is_empty());
            assert!(told("burst").is_empty());
        }
        stream.write_all(&packets[last..].concat()).unwrap();
        drop(stream);
        assert!(end(&mut ground).0.success());
        let (found, first) = (told("burst"), told("burst-alert"));
        assert_eq!((found.len(), first.len()), (alerts, alerts), "{found:?} {first:?}");
        for (burst, alert) in found.iter().zip(&first) {
            let number = |value: &Value, key: &str| value[key].as_f64().unwrap();
            let peak_s = number(alert, "peak_s");
            assert!(number(burst, "from_s") < peak_s && peak_s < number(burst, "until_s"), "{burst} {alert}");
            assert_eq!(alert["is_provisional"], true);
        }
    }
}

#[test]
fn what_is_not_simulated_is_refused() {
    let place = Workplace::new(MISSION);
    for (key, value) in [
        ("spacecraft.fidelity", "samples"),
        ("spacecraft.moon_reflection", "0.07"),
        ("spacecraft.ninth.on", "true"),
        ("instrument.pattern.constant_rms", "0.1"),
    ] {
        let set = format!("{key}={value}");
        let text = fail(&["check", &place.pipeline, "--set", BURST, "--set", &set]);
        assert!(text.contains("with sky.moving, which is not simulated otherwise"), "{key}: {text}");
    }
}
