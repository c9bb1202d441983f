//! Pieces of maps against healpy's gnomview and cartview.

use crate::common;

use std::path::Path;
use std::process::Command;

use lunarray::sky::fits::{Precision, WriteOptions, write_map};
use lunarray::sky::healpix::pixel_directions;
use lunarray::sky::{Frame, SkyMap};

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn pieces_are_those_of_healpy() {
    let python = common::python();
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    // Every pixel has a value of its own.
    let value = |n: &[f64; 3]| 10.0 + n[0] + 2.0 * n[1] + 3.0 * n[2] + (40.0 * n[0] * n[1]).sin();
    let map = SkyMap::new(Frame::Galactic, pixel_directions(64).iter().map(value).collect()).unwrap();
    let options = WriteOptions { precision: Precision::Double, ..WriteOptions::default() };
    write_map(Path::new(&path("map.fits")), &map, &options).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/cutouts.py");
    for projection in ["gnomonic", "cartesian"] {
        for [lon, lat, size, pixels] in [
            ["0", "0", "20", "200"],
            ["120", "-35", "20", "101"],
            ["310.5", "88", "30", "150"],
            ["45", "60", "1", "64"],
        ] {
            let centre = format!("{lon},{lat}");
            let (map, picture, table) = (path("map.fits"), path("piece.png"), path("piece.csv"));
            let args = ["cutout", &map, "--centre", &centre, "--size", size, "--pixels", pixels];
            let more = ["--projection", projection, "--out", &picture];
            let made =
                assert_cmd::Command::cargo_bin("lunarray").unwrap().args(args).args(more).output().unwrap();
            assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
            let args = [&map, &table, projection, lon, lat, size, pixels];
            let compared = Command::new(&python).arg(&script).args(args).output().unwrap();
            assert!(compared.status.success(), "{}", String::from_utf8_lossy(&compared.stderr));
            let differing: f64 = String::from_utf8(compared.stdout).unwrap().trim().parse().unwrap();
            // Directions on the border of two pixels may go to either.
            assert!(differing < 1e-3, "{projection} {centre}: {differing}");
        }
    }
}
