//! Visibilities of a sky by direct sum over its pixels, many pairs at a time.

use multiversion::multiversion;
use num_complex::Complex64;
use rayon::prelude::*;

use super::kernel::{CHUNK, Prepared, cos_sin_turns, dot64, fraction, fused, total};
use super::{Directions, PairGeometry, ResponseError};

/// Pairs that one task takes over a stretch of the sky.
const PAIRS_PER_TASK: usize = 32;

/// Directions that a task takes over all its pairs before it goes on; they stay in the second-level cache.
const STRETCH: usize = 32 * CHUNK;

/// What a pair measures of a sky.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SkySum {
    /// Sum of T A S_i S_j exp(-2 pi i u . n) dOmega, K sr.
    pub visibility_k_sr: Complex64,
    /// Sum of T A S_i S_j dOmega: the system temperature that the sky makes, K sr.
    pub zero_spacing_k_sr: f64,
}

/// Visibility and zero-spacing sum of each pair, for a sky (K) at `directions`, `area_sr` each.
///
/// Fringes are `f32` to 1e-6; products are summed over 16 pixels apart in `f32` for 16 terms, then in
/// `f64`. The error is below 1e-6 of the zero-spacing sum whatever the number of pixels (fringe errors
/// are not correlated from pixel to pixel, so 1e-8 is typical). Runs on the current rayon pool; the
/// result does not depend on it.
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn sky_sums(
    pairs: &[PairGeometry],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<SkySum>, ResponseError> {
    sums_of(pairs, Prepared::new, directions, sky_k, area_sr)
}

/// As [`sky_sums`] for whatever `prepare` makes ready.
pub(super) fn sums_of<G: Sync>(
    geometries: &[G],
    prepare: fn(&G) -> Prepared,
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<SkySum>, ResponseError> {
    if sky_k.len() != directions.len() {
        return Err(ResponseError::SkyLength { sky: sky_k.len(), directions: directions.len() });
    }
    let mut sums = vec![SkySum::default(); geometries.len()];
    sums.par_chunks_mut(PAIRS_PER_TASK).zip(geometries.par_chunks(PAIRS_PER_TASK)).for_each(
        |(sums, geometries)| {
            let prepared: Vec<Prepared> = geometries.iter().map(prepare).collect();
            sum_prepared(sums, &prepared, directions, sky_k, area_sr);
        },
    );
    Ok(sums)
}

fn sum_prepared(
    sums: &mut [SkySum],
    prepared: &[Prepared],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) {
    for first in (0..sky_k.len()).step_by(STRETCH) {
        let range = first..sky_k.len().min(first + STRETCH);
        let (x, y, z) =
            (&directions.x[range.clone()], &directions.y[range.clone()], &directions.z[range.clone()]);
        for (sum, pair) in sums.iter_mut().zip(prepared) {
            let [re, im, zero] = sum_stretch(pair, [x, y, z], &sky_k[range.clone()]);
            sum.visibility_k_sr += Complex64::new(re, im);
            sum.zero_spacing_k_sr += zero;
        }
    }
    for sum in sums {
        sum.visibility_k_sr *= area_sr;
        sum.zero_spacing_k_sr *= area_sr;
    }
}

/// Sums over one stretch, without the area: real part, imaginary part, zero spacing.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_stretch(pair: &Prepared, n: [&[f64]; 3], sky_k: &[f32]) -> [f64; 3] {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    stretch::<FMA>(pair, n, sky_k)
}

#[inline(always)]
fn stretch<const FMA: bool>(pair: &Prepared, n: [&[f64]; 3], sky_k: &[f32]) -> [f64; 3] {
    let mut total = [0.0_f64; 3];
    let mut sky = [0.0_f32; CHUNK];
    let mut at = [[0.0_f64; CHUNK]; 3];
    for (k, values) in sky_k.chunks(CHUNK).enumerate() {
        let first = k * CHUNK;
        let last = first + values.len();
        let sums = match (values.try_into(), n.map(|c| <&[f64; CHUNK]>::try_from(&c[first..last]))) {
            (Ok(values), [Ok(x), Ok(y), Ok(z)]) => chunk::<FMA>(pair, [x, y, z], values),
            _ => {
                // The last chunk is filled with pixels of a cold sky.
                sky[..values.len()].copy_from_slice(values);
                sky[values.len()..].fill(0.0);
                for (at, n) in at.iter_mut().zip(n) {
                    at[..values.len()].copy_from_slice(&n[first..last]);
                }
                chunk::<FMA>(pair, [&at[0], &at[1], &at[2]], &sky)
            }
        };
        for (total, sum) in total.iter_mut().zip(sums) {
            *total += sum;
        }
    }
    total
}

#[inline(always)]
fn chunk<const FMA: bool>(pair: &Prepared, [x, y, z]: [&[f64; CHUNK]; 3], sky_k: &[f32; CHUNK]) -> [f64; 3] {
    let mut turns = [0.0_f32; CHUNK];
    let mut seen = [0.0_f32; CHUNK];
    for k in 0..CHUNK {
        turns[k] = fraction(dot64::<FMA>(pair.u, x[k], y[k], z[k]));
        let depth_i = dot64::<FMA>(pair.i_hat, x[k], y[k], z[k]) + pair.limb_i;
        let depth_j = dot64::<FMA>(pair.j_hat, x[k], y[k], z[k]) + pair.limb_j;
        seen[k] = if (depth_i >= 0.0) & (depth_j >= 0.0) { sky_k[k] } else { 0.0 };
    }
    if let Some(dipole) = pair.dipole {
        for k in 0..CHUNK {
            let along = dot64::<FMA>(dipole, x[k], y[k], z[k]) as f32;
            seen[k] *= fused::<FMA>(-along, along, 1.0);
        }
    }
    const LANES: usize = 16;
    let mut lanes = [[0.0_f32; LANES]; 3];
    for (turns, seen) in turns.as_chunks::<LANES>().0.iter().zip(seen.as_chunks::<LANES>().0) {
        for k in 0..LANES {
            let (cos, sin) = cos_sin_turns::<FMA>(turns[k]);
            lanes[0][k] = fused::<FMA>(seen[k], cos, lanes[0][k]);
            lanes[1][k] = fused::<FMA>(-seen[k], sin, lanes[1][k]);
            lanes[2][k] += seen[k];
        }
    }
    [total(&lanes[0]), total(&lanes[1]), total(&lanes[2])]
}
