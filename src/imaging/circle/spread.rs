//! Spreads visibilities onto the sums at the nodes.

use num_complex::Complex64;
use pulp::{Arch, Simd, WithSimd};

use super::grid::ALPHAS;
use super::grid::{Grids, NODES};
use super::quanta::{BIAS, ExactNode, Quanta, TERM_MAX, biases};
use crate::imaging::exact::engine::Accepted;
use crate::imaging::exact::fixed_point::Direction;
use crate::imaging::exact::fixed_point::rows::{IntegerRow, Integers};
use crate::ranks::RankShare;
use crate::response::harmonic::gridding_kernel::{Kernel, LANES};

/// A visibility's place among the sums, on a torus at a baseline length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TorusPoint {
    /// Omega - pi/2, rad.
    pub(super) alpha_rad: f64,
    /// phi + pi/2, rad.
    pub(super) gamma_rad: f64,
    /// Baseline, wavelengths.
    pub(super) u: f64,
    /// Whether the sums hold the conjugate: the visibility of the pair with its satellites exchanged.
    pub(super) reversed: bool,
}

impl Accepted<TorusPoint> {
    /// Weight times visibility, real and imaginary part; root of the weight times unit noise, likewise.
    pub(super) fn right_hand_sides(&self) -> [f64; 4] {
        let value = if self.place.reversed { self.value_k_sr.conj() } else { self.value_k_sr };
        let noise = self.noise * self.weight.sqrt();
        [self.weight * value.re, self.weight * value.im, noise.re, noise.im]
    }
}

/// A visibility's place on every grid, and its weight and data in quanta.
#[derive(Clone, Debug)]
pub(super) struct Located {
    pub(super) first_node: usize,
    u: [f32; LANES],
    weight_first: [u32; 2],
    weight_alpha: [f32; LANES],
    weight_parts: [u16; LANES],
    weight_gamma: [f32; LANES],
    data_first: [u32; 2],
    data_alpha: [f32; LANES],
    data_parts: [u16; LANES],
    data_gamma: [f32; LANES],
    /// In 2^shift quanta.
    weight: f32,
    weight_shift: u32,
    /// Likewise.
    right: [f32; 4],
    right_shifts: [u32; 4],
}

/// Numbers of quanta in multiples of the least power of two for which none exceeds [`TERM_MAX`].
fn shifted<const N: usize>(quanta: [f64; N]) -> ([f32; N], u32) {
    let greatest = quanta.iter().fold(0.0_f64, |most, x| most.max(x.abs()));
    let (mut shift, mut step) = (0, 1.0);
    while greatest * step > TERM_MAX {
        shift += 1;
        step *= 0.5;
    }
    (quanta.map(|x| (x * step) as f32), shift)
}

impl Located {
    /// `u` must lie within the grid.
    pub(super) fn new(
        grids: &Grids,
        quanta: Quanta,
        visibility: &Accepted<TorusPoint>,
        direction: Direction,
    ) -> Self {
        let TorusPoint { alpha_rad, gamma_rad, u, .. } = visibility.place;
        let (first_node, u) = grids.u.spread((u - grids.nodes.first) / grids.nodes.step);
        let (points, data_points) = (grids.points, grids.data_points());
        let (a, weight_alpha) = Grids::on_circle(&grids.weight_alpha, points, alpha_rad);
        let (g, weight_gamma) = Grids::on_circle(&grids.weight_gamma, points, gamma_rad);
        let (da, data_alpha) = Grids::on_circle(&grids.data, data_points, alpha_rad);
        let (dg, data_gamma) = Grids::on_circle(&grids.data, data_points, gamma_rad);
        let sign = direction.sign();
        let ([weight], weight_shift) = shifted([sign * visibility.weight / quanta.weight]);
        let [data_re, data_im, noise_re, noise_im] =
            visibility.right_hand_sides().map(|term| sign * term / quanta.right);
        let ([data_re, data_im], data_shift) = shifted([data_re, data_im]);
        let ([noise_re, noise_im], noise_shift) = shifted([noise_re, noise_im]);
        Self {
            first_node: first_node.max(0) as usize,
            u,
            weight_first: [a, g],
            weight_alpha,
            weight_parts: parts(&weight_alpha),
            weight_gamma,
            data_first: [da, dg],
            data_alpha,
            data_parts: parts(&data_alpha),
            data_gamma,
            weight,
            weight_shift,
            right: [data_re, data_im, noise_re, noise_im],
            right_shifts: [data_shift, data_shift, noise_shift, noise_shift],
        }
    }

    /// Whether it adds to sums that this process holds.
    pub(super) fn reaches(&self, grids: &Grids) -> bool {
        let holds = |first: u32, kernel: &Kernel, points: usize| {
            (0..kernel.width()).any(|k| grids.holds((first as usize + k) % points))
        };
        holds(self.weight_first[0], &grids.weight_alpha, grids.points)
            || holds(self.data_first[0], &grids.data, grids.data_points())
    }

    /// Weights of one of its nodes with itself and with those above; the first node is 0.
    fn diagonals(&self, at: usize) -> [f32; NODES] {
        let mut diagonals = [0.0; NODES];
        for (diagonal, other) in diagonals.iter_mut().zip(&self.u[at..NODES]) {
            *diagonal = self.weight * self.u[at] * other;
        }
        diagonals
    }
}

/// Adds visibilities to the sums at node `index`, which all of them reach.
pub(super) fn spread(
    grids: &Grids,
    direction: Direction,
    index: usize,
    reaching: &[&Located],
    node: &mut ExactNode,
) {
    let arch = Arch::new();
    let at = |one: &Located| index - one.first_node;
    in_groups(
        reaching,
        |one| (one.first_node, one.weight_first, one.weight_shift),
        |first, group| {
            let rows = Rows {
                rows: &mut node.weights,
                share: grids.share,
                stride: grids.weight_stride(),
                first: first.weight_first,
                alphas: grids.weight_alpha.width(),
                used: NODES - at(first),
                shifts: [first.weight_shift; NODES],
                direction,
            };
            rows.add(arch, group, |one| Term {
                values: one.diagonals(at(one)),
                alphas: &one.weight_alpha,
                parts: &one.weight_parts,
                gammas: &one.weight_gamma,
            });
        },
    );
    in_groups(
        reaching,
        |one| (one.first_node, one.data_first, one.right_shifts),
        |first, group| {
            let rows = Rows {
                rows: &mut node.right,
                share: grids.share,
                stride: grids.data_stride(),
                first: first.data_first,
                alphas: grids.data.width(),
                used: 4,
                shifts: first.right_shifts,
                direction,
            };
            rows.add(arch, group, |one| Term {
                values: one.right.map(|term| term * one.u[at(one)]),
                alphas: &one.data_alpha,
                parts: &one.data_parts,
                gammas: &one.data_gamma,
            });
        },
    );
}

/// A visibility's place on the grid of data, and noises of it in quanta.
#[derive(Clone, Debug)]
pub(super) struct LocatedNoise {
    pub(super) first_node: usize,
    u: [f32; LANES],
    first: [u32; 2],
    alpha: [f32; LANES],
    parts: [u16; LANES],
    gamma: [f32; LANES],
    /// Of two realisations each, in 2^shift quanta.
    pairs: Vec<([f32; 4], [u32; 4])>,
}

impl LocatedNoise {
    /// Of noises in (K sr)^-1, two realisations each.
    pub(super) fn new(
        grids: &Grids,
        quanta: Quanta,
        place: &TorusPoint,
        noises: impl Iterator<Item = [Complex64; 2]>,
    ) -> Self {
        let (first_node, u) = grids.u.spread((place.u - grids.nodes.first) / grids.nodes.step);
        let points = grids.data_points();
        let (a, alpha) = Grids::on_circle(&grids.data, points, place.alpha_rad);
        let (g, gamma) = Grids::on_circle(&grids.data, points, place.gamma_rad);
        let of_one = |noise: Complex64| shifted([noise.re, noise.im].map(|term| term / quanta.right));
        let of_two = |[one, other]: [Complex64; 2]| {
            let (([a, b], one), ([c, d], other)) = (of_one(one), of_one(other));
            ([a, b, c, d], [one, one, other, other])
        };
        Self {
            first_node: first_node.max(0) as usize,
            u,
            first: [a, g],
            alpha,
            parts: parts(&alpha),
            gamma,
            pairs: noises.map(of_two).collect(),
        }
    }
}

/// Adds the noises of two realisations, number `pair` of each visibility's, to their sums at node `index`, which all of them reach.
pub(super) fn spread_noises(
    grids: &Grids,
    index: usize,
    pair: usize,
    reaching: &[&LocatedNoise],
    rows: &mut [IntegerRow],
) {
    let arch = Arch::new();
    in_groups(
        reaching,
        |one| (one.first_node, one.first, one.pairs[pair].1),
        |first, group| {
            let rows = Rows {
                rows: &mut *rows,
                share: grids.share,
                stride: grids.data_stride(),
                first: first.first,
                alphas: grids.data.width(),
                used: 4,
                shifts: first.pairs[pair].1,
                direction: Direction::In,
            };
            rows.add(arch, group, |one| Term {
                values: one.pairs[pair].0.map(|term| term * one.u[index - one.first_node]),
                alphas: &one.alpha,
                parts: &one.parts,
                gammas: &one.gamma,
            });
        },
    );
}

/// Calls `add` with groups of consecutive visibilities in one cell of the grid, and of one power of two.
fn in_groups<T, C: PartialEq>(reaching: &[&T], cell: impl Fn(&T) -> C, mut add: impl FnMut(&T, &[&T])) {
    for run in reaching.chunk_by(|a, b| cell(a) == cell(b)) {
        for group in run.chunks(GROUP) {
            add(group[0], group);
        }
    }
}

/// Most visibilities that are added at once: their terms of up to 2^22 sum within 32 bits.
const GROUP: usize = 8;

/// By alpha `[K][gamma]`, and the first point in alpha and gamma to add to.
struct Rows<'a, const K: usize> {
    rows: &'a mut [IntegerRow],
    /// The blocks of alphas that are held; others are left out.
    share: RankShare,
    stride: usize,
    first: [u32; 2],
    /// Alphas that are reached.
    alphas: usize,
    /// Of K.
    used: usize,
    /// Powers of two, in quanta, that values of each of K are multiples of.
    shifts: [u32; K],
    direction: Direction,
}

impl<const K: usize> Rows<'_, K> {
    /// Adds the terms of a group of at most [`GROUP`] visibilities together, in registers.
    #[inline(always)]
    fn add<'t, T>(self, arch: Arch, group: &[&'t T], term: impl Fn(&'t T) -> Term<'t, K>) {
        let mut terms = [Term::EMPTY; GROUP];
        for (to, one) in terms.iter_mut().zip(group) {
            *to = term(one);
        }
        arch.dispatch(SpreadRows { rows: self, terms: &terms[..group.len()] });
    }
}

/// One visibility's factors.
#[derive(Clone, Copy)]
struct Term<'a, const K: usize> {
    values: [f32; K],
    alphas: &'a [f32; LANES],
    /// Bounds of the alphas.
    parts: &'a [u16; LANES],
    gammas: &'a [f32; LANES],
}

impl<const K: usize> Term<'_, K> {
    const EMPTY: Self =
        Self { values: [0.0; K], alphas: &[0.0; LANES], parts: &[0; LANES], gammas: &[0.0; LANES] };

    /// Bound of its values, in quanta times the power of two that each is a multiple of, rounded up.
    #[inline(always)]
    fn greatest(&self) -> u32 {
        self.values.iter().fold(0, |most, value| most.max(value.abs() as i32 as u32)) + 1
    }
}

/// Bounds of kernels are counted in units of 2^-8.
const PARTS: u32 = 8;

/// Bounds of kernels, which are at most one up to rounding: a sixteenth more, for roundings of kernels and products.
#[inline(always)]
fn parts(kernel: &[f32; LANES]) -> [u16; LANES] {
    kernel.map(|alpha| (alpha.abs() * 1.0625 * (1 << PARTS) as f32) as u16 + 1)
}

/// For each alpha the most that terms add to a sum, in quanta times the greatest power of two that values are multiples
/// of: their values times their kernels, and half of the step to which they are rounded.
///
/// 32 bits hold it: 2^21 times 2^8 and an eighth, and 2^22 for each term of a group.
#[inline(always)]
fn bounds<const K: usize>(terms: &[Term<'_, K>]) -> [u32; LANES] {
    let mut bounds = [0_u32; LANES];
    for term in terms {
        let greatest = term.greatest();
        for (bound, part) in bounds.iter_mut().zip(term.parts) {
            *bound = bound.wrapping_add((greatest.wrapping_mul(u32::from(*part)) >> PARTS) + 1);
        }
    }
    bounds
}

/// Adds the outer products of values, alphas and gammas, each term rounded to a whole number.
struct SpreadRows<'a, const K: usize> {
    rows: Rows<'a, K>,
    terms: &'a [Term<'a, K>],
}

impl<const K: usize> WithSimd for SpreadRows<'_, K> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { rows, terms } = self;
        let [first, gamma] = rows.first.map(|x| x as usize);
        let points = rows.rows.len();
        let mut alpha = first;
        let bounds = bounds(terms);
        let shift = rows.shifts.iter().fold(0, |most, shift| *shift.max(&most));
        for (lane, bound) in bounds.iter().enumerate().take(rows.alphas) {
            let here = alpha;
            alpha = if alpha + 1 == points { 0 } else { alpha + 1 };
            if !rows.share.holds(here / ALPHAS) {
                continue;
            }
            let Some(row) = rows.rows.get_mut(here) else { return };
            row.make_room(u64::from(*bound) << shift, rows.direction, K * rows.stride);
            for k in 0..rows.used {
                let multiples = multiples(simd, terms, lane, k);
                let at = k * rows.stride + gamma;
                match &mut row.integers {
                    Integers::Narrow(sums) => add(sums, at, &multiples, |sum, multiple| {
                        sum.wrapping_add(multiple << rows.shifts[k])
                    }),
                    Integers::Wide(sums) => add(sums, at, &multiples, |sum, multiple| {
                        sum.wrapping_add(i64::from(multiple) << rows.shifts[k])
                    }),
                    Integers::None => {}
                }
            }
        }
    }
}

/// The rounded terms of one alpha, summed over visibilities.
///
/// With named registers: the compiler would otherwise vectorise over visibilities, with gathers.
#[inline(always)]
fn multiples<S: Simd, const K: usize>(simd: S, terms: &[Term<'_, K>], lane: usize, k: usize) -> [u32; LANES] {
    let mut multiples = [biases(terms.len()).wrapping_neg().cast_unsigned(); LANES];
    let (sums, _) = S::as_mut_simd_u32s(&mut multiples);
    let bias = simd.splat_f32s(BIAS);
    for term in terms {
        let factor = simd.splat_f32s(term.values[k] * term.alphas[lane]);
        for (sum, gammas) in sums.iter_mut().zip(S::as_simd_f32s(term.gammas).0) {
            let biased = simd.mul_add_f32s(factor, *gammas, bias);
            *sum = simd.add_u32s(*sum, simd.transmute_u32s_f32s(biased));
        }
    }
    multiples
}

#[inline(always)]
fn add<T: Copy>(sums: &mut [T], at: usize, multiples: &[u32; LANES], add: impl Fn(T, i32) -> T) {
    let Some(sums) = sums.get_mut(at..).and_then(|sums| sums.first_chunk_mut::<LANES>()) else { return };
    for (sum, multiple) in sums.iter_mut().zip(multiples) {
        *sum = add(*sum, multiple.cast_signed());
    }
}
