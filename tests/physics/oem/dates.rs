//! Dates, time systems and segments of OEM files.

use super::*;

/// A file of a circular orbit 300 km above the Moon, in a plane that holds the pole; states at some times after a date of a time system.
struct FlownOrbit<'a> {
    frame: &'a str,
    scale: &'a str,
    metadata: &'a str,
}

const MADE: FlownOrbit<'_> = FlownOrbit {
    frame: "ECLIPJ2000",
    scale: "UTC",
    metadata: "INTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 7\n",
};

impl FlownOrbit<'_> {
    /// Metadata and states `(label, seconds after the first, velocity scaled)`.
    fn segment(&self, angle: f64, states: &[(String, f64)]) -> String {
        let Self { frame, scale, metadata } = self;
        let mut text = format!(
            "META_START\nOBJECT_NAME = A\nCENTER_NAME = MOON\nREF_FRAME = {frame}\nTIME_SYSTEM = {scale}\n{metadata}META_STOP\n"
        );
        for (label, s) in states {
            let (sin, cos) = (RATE * s - angle).sin_cos();
            let v = 2037.1 * RATE;
            text += &format!(
                "{label} {:.9} 0.0 {:.9} {:.12} 0.0 {:.12}\n",
                2037.1 * cos,
                2037.1 * sin,
                -v * sin,
                v * cos
            );
        }
        text
    }

    fn file(&self, angle: f64, states: &[(String, f64)]) -> String {
        format!("CCSDS_OEM_VERS = 2.0\nORIGINATOR = TEST\n{}", self.segment(angle, states))
    }
}

/// Dates of minutes from 2024-03-01T00:00:00 on, and the seconds of each.
fn minutes(range: std::ops::Range<u32>) -> Vec<(String, f64)> {
    range.map(|k| (format!("2024-03-01T{:02}:{:02}:00.000", k / 60, k % 60), f64::from(60 * k))).collect()
}

/// The array of three files whose satellites are 1 mrad apart.
fn array_of(folder: &Path, text: impl Fn(f64) -> Vec<u8>) -> Result<Array, lunarray::array::ArrayError> {
    for n in 1..=3 {
        fs::write(folder.join(format!("sat{n}.oem")), text(1e-3 * f64::from(n))).unwrap();
    }
    Array::new(&config(folder))
}

fn radius_off_m(array: &Array, t_s: f64) -> f64 {
    let [x, y, z] = array.position_m(0, t_s);
    let (sin, cos) = (RATE * t_s - 1e-3).sin_cos();
    norm(sub([x, y, z], [2037.1e3 * cos, 0.0, 2037.1e3 * sin]))
}

#[test]
fn dates_of_files_are_those_of_the_mission_in_every_time_system() {
    let folder = tempfile::tempdir().unwrap();
    // TAI of 2024-03-01T00:00:00 on each scale, s since 1958: 24,166 days, and what astropy 8.0.2 has for `Time(.., scale=..).tai`.
    for (scale, offset_s, tolerance_s) in
        // A date in f64 seconds since 1958 is known to 5e-7 s, the series of TDB to 1e-5 s.
        [
            ("UTC", 37.0, 1e-6),
            ("TAI", 0.0, 1e-6),
            ("TT", -32.184, 1e-6),
            ("TDB", -32.185_359_606, 1e-5),
            ("GPS", 19.0, 1e-6),
        ]
    {
        let array =
            array_of(folder.path(), |u| FlownOrbit { scale, ..MADE }.file(u, &minutes(0..61)).into_bytes())
                .unwrap();
        let epoch_s = array.epoch_tai_s().unwrap();
        assert!((epoch_s - 24_166.0 * 86_400.0 - offset_s).abs() < tolerance_s, "{scale}: {epoch_s}");
        assert!(radius_off_m(&array, 1234.5) < 1e-2, "{scale}");
    }
    // By the dates: ecliptic longitude 40.146 and latitude 2.164 degrees (astropy 8.0.2 with DE421).
    let array = array_of(folder.path(), |u| MADE.file(u, &minutes(0..61)).into_bytes()).unwrap();
    let [x, y, z] = array.earth_hat(0.0);
    let place_deg = [y.atan2(x), z.asin()].map(f64::to_degrees);
    assert!((place_deg[0] - 40.146).abs() < 0.01 && (place_deg[1] - 2.164).abs() < 0.01, "{place_deg:?}");
    let [x, y, _] = array.sun_hat(0.0).unwrap();
    assert!((y.atan2(x).to_degrees().rem_euclid(360.0) - 340.692).abs() < 0.01);
}

#[test]
fn utc_goes_through_a_leap_second() {
    let folder = tempfile::tempdir().unwrap();
    let label = |k: u32| match k {
        0..30 => format!("2016-12-31T23:{:02}:00", 30 + k),
        30 => "2016-12-31T23:59:60".to_owned(),
        _ => format!("2017-01-01T00:{:02}:59", k - 31),
    };
    let states: Vec<(String, f64)> = (0..61).map(|k| (label(k), f64::from(60 * k))).collect();
    let array = array_of(folder.path(), |u| MADE.file(u, &states).into_bytes()).unwrap();
    for k in 0..200 {
        assert!(radius_off_m(&array, 18.0 * f64::from(k)) < 1e-2, "{k}");
    }
    let known_s = array.known_s().unwrap();
    assert!((known_s[1] - 3600.0).abs() < 1e-6, "{known_s:?}");
    // The same labels have no second 60 on TAI.
    let said = array_of(folder.path(), |u| FlownOrbit { scale: "TAI", ..MADE }.file(u, &states).into_bytes());
    assert!(said.unwrap_err().to_string().contains("2016-12-31T23:59:60"));
}

#[test]
fn useable_times_say_which_segment_holds() {
    let folder = tempfile::tempdir().unwrap();
    let useable = |from: &str, until: &str| {
        format!(
            "USEABLE_START_TIME = 2024-03-01T{from}:00\nUSEABLE_STOP_TIME = 2024-03-01T{until}:00\n{}",
            MADE.metadata
        )
    };
    // Padding before and after: the mission begins with what is useable.
    let metadata = useable("00:10", "01:10");
    let padded = FlownOrbit { metadata: &metadata, ..MADE };
    let array = array_of(folder.path(), |u| padded.file(u, &minutes(0..81)).into_bytes()).unwrap();
    let known_s = array.known_s().unwrap();
    assert!(known_s[0].abs() < 1e-6 && (known_s[1] - 3600.0).abs() < 1e-6, "{known_s:?}");
    assert!((array.epoch_tai_s().unwrap() - (24_166.0 * 86_400.0 + 637.0)).abs() < 1e-6);
    let [x, _, z] = array.position_m(0, 0.0);
    assert!((z.atan2(x) - (600.0 * RATE - 1e-3)).abs() < 1e-9);
    // Segments that overlap: the second is of another orbit until it is useable.
    let (first, second) = (useable("00:00", "00:30"), useable("00:30", "01:00"));
    let two = |u: f64| {
        let later = FlownOrbit { metadata: &second, ..MADE }.segment(u, &minutes(25..61));
        FlownOrbit { metadata: &first, ..MADE }.file(u, &minutes(0..36)) + &later
    };
    let array = array_of(folder.path(), |u| two(u).into_bytes()).unwrap();
    assert!((array.known_s().unwrap()[1] - 3600.0).abs() < 1e-6);
    for k in 0..200 {
        assert!(radius_off_m(&array, 18.0 * f64::from(k)) < 1e-2, "{k}");
    }
    // Without them an overlap is refused, as are useable times that no state has.
    let told = |text: String| array_of(folder.path(), |_| text.clone().into_bytes()).unwrap_err().to_string();
    let plain = MADE.file(1e-3, &minutes(0..36)) + &MADE.segment(1e-3, &minutes(25..61));
    assert!(told(plain).contains("begins 600.000 s before the one before ends"));
    let metadata = useable("00:00", "02:10");
    let said = told(FlownOrbit { metadata: &metadata, ..MADE }.file(1e-3, &minutes(0..81)));
    assert!(
        said.contains(
            "line 9: found USEABLE_STOP_TIME = 2024-03-01T02:10:00.000; expected one that fits the states"
        ),
        "{said}"
    );
}

#[test]
fn states_that_do_not_fit_each_other_are_refused_with_time_and_error() {
    let folder = tempfile::tempdir().unwrap();
    let all = minutes(0..180);
    let of = |states: &[(String, f64)]| MADE.file(1e-3, states);
    let some = |keep: &dyn Fn(usize) -> bool| -> Vec<(String, f64)> {
        all.iter().enumerate().filter(|(k, _)| keep(*k)).map(|(_, state)| state.clone()).collect()
    };
    let changed = |k: usize, change: &dyn Fn(&mut [f64])| {
        let line = of(&all).lines().find(|line| line.starts_with(&all[k].0)).unwrap().to_owned();
        let mut numbers: Vec<f64> = line.split(' ').skip(1).map(|x| x.parse().unwrap()).collect();
        change(&mut numbers);
        let numbers: Vec<String> = numbers.iter().map(f64::to_string).collect();
        of(&all).replacen(&line, &format!("{} {}", all[k].0, numbers.join(" ")), 1)
    };
    let every = |change: &dyn Fn(&mut [f64])| {
        let mut text = of(&[]);
        for line in of(&all).lines().filter(|line| line.starts_with("2024")) {
            let (label, numbers) = line.split_once(' ').unwrap();
            let mut numbers: Vec<f64> = numbers.split(' ').map(|x| x.parse().unwrap()).collect();
            change(&mut numbers);
            let numbers: Vec<String> = numbers.iter().map(f64::to_string).collect();
            text += &format!("{label} {}\n", numbers.join(" "));
        }
        text
    };
    let lagrange = "INTERPOLATION = LAGRANGE\nINTERPOLATION_DEGREE = 7\n";
    let coarse: Vec<(String, f64)> =
        (0..11).map(|k| (format!("2024-03-01T{k:02}:00:00"), 3600.0 * f64::from(k))).collect();
    for (text, told) in [
        (
            of(&some(&|k| !(60..120).contains(&k))),
            "a gap of 3660.000 s (the states beside it are 60.000 s apart) from 2024-03-01T00:59:00.000 UTC",
        ),
        (FlownOrbit { metadata: lagrange, ..MADE }.file(1e-3, &coarse), "3600.000 s from 2024-03-01T"),
        (
            of(&some(&|k| k % 30 == 0)),
            "1800.000 s from 2024-03-01T00:00:00.000 UTC to 2024-03-01T00:30:00.000 UTC, between which the interpolation errs by",
        ),
        (
            every(&|x| x[3..].fill(0.0)),
            "a velocity of 0.000 m/s at 2024-03-01T00:00:00.000 UTC that differs by 1551",
        ),
        // A percent too fast: 15.5 m/s of 1551.
        (every(&|x| x[3..].iter_mut().for_each(|v| *v *= 1.01)), "differs by 15.51"),
        (changed(70, &|x| x[5] += 1e-3), "2024-03-01T01:10:00.000 UTC that differs by 1.000 m/s"),
        (
            changed(70, &|x| x[0] += 0.1),
            "60.000 s from 2024-03-01T01:09:00.000 UTC to 2024-03-01T01:10:00.000 UTC, between which the interpolation errs by",
        ),
    ] {
        let said = array_of(folder.path(), |_| text.clone().into_bytes()).unwrap_err().to_string();
        assert!(said.contains(told), "{told}: {said}");
    }
    // A state that is missing here and there does no harm, nor do positions that are rounded to a metre.
    array_of(folder.path(), |u| MADE.file(u, &some(&|k| k % 9 != 5)).into_bytes()).unwrap();
    let rounded = |u: f64| {
        let text = MADE.file(u, &all);
        let line = |line: &str| match line.starts_with("2024") {
            false => line.to_owned(),
            true => {
                let x: Vec<&str> = line.split(' ').collect();
                let places: Vec<String> =
                    (1..4).map(|k| format!("{:.3}", x[k].parse::<f64>().unwrap())).collect();
                format!("{} {} {}", x[0], places.join(" "), x[4..].join(" "))
            }
        };
        text.lines().map(line).collect::<Vec<_>>().join("\n")
    };
    array_of(folder.path(), |u| rounded(u).into_bytes()).unwrap();
}

#[test]
fn files_are_read_as_others_write_them() {
    let folder = tempfile::tempdir().unwrap();
    let states = minutes(0..61);
    let same = |text: &dyn Fn(f64) -> Vec<u8>| {
        let array = array_of(folder.path(), text).unwrap();
        assert!(radius_off_m(&array, 1234.5) < 1e-3);
        array
    };
    // A mark of byte order, lines of Windows, a comment in another encoding.
    same(&|u| {
        let text = MADE
            .file(u, &states)
            .replace("ORIGINATOR", "COMMENT i = 90DEG\nORIGINATOR")
            .replace('\n', "\r\n");
        let at = text.find("DEG").unwrap();
        [b"\xef\xbb\xbf", &text.as_bytes()[..at], b"\xb0", &text.as_bytes()[at + 3..]].concat()
    });
    // SANA's names of the axes of J2000: y and z of the equator are 23.439291 degrees from those of the ecliptic.
    for frame in ["EME2000", "J2000", "ICRF", "ICRF1", "ICRF2", "ICRF3", "GCRF", "GCRF3", "icrf3"] {
        let array =
            array_of(folder.path(), |u| FlownOrbit { frame, ..MADE }.file(u, &states).into_bytes()).unwrap();
        let [_, y, z] = array.position_m(0, 1234.5);
        let off = y.atan2(z).to_degrees() - 23.439_291;
        assert!(off.abs() < 1e-6, "{frame}: {off}");
    }
    // Covariances are passed over, and that is said.
    let array = same(&|u| {
        (MADE.file(u, &states) + "COVARIANCE_START\nEPOCH = 2024-03-01T00:00:00\n1.0\n0.0 1.0\nEPOCH = 2024-03-01T00:01:00\n1.0\nCOVARIANCE_STOP\n").into_bytes()
    });
    assert!(
        array.notes().len() == 3 && array.notes()[0].ends_with("sat1.oem: 2 covariances are not used"),
        "{:?}",
        array.notes()
    );
    // XML, alone and in a navigation data message.
    let xml = |u: f64, units: &str| {
        let mut text = String::from(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<ndm>\n<oem id=\"CCSDS_OEM_VERS\" version=\"2.0\">\n<header/>\n<body><segment>\n\
             <metadata>\n<CENTER_NAME>MOON</CENTER_NAME>\n<REF_FRAME>ECLIPJ2000</REF_FRAME>\n<TIME_SYSTEM>UTC</TIME_SYSTEM>\n\
             </metadata>\n<data>\n",
        );
        for line in MADE.file(u, &states).lines().filter(|line| line.starts_with("2024")) {
            let x: Vec<&str> = line.split(' ').collect();
            text += &format!("<stateVector><EPOCH>{}</EPOCH><X units=\"{units}\">{}</X>", x[0], x[1]);
            for (name, number) in ["Y", "Z", "X_DOT", "Y_DOT", "Z_DOT"].into_iter().zip(&x[2..]) {
                text += &format!("<{name}>{number}</{name}>");
            }
            text += "</stateVector>\n";
        }
        text + "</data>\n</segment></body>\n</oem>\n</ndm>\n"
    };
    same(&|u| xml(u, "km").into_bytes());
    let refused =
        |text: String| array_of(folder.path(), |_| text.clone().into_bytes()).unwrap_err().to_string();
    assert!(refused(xml(1e-3, "m")).contains("line 12: found X in \"m\"; expected units=\"km\""));
    assert!(
        refused(xml(1e-3, "km").replace("UTC", "SCLK")).contains("line 9: found SCLK; expected TIME_SYSTEM")
    );
    assert!(refused(xml(1e-3, "km").replace("</ndm>", "")).contains("the ends of all elements"));
    assert!(refused("<html><body>Not found</body></html>".into()).contains("expected <oem>"));
    // Compressed, and cut off.
    let gzip = |u: f64| {
        let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        std::io::Write::write_all(&mut packed, MADE.file(u, &states).as_bytes()).unwrap();
        packed.finish().unwrap()
    };
    same(&gzip);
    let said = array_of(folder.path(), |u| gzip(u)[..2000].to_vec()).unwrap_err().to_string();
    assert!(said.contains("sat1.oem: gzip"), "{said}");
}
