//! Antennas that differ, by keys and by files of attitudes and patterns, through the whole chain.

use super::*;

/// Tilts of the daughters' antennas, and patterns of their voltages, as flown and as known.
const TILTED: [&str; 2] = [
    "instrument.tilt_along_deg.constant=[20.0, 0.0, -15.0]",
    "instrument.tilt_radial_deg.constant=[0.0, 10.0, 0.0]",
];
const KNOWN_TILTED: [&str; 2] =
    ["map.antennas.tilt_along_deg=[20.0, 0.0, -15.0]", "map.antennas.tilt_radial_deg=[0.0, 10.0]"];
const KNOWN_PATTERN: &str = "map.antennas.pattern=[0.2, 0.0, -0.1]";
const SMEARED: &str = "map.refine.smear_integrations=true";

/// Flies the followers with these settings under a sky that the map's degrees hold, averaged over instants at the array's positions; gives what
/// refinement leaves of the data, chi-square, knowing each of several sets of settings.
fn left_by_refinement(flown: &[&str], known: &[&[&str]]) -> Vec<f64> {
    let place = Workplace::new(&followers());
    let downlink = place.path("flown.ccsds");
    let space = [
        "sky.nside=8",
        "sky.l_max=10",
        "spacecraft.model=general",
        // Half a wavelength of motion: four times what the mission has.
        "spacecraft.motion_wavelengths_max=0.5",
        "spacecraft.smear_integrations=true",
    ];
    let ground = [
        "map.engine=harmonic",
        "map.rows=average",
        "map.refine.passes_max=20",
        "map.refine.residual_max=1e-6",
        "map.epsilon=1e-9",
    ];
    let run = |command: &[&str], sets: &[&[&str]]| -> Vec<String> {
        let sets = sets.iter().copied().flatten().flat_map(|set| ["--set", set]);
        command.iter().copied().chain(sets).map(str::to_owned).collect()
    };
    let simulate = run(&["simulate", &place.pipeline, "-o", &downlink], &[&space, &ground, flown]);
    succeed(&simulate.iter().map(String::as_str).collect::<Vec<_>>());
    let left = |(k, more): (usize, &&[&str])| {
        let out = place.path(&format!("map-{k}"));
        let replay = run(&["replay", &downlink, "--map", &place.pipeline, "--out", &out], &[&ground, more]);
        let summary = json(&replay.iter().map(String::as_str).collect::<Vec<_>>());
        let refinement = summary["channels"][0]["refinement"].clone();
        assert_eq!(refinement["taken_as_instants"], 0, "{refinement}");
        let file = format!("{out}/3.000MHz/map.fits");
        let header = read_map_file(Path::new(&file), &ReadOptions::default()).unwrap().header;
        let mut keys: Vec<&str> = more
            .iter()
            .filter_map(|set| set.strip_prefix("map.antennas.")?.split(['=', '.']).next())
            .collect();
        keys.dedup();
        let expected = if keys.is_empty() { "ideal".to_owned() } else { keys.join(", ") };
        assert_eq!(header.text("ANTROWS"), Some(expected.as_str()));
        for (key, of) in [("PASSES", "iterations"), ("RESIDUAL", "residual")] {
            // To the digits that a card holds.
            let expected = refinement["convergence"][of].as_f64().unwrap();
            assert!((header.real(key).unwrap() / expected - 1.0).abs() < 1e-9, "{key}");
        }
        refinement["chi_square"]["all"].as_f64().unwrap()
    };
    known.iter().enumerate().map(left).collect()
}

/// Each daughter has its own dipole: refinement leaves nothing of the sky if it knows antennas and averages, and only then. (That either is
/// right is held against direct sums in `physics general`.)
#[test]
fn averages_and_antennas_that_differ_are_in_the_rows_of_a_refined_map() {
    let pattern = "instrument.pattern.constant=[0.2, 0.0, -0.1]";
    let flown = [&TILTED[..], &["spacecraft.antenna=dipole-normal", pattern]].concat();
    let antennas = [&KNOWN_TILTED[..], &[KNOWN_PATTERN]].concat();
    let both = [&antennas[..], &[SMEARED]].concat();
    let left = left_by_refinement(&flown, &[&[], &antennas, &[SMEARED], &both]);
    eprintln!("left of the data knowing neither, antennas, averages, both: {left:?}");
    let &[neither, instants, straight, both] = &left[..] else { panic!("{left:?}") };
    // Rows are in f32, and an iteration ends: something is left of what is known in full.
    assert!(both < 0.5 * instants && both < 1e-4 * straight && both < 1e-4 * neither, "{left:?}");
}

/// The same of three dipoles across each other, whose patterns change with frequency: at 3 MHz, half way between the rows of the table, they are
/// those of the list.
#[test]
fn three_dipoles_with_patterns_by_frequency_are_in_the_rows_of_a_refined_map() {
    const TABLE: &str = "pattern_by_frequency=[[1e6, 0.0, 0.0, 0.0], [5e6, 0.4, 0.0, -0.2]]";
    let table = format!("instrument.{TABLE}");
    let flown = [&TILTED[..], &["spacecraft.antenna=three-dipoles", &table]].concat();
    let straight = [KNOWN_PATTERN, SMEARED];
    let list = [&KNOWN_TILTED[..], &straight].concat();
    let table = format!("map.antennas.{TABLE}");
    let by_frequency = [&KNOWN_TILTED[..], &[&table, SMEARED]].concat();
    let left = left_by_refinement(&flown, &[&[SMEARED], &straight, &list, &by_frequency]);
    eprintln!("left of the data knowing averages, patterns too, all by a list, all by a table: {left:?}");
    let &[neither, straight, list, by_frequency] = &left[..] else { panic!("{left:?}") };
    assert!(list < 1e-4 * straight && list < 1e-4 * neither, "{left:?}");
    // 0.2 and -0.1 are not the interpolated numbers to the last bit.
    assert!((by_frequency / list - 1.0).abs() < 0.1, "{left:?}");
}

/// A CCSDS AEM of the satellites that the tilts above describe, in windows of the mission; `first` from 0 on.
fn attitude_message(plan: &Plan, first: usize) -> String {
    let [along_deg, radial_deg] = [[20.0_f64, 0.0, -15.0], [0.0, 10.0, 0.0]];
    let mut text =
        "CCSDS_AEM_VERS = 2.0\nCREATION_DATE = 2030-01-01T00:00:00\nORIGINATOR = TEST\n".to_owned();
    let epoch = plan.instrument.epoch_tai_s;
    for (satellite, window) in (first..3).flat_map(|n| plan.windows.iter().map(move |window| (n, window))) {
        text += &format!(
            "META_START\nOBJECT_NAME = D{satellite}\nOBJECT_ID = 2030-00{satellite}A\nREF_FRAME_A = ECLIPJ2000\nREF_FRAME_B = \
             SC_BODY_1\nTIME_SYSTEM = TAI\nATTITUDE_TYPE = QUATERNION\nINTERPOLATION_METHOD = LAGRANGE\nINTERPOLATION_DEGREE = 5\n\
             META_STOP\nDATA_START\n"
        );
        let (from_s, until_s) = (window.start.seconds().floor(), window.end.seconds().ceil() + 60.0);
        let steps = ((until_s - from_s) / 60.0).ceil() as usize;
        for k in 0..=steps {
            let t_s = from_s + 60.0 * k as f64;
            let (r, normal) = (plan.array.position_m(satellite, t_s), plan.array.normal_hat(satellite, t_s));
            let up = unit(r);
            let along = cross(normal, up);
            let tan = |deg: f64| deg.to_radians().tan();
            let lean = add(scale(tan(along_deg[satellite]), along), scale(tan(radial_deg[satellite]), up));
            let z = unit(add(normal, lean));
            let x = unit(sub(along, scale(dot(along, z), z)));
            let [a, b, c, d] = quaternion([x, cross(z, x), z]);
            // Whole seconds from an epoch on a whole second.
            let date = date_tai(epoch + t_s);
            text += &format!("{date} {a:.10} {b:.10} {c:.10} {d:.10}\n");
        }
        text += "DATA_STOP\n";
    }
    text
}

/// The same message, whose first daughter has nothing for three minutes within the first window: it is known at both ends of it.
fn with_a_gap(plan: &Plan) -> String {
    let text = attitude_message(plan, 0);
    let end = text.find("DATA_STOP\n").unwrap() + "DATA_STOP\n".len();
    let (first, rest) = text.split_at(end);
    let (header, segment) = first.split_at(first.find("META_START").unwrap());
    let window = &plan.windows[0];
    assert!(window.end.seconds() - window.start.seconds() > 400.0);
    let begin_s = plan.instrument.epoch_tai_s + window.start.seconds().floor();
    let used = |key: &str, after_s: f64| {
        segment.replace("META_STOP", &format!("{key} = {}\nMETA_STOP", date_tai(begin_s + after_s)))
    };
    [header, &used("USEABLE_STOP_TIME", 120.0), &used("USEABLE_START_TIME", 300.0), rest].concat()
}

/// The quaternion, scalar last, of the matrix with these rows, which takes components on fixed axes to those on the rows' (504.0-B).
fn quaternion(m: [[f64; 3]; 3]) -> [f64; 4] {
    // The eigenvector of Shepperd's largest pivot.
    let squares = [
        1.0 + m[0][0] - m[1][1] - m[2][2],
        1.0 - m[0][0] + m[1][1] - m[2][2],
        1.0 - m[0][0] - m[1][1] + m[2][2],
        1.0 + m[0][0] + m[1][1] + m[2][2],
    ];
    let [p01, p02, p12] = [m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]];
    let [q0, q1, q2] = [m[1][2] - m[2][1], m[2][0] - m[0][2], m[0][1] - m[1][0]];
    let rows = [
        [squares[0], p01, p02, q0],
        [p01, squares[1], p12, q1],
        [p02, p12, squares[2], q2],
        [q0, q1, q2, squares[3]],
    ];
    let largest = (0..4).max_by(|a, b| squares[*a].total_cmp(&squares[*b])).unwrap();
    let length = rows[largest].iter().map(|x| x * x).sum::<f64>().sqrt();
    rows[largest].map(|x| x / length)
}

/// A date such as 2030-031T12:00:00 on TAI.
fn date_tai(tai_s: f64) -> String {
    let second = tai_s.round() as i64;
    let (mut day, of_day) = (second.div_euclid(86_400), second.rem_euclid(86_400));
    let mut year = 1958;
    while day >= 365 + i64::from(year % 4 == 0) {
        day -= 365 + i64::from(year % 4 == 0);
        year += 1;
    }
    format!("{year}-{:03}T{:02}:{:02}:{:02}", day + 1, of_day / 3600, of_day / 60 % 60, of_day % 60)
}

/// Fields of a dipole along z with a factor 1 + q P_2, each 5 deg, at two frequencies about the channel's.
fn dipole_table(q: f64) -> String {
    let mut text = "frequency_hz,theta_deg,phi_deg,e_theta_re,e_theta_im,e_phi_re,e_phi_im\n".to_owned();
    for (hz, theta_deg, phi_deg) in [1e6, 5e6].into_iter().flat_map(|hz| {
        (0..=180).step_by(5).flat_map(move |theta| (0..360).step_by(10).map(move |phi| (hz, theta, phi)))
    }) {
        let (sin, cos) = f64::from(theta_deg).to_radians().sin_cos();
        // Gains are left to calibration: an amplitude and a phase of no matter.
        let field = -2.5 * sin * (1.0 + q * (1.5 * cos * cos - 0.5));
        text += &format!("{hz},{theta_deg},{phi_deg},{},{},0,0\n", 0.6 * field, 0.8 * field);
    }
    text
}

/// Attitudes by messages and patterns by tables are those that keys describe: what flies by one is known by the other.
#[test]
fn antennas_by_files_are_those_of_keys() {
    let place = Workplace::new(&followers());
    let source = ConfigSource { file: Some(place.pipeline.clone().into()), ..ConfigSource::default() };
    let plan = Plan::new(source.load().unwrap()).unwrap();
    let attitudes = place.file("all.aem", attitude_message(&plan, 0).as_bytes());
    let tables: Vec<String> = [0.2, 0.0, -0.1]
        .iter()
        .enumerate()
        .map(|(k, q)| place.file(&format!("{k}.csv"), dipole_table(*q).as_bytes()))
        .collect();
    let [attitudes, tables] = [vec![attitudes], tables].map(|paths| format!("{paths:?}"));
    let antenna = "spacecraft.antenna=dipole-normal";
    let known = [&KNOWN_TILTED[..], &[KNOWN_PATTERN, SMEARED]].concat();
    let by_files =
        [format!("map.antennas.files.attitudes={attitudes}"), format!("map.antennas.files.tables={tables}")];
    let by_files = [&by_files[0], &by_files[1], SMEARED];
    let flown = [&TILTED[..], &[antenna, "instrument.pattern.constant=[0.2, 0.0, -0.1]"]].concat();
    let left = left_by_refinement(&flown, &[&known, &by_files, &[SMEARED]]);
    eprintln!("flown by keys; left of the data known by keys, by files, not at all: {left:?}");
    // Rows are in f32, and an iteration ends. Normals of orbits come from the data's positions, attitudes from messages: those leave less.
    assert!(left[1] < left[0] && left[0] < 1e-4 * left[2], "{left:?}");

    let flown = [
        format!("instrument.antenna_files.attitudes={attitudes}"),
        format!("instrument.antenna_files.tables={tables}"),
    ];
    let left = left_by_refinement(&[&flown[0], &flown[1], antenna], &[&known, &by_files, &[SMEARED]]);
    eprintln!("flown by files; left of the data known by keys, by files, not at all: {left:?}");
    assert!(left[1] < left[0] && left[0] < 1e-4 * left[2], "{left:?}");

    // What files do not say is refused with their key.
    let short = place.file("short.aem", attitude_message(&plan, 1).as_bytes());
    let gap = place.file("gap.aem", with_a_gap(&plan).as_bytes());
    for (set, expected) in [
        (format!("attitudes=[{short:?}]"), "attitudes: 2 objects (2030-001A, 2030-002A); expected 3"),
        (format!("attitudes=[{gap:?}]"), "attitudes: nothing of daughter 1 at "),
        (
            format!(
                "tables=[{:?}]",
                place.file("far.csv", dipole_table(0.1).replace("\n1000000,", "\n4000000,").as_bytes())
            ),
            "expected 3000000 Hz, a channel, in between",
        ),
    ] {
        let set = format!("instrument.antenna_files.{set}");
        let out = place.path("refused.ccsds");
        let said = fail(&[
            "simulate",
            &place.pipeline,
            "-o",
            &out,
            "--set",
            antenna,
            "--set",
            "map.engine=harmonic",
            "--set",
            "map.rows=average",
            "--set",
            "map.refine.passes_max=1",
            "--set",
            "spacecraft.model=general",
            "--set",
            &set,
        ]);
        assert!(said.contains("instrument.antenna_files: ") && said.contains(expected), "{said}");
    }
}

/// Three dipoles see what an isotropic antenna sees, by three receivers: three times the weight, of which a receiver's noise costs half as
/// much again as it does there.
#[test]
fn three_dipoles_have_the_noise_of_three_receivers() {
    let place = Workplace::new(&TRIPLE.replace("every_nth_window = 100", "every_nth_window = 1000"));
    let weights = |name: &str, receiver_k_sr: &str, antenna: &str| -> Vec<f64> {
        let file = place.path(name);
        let noise = format!("spacecraft.receiver_noise_k_sr={receiver_k_sr}");
        let antenna = format!("spacecraft.antenna={antenna}");
        let sets = ["--set", &noise, "--set", &antenna, "--set", "spacecraft.model=direct"];
        let more =
            ["--set", "map.refine.passes_max=1", "--set", "map.engine=harmonic", "--set", "map.rows=average"];
        succeed(&[&["simulate", &place.pipeline, "-o", &file][..], &sets, &more].concat());
        let mut reader = DownlinkReader::open(Path::new(&file)).unwrap();
        let mut found = Vec::new();
        while let Some(frame) = reader.next_frame().unwrap() {
            if let GroundFrame::Visibilities(block) = frame {
                found.extend(block.weight.iter().map(|weight| f64::from(*weight)));
            }
        }
        found
    };
    // A receiver as noisy as the sky here, some 4e7 K sr, and one of no noise.
    for receiver_k_sr in [0.0, 4e7] {
        let one = weights("one.ccsds", &(1.5 * receiver_k_sr).to_string(), "isotropic");
        let three = weights("three.ccsds", &receiver_k_sr.to_string(), "three-dipoles");
        assert!(one.len() > 20 && one.len() == three.len(), "{} {}", one.len(), three.len());
        for (one, three) in one.iter().zip(&three) {
            // Sums of pixels and weights are in f32.
            assert!((three / one / 3.0 - 1.0).abs() < 3e-6, "{one} {three}");
        }
    }
}
