//! Measured rates of one core, from which times are estimated.
//!
//! They are processor times from virtual machines with 2 cores: of an AMD EPYC without AVX-512 where nothing else is said (the table of speeds
//! in `docs/evidence.md`), of an Intel Xeon with it for rows over pixels and numbers of iterations. On other machines estimates are off by
//! some factor, but still show which part takes longest, and whether it takes minutes or days.

/// Multiply-adds per second of the pixel engine's rank-k updates, rows of B included (`lunarray run` of the embedded
/// quicklook with pixel maps).
pub const RANK_K_MULTIPLY_ADDS_PER_S: f64 = 1.0e10;

/// Time per row element at pixel centres in a matrix product for two vectors, s: computed, and used forward and back. Measured as 1.1 ns
/// with AVX-512 (first case of `pipelines/paper/fig16-nside64.toml`, processor time), and assumed to be twice that without.
pub const CENTRE_ELEMENT_S: f64 = 2.2e-9;

/// Time per row element averaged over pixels, s, times nside: the blocks at the Moon's limb are a share of all pixels that falls with nside.
/// With AVX-512 on a busy machine, 64 to 90 ns at nside 8, 24 to 30 ns at 16, 14 ns at 32 and 5.6 ns at 64.
pub const AVERAGE_ELEMENT_S: f64 = 5e-7;

/// Time per row element averaged child by child in f64 (256 sines), s; not measured.
pub const EXACT_ELEMENT_S: f64 = 1e-5;

/// Multiply-adds per second of a Cholesky factorisation, whose panels keep one of two cores waiting.
pub const CHOLESKY_MULTIPLY_ADDS_PER_S: f64 = 0.5 * RANK_K_MULTIPLY_ADDS_PER_S;

/// Visibilities per second that the harmonic engine adds, at any degree (bench `harmonic`).
pub const HARMONIC_VISIBILITIES_PER_S: f64 = 4e5;

/// Time of a row at true positions, s, in units of `l_max (l_max + 2 pi u)`, for both products of two skies: 1.7 ms at l = 191 and u = 125
/// (bench `general`; half of it with AVX-512).
pub const ROW_S: f64 = 1e-8;

/// Time of such a row whatever its degree, s: 0.10 ms of products at l = 20 and u = 16 (with AVX-512, on a busy machine).
pub const ROW_FIXED_S: f64 = 1e-4;

/// Visibilities per computed row; the other rows are interpolated. 49 in bench `general`, 41 in a mission. Where integrations are left out,
/// the second number over theirs: 4.7 with every fourth.
pub const VISIBILITIES_PER_ROW: [f64; 2] = [40.0, 20.0];

/// Time of the interpolation of a visibility at one instant, s (0.9 us with AVX-512, from averages in bench `general`).
pub const INTERPOLATION_S: f64 = 2e-6;

/// Usual maximum number of iterations of a refined map, each of which uses all visibilities.
pub const REFINED_ITERATIONS: f64 = 5.0;

/// Time of an inner solution of a refinement as a fraction of that of a map, because it stops at a hundred times larger residual. A third was
/// measured at 10 MHz with every integration; more where data are few.
pub const INNER_SOLUTION_FRACTION: f64 = 0.5;

/// Mean number of instants in the average over an integration: two for a motion of an eighth of a wavelength, more on short baselines.
pub const AVERAGE_INSTANTS: f64 = 2.5;

/// Multiply-adds per second of Fourier transforms of 300 to 900 points (bench `harmonic`: products with BtN^-1B, four transforms per line).
pub const TRANSFORM_MULTIPLY_ADDS_PER_S: f64 = 6e9;

/// Number of cores that work on the inner loops of stages.
pub fn cores() -> f64 {
    rayon::current_num_threads() as f64
}
