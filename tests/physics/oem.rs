//! Orbits from CCSDS OEM files: as other code integrated them, and files that are refused.

mod dates;

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

/// Angular speed of the circle, rad/s: sqrt(GM / r^3).
const RATE: f64 = 7.615e-4;

/// A file of a circular orbit 300 km above the Moon, `angle` behind the first, states each minute.
fn circle(angle: f64) -> String {
    let mut text = String::from(
        "CCSDS_OEM_VERS = 2.0\nORIGINATOR = TEST\nMETA_START\nOBJECT_NAME = A\nCENTER_NAME = Moon\nREF_FRAME = ECLIPJ2000\n\
         TIME_SYSTEM = TDB\nINTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 7\nMETA_STOP\n",
    );
    for k in 0..20 {
        let phase = RATE * 60.0 * f64::from(k) - angle;
        let (sin, cos) = phase.sin_cos();
        let (x, y, v) = (2037.1 * cos, 2037.1 * sin, 2037.1 * RATE);
        text +=
            &format!("2030-01-01T00:{k:02}:00.000 {x:.9} {y:.9} 0.0 {:.12} {:.12} 0.0\n", -v * sin, v * cos);
    }
    text
}

/// The file of [`circle`] with lines more in its metadata.
fn circle_with(angle: f64, lines: &str) -> String {
    circle(angle).replacen("META_STOP", &format!("{lines}META_STOP"), 1)
}

/// The states of [`circle`] on the axes MOON_ME_DE421 and MOON_PA_DE421, which turn with the Moon.
///
/// By NAIF's toolkit with JPL's DE421: `pip install lunarsky spiceypy`, `furnsh` of `moon_pa_de421_1900-2050.bpc` and `moon_080317.tf` in
/// `lunarsky/data`, `sxform("ECLIPJ2000", frame, 946728000 + 60 k) @ state`.
#[rustfmt::skip]
const FIXED_TO_THE_MOON: [[&str; 8]; 2] = [
    [
        "2030-01-01T00:00:00 1071.18759 -1731.89612 53.56651 1.314738294 0.813044660 -0.004152876",
        "2030-01-01T00:01:00 1148.93454 -1681.33549 53.26151 1.276378952 0.872018505 -0.006011926",
        "2030-01-01T00:02:00 1224.30015 -1627.29005 52.84533 1.235374116 0.929184958 -0.007858429",
        "2030-01-01T00:03:00 1297.12822 -1569.87182 52.31883 1.191808772 0.984425533 -0.009688531",
        "2030-01-01T00:04:00 1367.26780 -1509.19980 51.68311 1.145773218 1.037625736 -0.011498411",
        "2030-01-01T00:05:00 1434.57351 -1445.39975 50.93950 1.097362868 1.088675302 -0.013284291",
        "2030-01-01T00:06:00 1498.90585 -1378.60389 50.08955 1.046678059 1.137468423 -0.015042443",
        "2030-01-01T00:07:00 1560.13148 -1308.95069 49.13503 0.993823845 1.183903969 -0.016769197",
    ],
    [
        "2030-01-01T00:00:00 1070.59677 -1732.24867 53.97701 1.315007433 0.812611685 -0.003653314",
        "2030-01-01T00:01:00 1148.36047 -1681.71365 53.70155 1.276668224 0.871598155 -0.005527060",
        "2030-01-01T00:02:00 1223.74403 -1627.69302 53.31399 1.235682920 0.928778104 -0.007389263",
        "2030-01-01T00:03:00 1296.59119 -1570.29878 52.81515 1.192136469 0.984033019 -0.009236038",
        "2030-01-01T00:04:00 1366.75098 -1509.64986 52.20605 1.146119127 1.037248375 -0.011063529",
        "2030-01-01T00:05:00 1434.07798 -1445.87197 51.48798 1.097726274 1.088313876 -0.012867921",
        "2030-01-01T00:06:00 1498.43263 -1379.09731 50.66244 1.047058208 1.137123682 -0.014645448",
        "2030-01-01T00:07:00 1559.68155 -1309.46427 49.73114 0.994219949 1.183576627 -0.016392400",
    ],
];

#[test]
fn axes_that_are_fixed_to_the_moon_turn_with_it() {
    let folder = tempfile::tempdir().unwrap();
    for n in 1..=3 {
        fs::write(folder.path().join(format!("sat{n}.oem")), circle(1e-3 * f64::from(n))).unwrap();
    }
    let head = circle(0.0).split("2030").next().unwrap().to_owned();
    let read = |frame: &str, states: [&str; 8]| {
        let text = head.replace("ECLIPJ2000", frame) + &states.join("\n");
        fs::write(folder.path().join("sat1.oem"), text).unwrap();
        Array::new(&config(folder.path())).unwrap()
    };
    let [mean, principal] = FIXED_TO_THE_MOON;
    for (frame, states) in
        [("MOON_ME", mean), ("IAU_MOON", mean), ("MOON_PA421", principal), ("Moon_PA_DE421", principal)]
    {
        let array = read(frame, states);
        for t_s in [0.0, 150.0, 420.0] {
            let (sin, cos) = (RATE * t_s).sin_cos();
            let state = array.state(0, t_s);
            // The orientation is good to 0.005 degrees: 180 m, and 0.14 m/s of 1551 m/s. The turning itself is 5.4 m/s.
            let off_m = norm(sub(state.position_m, [2037.1e3 * cos, 2037.1e3 * sin, 0.0]));
            assert!(off_m < 180.0, "{frame} {t_s}: {off_m} m");
            let speed = 2037.1e3 * RATE;
            let off_m_s = norm(sub(state.velocity_m_s, [-speed * sin, speed * cos, 0.0]));
            assert!(off_m_s < 0.14, "{frame} {t_s}: {off_m_s} m/s");
        }
    }
    // Both frames have the same error: a file on the wrong one is 103 arc seconds off, 1 km at most.
    let [right, wrong] = ["MOON_ME", "MOON_PA"].map(|frame| read(frame, mean).position_m(0, 0.0));
    let off_m = norm(sub(right, wrong));
    assert!((400.0..1100.0).contains(&off_m), "{off_m} m");
}

#[test]
fn an_epoch_that_ends_with_z_is_utc() {
    let folder = tempfile::tempdir().unwrap();
    for n in 1..=3 {
        fs::write(folder.path().join(format!("sat{n}.oem")), circle(1e-3 * f64::from(n))).unwrap();
    }
    let begins = |epoch: &str| {
        let config = ArrayConfig { oem_epoch: epoch.into(), ..config(folder.path()) };
        Array::new(&config).map(|array| array.known_s().unwrap()[0]).map_err(|error| error.to_string())
    };
    // TDB is ahead of UTC by 37 s + 32.184 s, and less than 2 ms of relativity.
    let apart_s = begins("2030-01-01T00:10:00").unwrap() - begins("2030-01-01T00:10:00Z").unwrap();
    assert!((apart_s - 69.184).abs() < 2e-3, "{apart_s}");
    let said = begins("2030-01-01T23:59:60Z").unwrap_err();
    assert!(said.contains("a date on UTC"), "{said}");
}

#[test]
fn what_is_said_twice_or_of_other_times_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let write = |n: usize, bytes: &[u8]| fs::write(folder.path().join(format!("sat{n}.oem")), bytes).unwrap();
    let array = || Array::new(&config(folder.path())).map_err(|error| error.to_string());
    for n in 2..=3 {
        write(n, circle(1e-3 * n as f64).as_bytes());
    }
    // The states go to 00:19: the beginning of a file that promises more is known as far as it goes. Line ends are those of any system.
    let whole = "START_TIME = 2029-12-31T23:59:30\nSTOP_TIME = 2030-01-02T00:00:00\n";
    let good = circle_with(0.0, whole);
    for text in [good.clone(), good.replace('\n', "\r\n"), good.replace('\n', "\r")] {
        write(1, text.as_bytes());
        array().unwrap();
    }
    let wide: Vec<u8> = good.bytes().flat_map(|byte| [byte, 0]).collect();
    for (bytes, told) in [
        (
            circle_with(0.0, "TIME_SYSTEM = TAI\n").into_bytes(),
            "line 10: found TIME_SYSTEM again; expected TIME_SYSTEM once",
        ),
        (
            circle_with(0.0, "STOP_TIME = 2030-01-01T00:10:00\n").into_bytes(),
            "line 10: found STOP_TIME = 2030-01-01T00:10:00.000",
        ),
        (
            circle_with(0.0, "START_TIME = 2030-01-01T00:10:00\n").into_bytes(),
            "line 10: found START_TIME = 2030-01-01T00:10",
        ),
        (circle_with(0.0, "STOP_TIME = soon\n").into_bytes(), "STOP_TIME = a date on TDB"),
        (wide, "text in UTF-16; expected text as ASCII or UTF-8"),
        (b"\x28\xb5\x2f\xfd\0".to_vec(), "a zstd file; expected text"),
    ] {
        write(1, &bytes);
        let said = array().unwrap_err();
        assert!(said.contains(told) && said.contains("sat1.oem"), "{said}: expected {told}");
    }
    // A device is not read, and a pipe not waited for.
    let endless = ArrayConfig { oem: vec!["/dev/zero".into(); 3], ..config(folder.path()) };
    let said = Array::new(&endless).unwrap_err().to_string();
    assert!(said.contains("/dev/zero") && said.contains("a device; expected a file"), "{said}");
}

#[test]
fn a_step_of_a_state_is_seen_and_rounding_is_not() {
    let folder = tempfile::tempdir().unwrap();
    for n in 2..=3 {
        fs::write(folder.path().join(format!("sat{n}.oem")), circle(1e-3 * f64::from(n))).unwrap();
    }
    // The file with each position x, km, as `change` of the minute and x has it, and numbers rounded to these decimals.
    let read = |change: &dyn Fn(usize, f64) -> f64, decimals: [usize; 2]| {
        let row = |line: &str| -> String {
            let Some((date, numbers)) = line.split_once(' ').filter(|_| line.starts_with("2030")) else {
                return format!("{line}\n");
            };
            let minute = date[14..16].parse().unwrap();
            let mut six: Vec<f64> = numbers.split(' ').map(|number| number.parse().unwrap()).collect();
            six[0] = change(minute, six[0]);
            let six = six.iter().enumerate().map(|(k, number)| format!("{number:.*}", decimals[k / 3]));
            format!("{date} {}\n", six.collect::<Vec<_>>().join(" "))
        };
        fs::write(folder.path().join("sat1.oem"), circle(0.0).lines().map(row).collect::<String>()).unwrap();
        Array::new(&config(folder.path())).map_err(|error| error.to_string())
    };
    // One state, and all from one on: each neighbour has half of that step, on its side.
    let one =
        |at: usize, step_km: f64| move |minute: usize, x: f64| if minute == at { x + step_km } else { x };
    let from =
        |at: usize, step_km: f64| move |minute: usize, x: f64| if minute >= at { x + step_km } else { x };
    let told = "a position at 2030-01-01T00:09:00.000 TDB that is 10.0 m from where its neighbours have it";
    let said = read(&one(9, 0.01), [9, 12]).unwrap_err();
    assert!(said.contains(told), "{said}");
    // Also beside the ends, where the interpolation shows it.
    for at in [1, 2, 17, 18] {
        read(&one(at, 0.01), [9, 12]).unwrap_err();
    }
    let said = read(&from(9, -0.01), [9, 12]).unwrap_err();
    assert!(said.contains("m from where its neighbours have it"), "{said}");
    // Metres and millimetres a second, and a step as large as the tolerance.
    read(&|_, x| x, [3, 6]).unwrap();
    read(&one(9, 0.0019), [9, 12]).unwrap();
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
        (replace("ECLIPJ2000", "ITRF2000"), "line 6: found ITRF2000; expected REF_FRAME"),
        (replace("ECLIPJ2000", "MOON_MEIAUE"), "line 6: found MOON_MEIAUE; expected REF_FRAME"),
        (replace("TDB", "SCLK"), "line 7: found SCLK; expected TIME_SYSTEM"),
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
        (split(8, 7), "begins 60.000 s before the one before ends"),
        (circle(2e-3), "satellites 1 and 2 are at one place"),
    ] {
        write(1, &text);
        let said = array().unwrap_err().to_string();
        assert!(said.contains(told) && said.contains(".oem"), "{told}: {said}");
    }
    // What lies after a gap between segments is not known.
    write(1, &split(8, 9));
    let until_gap = array().unwrap();
    let known_s = until_gap.known_s().unwrap();
    assert!((known_s[1] - 480.0).abs() < 1e-6, "{known_s:?}");
    until_gap.require_known(480.0).unwrap();
    let said = until_gap.require_known(600.0).unwrap_err().to_string();
    assert!(said.contains("t = 600 s") && said.contains("0.000 s to 480.000 s"), "{said}");
    assert!(until_gap.position_m(0, 600.0)[0].is_nan());
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
