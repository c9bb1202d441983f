//! Satellites on orbits of their own, through the whole chain.

use crate::common;

use std::path::Path;

use common::workplace::{Workplace, fail, json, maps, succeed};
use lunarray::downlink::Contents;

/// A triple whose altitudes differ by tens of kilometres and whose planes are tilted against each other: a circle's rows
/// would be of no use.
const TRIPLE: &str = r#"
name = "triple"
seed = 3
[sky]
nside = 4
[array]
satellites = 3
kepler = [
    { semi_major_axis_m = 2037.1e3, eccentricity = 0.010, inclination_deg = 60.00, node_longitude_deg = 0.0, periapsis_deg = 90.0, mean_anomaly_deg = 0.000, node_rate_deg_per_day = -0.75 },
    { semi_major_axis_m = 2037.1e3, eccentricity = 0.012, inclination_deg = 60.02, node_longitude_deg = 0.0, periapsis_deg = 90.0, mean_anomaly_deg = 0.015, node_rate_deg_per_day = -0.75 },
    { semi_major_axis_m = 2037.1e3, eccentricity = 0.010, inclination_deg = 60.00, node_longitude_deg = 0.02, periapsis_deg = 90.0, mean_anomaly_deg = 0.005, node_rate_deg_per_day = -0.75 },
]
[spacecraft]
channels_hz = [3.0e6]
every_nth_window = 100
thermal_noise = false
[map]
nside = 4
epsilon = 1e-6
baseline_bp_max = 10.0
rows = "centre"
[products]
pictures = false
"#;

#[test]
fn a_triple_on_ellipses_is_flown_and_mapped() {
    let place = Workplace::new(TRIPLE);
    let out = place.path("out");
    let summary = json(&["run", &place.pipeline, "--out", &out]);
    let ledger = &summary["ledger"];
    assert!(ledger["accumulated"].as_u64().unwrap() > 1000, "{ledger}");
    // Data of the map's own pixels without noise come back, but for what the regularisation takes.
    let error = summary["channels"][0]["snapshots"][0]["rms_error_over_rms_truth"].as_f64().unwrap();
    assert!(error < 0.05, "{error}");
    // The ground knows the orbits from the downlink alone.
    let (downlink, ground) = (format!("{out}/downlink.ccsds"), place.path("ground"));
    succeed(&["replay", &downlink, "--map", &place.pipeline, "--out", &ground]);
    for (path, bytes) in maps(&ground) {
        assert!(bytes == maps(&out)[&path], "{} differs", path.display());
    }
    assert!(Contents::read(Path::new(&downlink)).unwrap().visibilities.count > 1000);
}

#[test]
fn what_needs_a_circle_is_refused_for_ellipses() {
    let place = Workplace::new(TRIPLE);
    for set in [
        "map.engine=harmonic",
        "spacecraft.fidelity=samples",
        "spacecraft.model=harmonic",
        "spacecraft.smear_integrations=true",
        "spacecraft.antenna=dipole-normal",
        "spacecraft.ninth.on=true",
    ] {
        let said = fail(&["check", &place.pipeline, "--set", set]);
        let (key, _) = set.split_once('=').unwrap();
        let told = format!("{key} = ");
        assert!(said.contains(&told) && said.contains("needs a common circle"), "{set}: {said}");
    }
}
