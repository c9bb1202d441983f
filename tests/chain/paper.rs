//! The paper's map, at a quarter of its resolution and a twentieth of its orbits, through the command and the harmonic
//! engine; the sky is the published one, and so is what to expect.

use crate::common;

use std::path::Path;

use assert_cmd::Command;
use lunarray::sky::fits::{ReadOptions, read_whole_map};
use serde_json::Value;

fn lunarray(args: &[&str]) -> Vec<u8> {
    let output = Command::cargo_bin("lunarray").unwrap().args(args).output().unwrap();
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    output.stdout
}

/// Mean over the latitudes beyond 75 degrees of a map over that of the input.
fn poles(folder: &Path) -> f64 {
    let [map, input] = ["map.fits", "input.fits"]
        .map(|name| read_whole_map(&folder.join(name), &ReadOptions::default()).unwrap());
    let directions = map.directions_ecliptic();
    let mean = |values: &[f64]| {
        let polar = directions.iter().zip(values).filter(|(n, _)| n[2].abs() > 75_f64.to_radians().sin());
        polar.map(|(_, t)| *t).sum::<f64>()
    };
    mean(map.values()) / mean(input.values())
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn the_published_sky_comes_back_as_in_the_paper() {
    let sky = common::shared("sky/ulsa_10mhz_galactic_nside64.fits");
    let folder = tempfile::tempdir().unwrap();
    let run = |pipeline: &str, sky: &Path, out: &str| {
        let out = folder.path().join(out);
        let printed = lunarray(&[
            "run",
            pipeline,
            "--out",
            out.to_str().unwrap(),
            "--set",
            &format!("sky.file={:?}", sky.to_str().unwrap()),
            "--set",
            "sky.l_max=0",
            "--set",
            "spacecraft.every_nth_window=20",
            "--set",
            "spacecraft.thermal_noise=false",
            "--set",
            // Somewhat beyond what a map of nside 32 takes, 62.6.
            "spacecraft.baseline_wavelengths_max=70",
            "--set",
            "map.nside=32",
            "--json",
        ]);
        (out, serde_json::from_slice::<Value>(&printed).unwrap())
    };
    let (at_10, summary) = run("pipelines/paper-10mhz.toml", &sky, "10");
    let channel = &summary["channels"][0];
    let rho: Vec<f64> = channel["rho"].as_array().unwrap().iter().map(|r| r.as_f64().unwrap()).collect();
    // The paper finds rho near 1 above l = 18, to the end of what the map resolves: l_max is 80 here, and the fringes
    // beyond it that are in the data are not in the map.
    for (l, rho) in rho.iter().enumerate().take(61).skip(20) {
        assert!(*rho >= 0.98, "10 MHz, l = {l}: {rho}");
    }
    // It drops below l = 18, where no baseline is short enough, and with it the poles are dark.
    assert!(rho[4..=12].iter().all(|rho| *rho < 0.95), "{:?}", &rho[..20]);
    assert!(poles(&at_10.join("10.000MHz")) < 0.7);
    // The run would have failed if its ledger did not close; nothing is refused. Daughters that trail by up to 3.6 km see
    // the Earth for up to 2.3 s into a window, which costs its first integration.
    let flagged: Vec<_> = summary["ledger"]["flagged"].as_object().unwrap().keys().collect();
    assert_eq!(flagged, ["Earth in sight of a daughter", "baseline beyond the map's limit"]);

    // The ground alone makes the same map from the same bytes.
    let again = folder.path().join("again");
    lunarray(&[
        "replay",
        at_10.join("downlink.ccsds").to_str().unwrap(),
        "--map",
        "pipelines/paper-10mhz.toml",
        "--set",
        "map.nside=32",
        "--out",
        again.to_str().unwrap(),
    ]);
    for name in ["map.fits", "noise.fits"] {
        let [one, other] =
            [&at_10, &again].map(|out| std::fs::read(out.join("10.000MHz").join(name)).unwrap());
        assert!(one == other, "{name}");
    }

    // At 3 MHz the shortest baseline is three times as short in wavelengths.
    let sky = common::shared("sky/ulsa_3mhz_galactic_nside64.fits");
    let (at_3, summary) = run("pipelines/paper-3mhz.toml", &sky, "3");
    let rho = summary["channels"][0]["rho"].as_array().unwrap();
    for (l, rho) in rho.iter().enumerate().take(61).skip(2) {
        assert!(rho.as_f64().unwrap() >= 0.98, "3 MHz, l = {l}: {rho}");
    }
    let poles = poles(&at_3.join("3.000MHz"));
    assert!((poles - 1.0).abs() < 0.02, "{poles}");
}
