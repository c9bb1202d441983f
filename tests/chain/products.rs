//! What a run writes about its maps: headers, post-processing and curves, against healpy.

use crate::common;

use std::path::{Path, PathBuf};
use std::process::Command;

use assert_cmd::Command as Assert;
use lunarray::sky::fits::{ReadOptions, WriteOptions, read_map_file, write_map};
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::{Frame, SkyMap};
use serde_json::Value;

const NSIDE: usize = 8;

/// A sky four times finer than the maps, and what a run of it leaves.
struct Ran {
    out: PathBuf,
    channel: Value,
    printed: String,
}

fn sky(folder: &Path) -> PathBuf {
    let values = generate(&GeneratedSky::default(), 3e6, 4 * NSIDE, 5).unwrap();
    let path = folder.join("sky.fits");
    write_map(&path, &SkyMap::new(Frame::Ecliptic, values).unwrap(), &WriteOptions::default()).unwrap();
    path
}

fn run(folder: &Path, name: &str, keys: &[&str]) -> Ran {
    let out = folder.join(name);
    let file = format!("sky.file={:?}", sky(folder).to_str().unwrap());
    let all = [
        file.as_str(),
        "spacecraft.channels_hz=[3e6]",
        "spacecraft.every_nth_window=500",
        "spacecraft.every_nth_integration=16",
        "spacecraft.baseline_wavelengths_max=15.6",
        "map.nside=8",
        "map.epsilon=1e-4",
        "map.snapshot_every_s=0.0",
        "products.pictures=false",
    ];
    let mut command = Assert::cargo_bin("lunarray").unwrap();
    command.args(["run", "pipelines/quicklook.toml", "--out", out.to_str().unwrap()]);
    for key in all.iter().chain(keys) {
        command.args(["--set", key]);
    }
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary = std::fs::read_to_string(out.join("summary.json")).unwrap();
    let summary: Value = serde_json::from_str(&summary).unwrap();
    let printed = String::from_utf8(output.stdout).unwrap();
    Ran { out: out.join("3.000MHz"), channel: summary["channels"][0].clone(), printed }
}

fn healpy(arguments: &[&str]) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/sky_compare.py");
    let output = Command::new(common::python()).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn header(ran: &Ran, file: &str) -> lunarray::sky::fits::Header {
    read_map_file(&ran.out.join(file), &ReadOptions::default()).unwrap().header
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn correlations_are_of_the_sky_at_its_own_resolution() {
    let folder = tempfile::tempdir().unwrap();
    for (engine, l_max) in [("pixel", 23), ("harmonic", 20)] {
        let ran = run(folder.path(), engine, &[&format!("map.engine={engine}")]);
        let path = |file: &str| ran.out.join(file).to_str().unwrap().to_owned();
        let input = folder.path().join("sky.fits").to_str().unwrap().to_owned();
        let degrees = l_max.to_string();
        let expected = healpy(&[&path("map.fits"), &input, &degrees, &path("noise.fits")]);
        for key in ["rho", "snr"] {
            let (found, expected) = (numbers(&ran.channel[key]), numbers(&expected[key]));
            assert_eq!(found.len(), expected.len());
            for (l, (found, expected)) in found.iter().zip(&expected).enumerate() {
                // Maps are written in single precision, 6e-8 of their greatest values: far above degrees of 1e-3 of them.
                assert!(
                    (found / expected - 1.0).abs() < 1e-3,
                    "{engine}, {key}, l = {l}: {found} {expected}"
                );
            }
        }
        // Against the sky averaged over the pixels first, the pixel engine would look better than it is.
        let averaged = healpy(&[&path("map.fits"), &path("input.fits"), &degrees]);
        if engine == "pixel" {
            let (own, averaged) = (numbers(&expected["rho"]), numbers(&averaged["rho"]));
            assert!(own[20] < averaged[20] - 1e-3, "{} {}", own[20], averaged[20]);
        }
    }
}

#[test]
fn headers_and_summaries_say_how_a_map_was_made() {
    let folder = tempfile::tempdir().unwrap();
    let noisy = run(folder.path(), "noisy", &["map.engine=pixel", "map.prior_k=2e6"]);
    let cards = header(&noisy, "map.fits");
    for (key, text) in [
        ("NOISE", "on"),
        ("ENGINE", "pixel"),
        ("ROWS", "average"),
        ("ANTENNA", "isotropic"),
        ("PRIOR", "uniform, 2e6 K"),
        ("TELESCOP", "lunarray"),
        ("TIMESYS", "TAI"),
    ] {
        assert_eq!(cards.text(key), Some(text), "{key}");
    }
    // The mission begins on 2027-01-01; ISO dates are in the order of their letters.
    let [first, last] = ["DATE-BEG", "DATE-END"].map(|key| cards.text(key).unwrap());
    assert!("2027-01-01T00:00:00" < first && first < last && last < "2028-05", "{first} {last}");
    // 2 b_p = 2 wavelength / sqrt(4 pi / N_pix).
    let limit_m = 2.0 * 299_792_458.0 / 3e6 / (4.0 * std::f64::consts::PI / 768.0_f64).sqrt();
    assert!((cards.real("BASEMAX").unwrap() / limit_m - 1.0).abs() < 1e-12);
    assert_eq!((cards.real("BPMAX"), cards.real("EPSILON")), (Some(2.0), Some(1e-4)));
    assert_eq!((cards.get("LMAX"), cards.get("FWHM")), (None, None));
    assert_eq!(noisy.channel["thermal_noise"], true);
    assert!(noisy.printed.contains("with the map's thermal noise"), "{}", noisy.printed);
    assert!(noisy.printed.contains("noise power subtracted"), "{}", noisy.printed);
    assert!(!noisy.printed.contains("mostly noise"), "{}", noisy.printed);
    // A receiver a thousand times louder than the sky.
    let loud = run(folder.path(), "loud", &["map.engine=pixel", "spacecraft.receiver_noise_k_sr=1e10"]);
    assert!(loud.printed.contains("mostly noise"), "{}", loud.printed);

    let keys = ["spacecraft.thermal_noise=false", "map.engine=harmonic", "spacecraft.antenna=dipole-normal"];
    let quiet = run(folder.path(), "quiet", &keys);
    let cards = header(&quiet, "map.fits");
    for (key, text) in
        [("NOISE", "off"), ("ENGINE", "harmonic"), ("ANTENNA", "dipole-normal"), ("PRIOR", "none")]
    {
        assert_eq!(cards.text(key), Some(text), "{key}");
    }
    assert_eq!((cards.real("LMAX"), cards.get("ROWS")), (Some(20.0), None));
    assert_eq!(quiet.channel["thermal_noise"], false);
    assert!(quiet.channel["rho_noise_subtracted"].is_null());
    assert!(quiet.printed.contains("without thermal noise"), "{}", quiet.printed);
}

#[test]
fn a_pixel_map_that_is_iterated_says_whether_it_has_converged() {
    let folder = tempfile::tempdir().unwrap();
    for (matrix, iterations, said) in [
        ("stored", "300", "iterations, residual"),
        ("stored", "1", ": not converged, increase map.iterations_max"),
        ("free", "1", ": not converged, increase map.iterations_max"),
    ] {
        let [matrix, iterations] = [("matrix", matrix), ("iterations_max", iterations)]
            .map(|(key, value)| format!("map.{key}={value}"));
        let keys = ["map.engine=pixel", "map.regulariser={degree=2.0}", &matrix, &iterations];
        let ran = run(folder.path(), &keys[2..].join(""), &keys);
        assert!(ran.printed.contains(said), "{matrix}: {}", ran.printed);
        assert_eq!(ran.printed.contains("not converged"), iterations.ends_with("=1"), "{}", ran.printed);
    }
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn post_processing_is_of_map_noise_input_and_curves() {
    let folder = tempfile::tempdir().unwrap();
    let ran = run(folder.path(), "smooth", &["map.engine=pixel", "products.smooth_fwhm_deg=8.0"]);
    let path = |file: &str| ran.out.join(file).to_str().unwrap().to_owned();
    for kind in ["map", "noise"] {
        let smooth = format!("{kind}-smooth.fits");
        let cards = header(&ran, &smooth);
        assert_eq!((cards.real("SPLIT"), cards.real("FWHM")), (Some(4.0), Some(8.0)));
        let found = read_map_file(&ran.out.join(&smooth), &ReadOptions::default()).unwrap().map;
        let expected = healpy(&["--process", &path(&format!("{kind}.fits")), "4", "8.0"]);
        let expected = numbers(&expected);
        let scale = expected.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
        for (found, expected) in found.values().iter().zip(&expected) {
            // Single precision in files, and quadratures improved three times in both.
            assert!((found - expected).abs() < 1e-5 * scale, "{kind}: {found} {expected}");
        }
    }
    let cards = header(&ran, "input-smooth.fits");
    assert_eq!((cards.real("NSIDE"), cards.real("FWHM")), (Some(32.0), Some(8.0)));
    assert_eq!(ran.channel["post_processing"]["fwhm_deg"], 8.0);
    // The curves are of the maps after it.
    let input = folder.path().join("sky.fits").to_str().unwrap().to_owned();
    let expected = healpy(&[&path("map-smooth.fits"), &input, "23"]);
    for (l, (found, expected)) in
        numbers(&ran.channel["rho"]).iter().zip(numbers(&expected["rho"])).enumerate().take(20)
    {
        // A beam is a factor by degree, which rho does not see; single precision, and 5e-3 of the amplitude at l = 20.
        assert!((found / expected - 1.0).abs() < 1e-3, "l = {l}: {found} {expected}");
    }
}
