//! `lunarray corrupt`: what a link would make of a downlink.

use std::path::PathBuf;

use clap::Args;

use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::downlink::link::{LinkConfig, corrupt, truth_path};

/// Damage a downlink file as a link would, and tell the truth about it.
///
/// Takes a sound file of either format, pass by pass. "Frame" is a coded frame, or a packet where packets are sent
/// plain. All faults are off unless asked for; the same seed gives the same bytes. FILE.truth.json, beside
/// the new file, holds what cannot be recovered any more: frames by virtual channel and count, packets by APID
/// and count (of 46 bits; the sequence count is its lower 14), and why.
#[derive(Debug, Args)]
pub(super) struct CorruptArgs {
    /// Sound downlink file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// File to write.
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Seed of all faults.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Probability that a bit is wrong.
    #[arg(long, default_value_t = 0.0)]
    bit_error_rate: f64,
    /// Mean distance of bursts, bits; 0 for none.
    #[arg(long, default_value_t = 0.0)]
    burst_every_bits: f64,
    /// Mean length of bursts, bits.
    #[arg(long, default_value_t = 0.0)]
    burst_bits: f64,
    /// Probability that a bit of a burst is wrong.
    #[arg(long, default_value_t = 0.5)]
    burst_bit_error_rate: f64,
    /// Probability that a frame does not arrive.
    #[arg(long, default_value_t = 0.0)]
    frame_loss: f64,
    /// Probability that a pass does not arrive.
    #[arg(long, default_value_t = 0.0)]
    pass_loss: f64,
    /// Probability that a pass is cut off somewhere.
    #[arg(long, default_value_t = 0.0)]
    pass_cut: f64,
    /// Probability that a frame arrives twice.
    #[arg(long, default_value_t = 0.0)]
    duplicate: f64,
    /// Probability that a frame arrives later than it should.
    #[arg(long, default_value_t = 0.0)]
    reorder: f64,
    /// Greatest number of frames that it then comes too late by.
    #[arg(long, default_value_t = 16)]
    reorder_frames: u64,
    /// Probability that a pass arrives after the one that follows it.
    #[arg(long, default_value_t = 0.0)]
    pass_swap: f64,
    /// Probability that a coded frame loses or gains a bit.
    #[arg(long, default_value_t = 0.0)]
    bit_slip: f64,
    /// Frames at the end of each pass that a second station hears too, with faults of its own.
    #[arg(long, default_value_t = 0)]
    second_station_frames: u64,
    /// Print the truth as one JSON object instead of a few lines.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &CorruptArgs) -> CommandResult {
    let config = LinkConfig {
        bit_error_rate: args.bit_error_rate,
        burst_every_bits: args.burst_every_bits,
        burst_bits: args.burst_bits,
        burst_bit_error_rate: args.burst_bit_error_rate,
        frame_loss: args.frame_loss,
        pass_loss: args.pass_loss,
        pass_cut: args.pass_cut,
        duplicate: args.duplicate,
        reorder: args.reorder,
        reorder_frames: args.reorder_frames,
        pass_swap: args.pass_swap,
        bit_slip: args.bit_slip,
        second_station_frames: args.second_station_frames,
    };
    let truth = corrupt(&args.file, &args.out, &config, args.seed)?;
    if args.json {
        print_json_line(&truth)?;
    } else {
        let place = truth_path(&args.out);
        print_text(&format!(
            "{truth}\nThe downlink is in {}, the truth in {}",
            args.out.display(),
            place.display()
        ))?;
    }
    Ok(Completion::Done)
}
