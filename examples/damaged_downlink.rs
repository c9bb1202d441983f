//! A link that loses packets: the ground maps what is left, and its ledger says what was lost.

mod common;

use std::error::Error;

use lunarray::downlink::link::{LinkConfig, corrupt};

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
    let part = ledger.accumulated as f64 / ledger.sampled as f64;
    println!(
        "{} visibilities sampled, {:.1} % in the maps of {} channels",
        ledger.sampled,
        100.0 * part,
        summary.channels.len()
    );
    // As many packets are lost as were to be, to some standard deviations; repeated descriptions are not missed.
    if (0.7..0.99).contains(&part) { Ok(()) } else { Err("not the loss that was asked for".into()) }
}
