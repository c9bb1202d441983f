//! From independent noise to noise of a given covariance, many frequencies at a time.

use multiversion::multiversion;

use crate::array::response::kernel::fused;

/// Frequencies that are worked on together: two registers of the widest kind.
pub(super) const TILE: usize = 32;

/// Smallest pivot of a covariance, as a part of its diagonal: below lies the rounding of `f32`.
const PIVOT_MIN: f32 = 1e-6;

/// Changes of a correlation that are counted; smaller ones are rounding.
const CHANGE_COUNTED: f32 = 1e-5;

/// Matrices of one tile of frequencies: lower triangles, row after row, `TILE` values an element.
#[derive(Clone, Debug)]
pub(super) struct Tile {
    pub re: Vec<[f32; TILE]>,
    pub im: Vec<[f32; TILE]>,
}

/// What had to be done to covariances.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Repairs {
    /// Correlations looked at.
    pub elements: u64,
    /// Those made smaller by more than `CHANGE_COUNTED` so that a matrix became a covariance.
    pub changed: u64,
    /// Greatest change, as a part of the two daughters' powers.
    pub change_max: f32,
}

impl Repairs {
    /// Adds what another part has counted.
    pub fn absorb(&mut self, other: Self) {
        self.elements += other.elements;
        self.changed += other.changed;
        self.change_max = self.change_max.max(other.change_max);
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
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let mut sum = [0.0_f32; TILE];
    for (coefficient, row) in coefficients.iter().zip(basis) {
        for k in 0..TILE {
            sum[k] = fused::<FMA>(*coefficient, row[k], sum[k]);
        }
    }
    for k in 0..TILE {
        out[k] = sign * sum[k];
    }
}

/// Replaces covariances C by L with C = L L*, for `order` daughters.
///
/// Rounding and interpolation can make C a little less than a covariance. A daughter then has less power left than
/// its correlation with another asks for; the correlation is made as small as the power that is left. Powers
/// stay, and no correlation changes by more than C lacks.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn factor(tile: &mut Tile, order: usize) -> Repairs {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let mut repairs = Repairs { elements: (order * (order - 1) / 2 * TILE) as u64, ..Repairs::default() };
    let powers: Vec<[f32; TILE]> = (0..order).map(|i| tile.re[element(i, i)]).collect();
    let mut left = powers.clone();
    for j in 0..order {
        let (mut pivot, mut inverse) = ([0.0_f32; TILE], [0.0_f32; TILE]);
        for t in 0..TILE {
            // No power at all is a daughter that hears nothing.
            pivot[t] = left[j][t].max(PIVOT_MIN * powers[j][t]).max(f32::MIN_POSITIVE).sqrt();
            inverse[t] = 1.0 / pivot[t];
        }
        tile.re[element(j, j)] = pivot;
        tile.im[element(j, j)] = [0.0; TILE];
        for i in j + 1..order {
            let at = element(i, j);
            let (mut re, mut im) = (tile.re[at], tile.im[at]);
            for k in 0..j {
                let (a, b) = (element(i, k), element(j, k));
                let (a_re, a_im, b_re, b_im) = (&tile.re[a], &tile.im[a], &tile.re[b], &tile.im[b]);
                for t in 0..TILE {
                    re[t] = fused::<FMA>(-a_re[t], b_re[t], fused::<FMA>(-a_im[t], b_im[t], re[t]));
                    im[t] = fused::<FMA>(-a_im[t], b_re[t], fused::<FMA>(a_re[t], b_im[t], im[t]));
                }
            }
            let mut lacking = 0_u32;
            for t in 0..TILE {
                re[t] *= inverse[t];
                im[t] *= inverse[t];
                let asked = re[t] * re[t] + im[t] * im[t];
                lacking += u32::from(asked > left[i][t]);
                left[i][t] -= asked;
            }
            if lacking > 0 {
                shrink(
                    [&mut re, &mut im],
                    &mut left[i],
                    |t| pivot[t] / (powers[i][t] * powers[j][t]).sqrt(),
                    &mut repairs,
                );
            }
            tile.re[at] = re;
            tile.im[at] = im;
        }
    }
    repairs
}

/// Makes the elements smaller that took more power than was left; `unit` is a change of one, as a part of the powers.
fn shrink(
    [re, im]: [&mut [f32; TILE]; 2],
    left: &mut [f32; TILE],
    unit: impl Fn(usize) -> f32,
    repairs: &mut Repairs,
) {
    for t in 0..TILE {
        if left[t] >= 0.0 {
            continue;
        }
        let asked = re[t] * re[t] + im[t] * im[t];
        let there = (left[t] + asked).max(0.0);
        left[t] = 0.0;
        let scale = (there / asked).sqrt();
        let change = unit(t) * asked.sqrt() * (1.0 - scale);
        repairs.changed += u64::from(change > CHANGE_COUNTED);
        repairs.change_max = repairs.change_max.max(change);
        re[t] *= scale;
        im[t] *= scale;
    }
}

/// `x_i = sum over j <= i of L_ij z_j`: row `i` of the factor times independent noise, `stride` apart.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn colour(
    tile: &Tile,
    i: usize,
    noise: [&[[f32; TILE]]; 2],
    stride: usize,
    x: &mut [[f32; TILE]; 2],
) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let [mut re, mut im] = [[0.0_f32; TILE]; 2];
    for j in 0..=i {
        let at = element(i, j);
        let (l_re, l_im) = (&tile.re[at], &tile.im[at]);
        let (z_re, z_im) = (&noise[0][j * stride], &noise[1][j * stride]);
        for t in 0..TILE {
            re[t] = fused::<FMA>(l_re[t], z_re[t], fused::<FMA>(-l_im[t], z_im[t], re[t]));
            im[t] = fused::<FMA>(l_re[t], z_im[t], fused::<FMA>(l_im[t], z_re[t], im[t]));
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
        assert_eq!((repairs.changed, repairs.elements), (0, 320));
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
    fn what_is_no_covariance_keeps_its_powers_and_loses_correlation() {
        // Two daughters of power 1 that correlate by 1.01.
        let mut tile = Tile::new(2);
        for t in 0..TILE {
            (tile.re[0][t], tile.re[2][t], tile.re[1][t], tile.im[1][t]) = (1.0, 1.0, 0.0, 1.01);
        }
        let repairs = factor(&mut tile, 2);
        assert_eq!(repairs.changed, TILE as u64);
        assert!((repairs.change_max - 0.01).abs() < 1e-5, "{}", repairs.change_max);
        assert!((tile.im[1][0] * tile.re[0][0] - 1.0).abs() < 1e-6);
        let power = tile.im[1][0].powi(2) + tile.re[2][0].powi(2);
        // The least pivot is added.
        assert!((power - 1.0).abs() < 2e-6, "{power}");
    }
}
