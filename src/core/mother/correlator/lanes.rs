//! The order of samples and products in the kernels.

/// Channels that are processed together.
pub const LANES: usize = 16;
/// Samples per slice: 16 kB for eight daughters.
pub const SLICE: usize = 16;

/// Index of the product of daughters `i <= j`.
#[must_use]
pub fn product(i: usize, j: usize) -> usize {
    j * (j + 1) / 2 + i
}

/// Sums over a dump: by product, real and imaginary parts of `x_i conj(x_j)`, one value per channel.
pub type ProductSums = Vec<[[f32; LANES]; 2]>;
