//! From independent noise to noise of a given covariance, many frequencies at a time.

use pulp::{Simd, WithSimd};

use super::covariance::Covariances;

/// Frequencies that are worked on together on one side of the channel's centre: a register of the widest kind.
pub(super) const HALF: usize = 16;
/// Frequencies that are worked on together: `HALF` below the centre, and those that mirror them.
pub(super) const TILE: usize = 2 * HALF;

/// Smallest pivot of a covariance, as a part of its diagonal: below lies the rounding of `f32`.
pub(super) const PIVOT_MIN: f32 = 1e-6;

/// Matrices of one tile of frequencies: lower triangles, row after row, `TILE` values an element.
#[derive(Clone, Debug)]
pub(super) struct Tile {
    pub re: Vec<[f32; TILE]>,
    pub im: Vec<[f32; TILE]>,
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

/// Puts the covariances of one group of bins and their mirrors into a tile.
pub(super) struct Expand<'a> {
    pub(super) covariances: &'a Covariances,
    pub(super) epoch: usize,
    pub(super) group: usize,
    pub(super) tile: &'a mut Tile,
}

impl WithSimd for Expand<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match S::F32_LANES {
            16 => self.run::<S, 1>(simd),
            8 => self.run::<S, 2>(simd),
            4 => self.run::<S, 4>(simd),
            _ => self.run::<S, HALF>(simd),
        }
    }
}

impl Expand<'_> {
    /// `P` registers hold one side.
    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) {
        let Self { covariances, epoch, group, tile } = self;
        for daughter in 0..covariances.daughters() {
            let at = element(daughter, daughter);
            tile.re[at] = [covariances.power(daughter, epoch); TILE];
            tile.im[at] = [0.0; TILE];
        }
        for series in covariances.pairs() {
            let at = element(series.pair.j.into(), series.pair.i.into());
            let (re, im) = series.at(epoch);
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

/// Sums of `coefficient x row`, for the coefficients of both parts.
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

/// Replaces covariances C by L with C = L L*, for `order` daughters, where C is a covariance but for rounding; says
/// whether it was. If not, the tile is of no use.
pub(super) struct Factor<'a> {
    pub(super) tile: &'a mut Tile,
    pub(super) order: usize,
}

impl WithSimd for Factor<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> bool {
        match S::F32_LANES {
            16 => self.run::<S, 1>(simd),
            8 => self.run::<S, 2>(simd),
            4 => self.run::<S, 4>(simd),
            _ => self.run::<S, HALF>(simd),
        }
    }
}

impl Factor<'_> {
    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) -> bool {
        let Self { tile, order } = self;
        let mut least = simd.splat_f32s(0.0);
        for side in 0..2 {
            for j in 0..order {
                let inverse = pivot::<S, P>(simd, tile, j, side);
                for i in j + 1..order {
                    let left = row::<S, P>(simd, tile, [i, j, side], inverse);
                    for left in left {
                        least = simd.min_f32s(least, left);
                    }
                }
            }
        }
        simd.reduce_min_f32s(least) >= 0.0
    }
}

/// One side of an element.
#[inline(always)]
fn part<S: Simd, const P: usize>(lanes: &[f32; TILE], side: usize) -> [S::f32s; P] {
    let lanes = S::as_simd_f32s(&lanes[side * HALF..][..HALF]).0;
    std::array::from_fn(|p| lanes[p])
}

#[inline(always)]
fn set<S: Simd, const P: usize>(lanes: &mut [f32; TILE], side: usize, values: [S::f32s; P]) {
    let lanes = S::as_mut_simd_f32s(&mut lanes[side * HALF..][..HALF]).0;
    lanes[..P].copy_from_slice(&values);
}

/// What a daughter has left of its power becomes its own amplitude; gives one over it. The imaginary part on the
/// diagonal, which is none, keeps the power.
#[inline(always)]
fn pivot<S: Simd, const P: usize>(simd: S, tile: &mut Tile, j: usize, side: usize) -> [S::f32s; P] {
    let at = element(j, j);
    let (mut left, mut power) = (part::<S, P>(&tile.re[at], side), part::<S, P>(&tile.im[at], side));
    if j == 0 {
        power = left;
    }
    let mut inverse = left;
    for p in 0..P {
        // No power at all is a daughter that hears nothing.
        let least = simd.mul_f32s(simd.splat_f32s(PIVOT_MIN), power[p]);
        let least = simd.max_f32s(least, simd.splat_f32s(f32::MIN_POSITIVE));
        left[p] = simd.sqrt_f32s(simd.max_f32s(left[p], least));
        inverse[p] = simd.div_f32s(simd.splat_f32s(1.0), left[p]);
        power[p] = simd.splat_f32s(0.0);
    }
    set::<S, P>(&mut tile.re[at], side, left);
    set::<S, P>(&mut tile.im[at], side, power);
    inverse
}

/// Element (i, j), from those before it; gives what daughter i has left of its power.
#[inline(always)]
fn row<S: Simd, const P: usize>(
    simd: S,
    tile: &mut Tile,
    [i, j, side]: [usize; 3],
    inverse: [S::f32s; P],
) -> [S::f32s; P] {
    let (at, own) = (element(i, j), element(i, i));
    let (mut re, mut im) = (part::<S, P>(&tile.re[at], side), part::<S, P>(&tile.im[at], side));
    for k in 0..j {
        let (a, b) = (element(i, k), element(j, k));
        let (a_re, a_im) = (part::<S, P>(&tile.re[a], side), part::<S, P>(&tile.im[a], side));
        let (b_re, b_im) = (part::<S, P>(&tile.re[b], side), part::<S, P>(&tile.im[b], side));
        for p in 0..P {
            let (minus_re, minus_im) = (simd.neg_f32s(a_re[p]), simd.neg_f32s(a_im[p]));
            re[p] = simd.mul_add_f32s(minus_re, b_re[p], simd.mul_add_f32s(minus_im, b_im[p], re[p]));
            im[p] = simd.mul_add_f32s(minus_im, b_re[p], simd.mul_add_f32s(a_re[p], b_im[p], im[p]));
        }
    }
    let mut left = part::<S, P>(&tile.re[own], side);
    if j == 0 {
        // The power, for the pivot.
        set::<S, P>(&mut tile.im[own], side, left);
    }
    for p in 0..P {
        re[p] = simd.mul_f32s(re[p], inverse[p]);
        im[p] = simd.mul_f32s(im[p], inverse[p]);
        let asked = simd.mul_add_f32s(re[p], re[p], simd.mul_f32s(im[p], im[p]));
        left[p] = simd.sub_f32s(left[p], asked);
    }
    set::<S, P>(&mut tile.re[at], side, re);
    set::<S, P>(&mut tile.im[at], side, im);
    set::<S, P>(&mut tile.re[own], side, left);
    left
}

/// `x_i = sum over j <= i of L_ij z_j`: the factor of one group of bins times independent noise, daughter by daughter.
pub(super) struct Colour<'a> {
    pub(super) tile: &'a Tile,
    /// By daughter, `stride` apart.
    pub(super) noise: [&'a [[f32; TILE]]; 2],
    pub(super) stride: usize,
    pub(super) x: &'a mut [[[f32; TILE]; 2]],
}

impl WithSimd for Colour<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match S::F32_LANES {
            16 => self.run::<S, 1>(simd),
            8 => self.run::<S, 2>(simd),
            4 => self.run::<S, 4>(simd),
            _ => self.run::<S, HALF>(simd),
        }
    }
}

impl Colour<'_> {
    #[inline(always)]
    fn run<S: Simd, const P: usize>(self, simd: S) {
        let Self { tile, noise, stride, x } = self;
        for side in 0..2 {
            for (i, x) in x.iter_mut().enumerate() {
                let [mut re, mut im] = [[simd.splat_f32s(0.0); P]; 2];
                for j in 0..=i {
                    let at = element(i, j);
                    let (l_re, l_im) = (part::<S, P>(&tile.re[at], side), part::<S, P>(&tile.im[at], side));
                    let z_re = part::<S, P>(&noise[0][j * stride], side);
                    let z_im = part::<S, P>(&noise[1][j * stride], side);
                    for p in 0..P {
                        let minus = simd.neg_f32s(l_im[p]);
                        re[p] = simd.mul_add_f32s(l_re[p], z_re[p], simd.mul_add_f32s(minus, z_im[p], re[p]));
                        im[p] =
                            simd.mul_add_f32s(l_re[p], z_im[p], simd.mul_add_f32s(l_im[p], z_re[p], im[p]));
                    }
                }
                set::<S, P>(&mut x[0], side, re);
                set::<S, P>(&mut x[1], side, im);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::repair::factor;
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
        let mut careful = tile.clone();
        let repairs = factor(&mut careful, ORDER);
        assert_eq!((repairs.changed, repairs.elements), (0, 320));
        assert!(pulp::Arch::new().dispatch(Factor { tile: &mut tile, order: ORDER }));
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
        // L_ij = i + 2 j + i j k, z_j = 1 + j i, for any frequency t scaled by t.
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
        pulp::Arch::new().dispatch(Colour { tile: &tile, noise: [&z_re, &z_im], stride: 1, x: &mut x });
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
