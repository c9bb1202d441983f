//! Products with B and its transpose.

use std::ops::Range;

use num_complex::Complex64;
use rayon::prelude::*;

use super::antennas::Products;
use super::cap::{CapBuffers, CapClass, NodePatterns, Patterns, batch_bytes};
use super::classes::tables_bytes;
use super::frames::{Frames, Turned};
use super::instants::Instants;
use super::lanes::{LANES, Lanes, VALUES, Value};
use super::phases::{PaddedShares, PhaseGrid, PhaseTable};
use super::plan::{GROUP_NODES, Observed, Pass, RowNode, RowPlan};
use super::turns::{QuarterTurns, place};
use super::{PairAt, RowsError, RowsSetup};
use crate::response::harmonic::degrees;
use crate::response::harmonic::trigonometry::sin_cos;
use crate::sky::harmonics::Alm;

/// Rows of one class that a task computes together.
const BATCH: usize = 32;

/// Groups whose gradients are held until they are added.
const GROUPS_AT_ONCE: usize = 32;

/// Rows of B over harmonics, for any positions.
#[derive(Clone, Debug)]
pub struct GeneralRows {
    /// With the degrees that products with the response have.
    setup: RowsSetup,
    products: Products,
    instants: Instants,
    turns: QuarterTurns,
    patterns: Patterns,
    phases: PhaseGrid,
}

impl GeneralRows {
    /// Rows for a setup.
    #[must_use]
    pub fn new(setup: RowsSetup) -> Self {
        let products = Products::new(setup.polynomial_degree);
        let setup = RowsSetup { l_max: setup.l_max + products.degree(), ..setup };
        let turns = QuarterTurns::new(setup.l_max);
        let (patterns, phases) = (Patterns::new(setup), PhaseGrid::new(setup.l_max));
        Self { patterns, phases, turns, setup, products, instants: Instants::new() }
    }

    /// Plans the rows of visibilities: few of them where consecutive ones are of one pair and in the order of time.
    ///
    /// # Errors
    /// The first visibility whose positions have no row.
    pub fn plan(&self, pairs: &[PairAt]) -> Result<RowPlan, RowsError> {
        self.plan_of(pairs, &Observed::default())
    }

    /// As [`Self::plan`], of averages over integrations and of pairs with responses of their own.
    ///
    /// # Errors
    /// As [`Self::plan`].
    pub fn plan_of(&self, pairs: &[PairAt], observed: &Observed<'_>) -> Result<RowPlan, RowsError> {
        RowPlan::new(&self.setup, pairs, observed, false)
    }

    /// As [`Self::plan`], each row computed for itself.
    ///
    /// # Errors
    /// As [`Self::plan`].
    pub fn plan_direct(&self, pairs: &[PairAt]) -> Result<RowPlan, RowsError> {
        RowPlan::new(&self.setup, pairs, &Observed::default(), true)
    }

    /// Visibilities, K sr, of skies given by coefficients up to `l_max`: `B x`, one vector a sky.
    #[must_use]
    pub fn forward(&self, plan: &RowPlan, skies: &[Alm]) -> Vec<Vec<Complex64>> {
        let tables = Tables::new(&self.setup, plan);
        let (count, skies) = (skies.len(), self.products.of(skies));
        let skies = skies.as_slice();
        let values = plan.groups.par_iter().map(|group| {
            let passes = &plan.passes[group.clone()];
            let mut amplitudes = self.no_amplitudes(passes, skies.len());
            let mut buffers = CapBuffers::default();
            let frames = self.frames(plan, passes);
            let basis = frames.as_ref().map(|frames| (frames, self.turned(&frames.chosen, skies)));
            for places in Self::batches(plan, passes) {
                let Some(batch) = self.batch(plan, passes, &tables, &mut buffers, places) else { continue };
                self.amplitudes(&batch, skies, basis.as_ref(), &mut amplitudes);
            }
            self.interpolate(plan, passes, &amplitudes, count)
        });
        joined(plan, count, values.collect())
    }

    /// `sum_t Re(conj(dV_t/dx) v_t)` with respect to `Re T_lm` and `Im T_lm`, as real and imaginary part: `Bt v` for each of
    /// several vectors of one value a row.
    #[must_use]
    pub fn adjoint(&self, plan: &RowPlan, values: &[&[Complex64]]) -> Vec<Alm> {
        let tables = Tables::new(&self.setup, plan);
        let skies = values.len() * self.products.count();
        let mut out = vec![Alm::zeros(self.setup.l_max); skies];
        // The order of sums is that of the groups, whatever the threads.
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                let passes = &plan.passes[group.clone()];
                let rows = rows_of(passes);
                let values: Vec<&[Complex64]> = values.iter().map(|values| &values[rows.clone()]).collect();
                let amplitudes = self.spread(plan, passes, &values);
                let mut gradients = vec![Alm::zeros(self.setup.l_max); skies];
                let mut buffers = CapBuffers::default();
                let frames = self.frames(plan, passes);
                let mut basis = frames.as_ref().map(|frames| (frames, self.no_turned(frames, skies)));
                for places in Self::batches(plan, passes) {
                    let Some(batch) = self.batch(plan, passes, &tables, &mut buffers, places) else {
                        continue;
                    };
                    self.gradients(&batch, &amplitudes, basis.as_mut(), &mut gradients);
                }
                if let Some((frames, turned)) = &basis {
                    self.turn_back(&frames.chosen, turned, &mut gradients);
                }
                gradients
            });
            let parts: Vec<_> = parts.collect();
            parts.iter().for_each(|part| add_to(&mut out, part));
        }
        self.products.back(out)
    }

    /// `B x` and `Bt W B x` for several x, W being the rows' weights: [`Self::forward`] and [`Self::adjoint`] with each row
    /// computed once for both.
    #[must_use]
    pub fn normal(&self, plan: &RowPlan, skies: &[Alm], weight: &[f64]) -> (Vec<Vec<Complex64>>, Vec<Alm>) {
        let tables = Tables::new(&self.setup, plan);
        let (count, skies) = (skies.len(), self.products.of(skies));
        let skies = skies.as_slice();
        let mut out = vec![Alm::zeros(self.setup.l_max); skies.len()];
        let mut seen = Vec::with_capacity(plan.groups.len());
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                let passes = &plan.passes[group.clone()];
                let mut amplitudes = self.no_amplitudes(passes, skies.len());
                let mut buffers = CapBuffers::default();
                let batches: Vec<Batch> = Self::batches(plan, passes)
                    .into_iter()
                    .filter_map(|places| self.batch(plan, passes, &tables, &mut buffers, places))
                    .collect();
                let frames = self.frames(plan, passes);
                let basis = frames.as_ref().map(|frames| (frames, self.turned(&frames.chosen, skies)));
                let one = |batch: &Batch| self.amplitudes(batch, skies, basis.as_ref(), &mut amplitudes);
                batches.iter().for_each(one);
                drop(basis);
                let seen = self.interpolate(plan, passes, &amplitudes, count);
                let weight = &weight[rows_of(passes)];
                let weighted: Vec<Vec<Complex64>> =
                    seen.iter().map(|seen| seen.iter().zip(weight).map(|(v, w)| v * *w).collect()).collect();
                let weighted: Vec<&[Complex64]> = weighted.iter().map(Vec::as_slice).collect();
                let amplitudes = self.spread(plan, passes, &weighted);
                let mut gradients = vec![Alm::zeros(self.setup.l_max); skies.len()];
                let mut basis = frames.as_ref().map(|frames| (frames, self.no_turned(frames, skies.len())));
                for batch in &batches {
                    self.gradients(batch, &amplitudes, basis.as_mut(), &mut gradients);
                }
                if let Some((frames, turned)) = &basis {
                    self.turn_back(&frames.chosen, turned, &mut gradients);
                }
                (seen, gradients)
            });
            let parts: Vec<_> = parts.collect();
            for (values, gradients) in parts {
                add_to(&mut out, &gradients);
                seen.push(values);
            }
        }
        (joined(plan, count, seen), self.products.back(out))
    }

    /// How the frames of the passes' nodes are combined of some of them, if they are.
    fn frames(&self, plan: &RowPlan, passes: &[Pass]) -> Option<Frames> {
        if plan.direct { None } else { Frames::new(&plan.nodes[nodes_of(passes)], self.setup.l_max) }
    }

    /// Room for gradients of skies in the chosen frames.
    fn no_turned(&self, frames: &Frames, skies: usize) -> Turned {
        let (l_max, columns) = (self.setup.l_max, lanes_of(&frames.chosen) * skies);
        (0..=l_max).map(|mu| [0, 1].map(|_| vec![0.0; columns * degrees(l_max, mu)])).collect()
    }

    /// Orders of an amplitude, mu = -l_max ..= l_max, and what fills the last vector.
    fn orders(&self) -> usize {
        (2 * self.setup.l_max + 1).next_multiple_of(LANES)
    }

    /// Room for the amplitudes g of the passes' nodes: `[node][sky][real or imaginary part][order]`.
    fn no_amplitudes(&self, passes: &[Pass], skies: usize) -> Vec<f64> {
        vec![0.0; nodes_of(passes).len() * skies * 2 * self.orders()]
    }

    /// Nodes of passes, in batches of one class: places among the passes' nodes.
    fn batches(plan: &RowPlan, passes: &[Pass]) -> Vec<Vec<usize>> {
        let nodes = &plan.nodes[nodes_of(passes)];
        let mut order: Vec<usize> = (0..nodes.len()).collect();
        // Pairs of one batch should need about as many quadrature points.
        let length = |k: usize| nodes[k].view.baseline_m;
        order.sort_by(|&a, &b| nodes[a].class.cmp(&nodes[b].class).then(length(a).total_cmp(&length(b))));
        order
            .chunk_by(|&a, &b| nodes[a].class == nodes[b].class)
            .flat_map(|same| same.chunks(BATCH).map(<[usize]>::to_vec))
            .collect()
    }

    /// The patterns of a batch; `None` if there is nothing in it.
    fn batch(
        &self,
        plan: &RowPlan,
        passes: &[Pass],
        tables: &Tables,
        buffers: &mut CapBuffers,
        places: Vec<usize>,
    ) -> Option<Batch> {
        let first = nodes_of(passes).start;
        let nodes: Vec<RowNode> = places.iter().map(|&k| plan.nodes[first + k]).collect();
        let class = tables.classes[nodes.first()?.class as usize].as_ref()?;
        let patterns = self.patterns.of(&self.turns, class, &nodes, buffers);
        Some(Batch { places, nodes, patterns })
    }

    /// Writes the amplitudes of a batch; `basis` has the skies in the frames of which those of the batch are combined.
    fn amplitudes(&self, batch: &Batch, skies: &[Alm], basis: Option<&(&Frames, Turned)>, out: &mut [f64]) {
        let (orders, l_max) = (self.orders(), self.setup.l_max);
        let turned = match basis {
            None => self.turned(&batch.nodes, skies),
            Some((frames, turned)) => {
                frames.combined(turned, &frames.weights_of(&batch.places), [l_max, skies.len()])
            }
        };
        let lanes = lanes_of(&batch.nodes);
        for (mu, [re, im]) in turned.iter().enumerate() {
            for (group, places) in batch.places.chunks(LANES).enumerate() {
                let pattern = batch.patterns[mu].of(group);
                for sky in 0..skies.len() {
                    let first = sky * lanes + group * LANES;
                    let sums = products(&re[first..], &im[first..], skies.len() * lanes, pattern);
                    for (lane, node) in places.iter().enumerate() {
                        let place = (node * skies.len() + sky) * 2 * orders + l_max;
                        (out[place + mu], out[place + orders + mu]) = (sums[0][lane], sums[1][lane]);
                        if mu > 0 {
                            (out[place - mu], out[place + orders - mu]) = (sums[2][lane], sums[3][lane]);
                        }
                    }
                }
            }
        }
    }

    /// The transpose of [`Self::amplitudes`], added to the gradients of what it is combined of, or to `out`.
    fn gradients(
        &self,
        batch: &Batch,
        amplitudes: &[f64],
        basis: Option<&mut (&Frames, Turned)>,
        out: &mut [Alm],
    ) {
        let (orders, l_max, skies) = (self.orders(), self.setup.l_max, out.len());
        let lanes = lanes_of(&batch.nodes);
        let at = |place: usize| amplitudes[place] as Value;
        let turned: Turned = (0..=l_max)
            .map(|mu| {
                let [mut re, mut im] = [0, 1].map(|_| vec![0.0; degrees(l_max, mu) * skies * lanes]);
                for (group, places) in batch.places.chunks(LANES).enumerate() {
                    let pattern = batch.patterns[mu].of(group);
                    for sky in 0..skies {
                        let mut values = [[0.0; LANES]; 4];
                        for (lane, node) in places.iter().enumerate() {
                            let place = (node * skies + sky) * 2 * orders + l_max;
                            (values[0][lane], values[1][lane]) = (at(place + mu), at(place + orders + mu));
                            if mu > 0 {
                                (values[2][lane], values[3][lane]) =
                                    (at(place - mu), at(place + orders - mu));
                            }
                        }
                        let first = sky * lanes + group * LANES;
                        products_back(&values, pattern, &mut re[first..], &mut im[first..], skies * lanes);
                    }
                }
                [re, im]
            })
            .collect();
        match basis {
            None => self.turn_back(&batch.nodes, &turned, out),
            Some((frames, sums)) => {
                frames.shared(&turned, &frames.weights_of(&batch.places), sums, [l_max, skies]);
            }
        }
    }

    /// Skies in the frames of nodes, by mu: real and imaginary parts of `t_{l mu}`, `[l = mu, mu + 2, ..][sky][lane]`.
    fn turned(&self, nodes: &[RowNode], skies: &[Alm]) -> Turned {
        let l_max = self.setup.l_max;
        let lanes = lanes_of(nodes);
        let columns = lanes * skies.len();
        let phases = Phases::new(nodes, l_max);
        let mut out: Turned =
            (0..=l_max).map(|mu| [0, 1].map(|_| vec![0.0; columns * degrees(l_max, mu)])).collect();
        let mut buffers = [0, 1].map(|_| [0, 1].map(|_| vec![0.0; columns * (l_max + 1)]));
        for l in 0..=l_max {
            let [mut sky, half] =
                buffers.each_mut().map(|both| both.each_mut().map(|x| &mut x[..columns * (l + 1)]));
            for m in 0..=l {
                for (k, alm) in skies.iter().enumerate() {
                    let at = place(l, m) * columns + k * lanes;
                    let [re, im] = sky.each_mut().map(|part| &mut part[at..at + lanes]);
                    let z = alm.get(l, m).conj();
                    re.fill(z.re as Value);
                    im.fill(z.im as Value);
                    turn(re, im, phases.get(0, m), -1.0);
                }
            }
            let [re, im] = half;
            self.turns.turn(l, &[0, 1], [&*sky[0], &*sky[1]], [&mut *re, &mut *im]);
            for k in 0..=l {
                let at = place(l, k) * columns;
                for (re, im) in rows_at(re, im, at..at + columns, lanes) {
                    turn(re, im, phases.get(1, k), -1.0);
                }
            }
            let [to_re, to_im] = sky;
            self.turns.turn(l, &[l % 2], [&*re, &*im], [&mut *to_re, &mut *to_im]);
            for mu in (l % 2..=l).step_by(2) {
                let (from, to) = (place(l, mu) * columns, (l - mu) / 2 * columns);
                let [re, im] = &mut out[mu];
                re[to..to + columns].copy_from_slice(&to_re[from..from + columns]);
                im[to..to + columns].copy_from_slice(&to_im[from..from + columns]);
                for (re, im) in rows_at(re, im, to..to + columns, lanes) {
                    turn(re, im, phases.get(2, mu), -1.0);
                }
            }
        }
        out
    }

    /// The transpose of [`Self::turned`], added to `out`.
    fn turn_back(&self, nodes: &[RowNode], turned: &[[Vec<Value>; 2]], out: &mut [Alm]) {
        let l_max = self.setup.l_max;
        let lanes = lanes_of(nodes);
        let columns = lanes * out.len();
        let phases = Phases::new(nodes, l_max);
        let mut buffers = [0, 1].map(|_| [0, 1].map(|_| vec![0.0; columns * (l_max + 1)]));
        for l in 0..=l_max {
            let [sky, half] =
                buffers.each_mut().map(|both| both.each_mut().map(|x| &mut x[..columns * (l + 1)]));
            let [sky_re, sky_im] = sky;
            for mu in (l % 2..=l).step_by(2) {
                let (from, to) = ((l - mu) / 2 * columns, place(l, mu) * columns);
                sky_re[to..to + columns].copy_from_slice(&turned[mu][0][from..from + columns]);
                sky_im[to..to + columns].copy_from_slice(&turned[mu][1][from..from + columns]);
                for (re, im) in rows_at(sky_re, sky_im, to..to + columns, lanes) {
                    turn(re, im, phases.get(2, mu), 1.0);
                }
            }
            let [re, im] = half;
            self.turns.turn_back(l, &[l % 2], [&*sky_re, &*sky_im], [&mut *re, &mut *im]);
            for k in 0..=l {
                let at = place(l, k) * columns;
                for (re, im) in rows_at(re, im, at..at + columns, lanes) {
                    turn(re, im, phases.get(1, k), 1.0);
                }
            }
            self.turns.turn_back(l, &[0, 1], [&*re, &*im], [&mut *sky_re, &mut *sky_im]);
            for m in 0..=l {
                for (k, out) in out.iter_mut().enumerate() {
                    let at = place(l, m) * columns + k * lanes;
                    let [re, im] = [&mut sky_re[at..at + lanes], &mut sky_im[at..at + lanes]];
                    turn(re, im, phases.get(0, m), 1.0);
                    // z = conj(T) conj(phase): the gradient is conj(z' phase).
                    let sum = |part: &[Value]| part.iter().map(|x| f64::from(*x)).sum::<f64>();
                    *out.get_mut(l, m) += Complex64::new(sum(re), -sum(im));
                }
            }
        }
    }

    /// Values at all rows of passes, one vector a sky, from the amplitudes of the skies' products.
    fn interpolate(
        &self,
        plan: &RowPlan,
        passes: &[Pass],
        amplitudes: &[f64],
        skies: usize,
    ) -> Vec<Vec<Complex64>> {
        let first = nodes_of(passes).start;
        let products = skies * self.products.count();
        let width = 2 * self.orders();
        let mut out = vec![Vec::with_capacity(rows_of(passes).len()); skies];
        let (mut table, mut shares, mut padded) =
            (PhaseTable::default(), Vec::new(), PaddedShares::default());
        let [mut values, mut at] = [0, 1].map(|_| vec![Complex64::ZERO; products]);
        for pass in passes {
            let amplitudes = &amplitudes[(pass.nodes.start - first) * products * width..];
            let amplitudes = &amplitudes[..pass.nodes.len() * products * width];
            if pass.tau.is_empty() {
                for (row, node) in pass.rows.clone().zip(amplitudes.chunks_exact(products * width)) {
                    for (value, g) in values.iter_mut().zip(node.chunks_exact(width)) {
                        *value = self.at_phase(g, plan.gamma_rad[row]);
                    }
                    plan.combine(row, &values, &mut out);
                }
                continue;
            }
            self.phases.fill(amplitudes, width / 2, [pass.nodes.len(), products], &mut table);
            for row in pass.rows.clone() {
                values.fill(Complex64::ZERO);
                for instant in plan.instants_of(pass, row, &self.instants) {
                    let gamma_rad = plan.shares(pass, row, instant, &mut shares);
                    padded.set(&table, &shares);
                    self.phases.at(&table, gamma_rad, &padded, &mut at);
                    values.iter_mut().zip(&at).for_each(|(value, at)| *value += instant.weight * at);
                }
                plan.combine(row, &values, &mut out);
            }
        }
        out
    }

    /// `sum_mu exp(-i mu gamma) g_mu`.
    fn at_phase(&self, amplitudes: &[f64], gamma_rad: f64) -> Complex64 {
        let (re, im) = amplitudes.split_at(amplitudes.len() / 2);
        phase_sum(re, im, gamma_rad) * Complex64::cis(self.setup.l_max as f64 * gamma_rad)
    }

    /// The transpose of [`Self::interpolate`], for several vectors over the rows of the passes.
    fn spread(&self, plan: &RowPlan, passes: &[Pass], values: &[&[Complex64]]) -> Vec<f64> {
        let (first, first_row) = (nodes_of(passes).start, rows_of(passes).start);
        let (width, skies) = (2 * self.orders(), values.len() * self.products.count());
        let mut out = self.no_amplitudes(passes, skies);
        let (mut table, mut shares, mut padded) =
            (PhaseTable::default(), Vec::new(), PaddedShares::default());
        let [mut of_row, mut at] = [0, 1].map(|_| vec![Complex64::ZERO; skies]);
        for pass in passes {
            let out = &mut out[(pass.nodes.start - first) * skies * width..];
            let out = &mut out[..pass.nodes.len() * skies * width];
            if pass.tau.is_empty() {
                for (row, to) in pass.rows.clone().zip(out.chunks_exact_mut(skies * width)) {
                    let gamma_rad = plan.gamma_rad[row];
                    plan.divide(row, values.iter().map(|values| values[row - first_row]), &mut of_row);
                    for (value, to) in of_row.iter().zip(to.chunks_exact_mut(width)) {
                        let turn = Complex64::cis(-(self.setup.l_max as f64) * gamma_rad);
                        let (re, im) = to.split_at_mut(width / 2);
                        phase_terms(value * turn, gamma_rad, re, im);
                    }
                }
                continue;
            }
            self.phases.clear(&mut table, [pass.nodes.len(), skies]);
            for row in pass.rows.clone() {
                plan.divide(row, values.iter().map(|values| values[row - first_row]), &mut of_row);
                for instant in plan.instants_of(pass, row, &self.instants) {
                    let gamma_rad = plan.shares(pass, row, instant, &mut shares);
                    padded.set(&table, &shares);
                    at.iter_mut().zip(&of_row).for_each(|(at, value)| *at = instant.weight * value);
                    self.phases.add(&mut table, gamma_rad, &padded, &at);
                }
            }
            self.phases.collect(&mut table, width / 2, out);
        }
        out
    }
}

/// Nodes of a batch, and what fills the last vector.
fn lanes_of(nodes: &[RowNode]) -> usize {
    nodes.len().next_multiple_of(LANES)
}

/// A range of two lists, in chunks of the lanes.
fn rows_at<'a>(
    re: &'a mut [Value],
    im: &'a mut [Value],
    range: Range<usize>,
    lanes: usize,
) -> impl Iterator<Item = (&'a mut [Value], &'a mut [Value])> {
    re[range.clone()].chunks_exact_mut(lanes).zip(im[range].chunks_exact_mut(lanes))
}

/// Turns numbers by phases, or back.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn turn(re: &mut [Value], im: &mut [Value], [cos, sin]: [&[Value]; 2], sign: Value) {
    for (((re, im), cos), sin) in re.iter_mut().zip(im).zip(cos).zip(sin) {
        let sin = sign * sin;
        (*re, *im) = (*re * cos - *im * sin, *re * sin + *im * cos);
    }
}

/// Sums over l of turned skies with patterns: for mu, and of the conjugate skies for -mu. Values of one l are `stride` apart.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn products(re: &[Value], im: &[Value], stride: usize, pattern: &[Value]) -> [Lanes; 4] {
    let mut sums = [[0.0; LANES]; 4];
    for ((re, im), pattern) in re.chunks(stride).zip(im.chunks(stride)).zip(pattern.chunks_exact(VALUES)) {
        let (re, im) = (&re[..LANES], &im[..LANES]);
        for k in 0..LANES {
            let [a, b, c, d] = [0, 1, 2, 3].map(|part| f64::from(pattern[part * LANES + k]));
            let (re, im) = (f64::from(re[k]), f64::from(im[k]));
            sums[0][k] += re * a - im * b;
            sums[1][k] += re * b + im * a;
            sums[2][k] += re * c + im * d;
            sums[3][k] += re * d - im * c;
        }
    }
    sums
}

/// The transpose of [`products`].
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn products_back(
    values: &[[Value; LANES]; 4],
    pattern: &[Value],
    re: &mut [Value],
    im: &mut [Value],
    stride: usize,
) {
    let parts = re.chunks_mut(stride).zip(im.chunks_mut(stride));
    for ((re, im), pattern) in parts.zip(pattern.chunks_exact(VALUES)) {
        let (re, im) = (&mut re[..LANES], &mut im[..LANES]);
        for k in 0..LANES {
            let [a, b, c, d] = [0, 1, 2, 3].map(|part| pattern[part * LANES + k]);
            let [plus_re, plus_im, minus_re, minus_im] = [0, 1, 2, 3].map(|part| values[part][k]);
            re[k] = a * plus_re + b * plus_im + c * minus_re + d * minus_im;
            im[k] = a * plus_im - b * plus_re + d * minus_re - c * minus_im;
        }
    }
}

/// `sum_n exp(-i n angle) g_n`, n from 0; the length is a multiple of the lanes.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn phase_sum(re: &[f64], im: &[f64], angle_rad: f64) -> Complex64 {
    // Horner's rule, each lane on its own from the last of its orders down.
    let (sin, cos) = (-(LANES as f64) * angle_rad).sin_cos();
    let mut sums = [[0.0; LANES]; 2];
    for (re, im) in re.rchunks_exact(LANES).zip(im.rchunks_exact(LANES)) {
        for k in 0..LANES {
            let [a, b] = [sums[0][k], sums[1][k]];
            sums[0][k] = a * cos - b * sin + re[k];
            sums[1][k] = a * sin + b * cos + im[k];
        }
    }
    (0..LANES).map(|k| Complex64::new(sums[0][k], sums[1][k]) * Complex64::cis(-(k as f64) * angle_rad)).sum()
}

/// `exp(i n angle) first`, n from 0; the length is a multiple of the lanes.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn phase_terms(first: Complex64, angle_rad: f64, re: &mut [f64], im: &mut [f64]) {
    let (sin, cos) = (LANES as f64 * angle_rad).sin_cos();
    let start: [Complex64; LANES] = std::array::from_fn(|k| first * Complex64::cis(k as f64 * angle_rad));
    let mut term = [start.map(|z| z.re), start.map(|z| z.im)];
    for (re, im) in re.chunks_exact_mut(LANES).zip(im.chunks_exact_mut(LANES)) {
        for k in 0..LANES {
            let [a, b] = [term[0][k], term[1][k]];
            (re[k], im[k]) = (a, b);
            term[0][k] = a * cos - b * sin;
            term[1][k] = a * sin + b * cos;
        }
    }
}

/// Nodes of consecutive passes.
fn nodes_of(passes: &[Pass]) -> Range<usize> {
    passes.first().map_or(0, |pass| pass.nodes.start)..passes.last().map_or(0, |pass| pass.nodes.end)
}

/// Rows of consecutive passes.
fn rows_of(passes: &[Pass]) -> Range<usize> {
    passes.first().map_or(0, |pass| pass.rows.start)..passes.last().map_or(0, |pass| pass.rows.end)
}

/// Values of groups one after the other, by sky.
fn joined(plan: &RowPlan, skies: usize, groups: Vec<Vec<Vec<Complex64>>>) -> Vec<Vec<Complex64>> {
    let mut out = vec![Vec::with_capacity(plan.rows()); skies];
    for group in groups {
        for (out, values) in out.iter_mut().zip(group) {
            out.extend(values);
        }
    }
    out
}

fn add_to(sums: &mut [Alm], part: &[Alm]) {
    for (sum, part) in sums.iter_mut().zip(part) {
        sum.values_mut().iter_mut().zip(part.values()).for_each(|(sum, x)| *sum += x);
    }
}

/// What the rows of a plan share.
struct Tables {
    /// The classes that nodes are of, by number.
    classes: Vec<Option<CapClass>>,
}

impl Tables {
    fn new(setup: &RowsSetup, plan: &RowPlan) -> Self {
        let mut is_used = vec![false; plan.classes.len()];
        plan.nodes.iter().for_each(|node| is_used[node.class as usize] = true);
        let classes = plan.classes.par_iter().zip(is_used);
        let classes = classes.map(|(class, used)| used.then(|| CapClass::new(setup, class))).collect();
        Self { classes }
    }
}

/// Nodes of one class, and their patterns.
struct Batch {
    /// Places among the nodes of the group's passes.
    places: Vec<usize>,
    nodes: Vec<RowNode>,
    /// By mu.
    patterns: Vec<NodePatterns>,
}

/// Cosines and sines of multiples of the turns of nodes; the last node fills the last vector.
struct Phases {
    stride: usize,
    lanes: usize,
    cos: Vec<Value>,
    sin: Vec<Value>,
}

impl Phases {
    fn new(nodes: &[RowNode], l_max: usize) -> Self {
        let (stride, lanes) = (l_max + 1, lanes_of(nodes));
        let [mut cos, mut sin] = [0, 1].map(|_| Vec::with_capacity(3 * lanes * stride));
        for turn in 0..3 {
            for k in 0..stride {
                let filled = nodes.iter().chain(nodes.last().into_iter().cycle()).take(lanes);
                for (s, c) in filled.map(|node| sin_cos(k as f64 * node.turns_rad[turn])) {
                    cos.push(c as Value);
                    sin.push(s as Value);
                }
            }
        }
        Self { stride, lanes, cos, sin }
    }

    /// Of one turn and order: cosines and sines by lane.
    fn get(&self, turn: usize, k: usize) -> [&[Value]; 2] {
        let first = (turn * self.stride + k) * self.lanes;
        [&self.cos[first..first + self.lanes], &self.sin[first..first + self.lanes]]
    }
}

/// Memory of rows up to `l_max` and `u_max` wavelengths besides the visibilities', bytes: Legendre functions by class, and what each thread
/// works with. Responses that are polynomials of a degree multiply the skies by the number of its monomials.
#[must_use]
pub fn row_tables_bytes(l_max: usize, u_max: f64, threads: usize, polynomial_degree: usize) -> u64 {
    let products = Products::new(polynomial_degree).count() as f64;
    let l_max = l_max + polynomial_degree;
    let coefficients = 0.25 * ((l_max + 2) as f64).powi(2);
    let turns = ((l_max + 2) as f64).powi(3) / 3.0;
    let gradients = (2 * GROUPS_AT_ONCE) as f64 * 16.0 * 2.0 * coefficients * products;
    // Amplitudes of two skies before and after the weights, and the patterns.
    let group =
        1.5 * GROUP_NODES as f64 * (4.0 * 16.0 * (2 * l_max + 1) as f64 * products + 16.0 * coefficients);
    let batch = BATCH as f64 * 80.0 * coefficients + batch_bytes(l_max, u_max, BATCH);
    let classes = tables_bytes(l_max, u_max);
    (classes + 4.0 * turns + gradients + threads as f64 * (group + batch)) as u64
}
