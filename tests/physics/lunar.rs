//! Visibilities by stations on the Moon, as pyuvsim simulates them.

use crate::common;

use std::path::Path;
use std::process::Command;

use lunarray::array::{Array, ArrayConfig, Station, Stations};
use lunarray::frames::AntennaResponse;
use lunarray::response::pixel::{PairGeometry, exact};
use lunarray::units::vector::{Vec3, norm, scale, sub};
use num_complex::Complex64;
use serde_json::Value;

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn vector(numbers: &[f64]) -> Vec3 {
    numbers.try_into().unwrap()
}

/// Compares every visibility of a simulation; returns their number.
fn compare(simulation: &Value) -> usize {
    let directions: Vec<Vec3> =
        simulation["directions"].as_array().unwrap().iter().map(|row| vector(&numbers(row))).collect();
    let flux_jy = numbers(&simulation["flux_jy"]);
    let total_jy: f64 = flux_jy.iter().map(|flux| flux.abs()).sum();
    let rows = simulation["visibilities"].as_array().unwrap();
    let dipoles = simulation["dipoles"] == true;
    for row in rows {
        let row = numbers(row);
        let pair = PairGeometry {
            r_i_m: vector(&row[..3]),
            r_j_m: vector(&row[3..6]),
            frequency_hz: simulation["frequency_hz"].as_f64().unwrap(),
            moon_radius_m: simulation["moon_radius_m"].as_f64().unwrap(),
            response: if dipoles { AntennaResponse::DipoleNormal } else { AntennaResponse::Isotropic },
        };
        let found = exact::visibility(&pair, &directions, &flux_jy, 1.0).visibility_k_sr;
        let off = (found - Complex64::new(row[6], row[7])).norm() / total_jy;
        // Positions of 1.7e6 m are rounded to 2e-10 m in several turns, here of up to 1,000 wavelengths of 3 m: 1e-9 of phase.
        assert!(off < 1e-8, "{row:?}: {found}, {off:e} of all sources");
    }
    rows.len()
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn stations_see_what_pyuvsim_simulates() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("truth.json");
    let made = Command::new(common::python())
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/lunar_visibilities.py"))
        .arg(&out)
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let simulations: Vec<Value> = serde_json::from_slice(&std::fs::read(&out).unwrap()).unwrap();
    // The reference: all pairs of 128 stations, and each with itself. Ours: 28 pairs of eight, 6 of four, at several times.
    let counts: Vec<usize> = simulations.iter().map(compare).collect();
    assert!(counts[0] == 128 * 129 / 2 && counts[1] > 3 * 28 && counts[2] > 3 * 6, "{counts:?}");

    // Our stations have the reference's zenith to the precision that is stated of the Moon's orientation, 0.005 degrees.
    let place = &simulations[0]["place"];
    let degrees = |name: &str| place[name].as_f64().unwrap();
    let station = |off_deg: f64| Station {
        longitude_deg: degrees("longitude_deg") + off_deg,
        latitude_deg: degrees("latitude_deg"),
        height_m: 0.0,
    };
    let config = ArrayConfig {
        satellites: 3,
        stations: Stations::List([0.0, 0.01, 0.02].map(station).to_vec()),
        stations_epoch: place["utc"].as_str().unwrap().to_owned(),
        ..ArrayConfig::default()
    };
    let place_m = Array::new(&config).unwrap().position_m(0, 0.0);
    let off_rad = norm(sub(scale(1.0 / norm(place_m), place_m), vector(&numbers(&place["zenith"]))));
    assert!(off_rad < 0.005_f64.to_radians(), "{off_rad}");
}
