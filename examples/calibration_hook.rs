//! A calibration step of one's own: one satellite's clock is late, and the hook takes the delay out again.
//!
//! To make such a hook part of the program, add it to `CalibrationHook` in `src/core/calibration/config.rs`.

mod common;

use std::error::Error;
use std::f64::consts::TAU;

use lunarray::calibration::{Calibration, CalibrationError, CalibrationReport, Calibrator, Identity};
use lunarray::downlink::DownlinkReader;
use lunarray::frames::{GroundFrame, PlacedFrame, PlacedVisibilities};
use lunarray::runtime::{Ledger, Outlet, Stage};
use num_complex::Complex64;

/// Removes a constant delay of one satellite.
struct ClockDelay {
    satellite: u8,
    delay_s: f64,
}

impl Calibration for ClockDelay {
    fn name(&self) -> &'static str {
        "clock delay"
    }

    fn apply(&mut self, block: &mut PlacedVisibilities) -> Result<CalibrationReport, CalibrationError> {
        // V_ij is the mean of E_i conj(E_j): a delay of i turns it one way, one of j the other.
        let sign = f64::from(u8::from(block.pair.i == self.satellite))
            - f64::from(u8::from(block.pair.j == self.satellite));
        let turn = Complex64::cis(sign * TAU * block.frequency_hz * self.delay_s);
        for value in &mut block.value_k_sr {
            *value *= turn;
        }
        // A phase alone leaves the weights as they are, and takes nothing out.
        Ok(CalibrationReport { kept: block.len(), unusable_gain: 0 })
    }
}

/// The visibilities of a downlink as they leave calibration with `hook`.
fn calibrated(
    frames: &[GroundFrame],
    hook: impl Calibration + 'static,
) -> Result<Vec<PlacedVisibilities>, CalibrationError> {
    let mut calibrator = Calibrator::new(Box::new(hook), Ledger::new());
    let mut out = Outlet::collect();
    for frame in frames {
        calibrator.step(frame.clone(), &mut out)?;
    }
    calibrator.finish(&mut out)?;
    let blocks = out.into_vec().into_iter().filter_map(|frame| match frame {
        PlacedFrame::Visibilities(block) => Some(block),
        _ => None,
    });
    Ok(blocks.collect())
}

fn main() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("small.ccsds");
    common::small_downlink(&file)?;
    let mut reader = DownlinkReader::open(&file)?;
    let mut frames = Vec::new();
    while let Some(frame) = reader.next_frame()? {
        frames.push(frame);
    }

    let plain = calibrated(&frames, Identity)?;
    let turned = calibrated(&frames, ClockDelay { satellite: 0, delay_s: 20e-9 })?;
    let mut largest = 0.0_f64;
    for (plain, turned) in plain.iter().zip(&turned) {
        for (a, b) in plain.value_k_sr.iter().zip(&turned.value_k_sr) {
            largest = largest.max((b / a).arg().to_degrees().abs());
        }
    }
    println!("{} blocks; phases turned by up to {largest:.1} degrees", turned.len());
    // 20 ns are 0.2 periods of the highest channel, 10 MHz.
    if (largest - 72.0).abs() < 1e-3 { Ok(()) } else { Err("not the phase that was asked for".into()) }
}
