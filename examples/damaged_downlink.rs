//! A link that loses packets: the ground maps what is left, and its ledger says what was lost.

mod common;

use std::error::Error;

use lunarray::downlink::link::{LinkConfig, corrupt};
use lunarray::frames::VisibilityReason;

fn main() -> Result<(), Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let (whole, damaged) = (folder.path().join("whole.ccsds"), folder.path().join("damaged.ccsds"));
    let mission = common::small_mission();
    mission.simulate(&whole)?;
    let link = LinkConfig { frame_loss: 0.05, ..LinkConfig::default() };
    let truth = corrupt(&whole, &damaged, &link, 7)?;
    println!("{} packets sent, {} arrived", truth.frames_sent, truth.frames_recoverable);

    let summary = mission.out(folder.path().join("maps")).replay(&[damaged])?;
    let ledger = &summary.ledger;
    let (lost, unplaced) = (ledger.lost_total(), ledger.count(VisibilityReason::NoEphemeris));
    println!(
        "of {} visibilities sampled {lost} were lost, {unplaced} more lost their ephemeris; {} are in the maps of {} channels",
        ledger.sampled,
        ledger.accumulated,
        summary.channels.len()
    );
    // A visibility needs its own packet and some four of ephemerides: 1 - 0.95^5 = 0.23 at most, and two standard deviations.
    let part = (lost as f64 + unplaced as f64) / ledger.sampled as f64;
    if (0.02..0.3).contains(&part) { Ok(()) } else { Err("not the loss that was asked for".into()) }
}
