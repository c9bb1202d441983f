//! From independent noise to noise of a given covariance, many frequencies at a time.

use multiversion::multiversion;

/// Frequencies that are worked on together: two registers of the widest kind.
pub(super) const TILE: usize = 32;

/// Smallest pivot of a covariance, as a part of its diagonal: below lies the rounding of `f32`.
const PIVOT_MIN: f32 = 4e-6;

/// Matrices of one tile of frequencies: lower triangles, row after row, `TILE` values an element.
#[derive(Clone, Debug)]
pub(super) struct Tile {
    pub re: Vec<[f32; TILE]>,
    pub im: Vec<[f32; TILE]>,
}

/// What had to be done to covariances.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Repairs {
    /// Matrices' diagonal elements looked at.
    pub pivots: u64,
    /// Those to which noise was added so that a matrix became one of a covariance.
    pub repaired: u64,
    /// Most noise that was added, as a part of the daughter's power.
    pub added_max: f32,
}

impl Repairs {
    /// Adds what another part has counted.
    pub fn absorb(&mut self, other: Self) {
        self.pivots += other.pivots;
        self.repaired += other.repaired;
        self.added_max = self.added_max.max(other.added_max);
    }
}

/// Place of element (i, j), i >= j, of a lower triangle.
pub(super) fn element(i: usize, j: usize) -> usize {
    i * (i + 1) / 2 + j
}

impl Tile {
    pub(super) fn new(order: usize) -> Self {
        let elements = element(order, 0);
        Self { re: vec![[0.0; TILE]; elements], im: vec![[0.0; TILE]; elements] }
    }
}

/// `out = sum of coefficient x basis row`, `sign` times.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn expand(coefficients: &[f32], basis: &[[f32; TILE]], sign: f32, out: &mut [f32; TILE]) {
    let mut sum = [0.0_f32; TILE];
    for (coefficient, row) in coefficients.iter().zip(basis) {
        for k in 0..TILE {
            sum[k] += coefficient * row[k];
        }
    }
    for k in 0..TILE {
        out[k] = sign * sum[k];
    }
}

/// Replaces covariances C by L with C = L L*, for `order` daughters.
///
/// A pivot that is too small or negative, as rounding and interpolation make it, is raised: that adds noise of its
/// own to one daughter, and leaves what the daughters have in common as it is.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn factor(tile: &mut Tile, order: usize) -> Repairs {
    let mut repairs = Repairs { pivots: (order * TILE) as u64, ..Repairs::default() };
    for j in 0..order {
        let mut inverse = [0.0_f32; TILE];
        for i in j..order {
            let at = element(i, j);
            let (mut re, mut im) = (tile.re[at], tile.im[at]);
            for k in 0..j {
                let (a, b) = (element(i, k), element(j, k));
                let (a_re, a_im, b_re, b_im) = (&tile.re[a], &tile.im[a], &tile.re[b], &tile.im[b]);
                for t in 0..TILE {
                    re[t] -= a_re[t] * b_re[t] + a_im[t] * b_im[t];
                    im[t] -= a_im[t] * b_re[t] - a_re[t] * b_im[t];
                }
            }
            if i == j {
                let power = tile.re[at];
                let mut repaired = 0_u32;
                let mut added_max = 0.0_f32;
                for t in 0..TILE {
                    let least = PIVOT_MIN * power[t];
                    let low = re[t] < least;
                    repaired += u32::from(low);
                    let added = if low { (least - re[t]) / power[t].max(f32::MIN_POSITIVE) } else { 0.0 };
                    added_max = added_max.max(added);
                    // No power at all is a daughter that hears nothing.
                    let pivot = re[t].max(least).max(f32::MIN_POSITIVE).sqrt();
                    re[t] = pivot;
                    inverse[t] = 1.0 / pivot;
                }
                im = [0.0; TILE];
                repairs.repaired += u64::from(repaired);
                repairs.added_max = repairs.added_max.max(added_max);
            } else {
                for t in 0..TILE {
                    re[t] *= inverse[t];
                    im[t] *= inverse[t];
                }
            }
            tile.re[at] = re;
            tile.im[at] = im;
        }
    }
    repairs
}

/// `x_i = sum over j <= i of L_ij z_j`: row `i` of the factor times independent noise, `stride` apart.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn colour(tile: &Tile, i: usize, noise: [&[[f32; TILE]]; 2], stride: usize, x: &mut [[f32; TILE]; 2]) {
    let [mut re, mut im] = [[0.0_f32; TILE]; 2];
    for j in 0..=i {
        let at = element(i, j);
        let (l_re, l_im) = (&tile.re[at], &tile.im[at]);
        let (z_re, z_im) = (&noise[0][j * stride], &noise[1][j * stride]);
        for t in 0..TILE {
            re[t] += l_re[t] * z_re[t] - l_im[t] * z_im[t];
            im[t] += l_re[t] * z_im[t] + l_im[t] * z_re[t];
        }
    }
    *x = [re, im];
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn factors_multiply_to_the_matrix() {
        // C = M M* + 0.1, M of small whole numbers that differ from frequency to frequency.
        const ORDER: usize = 5;
        let m = |i: usize, k: usize, t: usize| {
            let value = |seed: usize| ((seed * 7919 + t * 31) % 13) as f32 - 6.0;
            (value(i * 10 + k), value(i * 11 + k + 5))
        };
        let mut tile = Tile::new(ORDER);
        for i in 0..ORDER {
            for j in 0..=i {
                for t in 0..TILE {
                    let (mut re, mut im) = (if i == j { 0.1 } else { 0.0 }, 0.0);
                    for k in 0..ORDER {
                        let ((a, b), (c, d)) = (m(i, k, t), m(j, k, t));
                        re += a * c + b * d;
                        im += b * c - a * d;
                    }
                    tile.re[element(i, j)][t] = re;
                    tile.im[element(i, j)][t] = im;
                }
            }
        }
        let wanted = tile.clone();
        let repairs = factor(&mut tile, ORDER);
        assert_eq!((repairs.repaired, repairs.pivots), (0, 160));
        for i in 0..ORDER {
            for j in 0..=i {
                for t in 0..TILE {
                    let (mut re, mut im) = (0.0, 0.0);
                    for k in 0..=j {
                        let (a, b) = (element(i, k), element(j, k));
                        re += tile.re[a][t] * tile.re[b][t] + tile.im[a][t] * tile.im[b][t];
                        im += tile.im[a][t] * tile.re[b][t] - tile.re[a][t] * tile.im[b][t];
                    }
                    let at = element(i, j);
                    // f32 rounding of sums of up to 360.
                    assert!((re - wanted.re[at][t]).abs() < 1e-3 && (im - wanted.im[at][t]).abs() < 1e-3);
                }
            }
        }
    }

    #[test]
    fn what_is_no_covariance_gains_noise_and_keeps_its_correlations() {
        // Two daughters of power 1 that correlate by 1.01.
        let mut tile = Tile::new(2);
        for t in 0..TILE {
            (tile.re[0][t], tile.re[2][t], tile.re[1][t], tile.im[1][t]) = (1.0, 1.0, 0.0, 1.01);
        }
        let repairs = factor(&mut tile, 2);
        assert_eq!(repairs.repaired, TILE as u64);
        // 1.01^2 - 1, and the least pivot; rounding.
        assert!((repairs.added_max - 0.0201).abs() < 1e-5, "{}", repairs.added_max);
        assert!((tile.im[1][0] * tile.re[0][0] - 1.01).abs() < 1e-6);
        let power = tile.im[1][0].powi(2) + tile.re[2][0].powi(2);
        assert!((power - 1.0201).abs() < 1e-5, "{power}");
    }
}
