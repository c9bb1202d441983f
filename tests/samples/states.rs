//! A ground segment with a state, for samples of two bits: the same maps and auto-correlations as without a state.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use crate::common::downlink::packets_of;
use crate::common::workplace::{Workplace, fail, json, succeed};

const PIPELINE: &str = r#"
name = "two bits"
seed = 3
[sky]
nside = 4
[daughters]
bits = 2
[spacecraft]
fidelity = "samples"
channels_hz = [1.0e6, 2.0e6]
duration_s = 3.0e4
window_s_max = 4.0
flag_earth = false # the last daughters see the Earth for 64 s of a window
every_nth_window = 1
every_nth_integration = 1
baseline_wavelengths_max = 24.0
auto_integration_s = 0.5
[downlink]
packet_bytes_max = 512
[calibration]
quantiser_bits = 2
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-2
"#;

/// The tables, statistics and pictures of auto-correlations, and all maps, of a session.
fn products(place: &Workplace, out: &str) -> Vec<Vec<u8>> {
    let file = |name: &str| std::fs::read(place.path(&format!("{out}/{name}"))).unwrap();
    let mut found: Vec<Vec<u8>> = ["autos.csv", "autos.json", "autos.png"].map(file).to_vec();
    let maps = crate::common::workplace::maps(&place.path(out));
    found.extend(maps.into_iter().filter(|(path, _)| path.ends_with("map.fits")).map(|(_, bytes)| bytes));
    found
}

fn plain(place: &Workplace, out: &str, file: &str, sets: &[&str]) -> Vec<Vec<u8>> {
    let mut args = vec!["replay", file, "--map", &place.pipeline, "--out"];
    let folder = place.path(out);
    args.push(&folder);
    args.extend(sets.iter().flat_map(|set| ["--set", set]));
    succeed(&args);
    products(place, out)
}

/// Arguments of a session that continues a state.
fn session(place: &Workplace, state: &str, files: &[&str]) -> Vec<String> {
    let (out, state) = (place.path(&format!("{state}.out")), place.path(state));
    let fixed = ["--map", &place.pipeline, "--out", &out, "--state", &state, "--checkpoint-every", "300"];
    [&["replay"], files, &fixed].concat().into_iter().map(str::to_owned).collect()
}

fn kept(place: &Workplace, state: &str, files: &[&str]) -> Vec<Vec<u8>> {
    let args = session(place, state, files);
    succeed(&args.iter().map(String::as_str).collect::<Vec<_>>());
    products(place, &format!("{state}.out"))
}

/// Number of lines of a table of auto-correlations.
fn lines(products: &[Vec<u8>]) -> usize {
    products[0].iter().filter(|octet| **octet == b'\n').count()
}

#[test]
fn a_state_has_the_maps_and_auto_correlations_of_a_plain_replay() {
    let place = Workplace::new(PIPELINE);
    let file = place.simulate("all.ccsds", &[]);
    let whole = plain(&place, "plain", &file, &[]);
    assert!(
        lines(&whole) > 1 + 2 * 8 * 16,
        "two windows of eight half seconds, in two channels, of eight daughters"
    );
    assert!(kept(&place, "state", &[&file]) == whole);
    // The correction matters: without it maps and auto-correlations differ.
    let uncorrected = plain(&place, "uncorrected", &file, &["calibration.quantiser_bits=0"]);
    assert!(whole.iter().zip(&uncorrected).all(|(one, other)| one != other));
    // A state corrected for two bits cannot continue with other numbers of bits.
    for bits in ["0", "1"] {
        let mut args = session(&place, "state", &[&file]);
        args.extend(["--set".to_owned(), format!("calibration.quantiser_bits={bits}")]);
        let said = fail(&args.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(said.contains("calibration.quantiser_bits = 2; expected ") && said.contains(bits), "{said}");
    }
}

#[test]
fn auto_correlations_are_kept_once_whatever_happens() {
    let place = Workplace::new(PIPELINE);
    let file = place.simulate("all.ccsds", &[]);
    let since = Instant::now();
    let whole = kept(&place, "whole", &[&file]);
    let length = since.elapsed();
    let ledger = |out: &str| -> serde_json::Value {
        let text = std::fs::read(place.path(&format!("{out}.out/summary.json"))).unwrap();
        serde_json::from_slice::<serde_json::Value>(&text).unwrap()["ledger"].clone()
    };

    // Twice, out of order, in two sessions.
    let bad = place.path("bad.ccsds");
    succeed(&["corrupt", &file, "--out", &bad, "--duplicate", "0.3", "--reorder", "0.3", "--seed", "5"]);
    assert!(kept(&place, "disordered", &[&bad]) == whole);
    assert!(kept(&place, "disordered", &[&file]) == whole);
    assert_eq!(ledger("disordered"), ledger("whole"));

    // Killed at moments spread over a session, and resumed.
    for k in 0..4 {
        let args = session(&place, "killed", &[&file]);
        let mut command = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let mut child = command.args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_secs_f64(
            length.as_secs_f64() * (0.1 + 0.618_034 * f64::from(k)).fract(),
        ));
        let _ = child.kill();
        child.wait().unwrap();
    }
    assert!(kept(&place, "killed", &[&file]) == whole);
    assert_eq!(ledger("killed"), ledger("whole"));

    // Two ground segments that each receive every second packet of visibilities, merged.
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let of_visibilities = |packet: &[u8]| packet[1] == 3;
    let heard = |station: u8| -> Vec<u8> {
        let is_heard = |packet: &&Vec<u8>| !of_visibilities(packet) || packet[3] % 2 == station;
        packets.iter().filter(is_heard).flatten().copied().collect()
    };
    let [even, odd] = [0, 1].map(|station| place.file(&format!("{station}.ccsds"), &heard(station)));
    let half = kept(&place, "even", &[&even]);
    assert!(lines(&half) > 1 && lines(&half) < lines(&whole));
    kept(&place, "odd", &[&odd]);
    let merged = place.path("merged");
    succeed(&["merge", &place.path("even"), &place.path("odd"), "--map", &place.pipeline, "--out", &merged]);
    assert!(kept(&place, "merged", &[&file]) == whole);
    assert_eq!(ledger("merged"), ledger("whole"));

    // Retracted, to exactly the auto-correlations of the ground segment that never received them; then replayed again.
    let only_odd: Vec<u8> = packets
        .iter()
        .filter(|packet| of_visibilities(packet) && packet[3] % 2 == 1)
        .flatten()
        .copied()
        .collect();
    let only_odd = place.file("only-odd.ccsds", &only_odd);
    let report = json(&["retract", &only_odd, "--state", &merged, "--map", &place.pipeline]);
    assert!(report["refused"] == 0 && report["packets"].as_u64().unwrap() > 0, "{report}");
    assert!(kept(&place, "merged", &[&even]) == half);
    assert_eq!(ledger("merged"), ledger("even"));
    assert!(kept(&place, "merged", &[&file]) == whole);
}
