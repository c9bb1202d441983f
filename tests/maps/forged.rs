//! Data that a checksum does not tell from a spacecraft's, and that no spacecraft sends: they end no ground.

use std::sync::Arc;

use lunarray::array::{Array, ArrayConfig};
use lunarray::frames::{
    AntennaResponse, Channel, Instrument, PlacedFrame, PlacedVisibilities, VisibilityReason,
};
use lunarray::imaging::Samples;
use lunarray::imaging::anywhere::AssumedInstrument;
use lunarray::imaging::anywhere::RefineRule;
use lunarray::imaging::{
    Accumulator, EngineKind, MapConfig, NormalEngine, PixelEngine, PixelSetup, RefineConfig, Snapshot,
    SumCounts,
};
use lunarray::imaging::{SolveError, SolveWatch, Solver, SolverSetup, StoppingRule};
use lunarray::response::pixel::PixelMethod;
use lunarray::runtime::{Ledger, Outlet, Stage};
use lunarray::units::vector::{norm, scale};
use lunarray::units::{ChannelId, Pair, PerChannel};
use num_complex::Complex64;

pub fn instrument() -> Instrument {
    Instrument {
        name: "forged".to_owned(),
        epoch_tai_s: 2e9,
        moon_radius_m: ArrayConfig::default().moon_radius_m,
        satellites: 8,
        channels: vec![Channel { frequency_hz: 3e6, width_hz: 8e3 }],
        response: AntennaResponse::Isotropic,
        seed: 0,
        configuration_hash: 0,
        spectrometer: None,
        noiseless: false,
    }
}

/// Visibilities of the shortest pair over an orbit, of this weight, (K sr)^-2.
pub fn block(weight: f64) -> PlacedVisibilities {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let times_s: Vec<f64> = (0..40).map(|k| 200.0 * f64::from(k)).collect();
    let at = |n: usize| times_s.iter().map(|&time_s| array.position_m(n, time_s)).collect();
    PlacedVisibilities {
        channel: ChannelId(0),
        frequency_hz: 3e6,
        pair: Pair { i: 0, j: 1 },
        r_i_m: at(0),
        r_j_m: at(1),
        value_k_sr: vec![Complex64::new(0.5 / weight.sqrt(), 0.0); times_s.len()],
        weight: vec![weight; times_s.len()],
        time_s: times_s,
        ..PlacedVisibilities::default()
    }
}

/// The same with all positions at a part of their distance from the Moon's centre.
fn lowered(block: &PlacedVisibilities, part: f64) -> PlacedVisibilities {
    let lower = |places: &[[f64; 3]]| places.iter().map(|&place| scale(part, place)).collect();
    PlacedVisibilities { r_i_m: lower(&block.r_i_m), r_j_m: lower(&block.r_j_m), ..block.clone() }
}

#[test]
fn positions_just_above_the_surface_or_far_away_end_no_refined_ground() {
    let (good, moon_m) = (block(1e-11), instrument().moon_radius_m);
    let heights = [(moon_m + 40.0) / norm(good.r_i_m[0]), 1.0, 1e4];
    for part in heights {
        // All that is moved is the place of both: the baseline stays.
        let shift = |places: &[[f64; 3]]| -> Vec<[f64; 3]> {
            let by = |k: usize| scale(part - 1.0, good.r_i_m[k]);
            places
                .iter()
                .enumerate()
                .map(|(k, place)| std::array::from_fn(|axis| place[axis] + by(k)[axis]))
                .collect()
        };
        let mut bad =
            PlacedVisibilities { r_i_m: shift(&good.r_i_m), r_j_m: shift(&good.r_j_m), ..good.clone() };
        let ledger = Ledger::new();
        let refine = RefineConfig { passes_max: 1, ..RefineConfig::default() };
        let map = MapConfig {
            engine: EngineKind::Harmonic,
            nside: 4,
            refine,
            snapshot_every_s: 5e3,
            ..MapConfig::default()
        };
        let mut accumulator = Accumulator::new(map, ledger.clone());
        let mut out = Outlet::collect();
        accumulator.step(PlacedFrame::Instrument(instrument()), &mut out).unwrap();
        for _ in 0..2 {
            ledger.add_sampled(bad.len() as u64);
            accumulator.step(PlacedFrame::Visibilities(bad.clone()), &mut out).unwrap();
            bad.time_s.iter_mut().for_each(|time_s| *time_s += 1e4);
        }
        assert!(out.into_vec().iter().any(|snapshot| !snapshot.is_final), "{part}");
    }
}

#[test]
fn positions_within_the_moon_make_no_engine_and_end_nothing() {
    let good = block(1e-11);
    for part in [0.5, 1e-3] {
        let bad = lowered(&good, part);
        assert!(norm(bad.r_i_m[0]) < instrument().moon_radius_m);
        let ledger = Ledger::new();
        let map = MapConfig { engine: EngineKind::Harmonic, nside: 4, ..MapConfig::default() };
        let mut accumulator = Accumulator::new(map, ledger.clone());
        let mut out = Outlet::collect();
        let count = good.len() as u64;
        accumulator.step(PlacedFrame::Instrument(instrument()), &mut out).unwrap();
        for placed in [&bad, &good] {
            ledger.add_sampled(count);
            accumulator.step(PlacedFrame::Visibilities(placed.clone()), &mut out).unwrap();
        }
        accumulator.finish(&mut out).unwrap();
        let report = ledger.balanced_report().unwrap();
        assert_eq!((report.count(VisibilityReason::OffAltitude), report.accumulated), (count, count));
        assert_eq!(out.into_vec().len(), 1);
    }
}

/// An instrument that replaces another has its own frequency: what is beyond its map is that of its baselines in wavelengths.
#[test]
fn what_is_beyond_follows_the_instrument() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("power.csv");
    let table: String = (0..60).map(|l| format!("{l},{}\n", 1e12 / f64::from(l + 1).powi(2))).collect();
    std::fs::write(&path, table).unwrap();
    let at = |frequency_hz: f64| {
        let channels = vec![Channel { frequency_hz, width_hz: 8e3 }];
        let block = PlacedVisibilities { frequency_hz, ..block(1e-9) };
        [PlacedFrame::Instrument(Instrument { channels, ..instrument() }), PlacedFrame::Visibilities(block)]
    };
    let weight = |frames: Vec<PlacedFrame>| {
        let map = MapConfig {
            nside: 1,
            baseline_bp_max: 100.0,
            beyond_files: vec![path.clone()],
            ..MapConfig::default()
        };
        let mut accumulator = Accumulator::new(map, Ledger::new());
        let mut out = Outlet::collect();
        frames.into_iter().for_each(|frame| accumulator.step(frame, &mut out).unwrap());
        accumulator.finish(&mut out).unwrap();
        out.into_vec().pop().unwrap().data.counts().weight
    };
    let [first, alone] = [3e6, 6e6].map(|frequency_hz| weight(at(frequency_hz).into()));
    assert!(first != alone && alone < 40e-9, "{first} {alone}");
    assert_eq!(weight([at(3e6), at(6e6)].concat()), alone);
}

/// Settings of a solver without anything special.
pub fn solver_setup(watch: SolveWatch) -> SolverSetup {
    SolverSetup {
        epsilon: PerChannel::All(1e-4),
        regularisers: Vec::new(),
        beams_deg: Vec::new(),
        prior_k: PerChannel::All(0.0),
        prior_maps: Vec::new(),
        prior_hz: Vec::new(),
        moon_reflection: 0.0,
        rule: StoppingRule { residual_max: 1e-4, iterations_max: 100 },
        refine: RefineRule { passes_max: 0, residual_max: 1e-4 },
        assumed: AssumedInstrument::default(),
        iteration_folder: None,
        trace_probes: 0,
        samples: Samples::default(),
        kept: None,
        watch,
    }
}

/// Weights that rounding leaves nothing of: counted, and a matrix of zeros.
#[test]
fn a_snapshot_that_determines_no_map_waits_for_more() {
    let solve = |is_final: bool| {
        let setup = PixelSetup {
            nside: 2,
            frequency_hz: 3e6,
            method: PixelMethod::Average,
            moon_radius_m: instrument().moon_radius_m,
            response: AntennaResponse::Isotropic,
            companion_seed: 1,
            weight_max: 1.0,
        };
        let mut sums = PixelEngine::new(setup).unwrap().into_sums();
        sums.counts = SumCounts { visibilities: 4, weight: 1e-12, power: 0.0 };
        let snapshot = Snapshot {
            instrument: Arc::new(instrument()),
            channel: ChannelId(0),
            number: 1,
            is_final,
            span_s: [0.0, 1.0],
            nside: 2,
            data: Box::new(sums),
        };
        let setup = solver_setup(SolveWatch::default());
        let mut maps = Outlet::collect();
        let solved = Solver::new(setup).step(snapshot, &mut maps);
        (solved, maps.into_vec().len())
    };
    assert_eq!(solve(false), (Ok(()), 0));
    assert!(matches!(solve(true), (Err(SolveError::NotPositive { .. }), 0)));
}
