//! Maps of several channels together, from a state to files, against the sky that was put in.

use serde_json::Value;

use crate::common::workplace::{Workplace, fail, json, succeed};

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

/// Mean rho_l of l = 6 to 10, which 10 MHz alone sees least.
fn rho(map: &str, sky: &str) -> f64 {
    let compared = json(&["compare", map, sky]);
    let rho: Vec<f64> = compared["rho"].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect();
    rho[6..=10].iter().sum::<f64>() / 5.0
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
        let truth = json(&["compare", &sky, &sky])["cl_map"][0].as_f64().unwrap();
        let truth = (truth / (4.0 * std::f64::consts::PI)).sqrt();
        let [mean, sigma] = ["mean_k", "mean_sigma_k"].map(|key| map[key].as_f64().unwrap());
        assert!((mean - truth).abs() < 5.0 * sigma && sigma < 0.1 * truth, "{name}: {mean} {sigma} {truth}");
    }
    assert!(std::fs::metadata(format!("{joint}/spectra.fits")).unwrap().len() > 0);
    let said = fail(&["joint", &state, "--at", "12MHz", "--out", &place.path("beyond")]);
    assert!(said.contains("between 5.000 and 10.000 MHz"), "{said}");
    // An iteration that may not go on says so, where people and where programs look.
    let (short, cut) = (place.path("cut"), ["--set", "map.iterations_max=1", "--count", "2", "--out"]);
    let said = succeed(&[&["joint", &state], &cut[..], &[&short]].concat());
    assert!(said.contains("not converged"), "{said}");
    let header = std::fs::read(format!("{short}/10.000MHz/map.fits")).unwrap();
    let header = String::from_utf8_lossy(&header[..8640]).into_owned();
    assert!(header.contains("CONVERGD=                    F"), "{header}");
}
