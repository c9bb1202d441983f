//! Cholesky factors of matrices that are not quite positive semidefinite.

use multiversion::multiversion;

use super::tile::{PIVOT_MIN, TILE, Tile, element};
use crate::units::arithmetic::fused;

/// Smallest change of a correlation that is counted; smaller ones are rounding.
const CHANGE_COUNTED: f32 = 1e-5;

/// Statistics of the repairs of covariances.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Repairs {
    /// Correlations checked.
    pub elements: u64,
    /// Correlations reduced by more than 1e-5 to make a matrix positive semidefinite.
    pub changed: u64,
    /// Largest reduction, as a fraction of the geometric mean of the two powers.
    pub change_max: f32,
}

impl Repairs {
    /// The statistics of a tile for `order` daughters that needed no repair.
    pub(super) fn none(order: usize) -> Self {
        Self { elements: (order * (order - 1) / 2 * TILE) as u64, ..Self::default() }
    }

    /// Adds other statistics.
    pub fn add(&mut self, other: Self) {
        self.elements += other.elements;
        self.changed += other.changed;
        self.change_max = self.change_max.max(other.change_max);
    }
}

/// Cholesky factors as by [`crate::daughters::colour::Factor`], for a C that need not be positive semidefinite.
///
/// Rounding and interpolation can leave C slightly indefinite. A daughter then has less power left than its correlation
/// with another needs; that correlation is reduced to fit. Powers do not change, and no correlation changes by more
/// than C is short of positive semidefinite.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn factor(tile: &mut Tile, order: usize) -> Repairs {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let mut repairs = Repairs::none(order);
    let powers: Vec<[f32; TILE]> = (0..order).map(|i| tile.re[element(i, i)]).collect();
    let mut left = powers.clone();
    for j in 0..order {
        let (mut pivot, mut inverse) = ([0.0_f32; TILE], [0.0_f32; TILE]);
        for t in 0..TILE {
            // A daughter without signal has no power at all.
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
            let mut deficient = 0_u32;
            for t in 0..TILE {
                re[t] *= inverse[t];
                im[t] *= inverse[t];
                let needed = re[t] * re[t] + im[t] * im[t];
                deficient += u32::from(needed > left[i][t]);
                left[i][t] -= needed;
            }
            if deficient > 0 {
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

/// Reduces the elements that took more power than was left; `unit` converts a change to a fraction of the powers.
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
        let needed = re[t] * re[t] + im[t] * im[t];
        let there = (left[t] + needed).max(0.0);
        left[t] = 0.0;
        let scale = (there / needed).sqrt();
        let change = unit(t) * needed.sqrt() * (1.0 - scale);
        repairs.changed += u64::from(change > CHANGE_COUNTED);
        repairs.change_max = repairs.change_max.max(change);
        re[t] *= scale;
        im[t] *= scale;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::daughters::colour::Factor;
    use crate::daughters::tile::on_tile;

    #[test]
    fn an_indefinite_matrix_keeps_its_powers_and_loses_correlation() {
        // Two daughters of power 1 with a correlation of 1.01.
        let mut tile = Tile::new(2);
        for t in 0..TILE {
            (tile.re[0][t], tile.re[2][t], tile.re[1][t], tile.im[1][t]) = (1.0, 1.0, 0.0, 1.01);
        }
        assert!(!on_tile(pulp::Arch::new(), Factor { tile: &mut tile.clone(), order: 2 }));
        let repairs = factor(&mut tile, 2);
        assert_eq!(repairs.changed, TILE as u64);
        assert!((repairs.change_max - 0.01).abs() < 1e-5, "{}", repairs.change_max);
        assert!((tile.im[1][0] * tile.re[0][0] - 1.0).abs() < 1e-6);
        let power = tile.im[1][0].powi(2) + tile.re[2][0].powi(2);
        // The smallest pivot is added.
        assert!((power - 1.0).abs() < 2e-6, "{power}");
    }
}
