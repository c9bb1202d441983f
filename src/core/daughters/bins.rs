//! Frequency bins of a channel and epochs of its samples.

/// Number of frequency bins over the channel.
pub const BINS: usize = 128;
/// Number of samples from one epoch to the next.
pub const HOP: usize = BINS / 2;
/// Number of bins on one side of the channel's centre that are processed together: one register of the widest kind.
pub(super) const HALF: usize = 16;

/// Frequency of a bin relative to the channel's centre, in channel widths.
pub(super) fn bin_offset(bin: usize) -> f64 {
    (bin as f64 + 0.5) / BINS as f64 - 0.5
}
