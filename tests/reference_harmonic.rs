//! The harmonic engine's ingredients against values computed by independent code.

mod common;

use std::path::Path;

use lunarray::sky::harmonics::wigner_d;
use serde::Deserialize;

#[derive(Deserialize)]
struct Reference {
    wigner_d: Vec<WignerReference>,
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
fn wigner_functions() {
    let Some(path) = common::shared("reference/harmonic.json") else { return };
    for case in reference(&path).wigner_d {
        let found = wigner_d(case.l_max, case.m, case.mu, case.beta_deg.to_radians());
        assert_eq!(found.len(), case.d.len());
        for (l, (x, y)) in found.iter().zip(&case.d).enumerate() {
            // Both sides are good to about l roundings.
            assert!((x - y).abs() < 1e-12, "l {l} m {} mu {}: {x} {y}", case.m, case.mu);
        }
    }
}
