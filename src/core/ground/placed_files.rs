//! Placed and calibrated visibilities of downlink files, for what uses them other than as sums.

use std::path::PathBuf;

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
                Ok(Some(PlacedFrame::Visibilities(placed))) => {
                    if let Some(instrument) = &described {
                        take(instrument, &placed);
                    }
                }
                Ok(Some(PlacedFrame::NotMapped(counted))) => {
                    ledger.add_left_out(VisibilityReason::ChannelNotMapped, counted.visibilities);
                }
                Ok(_) => {}
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
