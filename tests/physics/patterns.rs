//! Wigner functions and pattern coefficients against values computed by independent code.

use crate::common;

use std::path::Path;

use lunarray::frames::AntennaResponse;
use lunarray::response::harmonic::{NodeGrid, PatternGeometry, PatternTable};
use lunarray::sky::harmonics::wigner_d;
use lunarray::units::constants::{MOON_RADIUS_M, SPEED_OF_LIGHT_M_S};
use serde::Deserialize;

#[derive(Deserialize)]
struct Reference {
    wigner_d: Vec<WignerReference>,
    beam_coefficients: Vec<BeamReference>,
}

#[derive(Deserialize)]
struct BeamReference {
    b_m: f64,
    nu_hz: f64,
    l_max: usize,
    re: Vec<Vec<f64>>,
}

#[derive(Deserialize)]
struct WignerReference {
    m: i64,
    mu: i64,
    beta_deg: f64,
    l_max: usize,
    d: Vec<f64>,
}

fn reference(path: &Path) -> Reference {
    let text = std::fs::read_to_string(path).expect("the reference file is readable");
    serde_json::from_str(&text).expect("the reference file has the documented form")
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn wigner_functions() {
    let path = common::shared("reference/harmonic.json");
    for case in reference(&path).wigner_d {
        let found = wigner_d(case.l_max, case.m, case.mu, case.beta_deg.to_radians());
        assert_eq!(found.len(), case.d.len());
        for (l, (x, y)) in found.iter().zip(&case.d).enumerate() {
            // Both sides are good to about l roundings.
            assert!((x - y).abs() < 1e-12, "l {l} m {} mu {}: {x} {y}", case.m, case.mu);
        }
    }
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn pattern_coefficients() {
    let path = common::shared("reference/harmonic.json");
    for case in reference(&path).beam_coefficients {
        let geometry = PatternGeometry {
            orbit_radius_m: MOON_RADIUS_M + 300e3,
            moon_radius_m: MOON_RADIUS_M,
            wavelength_m: SPEED_OF_LIGHT_M_S / case.nu_hz,
            response: AntennaResponse::Isotropic,
        };
        let grid = NodeGrid { first: case.b_m / geometry.wavelength_m, step: 1.0, count: 1 };
        let table = PatternTable::<f64>::new(geometry, case.l_max, grid);
        for l in 0..=case.l_max {
            for mu in 0..=l {
                let sign = if mu % 2 == 0 { 1.0 } else { -1.0 };
                let [plus, minus] = match (l - mu) % 2 {
                    0 => [0, 1].map(|k| table.order(mu)[(l - mu) + k]),
                    _ => [0.0, 0.0],
                };
                for (found, order) in [(plus, case.l_max + mu), (sign * minus, case.l_max - mu)] {
                    let expected = case.re[l][order];
                    println!("{l} {mu} {found} {expected} {:e}", found - expected);
                    // The reference's own imaginary parts, zero in truth, show 1e-9 to be ample.
                    assert!(
                        (found - expected).abs() < 1e-9,
                        "{} m, l {l} mu {mu}: {found} {expected}",
                        case.b_m
                    );
                }
            }
        }
    }
}
