//! The image of the sky in the Moon, and its correction.

use std::path::Path;

use lunarray::sky::fits::{ReadOptions, read_whole_map};

use super::common::workplace::{SMALL, Workplace, fail, json, succeed};

fn map(out: &str) -> Vec<f64> {
    let path = format!("{out}/10.000MHz/map.fits");
    read_whole_map(Path::new(&path), &ReadOptions::default()).unwrap().into_values()
}

#[test]
fn the_correction_divides_visibilities_and_leaves_the_prior() {
    let place = Workplace::new(SMALL);
    let downlink = place.simulate("downlink.ccsds", &[]);
    let made = |name: &str, sets: &[&str]| {
        let out = place.path(name);
        let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", *set]).collect();
        let args = ["replay", &downlink, "--map", &place.pipeline, "--out", &out];
        succeed(&[&args, &sets[..]].concat());
        map(&out)
    };
    let (plain, prior) = (made("plain", &[]), made("prior", &["map.prior_k=3e5"]));
    let corrected = made("corrected", &["map.moon_reflection=0.25"]);
    let both = made("both", &["map.moon_reflection=0.25", "map.prior_k=3e5"]);
    let largest = plain.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
    for k in 0..plain.len() {
        // T = A V + (I - A B) T_p: visibilities are divided by 1.25, and the prior's part stays. Maps are in f32.
        assert!((corrected[k] - plain[k] / 1.25).abs() < 1e-6 * largest);
        assert!((both[k] - (plain[k] / 1.25 + prior[k] - plain[k])).abs() < 1e-6 * largest, "{k}");
    }
}

#[test]
fn what_the_moon_reflects_is_added_and_mostly_taken_back() {
    let place = Workplace::new(SMALL);
    let mean = |name: &str, sets: &[&str]| {
        let out = place.path(name);
        let quiet = ["--set", "spacecraft.thermal_noise=false"];
        let sets: Vec<&str> = sets.iter().flat_map(|set| ["--set", *set]).chain(quiet).collect();
        let run = json(&[&["run", &place.pipeline, "--out", &out], &sets[..]].concat());
        run["channels"][0]["mean_k"].as_f64().unwrap()
    };
    let reflects = "spacecraft.moon_reflection=0.07";
    for model in ["spacecraft.model=direct", "spacecraft.model=harmonic"] {
        let none = mean("none", &[model]);
        let added = mean("added", &[model, reflects]);
        let corrected = mean("corrected", &[model, reflects, "map.moon_reflection=0.07"]);
        // At 3 MHz baselines of 1 to 16 wavelengths measure the mean. The sky above the horizontal is reflected, that between it
        // and the limb (1.522 of the sphere's halves are seen) is not.
        assert!(added > 1.02 * none && added < 1.08 * none, "{model}: {added} {none}");
        assert!((corrected / none - 1.0).abs() < 0.04 && corrected < none, "{model}: {corrected} {none}");
    }
}

#[test]
fn a_round_moon_shows_the_sky_smaller() {
    let place = Workplace::new(SMALL);
    let mean = |name: &str, sets: &[&str]| {
        let out = place.path(name);
        let quiet = ["spacecraft.thermal_noise=false", "spacecraft.model=direct", "sky.nside=32"];
        let sets: Vec<&str> = sets.iter().chain(&quiet).flat_map(|set| ["--set", *set]).collect();
        let run = json(&[&["run", &place.pipeline, "--out", &out], &sets[..]].concat());
        run["channels"][0]["mean_k"].as_f64().unwrap()
    };
    let (reflects, sphere) = ("spacecraft.moon_reflection=0.07", "spacecraft.moon_mirror=sphere");
    let none = mean("none", &[]);
    let flat = mean("flat", &[reflects]);
    let round = mean("round", &[reflects, sphere]);
    // The image fills the Moon's disc, 3.0 sr, instead of 2 pi below the horizontal: baselines of a wavelength and more have less of
    // it. Its power is held to the disc's in `receiver`.
    assert!(round != none && (round - none).abs() < 0.5 * (flat - none), "{none} {round} {flat}");
    // The image of an antenna that leans away from the Moon is another antenna's.
    let (direct, leans) = ("spacecraft.model=direct", "instrument.tilt_radial_deg.constant_rms=3");
    let check = ["check", &place.pipeline, "--set", direct, "--set", leans];
    let refused = fail(&[&check[..], &["--set", reflects]].concat());
    assert!(refused.contains("expected 0 with instrument.tilt_radial_deg"), "{refused}");
    json(&check);
    // Without reflection there is nothing to mirror.
    assert!((mean("dark", &[sphere]) - none).abs() < 1e-9 * none);
    for model in ["auto", "harmonic", "general"] {
        let model = format!("spacecraft.model={model}");
        let refused = fail(&["check", &place.pipeline, "--set", &model, "--set", sphere]);
        assert!(
            refused.contains(
                "spacecraft.moon_mirror = \"sphere\": expected \"flat\", or spacecraft.model = \"direct\""
            ),
            "{refused}"
        );
    }
}
