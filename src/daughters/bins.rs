//! The frequency bins of a channel and the epochs of its samples: sizes that the folder shares.

/// Frequency bins over the channel.
pub const BINS: usize = 128;
/// Samples from one epoch to the next.
pub const HOP: usize = BINS / 2;
/// Bins on one side of the channel's centre that are processed together: one register of the widest kind.
pub(super) const HALF: usize = 16;

/// Frequency of a bin relative to the channel's centre, in channel widths.
pub(super) fn bin_offset(bin: usize) -> f64 {
    (bin as f64 + 0.5) / BINS as f64 - 0.5
}
