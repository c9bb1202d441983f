//! Spherical harmonics against healpy.
#![allow(clippy::unwrap_used, clippy::panic)] // Helpers of tests are tests.

mod common;

use std::fs;
use std::path::Path;
use std::process::Command;

use lunarray::sky::harmonics::{Alm, AnalysisOptions, Method, Transform};
use num_complex::Complex64;

/// nside and `l_max`: tiny, typical, to the limit and beyond.
const CASES: [(usize, usize); 8] =
    [(1, 2), (2, 9), (4, 11), (16, 20), (32, 95), (64, 191), (16, 200), (256, 767)];

struct Reference {
    folder: tempfile::TempDir,
}

impl Reference {
    fn new(cases: &[(usize, usize)]) -> Option<Self> {
        let python = common::python()?;
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/sky_harmonics.py");
        let folder = tempfile::tempdir().unwrap();
        let cases = cases.iter().map(|(nside, l_max)| format!("{nside}:{l_max}"));
        let output = Command::new(python).arg(script).arg(folder.path()).args(cases).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Some(Self { folder })
    }

    fn values(&self, kind: &str, (nside, l_max): (usize, usize)) -> Vec<f64> {
        let bytes = fs::read(self.folder.path().join(format!("{kind}_{nside}_{l_max}"))).unwrap();
        bytes.as_chunks::<8>().0.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect()
    }

    fn alm(&self, kind: &str, case: (usize, usize)) -> Alm {
        let values =
            self.values(kind, case).as_chunks::<2>().0.iter().map(|c| Complex64::new(c[0], c[1])).collect();
        Alm::from_values(case.1, values).unwrap()
    }
}

/// Greatest difference relative to the greatest value.
fn difference(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let greatest = |values: &mut dyn Iterator<Item = f64>| values.fold(0.0_f64, |a, b| a.max(b.abs()));
    greatest(&mut found.iter().zip(expected).map(|(a, b)| a - b)) / greatest(&mut expected.iter().copied())
}

fn parts(alm: &Alm) -> Vec<f64> {
    alm.values().iter().flat_map(|value| [value.re, value.im]).collect()
}

#[test]
fn transforms_equal_healpys() {
    let Some(reference) = Reference::new(&CASES) else { return };
    for case in CASES {
        let (nside, l_max) = case;
        let transform = Transform::new(nside, l_max).unwrap();
        let map = transform.synthesis(&reference.alm("alm", case)).unwrap();
        let error = difference(&map, &reference.values("map", case));
        eprintln!("{case:?} synthesis {error:e}");
        assert!(error < 1e-11, "{case:?}: synthesis differs by {error:e}");
        if l_max < 3 * nside {
            let options = AnalysisOptions { method: Method::Jacobi { iterations: 3 } };
            let found = transform.analysis(&reference.values("noise", case), &options).unwrap();
            let error = difference(&parts(&found.alm), &parts(&reference.alm("jacobi", case)));
            eprintln!("{case:?} analysis {error:e}");
            assert!(error < 1e-11, "{case:?}: analysis differs by {error:e}");
        }
    }
}
