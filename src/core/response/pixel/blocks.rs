//! Pixels divided into blocks small enough for the mean of a fringe to have a closed form.
//!
//! Over a block of m x m children, at positions x, y in (-1/2, 1/2), the children's directions are fitted by
//! `n = c + gx x + gy y + hxx (x^2 - v) + hxy x y + hyy (y^2 - v)`, `v = (1 - 1/m^2) / 12`. These
//! functions are orthogonal over the children, so each coefficient is a projection.

use rayon::prelude::*;

use super::CHILDREN;
use super::exact::child_directions;
use super::order::PixelOrder;
use crate::sky::healpix;
use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

/// Indices of the vectors among a block's `f32` coefficients, three components each.
pub(super) const GX: usize = 0;
pub(super) const GY: usize = 3;
pub(super) const HXX: usize = 6;
pub(super) const HXY: usize = 9;
pub(super) const HYY: usize = 12;
pub(super) const SLOPES: usize = 15;

/// Maximum half phase (rad) over a block for which the closed form's polynomials hold.
pub(super) const HALF_PHASE_RAD_MAX: f64 = 10.0;

/// Maximum half phase (rad) over a child for which the series of the sampling factor holds.
const HALF_PHASE_RAD_PER_CHILD_MAX: f64 = 2.0;

/// Maximum error of a block's closed form. Only the worst pixel, at the longest baseline of a class in the
/// worst direction, reaches it, and errors of pixels are independent: the rms over pixels is several times
/// below the 1e-3 required of a row.
const ERROR_MAX: f64 = 4e-3;

/// Number of blocks in a [`BlockGroup`].
pub(super) const GROUP: usize = 64;

/// Blocks in the layout of the kernels. Gaps and the padding of a set's last group have a radius of NaN, so that
/// every comparison finds them hidden.
#[derive(Clone, Debug)]
pub(super) struct BlockGroup {
    /// Constant term of the fit.
    pub centre: [[f64; GROUP]; 3],
    /// The other terms, at the indices [`GX`] to [`HYY`].
    pub slopes: [[f32; GROUP]; SLOPES],
    /// Maximum distance of a child from `centre`.
    pub radius: [f32; GROUP],
}

impl BlockGroup {
    const EMPTY: Self =
        Self { centre: [[0.0; GROUP]; 3], slopes: [[0.0; GROUP]; SLOPES], radius: [f32::NAN; GROUP] };
}

/// Blocks of one size.
#[derive(Debug)]
pub(super) struct BlockSet {
    pub children: usize,
    /// Index of each block's pixel in a row.
    pub pixels: Vec<u32>,
    /// The blocks.
    pub groups: Vec<BlockGroup>,
}

#[derive(Clone, Copy, Debug)]
struct FittedBlock {
    children: usize,
    centre: Vec3,
    slopes: [Vec3; 5],
    radius: f64,
    residual: f64,
}

impl BlockSet {
    fn new(per_side: usize) -> Self {
        Self { children: CHILDREN / per_side, pixels: Vec::new(), groups: Vec::new() }
    }

    /// Appends a block of a pixel, or a gap.
    fn push(&mut self, pixel: usize, block: Option<&FittedBlock>) {
        let (group, lane) = (self.pixels.len() / GROUP, self.pixels.len() % GROUP);
        self.pixels.push(pixel as u32);
        if group == self.groups.len() {
            self.groups.push(BlockGroup::EMPTY);
        }
        let (Some(block), group) = (block, &mut self.groups[group]) else { return };
        for axis in 0..3 {
            group.centre[axis][lane] = block.centre[axis];
            for (term, slope) in block.slopes.iter().enumerate() {
                group.slopes[3 * term + axis][lane] = slope[axis] as f32;
            }
        }
        // Rounded up, so that all children are inside in f32 too.
        group.radius[lane] = (block.radius * (1.0 + 1e-6) + 1e-6) as f32;
    }
}

/// Blocks for all baselines up to a given length.
#[derive(Debug)]
pub(super) struct BlockClass {
    /// Number of blocks along a pixel's side in `whole`.
    pub per_side: usize,
    /// Blocks of all pixels in the order of a row, `per_side`^2 for each, with gaps.
    pub whole: BlockSet,
    /// Smaller blocks that fill the gaps, where pixels are strongly curved (at the poles) or creased (at the boundary
    /// of the polar caps).
    pub finer: Vec<BlockSet>,
}

impl BlockClass {
    /// Fits blocks for baselines up to `wavelengths_max`, with at least `per_side` along a pixel's side.
    pub fn new((nside, order): (usize, PixelOrder), per_side: usize, wavelengths_max: f64) -> Self {
        let cut: Vec<Vec<(usize, Option<FittedBlock>)>> = (0..healpix::pixel_count(nside))
            .into_par_iter()
            .map(|place| {
                let children: Vec<Vec3> =
                    child_directions(nside, CHILDREN, order.ring(nside, place)).collect();
                let mut blocks = Vec::new();
                let size = CHILDREN / per_side;
                for k in 0..per_side * per_side {
                    let corner = (k / per_side * size, k % per_side * size);
                    cut(&children, corner, size, wavelengths_max, &mut blocks);
                }
                blocks
            })
            .collect();
        let mut whole = BlockSet::new(per_side);
        let sides = (per_side.ilog2() + 1..=CHILDREN.ilog2()).map(|power| 1 << power);
        let mut finer: Vec<BlockSet> = sides.map(BlockSet::new).collect();
        for (pixel, blocks) in cut.iter().enumerate() {
            for (size, block) in blocks {
                match (finer.iter_mut().find(|set| set.children == *size), block) {
                    (None, block) => whole.push(pixel, block.as_ref()),
                    (Some(set), Some(_)) => set.push(pixel, block.as_ref()),
                    (Some(_), None) => {}
                }
            }
        }
        finer.retain(|set| !set.pixels.is_empty());
        Self { per_side, whole, finer }
    }
}

/// Fits the block at `corner` with `size` children along its side. If the fit is not good enough, records a gap (`None`) and
/// divides the block into quarters.
fn cut(
    children: &[Vec3],
    corner: (usize, usize),
    size: usize,
    wavelengths_max: f64,
    blocks: &mut Vec<(usize, Option<FittedBlock>)>,
) {
    let mut inside = [[0.0; 3]; CHILDREN * CHILDREN];
    let inside = &mut inside[..size * size];
    for (k, child) in inside.iter_mut().enumerate() {
        *child = children[(corner.0 + k / size) * CHILDREN + corner.1 + k % size];
    }
    let block = fit(inside, size);
    if size == 1 || block.is_good(wavelengths_max) {
        return blocks.push((size, Some(block)));
    }
    blocks.push((size, None));
    let half = size / 2;
    for (x, y) in [(0, 0), (0, half), (half, 0), (half, half)] {
        cut(children, (corner.0 + x, corner.1 + y), half, wavelengths_max, blocks);
    }
}

impl FittedBlock {
    /// Whether the closed form, which expands the quadratic phase to first order and neglects the residual of the fit, holds for
    /// baselines up to `wavelengths_max`.
    fn is_good(&self, wavelengths_max: f64) -> bool {
        use std::f64::consts::PI;
        let radians = 2.0 * PI * wavelengths_max;
        let [gx, gy, hxx, hxy, hyy] = self.slopes.map(norm);
        // The rms over the unit square is 1/sqrt(180) for x^2 - 1/12, and 1/12 for x y.
        let quadratic = radians * ((hxx * hxx + hyy * hyy) / 180.0 + hxy * hxy / 144.0).sqrt();
        0.5 * radians * gx.max(gy) <= HALF_PHASE_RAD_MAX
            && 0.5 * radians * gx.max(gy) <= HALF_PHASE_RAD_PER_CHILD_MAX * self.children as f64
            && 0.5 * quadratic * quadratic <= ERROR_MAX
            && radians * self.residual <= ERROR_MAX
    }
}

fn fit(children: &[Vec3], m: usize) -> FittedBlock {
    let variance = (1.0 - 1.0 / (m * m) as f64) / 12.0;
    let place = |k: usize| (k as f64 + 0.5) / m as f64 - 0.5;
    let basis = |k: usize| {
        let (x, y) = (place(k / m), place(k % m));
        [x, y, x * x - variance, x * y, y * y - variance]
    };
    let mean =
        scale(1.0 / children.len() as f64, children.iter().fold([0.0; 3], |sum, &child| add(sum, child)));
    let mut slopes = [[0.0; 3]; 5];
    let mut squares = [0.0; 5];
    for (k, &child) in children.iter().enumerate() {
        for ((slope, square), value) in slopes.iter_mut().zip(&mut squares).zip(basis(k)) {
            *slope = add(*slope, scale(value, sub(child, mean)));
            *square += value * value;
        }
    }
    for (slope, square) in slopes.iter_mut().zip(squares) {
        // For m = 1 and m = 2 some functions vanish at all children, up to rounding.
        *slope = if square > 1e-12 { scale(1.0 / square, *slope) } else { [0.0; 3] };
    }
    let (mut radius, mut residual) = (0.0_f64, 0.0);
    for (k, &child) in children.iter().enumerate() {
        let off = sub(child, mean);
        radius = radius.max(norm(off));
        let unexplained = basis(k)
            .iter()
            .zip(slopes)
            .fold(off, |unexplained, (value, s)| sub(unexplained, scale(*value, s)));
        residual += dot(unexplained, unexplained);
    }
    FittedBlock {
        children: m,
        centre: mean,
        slopes,
        radius,
        residual: (residual / children.len() as f64).sqrt(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_fill_every_pixel() {
        for (nside, per_side) in [(8, 1), (8, 4), (16, 1)] {
            let class = BlockClass::new((nside, PixelOrder::Ring), per_side, 30.0);
            assert!(class.finer.iter().all(|set| !set.pixels.is_empty()));
            let mut filled = vec![0; healpix::pixel_count(nside)];
            for set in class.finer.iter().chain([&class.whole]) {
                assert_eq!(set.groups.len(), set.pixels.len().div_ceil(GROUP));
                for (k, &pixel) in set.pixels.iter().enumerate() {
                    if !set.groups[k / GROUP].radius[k % GROUP].is_nan() {
                        filled[pixel as usize] += set.children * set.children;
                    }
                }
            }
            assert!(filled.iter().all(|&children| children == CHILDREN * CHILDREN));
            let expected = (0..filled.len() as u32).flat_map(|pixel| vec![pixel; per_side * per_side]);
            assert!(class.whole.pixels.iter().copied().eq(expected));
        }
    }
}
