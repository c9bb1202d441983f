//! What packets say of positions and times, and what was flown.

use crate::common;

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::Path;

use common::workplace::{Workplace, fail, succeed};
use lunarray::array::{Array, ArrayConfig, Ephemeris};
use lunarray::downlink::DownlinkReader;
use lunarray::frames::{GroundFrame, VisibilityBlock};
use lunarray::units::vector::{Vec3, add, cross, dot, norm, scale, sub, unit};
use num_complex::Complex64;

const SMALL: &str = r#"
name = "navigation"
seed = 4
[sky]
nside = 8
[array]
satellites = 4
[spacecraft]
channels_hz = [3.0e6]
duration_s = 4e5
every_nth_window = 12
every_nth_integration = 15
baseline_wavelengths_max = 16.0
thermal_noise = false
flag_earth = false
model = "direct"
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-4
[products]
pictures = false
"#;

const NSIDE: usize = 8;
const PIXEL: usize = 100;
const SOURCE_K: f64 = 1e6;

/// A place with a sky of one bright pixel, which daughters see from most of the orbit; its direction.
fn one_source() -> (Workplace, String, Vec3) {
    let place = Workplace::new(SMALL);
    let mut values = vec![0.0; 12 * NSIDE * NSIDE];
    values[PIXEL] = SOURCE_K;
    let map = lunarray::sky::SkyMap::new(lunarray::sky::Frame::Ecliptic, values).unwrap();
    let path = place.path("source.fits");
    lunarray::sky::fits::write_map(Path::new(&path), &map, &Default::default()).unwrap();
    let n_hat = lunarray::sky::healpix::pixel_directions(NSIDE)[PIXEL];
    (place, format!("sky.file={path}"), n_hat)
}

/// Visibilities by pair and number, in the order of their times, and the positions that packets say.
type Downlink = (BTreeMap<(u8, u8), Vec<VisibilityBlock>>, Ephemeris);

fn simulate(place: &Workplace, name: &str, set: &[&str]) -> Downlink {
    let path = place.path(name);
    let mut args = vec!["simulate", &place.pipeline, "--out", &path];
    set.iter().for_each(|set| args.extend(["--set", set]));
    succeed(&args);
    let mut reader = DownlinkReader::open(Path::new(&path)).unwrap();
    let (mut blocks, mut ephemeris): Downlink = (BTreeMap::new(), Ephemeris::default());
    while let Some(frame) = reader.next_frame().unwrap() {
        match frame {
            GroundFrame::Visibilities(block) => {
                blocks.entry((block.pair.i, block.pair.j)).or_default().push(block);
            }
            GroundFrame::Ephemeris(segment) => drop(ephemeris.insert(segment)),
            _ => {}
        }
    }
    (blocks, ephemeris)
}

/// A wave from one pixel at these positions, K sr.
fn source_k_sr([i_m, j_m]: [Vec3; 2], n_hat: Vec3) -> Complex64 {
    let area_sr = 4.0 * std::f64::consts::PI / (12 * NSIDE * NSIDE) as f64;
    let turns = dot(sub(i_m, j_m), n_hat) * 3e6 / 299_792_458.0;
    SOURCE_K * area_sr * Complex64::cis(-TAU * turns)
}

fn rotated(v: Vec3, axis_hat: Vec3, angle_rad: f64) -> Vec3 {
    let (sin, cos) = angle_rad.sin_cos();
    let along = scale(dot(v, axis_hat) * (1.0 - cos), axis_hat);
    add(add(scale(cos, v), scale(sin, cross(axis_hat, v))), along)
}

#[test]
fn a_late_tag_shifts_positions_along_the_track_and_turns_the_sky_that_is_seen() {
    const LATE_S: f64 = 0.4;
    let (place, sky, n_hat) = one_source();
    let (flown, _) = simulate(&place, "ideal.ccsds", &[&sky]);
    let late = "navigation.time_tag_ms={constant=[400.0]}";
    let (said, ephemeris) = simulate(&place, "late.ccsds", &[&sky, late]);
    let array = Array::new(&ArrayConfig { satellites: 4, ..ArrayConfig::default() }).unwrap();
    let turn_rad = TAU * LATE_S / array.orbital_period_s();
    let (mut seen, mut most_turned) = (0, 0.0_f64);
    for ((pair, flown), said) in flown.iter().zip(said.values()) {
        for (flown, said) in flown.iter().zip(said) {
            // The same measurement under another time.
            assert_eq!(said.start.0 - flown.start.0, 400_000);
            assert_eq!(
                (&said.offset_ticks, &said.duration_ticks),
                (&flown.offset_ticks, &flown.duration_ticks)
            );
            assert_eq!((&said.value_k_sr, &said.weight), (&flown.value_k_sr, &flown.weight));
            let (placed, counts) = ephemeris.place(said, 3e6);
            assert_eq!(counts.placed, said.len() as u64);
            for k in 0..said.len() {
                let t_s = flown.middle_s(k);
                let believed = [placed.r_i_m[k], placed.r_j_m[k]];
                let states = [pair.0, pair.1].map(|n| array.state(n.into(), t_s));
                for (believed, state) in believed.iter().zip(states) {
                    // Along the track by v dt; v^2 / r dt^2 / 2 of it, 0.095 m, is towards the Moon.
                    let moved = sub(*believed, state.position_m);
                    let down_m =
                        norm(state.velocity_m_s).powi(2) / norm(state.position_m) * LATE_S.powi(2) / 2.0;
                    let expected =
                        sub(scale(LATE_S, state.velocity_m_s), scale(down_m, unit(state.position_m)));
                    assert!(norm(sub(moved, expected)) < 1e-3, "{moved:?} {expected:?}");
                    assert!((600.0..640.0).contains(&norm(moved)));
                }
                let data = Complex64::new(said.value_k_sr[k].re.into(), said.value_k_sr[k].im.into());
                if data.norm() == 0.0 {
                    continue; // Behind the Moon.
                }
                let at_flown = source_k_sr(states.map(|state| state.position_m), n_hat);
                // Values in f32, positions to 1e-5 m of a wavelength of 100 m.
                assert!((data - at_flown).norm() < 2e-6 * data.norm(), "{data} {at_flown}");
                // At the positions believed, the same sky has to be turned with the orbit to give these data. The node's motion and
                // the breathing change a baseline of 1.6 km by less than 1e-4 m in this time.
                let normal = array.orbit_normal_hat(t_s);
                let turned = source_k_sr(believed, rotated(n_hat, normal, turn_rad));
                assert!((data - turned).norm() < 1e-4 * data.norm(), "{data} {turned}");
                let unturned = source_k_sr(believed, n_hat);
                most_turned = most_turned.max((unturned - data).norm() / data.norm());
                seen += 1;
            }
        }
    }
    // 2 pi 16 wavelengths times 3e-4 rad.
    assert!(seen > 60 && (0.01..0.04).contains(&most_turned), "{seen} {most_turned}");
}

#[test]
fn tags_find_positions_however_far_they_are_off() {
    let (place, sky, _) = one_source();
    for (ms, name) in [("9000.0", "late"), ("-9000.0", "early")] {
        let set = format!("navigation.time_tag_ms={{constant=[{ms}],drift_rms=300.0}}");
        let (said, ephemeris) = simulate(&place, name, &[&sky, &set]);
        for block in said.values().flatten() {
            assert_eq!(ephemeris.count(block).0.placed, block.len() as u64);
        }
    }
    let truth = std::fs::read_to_string(place.path("late.instrument.csv")).unwrap();
    let column = truth.lines().next().unwrap().split(',').position(|name| name == "time_tag_ms").unwrap();
    let tags_ms: Vec<f64> =
        truth.lines().skip(1).map(|line| line.split(',').nth(column).unwrap().parse().unwrap()).collect();
    assert!(tags_ms.iter().all(|ms| (ms - 9000.0).abs() < 1500.0) && tags_ms.iter().any(|ms| *ms != 9000.0));
}

#[test]
fn navigation_that_is_off_leaves_every_byte_and_old_keys_are_told_where_they_went() {
    let (place, sky, _) = one_source();
    let bytes = |name: &str, set: &[&str]| {
        simulate(&place, name, &[&[sky.as_str()], set].concat());
        std::fs::read(place.path(name)).unwrap()
    };
    let ideal = bytes("ideal", &[]);
    assert!(bytes("off", &["navigation.along_m={drift_rms=0.0,drift_time_s=100.0}"]) == ideal);
    let errors = ["navigation.radial_m={orbit_rms=5.0}", "navigation.time_tag_ms={pass_rms=5.0}"];
    let on = bytes("on", &errors);
    assert!(on != ideal && bytes("again", &[&errors[..], &["runtime.threads=1"]].concat()) == on);
    let said = fail(&[
        "simulate",
        &place.pipeline,
        "--out",
        &place.path("x"),
        "--set",
        "instrument.along_m.pass_rms=1.0",
    ]);
    assert!(said.contains("instrument.along_m: no such key; it was renamed to navigation.along_m"), "{said}");
}
