//! Errors of the instrument through the chain.

use crate::common;

use std::collections::BTreeMap;
use std::path::Path;

use common::workplace::{Workplace, json, succeed};
use lunarray::downlink::DownlinkReader;
use lunarray::frames::{Flags, GroundFrame, VisibilityBlock};
use lunarray::units::vector::{cross, dot, unit};
use num_complex::Complex64;

const SMALL: &str = r#"
name = "errors"
seed = 4
[sky]
nside = 8
[array]
satellites = 4
[spacecraft]
channels_hz = [3.0e6, 5.0e6]
duration_s = 4e5
every_nth_window = 12
every_nth_integration = 15
baseline_wavelengths_max = 16.0
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-4
[products]
pictures = false
"#;

/// Time, gain with its clock, and whether it is dead.
type Receiver = (f64, Complex64, bool);

const ERRORS: [&str; 6] = [
    "instrument.phase_deg={pass_rms=40.0,drift_rms=10.0,drift_time_s=2000.0}",
    "instrument.amplitude={constant_rms=0.2}",
    "instrument.clock_ns={constant=[0.0,30.0,-20.0,5.0],step_rms=3.0,step_every_s=3000.0}",
    "navigation.along_m={orbit_rms=5.0}",
    "instrument.outlier_probability=0.1",
    "instrument.outlier_sigma=30.0",
];

fn simulate(place: &Workplace, name: &str, set: &[&str]) -> Vec<u8> {
    let out = place.path(name);
    let mut args = vec!["simulate", &place.pipeline, "--out", &out];
    for set in set {
        args.extend(["--set", set]);
    }
    succeed(&args);
    std::fs::read(out).unwrap()
}

/// Blocks of pairs by channel, pair and start.
fn blocks(path: &str) -> BTreeMap<(u16, u8, u8, i64), VisibilityBlock> {
    let mut reader = DownlinkReader::open(Path::new(path)).unwrap();
    let mut found: BTreeMap<_, VisibilityBlock> = BTreeMap::new();
    while let Some(frame) = reader.next_frame().unwrap() {
        if let GroundFrame::Visibilities(block) = frame {
            for k in 0..block.len() {
                let time = block.start.0 + i64::from(block.offset_ticks[k]);
                let one = VisibilityBlock {
                    channel: block.channel,
                    pair: block.pair,
                    start: block.start,
                    offset_ticks: vec![block.offset_ticks[k]],
                    duration_ticks: vec![block.duration_ticks[k]],
                    value_k_sr: vec![block.value_k_sr[k]],
                    weight: vec![block.weight[k]],
                    flags: vec![block.flags[k]],
                };
                found.insert((block.channel.0, block.pair.i, block.pair.j, time), one);
            }
        }
    }
    found
}

#[test]
fn errors_that_are_off_leave_every_byte_and_seeds_decide_the_rest() {
    let place = Workplace::new(SMALL);
    let ideal = simulate(&place, "ideal.ccsds", &[]);
    let off = [
        "instrument.realisation=5",
        "instrument.phase_deg={drift_rms=0.0,drift_time_s=100.0}",
        "instrument.beacon={k_sr=0.0,on_s=60.0}",
    ];
    assert!(simulate(&place, "off.ccsds", &off) == ideal);
    assert!(!Path::new(&place.path("ideal.ccsds.instrument.csv")).exists());
    let on = simulate(&place, "on.ccsds", &ERRORS);
    assert!(on != ideal);
    let one_thread = [&ERRORS[..], &["runtime.threads=1", "runtime.queue_capacity=2"]].concat();
    assert!(simulate(&place, "one.ccsds", &one_thread) == on);
    let truth = |name: &str| std::fs::read(place.path(&format!("{name}.ccsds.instrument.csv"))).unwrap();
    assert!(truth("on") == truth("one"));
    let other = [&ERRORS[..], &["instrument.realisation=1"]].concat();
    assert!(simulate(&place, "other.ccsds", &other) != on);
}

#[test]
fn visibilities_weights_and_dead_receivers_follow_the_truth() {
    let place = Workplace::new(SMALL);
    let quiet = "spacecraft.thermal_noise=false";
    simulate(&place, "ideal.ccsds", &[quiet]);
    let ideal = blocks(&place.path("ideal.ccsds"));
    let set = [
        quiet,
        "instrument.phase_deg={pass_rms=40.0}",
        "instrument.amplitude={constant_rms=0.2}",
        "instrument.clock_ns={constant=[0.0,30.0,-20.0,5.0]}",
        "instrument.dead_channels=[[2,1]]",
    ];
    simulate(&place, "errors.ccsds", &set);
    let found = blocks(&place.path("errors.ccsds"));
    assert_eq!(ideal.len(), found.len());
    // The truth as it is written: gain, clock and whether dead, by daughter and channel and pass.
    let table = std::fs::read_to_string(place.path("errors.ccsds.instrument.csv")).unwrap();
    let mut truth: BTreeMap<(u16, u8), Vec<Receiver>> = BTreeMap::new();
    for line in table.lines().skip(1) {
        let number: Vec<f64> = line.split(',').map(|field| field.parse().unwrap()).collect();
        let [_, t_s, daughter, channel, _, ln, deg, ..] = number[..] else { panic!("{line}") };
        // The clock is in the phase.
        let gain = Complex64::from_polar(ln.exp(), deg.to_radians());
        let dead = number[11] == 1.0;
        truth.entry((channel as u16, daughter as u8 - 1)).or_default().push((t_s, gain, dead));
    }
    let mut dead_seen = 0;
    for ((key, ideal), (other, found)) in ideal.iter().zip(&found) {
        assert_eq!(key, other);
        let (channel, i, j, time) = *key;
        let at = |n: u8| {
            let near = |row: &&Receiver| ((row.0 - time as f64 * 1e-6).abs() * 1e3) as u64;
            *truth[&(channel, n)].iter().min_by_key(near).unwrap()
        };
        let (a, b) = (at(i), at(j));
        let gain = a.1 * b.1.conj();
        let of = |block: &VisibilityBlock| {
            let value = block.value_k_sr[0];
            Complex64::new(value.re.into(), value.im.into())
        };
        let expected = if a.2 || b.2 { Complex64::ZERO } else { of(ideal) * gain };
        dead_seen += usize::from(a.2 || b.2);
        // Single precision of both, and the digits of the table.
        let error = (of(found) - expected).norm();
        assert!(error <= 1e-6 * of(ideal).norm() * gain.norm(), "{key:?}: {} {expected}", of(found));
        let weight = f64::from(found.weight[0]) * gain.norm_sqr() / f64::from(ideal.weight[0]);
        assert!((weight - 1.0).abs() < 1e-6, "{weight}");
    }
    assert!(dead_seen > 10);
}

/// The number in a column of a line of the truth.
fn column(table: &str, name: &str, line: &str) -> f64 {
    let place = table.lines().next().unwrap().split(',').position(|field| field == name).unwrap();
    line.split(',').nth(place).unwrap().parse().unwrap()
}

/// Tilts towards the track and away from the Moon, rad, and the distortion, as the truth has them for the pass of a time.
fn true_antenna(table: &str, n: u8, t_s: f64) -> [f64; 3] {
    let of = |line: &&str| {
        let daughter = column(table, "daughter", line) as u8 == n + 1;
        let near_s = (column(table, "time_s", line) - t_s).abs();
        if daughter { (near_s * 1e3) as u64 } else { u64::MAX }
    };
    let line = table.lines().skip(1).min_by_key(of).unwrap();
    let [along, radial] = ["tilt_along_deg", "tilt_radial_deg"].map(|name| column(table, name, line));
    [along.to_radians(), radial.to_radians(), column(table, "pattern", line)]
}

#[test]
fn tilted_dipoles_see_one_source_by_their_projections() {
    let place = Workplace::new(SMALL);
    // One bright pixel, high above the ecliptic where daughters see it from most of the orbit.
    let (nside, pixel) = (8, 100);
    let mut values = vec![0.0; 12 * nside * nside];
    values[pixel] = 1e6;
    let map = lunarray::sky::SkyMap::new(lunarray::sky::Frame::Ecliptic, values).unwrap();
    let path = place.path("source.fits");
    let options = lunarray::sky::fits::WriteOptions::default();
    lunarray::sky::fits::write_map(Path::new(&path), &map, &options).unwrap();
    let n_hat = lunarray::sky::healpix::pixel_directions(nside)[pixel];
    // Sky by sky, as the map says no frequency.
    let file = format!("sky.file=[{path:?}, {path:?}]");
    let set = [
        &file,
        "spacecraft.thermal_noise=false",
        "spacecraft.antenna=dipole-normal",
        "spacecraft.model=direct",
    ];
    simulate(&place, "ideal.ccsds", &set);
    let tilts = [
        "instrument.tilt_along_deg={constant=[0.0,10.0,-20.0,5.0]}",
        "instrument.tilt_radial_deg={pass_rms=10.0}",
        "instrument.pattern={constant=[0.0,0.1,-0.2,0.3]}",
    ];
    simulate(&place, "tilted.ccsds", &[&set[..], &tilts].concat());
    let [ideal, tilted] = ["ideal", "tilted"].map(|name| blocks(&place.path(&format!("{name}.ccsds"))));
    let table = std::fs::read_to_string(place.path("tilted.ccsds.instrument.csv")).unwrap();
    let array = lunarray::array::Array::new(&lunarray::array::ArrayConfig {
        satellites: 4,
        ..lunarray::array::ArrayConfig::default()
    })
    .unwrap();
    let (mut compared, mut far) = (0, 0.0_f64);
    for ((key, ideal), tilted) in ideal.iter().zip(tilted.values()) {
        let of = |block: &VisibilityBlock| {
            Complex64::new(block.value_k_sr[0].re.into(), block.value_k_sr[0].im.into())
        };
        let (before, after) = (of(ideal), of(tilted));
        if before.norm() == 0.0 {
            assert_eq!(after.norm(), 0.0);
            continue;
        }
        let t_s = ideal.middle_s(0);
        // Across the wave's direction, dipoles lie along two axes p and q; each has its own part on them.
        let normal = array.orbit_normal_hat(t_s);
        let helper = if n_hat[2].abs() < 0.9 { [0.0, 0.0, 1.0] } else { [1.0, 0.0, 0.0] };
        let p = unit(cross(n_hat, helper));
        let q = cross(n_hat, p);
        let voltages = |n: u8| {
            let [along, radial, distortion] = true_antenna(&table, n, t_s);
            let up = unit(array.position_m(n.into(), t_s));
            let track = cross(normal, up);
            let axis =
                unit(std::array::from_fn(|k| normal[k] + along.tan() * track[k] + radial.tan() * up[k]));
            let factor = 1.0 + distortion * (3.0 * dot(axis, n_hat).powi(2) - 1.0) / 2.0;
            [factor * dot(axis, p), factor * dot(axis, q)]
        };
        let (a, b) = (voltages(key.1), voltages(key.2));
        let own = dot(normal, p).powi(2) + dot(normal, q).powi(2);
        let expected = (a[0] * b[0] + a[1] * b[1]) / own;
        // Single precision, and the digits of the table.
        assert!(
            (after / before - expected).norm() < 2e-6 * (1.0 + expected.abs() / own),
            "{key:?}: {} {expected}",
            after / before
        );
        (compared, far) = (compared + 1, far.max((expected - 1.0).abs()));
    }
    assert!(compared > 100 && far > 0.2, "{compared} {far}");
    // On a common circle harmonics know one antenna.
    let args = ["simulate", &place.pipeline, "--out", &place.path("x"), "--set", tilts[0]];
    let said = common::workplace::fail(&args);
    assert!(
        said.contains("spacecraft.model = \"auto\": expected \"direct\" or \"general\" with instrument.tilt"),
        "{said}"
    );
}

#[test]
fn a_leak_about_the_limb_is_a_wave_from_the_earth() {
    let place = Workplace::new(SMALL);
    let quiet = "spacecraft.thermal_noise=false";
    simulate(&place, "ideal.ccsds", &[quiet]);
    simulate(
        &place,
        "leak.ccsds",
        &[quiet, "instrument.leak_k_sr=1e9", "instrument.leak_depth_deg=3.0", "spacecraft.flag_earth=false"],
    );
    let [ideal, leak] = ["ideal", "leak"].map(|name| blocks(&place.path(&format!("{name}.ccsds"))));
    let array = lunarray::array::Array::new(&lunarray::array::ArrayConfig {
        satellites: 4,
        ..lunarray::array::ArrayConfig::default()
    })
    .unwrap();
    let (mut strong, mut weak) = (0, 0);
    for ((key, ideal), leak) in ideal.iter().zip(leak.values()) {
        let of = |block: &VisibilityBlock| {
            Complex64::new(block.value_k_sr[0].re.into(), block.value_k_sr[0].im.into())
        };
        let (t_s, hz) = (ideal.middle_s(0), [3e6, 5e6][usize::from(key.0)]);
        let [r_i, r_j] = [key.1, key.2].map(|n| array.position_m(n.into(), t_s));
        let earth = array.earth_hat(t_s);
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        // Power at a daughter, by the angle from the nadir and the disc's radius.
        let power = |r: [f64; 3]| {
            let distance = dot(r, r).sqrt();
            let below = (1_737_100.0 / distance).asin() - (-dot(r, earth) / distance).acos();
            1e9 * (-below.to_degrees().max(0.0) / 3.0).exp()
        };
        let turns = hz / 299_792_458.0 * (dot(earth, r_i) - dot(earth, r_j));
        let amplitude = (power(r_i) * power(r_j)).sqrt();
        let expected = of(ideal) + Complex64::from_polar(amplitude, -std::f64::consts::TAU * turns);
        // Single precision.
        assert!((of(leak) - expected).norm() < 1e-6 * (amplitude + of(ideal).norm()), "{key:?}");
        (strong, weak) = if amplitude > 1e8 { (strong + 1, weak) } else { (strong, weak + 1) };
    }
    assert!(strong > 10 && weak > 10, "{strong} {weak}");
}

#[test]
fn studies_of_tolerances_are_good() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines/calibration");
    for name in ["phases", "constant-phases", "clocks", "positions"] {
        let study = lunarray::pipeline::Study::read(&folder.join(format!("{name}.toml")), &[]).unwrap();
        assert!(study.cases.len() >= 5, "{name}");
    }
}

#[test]
fn a_beacon_is_flagged_and_left_out_of_maps() {
    let place = Workplace::new(SMALL);
    let beacon = "instrument.beacon={k_sr=1e10,direction_deg=[40.0,10.0],on_s=200.0,every_s=1000.0}";
    let out = place.path("out");
    let summary = json(&["run", &place.pipeline, "--out", &out, "--set", beacon]);
    let reasons = summary["ledger"].to_string();
    assert!(reasons.contains("artificial signal on"), "{reasons}");
    let found = blocks(&format!("{out}/downlink.ccsds"));
    let on = found.values().filter(|block| block.flags[0].0 & Flags::BEACON.0 != 0).count();
    // A fifth of the time.
    let part = on as f64 / found.len() as f64;
    assert!((0.15..0.25).contains(&part), "{part}");
    // Its visibilities are as strong as it is, the sky's far weaker.
    for block in found.values().filter(|block| block.flags[0].0 & Flags::BEACON.0 != 0) {
        let size = block.value_k_sr[0].norm();
        assert!((0.95e10..1.05e10).contains(&size), "{size}");
    }
}

#[test]
fn a_map_of_random_phases_keeps_exp_of_less_their_variance() {
    let place = Workplace::new(SMALL);
    let run = |name: &str, set: &[&str]| {
        let out = place.path(name);
        let mut args = vec!["run", &place.pipeline, "--out", &out, "--set", "spacecraft.thermal_noise=false"];
        // Many passes for a mean over phases: one in three windows of half a year, few integrations of each. Regularised so
        // strongly that the map is a sum over the data: an inverse would weigh few of them most.
        let many = [
            "spacecraft.duration_s=2e7",
            "spacecraft.every_nth_window=6",
            "spacecraft.channels_hz=[3.0e6]",
            "spacecraft.every_nth_integration=16",
            "spacecraft.flag_earth=false",
            "sky.nside=4",
            "map.epsilon=1.0",
        ];
        for set in set.iter().chain(&many) {
            args.extend(["--set", set]);
        }
        succeed(&args);
        format!("{out}/3.000MHz/map.fits")
    };
    let ideal = run("ideal", &[]);
    let sigma_deg = 20.0_f64;
    let phase = format!("instrument.phase_deg={{pass_rms={}}}", sigma_deg / 2.0_f64.sqrt());
    let spectra = json(&["compare", &run("spoilt", &[&phase]), &ideal, "--no-plot"]);
    let of = |name: &str| spectra[name].as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).sum::<f64>();
    let kept = of("cl_cross") / of("cl_truth");
    let law = (-0.5 * sigma_deg.to_radians().powi(2)).exp();
    eprintln!("{sigma_deg} deg: amplitude {kept:.4} for {law:.4}");
    // The cosine of such a phase varies by 0.08; over the some 80 of 404 passes in which baselines are short, 1 %.
    assert!((kept / law - 1.0).abs() < 0.03, "{sigma_deg} deg: {kept} for {law}");
}
