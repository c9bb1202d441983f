//! Averages of a fringe over blocks of children in closed form.
//!
//! Over a block the phase is `2 pi u . c + alpha x + beta y` plus a small quadratic (see
//! [`super::blocks`]). The mean of exp(-i alpha x) over m children is the Dirichlet kernel
//! `sin(alpha/2) / (m sin(alpha/2m)) = S(t) / S(t/m)`, t = alpha/2, S(t) = sin t / t. The quadratic is
//! expanded to first order, which also needs the means of x and x^2: with P(t) = S'(t) / t,
//! `<x e> = (i/2) t P` and `<(x^2 - 1/12) e> = S/6 + P/2`.

use std::f32::consts::PI;

use multiversion::multiversion;

use super::blocks::{BlockGroup, GROUP, GX, GY, HALF_PHASE_RAD_MAX, HXX, HXY, HYY};
use super::kernel::{KernelGeometry, dot32, dot64};
use crate::units::arithmetic::{cos_sin_turns, fraction_of_turn, fused, polynomial};

/// Mean responses over a group of blocks.
#[derive(Clone, Debug)]
pub(super) struct Means {
    pub re: [f32; GROUP],
    pub im: [f32; GROUP],
    /// 1 where the limb of the Moon may cross the block, else 0.
    pub cut: [f32; GROUP],
}

impl Default for Means {
    fn default() -> Self {
        Self { re: [0.0; GROUP], im: [0.0; GROUP], cut: [0.0; GROUP] }
    }
}

/// Computes the means of A S_i S_j exp(-2 pi i u . n) over blocks of `children`^2 children. Marks the blocks that a limb may cross, for
/// [`limb_block_mean`](super::limb_blocks::limb_block_mean), and returns whether there are any.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512dq+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(super) fn block_means(
    pair: &KernelGeometry,
    children: usize,
    group: &BlockGroup,
    means: &mut Means,
) -> bool {
    const FMA: bool =
        multiversion::target::target_cfg_f!(any(target_feature = "fma", target_feature = "neon"));
    if let Some(dipole) = pair.dipole {
        means_of::<FMA, true>(pair, dipole.map(|w| w as f32), children, group, means)
    } else {
        means_of::<FMA, false>(pair, [0.0; 3], children, group, means)
    }
}

#[inline(always)]
fn means_of<const FMA: bool, const DIPOLE: bool>(
    pair: &KernelGeometry,
    dipole: [f32; 3],
    children: usize,
    group: &BlockGroup,
    means: &mut Means,
) -> bool {
    let mut turns = [0.0_f32; GROUP];
    let mut depth = [0.0_f32; GROUP];
    let [x, y, z] = &group.centre;
    for k in 0..GROUP {
        turns[k] = fraction_of_turn(dot64::<FMA>(pair.u, x[k], y[k], z[k]));
        let (depth_i, depth_j) = pair.depths::<FMA>(x[k], y[k], z[k]);
        depth[k] = depth_i.min(depth_j) as f32;
    }
    let u = pair.u.map(|u| u as f32 * PI);
    let per_side = 1.0 / children as f32;
    let at = |term: usize, k: usize, v: [f32; 3]| {
        dot32::<FMA>(v, group.slopes[term][k], group.slopes[term + 1][k], group.slopes[term + 2][k])
    };
    for k in 0..GROUP {
        let (tx, ty) = (at(GX, k, u), at(GY, k, u));
        let (sx, px) = sinc::<FMA>(tx);
        let (sy, py) = sinc::<FMA>(ty);
        let second = |s: f32, p: f32| fused::<FMA>(s, 1.0 / 6.0, 0.5 * p);
        // The quadratic needs a factor 2 pi, but u contains only pi.
        let quadratic = 2.0 * at(HXX, k, u) * second(sx, px) * sy + 2.0 * at(HYY, k, u) * sx * second(sy, py)
            - 0.5 * at(HXY, k, u) * (tx * px) * (ty * py);
        let sampled = inverse_sinc::<FMA>(tx * per_side) * inverse_sinc::<FMA>(ty * per_side);
        let (mut even, mut odd) = (sx * sy, -quadratic);
        if DIPOLE {
            let along = dot32::<FMA>(dipole, x[k] as f32, y[k] as f32, z[k] as f32);
            let (wx, wy) = (at(GX, k, dipole), at(GY, k, dipole));
            let mean = 1.0 - along * along - (wx * wx + wy * wy) * (1.0 - per_side * per_side) / 12.0;
            let slope = -along * (wx * (tx * px) * sy + wy * sx * (ty * py));
            (even, odd) = (mean * even, fused::<FMA>(mean, odd, slope));
        }
        let seen = if depth[k] >= group.radius[k] { sampled } else { 0.0 };
        let (cos, sin) = cos_sin_turns::<FMA>(turns[k]);
        means.re[k] = seen * fused::<FMA>(cos, even, sin * odd);
        means.im[k] = seen * fused::<FMA>(cos, odd, -sin * even);
        means.cut[k] = if depth[k].abs() < group.radius[k] { 1.0 } else { 0.0 };
    }
    means.cut.iter().any(|&cut| cut != 0.0)
}

/// Computes S(t) = sin t / t and P(t) = S'(t) / t for |t| <= [`HALF_PHASE_RAD_MAX`], to 6e-7.
///
/// They are polynomials in t^2, interpolated at Chebyshev points. The choice of blocks keeps the argument in range; clamping
/// bounds the result in any case.
#[inline(always)]
fn sinc<const FMA: bool>(t: f32) -> (f32, f32) {
    const S: [f32; 11] = [
        0.100_248_12,
        0.302_549_15,
        -0.853_463,
        0.080_921_67,
        0.818_227_95,
        -0.787_056_1,
        0.380_474_5,
        -0.118_882_81,
        0.026_681_827,
        -0.004_732_928,
        0.000_629_498_16,
    ];
    const P: [f32; 10] = [
        0.012_101_937,
        -0.068_277_024,
        0.009_711_776,
        0.130_916_22,
        -0.157_418_27,
        0.091_314_85,
        -0.033_274_032,
        0.008_536_709,
        -0.001_711_372,
        0.000_252_537_63,
    ];
    const PER_SQUARE: f32 = (2.0 / (HALF_PHASE_RAD_MAX * HALF_PHASE_RAD_MAX)) as f32;
    let place = fused::<FMA>(t * t, PER_SQUARE, -1.0).min(1.0);
    (polynomial::<FMA, 11>(&S, place), polynomial::<FMA, 10>(&P, place))
}

/// Computes 1 / S(t) by its series, to 1e-5 for |t| <= 0.8 and 2 % at 2; t is the half phase over one child.
///
/// Where t is large, the result multiplies kernels of order (1 / CHILDREN t)^2 or less.
#[inline(always)]
fn inverse_sinc<const FMA: bool>(t: f32) -> f32 {
    const SERIES: [f32; 5] = [1.0, 1.0 / 6.0, 7.0 / 360.0, 31.0 / 15_120.0, 127.0 / 604_800.0];
    polynomial::<FMA, 5>(&SERIES, t * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sinc_and_its_derivative_are_right() {
        for k in 1..=2000 {
            let t = HALF_PHASE_RAD_MAX * f64::from(k) / 2000.0;
            let (s, p) = sinc::<false>(t as f32);
            let expected = t.sin() / t;
            // The error is interpolation and f32 rounding.
            assert!((f64::from(s) - expected).abs() < 1.5e-6, "{t}");
            // The closed form of P loses bits as t^-2, unlike the polynomial.
            let derivative = (t.cos() - expected) / (t * t);
            assert!((f64::from(p) - derivative).abs() < 1e-6 + 1e-15 / (t * t), "{t}");
        }
        for k in 1..=200 {
            let t = f64::from(k) / 100.0;
            // The truncated terms of the series, from 2.1e-5 t^10 on.
            let truncated = 4.5e-5 * t.powi(10) + 1e-6;
            assert!((f64::from(inverse_sinc::<false>(t as f32)) - t / t.sin()).abs() < truncated, "{t}");
        }
    }
}
