//! The ninth daughter's spectra.

use std::f64::consts::{PI, TAU};
use std::path::Path;
use std::sync::Arc;

use lunarray::array::{Array, ArrayConfig, ObservingWindows};
use lunarray::frames::{
    AntennaResponse, Channel, GroundFrame, Housekeeping, Instrument, ObservingWindow, VisibilityBlock,
};
use lunarray::mother::{Ninth, NinthConfig, NinthSetup, NinthSky};
use lunarray::response::model::{DaughterPosition, DirectSum, VisibilityModel};
use lunarray::runtime::{Outlet, Stage};
use lunarray::sky::fits::{ReadOptions, WriteOptions, read_map, write_map};
use lunarray::sky::generated::{GeneratedSky, generate};
use lunarray::sky::healpix::pixel_directions;
use lunarray::sky::{Frame, SkyMap};
use lunarray::units::MissionTime;
use lunarray::units::vector::{Vec3, dot, norm};

const MOON_M: f64 = 1_737_100.0;
const RADIUS_M: f64 = 2_037_100.0;
const TEMPERATURE_K: f64 = 2e4;
const AT_HZ: f64 = 30e6;
const RECEIVER_K_SR: f64 = 5e3;
const NSIDE: usize = 64;

fn config() -> NinthConfig {
    NinthConfig {
        on: true,
        channels: 300,
        integration_s: 0.5,
        receiver_noise_k_sr: RECEIVER_K_SR,
        file_index: -2.6,
        ..NinthConfig::default()
    }
}

/// Its blocks of the first seconds of the first window, for a uniform sky.
fn uniform(seed: Option<u64>, response: AntennaResponse, seconds: f64) -> Vec<VisibilityBlock> {
    let array = Arc::new(Array::new(&ArrayConfig::default()).unwrap());
    let start = ObservingWindows::new(&array, 0.0, 1e9).next().unwrap().start;
    let end = MissionTime::from_seconds(start.seconds() + seconds);
    let sky = SkyMap::new(Frame::Ecliptic, vec![TEMPERATURE_K; 12 * NSIDE * NSIDE]).unwrap();
    let model = DirectSum::new(&sky, AT_HZ, MOON_M, response);
    let setup = NinthSetup {
        array,
        config: config(),
        sky: NinthSky::PowerLaw { model, frequency_hz: AT_HZ, index: config().file_index },
        windows: vec![ObservingWindow { index: 0, start, end }],
        seed,
    };
    let mut ninth = Ninth::new(setup).unwrap();
    let mut out = Outlet::collect();
    let instrument = Instrument {
        name: String::new(),
        epoch_tai_s: 0.0,
        moon_radius_m: MOON_M,
        satellites: 8,
        channels: vec![Channel { frequency_hz: 1e6, width_hz: 8e3 }; 3],
        response,
        seed: 0,
        configuration_hash: 0,
        spectrometer: config().spectrometer(),
        noiseless: false,
    };
    ninth.step(GroundFrame::Instrument(instrument.clone()), &mut out).unwrap();
    let report = Housekeeping { time: end, sampled: 7, dropped: 0 };
    ninth.step(GroundFrame::Housekeeping(report), &mut out).unwrap();
    ninth.finish(&mut out).unwrap();
    let mut frames = out.into_vec();
    // Its powers are counted, and precede the frame that closes the window.
    let Some(GroundFrame::Housekeeping(report)) = frames.pop() else { panic!("no report") };
    assert_eq!(frames.remove(0), GroundFrame::Instrument(instrument.clone()));
    let blocks: Vec<VisibilityBlock> = frames
        .into_iter()
        .map(|frame| match frame {
            GroundFrame::Visibilities(block) => block,
            other => panic!("{other:?}"),
        })
        .collect();
    let count: usize = blocks.iter().map(VisibilityBlock::len).sum();
    assert_eq!(report.sampled, 7 + count as u64);
    for (k, block) in blocks.iter().enumerate() {
        assert_eq!((block.channel.0, block.pair.i, block.pair.j), (3 + k as u16, 8, 8));
        let channel = instrument.channel_of(block.channel, block.pair).unwrap();
        assert!((channel.frequency_hz - (30e6 + 0.3e6 * (k as f64 + 0.5))).abs() < 1e-6);
    }
    blocks
}

/// Its position on the circle, by the formulas of the paper.
fn position(t_s: f64) -> Vec3 {
    let f = TAU * t_s / 8248.68 - 110e3 / RADIUS_M;
    let node = -TAU * t_s / (1.3 * 365.25 * 86_400.0);
    let (sin_i, cos_i) = 30.0_f64.to_radians().sin_cos();
    let (x, y, z) = (f.cos(), f.sin() * cos_i, f.sin() * sin_i);
    [x * node.cos() - y * node.sin(), x * node.sin() + y * node.cos(), z].map(|x| RADIUS_M * x)
}

#[test]
fn a_uniform_sky_gives_its_temperature_times_the_unocculted_solid_angle() {
    let directions = pixel_directions(NSIDE);
    let (cos, area_sr) = ((1.0 - (MOON_M / RADIUS_M).powi(2)).sqrt(), 4.0 * PI / directions.len() as f64);
    // The sphere without the Moon's cap; for dipoles normal to the orbit, the integral of 1 - sin^2 t cos^2 p over it.
    let dipole = PI * ((1.0 + cos) + (1.0 + cos.powi(3)) / 3.0);
    for (response, solid_sr) in
        [(AntennaResponse::Isotropic, 2.0 * PI * (1.0 + cos)), (AntennaResponse::DipoleNormal, dipole)]
    {
        for block in uniform(None, response, 5.25).iter().step_by(37) {
            let frequency_hz = 30e6 + 0.3e6 * (f64::from(block.channel.0 - 3) + 0.5);
            let sky_k = TEMPERATURE_K * (frequency_hz / AT_HZ).powf(-2.6);
            assert_eq!(block.len(), 11);
            for k in 0..block.len() {
                assert_eq!(block.duration_ticks[k], if k == 10 { 250_000 } else { 500_000 });
                let found = (f64::from(block.value_k_sr[k].re) - RECEIVER_K_SR) / sky_k;
                // The 4 nside pixels on the limb count whole: each is wrong by half a pixel at random.
                let limb = 0.5 * (4.0 * NSIDE as f64).sqrt() * area_sr;
                assert!((found - solid_sr).abs() < 4.0 * limb, "{response:?} {k}: {found} {solid_sr}");
                if response == AntennaResponse::Isotropic {
                    // The visible pixels, counted one by one.
                    let r_m = position(block.middle_s(k));
                    let sees = |n: &&Vec3| dot(**n, r_m) / norm(r_m) >= -cos;
                    let counted = directions.iter().filter(sees).count() as f64 * area_sr;
                    // f32, and one pixel on the limb.
                    assert!((found - counted).abs() < 1e-6 * solid_sr + area_sr, "{k}: {found} {counted}");
                }
                // dnu dt / P^2.
                let samples = 0.3e6 * f64::from(block.duration_ticks[k]) * 1e-6;
                let power = f64::from(block.value_k_sr[k].re);
                assert!((f64::from(block.weight[k]) * power * power / samples - 1.0).abs() < 1e-5);
            }
        }
    }
}

#[test]
fn the_rest_of_a_window_is_not_an_integration_of_a_few_samples() {
    // At 300 kHz 1e4 samples are 33 ms. The last 30 ms of 5.03 s join the half second before them.
    for (seconds, count, last) in [(5.03, 10, 530_000), (5.04, 11, 40_000), (0.03, 0, 0)] {
        for block in uniform(Some(9), AntennaResponse::Isotropic, seconds) {
            assert_eq!(block.len(), count, "{seconds}");
            assert_eq!(block.duration_ticks.last().copied().unwrap_or(0), last, "{seconds}");
            let ticks: u32 = block.duration_ticks.iter().sum();
            assert!(count == 0 || f64::from(ticks) == (seconds * 1e6_f64).round());
        }
    }
}

#[test]
fn noise_is_that_of_the_radiometer_equation() {
    let with = uniform(Some(3), AntennaResponse::Isotropic, 40.0);
    let without = uniform(None, AntennaResponse::Isotropic, 40.0);
    assert_ne!(with, uniform(Some(4), AntennaResponse::Isotropic, 40.0));
    let (mut sum, mut squares, mut neighbours, mut count) = (0.0, 0.0, 0.0, 0.0);
    let mut before = vec![0.0; 80];
    for (with, without) in with.iter().zip(&without) {
        assert_eq!(with.len(), 80);
        for (k, before) in before.iter_mut().enumerate() {
            let (found, expected) = (f64::from(with.value_k_sr[k].re), f64::from(without.value_k_sr[k].re));
            // P / sqrt(dnu dt).
            let draw = (found / expected - 1.0) * (0.3e6_f64 * 0.5).sqrt();
            sum += draw;
            squares += draw * draw;
            neighbours += draw * *before;
            count += 1.0;
            *before = draw;
        }
    }
    // Standard errors of a mean, of a variance and of a correlation of neighbouring channels.
    assert_eq!(count, 24_000.0);
    assert!((sum / count).abs() < 4.0 * (1.0 / count).sqrt(), "{}", sum / count);
    assert!((squares / count - 1.0).abs() < 4.0 * (2.0 / count).sqrt(), "{}", squares / count);
    assert!((neighbours / count).abs() < 4.0 * (1.0 / count).sqrt(), "{}", neighbours / count);
}

#[test]
fn a_generated_sky_is_interpolated_correctly_between_its_maps() {
    let model = |frequency_hz: f64| {
        let values = generate(&GeneratedSky::default(), frequency_hz, 64, 9).unwrap();
        let sky = SkyMap::new(Frame::Ecliptic, values).unwrap();
        DirectSum::new(&sky, frequency_hz, MOON_M, AntennaResponse::Isotropic)
    };
    let nodes_hz = NinthSky::nodes_hz([30e6, 120e6]);
    let mut sky = NinthSky::Maps(nodes_hz.iter().map(|&at_hz| (at_hz, model(at_hz))).collect());
    let places = [3e3, 6e3].map(|t_s| DaughterPosition {
        r_m: position(t_s),
        normal_hat: [0.0, 0.0, 1.0],
        ..DaughterPosition::default()
    });
    let frequencies_hz = [30e6, 47e6, 82e6, 120e6];
    let found = sky.powers(&places, &frequencies_hz).unwrap();
    for (k, frequency_hz) in frequencies_hz.into_iter().enumerate() {
        let mut expected = [0.0; 2];
        model(frequency_hz).predict_powers(&places, &mut expected).unwrap();
        for (found, expected) in found.iter().zip(expected) {
            // A tenth of the noise of 1 MHz in 10 s.
            assert!((found[k] / expected - 1.0).abs() < 3e-5, "{frequency_hz}: {} {expected}", found[k]);
        }
    }
}

const PIPELINE: &str = r#"
    name = "nine"
    seed = 3
    [spacecraft]
    channels_hz = [1.0e6, 2.0e6]
    duration_s = 3e4
    window_s_max = 6.0
    flag_earth = false # the last daughters see the Earth for 64 s of a window
    baseline_wavelengths_max = 24.0
    [spacecraft.ninth]
    on = true
    integration_s = 2.0
    file_index = -2.5
    [map]
    engine = 'pixel'
    nside = 2
    epsilon = [1e-2, 1e-1]
    [products]
    pictures = false
"#;

/// The program with settings: what it prints.
fn lunarray(command: &[&str], sets: &[&str]) -> String {
    let mut run = assert_cmd::Command::cargo_bin("lunarray").unwrap();
    let done = run.args(command).args(sets.iter().flat_map(|set| ["--set", set])).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    String::from_utf8(done.stdout).unwrap()
}

fn map(out: &Path) -> Vec<f64> {
    read_map(&out.join("2.000MHz/map.fits"), &ReadOptions::default()).unwrap().values().to_vec()
}

#[test]
fn spectra_are_sent_with_the_visibilities_of_either_fidelity() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = folder.path().join("nine.toml");
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let sky = folder.path().join("sky.fits");
    write_map(
        &sky,
        &SkyMap::new(Frame::Ecliptic, vec![1e6; 12 * 64 * 64]).unwrap(),
        &WriteOptions::default(),
    )
    .unwrap();
    let (pipeline, sky) = (pipeline.to_str().unwrap(), sky.to_str().unwrap());
    let sky = format!("sky.file=[{sky:?},{sky:?}]");
    for (fidelity, more) in
        [("visibilities", &[][..]), ("samples", &["spacecraft.sub_bands=2", "calibration.sub_bands=2"][..])]
    {
        let fidelity_set = format!("spacecraft.fidelity={fidelity}");
        let sets = [&[fidelity_set.as_str(), &sky], more].concat();
        let out = folder.path().join(fidelity);
        lunarray(&["run", pipeline, "--out", out.to_str().unwrap()], &sets);
        let table = std::fs::read_to_string(out.join("autos.csv")).unwrap();
        let rows: Vec<Vec<f64>> = table
            .lines()
            .skip(1)
            .map(|line| line.split(',').map(|number| number.parse().unwrap()).collect())
            .filter(|row: &Vec<f64>| row[2] == 9.0)
            .collect();
        // 90 channels of three integrations in each of the windows of 3e4 s.
        assert!(rows.len().is_multiple_of(270) && rows.len() >= 540, "{}", rows.len());
        for row in &rows {
            let (frequency_hz, width_hz, power, sigma) = (row[0], row[1], row[4], row[5]);
            assert!((30e6..120e6).contains(&frequency_hz) && (width_hz - 1e6).abs() < 1e-3);
            let cos = (1.0 - (MOON_M / RADIUS_M).powi(2)).sqrt();
            // Extrapolated from the file of 2 MHz, the highest channel.
            let expected = 1e6 * (frequency_hz / 2e6).powf(-2.5) * 2.0 * PI * (1.0 + cos);
            // Noise of 2e6 samples, and pixels on the limb as above.
            let error = (1.0_f64 / 2e6).sqrt().hypot(2.1e-4);
            assert!((power / expected - 1.0).abs() < 5.0 * error, "{row:?}: {expected}");
            assert!((sigma / power * 2e6_f64.sqrt() - 1.0).abs() < 2e-3, "{row:?}");
        }
        let inspected = lunarray(&["inspect", out.join("downlink.ccsds").to_str().unwrap()], &[]);
        assert!(
            inspected.contains("satellite 9 is a spectrometer: 30.000 to 120.000 MHz in 90 channels"),
            "{inspected}"
        );
        assert!(!inspected.contains("9-9"), "{inspected}");
        // The ground segment alone gets it from the downlink bytes, and its map does not use it.
        let (ground, alone) = (folder.path().join("ground"), folder.path().join("alone"));
        let downlink = out.join("downlink.ccsds");
        let settings =
            ["map.nside=2", "map.epsilon=[1e-2,1e-1]", "map.snapshot_every_s=0.0", "products.pictures=false"];
        let settings: Vec<&str> = settings.into_iter().chain(more.iter().copied().skip(1)).collect();
        lunarray(&["replay", downlink.to_str().unwrap(), "--out", ground.to_str().unwrap()], &settings);
        assert_eq!(table, std::fs::read_to_string(ground.join("autos.csv")).unwrap());
        let without = [&sets[..], &["spacecraft.ninth={}"]].concat();
        lunarray(&["run", pipeline, "--out", alone.to_str().unwrap()], &without);
        assert_eq!(map(&out), map(&alone), "{fidelity}");
        std::fs::remove_dir_all(&ground).unwrap();
    }
}

#[test]
fn check_reports_its_data_rate_and_invalid_settings() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = folder.path().join("nine.toml");
    std::fs::write(&pipeline, PIPELINE).unwrap();
    let pipeline = pipeline.to_str().unwrap();
    // 90 powers of 21 bytes in 2 s.
    let said = lunarray(&["check", pipeline], &[]);
    assert!(said.contains("7.560 kbit/s"), "{said}");
    let cost = |sets: &[&str]| -> serde_json::Value {
        serde_json::from_str(&lunarray(&["check", pipeline, "--json"], sets)).unwrap()
    };
    let with = cost(&[]);
    assert_eq!(with["ninth_bits_per_s"], 7560.0);
    let without = cost(&["spacecraft.ninth={}"]);
    assert!(without["ninth_bits_per_s"].is_null());
    assert!(with["downlink_bytes"].as_f64().unwrap() > without["downlink_bytes"].as_f64().unwrap());
    for set in [
        "spacecraft.ninth.band_hz=[20e6,120e6]",
        "spacecraft.ninth.band_hz=[90e6,60e6]",
        "spacecraft.ninth.channels=0",
        "spacecraft.ninth.integration_s=0.005",
        "spacecraft.ninth.receiver_noise_k_sr=-1.0",
        "spacecraft.ninth.arc_m=-1.0",
        "spacecraft.ninth.file_index=1.0",
    ] {
        let mut run = assert_cmd::Command::cargo_bin("lunarray").unwrap();
        let done = run.args(["check", pipeline, "--set", set]).output().unwrap();
        let key = set.split('=').next().unwrap();
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(!done.status.success() && said.contains(key), "{set}: {said}");
    }
}
