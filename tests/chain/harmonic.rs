//! The space segment with the harmonic model, from a map file to downlink bytes, against direct sums.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use lunarray::array::Array;
use lunarray::downlink::DownlinkReader;
use lunarray::frames::{AntennaResponse, GroundFrame, VisibilityBlock};
use lunarray::pipeline::{ConfigSource, Plan, simulate};
use lunarray::response::harmonic::{HarmonicModel, ModelSettings, PairState, PatternGeometry};
use lunarray::response::pixel::{Directions, PairGeometry, SingleGeometry, sky_powers, sky_sums};
use lunarray::runtime::Cancel;
use lunarray::sky::fits::{WriteOptions, write_map};

use lunarray::sky::harmonics::{Alm, synthesis};
use lunarray::sky::healpix::{pixel_area_sr, ring};
use lunarray::sky::{Frame, SkyMap, rotate};
use num_complex::{Complex32, Complex64};

const L_MAX: usize = 40;

/// Equal power at all degrees, and a mean as large as the fluctuations.
fn sky() -> Alm {
    let mut alm = Alm::zeros(L_MAX);
    let mut word = 11_u64;
    let mut random = || {
        word = word.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (word >> 33) as f64 / (1_u64 << 31) as f64 - 0.5
    };
    for m in 0..=L_MAX {
        for l in m..=L_MAX {
            *alm.get_mut(l, m) = Complex64::new(random(), if m == 0 { 0.0 } else { random() }) * 1e4;
        }
    }
    *alm.get_mut(0, 0) = Complex64::new(1.7e5, 0.0);
    alm
}

fn plan(file: &str, overrides: &[&str]) -> Plan {
    let mut all: Vec<String> = [
        "spacecraft.channels_hz=[10e6]",
        "map.epsilon=1e-4",
        "spacecraft.model=harmonic",
        "spacecraft.thermal_noise=false",
        "spacecraft.every_nth_integration=3",
        "spacecraft.every_nth_window=200",
        // Longer baselines see the limb alone of this sky, and sums over pixels do not know the limb that well;
        // tests/physics/forward.rs has them, with an exact limb.
        "spacecraft.baseline_wavelengths_max=9.0",
        // Beyond what is in the map, which must not matter.
        "sky.l_max=96",
    ]
    .map(str::to_owned)
    .to_vec();
    all.push(format!("sky.file={file}"));
    all.extend(overrides.iter().map(|&text| text.to_owned()));
    Plan::new(ConfigSource { overrides: all, ..ConfigSource::default() }.load().unwrap()).unwrap()
}

fn blocks(file: &Path) -> Vec<VisibilityBlock> {
    let mut reader = DownlinkReader::open(file).unwrap();
    let mut found = Vec::new();
    while let Some(frame) = reader.next_frame().unwrap() {
        if let GroundFrame::Visibilities(block) = frame {
            found.push(block);
        }
    }
    found
}

/// Some visibilities of a downlink file and their pairs' places.
struct Sample {
    geometry: Vec<PairGeometry>,
    value: Vec<Complex64>,
    noise_k_sr: Vec<f64>,
}

fn sample(array: &Array, blocks: &[VisibilityBlock], every: usize) -> Sample {
    let all = blocks.iter().flat_map(|block| (0..block.len()).map(move |k| (block, k)));
    let mut found = Sample { geometry: Vec::new(), value: Vec::new(), noise_k_sr: Vec::new() };
    for (block, k) in all.step_by(every) {
        let t_s = block.middle_s(k);
        found.geometry.push(PairGeometry {
            r_i_m: array.position_m(block.pair.i.into(), t_s),
            r_j_m: array.position_m(block.pair.j.into(), t_s),
            frequency_hz: 10e6,
            moon_radius_m: array.moon_radius_m(),
            response: AntennaResponse::Isotropic,
        });
        let value = block.value_k_sr[k];
        found.value.push(Complex64::new(value.re.into(), value.im.into()));
        // weight = 2 dnu dt / (P_i P_j)
        let dt_s = 1e-6 * f64::from(block.duration_ticks[k]);
        found.noise_k_sr.push((2.0 * 8_000.0 * dt_s / f64::from(block.weight[k])).sqrt());
    }
    found
}

/// Sums over the pixels of a much finer map of the same coefficients, some rings at a time. The Moon's limb cuts
/// some 14,000 pixels of 2.5e-7 sr at random, which leaves 1e-5 of the sky's temperature.
fn pixel_sums(alm: &Alm, frame: Frame, pairs: &[PairGeometry]) -> Vec<Complex64> {
    const NSIDE: usize = 2048;
    let map = synthesis(alm, NSIDE).unwrap();
    let rotation = frame.to_ecliptic();
    let mut totals = vec![Complex64::ZERO; pairs.len()];
    let rings: Vec<usize> = (1..4 * NSIDE).collect();
    for rings in rings.chunks(128) {
        let (mut directions, mut values) = (Vec::new(), Vec::new());
        for &k in rings {
            let ring = ring(NSIDE, k);
            for p in 0..ring.len {
                let (sin, cos) = (ring.phi0_rad + TAU * p as f64 / ring.len as f64).sin_cos();
                directions.push(rotate(&rotation, [ring.sin_theta * cos, ring.sin_theta * sin, ring.z]));
                values.push(map[ring.first + p] as f32);
            }
        }
        let directions = Directions::from(directions.as_slice());
        let sums = sky_sums(pairs, &directions, &values, pixel_area_sr(NSIDE)).unwrap();
        for (total, sum) in totals.iter_mut().zip(sums) {
            *total += sum.visibility_k_sr;
        }
    }
    totals
}

/// Geometric means of what the two daughters of each pair hear by themselves, K sr. The Moon's limb cuts some 2000 pixels of
/// 4e-6 sr, which leaves 1e-5.
fn pixel_powers(alm: &Alm, frame: Frame, pairs: &[PairGeometry]) -> Vec<f64> {
    const NSIDE: usize = 512;
    let map = SkyMap::new(frame, synthesis(alm, NSIDE).unwrap()).unwrap();
    let directions = Directions::from(map.directions_ecliptic().as_slice());
    let values: Vec<f32> = map.values().iter().map(|&value| value as f32).collect();
    let single = |pair: &PairGeometry, r_m| SingleGeometry {
        r_m,
        normal_hat: [0.0, 0.0, 1.0],
        moon_radius_m: pair.moon_radius_m,
        response: pair.response,
    };
    let singles: Vec<SingleGeometry> =
        pairs.iter().flat_map(|pair| [pair.r_i_m, pair.r_j_m].map(|r_m| single(pair, r_m))).collect();
    let powers = sky_powers(&singles, &directions, &values, pixel_area_sr(NSIDE)).unwrap();
    powers.chunks(2).map(|own| (own[0] * own[1]).sqrt()).collect()
}

#[test]
fn a_galactic_map_comes_down_as_its_direct_sums() {
    let folder = tempfile::tempdir().unwrap();
    let map_path = folder.path().join("galactic.fits");
    let map = SkyMap::new(Frame::Galactic, synthesis(&sky(), 64).unwrap()).unwrap();
    write_map(&map_path, &map, &WriteOptions::default()).unwrap();
    let plan = plan(map_path.to_str().unwrap(), &[]);
    let downlink = folder.path().join("down.ccsds");
    simulate(&plan, &downlink, &Cancel::new(), &mut |_| {}).unwrap();
    let blocks = blocks(&downlink);
    let count: usize = blocks.iter().map(VisibilityBlock::len).sum();
    assert!(count > 200, "{count}");
    let sample = sample(&plan.array, &blocks, count / 48);
    let expected = pixel_sums(&sky(), Frame::Galactic, &sample.geometry);
    let (mut error, mut power) = (0.0, 0.0);
    for (found, value) in sample.value.iter().zip(&expected) {
        error += (found - value).norm_sqr();
        power += value.norm_sqr();
    }
    let powers = pixel_powers(&sky(), Frame::Galactic, &sample.geometry);
    for (noise, power) in sample.noise_k_sr.iter().zip(&powers) {
        // Powers are predicted every ninth of a radian, which degrees from l = 20 on are too fine for. Of each of them this
        // sky has some 9e3 K, of which a visible half keeps 5 / l^1.5 sr: 6e-4 of a power, 2.7e-3 of twenty. The next test
        // has a smooth sky.
        assert!((noise / power - 1.0).abs() < 4.0 * 2.7e-3, "{noise} {power}");
    }
    let relative = f64::sqrt(error / power);
    // 3e-5, which falls with finer pixels as their limb's error does.
    println!("{count} visibilities, {} compared: {relative:.2e}", sample.value.len());
    assert!(relative < 1e-4, "{relative:e}");
}

#[test]
fn own_powers_are_of_each_daughters_own_place() {
    // A mean, and degrees one to three nearly as strong: a power changes by percents while the array goes by.
    let mut alm = Alm::zeros(3);
    *alm.get_mut(0, 0) = Complex64::new(1e5, 0.0);
    for (l, m, value) in
        [(1, 1, Complex64::new(3e4, 1e4)), (2, 1, Complex64::new(-1e4, 2e4)), (3, 2, Complex64::I * 2e4)]
    {
        *alm.get_mut(l, m) = value;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("smooth.fits");
    let map = SkyMap::new(Frame::Ecliptic, synthesis(&alm, 32).unwrap()).unwrap();
    write_map(&path, &map, &WriteOptions::default()).unwrap();
    let sets = ["spacecraft.auto_powers=true", "spacecraft.auto_integration_s=25.0", "sky.l_max=8"];
    let plan = plan(path.to_str().unwrap(), &sets);
    let downlink = folder.path().join("down.ccsds");
    simulate(&plan, &downlink, &Cancel::new(), &mut |_| {}).unwrap();
    let mut own = blocks(&downlink);
    own.retain(|block| block.pair.i == block.pair.j);
    let count: usize = own.iter().map(VisibilityBlock::len).sum();
    // A place and its power are those of a pair of one daughter with herself.
    let sample = sample(&plan.array, &own, count / 64);
    let powers = pixel_powers(&alm, Frame::Ecliptic, &sample.geometry);
    for ((value, noise), power) in sample.value.iter().zip(&sample.noise_k_sr).zip(&powers) {
        assert_eq!(value.im, 0.0);
        // The limb, 1e-5; a cubic's 3/128 (l h)^4 of degree three, 3e-4 of its tenth; f32 and a sky read from 32-bit numbers.
        assert!((value.re / power - 1.0).abs() < 1e-4, "{value} {power}");
        // n / P^2 is half of what a pair with these powers weighs.
        assert!((noise / 2.0_f64.sqrt() / value.re - 1.0).abs() < 1e-5, "{noise} {value}");
    }
    let (least, most) = powers.iter().fold((f64::INFINITY, 0.0_f64), |(a, b), p| (a.min(*p), b.max(*p)));
    assert!(powers.len() >= 64 && most > 1.3 * least, "{least} {most}");
}

/// Smeared visibilities are means over the phase that is swept.
#[test]
fn averages_are_averages_of_instants() {
    let geometry = PatternGeometry {
        orbit_radius_m: 2_037_100.0,
        moon_radius_m: 1_737_100.0,
        wavelength_m: 30.0,
        response: AntennaResponse::Isotropic,
    };
    let mut model = HarmonicModel::new(sky(), ModelSettings::new(geometry, PI / 6.0, 20.0)).unwrap();
    // As long as l_max 40 makes it tell: sinc(0.5 40 0.05) = 0.84.
    let span_rad = 0.05;
    let state =
        |phase_rad, span_rad| PairState { node_rad: 1.0, phase_rad, baseline_wavelengths: 6.0, span_rad };
    let mut values = |states: &[PairState]| {
        let mut values = vec![Complex64::ZERO; states.len()];
        model.visibilities(states, &mut values).unwrap();
        values
    };
    let smeared = values(&(0..20).map(|k| state(0.1 * f64::from(k), span_rad)).collect::<Vec<_>>());
    let mut change = 0.0_f64;
    for (k, smeared) in smeared.iter().enumerate() {
        let middle = 0.1 * k as f64;
        let instants: Vec<_> =
            (0..200).map(|n| state(middle + span_rad * ((f64::from(n) + 0.5) / 200.0 - 0.5), 0.0)).collect();
        let instants = values(&instants);
        let mean = instants.iter().sum::<Complex64>() / 200.0;
        let scale = instants.iter().map(|v| v.norm()).sum::<f64>() / 200.0;
        // Two models' tolerances of 1e-5, and a phase where this pair sees little.
        assert!((smeared - mean).norm() < 1e-4 * scale, "{k}: {smeared} {mean}");
        change = change.max((mean - instants[100]).norm() / scale);
    }
    // Something was there to be averaged.
    assert!(change > 0.01, "{change}");
}

#[test]
fn capacities_and_threads_do_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let map_path = folder.path().join("map.fits");
    let map = SkyMap::new(Frame::Ecliptic, synthesis(&sky(), 32).unwrap()).unwrap();
    write_map(&map_path, &map, &WriteOptions::default()).unwrap();
    let run = |name: &str, capacity: usize, threads: usize| {
        let capacity = format!("runtime.queue_capacity={capacity}");
        let overrides =
            ["spacecraft.thermal_noise=true", "sky.l_max=60", "spacecraft.every_nth_window=40", &capacity];
        let plan = plan(map_path.to_str().unwrap(), &overrides);
        let path = folder.path().join(name);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| simulate(&plan, &path, &Cancel::new(), &mut |_| {})).unwrap();
        std::fs::read(path).unwrap()
    };
    let reference = run("reference", 64, 2);
    assert!(reference.len() > 100_000);
    for (capacity, threads) in [(1, 1), (3, 3)] {
        assert!(reference == run("other", capacity, threads), "{capacity} {threads}");
    }
}

/// Where the map holds all degrees that baselines see, so that cost may choose the model, the choice changes visibilities as is stated
/// (docs/evidence.md), by their rms: most with one bright pixel at a pole, little with noise in all pixels.
#[test]
fn models_differ_as_stated_where_cost_may_choose() {
    let folder = tempfile::tempdir().unwrap();
    let nside = 16;
    let pixels = 12 * nside * nside;
    let mut pole = vec![1e5; pixels];
    pole[1] = 1e9;
    let noise =
        (0..pixels as u64).map(|k| (k.wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 33) as f64 * 1e-4).collect();
    for (name, values, most) in [("pole", pole, 0.15), ("noise", noise, 0.04)] {
        let map = folder.path().join(format!("{name}.fits"));
        write_map(&map, &SkyMap::new(Frame::Ecliptic, values).unwrap(), &WriteOptions::default()).unwrap();
        let visibilities = |model: &str| -> Vec<Complex64> {
            let overrides = [
                "spacecraft.channels_hz=[5e6]".to_owned(),
                "map.epsilon=1e-4".to_owned(),
                "spacecraft.thermal_noise=false".to_owned(),
                "spacecraft.every_nth_window=100".to_owned(),
                "spacecraft.every_nth_integration=1".to_owned(),
                // 2 pi 2.1, and the decay beyond it: 36, 9/4 of nside.
                "spacecraft.baseline_wavelengths_max=2.1".to_owned(),
                format!("spacecraft.model={model}"),
                format!("sky.file={}", map.display()),
            ];
            let source = ConfigSource { overrides: overrides.to_vec(), ..ConfigSource::default() };
            let file = folder.path().join(format!("{name}-{model}.ccsds"));
            let plan = Plan::new(source.load().unwrap()).unwrap();
            simulate(&plan, &file, &Cancel::new(), &mut |_| {}).unwrap();
            let wide = |value: &Complex32| Complex64::new(value.re.into(), value.im.into());
            blocks(&file).iter().flat_map(|block| block.value_k_sr.iter().map(wide)).collect()
        };
        let [direct, harmonic] = ["direct", "harmonic"].map(visibilities);
        assert!(direct.len() > 300 && direct.len() == harmonic.len());
        let apart: f64 = direct.iter().zip(&harmonic).map(|(a, b)| (a - b).norm_sqr()).sum();
        let apart = (apart / direct.iter().map(Complex64::norm_sqr).sum::<f64>()).sqrt();
        assert!(apart > 1e-3 && apart < most, "{name}: {apart}");
    }
}
