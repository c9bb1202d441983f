//! Orbits from CCSDS OEM files: as other code integrated them, and files that are refused.

use crate::common;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use lunarray::array::{Array, ArrayConfig};
use lunarray::units::vector::{Vec3, norm, sub};

fn config(folder: &Path) -> ArrayConfig {
    let oem = (1..=3).map(|n| folder.join(format!("sat{n}.oem"))).collect();
    ArrayConfig { satellites: 3, oem, ..ArrayConfig::default() }
}

#[test]
#[ignore = "needs LUNARRAY_PYTHON"]
fn orbits_of_files_are_those_that_were_integrated() {
    let python = common::python();
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/oem_orbits.py");
    let output = Command::new(python).arg(script).arg(folder.path()).arg("0.5").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let array = Array::new(&config(folder.path())).unwrap();
    assert_eq!((array.satellites(), array.known_s()), (3, Some([0.0, 43_200.0])));
    assert!((array.inclination_rad().to_degrees() - 60.0).abs() < 0.01);
    // An orbit under J2 differs from its ellipse by some kilometres.
    assert!((array.orbit_radius_m() - 2037.1e3).abs() < 10e3);
    let truth: Vec<f64> = fs::read(folder.path().join("truth"))
        .unwrap()
        .as_chunks::<8>()
        .0
        .iter()
        .map(|&bytes| f64::from_le_bytes(bytes))
        .collect();
    assert!(truth.len() >= 10 * 20);
    for row in truth.chunks_exact(10) {
        for n in 0..3 {
            let expected: Vec3 = std::array::from_fn(|k| row[1 + 3 * n + k]);
            let state = array.state(n, row[0]);
            let error_m = norm(sub(state.position_m, expected));
            // Steps of 2 s err by some 1e-5 m in half a day, a polynomial of degree 7 over minutes by 1e-6 m.
            assert!(error_m < 1e-3, "{} {n}: {error_m} m", row[0]);
            let ahead = array.position_m(n, row[0] + 0.5);
            let behind = array.position_m(n, row[0] - 0.5);
            // A difference over a second: the third derivative, 1e-3 m/s^3, over 24.
            assert!(norm(sub(sub(ahead, behind), state.velocity_m_s)) < 1e-4);
        }
    }
    // Of each state seven numbers are kept: its time, position and velocity.
    let states = |n: u32| {
        let text = fs::read_to_string(folder.path().join(format!("sat{n}.oem"))).unwrap();
        text.lines().filter(|line| line.starts_with("20")).count()
    };
    assert_eq!(array.table_bytes(), (1..=3).map(|n| 7 * 8 * states(n) as u64).sum::<u64>());
    // Another epoch shifts all.
    let later = ArrayConfig { oem_epoch: "2030-12-31T01:00:00".into(), ..config(folder.path()) };
    let later = Array::new(&later).unwrap();
    assert_eq!(later.known_s(), Some([-3600.0, 39_600.0]));
    assert_eq!(later.position_m(1, 100.0), array.position_m(1, 3700.0));
}

/// A file of a circular orbit 300 km above the Moon, `angle` behind the first, states each minute.
fn circle(angle: f64) -> String {
    let mut text = String::from(
        "CCSDS_OEM_VERS = 2.0\nORIGINATOR = TEST\nMETA_START\nOBJECT_NAME = A\nCENTER_NAME = Moon\nREF_FRAME = ECLIPJ2000\n\
         TIME_SYSTEM = TDB\nINTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 7\nMETA_STOP\n",
    );
    for k in 0..20 {
        let phase = 7.6e-4 * 60.0 * f64::from(k) - angle;
        let (sin, cos) = phase.sin_cos();
        let (x, y, v) = (2037.1 * cos, 2037.1 * sin, 2037.1 * 7.6e-4);
        text +=
            &format!("2030-01-01T00:{k:02}:00.000 {x:.9} {y:.9} 0.0 {:.12} {:.12} 0.0\n", -v * sin, v * cos);
    }
    text
}

#[test]
fn hostile_files_are_refused_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let write = |n: usize, text: &str| fs::write(folder.path().join(format!("sat{n}.oem")), text).unwrap();
    let array = || Array::new(&config(folder.path()));
    for n in 2..=3 {
        write(n, &circle(1e-3 * n as f64));
    }
    write(1, &circle(0.0));
    array().unwrap();
    let line = |minute: usize| {
        circle(0.0).lines().find(|line| line.contains(&format!("T00:{minute:02}:"))).unwrap().to_owned()
    };
    let replace = |from: &str, to: &str| {
        assert!(circle(0.0).contains(from));
        circle(0.0).replacen(from, to, 1)
    };
    let head =
        circle(0.0).split("META_STOP\n").next().unwrap().split("META_START\n").nth(1).unwrap().to_owned();
    let segment = format!("META_START\n{head}META_STOP\n");
    let split = |at: usize, from: usize| {
        // The data again from a state, as another segment.
        let (first, rest) =
            circle(0.0).split_once(&line(at)).map(|(a, b)| (a.to_owned(), b.to_owned())).unwrap();
        let again: String = (from..20).map(|minute| line(minute) + "\n").collect();
        let _ = rest;
        format!("{first}{}\n{segment}{again}", line(at))
    };
    for (text, told) in [
        (String::new(), "expected a segment"),
        ("hello".into(), "CCSDS_OEM_VERS"),
        (replace("CENTER_NAME = Moon", "CENTER_NAME = EARTH"), "found EARTH; expected CENTER_NAME = MOON"),
        (replace("ECLIPJ2000", "ITRF2000"), "found ITRF2000; expected REF_FRAME"),
        (replace("TDB", "SCLK"), "TIME_SYSTEM"),
        (replace("HERMITE", "SPLINE"), "found SPLINE; expected INTERPOLATION"),
        (replace("DEGREE = 7", "DEGREE = 99"), "found 99; expected INTERPOLATION_DEGREE"),
        (replace(&line(5), &line(3)), "epochs in rising order"),
        (replace(&line(5), &line(4)), "epochs in rising order"),
        (replace("2030-01-01T00:05:00.000", "2030-02-31T00:05:00.000"), "expected an epoch"),
        (replace(&line(5), "2030-01-01T00:05:00.000 NaN 0 0 1 1 1"), "six finite numbers"),
        (replace(&line(5), "2030-01-01T00:05:00.000 1e999 0 0 1 1 1"), "six finite numbers"),
        (replace(&line(5), "2030-01-01T00:05:00.000 2037.1 0 0"), "six finite numbers"),
        (replace(&line(5), "2030-01-01T00:05:00.000 1700.0 0 0 1 1 1"), "expected above the Moon's surface"),
        (
            replace(&line(5), "2030-01-01T00:05:00.000 2e9 0 0 1 1 1"),
            "above the Moon's surface, within 1e6 km",
        ),
        // The velocity of escape is sqrt(2 x 4902.8 / 2037.1) = 2.194 km/s there.
        (
            replace(&line(5), "2030-01-01T00:05:00.000 2037.1 0 0 0 2.2 0"),
            "found 2.200 km/s at 2037.1 km from the Moon's centre; expected less than the velocity of escape",
        ),
        (circle(0.0).split(&line(2)).next().unwrap().to_owned(), "found 2 states"),
        (split(8, 9), "begins 60.000 s after the one before ends"),
        (split(8, 7), "begins 60.000 s before the one before ends"),
        (circle(2e-3), "satellites 1 and 2 are at one place"),
    ] {
        write(1, &text);
        let said = array().unwrap_err().to_string();
        assert!(said.contains(told) && said.contains(".oem"), "{told}: {said}");
    }
    // Segments that share an epoch are one orbit.
    write(1, &split(8, 8));
    let whole = array().unwrap();
    let circle_m = 2037.1e3;
    assert!((norm(whole.position_m(0, 480.5)) - circle_m).abs() < 1e-3);
    fs::remove_file(folder.path().join("sat1.oem")).unwrap();
    assert!(array().unwrap_err().to_string().contains("sat1.oem"));
    let few = ArrayConfig { oem: vec![PathBuf::from("a")], ..ArrayConfig::default() };
    assert!(few.problems().iter().any(|problem| problem.to_string().contains("one for each satellite")));
}
