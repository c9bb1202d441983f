//! Spherical harmonics against healpy.

use crate::common;

use std::fs;
use std::path::Path;
use std::process::Command;

use lunarray::sky::fits::{ReadOptions, read_map};
use lunarray::sky::harmonics::{Alm, AnalysisOptions, Method, Transform};
use lunarray::sky::spectra::{auto_cl, gaussian_beam, multiply_degrees};
use lunarray::sky::{Frame, SkyMap};
use num_complex::Complex64;

/// nside and `l_max`: tiny, typical, to the limit and beyond.
const CASES: [(usize, usize); 8] =
    [(1, 2), (2, 9), (4, 11), (16, 20), (32, 95), (64, 191), (16, 200), (256, 767)];

struct Reference {
    folder: tempfile::TempDir,
}

impl Reference {
    fn new(cases: &[(usize, usize)]) -> Self {
        let python = common::python();
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/sky_harmonics.py");
        let folder = tempfile::tempdir().unwrap();
        let cases = cases.iter().map(|(nside, l_max)| format!("{nside}:{l_max}"));
        let output = Command::new(python).arg(script).arg(folder.path()).args(cases).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Self { folder }
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
#[ignore = "needs LUNARRAY_PYTHON"]
fn transforms_equal_healpys() {
    let reference = Reference::new(&CASES);
    for case in CASES {
        let (nside, l_max) = case;
        let transform = Transform::new(nside, l_max).unwrap();
        let map = transform.synthesis(&reference.alm("alm", case)).unwrap();
        let error = difference(&map, &reference.values("map", case));
        assert!(error < 1e-11, "{case:?}: synthesis differs by {error:e}");
        if l_max < 3 * nside {
            let options = AnalysisOptions { method: Method::Jacobi { iterations: 3 } };
            let found = transform.analysis(&reference.values("noise", case), &options).unwrap();
            let error = difference(&parts(&found.alm), &parts(&reference.alm("jacobi", case)));
            assert!(error < 1e-11, "{case:?}: analysis differs by {error:e}");
        }
    }
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn smoothing_spectra_and_rotation_equal_healpys() {
    let cases = [(8, 20), (32, 95), (64, 100)];
    let reference = Reference::new(&cases);
    for case in cases {
        let (nside, l_max) = case;
        let mut alm = reference.alm("alm", case);
        let error = difference(&auto_cl(&alm), &reference.values("cl", case));
        assert!(error < 1e-14, "{case:?}: spectra differ by {error:e}");
        let map = SkyMap::new(Frame::Galactic, reference.values("map", case)).unwrap();
        let turned = map.to_ecliptic();
        // healpy forms the angles of the turned centres and their pixels' shares by other roundings.
        let error = difference(turned.values(), &reference.values("rotated", case));
        assert!(error < 1e-11, "{case:?}: rotation differs by {error:e}");
        multiply_degrees(&mut alm, &gaussian_beam(0.1, l_max));
        let smooth = Transform::new(nside, l_max).unwrap().synthesis(&alm).unwrap();
        let error = difference(&smooth, &reference.values("smooth", case));
        assert!(error < 1e-12, "{case:?}: smoothing differs by {error:e}");
        let smoothed = map.smoothed(0.1).unwrap();
        let error = difference(smoothed.values(), &reference.values("smoothing", case));
        assert!(error < 1e-11, "{case:?}: smoothing of a map differs by {error:e}");
    }
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn frames_turn_as_healpys_rotator() {
    let python = common::python();
    let code = "import healpy as hp\nfor c in ('GE', 'CE', 'EC', 'CG'):\n print(*hp.Rotator(coord=list(c)).mat.ravel())";
    let output = Command::new(python).args(["-c", code]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let frames = [
        (Frame::Galactic, Frame::Ecliptic),
        (Frame::Equatorial, Frame::Ecliptic),
        (Frame::Ecliptic, Frame::Equatorial),
        (Frame::Equatorial, Frame::Galactic),
    ];
    for ((from, to), line) in frames.into_iter().zip(text.lines()) {
        let expected: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
        let found = from.to_frame(to).concat();
        // Products of matrices whose elements have 16 digits.
        assert!(difference(&found, &expected) < 1e-14, "{from} to {to}");
    }
}

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn the_published_map_turns_as_published() {
    let galactic = common::shared("sky/ulsa_10mhz_galactic_nside64.fits");
    let ecliptic = common::shared("sky/ulsa_10mhz_ecliptic_nside64.fits");
    let options = ReadOptions::default();
    let found = read_map(&galactic, &options).unwrap().to_ecliptic();
    let expected = read_map(&ecliptic, &options).unwrap();
    assert_eq!(found.frame(), expected.frame());
    for (pixel, (found, expected)) in found.values().iter().zip(expected.values()).enumerate() {
        // The file is in single precision, of which one unit in the last place is up to 2^-23 = 1.2e-7.
        assert!((found / expected - 1.0).abs() < 1.2e-7, "pixel {pixel}: {found} and {expected}");
    }
}
