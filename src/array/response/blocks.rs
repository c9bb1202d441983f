//! Pixels cut into blocks small enough that a fringe over a block has a closed form.
//!
//! Over a block of m x m children, at places x, y in (-1/2, 1/2), the children's directions are fitted by
//! `n = c + gx x + gy y + hxx (x^2 - v) + hxy x y + hyy (y^2 - v)`, `v = (1 - 1/m^2) / 12`. These
//! functions are orthogonal over the children, so each coefficient is a plain projection.

use rayon::prelude::*;

use super::CHILDREN;
use super::exact::child_directions;
use crate::sky::healpix;
use crate::units::vector::{Vec3, add, dot, norm, scale, sub};

/// Places of the vectors among a block's `f32` coefficients, three components each.
pub(super) const GX: usize = 0;
pub(super) const GY: usize = 3;
pub(super) const HXX: usize = 6;
pub(super) const HXY: usize = 9;
pub(super) const HYY: usize = 12;
/// Number of `f32` coefficients.
pub(super) const SLOPES: usize = 15;

/// Greatest half phase (rad) over a block for which the closed form's polynomials hold.
pub(super) const HALF_PHASE_RAD_MAX: f64 = 10.0;

/// Greatest half phase (rad) over a child for which the series of the sampling factor holds.
const HALF_PHASE_RAD_PER_CHILD_MAX: f64 = 2.0;

/// Error of a block's closed form that is accepted. Errors of pixels are not aligned, and this bound is
/// met only by the worst pixel at a class's longest baseline in the worst direction, so that the mean
/// over pixels is several times smaller than the 1e-3 that is asked of a row.
const ERROR_MAX: f64 = 1.5e-3;

/// Blocks in a [`Group`].
pub(super) const GROUP: usize = 64;

/// Blocks in the layout that the kernels read; the last group of a set is filled with empty blocks.
#[derive(Clone, Debug)]
pub(super) struct Group {
    /// Constant term of the fit.
    pub centre: [[f64; GROUP]; 3],
    /// The other terms; see [`GX`] and the following.
    pub slopes: [[f32; GROUP]; SLOPES],
    /// Greatest distance of a child from `centre`.
    pub radius: [f32; GROUP],
}

impl Group {
    const EMPTY: Self =
        Self { centre: [[0.0; GROUP]; 3], slopes: [[0.0; GROUP]; SLOPES], radius: [0.0; GROUP] };
}

/// Blocks of some pixels, all cut alike.
#[derive(Debug)]
pub(super) struct BlockSet {
    /// Children along a block's side.
    pub children: usize,
    /// Blocks along a pixel's side.
    pub per_side: usize,
    /// RING numbers of the pixels; each has `per_side`^2 blocks in a row.
    pub pixels: Vec<u32>,
    /// The blocks.
    pub groups: Vec<Group>,
}

/// One fitted block.
#[derive(Clone, Copy, Debug)]
struct Block {
    children: usize,
    centre: Vec3,
    slopes: [Vec3; 5],
    radius: f64,
    residual: f64,
}

impl BlockSet {
    fn new(per_side: usize) -> Self {
        Self { children: CHILDREN / per_side, per_side, pixels: Vec::new(), groups: Vec::new() }
    }

    /// Number of blocks.
    pub fn len(&self) -> usize {
        self.pixels.len() * self.per_pixel()
    }

    /// Blocks of one pixel.
    pub fn per_pixel(&self) -> usize {
        self.per_side * self.per_side
    }

    fn push(&mut self, pixel: usize, blocks: &[Block]) {
        let first = self.len();
        self.pixels.push(pixel as u32);
        self.groups.resize(self.len().div_ceil(GROUP), Group::EMPTY);
        for (k, block) in blocks.iter().enumerate() {
            let (group, lane) = (&mut self.groups[(first + k) / GROUP], (first + k) % GROUP);
            for axis in 0..3 {
                group.centre[axis][lane] = block.centre[axis];
                for (term, slope) in block.slopes.iter().enumerate() {
                    group.slopes[3 * term + axis][lane] = slope[axis] as f32;
                }
            }
            // Rounded up, so that no child is outside in f32 either.
            group.radius[lane] = (block.radius * (1.0 + 1e-6) + 1e-6) as f32;
        }
    }
}

/// The blocks for all baselines up to some length: most pixels in the coarsest set, a few in finer ones.
#[derive(Debug)]
pub(super) struct BlockClass {
    /// Set by set; the pixels of all sets together are all pixels, each once.
    pub sets: Vec<BlockSet>,
}

impl BlockClass {
    /// Blocks good for baselines of up to `wavelengths_max`, at least `per_side` along a pixel's side.
    pub fn new(nside: usize, per_side: usize, wavelengths_max: f64) -> Self {
        let sides: Vec<usize> = (0..=CHILDREN.ilog2()).map(|k| 1 << k).filter(|&s| s >= per_side).collect();
        let fitted: Vec<(usize, Vec<Block>)> = (0..healpix::pixel_count(nside))
            .into_par_iter()
            .map(|pixel| {
                let children: Vec<Vec3> = child_directions(nside, CHILDREN, pixel).collect();
                let good = |&&side: &&usize| {
                    side == CHILDREN || fit(&children, side).iter().all(|b| b.is_good(wavelengths_max))
                };
                let side = sides.iter().find(good).copied().unwrap_or(CHILDREN);
                (side, fit(&children, side))
            })
            .collect();
        let mut sets: Vec<BlockSet> = sides.iter().map(|&side| BlockSet::new(side)).collect();
        for (pixel, (side, blocks)) in fitted.iter().enumerate() {
            if let Some(set) = sets.iter_mut().find(|set| set.per_side == *side) {
                set.push(pixel, blocks);
            }
        }
        sets.retain(|set| !set.pixels.is_empty());
        Self { sets }
    }
}

impl Block {
    /// Whether the closed form holds for baselines of up to `wavelengths_max`.
    ///
    /// It takes the fit's quadratic phase to first order and leaves out the fit's residual.
    fn is_good(&self, wavelengths_max: f64) -> bool {
        use std::f64::consts::PI;
        let radians = 2.0 * PI * wavelengths_max;
        let [gx, gy, hxx, hxy, hyy] = self.slopes.map(norm);
        // Root mean squares over the unit square: x^2 - 1/12 has 1/sqrt(180), x y has 1/12.
        let quadratic = radians * ((hxx * hxx + hyy * hyy) / 180.0 + hxy * hxy / 144.0).sqrt();
        0.5 * radians * gx.max(gy) <= HALF_PHASE_RAD_MAX
            && 0.5 * radians * gx.max(gy) <= HALF_PHASE_RAD_PER_CHILD_MAX * self.children as f64
            && 0.5 * quadratic * quadratic <= ERROR_MAX
            && radians * self.residual <= ERROR_MAX
    }
}

/// Fits the `per_side`^2 blocks of a pixel whose children's directions are given, y running fastest.
fn fit(children: &[Vec3], per_side: usize) -> Vec<Block> {
    let m = CHILDREN / per_side;
    let mut blocks = Vec::with_capacity(per_side * per_side);
    let mut inside = Vec::with_capacity(m * m);
    for block in 0..per_side * per_side {
        let (x0, y0) = (block / per_side * m, block % per_side * m);
        inside.clear();
        inside.extend((0..m * m).map(|k| children[(x0 + k / m) * CHILDREN + y0 + k % m]));
        blocks.push(fit_block(&inside, m));
    }
    blocks
}

/// Fits one block of m x m children.
fn fit_block(children: &[Vec3], m: usize) -> Block {
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
        // With m of 1 or 2 some functions vanish at all children, up to rounding.
        *slope = if square > 1e-12 { scale(1.0 / square, *slope) } else { [0.0; 3] };
    }
    let (mut radius, mut residual) = (0.0_f64, 0.0);
    for (k, &child) in children.iter().enumerate() {
        let off = sub(child, mean);
        radius = radius.max(norm(off));
        let left = basis(k).iter().zip(slopes).fold(off, |left, (value, s)| sub(left, scale(*value, s)));
        residual += dot(left, left);
    }
    Block { children: m, centre: mean, slopes, radius, residual: (residual / children.len() as f64).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pixel_is_in_one_set() {
        for per_side in [1, 4] {
            let class = BlockClass::new(8, per_side, 20.0);
            let mut pixels: Vec<u32> = class.sets.iter().flat_map(|set| set.pixels.clone()).collect();
            pixels.sort_unstable();
            assert_eq!(pixels, (0..healpix::pixel_count(8) as u32).collect::<Vec<_>>());
            for set in &class.sets {
                assert!(set.per_side >= per_side);
                assert_eq!(set.len(), set.pixels.len() * set.per_pixel());
            }
        }
    }
}
