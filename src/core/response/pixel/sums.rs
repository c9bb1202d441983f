//! Visibilities of a sky by direct sums over its pixels, many pairs at a time.

use multiversion::multiversion;
use num_complex::Complex64;
use rayon::prelude::*;

use super::kernel::{CHUNK, ChunkDirections, KernelGeometry, PaddedChunk, dot64, total};
use super::{Directions, PairGeometry, ResponseError, SatelliteAntenna, SingleGeometry};
use crate::units::arithmetic::{cos_sin_turns, fraction_of_turn, fused};

const PAIRS_PER_TASK: usize = 32;

/// Directions that a task sums for all its pairs before the next section; they stay in the second-level cache.
const SECTION: usize = 32 * CHUNK;

/// Sums of a pair over a sky.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct SkySum {
    /// Sum of T A S_i S_j exp(-2 pi i u . n) dOmega, K sr.
    pub visibility_k_sr: Complex64,
    /// Sum of T A S_i S_j dOmega: the contribution of the sky to the system temperature, K sr.
    pub zero_spacing_k_sr: f64,
}

/// Computes the visibility and the zero-spacing sum of each pair, for a sky (K) at `directions`, `area_sr` each.
///
/// Fringes are `f32`, accurate to 1e-6. Each of 16 partial sums adds 16 products in `f32`; the rest is summed in `f64`.
/// The error is below 1e-6 of the zero-spacing sum for any number of pixels (1e-8 is typical, as fringe errors are not
/// correlated between pixels). The sums run on the current rayon pool, and do not depend on it.
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn sky_sums(
    pairs: &[PairGeometry],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<SkySum>, ResponseError> {
    prepare_and_sum(pairs, KernelGeometry::pair, directions, sky_k, area_sr)
}

/// Computes the auto-correlation power `Int T A S dn` of each satellite, K sr, for a sky (K) at `directions`, `area_sr` each.
/// Its accuracy is that of [`sky_sums`].
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn sky_powers(
    singles: &[SingleGeometry],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<f64>, ResponseError> {
    let sums = prepare_and_sum(singles, KernelGeometry::single, directions, sky_k, area_sr)?;
    Ok(sums.into_iter().map(|sum| sum.zero_spacing_k_sr).collect())
}

/// Computes [`sky_sums`] with individual antennas in place of the pairs' response.
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn antenna_sums(
    pairs: &[(PairGeometry, [SatelliteAntenna; 2])],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<SkySum>, ResponseError> {
    prepare_and_sum(pairs, KernelGeometry::antenna_pair, directions, sky_k, area_sr)
}

/// Computes [`sky_powers`] with individual antennas in place of the satellites' response.
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn antenna_powers(
    singles: &[(SingleGeometry, SatelliteAntenna)],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<f64>, ResponseError> {
    let sums = prepare_and_sum(singles, KernelGeometry::antenna_single, directions, sky_k, area_sr)?;
    Ok(sums.into_iter().map(|sum| sum.zero_spacing_k_sr).collect())
}

/// Computes the visibilities of each pair for four skies (K) at the same `directions`, K sr. Fringes are computed once for all
/// four; each result is bit-identical to that of [`sky_sums`].
///
/// # Errors
/// [`ResponseError::SkyLength`] unless each sky has one value for each direction.
pub fn four_sky_sums(
    pairs: &[PairGeometry],
    directions: &Directions,
    skies_k: [&[f32]; 4],
    area_sr: f64,
) -> Result<Vec<[Complex64; 4]>, ResponseError> {
    if let Some(sky) = skies_k.iter().find(|sky| sky.len() != directions.len()) {
        return Err(ResponseError::SkyLength { sky: sky.len(), directions: directions.len() });
    }
    let mut sums = vec![[Complex64::ZERO; 4]; pairs.len()];
    sums.par_chunks_mut(PAIRS_PER_TASK).zip(pairs.par_chunks(PAIRS_PER_TASK)).for_each(|(sums, pairs)| {
        let prepared: Vec<KernelGeometry> = pairs.iter().map(KernelGeometry::pair).collect();
        for first in (0..directions.len()).step_by(SECTION) {
            let range = first..directions.len().min(first + SECTION);
            let n = [&directions.x, &directions.y, &directions.z].map(|axis| &axis[range.clone()]);
            let skies_k = skies_k.map(|sky| &sky[range.clone()]);
            for (sums, pair) in sums.iter_mut().zip(&prepared) {
                let parts = sum_four_sections(pair, n, skies_k);
                sums.iter_mut().zip(parts).for_each(|(sum, [re, im])| *sum += Complex64::new(re, im));
            }
        }
        sums.iter_mut().flatten().for_each(|sum| *sum *= area_sr);
    });
    Ok(sums)
}

/// Computes [`sky_sums`] of geometries that `prepare` converts.
fn prepare_and_sum<G: Sync>(
    geometries: &[G],
    prepare: fn(&G) -> KernelGeometry,
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
            let prepared: Vec<KernelGeometry> = geometries.iter().map(prepare).collect();
            sum_prepared(sums, &prepared, directions, sky_k, area_sr);
        },
    );
    Ok(sums)
}

fn sum_prepared(
    sums: &mut [SkySum],
    prepared: &[KernelGeometry],
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) {
    for first in (0..sky_k.len()).step_by(SECTION) {
        let range = first..sky_k.len().min(first + SECTION);
        let (x, y, z) =
            (&directions.x[range.clone()], &directions.y[range.clone()], &directions.z[range.clone()]);
        for (sum, pair) in sums.iter_mut().zip(prepared) {
            let [re, im, zero] = sum_section(pair, [x, y, z], &sky_k[range.clone()]);
            sum.visibility_k_sr += Complex64::new(re, im);
            sum.zero_spacing_k_sr += zero;
        }
    }
    for sum in sums {
        sum.visibility_k_sr *= area_sr;
        sum.zero_spacing_k_sr *= area_sr;
    }
}

/// Sums over one section, without the area: real part, imaginary part and zero spacing.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_section(pair: &KernelGeometry, n: [&[f64]; 3], sky_k: &[f32]) -> [f64; 3] {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let ([[re, im]], zero) = section::<FMA, 1>(pair, n, [sky_k]);
    [re, im, zero]
}

/// Sums four skies over one section, without the area: real and imaginary part of each.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn sum_four_sections(pair: &KernelGeometry, n: [&[f64]; 3], skies_k: [&[f32]; 4]) -> [[f64; 2]; 4] {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    section::<FMA, 4>(pair, n, skies_k).0
}

/// Sums skies over one section: real and imaginary part of each, and the zero spacing of the first.
#[inline(always)]
fn section<const FMA: bool, const SKIES: usize>(
    pair: &KernelGeometry,
    n: [&[f64]; 3],
    skies_k: [&[f32]; SKIES],
) -> ([[f64; 2]; SKIES], f64) {
    let (mut totals, mut zero) = ([[0.0_f64; 2]; SKIES], 0.0);
    for first in (0..n[0].len()).step_by(CHUNK) {
        let range = first..n[0].len().min(first + CHUNK);
        let n = n.map(|axis| &axis[range.clone()]);
        let skies_k = skies_k.map(|sky| &sky[range.clone()]);
        let whole = (n.map(<&[f64; CHUNK]>::try_from), skies_k.map(<&[f32; CHUNK]>::try_from));
        let (sums, zero_of_chunk) = match whole {
            ([Ok(x), Ok(y), Ok(z)], skies_k) if skies_k.iter().all(Result::is_ok) => {
                // The default is never used, as all are complete.
                const ZEROS: &[f32; CHUNK] = &[0.0; CHUNK];
                chunk::<FMA, SKIES>(pair, [x, y, z], skies_k.map(|sky_k| sky_k.unwrap_or(ZEROS)))
            }
            _ => {
                let padded = skies_k.map(|sky_k| PaddedChunk::new(n, sky_k));
                let skies_k = padded.each_ref().map(|padded| &padded.sky_k);
                chunk::<FMA, SKIES>(pair, padded[0].directions(), skies_k)
            }
        };
        for (total, sum) in totals.iter_mut().flatten().zip(sums.iter().flatten()) {
            *total += sum;
        }
        zero += zero_of_chunk;
    }
    (totals, zero)
}

#[inline(always)]
fn chunk<const FMA: bool, const SKIES: usize>(
    pair: &KernelGeometry,
    n: ChunkDirections<'_>,
    skies_k: [&[f32; CHUNK]; SKIES],
) -> ([[f64; 2]; SKIES], f64) {
    let [x, y, z] = n;
    let mut turns = [0.0_f32; CHUNK];
    let mut seen = [[0.0_f32; CHUNK]; SKIES];
    for k in 0..CHUNK {
        turns[k] = fraction_of_turn(dot64::<FMA>(pair.u, x[k], y[k], z[k]));
        let sees = pair.sees::<FMA>(x[k], y[k], z[k]);
        for (seen, sky_k) in seen.iter_mut().zip(skies_k) {
            seen[k] = if sees { sky_k[k] } else { 0.0 };
        }
    }
    seen.iter_mut().for_each(|seen| pair.apply_antenna::<FMA, _>(n, seen));
    const LANES: usize = 16;
    let mut lanes = [[[0.0_f32; LANES]; 2]; SKIES];
    let mut zero = [0.0_f32; LANES];
    for (part, turns) in turns.as_chunks::<LANES>().0.iter().enumerate() {
        for k in 0..LANES {
            let (cos, sin) = cos_sin_turns::<FMA>(turns[k]);
            for (lanes, seen) in lanes.iter_mut().zip(&seen) {
                let seen = seen[part * LANES + k];
                lanes[0][k] = fused::<FMA>(seen, cos, lanes[0][k]);
                lanes[1][k] = fused::<FMA>(-seen, sin, lanes[1][k]);
            }
            zero[k] += seen[0][part * LANES + k];
        }
    }
    (lanes.map(|[re, im]| [total(&re), total(&im)]), total(&zero))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::units::vector::{cross, scale, unit};
    use std::f64::consts::PI;

    const MOON_M: f64 = 1.7371e6;

    /// A satellite on an orbit whose normal is not near an axis.
    fn single(response: AntennaResponse) -> SingleGeometry {
        let normal_hat = unit([0.3, -0.6, 0.5]);
        let r_m = scale(2.0371e6, unit(cross(normal_hat, [0.2, 0.1, -0.7])));
        SingleGeometry { r_m, normal_hat, moon_radius_m: MOON_M, response }
    }

    #[test]
    fn powers_of_a_uniform_sky_are_the_solid_angles() {
        const NSIDE: usize = 128;
        let directions = pixel_directions(NSIDE);
        let sky_k = vec![3.0_f32; directions.len()];
        let cos = (1.0 - (MOON_M / 2.0371e6).powi(2)).sqrt();
        // The sphere without the Moon's cap; for dipoles at right angles to the Moon, the integral of 1 - sin^2 t cos^2 p over it.
        let whole = 2.0 * PI * (1.0 + cos);
        let dipole = PI * ((1.0 + cos) + (1.0 + cos.powi(3)) / 3.0);
        for (response, expected) in
            [(AntennaResponse::Isotropic, whole), (AntennaResponse::DipoleNormal, dipole)]
        {
            let one = single(response);
            let area_sr = pixel_area_sr(NSIDE);
            let found = sky_powers(&[one], &directions.as_slice().into(), &sky_k, area_sr).unwrap()[0];
            // Some 4 x 128 pixels lie on the limb, each counted fully or not at all: a random error of half a pixel.
            let limb = 0.5 * 512.0_f64.sqrt() * area_sr / expected;
            assert!((found / (3.0 * expected) - 1.0).abs() < 4.0 * limb, "{response:?}: {found}");
            let exact: f64 = directions.iter().map(|&n_hat| one.envelope(n_hat)).sum();
            // The accuracy documented for sums of f32.
            assert!((found / (3.0 * exact * area_sr) - 1.0).abs() < 1e-6, "{response:?}");
        }
    }

    #[test]
    fn four_skies_together_have_the_bits_of_each_alone() {
        let n = pixel_directions(16);
        let directions = Directions::from(n.as_slice());
        let skies: [Vec<f32>; 4] = std::array::from_fn(|m| {
            n.iter().map(|n| 2.0 + (n[m % 3] * (m as f64 + 1.5)).sin() as f32).collect()
        });
        let pairs: Vec<PairGeometry> = (1..70)
            .map(|k| {
                let one = single(AntennaResponse::DipoleNormal);
                let along = scale(53.0 * f64::from(k), unit(cross(one.normal_hat, one.r_m)));
                PairGeometry {
                    r_i_m: one.r_m,
                    r_j_m: crate::units::vector::add(one.r_m, along),
                    frequency_hz: 1e7,
                    moon_radius_m: MOON_M,
                    response: AntennaResponse::DipoleNormal,
                }
            })
            .collect();
        let together = four_sky_sums(&pairs, &directions, skies.each_ref().map(Vec::as_slice), 0.5).unwrap();
        for (m, sky) in skies.iter().enumerate() {
            for (k, alone) in sky_sums(&pairs, &directions, sky, 0.5).unwrap().iter().enumerate() {
                assert_eq!(together[k][m], alone.visibility_k_sr, "sky {m}, pair {k}");
            }
        }
        let short = [&skies[0][..], &skies[1][1..], &skies[2][..], &skies[3][..]];
        assert!(four_sky_sums(&pairs, &directions, short, 0.5).is_err());
    }

    #[test]
    fn a_pair_that_comes_together_hears_what_one_hears() {
        let one = single(AntennaResponse::DipoleNormal);
        let directions = pixel_directions(32);
        // Brighter to one side, so that a wrong axis shows.
        let sky_k: Vec<f32> =
            directions.iter().map(|n| 2.0 + (n[0] + n[2]) as f32 + (n[1] * n[2]) as f32).collect();
        let area_sr = pixel_area_sr(32);
        let directions = Directions::from(directions.as_slice());
        let expected = sky_powers(&[one], &directions, &sky_k, area_sr).unwrap()[0];
        let pair = |apart_m: f64| PairGeometry {
            r_i_m: one.r_m,
            r_j_m: crate::units::vector::add(one.r_m, scale(apart_m, unit(cross(one.normal_hat, one.r_m)))),
            frequency_hz: 1e6,
            moon_radius_m: MOON_M,
            response: AntennaResponse::DipoleNormal,
        };
        let near = sky_sums(&[pair(0.5)], &directions, &sky_k, area_sr).unwrap()[0].zero_spacing_k_sr;
        // Half a metre is 2.5e-7 rad; the plane through both satellites is as exact as their distance, to 1e-9 m.
        assert!((near / expected - 1.0).abs() < 3e-6, "{near} {expected}");
        // At one position they define no plane, and the result is NaN.
        assert_eq!(pair(0.0).orbit_normal(), None);
        assert!(sky_sums(&[pair(0.0)], &directions, &sky_k, area_sr).unwrap()[0].zero_spacing_k_sr.is_nan());
    }
}
