//! Rates of one core, measured once, from which times are estimated.
//!
//! The machine: a virtual machine with 2 cores of an AMD EPYC without AVX-512; the figures are those of `docs/evidence.md`'s
//! table of speeds, halved where they are for both cores. Another machine is faster or slower by some factor: what counts is which part takes longest, and
//! whether it is minutes or days.

/// Multiply-adds of the pixel engine's rank-k updates in a second, rows of B included (`lunarray run` of the embedded
/// quicklook with its maps in pixels).
pub(crate) const RANK_K_MULTIPLY_ADDS_PER_S: f64 = 1.0e10;

/// Time of an element of a row at pixel centres in a product of two vectors, s: made, and used there and back. 1.1 ns with AVX-512 (first
/// case of `pipelines/paper/fig16-nside64.toml`, processor time), taken to be twice as much without.
pub(crate) const CENTRE_ELEMENT_S: f64 = 2.2e-9;

/// The same of a row averaged over pixels: 5.6 ns with AVX-512 beside other work.
pub(crate) const AVERAGE_ELEMENT_S: f64 = 6e-9;

/// The same of a row averaged child by child in f64: 256 sines, not measured.
pub(crate) const EXACT_ELEMENT_S: f64 = 1e-5;

/// Multiply-adds of a Cholesky factorisation in a second: its panels keep one of two cores waiting.
pub(crate) const CHOLESKY_MULTIPLY_ADDS_PER_S: f64 = 0.5 * RANK_K_MULTIPLY_ADDS_PER_S;

/// Visibilities that the harmonic engine adds in a second, at any degree (bench `harmonic`).
pub(crate) const HARMONIC_VISIBILITIES_PER_S: f64 = 4e5;

/// Time of a row at true positions on one core, s, in units of `l_max (l_max + 2 pi u)`, for both products of two skies: 1.7 ms at
/// l = 191 and u = 125 (bench `general`; half of it with AVX-512).
pub(crate) const ROW_S: f64 = 1e-8;

/// Visibilities for one computed row, the others being interpolated (bench `general`: 49; 41 of a mission; less where
/// integrations are left out).
pub(crate) const VISIBILITIES_PER_ROW: f64 = 40.0;

/// Time of the interpolation of a visibility at one instant, s (0.9 us with AVX-512: what averages cost in bench `general`).
pub(crate) const INTERPOLATION_S: f64 = 2e-6;

/// Passes over the visibilities that a refined map usually takes, at most.
pub(crate) const REFINED_PASSES: f64 = 5.0;

/// Time of an inner solution of a refinement, of that of a map: its residual is a hundred times as large. A third was found at 10 MHz from
/// every integration; more where data are few.
pub(crate) const INNER_SOLUTION: f64 = 0.5;

/// Instants of an average over an integration, on average: two for an eighth of a wavelength of motion, more where baselines are short.
pub(crate) const AVERAGE_INSTANTS: f64 = 2.5;

/// Multiply-adds of Fourier transforms of lines of 300 to 900 points in a second (bench `harmonic`: products with
/// BtN^-1B, which are four transforms a line).
pub(crate) const TRANSFORM_MULTIPLY_ADDS_PER_S: f64 = 6e9;

/// Cores that work inside stages.
pub(crate) fn cores() -> f64 {
    rayon::current_num_threads() as f64
}
