//! Orbits from SPK kernels: as NAIF's toolkit writes and reads them, made by hand, and kernels that are refused.

use crate::common;

use std::f64::consts::PI;
use std::path::{Path, PathBuf};
use std::process::Command;

use lunarray::array::{Array, ArrayConfig};
use lunarray::units::vector::{norm, sub};

fn config(kernels: &[PathBuf]) -> ArrayConfig {
    ArrayConfig { satellites: 3, oem: kernels.to_vec(), ..ArrayConfig::default() }
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn kernels_are_read_as_the_toolkit_reads_them() {
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/spk_orbits.py");
    let output = Command::new(common::python()).arg(script).arg(folder.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut kernels = 0;
    for entry in std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().path()) {
        if entry.extension().is_none_or(|ending| ending != "bsp") {
            continue;
        }
        kernels += 1;
        let array = Array::new(&config(std::slice::from_ref(&entry))).unwrap();
        assert_eq!(array.satellites(), 3);
        let truth = std::fs::read(entry.with_extension("truth")).unwrap();
        let truth: Vec<f64> =
            truth.as_chunks::<8>().0.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect();
        assert!(truth.len() >= 10 * 100);
        for row in truth.chunks_exact(10) {
            for n in 0..3 {
                let expected = std::array::from_fn(|k| row[1 + 3 * n + k]);
                let error_m = norm(sub(array.position_m(n, row[0]), expected));
                // Dates of a kernel are good to 1.2e-7 s, times of the toolkit, of one term of TDB, to 3e-7 s in a day: at 1.6 km/s 0.7 mm.
                assert!(error_m < 2e-3, "{} {} {n}: {error_m} m", entry.display(), row[0]);
            }
        }
    }
    // Types 2, 3, 8, 9, 12, 13; two segments that overlap; the axes of the equator.
    assert_eq!(kernels, 8);
}

/// 2030-01-01T00:00:00 TDB, s from J2000.
const EPOCH_S: f64 = 946_728_000.0;

/// Angular speed of the circle, rad/s: sqrt(GM / r^3).
const RATE: f64 = 7.615e-4;
const RADIUS_KM: f64 = 2037.1;

/// State on a circle, km and km/s.
fn state(s: f64, angle: f64) -> [f64; 6] {
    let (sin, cos) = (RATE * s - angle).sin_cos();
    let speed = RADIUS_KM * RATE;
    [RADIUS_KM * cos, RADIUS_KM * sin, 0.0, -speed * sin, speed * cos, 0.0]
}

/// A segment of a kernel.
#[derive(Clone)]
struct Segment {
    covered_s: [f64; 2],
    object: i32,
    centre: i32,
    frame: i32,
    kind: i32,
    words: Vec<f64>,
}

/// A segment of a circle of 20 minutes, states each minute or polynomials over five.
fn segment(object: i32, kind: i32, angle: f64) -> Segment {
    let times: Vec<f64> = (0..=20).map(|k| 60.0 * f64::from(k)).collect();
    let states = times.iter().flat_map(|s| state(*s, angle));
    let dates = times.iter().map(|s| EPOCH_S + s);
    let count = times.len() as f64;
    let words: Vec<f64> = match kind {
        2 | 3 => {
            let records: Vec<f64> = (0..4).flat_map(|k| record(300.0 * f64::from(k), kind, angle)).collect();
            let size = (records.len() / 4) as f64;
            records.into_iter().chain([EPOCH_S, 300.0, size, 4.0]).collect()
        }
        // The interpolations go through eight and four states.
        8 | 12 => states.chain([EPOCH_S, 60.0, if kind == 8 { 7.0 } else { 3.0 }, count]).collect(),
        _ => states.chain(dates).chain([if kind == 9 { 7.0 } else { 3.0 }, count]).collect(),
    };
    Segment { covered_s: [EPOCH_S, EPOCH_S + 1200.0], object, centre: 301, frame: 17, kind, words }
}

/// A record of polynomials of Chebyshev for 300 s, through as many points as they have terms.
fn record(from_s: f64, kind: i32, angle: f64) -> Vec<f64> {
    const TERMS: i32 = 8;
    let at = |k: i32| PI * (f64::from(k) + 0.5) / f64::from(TERMS);
    let mut words = vec![EPOCH_S + from_s + 150.0, 150.0];
    for axis in 0..if kind == 2 { 3 } else { 6 } {
        for degree in 0..TERMS {
            let value = |k: i32| state(from_s + 150.0 * (1.0 + at(k).cos()), angle)[axis];
            let sum: f64 = (0..TERMS).map(|k| value(k) * (f64::from(degree) * at(k)).cos()).sum();
            words.push(sum * if degree == 0 { 1.0 } else { 2.0 } / f64::from(TERMS));
        }
    }
    words
}

/// A kernel, by NAIF's "DAF Required Reading".
fn kernel(segments: &[Segment], is_big: bool) -> Vec<u8> {
    let real = |value: f64| if is_big { value.to_be_bytes() } else { value.to_le_bytes() };
    let whole = |value: i32| if is_big { value.to_be_bytes() } else { value.to_le_bytes() };
    let mut file = b"DAF/SPK ".to_vec();
    file.extend([2, 6].map(whole).concat());
    file.extend([b' '; 60]);
    // First and last record of summaries, and the first free word.
    file.extend([2, 2, 0].map(whole).concat());
    file.extend(if is_big { b"BIG-IEEE" } else { b"LTL-IEEE" });
    file.resize(1024, 0);
    file.extend([0.0, 0.0, segments.len() as f64].map(real).concat());
    let mut next = 3 * 128 + 1;
    for segment in segments {
        let words = segment.words.len() as i32;
        file.extend(segment.covered_s.map(real).concat());
        let Segment { object, centre, frame, kind, .. } = *segment;
        file.extend([object, centre, frame, kind, next, next + words - 1].map(whole).concat());
        next += words;
    }
    file.resize(2048, 0);
    // Names.
    file.resize(3072, b' ');
    file.extend(segments.iter().flat_map(|segment| &segment.words).flat_map(|word| real(*word)));
    file
}

fn array_of(kernel: &[u8]) -> Result<Array, String> {
    let file = tempfile::Builder::new().suffix(".bsp").tempfile().unwrap();
    std::fs::write(file.path(), kernel).unwrap();
    Array::new(&config(&[file.path().to_owned()])).map_err(|error| error.to_string())
}

/// To what TDB and TAI differ.
fn assert_knows_all(array: &Array) {
    let [from_s, until_s] = array.known_s().unwrap();
    assert!(from_s == 0.0 && (until_s - 1200.0).abs() < 1e-6, "{from_s} {until_s}");
}

fn assert_on_circle(array: &Array, satellite: usize, t_s: f64, angle: f64) {
    let expected = std::array::from_fn(|k| 1e3 * state(t_s, angle)[k]);
    let error_m = norm(sub(array.position_m(satellite, t_s), expected));
    // TDB and TAI differ by up to 3.3e-10 of the time: 4e-7 s in 20 minutes at 1.6 km/s; and dates of a kernel are good to 1.2e-7 s.
    assert!(error_m < 1e-3, "{satellite} {t_s}: {error_m} m");
}

#[test]
fn objects_of_a_kernel_are_satellites() {
    for kind in [2, 3, 8, 9, 12, 13] {
        for is_big in [false, true] {
            // The last two are not about the Moon, and those of the first come in two segments.
            let mut others = [segment(-7, kind, 0.0), segment(399, kind, 0.0)];
            others[0].centre = 399;
            others[1].centre = 3;
            let mut segments: Vec<Segment> =
                (0..3).map(|n| segment(-30 + n, kind, 1e-3 * f64::from(n))).collect();
            segments.extend(others);
            let array = array_of(&kernel(&segments, is_big)).unwrap();
            assert_knows_all(&array);
            for (n, t_s) in (0..3).flat_map(|n| [0.0, 100.0, 299.9, 300.1, 655.5, 1200.0].map(|t_s| (n, t_s)))
            {
                assert_on_circle(&array, n, t_s, 1e-3 * n as f64);
            }
        }
    }
}

#[test]
fn the_last_of_segments_that_overlap_counts() {
    let mut segments = [-1, -2, -3, -1].map(|object| segment(object, 13, -1e-3 * f64::from(object)));
    // 200 m ahead, for a part of the time.
    segments[3].words = segment(-1, 13, 0.9e-3).words;
    segments[3].covered_s = [EPOCH_S + 290.0, EPOCH_S + 610.0];
    let array = array_of(&kernel(&segments, false)).unwrap();
    assert_knows_all(&array);
    for (t_s, angle) in [(280.0, 1e-3), (300.0, 0.9e-3), (600.0, 0.9e-3), (620.0, 1e-3)] {
        assert_on_circle(&array, 0, t_s, angle);
    }
}

#[test]
fn kernels_that_cannot_be_used_are_refused_with_a_reason() {
    let good = [-1, -2, -3].map(|object| segment(object, 13, -1e-3 * f64::from(object)));
    let changed = |change: fn(&mut Segment)| {
        let mut segments = good.clone();
        change(&mut segments[1]);
        kernel(&segments, false)
    };
    let all_changed = |change: fn(&mut Segment)| {
        let mut segments = good.clone();
        segments.iter_mut().for_each(change);
        kernel(&segments, false)
    };
    let whole = kernel(&good, false);
    let named = |name: &[u8; 8]| [&name[..], &whole[8..]].concat();
    // All segments have the numbers of the first.
    let mut shared = kernel(&good, false);
    for k in 1..25 {
        let place = 1024 + 24 + 40 * k;
        let first: Vec<u8> = shared[1024 + 24..1024 + 64].to_vec();
        shared[place..place + 40].copy_from_slice(&first);
    }
    shared[1024 + 16..1024 + 24].copy_from_slice(&25.0_f64.to_le_bytes());
    // The number of the next record of summaries.
    let next = |record: f64| [&whole[..1024], &record.to_le_bytes()[..], &whole[1032..]].concat();
    for (bytes, told) in [
        (next(f64::NAN), "summaries in record NaN of"),
        (next(1e30), "summaries in record 1000"),
        (next(-1.0), "summaries in record -1 of"),
        (next(2.5), "summaries in record 2.5 of"),
        (named(b"DAF/CK  "), "found \"DAF/CK\"; expected a binary SPK kernel"),
        (named(b"DAFETF N"), "expected a binary SPK kernel, DAF/SPK; NAIF's `tobin`"),
        ([&whole[..88], b"VAX-GFLT", &whole[96..]].concat(), "VAX-GFLT"),
        (whole[..2000].to_vec(), "summaries in record 2 of 1; expected the whole kernel"),
        (whole[..whole.len() - 8].to_vec(), "segment 3: found numbers that are not in the file"),
        (shared, "each with numbers of its own"),
        (kernel(&good[..2], false), "have 2 orbits; expected as many as array.satellites = 3"),
        (all_changed(|s| s.centre = 399), "the objects -1 about 399, -2 about 399"),
        (changed(|s| s.frame = 10_020), "segment 2: found a segment on the axes 10020; expected 1 (J2000)"),
        (changed(|s| s.kind = 21), "segment 2: found a segment of type 21; expected type 2 or 3"),
        (changed(|s| s.kind = 8), "numbers that contradict each other"),
        (changed(|s| s.words[3] = f64::NAN), "a value that is no number"),
        (changed(|s| s.words[6 * 21 + 2] = 0.0), "states that do not follow each other"),
        (changed(|s| s.covered_s[1] = 1e300), "numbers that are not in the file"),
        (changed(|s| s.covered_s = [0.0, 10.0]), "no states in the time that it covers"),
        (
            changed(|s| s.words[6 * 9] += 0.01),
            "object -2, segment 2: found a position at 2030-01-01T00:09:00.000 TDB that is 10.0 m",
        ),
        (changed(|s| s.words[0] = 0.0), "above the Moon's surface"),
    ] {
        let said = array_of(&bytes).map(|_| told).unwrap_err();
        assert!(said.contains(told) && said.contains(".bsp"), "{told}: {said}");
    }
    array_of(&whole).unwrap();
}
