//! Products with B and its transpose.

use std::f64::consts::TAU;

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
        let classes = self.classes(plan);
        let groups: Vec<Vec<Vec<Complex64>>> = plan
            .groups
            .par_iter()
            .map(|group| {
                let passes = &plan.passes[group.clone()];
                let amplitudes = self.amplitudes(plan, passes, &classes, skies);
                skies
                    .iter()
                    .enumerate()
                    .map(|(sky, _)| self.interpolate(plan, passes, &amplitudes, sky))
                    .collect()
            })
            .collect();
        let mut out = vec![Vec::with_capacity(plan.rows()); skies.len()];
        for group in groups {
            for (out, values) in out.iter_mut().zip(group) {
                out.extend(values);
            }
        }
        out
    }

    /// `sum_t Re(conj(dV_t/dx) v_t)` with respect to `Re T_lm` and `Im T_lm`, as real and imaginary part: `Bt v` for each of
    /// several vectors of one value a row.
    #[must_use]
    pub fn adjoint(&self, plan: &RowPlan, values: &[&[Complex64]]) -> Vec<Alm> {
        let classes = self.classes(plan);
        let mut out = vec![Alm::zeros(self.setup.l_max); values.len()];
        // The order of sums is that of the groups, whatever the threads.
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts: Vec<Vec<Alm>> = groups
                .par_iter()
                .map(|group| {
                    let passes = &plan.passes[group.clone()];
                    let amplitudes = self.spread(plan, passes, values);
                    self.gradients(plan, passes, &classes, &amplitudes, values.len())
                })
                .collect();
            for part in parts {
                for (out, part) in out.iter_mut().zip(part) {
                    out.values_mut().iter_mut().zip(part.values()).for_each(|(sum, x)| *sum += x);
                }
            }
        }
        out
    }

    /// Orders of an amplitude: mu = -l_max ..= l_max.
    fn orders(&self) -> usize {
        2 * self.setup.l_max + 1
    }

    /// The classes that nodes are of, by number.
    fn classes(&self, plan: &RowPlan) -> Vec<Option<RingClass>> {
        let mut is_used = vec![false; plan.class_radius_m.len()];
        plan.nodes.iter().for_each(|node| is_used[node.class as usize] = true);
        let radii_m = plan.class_radius_m.par_iter().zip(is_used);
        radii_m
            .map(|(&radius_m, used)| used.then(|| RingClass::new(&self.setup, radius_m, plan.u_max)))
            .collect()
    }

    /// Nodes of passes, in batches of one class: places among the passes' nodes.
    fn batches(plan: &RowPlan, passes: &[Pass]) -> Vec<(u32, Vec<usize>)> {
        let Some((first, last)) = passes.first().zip(passes.last()) else { return Vec::new() };
        let nodes = &plan.nodes[first.nodes.start..last.nodes.end];
        let mut order: Vec<usize> = (0..nodes.len()).collect();
        order.sort_by_key(|&k| nodes[k].class);
        order
            .chunk_by(|&a, &b| nodes[a].class == nodes[b].class)
            .flat_map(|same| same.chunks(BATCH).map(|batch| (nodes[batch[0]].class, batch.to_vec())))
            .collect()
    }

    /// Amplitudes g of the passes' nodes: `[node][sky][order]`.
    fn amplitudes(
        &self,
        plan: &RowPlan,
        passes: &[Pass],
        classes: &[Option<RingClass>],
        skies: &[Alm],
    ) -> Vec<Complex64> {
        let first = passes.first().map_or(0, |pass| pass.nodes.start);
        let end = passes.last().map_or(first, |pass| pass.nodes.end);
        let (orders, l_max) = (self.orders(), self.setup.l_max);
        let mut out = vec![Complex64::ZERO; (end - first) * skies.len() * orders];
        let mut solver = ArcSolver::new(TAU * plan.u_max);
        for (class, batch) in Self::batches(plan, passes) {
            let Some(class) = &classes[class as usize] else { continue };
            let nodes: Vec<RowNode> = batch.iter().map(|&k| plan.nodes[first + k]).collect();
            let patterns = self.patterns(class, &nodes, &mut solver);
            let turned = self.turned(&nodes, skies);
            for mu in 0..=l_max {
                let count = degrees(l_max, mu);
                for (n, &node) in batch.iter().enumerate() {
                    let pattern = patterns[mu].node(n);
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
        out
    }

    /// The transpose of [`Self::amplitudes`].
    fn gradients(
        &self,
        plan: &RowPlan,
        passes: &[Pass],
        classes: &[Option<RingClass>],
        amplitudes: &[Complex64],
        skies: usize,
    ) -> Vec<Alm> {
        let first = passes.first().map_or(0, |pass| pass.nodes.start);
        let (orders, l_max) = (self.orders(), self.setup.l_max);
        let mut out = vec![Alm::zeros(l_max); skies];
        let mut solver = ArcSolver::new(TAU * plan.u_max);
        for (class, batch) in Self::batches(plan, passes) {
            let Some(class) = &classes[class as usize] else { continue };
            let nodes: Vec<RowNode> = batch.iter().map(|&k| plan.nodes[first + k]).collect();
            let patterns = self.patterns(class, &nodes, &mut solver);
            let mut turned: Vec<[Vec<f64>; 2]> = Vec::with_capacity(l_max + 1);
            for mu in 0..=l_max {
                let count = degrees(l_max, mu);
                let mut parts = [0, 1].map(|_| vec![0.0; nodes.len() * skies * count]);
                for (n, &node) in batch.iter().enumerate() {
                    let pattern = patterns[mu].node(n);
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
            self.turn_back(&nodes, &turned, &mut out);
        }
        out
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
        let rings = class.rings.len();
        let values = 4 * nodes.len();
        // By mu: for each node real and imaginary part of I_mu, then of I_{-mu}, over the rings.
        let mut arcs: Vec<Vec<f64>> = (0..=l_max).map(|mu| vec![0.0; values * class.reached(mu)]).collect();
        let mut orders = vec![Complex64::ZERO; self.orders()];
        for (k, ring) in class.rings.iter().enumerate().take(rings) {
            let reach = ring.orders(l_max);
            let orders = &mut orders[..2 * reach + 1];
            for (n, node) in nodes.iter().enumerate() {
                let u = node.view.baseline_m / self.setup.wavelength_m;
                solver.solve(TAU * u * ring.sin_theta, node.view.arc(ring.sin_theta), orders);
                for mu in 0..=reach {
                    let reached = class.reached(mu);
                    if k >= reached {
                        continue;
                    }
                    let [plus, minus] = [orders[reach + mu], orders[reach - mu]];
                    for (part, value) in [plus.re, plus.im, minus.re, minus.im].into_iter().enumerate() {
                        arcs[mu][(4 * n + part) * reached + k] = value;
                    }
                }
            }
        }
        let product = |(mu, arcs): (usize, Vec<f64>)| {
            let (count, reached) = (degrees(l_max, mu), class.reached(mu));
            let mut coefficients = vec![0.0; values * count];
            faer::linalg::matmul::matmul(
                MatMut::from_column_major_slice_mut(&mut coefficients, count, values),
                Accum::Replace,
                MatRef::from_row_major_slice(&class.legendre[mu], count, reached),
                MatRef::from_column_major_slice(&arcs, reached, values),
                1.0,
                Par::Seq,
            );
            NodePatterns { count, coefficients }
        };
        arcs.into_iter().enumerate().map(product).collect()
    }

    /// Values at all rows of passes.
    fn interpolate(
        &self,
        plan: &RowPlan,
        passes: &[Pass],
        amplitudes: &[Complex64],
        sky: usize,
    ) -> Vec<Complex64> {
        let first = passes.first().map_or(0, |pass| pass.nodes.start);
        let end = passes.last().map_or(first, |pass| pass.nodes.end);
        let orders = self.orders();
        let stride = amplitudes.len() / (end - first).max(1);
        let node = |k: usize| &amplitudes[(k - first) * stride + sky * orders..][..orders];
        let mut out = Vec::new();
        let (mut shares, mut sums) = (Vec::new(), vec![Complex64::ZERO; orders]);
        for pass in passes {
            for (row, own) in
                pass.rows.clone().zip(pass.nodes.clone().chain(std::iter::repeat(pass.nodes.start)))
            {
                if pass.tau.is_empty() {
                    out.push(self.at_phase(node(own), plan.gamma_rad[row]));
                    continue;
                }
                plan.shares(pass, row, &mut shares);
                sums.fill(Complex64::ZERO);
                for (k, share) in pass.nodes.clone().zip(&shares) {
                    sums.iter_mut().zip(node(k)).for_each(|(sum, g)| *sum += share * g);
                }
                out.push(self.at_phase(&sums, plan.gamma_rad[row]));
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

    /// The transpose of [`Self::interpolate`], for several vectors: `[node][sky][order]`.
    fn spread(&self, plan: &RowPlan, passes: &[Pass], values: &[&[Complex64]]) -> Vec<Complex64> {
        let first = passes.first().map_or(0, |pass| pass.nodes.start);
        let end = passes.last().map_or(first, |pass| pass.nodes.end);
        let (orders, skies) = (self.orders(), values.len());
        let mut out = vec![Complex64::ZERO; (end - first) * skies * orders];
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
                        let mut term = *share * values[row] * lowest;
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
    let group = 1.5 * (2 * GROUP_NODES) as f64 * 16.0 * (2 * l_max + 1) as f64;
    let batch = BATCH as f64 * (4.0 * 8.0 * (rings * l_max as f64 + coefficients) + 64.0 * coefficients);
    let classes = classes_max(l_max, u_max) * class_bytes(l_max, u_max);
    (classes + 8.0 * turns + gradients + threads as f64 * (group + batch)) as u64
}

/// Quadrature points of one class of altitude, and the Legendre functions there.
struct RingClass {
    rings: Vec<RingPoint>,
    /// By mu: for l = mu, mu + 2, .. a row over the rings that it reaches, with their weights.
    legendre: Vec<Vec<f64>>,
    l_max: usize,
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
        let mut class = Self { rings, legendre: Vec::new(), l_max };
        class.legendre = (0..=l_max)
            .into_par_iter()
            .map(|mu| functions.even_rows::<f64>(mu, &weights[..class.reached(mu)]))
            .collect();
        class
    }

    /// Rings on which orders up to `mu` are not negligible.
    fn reached(&self, mu: usize) -> usize {
        self.rings.partition_point(|ring| ring.orders(self.l_max) >= mu)
    }
}
