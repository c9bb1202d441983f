use std::path::PathBuf;

use num_complex::Complex64;

use super::{AntennaTables, FittedDipole};
use crate::frames::AntennaResponse;
use crate::response::general::PairResponse;
use crate::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};

/// Lines of a table each 5 deg, fields by direction.
fn lines(dipole: usize, field: impl Fn(f64, f64) -> [Complex64; 2]) -> String {
    let mut text = String::new();
    for theta_deg in (0..=180).step_by(5) {
        for phi_deg in (0..=360).step_by(10) {
            let [a, b] = field(f64::from(theta_deg).to_radians(), f64::from(phi_deg).to_radians());
            text += &format!("2e6,{dipole},{theta_deg},{phi_deg},{},{},{},{}\n", a.re, a.im, b.re, b.im);
        }
    }
    text
}

const HEADER: &str =
    "# made by hand\nfrequency_hz,dipole,theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im\n";

fn read(texts: &[String], left_max: f64) -> Result<AntennaTables, String> {
    let folder = tempfile::tempdir().unwrap();
    let write = |(k, text): (usize, &String)| {
        let path = folder.path().join(format!("{k}.csv"));
        std::fs::write(&path, text).unwrap();
        path
    };
    let paths: Vec<PathBuf> = texts.iter().enumerate().map(write).collect();
    AntennaTables::read(&paths, left_max).map_err(|error| error.to_string())
}

/// Field of a current along z with this form of its distribution, in a medium without a body: a half-wave dipole.
fn half_wave(theta: f64) -> f64 {
    let (sin, cos) = theta.sin_cos();
    if sin < 1e-12 { 0.0 } else { (std::f64::consts::FRAC_PI_2 * cos).cos() / sin }
}

#[test]
fn a_half_wave_dipole_has_the_numbers_of_other_code() {
    // numpy 2.3 (lstsq of fields) and SciPy 1.17 (least_squares of gains), weights sin(theta), the same steps.
    let [q, left] = [-0.159_040_876, 0.001_018_897];
    let phase = Complex64::from_polar(3.0, 2.0);
    let fields = HEADER.to_owned() + &lines(1, |theta, _| [half_wave(theta) * phase, Complex64::ZERO]);
    let gains: String = (0..=180)
        .step_by(5)
        .flat_map(|theta| (0..360).step_by(10).map(move |phi| (theta, phi)))
        .map(|(theta, phi)| {
            // 0 is -inf dB, which no code writes.
            let db = (10.0 * half_wave(f64::from(theta).to_radians()).powi(2).log10()).max(-200.0);
            format!("2e6,{theta},{phi},{db}\n")
        })
        .collect();
    let gains = format!("frequency_hz,theta_deg,phi_deg,gain_db\n{gains}");
    for (text, q, left) in [(fields, q, left), (gains, -0.161_104_852, 0.001_310_502)] {
        let tables = read(std::slice::from_ref(&text), 0.02).unwrap();
        let [FittedDipole { axis, form }] = tables.dipoles_at(0, 2e6)[..] else { panic!() };
        assert!(norm(sub(axis, [0.0, 0.0, 1.0])) < 1e-6, "{axis:?}");
        // 1 + q P_2 is 1 - q / 2 across the axis, 1 + q along it.
        let expected = [1.0 - 0.5 * q, 1.0 - 0.5 * q, 1.0 + q];
        for k in 0..3 {
            assert!((form[k][k] - expected[k]).abs() < 1e-6, "{form:?}: {expected:?}");
        }
        // What is left is that of the other code to 1e-6.
        assert!(read(std::slice::from_ref(&text), left + 1e-6).is_ok());
        let said = read(&[text], left - 1e-6).unwrap_err();
        assert!(
            said.contains("at 2000000 Hz, dipole 1") && said.contains("of the table; expected at most"),
            "{said}"
        );
    }
}

/// A satellite whose three dipoles have other axes, lengths and forms than they should; the third axis and form are given by the body.
fn skew(k: usize) -> ([f64; 3], [Vec3; 3]) {
    let axis = [[0.1, -0.05, 0.9], [1.1, 0.1, 0.0], [-0.1, 1.0, 0.2]][k];
    let a = 0.1 * (k as f64 + 1.0);
    (axis, [[1.0 + a, 0.05, 0.02], [0.05, 1.0 - 0.5 * a, -0.03], [0.02, -0.03, 1.0 - 0.5 * a]])
}

fn field_of(k: usize, n: Vec3) -> Vec3 {
    let (axis, form) = skew(k);
    let factor = dot(n, [0, 1, 2].map(|row| dot(form[row], n)));
    scale(factor, sub(axis, scale(dot(axis, n), n)))
}

#[test]
fn pairs_of_skew_dipoles_respond_by_the_products_of_their_fields() {
    let phase = Complex64::cis(0.7);
    let across = |theta: f64, phi: f64| {
        let ((st, ct), (sp, cp)) = (theta.sin_cos(), phi.sin_cos());
        ([st * cp, st * sp, ct], [[ct * cp, ct * sp, -st], [-sp, cp, 0.0]])
    };
    let of_dipole = |k: usize| {
        lines(k + 1, |theta, phi| {
            let (n, basis) = across(theta, phi);
            basis.map(|e| phase * dot(field_of(k, n), e))
        })
    };
    let text = HEADER.to_owned() + &[0, 1, 2].map(of_dipole).concat();
    let tables = read(&[text], 1e-6).unwrap();
    assert_eq!((tables.dipoles(), tables.span_hz()), (Some(3), [2e6, 2e6]));
    // Lengths are relative to the root of the mean square.
    let square: f64 = (0..3).map(|k| dot(skew(k).0, skew(k).0)).sum::<f64>() / 3.0;
    let x = unit([0.3, -0.7, 0.2]);
    let y = unit(cross([0.1, 0.2, 0.9], x));
    let body = [x, y, cross(x, y)];
    let on_body = |v: Vec3| body.map(|axis| dot(axis, v));
    let antenna = |body| tables.antenna(5, 2e6, AntennaResponse::ThreeDipoles, body);
    let straight = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let response = PairResponse::of_antennas([&antenna(straight), &antenna(body)]);
    assert_eq!(response.degree(), 6);
    for n in [[0.2, 0.3, -0.7], [1.0, 0.0, 0.0], [-0.4, 0.9, 0.1]].map(unit) {
        let turned = |v: Vec3| add(add(scale(v[0], x), scale(v[1], y)), scale(v[2], body[2]));
        let product = |k: usize| dot(field_of(k, n), turned(field_of(k, on_body(n))));
        let expected = 0.5 * (product(0) + product(1) + product(2)) / square;
        assert!((response.value(n) - expected).abs() < 1e-9, "{} {expected}", response.value(n));
    }
}

#[test]
fn frequencies_between_are_linear_and_files_are_of_daughters() {
    let of = |hz: &str, x: f64| {
        let text = lines(1, |theta, phi| {
            // d = (x, 0, 1).
            let ((sin, cos), (sp, cp)) = (theta.sin_cos(), phi.sin_cos());
            [Complex64::from(x * cos * cp - sin), Complex64::from(-x * sp)]
        });
        text.replace("2e6", hz)
    };
    let first = HEADER.to_owned() + &of("1e6", 0.0) + &of("3e6", 0.4);
    let second = HEADER.to_owned() + &of("0.5e6", 0.0) + &of("2e6", 0.0);
    let tables = read(&[first, second], 1e-6).unwrap();
    assert_eq!((tables.count(), tables.span_hz()), (2, [1e6, 2e6]));
    let axis = |satellite, hz| tables.dipoles_at(satellite, hz)[0].axis;
    // Half way between unit vectors along (0, 0, 1) and (0.4, 0, 1).
    let end = unit([0.4, 0.0, 1.0]);
    assert!(norm(sub(axis(0, 2e6), unit(add(end, [0.0, 0.0, 1.0])))) < 1e-9);
    assert!(norm(sub(axis(1, 1.5e6), [0.0, 0.0, 1.0])) < 1e-9);
}

#[test]
fn tables_are_text_of_any_editor() {
    let table = HEADER.to_owned() + &lines(1, |theta, _| [Complex64::from(theta.sin()), Complex64::ZERO]);
    let file = tempfile::NamedTempFile::new().unwrap();
    let latin = [b"# caf\xe9\n", table.as_bytes()].concat();
    let marked = [b"\xef\xbb\xbf", table.as_bytes()].concat();
    for bytes in
        [latin, marked, table.replace('\n', "\r").into_bytes(), table.replace('\n', ",\r\n").into_bytes()]
    {
        std::fs::write(file.path(), &bytes).unwrap();
        AntennaTables::read(&[file.path().to_owned()], 1e-6).unwrap();
    }
    std::fs::write(file.path(), b"\x1f\x8b\x08\0").unwrap();
    let said = AntennaTables::read(&[file.path().to_owned()], 1e-6).unwrap_err().to_string();
    assert!(said.contains("a gzip file; expected CSV as plain text"), "{said}");
}

#[test]
fn what_is_no_dipole_is_refused() {
    let field = |theta: f64, phi: f64| [Complex64::from(-theta.sin()), Complex64::from(0.0 * phi)];
    let good = lines(1, field);
    let half: String = good
        .lines()
        .filter(|line| line.split(',').nth(2).unwrap().parse::<f64>().unwrap() <= 90.0)
        .map(|line| format!("{line}\n"))
        .collect();
    let lopsided = lines(1, |theta, phi| {
        [Complex64::from(theta.sin() * (1.0 + 0.3 * theta.sin() * phi.cos())), Complex64::ZERO]
    });
    let phased =
        lines(1, |theta, phi| [theta.sin() * Complex64::cis(0.3 * theta.sin() * phi.cos()), Complex64::ZERO]);
    // Nothing but the pole, which has no share of the sphere.
    let poles: String = (0..40).map(|phi_deg| format!("2e6,1,0,{phi_deg},0,0,0,0\n")).collect();
    for (text, expected) in [
        (
            format!("{HEADER}{half}"),
            "684 directions that are uneven or of a part of the sphere; expected even steps",
        ),
        (
            format!("{HEADER}{}", good.split_inclusive('\n').take(30).collect::<String>()),
            "directions; expected 40 or more",
        ),
        (format!("{HEADER}{good}2e6,1,90,0,1,0,0,0,9\n"), "line 1372: found 9 cells; expected 8"),
        (format!("{HEADER}{good}").replace("e_phi_im", "e_phi_im,dipole"), "several columns \"dipole\""),
        ("a\0,\0b\0".to_owned(), "UTF-16; expected CSV"),
        (format!("{HEADER}{lopsided}"), "of the table; expected at most 2.00 %"),
        (format!("{HEADER}{phased}"), "of the table; expected at most 2.00 %"),
        (
            format!("{HEADER}{good}2e6,1,190,0,0,0,0,0\n"),
            "line 1372: found \"190\" as theta_deg; expected 0 to 180",
        ),
        (format!("{HEADER}{good}").replace("e_phi_im", "e_phi"), "expected frequency_hz, theta_deg, phi_deg"),
        // Two values of one direction; those at 0 and 360 deg differ by rounding.
        (
            format!("{HEADER}{good}2e6,1,90,-350,1,0,0,0\n"),
            "lines 670 and 1372: found different values at theta = 90 deg, phi = 10 deg",
        ),
        (format!("{HEADER}{}", lines(1, |_, _| [Complex64::ZERO; 2])), "at 2000000 Hz, dipole 1: all zero"),
        (format!("{HEADER}{poles}"), "40 directions that are uneven"),
        (format!("{HEADER}{}\n", "9".repeat(10_000)), "... (10000 bytes)"),
        (format!("{}\n", "x".repeat(10_000)), "xxx... (10000 bytes)"),
        ("frequency_hz,theta_deg,phi_deg,gain,gain_db\n".to_owned(), "and either gain, gain_db or"),
        ("frequency_hz,theta_deg,phi_deg,gain,e_phi_re\n".to_owned(), "and either gain, gain_db or"),
        (HEADER.replace("dipole", "Dipole"), "found the column \"Dipole\"; expected its values as dipole"),
        (HEADER.to_owned(), "no directions"),
        (String::new(), "no lines"),
        (
            "frequency_hz,dipole,theta_deg,phi_deg,gain\n1e6,1,0,0,1\n1e6,2,0,0,1\n".to_owned(),
            "gains of several dipoles",
        ),
    ] {
        let said = read(&[text], 0.02).unwrap_err();
        assert!(said.contains(expected) && said.len() < 700, "{said}: expected {expected}");
    }
}
