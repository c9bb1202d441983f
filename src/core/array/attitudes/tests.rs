use std::fmt::Write;
use std::path::PathBuf;

use super::Attitudes;
use crate::units::time_scales::{Tai, TimeScale};
use crate::units::vector::{Vec3, dot, norm, sub};

/// A segment of two attitudes, of which [`BETWEEN`] is at 12:00:25.
const SEGMENT: &str = "META_START
OBJECT_NAME = DAUGHTER 1
OBJECT_ID = 2030-001A
CENTER_NAME = MOON
REF_FRAME_A = EME2000
REF_FRAME_B = SC_BODY_1
ATTITUDE_DIR = A2B
TIME_SYSTEM = TAI
START_TIME = 2030-01-31T12:00:00
STOP_TIME = 2030-01-31T12:01:00
ATTITUDE_TYPE = QUATERNION
QUATERNION_TYPE = LAST
META_STOP
DATA_START
2030-01-31T12:00:00 0.50251891 0.10050378 -0.30151134 0.80403025
2030-01-31T12:01:00 0.55232466 0.05021133 -0.25105666 0.79333905
DATA_STOP
";

/// Axes of the body on those of the ecliptic by SciPy 1.17: `Slerp` of these quaternions at 25 s of 60 s, and the matrix of the inverse
/// times that of the obliquity.
const BETWEEN: [Vec3; 3] = [
    [0.82968262, -0.50344991, -0.24117409],
    [0.53278105, 0.58516713, 0.61132952],
    [-0.16664664, -0.63570246, 0.75373157],
];

fn kvn(segments: &str) -> String {
    format!("CCSDS_AEM_VERS = 1.0\nCREATION_DATE = 2030-01-31T00:00:00\nORIGINATOR = TEST\n{segments}")
}

fn read(files: &[String]) -> Result<Attitudes, String> {
    let folder = tempfile::tempdir().unwrap();
    let written = files.iter().enumerate().map(|(k, text)| {
        let path = folder.path().join(format!("{k}.aem"));
        std::fs::write(&path, text).unwrap();
        path
    });
    let paths: Vec<PathBuf> = written.collect();
    Attitudes::read(&paths).map_err(|error| error.to_string())
}

fn tai_s(date: &str) -> f64 {
    Tai::parse(date, TimeScale::Tai).unwrap().seconds_since_1958()
}

fn assert_axes(found: Option<[Vec3; 3]>, expected: [Vec3; 3]) {
    let found = found.unwrap();
    let off = (0..3).map(|k| norm(sub(found[k], expected[k]))).fold(0.0, f64::max);
    // Quaternions above have eight digits.
    assert!(off < 3e-8, "{off:e}: {found:?}");
}

#[test]
fn attitudes_are_those_of_other_code_in_all_forms() {
    let at_s = tai_s("2030-01-31T12:00:25");
    let changed = |from: &str, to: &str| kvn(&SEGMENT.replace(from, to));
    // The same attitudes the other way round: conjugates, of rotations from B to A, from the body, or both.
    let scalar_first = SEGMENT
        .replace("LAST", "FIRST")
        .replace(
            "0.50251891 0.10050378 -0.30151134 0.80403025",
            "0.80403025 0.50251891 0.10050378 -0.30151134",
        )
        .replace(
            "0.55232466 0.05021133 -0.25105666 0.79333905",
            "0.79333905 0.55232466 0.05021133 -0.25105666",
        );
    let conjugate = SEGMENT
        .replace("0.50251891 0.10050378 -0.30151134", "-0.50251891 -0.10050378 0.30151134")
        // A quaternion and its negative are one attitude.
        .replace(
            "0.55232466 0.05021133 -0.25105666 0.79333905",
            "0.55232466 0.05021133 -0.25105666 -0.79333905",
        );
    let swapped =
        conjugate.replace("_A = EME2000", "_A = SC_BODY_1").replace("_B = SC_BODY_1", "_B = EME2000");
    let both = SEGMENT
        .replace("_A = EME2000", "_A = SC_BODY_1")
        .replace("_B = SC_BODY_1", "_B = EME2000")
        .replace("A2B", "B2A");
    // 37 s, the leap seconds since 1958, earlier by name.
    let utc =
        SEGMENT.replace("= TAI", "= UTC").replace("T12:00:00", "T11:59:23").replace("T12:01:00", "T12:00:23");
    for text in [
        kvn(SEGMENT),
        kvn(&scalar_first),
        kvn(&conjugate.replace("A2B", "B2A")),
        kvn(&swapped),
        kvn(&both),
        kvn(&utc),
        changed("_TYPE = QUATERNION\n", "_TYPE = QUATERNION/RATE\n")
            .replace("0.80403025", "0.80403025 0.1 0.2 0.3"),
        changed("ATTITUDE_DIR = A2B\n", "")
            .replace("VERS = 1.0", "VERS = 2.0")
            .replace("QUATERNION_TYPE = LAST\n", ""),
        xml(),
    ] {
        assert_axes(read(std::slice::from_ref(&text)).unwrap().body_axes(0, at_s), BETWEEN);
    }
}

fn xml() -> String {
    let state = |epoch: &str, q: [&str; 4]| {
        let [a, b, c, d] = q;
        format!(
            "<attitudeState><quaternionState><EPOCH>{epoch}</EPOCH><quaternion><QC>{d}</QC><Q1>{a}</Q1><Q2>{b}</Q2><Q3>{c}</Q3>\
             </quaternion></quaternionState></attitudeState>"
        )
    };
    format!(
        "<?xml version=\"1.0\"?><aem id=\"CCSDS_AEM_VERS\" version=\"1.0\"><header/><body><segment><metadata>\
         <OBJECT_ID>2030-001A</OBJECT_ID><REF_FRAME_A>EME2000</REF_FRAME_A><REF_FRAME_B>SC_BODY_1</REF_FRAME_B>\
         <TIME_SYSTEM>TAI</TIME_SYSTEM><ATTITUDE_TYPE>quaternion</ATTITUDE_TYPE><QUATERNION_TYPE>FIRST</QUATERNION_TYPE>\
         </metadata><data>{}{}</data></segment></body></aem>",
        state("2030-01-31T12:00:00", ["0.50251891", "0.10050378", "-0.30151134", "0.80403025"]),
        state("2030-01-31T12:01:00", ["0.55232466", "0.05021133", "-0.25105666", "0.79333905"]),
    )
}

#[test]
fn objects_are_satellites_and_know_their_times() {
    let second = SEGMENT.replace("001A", "001B");
    let later = SEGMENT.replace("T12:0", "T12:3");
    let found = read(&[kvn(&format!("{SEGMENT}{second}")), kvn(&later)]).unwrap();
    assert_eq!(found.objects().collect::<Vec<_>>(), ["2030-001A", "2030-001B"]);
    let at = |satellite, date: &str| found.body_axes(satellite, tai_s(date));
    assert_axes(at(0, "2030-01-31T12:00:25"), BETWEEN);
    assert_axes(at(0, "2030-01-31T12:30:25"), BETWEEN);
    let known = |satellite, date: &str| found.first_unknown_s(satellite, [tai_s(date); 2]).is_none();
    for (satellite, date) in [
        (0, "2030-01-31T11:59:58"),
        (0, "2030-01-31T12:15:00"),
        (1, "2030-01-31T12:30:25"),
        (2, "2030-01-31T12:00:25"),
    ] {
        assert!(!known(satellite, date), "{satellite} {date}");
    }
    // A time tag's error beyond the ends is allowed.
    assert!(known(0, "2030-01-31T12:01:00.9") && !known(0, "2030-01-31T12:01:01.1"));
    // Both ends of an interval may be known, and what is between them not: from the end of the first segment on.
    let first_unknown = |satellite, from: &str, until: &str| {
        let [from, until] = [from, until].map(|time| tai_s(&format!("2030-01-31T{time}")));
        found.first_unknown_s(satellite, [from, until])
    };
    assert_eq!(first_unknown(0, "12:00:10", "12:30:25"), Some(tai_s("2030-01-31T12:01:01")));
    assert_eq!(first_unknown(0, "12:02:00", "12:30:25"), Some(tai_s("2030-01-31T12:02:00")));
    assert_eq!(first_unknown(0, "12:30:10", "12:40:00"), Some(tai_s("2030-01-31T12:31:01")));
    assert_eq!(first_unknown(0, "12:30:10", "12:30:50"), None);
    // A segment that begins where another ends leaves no gap.
    let next = SEGMENT.replace("T12:01:00", "T12:02:00").replace("T12:00:00", "T12:01:00");
    let whole = read(&[kvn(&format!("{next}{SEGMENT}"))]).unwrap();
    let [from, until] = ["2030-01-31T12:00:10", "2030-01-31T12:01:50"].map(tai_s);
    assert_eq!(whole.first_unknown_s(0, [from, until]), None);
    let said = found.known_utc(0);
    assert!(
        said.starts_with("2030-01-31T11:59:23.000") && said.ends_with("2030-01-31T12:30:23.000"),
        "{said}"
    );
}

#[test]
fn a_steady_turn_is_met_between_states_by_any_method() {
    // A turn about a skew axis, at the rate of a low orbit.
    let axis = [0.48, 0.6, 0.64];
    let attitude = |angle_rad: f64| {
        let (sin, cos) = (0.5 * angle_rad).sin_cos();
        format!("{:.12} {:.12} {:.12} {:.12}", axis[0] * sin, axis[1] * sin, axis[2] * sin, cos)
    };
    let rate = std::f64::consts::TAU / 8249.0;
    for method in [
        "",
        "INTERPOLATION_METHOD = LAGRANGE\nINTERPOLATION_DEGREE = 5\n",
        "INTERPOLATION_METHOD = hermite\nINTERPOLATION_DEGREE = 3\n",
    ] {
        let mut data = String::new();
        for k in 0..9 {
            let _ = writeln!(data, "2030-01-31T12:{:02}:00 {}", 5 * k, attitude(rate * 300.0 * f64::from(k)));
        }
        let head = SEGMENT.split("META_STOP").next().unwrap().replace("EME2000", "ECLIPJ2000");
        let head = head.replace("STOP_TIME = 2030-01-31T12:01:00\n", "");
        let text = kvn(&format!("{head}{method}META_STOP\n{data}"));
        let found = read(&[text]).unwrap();
        for t_s in [10.0_f64, 150.0, 1250.0, 2390.0] {
            let axes = found.body_axes(0, tai_s("2030-01-31T12:00:00") + t_s).unwrap();
            // The axis of the turn is the same on both; the trace of a rotation is 1 + 2 cos of its angle.
            let turned = [0, 1, 2].map(|k| dot(axes[k], axis));
            assert!(norm(sub(turned, axis)) < 1e-9, "{turned:?}");
            let trace = axes[0][0] + axes[1][1] + axes[2][2];
            assert!((trace - 1.0 - 2.0 * (rate * t_s).cos()).abs() < 1e-9, "{method} {t_s}");
        }
    }
}

#[test]
fn what_is_no_attitude_is_told_by_line() {
    let changed = |from: &str, to: &str| {
        assert!(SEGMENT.contains(from), "{from}");
        kvn(&SEGMENT.replace(from, to))
    };
    let long = "X".repeat(10_000);
    for text in [changed("EME2000", &long), kvn(&format!("{SEGMENT}{SEGMENT}").replace("2030-001A", &long))] {
        let said = read(&[text]).unwrap_err();
        assert!(said.contains("XXX... (10000 bytes)") && said.len() < 700, "{said}");
    }
    for (text, expected) in [
        (
            kvn(SEGMENT).replace("AEM_VERS = 1.0", "AEM_VERS = 7.0"),
            "line 1: found \"CCSDS_AEM_VERS = 7.0\"; expected CCSDS_AEM_VERS = 2.0 or 1.0",
        ),
        (changed("EME2000", "MOON_ME"), "line 8: found MOON_ME; expected REF_FRAME_A = EME2000"),
        (changed("SC_BODY_1", "LVLH"), "line 9: found LVLH; expected SC_BODY_1"),
        (changed("A2B", "AB"), "line 10: found AB; expected ATTITUDE_DIR"),
        (changed("= TAI", "= MET"), "line 11: found MET; expected TIME_SYSTEM"),
        (changed("= QUATERNION\n", "= SPIN\n"), "line 14: found SPIN; expected ATTITUDE_TYPE"),
        (changed("LAST", "MIDDLE"), "line 15: found MIDDLE; expected QUATERNION_TYPE"),
        (changed("T12:01:00 0", "T11:59:00 0"), "epochs in rising order"),
        (changed("0.80403025", "0.9"), "line 18: found a quaternion of length 1.07"),
        (changed("0.80403025", "0.8 0.7"), "an epoch and the four finite numbers"),
        (changed("0.55232466 0.05021133 -0.25105666 0.79333905", "0.5 -0.5 0.5 0.5"), "at most 60 deg"),
        (
            changed("META_STOP", "INTERPOLATION_METHOD = LAGRANGE\nINTERPOLATION_DEGREE = 7\nMETA_STOP"),
            "found 2 attitudes; expected 8",
        ),
        (changed("META_STOP", "TIME_SYSTEM = UTC\nMETA_STOP"), "line 16: found TIME_SYSTEM again"),
        (
            changed("STOP_TIME = 2030-01-31", "STOP_TIME = 2030-01-30"),
            "line 13: found STOP_TIME = 2030-01-30",
        ),
        (
            changed("META_STOP", "USEABLE_STOP_TIME = 2030-01-31T12:02:00\nMETA_STOP"),
            "one that fits the states",
        ),
        (kvn(&format!("{SEGMENT}{SEGMENT}")), "overlap by 60.000 s"),
        (
            changed("DATA_STOP\n", "2030-01-31T12:02:00 0.5 0.1 -0.3 0.8062\n"),
            "in which the interpolation errs by some",
        ),
        (kvn(""), "expected a segment"),
    ] {
        let said = read(&[text]).unwrap_err();
        assert!(said.contains(expected), "{said}: expected {expected}");
    }
}
