//! The quiet Sun and Jupiter, which are solved for beside the map, through the whole chain.

use serde_json::Value;

use super::common::workplace::{Workplace, fail, json, succeed};

/// 1.3 years at 10 MHz, thinned. A map of degrees up to 20 of a sky up to 36, seen by baselines up to 15 wavelengths.
const MISSION: &str = r#"
name = "movers"
seed = 5
[sky]
nside = 16
[spacecraft]
channels_hz = [10.0e6]
duration_s = 4.1e7
every_nth_window = 25
baseline_wavelengths_max = 15.0
model = "harmonic"
[map]
nside = 8
engine = "harmonic"
[products]
pictures = false
"#;

/// Far brighter than when they are quiet, so that their arcs show in a map of few data: 1e5 Jy are 0.7 % of the sky's power of some 5e6 K sr.
const SOURCES: &str =
    "sky.moving=[{ direction = 'sun', steady_jy = 1e5 }, { direction = 'jupiter', steady_jy = 3e4 }]";

const SOLVED: [&str; 2] = ["--set", "map.movers=['sun', 'jupiter']"];

/// rho_l from l = 1 to twice the nside.
fn rho(summary: &Value) -> Vec<f64> {
    let rho = summary["channels"][0]["rho"].as_array().unwrap();
    (1..=16).map(|l| rho[l].as_f64().unwrap()).collect()
}

fn largest_loss(of: &Value, quiet: &Value) -> f64 {
    rho(of).iter().zip(rho(quiet)).map(|(found, quiet)| quiet - found).fold(0.0, f64::max)
}

#[test]
fn a_map_is_as_good_as_without_the_sun_and_jupiter() {
    let place = Workplace::new(MISSION);
    let run = |name: &str, more: &[&str]| {
        json(&[&["run", &place.pipeline, "--out", &place.path(name)], more].concat())
    };
    let quiet = run("quiet", &[]);
    let kept = run("kept", &["--set", SOURCES]);
    let solved = run("solved", &[&["--set", SOURCES], &SOLVED[..]].concat());
    let losses = [&kept, &solved].map(|summary| largest_loss(summary, &quiet));
    // What a map that keeps the arcs has lost, and what one without them may lose (the aim).
    assert!(losses[0] > 0.1 && losses[1] < 0.01, "{losses:?}");
    assert_eq!(kept["channels"][0]["movers"], Value::Null);

    let movers = &solved["channels"][0]["movers"];
    assert_eq!(
        (movers["month_s"].as_f64(), movers["visibilities_beyond"].as_u64()),
        (Some(2_592_000.0), Some(0))
    );
    let fluxes = movers["fluxes"].as_array().unwrap();
    // 474.5 days are 16 months, the last of half its length.
    assert_eq!(fluxes.len(), 32);
    let mut squares = 0.0;
    for (k, flux) in fluxes.iter().enumerate() {
        let number = |key: &str| flux[key].as_f64().unwrap();
        let truth = if flux["mover"] == "sun" { 1e5 } else { 3e4 };
        assert_eq!((number("month_start_s"), k % 2 == 0), (2_592_000.0 * (k / 2) as f64, truth == 1e5));
        squares += ((number("flux_jy") - truth) / number("sigma_jy")).powi(2) / 32.0;
        assert!((number("flux_jy") - truth).abs() < 0.25 * truth, "{flux}");
    }
    // 1 for Gaussian errors, and more by the sky's degrees that the map has not, which errors do not have.
    assert!((0.3..9.0).contains(&squares), "{squares}");
    let table = std::fs::read_to_string(place.path("solved/10.000MHz/movers.csv")).unwrap();
    assert_eq!(table.lines().count(), 33);
    assert!(
        table.starts_with("frequency_hz,mover,month_start_s,flux_jy,sigma_jy\n10000000,sun,0,"),
        "{table}"
    );
}

#[test]
fn bodies_are_refused_where_they_are_not_solved_for() {
    let place = Workplace::new(&MISSION.replace("every_nth_window = 25", "every_nth_window = 2500"));
    let file = place.simulate("downlink.ccsds", &[]);
    let replay = |more: &[&str]| {
        let out = place.path("out");
        fail(&[&["replay", &file, "--map", &place.pipeline, "--out", &out], &SOLVED[..], more].concat())
    };
    let state = place.path("state");
    let said = replay(&["--state", &state]);
    assert!(said.contains("map.movers with a saved state; expected none, or"), "{said}");
    for other in ["map.refine.passes_max=3", "map.engine=pixel"] {
        let said = replay(&["--set", other]);
        assert!(said.contains("map.movers"), "{other}: {said}");
    }
    let twice = ["--set", "map.movers=['sun', 'sun']"];
    let said = replay(&twice);
    assert!(said.contains("map.movers[1] = Sun: expected every body once"), "{said}");
    let all = ["--set", "spacecraft.every_nth_window=25"];
    succeed(&[&["check", &place.pipeline, "--set", "map.movers=['jupiter']"][..], &all].concat());
}
