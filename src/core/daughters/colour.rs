//! Colouring: from independent noise to noise of a given covariance, many frequencies at a time.

use pulp::Simd;

use super::bins::HALF;
use super::covariance::Covariances;
use super::tile::{PIVOT_MIN, TILE, Tile, TileKernel, element};

/// Evaluates the covariances of one group of bins and its mirror image into a tile.
pub(super) struct Expand<'a> {
    pub(super) covariances: &'a Covariances,
    pub(super) epoch: usize,
    pub(super) group: usize,
    pub(super) tile: &'a mut Tile,
}

impl TileKernel for Expand<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) {
        let Self { covariances, epoch, group, tile } = self;
        let values = covariances.epoch(epoch);
        for (daughter, power) in values[..covariances.daughters()].iter().enumerate() {
            let at = element(daughter, daughter);
            (tile.re[at], tile.im[at]) = ([*power; TILE], [0.0; TILE]);
        }
        for series in covariances.pairs() {
            let at = element(series.pair.j.into(), series.pair.i.into());
            let (re, im) = series.of(values);
            let (even_rows, odd_rows) = series.basis.group(group);
            let ((re_even, re_odd), (im_even, im_odd)) =
                (re.split_at(even_rows.len()), im.split_at(even_rows.len()));
            let even = functions::<S, P>(simd, even_rows, [re_even, im_even]);
            let odd = functions::<S, P>(simd, odd_rows, [re_odd, im_odd]);
            for (part, out) in [&mut tile.re[at], &mut tile.im[at]].into_iter().enumerate() {
                let (below, above) = out.split_at_mut(HALF);
                let (below, above) = (S::as_mut_simd_f32s(below).0, S::as_mut_simd_f32s(above).0);
                for p in 0..P {
                    below[p] = simd.add_f32s(even[part][p], odd[part][p]);
                    above[p] = simd.sub_f32s(even[part][p], odd[part][p]);
                }
            }
        }
    }
}

/// Sums of `coefficient x row`, for the real and the imaginary coefficients.
#[inline(always)]
fn functions<S: Simd, const P: usize>(
    simd: S,
    rows: &[[f32; HALF]],
    [re, im]: [&[f32]; 2],
) -> [[S::f32s; P]; 2] {
    let [mut sums_re, mut sums_im] = [[simd.splat_f32s(0.0); P]; 2];
    for (row, (re, im)) in rows.iter().zip(re.iter().zip(im)) {
        let row = S::as_simd_f32s(row).0;
        let (re, im) = (simd.splat_f32s(*re), simd.splat_f32s(*im));
        for p in 0..P {
            sums_re[p] = simd.mul_add_f32s(re, row[p], sums_re[p]);
            sums_im[p] = simd.mul_add_f32s(im, row[p], sums_im[p]);
        }
    }
    [sums_re, sums_im]
}

/// Replaces covariances C of `order` daughters by their Cholesky factors L, C = L L*. Returns whether every C is
/// positive semidefinite; if not, the tile's contents are undefined.
pub(super) struct Factor<'a> {
    pub(super) tile: &'a mut Tile,
    pub(super) order: usize,
}

impl TileKernel for Factor<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) -> bool {
        let Self { tile, order } = self;
        let mut least = simd.splat_f32s(0.0);
        for j in 0..order {
            let inverse = pivot::<S, P>(simd, tile, j);
            for i in j + 1..order {
                for left in row::<S, P>(simd, tile, [i, j], inverse).as_flattened() {
                    least = simd.min_f32s(least, *left);
                }
            }
        }
        simd.reduce_min_f32s(least) >= 0.0
    }
}

/// An element at all frequencies, in registers. Processing both sides together keeps enough sums in flight to hide the
/// latency of additions.
type TileRegisters<S, const P: usize> = [[<S as Simd>::f32s; P]; 2];

#[inline(always)]
fn registers<S: Simd, const P: usize>(element: &[f32; TILE]) -> TileRegisters<S, P> {
    let element = S::as_simd_f32s(element).0;
    std::array::from_fn(|side| std::array::from_fn(|p| element[side * P + p]))
}

#[inline(always)]
fn set<S: Simd, const P: usize>(element: &mut [f32; TILE], values: TileRegisters<S, P>) {
    S::as_mut_simd_f32s(element).0.copy_from_slice(values.as_flattened());
}

/// Converts the remainder of a daughter's power into the pivot, and returns its inverse. The imaginary part of the
/// diagonal, which is zero, stores the original power.
#[inline(always)]
fn pivot<S: Simd, const P: usize>(simd: S, tile: &mut Tile, j: usize) -> TileRegisters<S, P> {
    let at = element(j, j);
    let (mut left, mut power) = (registers::<S, P>(&tile.re[at]), registers::<S, P>(&tile.im[at]));
    if j == 0 {
        power = left;
    }
    let mut inverse = left;
    for side in 0..2 {
        for p in 0..P {
            // A daughter without signal has no power at all.
            let least = simd.mul_f32s(simd.splat_f32s(PIVOT_MIN), power[side][p]);
            let least = simd.max_f32s(least, simd.splat_f32s(f32::MIN_POSITIVE));
            left[side][p] = simd.sqrt_f32s(simd.max_f32s(left[side][p], least));
            inverse[side][p] = simd.div_f32s(simd.splat_f32s(1.0), left[side][p]);
        }
    }
    set::<S, P>(&mut tile.re[at], left);
    tile.im[at] = [0.0; TILE];
    inverse
}

/// Computes element (i, j) from those before it, and returns the remainder of daughter i's power.
#[inline(always)]
fn row<S: Simd, const P: usize>(
    simd: S,
    tile: &mut Tile,
    [i, j]: [usize; 2],
    inverse: TileRegisters<S, P>,
) -> TileRegisters<S, P> {
    let (at, diagonal) = (element(i, j), element(i, i));
    let (mut re, mut im) = (registers::<S, P>(&tile.re[at]), registers::<S, P>(&tile.im[at]));
    for k in 0..j {
        let (a, b) = (element(i, k), element(j, k));
        let (a_re, a_im) = (S::as_simd_f32s(&tile.re[a]).0, S::as_simd_f32s(&tile.im[a]).0);
        let (b_re, b_im) = (S::as_simd_f32s(&tile.re[b]).0, S::as_simd_f32s(&tile.im[b]).0);
        for side in 0..2 {
            for p in 0..P {
                let at = side * P + p;
                let (re, im) = (&mut re[side][p], &mut im[side][p]);
                *re = simd.mul_add_f32s(simd.neg_f32s(a_re[at]), b_re[at], *re);
                *im = simd.mul_add_f32s(simd.neg_f32s(a_im[at]), b_re[at], *im);
                *re = simd.mul_add_f32s(simd.neg_f32s(a_im[at]), b_im[at], *re);
                *im = simd.mul_add_f32s(a_re[at], b_im[at], *im);
            }
        }
    }
    let mut left = registers::<S, P>(&tile.re[diagonal]);
    if j == 0 {
        // Store the power for the pivot.
        set::<S, P>(&mut tile.im[diagonal], left);
    }
    for side in 0..2 {
        for p in 0..P {
            let (re, im) = (&mut re[side][p], &mut im[side][p]);
            *re = simd.mul_f32s(*re, inverse[side][p]);
            *im = simd.mul_f32s(*im, inverse[side][p]);
            let asked = simd.mul_add_f32s(*re, *re, simd.mul_f32s(*im, *im));
            left[side][p] = simd.sub_f32s(left[side][p], asked);
        }
    }
    set::<S, P>(&mut tile.re[at], re);
    set::<S, P>(&mut tile.im[at], im);
    set::<S, P>(&mut tile.re[diagonal], left);
    left
}

/// Colours noise: `x_i = sum over j <= i of L_ij z_j`, the factor of one group of bins times independent noise.
pub(super) struct ApplyFactor<'a> {
    pub(super) tile: &'a Tile,
    /// Independent noise by daughter, `stride` apart.
    pub(super) noise: [&'a [[f32; TILE]]; 2],
    pub(super) stride: usize,
    pub(super) x: &'a mut [[[f32; TILE]; 2]],
}

impl TileKernel for ApplyFactor<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) {
        let Self { tile, noise, stride, x } = self;
        for (i, x) in x.iter_mut().enumerate() {
            let [mut re, mut im] = [[[simd.splat_f32s(0.0); P]; 2]; 2];
            for j in 0..=i {
                let at = element(i, j);
                let (l_re, l_im) = (S::as_simd_f32s(&tile.re[at]).0, S::as_simd_f32s(&tile.im[at]).0);
                let (z_re, z_im) =
                    (S::as_simd_f32s(&noise[0][j * stride]).0, S::as_simd_f32s(&noise[1][j * stride]).0);
                for side in 0..2 {
                    for p in 0..P {
                        let at = side * P + p;
                        let (re, im) = (&mut re[side][p], &mut im[side][p]);
                        *re = simd.mul_add_f32s(l_re[at], z_re[at], *re);
                        *im = simd.mul_add_f32s(l_re[at], z_im[at], *im);
                        *re = simd.mul_add_f32s(simd.neg_f32s(l_im[at]), z_im[at], *re);
                        *im = simd.mul_add_f32s(l_im[at], z_re[at], *im);
                    }
                }
            }
            set::<S, P>(&mut x[0], re);
            set::<S, P>(&mut x[1], im);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pulp::Arch;

    use crate::daughters::repair::factor;
    use crate::daughters::tile::on_tile;

    #[test]
    fn factors_multiply_to_the_matrix() {
        // C = M M* + 0.1, with M of small integers that differ between frequencies.
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
        let mut careful = tile.clone();
        let repairs = factor(&mut careful, ORDER);
        assert_eq!((repairs.changed, repairs.elements), (0, 320));
        assert!(on_tile(Arch::new(), Factor { tile: &mut tile, order: ORDER }));
        for (one, other) in tile.re.iter().chain(&tile.im).zip(careful.re.iter().chain(&careful.im)) {
            // Elements of up to 19; the two differ in rounding.
            assert!(one.iter().zip(other).all(|(a, b)| (a - b).abs() < 1e-3), "{one:?} {other:?}");
        }
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
    fn noise_is_coloured_daughter_by_daughter() {
        // L_ij = t (i + 2 j) + i j sqrt(-1), z_j = 1 + j sqrt(-1), at frequency t.
        const ORDER: usize = 3;
        let mut tile = Tile::new(ORDER);
        for i in 0..ORDER {
            for j in 0..=i {
                tile.re[element(i, j)] = std::array::from_fn(|t| (t * (i + 2 * j)) as f32);
                tile.im[element(i, j)] = [(i * j) as f32; TILE];
            }
        }
        let z_re = vec![[1.0; TILE]; ORDER];
        let z_im: Vec<[f32; TILE]> = (0..ORDER).map(|j| [j as f32; TILE]).collect();
        let mut x = vec![[[0.0; TILE]; 2]; ORDER];
        let colour = ApplyFactor { tile: &tile, noise: [&z_re, &z_im], stride: 1, x: &mut x };
        on_tile(Arch::new(), colour);
        for (i, x) in x.iter().enumerate() {
            for (t, (re, im)) in x[0].iter().zip(&x[1]).enumerate() {
                let sum = |term: &dyn Fn(usize) -> usize| (0..=i).map(term).sum::<usize>() as f32;
                let (plus, minus) = (sum(&|j| t * (i + 2 * j)), sum(&|j| i * j * j));
                assert_eq!(*re, plus - minus, "{i} {t}");
                assert_eq!(*im, sum(&|j| t * (i + 2 * j) * j + i * j), "{i} {t}");
            }
        }
    }
}
