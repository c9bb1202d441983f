//! `lunarray corrupt`: apply the faults of a link to a downlink file.

use std::path::PathBuf;

use clap::Args;

use super::arguments::{input_path, output_path, require_repeatable};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::downlink::link::{LinkConfig, corrupt, truth_path};

/// Damage a downlink file as a faulty link would, and record what was damaged.
///
/// Reads an intact file of either format, pass by pass. "Frame" means a coded frame, or a packet in a file of plain
/// packets. All faults are off by default; the same seed gives the same bytes. FILE.truth.json, beside the new file,
/// lists what cannot be recovered and why: frames by virtual channel and count, packets by APID and 46-bit count (the
/// sequence count is its lower 14 bits).
///
/// Example: lunarray corrupt sky.cadu --out bad.cadu --frame-loss 0.01 --seed 3
#[derive(Debug, Args)]
pub(super) struct CorruptArgs {
    /// Intact downlink file.
    #[arg(value_name = "FILE", value_parser = input_path())]
    file: PathBuf,
    /// Damaged file to write.
    #[arg(short, long, value_name = "FILE", value_parser = output_path())]
    out: PathBuf,
    /// Seed of all faults.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Bit error probability.
    #[arg(long, default_value_t = 0.0)]
    bit_error_rate: f64,
    /// Mean distance between error bursts, bits; 0 for none.
    #[arg(long, default_value_t = 0.0)]
    burst_every_bits: f64,
    /// Mean length of an error burst, bits.
    #[arg(long, default_value_t = 0.0)]
    burst_bits: f64,
    /// Bit error probability within a burst.
    #[arg(long, default_value_t = 0.5)]
    burst_bit_error_rate: f64,
    /// Probability that a frame is lost.
    #[arg(long, default_value_t = 0.0)]
    frame_loss: f64,
    /// Probability that a whole pass is lost.
    #[arg(long, default_value_t = 0.0)]
    pass_loss: f64,
    /// Probability that a pass is cut short.
    #[arg(long, default_value_t = 0.0)]
    pass_cut: f64,
    /// Probability that a frame is duplicated.
    #[arg(long, default_value_t = 0.0)]
    duplicate: f64,
    /// Probability that a frame is delayed.
    #[arg(long, default_value_t = 0.0)]
    reorder: f64,
    /// Maximum delay of a delayed frame, frames.
    #[arg(long, default_value_t = 16)]
    reorder_frames: u64,
    /// Probability that a pass is swapped with the next one.
    #[arg(long, default_value_t = 0.0)]
    pass_swap: f64,
    /// Probability that a coded frame loses or gains a bit.
    #[arg(long, default_value_t = 0.0)]
    bit_slip: f64,
    /// Number of frames at the end of each pass that a second station also receives, with faults of its own.
    #[arg(long, default_value_t = 0)]
    second_station_frames: u64,
    /// Print the record of the damage as one JSON object instead of a summary.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &CorruptArgs) -> CommandResult {
    require_repeatable(&args.file, "its beginning is read twice")?;
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
            "{truth}\nWrote the downlink to {} and the record of its damage to {}",
            args.out.display(),
            place.display()
        ))?;
    }
    Ok(Completion::Done)
}
