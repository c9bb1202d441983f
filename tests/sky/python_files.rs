//! Map files against healpy, both ways, and the published maps.

use crate::common;

use std::ffi::OsStr;
use std::fs;
use std::path::Path;
use std::process::Command;

use lunarray::sky::fits::{
    Card, Ordering, Precision, ReadOptions, WriteOptions, read_map, read_whole_map, write_map,
};
use lunarray::sky::healpix::{nested_to_ring, pixel_directions, pixel_of, ring_to_nested};
use lunarray::sky::{Frame, SkyMap, is_unseen};
use lunarray::units::constants::HEALPIX_UNSEEN;

fn run(python: &Path, arguments: &[&OsStr]) -> String {
    run_script(python, "sky_files.py", arguments)
}

fn run_script(python: &Path, script: &str, arguments: &[&OsStr]) -> String {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python").join(script);
    let output = Command::new(python).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn raw_values(path: &Path) -> Vec<f64> {
    fs::read(path).unwrap().as_chunks::<8>().0.iter().map(|&bytes| f64::from_le_bytes(bytes)).collect()
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn healpy_files_are_read_bit_for_bit() {
    let python = common::python();
    let folder = tempfile::tempdir().unwrap();
    run(&python, &["write".as_ref(), folder.path().as_ref()]);
    let mut files = 0;
    for entry in fs::read_dir(folder.path()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension() != Some("fits".as_ref()) {
            continue;
        }
        let name = path.file_stem().unwrap().to_str().unwrap();
        let column = if name.starts_with("columns") { 2 } else { 0 };
        let map = read_map(&path, &ReadOptions { column: Some(column), ..ReadOptions::default() }).unwrap();
        assert!(name.ends_with(map.frame().letter()), "{name}");
        assert!(map.values() == raw_values(&path.with_extension("raw")), "{name}");
        files += 1;
    }
    assert_eq!(files, 2 * 4 * 2 * 2 * 2 + 1);
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn healpy_reads_ours_and_writes_the_same_bytes() {
    let python = common::python();
    let folder = tempfile::tempdir().unwrap();
    let mut files = 0;
    for nside in [4, 8, 16, 64] {
        for (frame, precision, ordering, partial) in [
            (Frame::Ecliptic, Precision::Single, Ordering::Ring, false),
            (Frame::Ecliptic, Precision::Double, Ordering::Nested, false),
            (Frame::Galactic, Precision::Single, Ordering::Ring, true),
            (Frame::Equatorial, Precision::Double, Ordering::Nested, true),
        ] {
            let value =
                |p: usize| if partial && p % 3 == 1 { HEALPIX_UNSEEN } else { (p as f64).sqrt() * 1e5 };
            let map = SkyMap::new(frame, (0..12 * nside * nside).map(value).collect()).unwrap();
            let path = folder.path().join(format!("{files}.fits"));
            let cards = vec![Card::integer("SEED", 17, "seed"), Card::real("FREQ", 1e7, "Hz")];
            write_map(&path, &map, &WriteOptions { precision, ordering, partial, cards }).unwrap();
            let raw: Vec<u8> = map.values().iter().flat_map(|value| value.to_le_bytes()).collect();
            fs::write(path.with_extension("raw"), raw).unwrap();
            files += 1;
        }
    }
    let read = run(&python, &["read".as_ref(), folder.path().as_ref()]);
    assert_eq!(read.trim(), files.to_string());
}

/// The published ULSA maps: MHz, and mean, standard deviation, 5, 50, 95 %, means above 60 deg, below -60 deg
/// and within 5 deg of Galactic latitude as their README tabulates them, K.
const ULSA: [(u32, [f64; 8]); 3] = [
    (1, [3.47e7, 3.27e7, 0.96e7, 2.69e7, 7.36e7, 6.76e7, 2.67e7, 2.13e7]),
    (3, [6.08e6, 2.59e6, 3.67e6, 5.81e6, 9.40e6, 6.84e6, 4.67e6, 3.95e6]),
    (10, [3.77e5, 1.74e5, 2.26e5, 3.20e5, 7.51e5, 3.07e5, 2.40e5, 5.09e5]),
];

#[test]
#[ignore = "needs LUNARRAY_SHARED"]
fn the_published_maps_have_their_published_statistics() {
    for (mhz, expected) in ULSA {
        let path = common::shared(&format!("sky/ulsa_{mhz}mhz_galactic_nside64.fits"));
        let map = read_whole_map(&path, &ReadOptions::default()).unwrap();
        assert_eq!((map.nside(), map.frame()), (64, Frame::Galactic));
        let mut sorted = map.values().to_vec();
        assert!(sorted.iter().all(|&value| !is_unseen(value)));
        sorted.sort_by(f64::total_cmp);
        let count = sorted.len() as f64;
        let mean = sorted.iter().sum::<f64>() / count;
        let std = (sorted.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / count).sqrt();
        let percentile = |percent: f64| sorted[(percent / 100.0 * (count - 1.0)).round() as usize];
        let sines: Vec<f64> = pixel_directions(64).iter().map(|direction| direction[2]).collect();
        let mean_where = |chosen: &dyn Fn(f64) -> bool| {
            let values = sines.iter().zip(map.values()).filter(|(sine, _)| chosen(**sine));
            let (sum, count) = values.fold((0.0, 0), |(sum, count), (_, value)| (sum + value, count + 1));
            sum / f64::from(count)
        };
        let (high, low) = (60_f64.to_radians().sin(), 5_f64.to_radians().sin());
        let found = [
            mean,
            std,
            percentile(5.0),
            percentile(50.0),
            percentile(95.0),
            mean_where(&|sine| sine > high),
            mean_where(&|sine| sine < -high),
            mean_where(&|sine| sine.abs() < low),
        ];
        for (found, expected) in found.into_iter().zip(expected) {
            // The table has three digits, of at least 0.96: half a unit of the last is 0.6 %.
            assert!((found / expected - 1.0).abs() < 0.006, "{mhz} MHz: {found:e}, expected {expected:e}");
        }
    }
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn numbers_of_pixels_are_healpys() {
    let python = common::python();
    let folder = tempfile::tempdir().unwrap();
    let nsides = ["1", "2", "4", "8", "64", "512"];
    let mut arguments: Vec<&OsStr> = vec![folder.path().as_ref()];
    arguments.extend(nsides.map(OsStr::new));
    run_script(&python, "sky_pixels.py", &arguments);
    let numbers = |name: String| -> Vec<usize> {
        let bytes = fs::read(folder.path().join(name)).unwrap();
        bytes.as_chunks::<8>().0.iter().map(|&bytes| u64::from_le_bytes(bytes) as usize).collect()
    };
    for nside in nsides {
        let nested = numbers(format!("nested_{nside}"));
        let pixels = numbers(format!("pixels_{nside}"));
        let directions = raw_values(&folder.path().join(format!("directions_{nside}")));
        let nside: usize = nside.parse().unwrap();
        assert_eq!((nested.len(), pixels.len()), (12 * nside * nside, 20_000));
        for (ring, &expected) in nested.iter().enumerate() {
            assert_eq!(ring_to_nested(nside, ring), expected, "nside {nside}, RING {ring}");
            assert_eq!(nested_to_ring(nside, expected), ring, "nside {nside}, NESTED {expected}");
        }
        for (&direction, &expected) in directions.as_chunks::<3>().0.iter().zip(&pixels) {
            assert_eq!(pixel_of(nside, direction), expected, "nside {nside}, {direction:?}");
        }
    }
}
