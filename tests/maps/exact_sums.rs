//! Sums hold what was put in and nothing of how it came: in any order, in any calls, over any engines merged in any
//! way, on any number of threads, and with anything put in and taken out again, a checkpoint has the same bytes.

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{AntennaResponse, PlacedVisibilities};
use lunarray::imaging::circle::{HarmonicEngine, HarmonicSetup, nominal_orbit};
use lunarray::imaging::{
    AccumulationError, NormalEngine, NormalSums, PixelEngine, PixelSetup, Refusal, automatic_weight_max,
};
use lunarray::response::harmonic::GeometryLimits;
use lunarray::response::pixel::{PairGeometry, PixelMethod, RowMaker};
use lunarray::sky::healpix::pixel_area_sr;
use lunarray::units::{Pair, StreamKind, random_stream};
use num_complex::Complex64;
use proptest::prelude::*;
use rand::RngExt;
use rand::seq::SliceRandom;

const FREQUENCY_HZ: f64 = 3e6;

/// Visibilities of the shortest pairs over a mission, in blocks of one pair; weights over four decades, up to
/// `weight_max`, and values of some standard deviations, now and then of thousands.
fn data(count: usize, weight_max: f64, seed: u64) -> Vec<PlacedVisibilities> {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut stream = random_stream(seed, StreamKind::Probe, [0, 0]);
    let mut blocks = Vec::new();
    let mut left = count;
    while left > 0 {
        let pair = Pair { i: 0, j: 1 + stream.random_range(0..2) };
        let mut block =
            PlacedVisibilities { frequency_hz: FREQUENCY_HZ, pair, ..PlacedVisibilities::default() };
        let mut time_s = stream.random_range(0.0..3e7);
        let length = stream.random_range(1..=left.min(9));
        for _ in 0..length {
            // Some stay in one cell of a torus, some do not.
            time_s += 10_f64.powf(stream.random_range(0.0..3.0));
            let weight: f64 = weight_max * 10_f64.powf(stream.random_range(-4.0..0.0));
            let size = 10_f64.powf(stream.random_range(-1.0..4.0)) / weight.sqrt();
            let angle: f64 = stream.random_range(0.0..6.3);
            block.time_s.push(time_s);
            block.r_i_m.push(array.position_m(usize::from(pair.i), time_s));
            block.r_j_m.push(array.position_m(usize::from(pair.j), time_s));
            block.value_k_sr.push(Complex64::from_polar(size, angle));
            block.weight.push(weight);
        }
        left -= length;
        blocks.push(block);
    }
    blocks
}

/// The visibilities of a block from one to before another.
fn part(block: &PlacedVisibilities, range: std::ops::Range<usize>) -> PlacedVisibilities {
    PlacedVisibilities {
        time_s: block.time_s[range.clone()].to_vec(),
        r_i_m: block.r_i_m[range.clone()].to_vec(),
        r_j_m: block.r_j_m[range.clone()].to_vec(),
        value_k_sr: block.value_k_sr[range.clone()].to_vec(),
        weight: block.weight[range].to_vec(),
        ..block.clone()
    }
}

fn bytes<E: NormalEngine>(engine: &mut E) -> Vec<u8> {
    let mut bytes = Vec::new();
    engine.checkpoint(&mut bytes).unwrap();
    bytes
}

fn add<E: NormalEngine>(engine: &mut E, block: &PlacedVisibilities) {
    let added = engine.add(block).unwrap();
    assert!(added.refused.is_empty() && added.visibilities == block.len() as u64);
}

/// One engine, block after block.
fn in_order<E: NormalEngine>(make: impl Fn() -> E, blocks: &[PlacedVisibilities]) -> E {
    let mut engine = make();
    blocks.iter().for_each(|block| add(&mut engine, block));
    engine
}

/// Several engines, parts of blocks in any order, merged in any order; with `strangers` in between, which leave.
fn in_disorder<E: NormalEngine>(
    make: impl Fn() -> E,
    blocks: &[PlacedVisibilities],
    strangers: &[PlacedVisibilities],
    seed: u64,
) -> E {
    let mut stream = random_stream(seed, StreamKind::Probe, [1, 0]);
    let mut parts = Vec::new();
    for block in blocks.iter().chain(strangers) {
        let cut = stream.random_range(0..=block.len());
        parts.push(part(block, 0..cut));
        parts.push(part(block, cut..block.len()));
    }
    parts.shuffle(&mut stream);
    let mut engines: Vec<E> = (0..stream.random_range(1..=4)).map(|_| make()).collect();
    for part in &parts {
        let place = stream.random_range(0..engines.len());
        let engine = &mut engines[place];
        add(engine, part);
        match stream.random_range(0..40) {
            0 => drop(engine.sums()),
            1 => engine.flush(),
            2 => *engine = E::restore(&mut bytes(engine).as_slice()).unwrap(),
            // Out and in again.
            3 => {
                let _ = engine.remove(part).unwrap();
                add(engine, part);
            }
            _ => {}
        }
    }
    while engines.len() > 1 {
        let one = engines.swap_remove(stream.random_range(0..engines.len()));
        let place = stream.random_range(0..engines.len());
        engines[place].merge(one).unwrap();
    }
    let mut engine = engines.pop().unwrap();
    let (one_by_one, together) = strangers.split_at(stream.random_range(0..=strangers.len()));
    for block in one_by_one {
        assert_eq!(engine.remove(block).unwrap().visibilities, block.len() as u64);
    }
    engine.subtract(in_order(&make, together)).unwrap();
    engine
}

/// Whether both ways give the same bytes, and all of it taken out leaves nothing.
fn hold_the_same<E: NormalEngine>(make: impl Fn() -> E + Sync, count: usize, weight_max: f64, seed: u64) {
    let (blocks, strangers) = (data(count, weight_max, seed), data(count / 3, weight_max, !seed));
    let mut plain = in_order(&make, &blocks);
    let expected = bytes(&mut plain);
    let threads = 1 + (seed % 3) as usize;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let found = pool.install(|| bytes(&mut in_disorder(&make, &blocks, &strangers, seed)));
    assert!(found == expected, "{} and {} bytes", found.len(), expected.len());
    let mut restored = E::restore(&mut expected.as_slice()).unwrap();
    assert!(bytes(&mut restored) == expected);
    for block in &blocks {
        let _ = plain.remove(block).unwrap();
    }
    assert!(bytes(&mut plain) == bytes(&mut make()));
}

fn pixel(nside: usize, method: PixelMethod, weight_max: f64) -> PixelEngine {
    PixelEngine::new(PixelSetup {
        nside,
        frequency_hz: FREQUENCY_HZ,
        method,
        moon_radius_m: ArrayConfig::default().moon_radius_m,
        response: AntennaResponse::Isotropic,
        companion_seed: 3,
        weight_max,
    })
    .unwrap()
}

fn harmonic(weight_max: f64) -> HarmonicEngine {
    let block = &data(1, 1.0, 1)[0];
    HarmonicEngine::new(HarmonicSetup {
        l_max: 10,
        frequency_hz: FREQUENCY_HZ,
        baseline_m_max: 3_000.0,
        moon_radius_m: ArrayConfig::default().moon_radius_m,
        response: AntennaResponse::Isotropic,
        orbit: nominal_orbit(block, GeometryLimits::default()).unwrap(),
        companion_seed: 3,
        weight_max,
    })
    .unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 12, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn sums_over_pixels_depend_on_the_data_alone(seed in 0_u64..1 << 32, nside in 1_u32..=3) {
        hold_the_same(|| pixel(1 << nside, PixelMethod::Average, 2.0), 400, 2.0, seed);
    }

    /// Weights a thousand times below the greatest, which rows of 32 bits hold, and up to it, which they do not.
    #[test]
    fn sums_over_harmonics_depend_on_the_data_alone(seed in 0_u64..1 << 32, room in 0..12) {
        let weight_max = 2.0 * f64::from(1 << room);
        hold_the_same(|| harmonic(weight_max), 400, 2.0, seed);
    }
}

/// A matrix of several tiles, the last one not full.
#[test]
fn sums_over_many_pixels_depend_on_the_data_alone() {
    hold_the_same(|| pixel(16, PixelMethod::Centre, 1.0), 300, 1.0, 11);
}

/// Rows of 32 bits hold what expected weights sum to; what is above takes 64 bits, and gives them back.
#[test]
fn rows_widen_when_they_must_and_are_written_as_narrow_as_they_can() {
    let mut one = data(1, 1.0, 5).swap_remove(0);
    one.weight[0] = 1.0;
    one.value_k_sr[0] = Complex64::new(0.3, -0.7);
    let (mut engine, repeats) = (harmonic(1024.0), 5_000);
    add(&mut engine, &one);
    let narrow = bytes(&mut engine);
    for _ in 1..repeats {
        add(&mut engine, &one);
    }
    // 2^20 quanta each: 5,000 of them are beyond 2^31.
    let wide = bytes(&mut engine);
    assert!(wide.len() > narrow.len() + 1000, "{} {}", wide.len(), narrow.len());
    let mut sums = [engine.sums(), harmonic_of(&one)].map(|sums| sums.right_hand_side().to_vec());
    sums[1].iter_mut().for_each(|x| *x *= f64::from(repeats));
    let scale = sums[1].iter().fold(0.0_f64, |most, x| most.max(x.abs()));
    for (many, single) in sums[0].iter().zip(&sums[1]) {
        // Both are read in f32.
        assert!((many - single).abs() < 1e-6 * scale, "{many} {single}");
    }
    for _ in 1..repeats {
        let _ = engine.remove(&one).unwrap();
    }
    assert!(bytes(&mut engine) == narrow);
}

fn harmonic_of(block: &PlacedVisibilities) -> lunarray::imaging::circle::HarmonicSums {
    in_order(|| harmonic(1024.0), std::slice::from_ref(block)).into_sums()
}

/// Against plain sums in f64 over the same rows, by the method that makes them in f64: weights a thousand times below the greatest, as expected of a sky.
#[test]
fn exact_sums_agree_with_plain_ones() {
    const NSIDE: usize = 4;
    let weight_max = automatic_weight_max(FREQUENCY_HZ, 8e3);
    let blocks = data(100, weight_max / 1024.0, 21);
    let sums = in_order(|| pixel(NSIDE, PixelMethod::AverageExact, weight_max), &blocks).into_sums();
    let maker = RowMaker::new(NSIDE, PixelMethod::AverageExact).unwrap();
    let (pixels, area_sr) = (maker.pixels(), pixel_area_sr(NSIDE));
    let (mut normal, mut right) = (vec![0.0; pixels * pixels], vec![0.0; pixels]);
    for block in &blocks {
        for k in 0..block.len() {
            let pair = PairGeometry {
                r_i_m: block.r_i_m[k],
                r_j_m: block.r_j_m[k],
                frequency_hz: FREQUENCY_HZ,
                moon_radius_m: ArrayConfig::default().moon_radius_m,
                response: AntennaResponse::Isotropic,
            };
            let (mut re, mut im) = (vec![0.0_f64; pixels], vec![0.0_f64; pixels]);
            maker.fill(&pair, area_sr, &mut re, &mut im);
            let (weight, value) = (block.weight[k], block.value_k_sr[k]);
            for a in 0..pixels {
                right[a] += weight * (re[a] * value.re + im[a] * value.im);
                for b in 0..=a {
                    normal[a * pixels + b] += weight * (re[a] * re[b] + im[a] * im[b]);
                }
            }
        }
    }
    let most = |values: &[f64]| values.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
    let (normal_scale, right_scale) = (most(&normal), most(&right));
    // Half a step for each of 200 terms; the scale is at most four times the greatest weight. 1e-12 for factors of 43
    // bits; 1e-8 of the greatest is what tests against independent code resolve.
    let scale = 4.0 * weight_max;
    let normal_error = 100.0 * area_sr * area_sr * scale * 2_f64.powi(-42);
    let right_error = 100.0 * area_sr * scale.sqrt() * 2_f64.powi(-31);
    for a in 0..pixels {
        let error = (sums.right[a] - right[a]).abs();
        assert!(error < right_error + 1e-12 * right_scale && error < 1e-8 * right_scale, "{a}: {error:e}");
        for b in 0..=a {
            let error = (sums.normal.get(a, b) - normal[a * pixels + b]).abs();
            let is_near = error < normal_error + 1e-12 * normal_scale && error < 1e-8 * normal_scale;
            assert!(is_near, "{a} {b}: {error:e}");
        }
    }
    let weight: f64 = blocks.iter().flat_map(|block| &block.weight).sum();
    assert!((sums.counts.weight / weight - 1.0).abs() < 1e-12);
}

/// What is out of range is refused with its reason, and nothing of it is in the sums.
#[test]
fn what_is_out_of_range_is_refused_and_counted() {
    fn refuse<E: NormalEngine>(make: impl Fn() -> E) {
        let good = data(1, 1.0, 8).swap_remove(0);
        let of = |weight: f64, value: Complex64| PlacedVisibilities {
            weight: vec![weight],
            value_k_sr: vec![value],
            ..good.clone()
        };
        let mut engine = make();
        add(&mut engine, &of(4.0, Complex64::new(8.1e3, 0.0)));
        let before = bytes(&mut engine);
        for (bad, reason) in [
            (of(4.001, Complex64::ONE), Refusal::OutOfRange),
            (of(1e300, Complex64::ONE), Refusal::OutOfRange),
            // Nothing of it would be in the matrix, and something in the right-hand side.
            (of(4.0 * 0.5_f64.powi(43), Complex64::ONE), Refusal::OutOfRange),
            (of(1.0, Complex64::new(0.0, -1.65e4)), Refusal::OutOfRange),
            (of(f64::INFINITY, Complex64::ONE), Refusal::NotFinite),
            (of(-1.0, Complex64::ONE), Refusal::NotFinite),
            (of(1.0, Complex64::new(f64::NAN, 0.0)), Refusal::NotFinite),
        ] {
            for take in [E::add, E::remove] {
                let added = take(&mut engine, &bad).unwrap();
                assert_eq!(added.visibilities, 0);
                assert_eq!(added.refused, [(reason, 1)].into_iter().collect());
            }
        }
        assert!(bytes(&mut engine) == before);
        // More than there is cannot be taken out.
        let two = PlacedVisibilities { weight: vec![4.0; 2], ..part_twice(&of(4.0, Complex64::ONE)) };
        assert!(matches!(engine.remove(&two), Err(AccumulationError::NothingHeld(_))));
        let more = in_order(&make, &data(5, 4.0, 2));
        assert!(matches!(engine.subtract(more), Err(AccumulationError::Range)));
        assert!(bytes(&mut engine) == before);
    }
    refuse(|| pixel(2, PixelMethod::Centre, 4.0));
    refuse(|| harmonic(4.0));
    for weight_max in [0.0, -1.0, f64::NAN] {
        let setup = PixelSetup { weight_max, ..*pixel(1, PixelMethod::Centre, 1.0).setup() };
        assert!(PixelEngine::new(setup).is_err());
    }
}

/// An overflow is of one visibility: it is refused as `Full` and counted, and the others of its call go in.
#[test]
fn a_full_engine_refuses_what_it_has_no_room_for_and_takes_the_rest() {
    fn fill<E: NormalEngine>(make: impl Fn() -> E) {
        let block = data(1, 1.0, 8).swap_remove(0);
        let of = |weight: &[f64]| PlacedVisibilities {
            weight: weight.to_vec(),
            value_k_sr: vec![Complex64::ONE; weight.len()],
            time_s: vec![block.time_s[0]; weight.len()],
            r_i_m: vec![block.r_i_m[0]; weight.len()],
            r_j_m: vec![block.r_j_m[0]; weight.len()],
            ..block.clone()
        };
        let restore = |bytes: &Vec<u8>| E::restore(&mut bytes.as_slice()).unwrap();
        // Engines of 1, 2, 4, .. of the greatest weight, until there is no room for twice as much.
        let mut powers = vec![bytes(&mut in_order(&make, &[of(&[4.0])]))];
        loop {
            let last = &powers[powers.len() - 1];
            let mut twice = restore(last);
            match twice.merge(restore(last)) {
                Ok(()) => powers.push(bytes(&mut twice)),
                Err(error) => break assert!(matches!(error, AccumulationError::Range), "{error}"),
            }
        }
        // All of them but the first: room for one of the greatest weight.
        let mut engine = make();
        powers[1..].iter().for_each(|power| engine.merge(restore(power)).unwrap());
        let held = engine.counts().visibilities;
        assert_eq!(held, (u64::MAX >> (64 - powers.len())) - 1);
        let added = engine.add(&of(&[2.0, 4.0, 2.0, 4.0])).unwrap();
        assert_eq!(added.visibilities, 2);
        assert_eq!(added.refused, [(Refusal::Full, 2)].into_iter().collect());
        assert_eq!(engine.counts().visibilities, held + 2);
        // What went in comes out, and nothing else is there.
        assert_eq!(engine.remove(&of(&[2.0, 2.0])).unwrap().visibilities, 2);
        powers[1..].iter().for_each(|power| engine.subtract(restore(power)).unwrap());
        assert!(bytes(&mut engine) == bytes(&mut make()));
    }
    fill(|| pixel(2, PixelMethod::Centre, 4.0));
    fill(|| harmonic(4.0));
}

fn part_twice(block: &PlacedVisibilities) -> PlacedVisibilities {
    let twice = |k: usize| [k, k];
    let places: Vec<usize> = (0..block.len()).flat_map(twice).collect();
    PlacedVisibilities {
        time_s: places.iter().map(|&k| block.time_s[k]).collect(),
        r_i_m: places.iter().map(|&k| block.r_i_m[k]).collect(),
        r_j_m: places.iter().map(|&k| block.r_j_m[k]).collect(),
        value_k_sr: places.iter().map(|&k| block.value_k_sr[k]).collect(),
        weight: places.iter().map(|&k| block.weight[k]).collect(),
        ..block.clone()
    }
}
