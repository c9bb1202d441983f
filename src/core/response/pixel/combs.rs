//! Visibilities of a sky at equally spaced frequencies.
//!
//! From one frequency to the next each pixel's fringe rotates by the same angle, so that a product replaces the sine.

use multiversion::multiversion;
use num_complex::Complex64;

use super::kernel::{CHUNK, ChunkDirections, KernelGeometry, PaddedChunk, dot64, total};
use super::{Directions, PairGeometry, ResponseError};
use crate::units::arithmetic::{cos_sin_turns, fraction_of_turn, fused};

/// Comb of equally spaced frequencies `nu (1 + first + k step)`, with nu the frequency of the pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comb {
    /// Offset of the first frequency, as a fraction of the pair's frequency.
    pub first: f64,
    /// Spacing, as a fraction of the pair's frequency.
    pub step: f64,
    /// Number of frequencies.
    pub count: usize,
}

/// Number of partial sums of a chunk in `f32`, which are added in `f64`.
const LANES: usize = 16;

/// Computes the visibilities (K sr) of a sky (K) at `directions`, `area_sr` each, at the frequencies of `comb`: `comb.count`
/// values per pair.
///
/// Layout and accuracy are those of [`sky_sums`](super::sky_sums), except that each frequency adds an error of 1e-7 to the fringe.
/// The sums run on the calling thread.
///
/// # Errors
/// [`ResponseError::SkyLength`] unless there is one sky value for each direction.
pub fn comb_sums(
    pairs: &[PairGeometry],
    comb: Comb,
    directions: &Directions,
    sky_k: &[f32],
    area_sr: f64,
) -> Result<Vec<Complex64>, ResponseError> {
    if sky_k.len() != directions.len() {
        return Err(ResponseError::SkyLength { sky: sky_k.len(), directions: directions.len() });
    }
    let mut sums = vec![Complex64::ZERO; pairs.len() * comb.count];
    if comb.count == 0 {
        return Ok(sums);
    }
    for (sums, pair) in sums.chunks_exact_mut(comb.count).zip(pairs) {
        let pair = KernelGeometry::pair(pair);
        let axes = [&directions.x, &directions.y, &directions.z];
        for (k, values) in sky_k.chunks(CHUNK).enumerate() {
            let range = k * CHUNK..k * CHUNK + values.len();
            add_chunk(&pair, comb, axes.map(|axis| &axis[range.clone()]), values, sums);
        }
        for sum in sums {
            *sum *= area_sr;
        }
    }
    Ok(sums)
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn add_chunk(pair: &KernelGeometry, comb: Comb, n: [&[f64]; 3], sky_k: &[f32], sums: &mut [Complex64]) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let mut fringes = Fringes::EMPTY;
    match (<&[f32; CHUNK]>::try_from(sky_k), n.map(<&[f64; CHUNK]>::try_from)) {
        (Ok(sky_k), [Ok(x), Ok(y), Ok(z)]) => fringes.begin::<FMA>(pair, comb, [x, y, z], sky_k),
        _ => {
            let padded = PaddedChunk::new(n, sky_k);
            fringes.begin::<FMA>(pair, comb, padded.directions(), &padded.sky_k);
        }
    }
    for sum in sums {
        let [re, im] = fringes.sum_and_advance::<FMA>();
        *sum += Complex64::new(re, im);
    }
}

/// Contributions of a chunk's pixels at one frequency, and their rotation to the next frequency.
struct Fringes {
    re: [f32; CHUNK],
    im: [f32; CHUNK],
    turn_re: [f32; CHUNK],
    turn_im: [f32; CHUNK],
}

impl Fringes {
    const EMPTY: Self =
        Self { re: [0.0; CHUNK], im: [0.0; CHUNK], turn_re: [0.0; CHUNK], turn_im: [0.0; CHUNK] };

    #[inline(always)]
    fn begin<const FMA: bool>(
        &mut self,
        pair: &KernelGeometry,
        comb: Comb,
        n: ChunkDirections<'_>,
        sky_k: &[f32; CHUNK],
    ) {
        let [x, y, z] = n;
        let mut seen = [0.0_f32; CHUNK];
        let (mut first, mut step) = ([0.0_f32; CHUNK], [0.0_f32; CHUNK]);
        for k in 0..CHUNK {
            let turns = dot64::<FMA>(pair.u, x[k], y[k], z[k]);
            first[k] = fraction_of_turn(turns * (1.0 + comb.first));
            step[k] = fraction_of_turn(turns * comb.step);
            seen[k] = if pair.sees::<FMA>(x[k], y[k], z[k]) { sky_k[k] } else { 0.0 };
        }
        pair.apply_antenna::<FMA, _>(n, &mut seen);
        for k in 0..CHUNK {
            let (cos, sin) = cos_sin_turns::<FMA>(first[k]);
            self.re[k] = seen[k] * cos;
            self.im[k] = -seen[k] * sin;
            let (cos, sin) = cos_sin_turns::<FMA>(step[k]);
            self.turn_re[k] = cos;
            self.turn_im[k] = -sin;
        }
    }

    #[inline(always)]
    fn sum_and_advance<const FMA: bool>(&mut self) -> [f64; 2] {
        let mut lanes = [[0.0_f32; LANES]; 2];
        let parts = self.re.as_chunks_mut::<LANES>().0.iter_mut().zip(self.im.as_chunks_mut::<LANES>().0);
        let turns = self.turn_re.as_chunks::<LANES>().0.iter().zip(self.turn_im.as_chunks::<LANES>().0);
        for ((re, im), (turn_re, turn_im)) in parts.zip(turns) {
            for k in 0..LANES {
                lanes[0][k] += re[k];
                lanes[1][k] += im[k];
                let turned = fused::<FMA>(re[k], turn_re[k], -(im[k] * turn_im[k]));
                im[k] = fused::<FMA>(re[k], turn_im[k], im[k] * turn_re[k]);
                re[k] = turned;
            }
        }
        [total(&lanes[0]), total(&lanes[1])]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;
    use crate::response::pixel::exact;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};

    #[test]
    fn sums_over_a_channel_are_those_at_each_frequency() {
        // 3072 pixels, and fewer than whole chunks.
        let (directions, area_sr) = (&pixel_directions(16)[..2900], pixel_area_sr(16));
        let sky_k: Vec<f64> = (0..directions.len()).map(|k| 1e6 + 1e3 * (k % 97) as f64).collect();
        let fast_sky: Vec<f32> = sky_k.iter().map(|&value| value as f32).collect();
        // 100 km and 2 km apart at 2037 km from the Moon's centre.
        let at = |arc_m: f64| {
            let (sin, cos) = (arc_m / 2.037e6 + 0.3).sin_cos();
            [2.037e6 * cos, 2.037e6 * sin * 0.8, 2.037e6 * sin * 0.6]
        };
        for response in [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal] {
            let pair = |arc_m: f64| PairGeometry {
                r_i_m: at(0.0),
                r_j_m: at(arc_m),
                frequency_hz: 1e6,
                moon_radius_m: 1.7374e6,
                response,
            };
            let pairs = [pair(1e5), pair(2e3)];
            let comb = Comb { first: -4.6e-3, step: 5.75e-4, count: 17 };
            let found = comb_sums(&pairs, comb, &directions.into(), &fast_sky, area_sr).unwrap();
            for (pair, found) in pairs.iter().zip(found.chunks_exact(comb.count)) {
                for (k, found) in found.iter().enumerate() {
                    let factor = 1.0 + comb.first + comb.step * k as f64;
                    let there = PairGeometry { frequency_hz: pair.frequency_hz * factor, ..*pair };
                    let exact = exact::visibility(&there, directions, &sky_k, area_sr);
                    // At most 17 rotations of 1e-7 each, relative to the sum of all pixels' magnitudes.
                    let off = (found - exact.visibility_k_sr).norm() / exact.zero_spacing_k_sr;
                    assert!(off < 2e-6, "{k}: {off}");
                }
            }
        }
    }
}
