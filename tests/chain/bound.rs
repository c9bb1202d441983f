//! `lunarray bound`: against closed forms.

use crate::common;

use common::workplace::{Workplace, fail, json, succeed};
use lunarray::array::{Array, ArrayConfig};
use lunarray::sky::fits::{WriteOptions, write_map};
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::vector::dot;

const THREE: &str = r#"
name = "three"
seed = 1
[array]
satellites = 3
arcs_m = [400, 900]
[spacecraft]
channels_hz = [3e6]
duration_s = 2e4
[calibrate]
sky_model = "direct"
amplitude_sigma = 0.02
phase_sigma_deg = 1e4
"#;

const BEACON: &str = "calibrate.beacon_k_sr=1e6";

/// A sky of one source that the Moon never hides: towards the normal of the orbit.
fn one_source(place: &Workplace) -> String {
    let normal_hat = Array::new(&ArrayConfig::default()).unwrap().normal_hat(0, 0.0);
    let directions = SkyMap::new(Frame::Ecliptic, vec![0.0; 12 * 16 * 16]).unwrap().directions_ecliptic();
    let near = |k: &usize| dot(directions[*k], normal_hat);
    let brightest = (0..directions.len()).max_by(|a, b| near(a).total_cmp(&near(b))).unwrap();
    let values = (0..directions.len()).map(|k| if k == brightest { 1e7 } else { 0.0 }).collect();
    let path = place.path("source.fits");
    let map = SkyMap::new(Frame::Ecliptic, values).unwrap();
    write_map(path.as_ref(), &map, &WriteOptions::default()).unwrap();
    path
}

#[test]
fn bounds_of_three_daughters_and_one_source_are_those_of_closed_forms() {
    let place = Workplace::new(THREE);
    let source = one_source(&place);
    let set =
        ["--set", "spacecraft.every_nth_integration=1", "--set", "spacecraft.baseline_wavelengths_max=0"];
    let args = [&["bound", place.pipeline.as_str(), "--model", &source], &set[..]].concat();
    let found = json(&args);
    let span_s: Vec<f64> = found["span_s"].as_array().unwrap().iter().map(|s| s.as_f64().unwrap()).collect();
    // Each pair sees the source with the power of either daughter: its information on the logarithm of a gain's amplitude, and on a phase, is
    // 2 width time. The matrix of amplitudes is (J + p) I + J 1 1' for three daughters with priors p, that of phases 3 J I - J 1 1'.
    let information = 2.0 * 8e3 * (span_s[1] - span_s[0]);
    let own = information + 0.02_f64.powi(-2);
    let amplitude = ((1.0 - information / (own + 3.0 * information)) / own).sqrt();
    let phase_deg = (2.0 / (3.0 * information)).sqrt().to_degrees();
    for (n, daughter) in found["daughters"].as_array().unwrap().iter().enumerate() {
        let gain = &daughter["gains"][0];
        let number = |name: &str| gain[name].as_f64().unwrap();
        // Integrations leave out less than a thousandth of the pass.
        let close = |found: f64, expected: f64| (found / expected - 1.0).abs() < 1e-3;
        assert!(close(number("amplitude_sigma"), amplitude), "{gain} {amplitude}");
        let sigma_deg = number("phase_sigma_deg");
        assert!(if n == 0 { sigma_deg == 0.0 } else { close(sigma_deg, phase_deg) }, "{gain} {phase_deg}");
    }
    let table = succeed(&args);
    assert!(table.starts_with("Pass 0, ") && table.lines().count() == 2 + 3, "{table}");
}

#[test]
fn bounds_without_a_sky_or_a_pass_say_what_is_missing() {
    let place = Workplace::new(THREE);
    let source = one_source(&place);
    let pipeline = place.pipeline.as_str();
    for (args, said) in [
        (&["bound", pipeline][..], "--model = (none): expected a HEALPix map of the sky for each channel"),
        (&["bound", pipeline, "--model", &source, "--pass", "99"], "--pass = 99: expected 0 to "),
        (&["bound", pipeline, "--model", &source, &source], "--model"),
        (
            &["bound", pipeline, "--model", &source, "--set", "calibrate.mode=\"beacon\"", "--set", BEACON],
            "calibrate.mode = beacon: expected \"sky\"",
        ),
    ] {
        let found = fail(args);
        assert!(found.contains(said), "{args:?}: {found}");
    }
}
