//! Blocks whose arrays differ in length are errors that name the array, wherever they enter; no panics.

use lunarray::array::segments_for;
use lunarray::calibration::{Calibration, CalibrationError, CalibrationReport, Calibrator, Identity};
use lunarray::frames::{AntennaResponse, Flags, GroundFrame, PlacedVisibilities, VisibilityBlock};
use lunarray::imaging::{NormalEngine, PixelEngine, PixelSetup};
use lunarray::pipeline::Mission;
use lunarray::response::pixel::PixelMethod;
use lunarray::runtime::Ledger;
use lunarray::units::{MissionTime, Pair};
use num_complex::{Complex32, Complex64};

const MOON_RADIUS_M: f64 = 1_737_100.0;

fn placed() -> PlacedVisibilities {
    PlacedVisibilities {
        frequency_hz: 3e6,
        pair: Pair { i: 0, j: 1 },
        time_s: vec![0.0, 10.0],
        r_i_m: vec![[2.04e6, 0.0, 0.0]; 2],
        r_j_m: vec![[2.04e6, 100.0, 0.0]; 2],
        value_k_sr: vec![Complex64::ONE; 2],
        weight: vec![1e-8; 2],
        ..PlacedVisibilities::default()
    }
}

/// The arrays of a block, each by a value too few or too many.
fn odd() -> [(&'static str, PlacedVisibilities); 5] {
    let changed = |change: fn(&mut PlacedVisibilities)| {
        let mut block = placed();
        change(&mut block);
        block
    };
    [
        ("r_i_m", changed(|block| block.r_i_m.truncate(1))),
        ("r_j_m", changed(|block| block.r_j_m.push([0.0; 3]))),
        ("value_k_sr", changed(|block| block.value_k_sr.clear())),
        ("weight", changed(|block| block.weight.truncate(1))),
        ("duration_s", changed(|block| block.duration_s.push(1.0))),
    ]
}

#[test]
fn engines_refuse_blocks_of_unequal_lengths() {
    let mut engine = PixelEngine::new(PixelSetup {
        nside: 1,
        frequency_hz: 3e6,
        method: PixelMethod::Centre,
        moon_radius_m: MOON_RADIUS_M,
        response: AntennaResponse::Isotropic,
        companion_seed: 1,
        weight_max: 2e-8,
    })
    .unwrap();
    for (name, block) in odd() {
        for told in [engine.add(&block).unwrap_err(), engine.remove(&block).unwrap_err()] {
            let told = told.to_string();
            assert!(told.contains(&format!("values of {name}: expected ")), "{told}");
        }
    }
    assert_eq!(engine.counts().visibilities, 0);
    assert_eq!(engine.add(&placed()).unwrap().visibilities, 2);
}

/// Forgets weights.
struct Forgetful;

impl Calibration for Forgetful {
    fn name(&self) -> &'static str {
        "forgetful"
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        block.weight.pop();
        Ok(CalibrationReport { kept: block.len(), unusable_gain: 0 })
    }
}

/// A calibrator that knows instrument and positions.
fn calibrator(hook: impl Calibration + 'static) -> Calibrator {
    let mut calibrator = Calibrator::new(Box::new(hook), Ledger::new());
    let plan = Mission::dsl().channels(&[3e6]).set("spacecraft.duration_s", "1d").plan().unwrap();
    calibrator.accept(GroundFrame::Instrument(plan.instrument.clone())).unwrap();
    for segment in segments_for(&plan.array, MissionTime(0), MissionTime::from_seconds(3600.0), 60.0) {
        calibrator.accept(GroundFrame::Ephemeris(segment)).unwrap();
    }
    calibrator
}

#[test]
fn calibration_refuses_blocks_of_unequal_lengths_and_hooks_that_leave_such() {
    let block = VisibilityBlock {
        pair: Pair { i: 0, j: 1 },
        offset_ticks: vec![1_000_000, 11_000_000],
        duration_ticks: vec![5_000_000; 2],
        value_k_sr: vec![Complex32::ONE; 2],
        weight: vec![1e-8; 2],
        flags: vec![Flags::GOOD; 2],
        ..VisibilityBlock::default()
    };
    let odd = VisibilityBlock { flags: vec![Flags::GOOD], ..block.clone() };
    let told = calibrator(Identity).accept(GroundFrame::Visibilities(odd)).unwrap_err().to_string();
    assert!(told.contains("a block of visibilities of satellites 1 and 2 has 1 values of flags"), "{told}");
    assert!(calibrator(Identity).accept(GroundFrame::Visibilities(block.clone())).unwrap().is_some());
    let told = calibrator(Forgetful).accept(GroundFrame::Visibilities(block)).unwrap_err().to_string();
    assert!(told.contains("has 1 values of weight"), "{told}");
}
