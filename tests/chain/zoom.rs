//! A patch of sky from long baselines: sources of a table through the whole chain.

use std::process::Command;

use serde_json::Value;

use super::common;
use super::common::workplace::{Workplace, fail, json};

/// Five minutes of some windows over three months at 10 MHz with all baselines, and the noise of the sky.
const MISSION: &str = r#"
name = "zoom"
seed = 11
[sky]
nside = 8
[spacecraft]
channels_hz = [10.0e6]
duration_s = 8.0e6
every_nth_window = 121
window_s_max = 300.0
"#;

/// Sources about the ecliptic pole, which the Moon never hides from an orbit inclined by 30 degrees; the fourth is a hundredth of the radius
/// from the edge. The last is outside.
const SOURCES: &str = "name,ra,dec,flux_10mhz_jy,spectral_index\n\
    A,270.0,66.5,60000,-0.8\nB,271.2,66.9,20000,-0.8\nC,268.9,66.1,15000,-0.8\nD,270.0,67.49,30000,-0.8\n\
    E,270.3,66.45,12000,-0.8\nF,269.5,66.8,4000,-0.8\nfar,90.0,-20.0,80000,-0.8\n";

/// The downlink, and the table of sources.
fn simulated(place: &Workplace) -> [String; 2] {
    let table = place.file("sources.csv", SOURCES.as_bytes());
    let downlink = place.simulate("pass.ccsds", &["--set", &format!("sky.points={table:?}")]);
    [downlink, table]
}

fn number(value: &Value, key: &str) -> f64 {
    value[key].as_f64().unwrap_or_else(|| panic!("{key} of {value}"))
}

#[test]
fn sources_have_their_fluxes_and_places() {
    let place = Workplace::new(MISSION);
    let [downlink, table] = simulated(&place);
    let zoom = |out: &str, more: &[&str]| {
        let args = ["zoom", &downlink, "--catalogue", &table, "--radius-deg", "1", "--out", &place.path(out)];
        json(&[&args[..], more].concat())
    };
    let subtracted = ["--subtract-jy", "50000"];
    let found = zoom("pole", &[&["--centre", "a"], &subtracted[..]].concat());
    let sources = found["sources"].as_array().unwrap();
    let names: Vec<&str> = sources.iter().map(|one| one["known_name"].as_str().unwrap()).collect();
    assert_eq!(names, ["A", "D", "B", "C", "E", "F"]);
    for one in sources {
        // Five standard deviations in each of eighteen numbers: false in one case of 1e5.
        let apart = number(one, "flux_jy") - number(one, "known_flux_jy");
        assert!(apart.abs() < 5.0 * number(one, "flux_error_jy"), "{one}");
        let error = number(one, "east_error_arcsec").hypot(number(one, "north_error_arcsec"));
        assert!(number(one, "known_distance_arcsec") < 5.0 * error, "{one}");
    }
    // The noise is P / sqrt(2 dnu t) of the pairs together, and the image has no other.
    let noise = &found["noise"];
    let ratio = number(noise, "measured_jy") / number(noise, "thermal_jy");
    assert!((ratio - 1.0).abs() < 0.1, "{noise}");
    assert_closes(&found["ledger"]);
    assert!(number(&found, "rows") < 0.2 * number(&found["ledger"], "accumulated"), "{found}");
    // Nothing is found where nothing is, by the very threshold that expects 0.05 false sources at most.
    let empty = zoom("empty", &[&["--centre", "300,55"], &["--subtract-jy", "3000"][..]].concat());
    assert_eq!(empty["sources"].as_array().unwrap().len(), 0, "{empty}");
    assert!(number(&empty, "false_sources") <= 0.05);
    // From a patch in the plane of the orbit the Moon takes its part, which is counted.
    let behind = zoom("plane", &["--centre", "90,-20"]);
    let flagged = &behind["ledger"]["flagged"];
    assert!(
        flagged["patch behind the Moon"].is_u64() || flagged["the Moon's limb in the patch"].is_u64(),
        "{flagged}"
    );
    assert_eq!(behind["sources"][0]["known_name"], "far");
    assert_closes(&behind["ledger"]);
}

fn assert_closes(ledger: &Value) {
    let flagged: u64 =
        ledger["flagged"].as_object().unwrap().values().map(|count| count.as_u64().unwrap()).sum();
    let lost: u64 = ledger["lost"].as_array().unwrap().iter().map(|one| one["count"].as_u64().unwrap()).sum();
    assert_eq!(
        ledger["sampled"].as_u64().unwrap(),
        ledger["accumulated"].as_u64().unwrap() + flagged + lost,
        "{ledger}"
    );
}

#[test]
fn what_cannot_be_imaged_is_refused() {
    let place = Workplace::new(MISSION);
    let downlink = place.simulate(
        "pass.ccsds",
        &["--set", "spacecraft.duration_s=9000", "--set", "spacecraft.window_s_max=20"],
    );
    let table = place.file("sources.csv", SOURCES.as_bytes());
    let out = place.path("out");
    let refused =
        |more: &[&str]| fail(&[&["zoom", &downlink, "--catalogue", &table, "--out", &out], more].concat());
    assert!(
        refused(&["--centre", "nowhere"])
            .contains("--centre = nowhere: expected right ascension and declination")
    );
    assert!(refused(&["--centre", "270,66", "--channel", "4"]).contains("--channel"));
    assert!(
        refused(&["--centre", "270,66", "--baseline-min", "1e6"])
            .contains("no visibility sees the whole patch")
    );
    assert!(
        refused(&["--centre", "270,66", "--pixel-arcmin", "60"]).contains("are too large for baselines of")
    );
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn images_and_tables_are_those_of_astropy() {
    let python = common::python();
    let place = Workplace::new(MISSION);
    let [downlink, table] = simulated(&place);
    let out = place.path("pole");
    let args =
        ["zoom", &downlink, "--catalogue", &table, "--centre", "A", "--radius-deg", "1", "--out", &out];
    json(&args);
    let script = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/zoom.py");
    let compared = Command::new(python).arg(script).args([&out, &table]).output().unwrap();
    assert!(compared.status.success(), "{}", String::from_utf8_lossy(&compared.stderr));
}
