//! Averages over blocks that the limb of the Moon crosses, child by child, but without a sine for each child.
//!
//! Lanes hold columns of children (several pieces of a column if the block is small) and step through their children
//! together. The phase along a column is quadratic, so that one rotation advances the fringe from child to child, and a second
//! rotation updates the first.

use std::f32::consts::TAU;

use multiversion::multiversion;

use super::blocks::{BlockGroup, GX, GY, HXX, HXY, HYY};
use super::kernel::{KernelGeometry, dot64};
use crate::units::arithmetic::{cos_sin_turns, fraction_of_turn, fused};

const LANES: usize = 16;

/// Coefficients of a scalar field over a block: constant, x, y, x^2 - v, x y, y^2 - v.
type BlockField = [f32; 6];

/// Computes the mean of A S_i S_j exp(-2 pi i u . n) over block `lane` of `group`, which has `children`^2 children.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn limb_block_mean(
    pair: &KernelGeometry,
    children: usize,
    group: &BlockGroup,
    lane: usize,
) -> (f32, f32) {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    let field = |v: [f64; 3]| -> BlockField {
        let term = |term: usize| {
            (0..3).map(|axis| v[axis] * f64::from(group.slopes[term + axis][lane])).sum::<f64>() as f32
        };
        [0.0, term(GX), term(GY), term(HXX), term(HXY), term(HYY)]
    };
    let at_centre =
        |v: [f64; 3]| dot64::<FMA>(v, group.centre[0][lane], group.centre[1][lane], group.centre[2][lane]);
    let with = |constant: f32, mut field: BlockField| {
        field[0] = constant;
        field
    };
    let fields = BlockFields {
        turns: with(fraction_of_turn(at_centre(pair.u)), field(pair.u)),
        depth_i: with((at_centre(pair.i_hat) + pair.limb_i) as f32, field(pair.i_hat)),
        depth_j: with((at_centre(pair.j_hat) + pair.limb_j) as f32, field(pair.j_hat)),
        along: match pair.dipole {
            Some(dipole) => with(at_centre(dipole) as f32, field(dipole)),
            None => [0.0; 6],
        },
    };
    let columns = children.min(LANES);
    // `children` is a power of two: pieces of columns fill the lanes, or several slices cover the columns.
    let pieces = (LANES / columns).min(children);
    let mut sum = [0.0_f32; 2];
    for first_column in (0..children).step_by(columns) {
        let part = fields.sum::<FMA>(ColumnSlice { children, columns, pieces, first_column });
        sum = [sum[0] + part[0], sum[1] + part[1]];
    }
    let per_child = 1.0 / (children * children) as f32;
    (sum[0] * per_child, sum[1] * per_child)
}

/// Phase, depths above the limbs and dipole projection of a pair over one block.
struct BlockFields {
    turns: BlockField,
    depth_i: BlockField,
    depth_j: BlockField,
    along: BlockField,
}

/// Some columns of a block, divided into pieces so that columns times pieces fit the lanes.
#[derive(Clone, Copy)]
struct ColumnSlice {
    children: usize,
    columns: usize,
    pieces: usize,
    first_column: usize,
}

impl BlockFields {
    #[inline(always)]
    fn sum<const FMA: bool>(&self, slice: ColumnSlice) -> [f32; 2] {
        let per_side = 1.0 / slice.children as f32;
        let variance = (1.0 - per_side * per_side) / 12.0;
        let steps = slice.children / slice.pieces;
        let (mut x, mut y, mut active) = ([0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES]);
        for lane in 0..LANES {
            let column = slice.first_column + lane % slice.columns;
            let piece = lane / slice.columns;
            x[lane] = (column as f32 + 0.5) * per_side - 0.5;
            y[lane] = ((piece * steps) as f32 + 0.5) * per_side - 0.5;
            active[lane] = if piece < slice.pieces { 1.0 } else { 0.0 };
        }
        let on = |field: &BlockField| ColumnField::new::<FMA>(field, &x, variance);
        let (turns, depth_i, depth_j, along) =
            (on(&self.turns), on(&self.depth_i), on(&self.depth_j), on(&self.along));
        let (mut re, mut im) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        let (mut step_re, mut step_im) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        for lane in 0..LANES {
            (re[lane], im[lane]) = conjugate_fringe::<FMA>(turns.at::<FMA>(lane, y[lane]));
            let step = turns.at::<FMA>(lane, y[lane] + per_side) - turns.at::<FMA>(lane, y[lane]);
            (step_re[lane], step_im[lane]) = conjugate_fringe::<FMA>(step);
        }
        // Second difference of the phase, which is small and the same in all lanes.
        let second_difference = TAU * 2.0 * turns.square * per_side * per_side;
        let (second_difference_re, second_difference_im) =
            (fused::<FMA>(-0.5 * second_difference, second_difference, 1.0), -second_difference);
        let (mut sum_re, mut sum_im) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        for _ in 0..steps {
            for lane in 0..LANES {
                let depth = depth_i.at::<FMA>(lane, y[lane]).min(depth_j.at::<FMA>(lane, y[lane]));
                let along = along.at::<FMA>(lane, y[lane]);
                let seen = if depth >= 0.0 { fused::<FMA>(-along, along, 1.0) } else { 0.0 };
                sum_re[lane] = fused::<FMA>(seen, re[lane], sum_re[lane]);
                sum_im[lane] = fused::<FMA>(seen, im[lane], sum_im[lane]);
                (re[lane], im[lane]) = product::<FMA>((re[lane], im[lane]), (step_re[lane], step_im[lane]));
                (step_re[lane], step_im[lane]) = product::<FMA>(
                    (step_re[lane], step_im[lane]),
                    (second_difference_re, second_difference_im),
                );
                y[lane] += per_side;
            }
        }
        let mut sum = [0.0_f32; 2];
        for lane in 0..LANES {
            sum[0] = fused::<FMA>(active[lane], sum_re[lane], sum[0]);
            sum[1] = fused::<FMA>(active[lane], sum_im[lane], sum[1]);
        }
        sum
    }
}

/// A field along the columns of the lanes: a quadratic in y for each lane.
struct ColumnField {
    constant: [f32; LANES],
    linear: [f32; LANES],
    square: f32,
}

impl ColumnField {
    #[inline(always)]
    fn new<const FMA: bool>(field: &BlockField, x: &[f32; LANES], variance: f32) -> Self {
        let [constant, fx, fy, fxx, fxy, fyy] = *field;
        let curved = |x: f32| fused::<FMA>(fxx, x * x - variance, constant - fyy * variance);
        Self {
            constant: x.map(|x| fused::<FMA>(fx, x, curved(x))),
            linear: x.map(|x| fused::<FMA>(fxy, x, fy)),
            square: fyy,
        }
    }

    #[inline(always)]
    fn at<const FMA: bool>(&self, lane: usize, y: f32) -> f32 {
        fused::<FMA>(fused::<FMA>(self.square, y, self.linear[lane]), y, self.constant[lane])
    }
}

/// Computes exp(-2 pi i turns) for a few turns.
#[inline(always)]
fn conjugate_fringe<const FMA: bool>(turns: f32) -> (f32, f32) {
    // Rounds as in `fraction_of_turn`: exact for |turns| < 2^21, and a block spans a few turns.
    const MAGIC: f32 = 12_582_912.0;
    let (cos, sin) = cos_sin_turns::<FMA>(turns - ((turns + MAGIC) - MAGIC));
    (cos, -sin)
}

#[inline(always)]
fn product<const FMA: bool>(a: (f32, f32), b: (f32, f32)) -> (f32, f32) {
    (fused::<FMA>(a.0, b.0, -a.1 * b.1), fused::<FMA>(a.0, b.1, a.1 * b.0))
}
