//! Placed and calibrated visibilities of downlink files, for what uses them other than as sums.

use std::path::PathBuf;

use super::burst_watch::BurstWatch;
use super::core::missing_packets;
use super::{Collector, GroundConfig, GroundError};
use crate::calibration::CalibrationHook;
use crate::frames::{GroundFrame, Instrument, PlacedFrame, PlacedVisibilities, VisibilityReason};
use crate::runtime::Ledger;

/// Reads downlink files, each packet once, and passes the visibilities of the channels of `config.group` to `take`, with the description of
/// the instrument after calibration. `ledger` counts all others with their reasons, and those sampled.
///
/// # Errors
/// Files that cannot be read, of another instrument than the first, or without a description of one; a calibration that cannot be used, or
/// that is found from the data (calibration.hook = "solve").
pub fn read_placed(
    config: &GroundConfig,
    files: &[PathBuf],
    ledger: &Ledger<VisibilityReason>,
    take: &mut dyn FnMut(&Instrument, &PlacedVisibilities),
) -> Result<(), GroundError> {
    read_frames(config, files, ledger, &mut |instrument, frame| {
        if let PlacedFrame::Visibilities(placed) = frame {
            take(instrument, &placed);
        }
    })
}

/// Reads downlink files as [`read_placed`] does, and passes on the blocks of each pass, by channel. A pass ends as it does where bursts are
/// looked for while data arrive, so that as much is in memory.
///
/// # Errors
/// Those of [`read_placed`].
pub fn read_passes(
    config: &GroundConfig,
    files: &[PathBuf],
    ledger: &Ledger<VisibilityReason>,
    take: &mut dyn FnMut(&Instrument, &[Vec<PlacedVisibilities>]),
) -> Result<(), GroundError> {
    let (mut watch, mut last) = (BurstWatch::default(), None);
    read_frames(config, files, ledger, &mut |instrument, frame| {
        if watch.is_ended_by(&frame) {
            take(instrument, &watch.take());
        }
        if let PlacedFrame::Visibilities(placed) = frame {
            ledger.add_accumulated(placed.len() as u64);
            watch.keep(placed, &[], false);
            last.get_or_insert_with(|| instrument.clone());
        }
    })?;
    if let Some(instrument) = last {
        take(&instrument, &watch.take());
    }
    Ok(())
}

fn read_frames(
    config: &GroundConfig,
    files: &[PathBuf],
    ledger: &Ledger<VisibilityReason>,
    take: &mut dyn FnMut(&Instrument, PlacedFrame),
) -> Result<(), GroundError> {
    if config.calibration.hook == CalibrationHook::Solve {
        return Err(GroundError::GainsFromData);
    }
    let mut collector = Collector::new(config.wait_bytes);
    let mut calibrator = config.calibrator(None, ledger)?;
    let (mut described, mut failure) = (None, None);
    for file in files {
        collector.read_file(file, &mut |delivery| {
            let Some(frame) = delivery.frame else { return };
            if let GroundFrame::Visibilities(block) = &frame {
                let bad = |packet: &super::DeliveredPacket| u64::from(packet.counts.visibilities_bad_value);
                calibrator.count_bad(block.start, delivery.packets.iter().map(bad).sum());
            }
            match calibrator.accept(frame) {
                Ok(Some(PlacedFrame::Instrument(instrument))) => described = Some(instrument),
                Ok(Some(PlacedFrame::NotMapped(counted))) => {
                    ledger.add_left_out(VisibilityReason::ChannelNotMapped, counted.visibilities);
                }
                Ok(Some(frame)) => {
                    if let Some(instrument) = &described {
                        take(instrument, frame);
                    }
                }
                Ok(None) => {}
                Err(error) => failure = failure.take().or(Some(error)),
            }
        })?;
        if let Some(error) = failure.take() {
            return Err(error.into());
        }
    }
    // It is in the summary: what is missing counts as not received.
    let _ = calibrator.post_losses(missing_packets(&collector, &calibrator));
    Ok(())
}
