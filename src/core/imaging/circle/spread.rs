//! Gridding: adds each visibility to the sums at the neighbouring baseline nodes, with the spreading kernels of a non-uniform FFT.

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

/// The position of a visibility in the sums: a point on the torus at a baseline length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TorusPoint {
    /// Longitude of the ascending node minus pi/2, rad.
    pub(super) alpha_rad: f64,
    /// Orbital phase plus pi/2, rad.
    pub(super) gamma_rad: f64,
    /// Baseline length, wavelengths.
    pub(super) u: f64,
    /// Whether the sums contain the conjugate, which is the visibility of the pair with its satellites exchanged.
    pub(super) is_conjugated: bool,
}

impl Accepted<TorusPoint> {
    /// Real and imaginary parts of the weight times the visibility, and of the square root of the weight times unit noise.
    pub(super) fn right_hand_sides(&self) -> [f64; 4] {
        let value = if self.place.is_conjugated { self.value_k_sr.conj() } else { self.value_k_sr };
        let noise = self.noise * self.weight.sqrt();
        [self.weight * value.re, self.weight * value.im, noise.re, noise.im]
    }
}

/// A visibility with its kernels on every grid, and its weight and data in quanta.
#[derive(Clone, Debug)]
pub(super) struct GriddedVisibility {
    pub(super) first_node: usize,
    u: [f32; LANES],
    weight_first: [u32; 2],
    weight_kernel_alpha: [f32; LANES],
    weight_kernel_bounds: [u16; LANES],
    weight_kernel_gamma: [f32; LANES],
    data_first: [u32; 2],
    data_kernel_alpha: [f32; LANES],
    data_kernel_bounds: [u16; LANES],
    data_kernel_gamma: [f32; LANES],
    /// Weight, in 2^shift quanta.
    weight: f32,
    weight_shift: u32,
    /// Data and noise terms, each in 2^shift quanta.
    rhs: [f32; 4],
    rhs_shifts: [u32; 4],
    /// Draws of the error by its gains, if there are any.
    gain_errors: Option<Box<GriddedTerms>>,
}

/// Divides by the smallest power of two for which no value exceeds [`TERM_MAX`]; returns the values and the exponent.
fn scale_to_term_max<const N: usize>(quanta: [f64; N]) -> ([f32; N], u32) {
    let largest = quanta.iter().fold(0.0_f64, |largest, x| largest.max(x.abs()));
    let (mut shift, mut step) = (0, 1.0);
    while largest * step > TERM_MAX {
        shift += 1;
        step *= 0.5;
    }
    (quanta.map(|x| (x * step) as f32), shift)
}

impl GriddedVisibility {
    /// Computes kernels and terms; `u` must lie within the grid.
    pub(super) fn new(
        grids: &Grids,
        quanta: Quanta,
        visibility: &Accepted<TorusPoint>,
        direction: Direction,
    ) -> Self {
        let TorusPoint { alpha_rad, gamma_rad, u, .. } = visibility.place;
        let (first_node, u) = grids.u.spread((u - grids.nodes.first) / grids.nodes.step);
        let (points, data_points) = (grids.points, grids.data_points());
        let (a, weight_kernel_alpha) = Grids::kernel_at(&grids.weight_alpha, points, alpha_rad);
        let (g, weight_kernel_gamma) = Grids::kernel_at(&grids.weight_gamma, points, gamma_rad);
        let (da, data_kernel_alpha) = Grids::kernel_at(&grids.data, data_points, alpha_rad);
        let (dg, data_kernel_gamma) = Grids::kernel_at(&grids.data, data_points, gamma_rad);
        let sign = direction.sign();
        let ([weight], weight_shift) = scale_to_term_max([sign * visibility.weight / quanta.weight]);
        let [data_re, data_im, noise_re, noise_im] =
            visibility.right_hand_sides().map(|term| sign * term / quanta.right);
        let ([data_re, data_im], data_shift) = scale_to_term_max([data_re, data_im]);
        let ([noise_re, noise_im], noise_shift) = scale_to_term_max([noise_re, noise_im]);
        let draws = &visibility.gain_errors_k_sr;
        let gain_errors = (!draws.is_empty()).then(|| {
            let term = |error: &Complex64| {
                let error = if visibility.place.is_conjugated { error.conj() } else { *error };
                sign * visibility.weight * error
            };
            let pair = |draws: &[Complex64]| [term(&draws[0]), draws.get(1).map(term).unwrap_or_default()];
            Box::new(GriddedTerms::new(grids, quanta, &visibility.place, draws.chunks(2).map(pair)))
        });
        Self {
            first_node: first_node.max(0) as usize,
            u,
            weight_first: [a, g],
            weight_kernel_alpha,
            weight_kernel_bounds: kernel_bounds(&weight_kernel_alpha),
            weight_kernel_gamma,
            data_first: [da, dg],
            data_kernel_alpha,
            data_kernel_bounds: kernel_bounds(&data_kernel_alpha),
            data_kernel_gamma,
            weight,
            weight_shift,
            rhs: [data_re, data_im, noise_re, noise_im],
            rhs_shifts: [data_shift, data_shift, noise_shift, noise_shift],
            gain_errors,
        }
    }

    /// Whether it contributes to sums that this process holds.
    pub(super) fn reaches(&self, grids: &Grids) -> bool {
        let holds = |first: u32, kernel: &Kernel, points: usize| {
            (0..kernel.width()).any(|k| grids.holds((first as usize + k) % points))
        };
        holds(self.weight_first[0], &grids.weight_alpha, grids.points)
            || holds(self.data_first[0], &grids.data, grids.data_points())
    }

    /// Weight times `kernel_u[node]` times `kernel_u[k]` for each k from `node` on. Nodes are counted from the visibility's first node.
    fn node_products(&self, node: usize) -> [f32; NODES] {
        let mut products = [0.0; NODES];
        for (product, other) in products.iter_mut().zip(&self.u[node..NODES]) {
            *product = self.weight * self.u[node] * other;
        }
        products
    }
}

/// Adds visibilities to the sums at node `index`, which must be within the kernels of all of them.
pub(super) fn add_visibilities(
    grids: &Grids,
    direction: Direction,
    index: usize,
    reaching: &[&GriddedVisibility],
    node: &mut ExactNode,
) {
    let arch = Arch::new();
    let offset_of = |visibility: &GriddedVisibility| index - visibility.first_node;
    in_groups(
        reaching,
        |visibility| (visibility.first_node, visibility.weight_first, visibility.weight_shift),
        |first, group| {
            let rows = Rows {
                rows: &mut node.weights,
                share: grids.share,
                stride: grids.weight_stride(),
                first: first.weight_first,
                kernel_width: grids.weight_alpha.width(),
                rows_used: NODES - offset_of(first),
                shifts: [first.weight_shift; NODES],
                direction,
            };
            rows.add(arch, group, |visibility| Term {
                values: visibility.node_products(offset_of(visibility)),
                kernel_alpha: &visibility.weight_kernel_alpha,
                kernel_bounds: &visibility.weight_kernel_bounds,
                kernel_gamma: &visibility.weight_kernel_gamma,
            });
        },
    );
    in_groups(
        reaching,
        |visibility| (visibility.first_node, visibility.data_first, visibility.rhs_shifts),
        |first, group| {
            let rows = Rows {
                rows: &mut node.right,
                share: grids.share,
                stride: grids.data_stride(),
                first: first.data_first,
                kernel_width: grids.data.width(),
                rows_used: 4,
                shifts: first.rhs_shifts,
                direction,
            };
            rows.add(arch, group, |visibility| Term {
                values: visibility.rhs.map(|term| term * visibility.u[offset_of(visibility)]),
                kernel_alpha: &visibility.data_kernel_alpha,
                kernel_bounds: &visibility.data_kernel_bounds,
                kernel_gamma: &visibility.data_kernel_gamma,
            });
        },
    );
    let terms: Vec<&GriddedTerms> =
        reaching.iter().filter_map(|visibility| visibility.gain_errors.as_deref()).collect();
    for pair in 0..terms.iter().map(|terms| terms.pairs.len()).max().unwrap_or(0) {
        let terms: Vec<&GriddedTerms> =
            terms.iter().filter(|terms| pair < terms.pairs.len()).copied().collect();
        if node.gain_errors.len() <= pair {
            node.gain_errors.push(vec![IntegerRow::default(); grids.data_points()]);
        }
        add_pair(grids, direction, (index, pair), &terms, &mut node.gain_errors[pair]);
    }
}

/// Terms of a visibility in further right-hand sides, in quanta, with its kernels on the grid of data.
#[derive(Clone, Debug)]
pub(super) struct GriddedTerms {
    pub(super) first_node: usize,
    u: [f32; LANES],
    first: [u32; 2],
    kernel_alpha: [f32; LANES],
    kernel_bounds: [u16; LANES],
    kernel_gamma: [f32; LANES],
    /// Pairs of right-hand sides: four terms in 2^shift quanta, and their shifts.
    pairs: Vec<([f32; 4], [u32; 4])>,
}

impl GriddedTerms {
    /// Computes kernels and terms from those of pairs of right-hand sides, (K sr)^-1.
    pub(super) fn new(
        grids: &Grids,
        quanta: Quanta,
        place: &TorusPoint,
        pairs: impl Iterator<Item = [Complex64; 2]>,
    ) -> Self {
        let (first_node, u) = grids.u.spread((place.u - grids.nodes.first) / grids.nodes.step);
        let points = grids.data_points();
        let (a, kernel_alpha) = Grids::kernel_at(&grids.data, points, place.alpha_rad);
        let (g, kernel_gamma) = Grids::kernel_at(&grids.data, points, place.gamma_rad);
        let to_quanta =
            |value: Complex64| scale_to_term_max([value.re, value.im].map(|term| term / quanta.right));
        let pair_to_quanta = |[first, second]: [Complex64; 2]| {
            let ([a, b], first_shift) = to_quanta(first);
            let ([c, d], second_shift) = to_quanta(second);
            ([a, b, c, d], [first_shift, first_shift, second_shift, second_shift])
        };
        Self {
            first_node: first_node.max(0) as usize,
            u,
            first: [a, g],
            kernel_alpha,
            kernel_bounds: kernel_bounds(&kernel_alpha),
            kernel_gamma,
            pairs: pairs.map(pair_to_quanta).collect(),
        }
    }
}

/// Adds a pair of further right-hand sides to their sums at node `index`, which must be within the kernels of all visibilities.
pub(super) fn add_pair(
    grids: &Grids,
    direction: Direction,
    (index, pair): (usize, usize),
    reaching: &[&GriddedTerms],
    rows: &mut [IntegerRow],
) {
    let arch = Arch::new();
    in_groups(
        reaching,
        |terms| (terms.first_node, terms.first, terms.pairs[pair].1),
        |first, group| {
            let rows = Rows {
                rows: &mut *rows,
                share: grids.share,
                stride: grids.data_stride(),
                first: first.first,
                kernel_width: grids.data.width(),
                rows_used: 4,
                shifts: first.pairs[pair].1,
                direction,
            };
            rows.add(arch, group, |terms| Term {
                values: terms.pairs[pair].0.map(|term| term * terms.u[index - terms.first_node]),
                kernel_alpha: &terms.kernel_alpha,
                kernel_bounds: &terms.kernel_bounds,
                kernel_gamma: &terms.kernel_gamma,
            });
        },
    );
}

/// Calls `add` with groups of consecutive visibilities that share a grid cell and a shift.
fn in_groups<T, C: PartialEq>(reaching: &[&T], cell: impl Fn(&T) -> C, mut add: impl FnMut(&T, &[&T])) {
    for run in reaching.chunk_by(|a, b| cell(a) == cell(b)) {
        for group in run.chunks(GROUP_MAX) {
            add(group[0], group);
        }
    }
}

/// Maximum number of visibilities that are added at once, so that the sum of their terms fits 32 bits (see [`bounds`]).
const GROUP_MAX: usize = 8;

/// The rows of a grid, one per alpha, each `[K][gamma]`, with the region that a kernel covers.
struct Rows<'a, const K: usize> {
    rows: &'a mut [IntegerRow],
    /// The blocks of alphas that this process holds.
    share: RankShare,
    stride: usize,
    /// First alpha and gamma that the kernel covers.
    first: [u32; 2],
    /// Number of alphas that the kernel covers.
    kernel_width: usize,
    /// Number of the K parts that are written.
    rows_used: usize,
    /// Exponents of the powers of two, in quanta, of which the values of each part are multiples.
    shifts: [u32; K],
    direction: Direction,
}

impl<const K: usize> Rows<'_, K> {
    /// Adds the terms of a group of at most [`GROUP_MAX`] visibilities, summed in registers.
    #[inline(always)]
    fn add<'t, T>(self, arch: Arch, group: &[&'t T], term: impl Fn(&'t T) -> Term<'t, K>) {
        let mut terms = [Term::EMPTY; GROUP_MAX];
        for (to, visibility) in terms.iter_mut().zip(group) {
            *to = term(visibility);
        }
        arch.dispatch(SpreadRows { rows: self, terms: &terms[..group.len()] });
    }
}

/// The factors of one visibility's term.
#[derive(Clone, Copy)]
struct Term<'a, const K: usize> {
    values: [f32; K],
    kernel_alpha: &'a [f32; LANES],
    /// Upper bounds of the magnitudes of `kernel_alpha`, in units of 2^-8.
    kernel_bounds: &'a [u16; LANES],
    kernel_gamma: &'a [f32; LANES],
}

impl<const K: usize> Term<'_, K> {
    const EMPTY: Self = Self {
        values: [0.0; K],
        kernel_alpha: &[0.0; LANES],
        kernel_bounds: &[0; LANES],
        kernel_gamma: &[0.0; LANES],
    };

    /// Upper bound of its values, in units of their power of two.
    #[inline(always)]
    fn value_bound(&self) -> u32 {
        self.values.iter().fold(0, |bound, value| bound.max(value.abs() as i32 as u32)) + 1
    }
}

/// Bounds of kernels are in units of 2^-8.
const BOUND_FRACTION_BITS: u32 = 8;

/// Upper bounds of kernel values (at most 1), enlarged by 1/16 to cover rounding of kernels and products.
#[inline(always)]
fn kernel_bounds(kernel: &[f32; LANES]) -> [u16; LANES] {
    kernel.map(|value| (value.abs() * 1.0625 * (1 << BOUND_FRACTION_BITS) as f32) as u16 + 1)
}

/// For each alpha an upper bound of what a group adds to one sum, in units of 2^(largest shift) quanta, including rounding of terms.
///
/// Nothing overflows 32 bits: a product is at most 2^21 x 2^8 x 1.125, and the sum at most 2^22 per term of the group.
#[inline(always)]
fn bounds<const K: usize>(terms: &[Term<'_, K>]) -> [u32; LANES] {
    let mut bounds = [0_u32; LANES];
    for term in terms {
        let value_bound = term.value_bound();
        for (bound, kernel_bound) in bounds.iter_mut().zip(term.kernel_bounds) {
            *bound = bound.wrapping_add(
                (value_bound.wrapping_mul(u32::from(*kernel_bound)) >> BOUND_FRACTION_BITS) + 1,
            );
        }
    }
    bounds
}

/// Adds the outer products of values, alpha kernels and gamma kernels, each term rounded to a whole number.
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
        let shift = rows.shifts.iter().fold(0, |largest, shift| *shift.max(&largest));
        for (kernel_index, bound) in bounds.iter().enumerate().take(rows.kernel_width) {
            let here = alpha;
            alpha = if alpha + 1 == points { 0 } else { alpha + 1 };
            if !rows.share.holds(here / ALPHAS) {
                continue;
            }
            let Some(row) = rows.rows.get_mut(here) else { return };
            row.make_room(u64::from(*bound) << shift, rows.direction, K * rows.stride);
            for k in 0..rows.rows_used {
                let multiples = multiples(simd, terms, kernel_index, k);
                let start = k * rows.stride + gamma;
                match &mut row.integers {
                    Integers::Narrow(sums) => add_lanes(sums, start, &multiples, |sum, multiple| {
                        sum.wrapping_add(multiple << rows.shifts[k])
                    }),
                    Integers::Wide(sums) => add_lanes(sums, start, &multiples, |sum, multiple| {
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
/// Uses explicit SIMD vectors, because the compiler would vectorise over visibilities and need gathers.
#[inline(always)]
fn multiples<S: Simd, const K: usize>(
    simd: S,
    terms: &[Term<'_, K>],
    kernel_index: usize,
    k: usize,
) -> [u32; LANES] {
    // Adding BIAS rounds a float to an integer in the low bits of its mantissa: the bit patterns are added, and the sum of the biases is
    // taken off at the start.
    let mut multiples = [biases(terms.len()).wrapping_neg().cast_unsigned(); LANES];
    let (sums, _) = S::as_mut_simd_u32s(&mut multiples);
    let bias = simd.splat_f32s(BIAS);
    for term in terms {
        let factor = simd.splat_f32s(term.values[k] * term.kernel_alpha[kernel_index]);
        for (sum, kernel_gamma) in sums.iter_mut().zip(S::as_simd_f32s(term.kernel_gamma).0) {
            let biased = simd.mul_add_f32s(factor, *kernel_gamma, bias);
            *sum = simd.add_u32s(*sum, simd.transmute_u32s_f32s(biased));
        }
    }
    multiples
}

/// Adds one multiple per lane to the sums from `start` on.
#[inline(always)]
fn add_lanes<T: Copy>(
    sums: &mut [T],
    start: usize,
    multiples: &[u32; LANES],
    accumulate: impl Fn(T, i32) -> T,
) {
    let Some(sums) = sums.get_mut(start..).and_then(|sums| sums.first_chunk_mut::<LANES>()) else { return };
    for (sum, multiple) in sums.iter_mut().zip(multiples) {
        *sum = accumulate(*sum, multiple.cast_signed());
    }
}
