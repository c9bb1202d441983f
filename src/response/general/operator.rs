//! Products with B and its transpose.

use std::f64::consts::TAU;
use std::ops::Range;

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;
use rayon::prelude::*;

use super::arc::ArcSolver;
use super::plan::{GROUP_NODES, Pass, RowNode, RowPlan, class_bytes, classes_max};
use super::turns::{QuarterTurns, place};
use super::{PairAt, RowsError, RowsSetup};
use crate::response::harmonic::degrees;
use crate::response::harmonic::legendre::Legendre;
use crate::response::harmonic::pattern::{PatternGeometry, RingPoint, ring_points};
use crate::sky::harmonics::Alm;

/// Rows of one altitude class that a task computes together.
const BATCH: usize = 16;

/// Groups whose gradients are held until they are added.
const GROUPS_AT_ONCE: usize = 32;

/// Rows of B over harmonics, for any positions.
#[derive(Clone, Debug)]
pub struct GeneralRows {
    setup: RowsSetup,
    turns: QuarterTurns,
}

impl GeneralRows {
    /// Rows for a setup.
    #[must_use]
    pub fn new(setup: RowsSetup) -> Self {
        Self { turns: QuarterTurns::new(setup.l_max), setup }
    }

    /// Setup.
    #[must_use]
    pub fn setup(&self) -> &RowsSetup {
        &self.setup
    }

    /// Plans the rows of visibilities, which are sorted by pair and time.
    ///
    /// # Errors
    /// The first visibility whose positions have no row.
    pub fn plan(&self, pairs: &[PairAt]) -> Result<RowPlan, RowsError> {
        RowPlan::new(&self.setup, pairs, false)
    }

    /// As [`Self::plan`], each row computed for itself.
    ///
    /// # Errors
    /// As [`Self::plan`].
    pub fn plan_direct(&self, pairs: &[PairAt]) -> Result<RowPlan, RowsError> {
        RowPlan::new(&self.setup, pairs, true)
    }

    /// Visibilities, K sr, of skies given by coefficients up to `l_max`: `B x`, one vector a sky.
    #[must_use]
    pub fn forward(&self, plan: &RowPlan, skies: &[Alm]) -> Vec<Vec<Complex64>> {
        let tables = Tables::new(&self.setup, plan);
        let values = plan.groups.par_iter().map(|group| {
            let passes = &plan.passes[group.clone()];
            let mut amplitudes = self.no_amplitudes(passes, skies.len());
            let mut solver = tables.solver.clone();
            for places in Self::batches(plan, passes) {
                let Some(batch) = self.batch(plan, passes, &tables, &mut solver, places) else { continue };
                self.amplitudes(&batch, skies, &mut amplitudes);
            }
            self.interpolate(plan, passes, &amplitudes, skies.len())
        });
        joined(plan, skies.len(), values.collect())
    }

    /// `sum_t Re(conj(dV_t/dx) v_t)` with respect to `Re T_lm` and `Im T_lm`, as real and imaginary part: `Bt v` for each of
    /// several vectors of one value a row.
    #[must_use]
    pub fn adjoint(&self, plan: &RowPlan, values: &[&[Complex64]]) -> Vec<Alm> {
        let tables = Tables::new(&self.setup, plan);
        let mut out = vec![Alm::zeros(self.setup.l_max); values.len()];
        // The order of sums is that of the groups, whatever the threads.
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                let passes = &plan.passes[group.clone()];
                let rows = rows_of(passes);
                let values: Vec<&[Complex64]> = values.iter().map(|values| &values[rows.clone()]).collect();
                let amplitudes = self.spread(plan, passes, &values);
                let mut gradients = vec![Alm::zeros(self.setup.l_max); values.len()];
                let mut solver = tables.solver.clone();
                for places in Self::batches(plan, passes) {
                    let Some(batch) = self.batch(plan, passes, &tables, &mut solver, places) else {
                        continue;
                    };
                    self.gradients(&batch, &amplitudes, &mut gradients);
                }
                gradients
            });
            let parts: Vec<_> = parts.collect();
            parts.iter().for_each(|part| add_to(&mut out, part));
        }
        out
    }

    /// `B x` and `Bt W B x` for several x, W being the rows' weights: [`Self::forward`] and [`Self::adjoint`] with each row
    /// computed once for both.
    #[must_use]
    pub fn normal(&self, plan: &RowPlan, skies: &[Alm], weight: &[f64]) -> (Vec<Vec<Complex64>>, Vec<Alm>) {
        let tables = Tables::new(&self.setup, plan);
        let mut out = vec![Alm::zeros(self.setup.l_max); skies.len()];
        let mut seen = Vec::with_capacity(plan.groups.len());
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                let passes = &plan.passes[group.clone()];
                let mut amplitudes = self.no_amplitudes(passes, skies.len());
                let mut solver = tables.solver.clone();
                let batches: Vec<Batch> = Self::batches(plan, passes)
                    .into_iter()
                    .filter_map(|places| self.batch(plan, passes, &tables, &mut solver, places))
                    .collect();
                batches.iter().for_each(|batch| self.amplitudes(batch, skies, &mut amplitudes));
                let seen = self.interpolate(plan, passes, &amplitudes, skies.len());
                let weight = &weight[rows_of(passes)];
                let weighted: Vec<Vec<Complex64>> =
                    seen.iter().map(|seen| seen.iter().zip(weight).map(|(v, w)| v * *w).collect()).collect();
                let weighted: Vec<&[Complex64]> = weighted.iter().map(Vec::as_slice).collect();
                let amplitudes = self.spread(plan, passes, &weighted);
                let mut gradients = vec![Alm::zeros(self.setup.l_max); skies.len()];
                batches.iter().for_each(|batch| self.gradients(batch, &amplitudes, &mut gradients));
                (seen, gradients)
            });
            let parts: Vec<_> = parts.collect();
            for (values, gradients) in parts {
                add_to(&mut out, &gradients);
                seen.push(values);
            }
        }
        (joined(plan, skies.len(), seen), out)
    }

    /// Orders of an amplitude: mu = -l_max ..= l_max.
    fn orders(&self) -> usize {
        2 * self.setup.l_max + 1
    }

    /// Room for the amplitudes g of the passes' nodes: `[node][sky][order]`.
    fn no_amplitudes(&self, passes: &[Pass], skies: usize) -> Vec<Complex64> {
        vec![Complex64::ZERO; nodes_of(passes).len() * skies * self.orders()]
    }

    /// Nodes of passes, in batches of one class: places among the passes' nodes.
    fn batches(plan: &RowPlan, passes: &[Pass]) -> Vec<Vec<usize>> {
        let nodes = &plan.nodes[nodes_of(passes)];
        let mut order: Vec<usize> = (0..nodes.len()).collect();
        order.sort_by_key(|&k| nodes[k].class);
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
        solver: &mut ArcSolver,
        places: Vec<usize>,
    ) -> Option<Batch> {
        let first = nodes_of(passes).start;
        let nodes: Vec<RowNode> = places.iter().map(|&k| plan.nodes[first + k]).collect();
        let class = tables.classes[nodes.first()?.class as usize].as_ref()?;
        let patterns = self.patterns(class, &nodes, solver);
        Some(Batch { places, nodes, patterns })
    }

    /// Writes the amplitudes of a batch.
    fn amplitudes(&self, batch: &Batch, skies: &[Alm], out: &mut [Complex64]) {
        let (orders, l_max) = (self.orders(), self.setup.l_max);
        let turned = self.turned(&batch.nodes, skies);
        for mu in 0..=l_max {
            let count = degrees(l_max, mu);
            for (n, &node) in batch.places.iter().enumerate() {
                let pattern = batch.patterns[mu].node(n);
                for sky in 0..skies.len() {
                    let start = (n * skies.len() + sky) * count;
                    let [re, im] = turned[mu].each_ref().map(|part| &part[start..start + count]);
                    let (mut plus, mut minus) = (Complex64::ZERO, Complex64::ZERO);
                    for k in 0..count {
                        let t = Complex64::new(re[k], im[k]);
                        plus += t * Complex64::new(pattern[0][k], pattern[1][k]);
                        minus += t.conj() * Complex64::new(pattern[2][k], pattern[3][k]);
                    }
                    let place = (node * skies.len() + sky) * orders + l_max;
                    out[place + mu] = plus;
                    if mu > 0 {
                        out[place - mu] = minus;
                    }
                }
            }
        }
    }

    /// The transpose of [`Self::amplitudes`], added to `out`.
    fn gradients(&self, batch: &Batch, amplitudes: &[Complex64], out: &mut [Alm]) {
        let (orders, l_max, skies) = (self.orders(), self.setup.l_max, out.len());
        let mut turned: Vec<[Vec<f64>; 2]> = Vec::with_capacity(l_max + 1);
        for mu in 0..=l_max {
            let count = degrees(l_max, mu);
            let mut parts = [0, 1].map(|_| vec![0.0; batch.nodes.len() * skies * count]);
            for (n, &node) in batch.places.iter().enumerate() {
                let pattern = batch.patterns[mu].node(n);
                for sky in 0..skies {
                    let place = (node * skies + sky) * orders + l_max;
                    let plus = amplitudes[place + mu];
                    let minus = if mu > 0 { amplitudes[place - mu] } else { Complex64::ZERO };
                    let start = (n * skies + sky) * count;
                    for k in 0..count {
                        let t = Complex64::new(pattern[0][k], -pattern[1][k]) * plus
                            + Complex64::new(pattern[2][k], pattern[3][k]) * minus.conj();
                        parts[0][start + k] = t.re;
                        parts[1][start + k] = t.im;
                    }
                }
            }
            turned.push(parts);
        }
        self.turn_back(&batch.nodes, &turned, out);
    }

    /// Skies in the frames of nodes, by mu: real and imaginary parts of `t_{l mu}`, `[node][sky][l = mu, mu + 2, ..]`.
    fn turned(&self, nodes: &[RowNode], skies: &[Alm]) -> Vec<[Vec<f64>; 2]> {
        let l_max = self.setup.l_max;
        let columns = nodes.len() * skies.len();
        let phases = Phases::new(nodes, l_max);
        let mut out: Vec<[Vec<f64>; 2]> =
            (0..=l_max).map(|mu| [0, 1].map(|_| vec![0.0; columns * degrees(l_max, mu)])).collect();
        for l in 0..=l_max {
            let mut sky = [0, 1].map(|_| vec![0.0; columns * (l + 1)]);
            for m in 0..=l {
                for (column, (node, alm)) in columns_of(nodes.len(), skies).enumerate() {
                    let z = skies[alm].get(l, m).conj() * phases.get(0, node, m).conj();
                    let at = column * (l + 1) + place(l, m);
                    (sky[0][at], sky[1][at]) = (z.re, z.im);
                }
            }
            let mut half = [0, 1].map(|_| vec![0.0; columns * (l + 1)]);
            let [re, im] = half.each_mut().map(Vec::as_mut_slice);
            self.turns.turn(l, &[0, 1], sky.each_ref().map(Vec::as_slice), [re, im]);
            for k in 0..=l {
                for (column, (node, _)) in columns_of(nodes.len(), skies).enumerate() {
                    let at = column * (l + 1) + place(l, k);
                    let z = Complex64::new(half[0][at], half[1][at]) * phases.get(1, node, k).conj();
                    (half[0][at], half[1][at]) = (z.re, z.im);
                }
            }
            let [re, im] = sky.each_mut().map(Vec::as_mut_slice);
            self.turns.turn(l, &[l % 2], half.each_ref().map(Vec::as_slice), [re, im]);
            for mu in (l % 2..=l).step_by(2) {
                let count = degrees(l_max, mu);
                for (column, (node, _)) in columns_of(nodes.len(), skies).enumerate() {
                    let from = column * (l + 1) + place(l, mu);
                    let t = Complex64::new(sky[0][from], sky[1][from]) * phases.get(2, node, mu).conj();
                    let to = column * count + (l - mu) / 2;
                    (out[mu][0][to], out[mu][1][to]) = (t.re, t.im);
                }
            }
        }
        out
    }

    /// The transpose of [`Self::turned`], added to `out`.
    fn turn_back(&self, nodes: &[RowNode], turned: &[[Vec<f64>; 2]], out: &mut [Alm]) {
        let l_max = self.setup.l_max;
        let columns = nodes.len() * out.len();
        let phases = Phases::new(nodes, l_max);
        let skies = out.len();
        for l in 0..=l_max {
            let mut sky = [0, 1].map(|_| vec![0.0; columns * (l + 1)]);
            for mu in (l % 2..=l).step_by(2) {
                let count = degrees(l_max, mu);
                for column in 0..columns {
                    let from = column * count + (l - mu) / 2;
                    let t = Complex64::new(turned[mu][0][from], turned[mu][1][from])
                        * phases.get(2, column / skies, mu);
                    let to = column * (l + 1) + place(l, mu);
                    (sky[0][to], sky[1][to]) = (t.re, t.im);
                }
            }
            let mut half = [0, 1].map(|_| vec![0.0; columns * (l + 1)]);
            let [re, im] = half.each_mut().map(Vec::as_mut_slice);
            self.turns.turn_back(l, &[l % 2], sky.each_ref().map(Vec::as_slice), [re, im]);
            for k in 0..=l {
                for column in 0..columns {
                    let at = column * (l + 1) + place(l, k);
                    let z = Complex64::new(half[0][at], half[1][at]) * phases.get(1, column / skies, k);
                    (half[0][at], half[1][at]) = (z.re, z.im);
                }
            }
            let [re, im] = sky.each_mut().map(Vec::as_mut_slice);
            self.turns.turn_back(l, &[0, 1], half.each_ref().map(Vec::as_slice), [re, im]);
            for m in 0..=l {
                for column in 0..columns {
                    let at = column * (l + 1) + place(l, m);
                    // z = conj(T) conj(phase): the gradient is conj(z' phase).
                    let z = Complex64::new(sky[0][at], sky[1][at]) * phases.get(0, column / skies, m);
                    *out[column % skies].get_mut(l, m) += z.conj();
                }
            }
        }
    }

    /// Patterns of nodes of one class, by mu.
    fn patterns(&self, class: &RingClass, nodes: &[RowNode], solver: &mut ArcSolver) -> Vec<NodePatterns> {
        let l_max = self.setup.l_max;
        let values = 4 * nodes.len();
        // By mu, over the rings: for each node real and imaginary part of I_mu, then of I_{-mu}.
        let mut arcs: Vec<Vec<f64>> =
            class.reached.iter().map(|reached| vec![0.0; values * reached]).collect();
        let mut orders = vec![Complex64::ZERO; self.orders() * nodes.len()];
        for (k, (ring, &reach)) in class.rings.iter().zip(&class.reach).enumerate() {
            let stride = 2 * reach + 1;
            for (node, orders) in nodes.iter().zip(orders.chunks_exact_mut(stride)) {
                let u = node.view.baseline_m / self.setup.wavelength_m;
                solver.solve(TAU * u * ring.sin_theta, node.view.arc(ring.sin_theta), orders);
            }
            for (mu, arcs) in arcs.iter_mut().enumerate().take(reach + 1) {
                let values = arcs[values * k..values * (k + 1)].chunks_exact_mut(4);
                for (four, orders) in values.zip(orders.chunks_exact(stride)) {
                    let [plus, minus] = [orders[reach + mu], orders[reach - mu]];
                    four.copy_from_slice(&[plus.re, plus.im, minus.re, minus.im]);
                }
            }
        }
        let product = |(mu, arcs): (usize, Vec<f64>)| {
            let (count, reached) = (degrees(l_max, mu), class.reached[mu]);
            let mut coefficients = vec![0.0; values * count];
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(&mut coefficients, count, values),
                Accum::Replace,
                MatRef::from_row_major_slice(&class.legendre[mu], count, reached),
                MatRef::from_row_major_slice(&arcs, reached, values),
                1.0,
                Par::Seq,
            );
            NodePatterns { count, coefficients }
        };
        arcs.into_iter().enumerate().map(product).collect()
    }

    /// Values at all rows of passes, one vector a sky.
    fn interpolate(
        &self,
        plan: &RowPlan,
        passes: &[Pass],
        amplitudes: &[Complex64],
        skies: usize,
    ) -> Vec<Vec<Complex64>> {
        let first = nodes_of(passes).start;
        let orders = self.orders();
        let mut out = vec![Vec::with_capacity(rows_of(passes).len()); skies];
        let (mut shares, mut sums) = (Vec::new(), vec![Complex64::ZERO; orders]);
        for pass in passes {
            for (row, own) in
                pass.rows.clone().zip(pass.nodes.clone().chain(std::iter::repeat(pass.nodes.start)))
            {
                if !pass.tau.is_empty() {
                    plan.shares(pass, row, &mut shares);
                }
                for (sky, out) in out.iter_mut().enumerate() {
                    let node = |k: usize| &amplitudes[((k - first) * skies + sky) * orders..][..orders];
                    if pass.tau.is_empty() {
                        out.push(self.at_phase(node(own), plan.gamma_rad[row]));
                        continue;
                    }
                    sums.fill(Complex64::ZERO);
                    for (k, share) in pass.nodes.clone().zip(&shares) {
                        sums.iter_mut().zip(node(k)).for_each(|(sum, g)| *sum += share * g);
                    }
                    out.push(self.at_phase(&sums, plan.gamma_rad[row]));
                }
            }
        }
        out
    }

    /// `sum_mu exp(-i mu gamma) g_mu`.
    fn at_phase(&self, amplitudes: &[Complex64], gamma_rad: f64) -> Complex64 {
        let turn = Complex64::cis(-gamma_rad);
        // Horner's rule from the greatest order down, then back by the lowest one's phase.
        let sum = amplitudes.iter().rev().fold(Complex64::ZERO, |sum, g| sum * turn + g);
        sum * Complex64::cis(self.setup.l_max as f64 * gamma_rad)
    }

    /// The transpose of [`Self::interpolate`], for several vectors over the rows of the passes: `[node][sky][order]`.
    fn spread(&self, plan: &RowPlan, passes: &[Pass], values: &[&[Complex64]]) -> Vec<Complex64> {
        let (first, first_row) = (nodes_of(passes).start, rows_of(passes).start);
        let (orders, skies) = (self.orders(), values.len());
        let mut out = self.no_amplitudes(passes, skies);
        let mut shares = Vec::new();
        for pass in passes {
            for (row, own) in
                pass.rows.clone().zip(pass.nodes.clone().chain(std::iter::repeat(pass.nodes.start)))
            {
                let nodes = if pass.tau.is_empty() { own..own + 1 } else { pass.nodes.clone() };
                if pass.tau.is_empty() {
                    shares.clear();
                    shares.push(1.0);
                } else {
                    plan.shares(pass, row, &mut shares);
                }
                let turn = Complex64::cis(plan.gamma_rad[row]);
                let lowest = Complex64::cis(-(self.setup.l_max as f64) * plan.gamma_rad[row]);
                for (sky, values) in values.iter().enumerate() {
                    for (k, share) in nodes.clone().zip(&shares) {
                        let place = ((k - first) * skies + sky) * orders;
                        let mut term = *share * values[row - first_row] * lowest;
                        for g in &mut out[place..place + orders] {
                            *g += term;
                            term *= turn;
                        }
                    }
                }
            }
        }
        out
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
    classes: Vec<Option<RingClass>>,
    solver: ArcSolver,
}

impl Tables {
    fn new(setup: &RowsSetup, plan: &RowPlan) -> Self {
        let mut is_used = vec![false; plan.class_radius_m.len()];
        plan.nodes.iter().for_each(|node| is_used[node.class as usize] = true);
        let radii_m = plan.class_radius_m.par_iter().zip(is_used);
        let classes = radii_m
            .map(|(&radius_m, used)| used.then(|| RingClass::new(setup, radius_m, plan.u_max)))
            .collect();
        Self { classes, solver: ArcSolver::new(TAU * plan.u_max) }
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

/// Columns of a batch: node and sky.
fn columns_of(nodes: usize, skies: &[Alm]) -> impl Iterator<Item = (usize, usize)> + use<> {
    let count = skies.len();
    (0..nodes).flat_map(move |node| (0..count).map(move |sky| (node, sky)))
}

/// `exp(i k angle)` for the turns of nodes.
struct Phases {
    stride: usize,
    nodes: usize,
    values: Vec<Complex64>,
}

impl Phases {
    fn new(nodes: &[RowNode], l_max: usize) -> Self {
        let stride = l_max + 1;
        let mut values = Vec::with_capacity(3 * nodes.len() * stride);
        for turn in 0..3 {
            for node in nodes {
                values.extend((0..stride).map(|k| Complex64::cis(k as f64 * node.turns_rad[turn])));
            }
        }
        Self { stride, nodes: nodes.len(), values }
    }

    fn get(&self, turn: usize, node: usize, k: usize) -> Complex64 {
        self.values[(turn * self.nodes + node) * self.stride + k]
    }
}

/// Coefficients of the patterns of a batch at one mu.
struct NodePatterns {
    count: usize,
    coefficients: Vec<f64>,
}

impl NodePatterns {
    /// Of one node over l = mu, mu + 2, ..: real and imaginary parts of `f_{l mu}`, then of `(-1)^mu f_{l,-mu}`.
    fn node(&self, n: usize) -> [&[f64]; 4] {
        std::array::from_fn(|part| &self.coefficients[(4 * n + part) * self.count..][..self.count])
    }
}

/// Memory of rows up to `l_max` and `u_max` wavelengths besides the visibilities', bytes: Legendre functions by class of
/// altitude, and what each thread works with.
#[must_use]
pub fn row_tables_bytes(l_max: usize, u_max: f64, threads: usize) -> u64 {
    let waves = l_max as f64 + TAU * u_max;
    // As `ring_points`: half a point a radian over both zones.
    let rings = 0.6 * waves + 64.0;
    let coefficients = 0.25 * ((l_max + 2) as f64).powi(2);
    let turns = ((l_max + 2) as f64).powi(3) / 3.0;
    let gradients = (2 * GROUPS_AT_ONCE) as f64 * 16.0 * 2.0 * coefficients;
    // Amplitudes of two skies before and after the weights, and the patterns.
    let group = 1.5 * GROUP_NODES as f64 * (4.0 * 16.0 * (2 * l_max + 1) as f64 + 32.0 * coefficients);
    let batch = BATCH as f64 * (4.0 * 8.0 * (rings * l_max as f64 + coefficients) + 64.0 * coefficients);
    let classes = classes_max(l_max, u_max) * class_bytes(l_max, u_max);
    (classes + 8.0 * turns + gradients + threads as f64 * (group + batch)) as u64
}

/// Quadrature points of one class of altitude, and the Legendre functions there.
struct RingClass {
    rings: Vec<RingPoint>,
    /// By ring: the greatest order that is not negligible there.
    reach: Vec<usize>,
    /// By mu: on how many rings, from the first, it is not negligible.
    reached: Vec<usize>,
    /// By mu: for l = mu, mu + 2, .. a row over the rings that it reaches, with their weights.
    legendre: Vec<Vec<f64>>,
}

impl RingClass {
    fn new(setup: &RowsSetup, radius_m: f64, u_max: f64) -> Self {
        let geometry = PatternGeometry {
            orbit_radius_m: radius_m,
            moon_radius_m: setup.moon_radius_m,
            wavelength_m: setup.wavelength_m,
            response: setup.response,
        };
        let l_max = setup.l_max;
        let (rings, weights) = ring_points(geometry, l_max, u_max, 1);
        let functions = Legendre::new(l_max, rings.iter().map(|ring| (ring.z, ring.sin_theta)));
        let reach: Vec<usize> = rings.iter().map(|ring| ring.orders(l_max)).collect();
        let reached: Vec<usize> =
            (0..=l_max).map(|mu| reach.partition_point(|orders| *orders >= mu)).collect();
        let legendre = (0..=l_max)
            .into_par_iter()
            .map(|mu| functions.even_rows::<f64>(mu, &weights[..reached[mu]]))
            .collect();
        Self { rings, reach, reached, legendre }
    }
}
