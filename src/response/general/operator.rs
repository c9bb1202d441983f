//! Products with B and its transpose.

use std::ops::Range;
use std::sync::{Mutex, PoisonError};

use num_complex::Complex64;
use rayon::prelude::*;

use super::antennas::Products;
use super::cap::{CapBuffers, CapClass, NodePatterns, Patterns, batch_bytes};
use super::classes::tables_bytes;
use super::frames::Frames;
use super::instants::Instants;
use super::lanes::{LANES, Lanes, VALUES, Value};
use super::phases::{PaddedShares, PhaseGrid, PhaseTable};
use super::plan::{GROUP_NODES, Observed, RowNode, RowPlan, Track};
use super::skies::{TurnBuffers, TurnedSkies, lanes_of, make_room};
use super::turns::QuarterTurns;
use super::{PairAt, RowsError, RowsSetup};
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
    /// The first visibility that has no row.
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
        let (tables, memory) = (Tables::new(&self.setup, plan), Memory::default());
        let (count, skies) = (skies.len(), self.products.of(skies));
        let skies = skies.as_slice();
        let values = plan.groups.par_iter().map(|group| {
            memory.with_workspace(|of| {
                let tracks = &plan.tracks[group.clone()];
                self.no_amplitudes(tracks, skies.len(), &mut of.amplitudes);
                let frames = self.frames(plan, tracks);
                self.turn(frames.as_ref(), skies, of);
                for places in Self::batches(plan, tracks) {
                    self.batch(plan, tracks, &tables, places, 0, of);
                    self.amplitudes(0, skies, frames.as_ref(), of);
                }
                self.interpolate(plan, tracks, count, of)
            })
        });
        joined(plan, count, values.collect())
    }

    /// `sum_t Re(conj(dV_t/dx) v_t)` with respect to `Re T_lm` and `Im T_lm`, as real and imaginary part: `Bt v` for each of
    /// several vectors of one value a row.
    #[must_use]
    pub fn adjoint(&self, plan: &RowPlan, values: &[&[Complex64]]) -> Vec<Alm> {
        let (tables, memory) = (Tables::new(&self.setup, plan), Memory::default());
        let skies = values.len() * self.products.count();
        let mut out = vec![Alm::zeros(self.setup.l_max); skies];
        // The order of sums is that of the groups, whatever the threads.
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                memory.with_workspace(|of| {
                    let tracks = &plan.tracks[group.clone()];
                    let rows = rows_of(tracks);
                    let values: Vec<&[Complex64]> =
                        values.iter().map(|values| &values[rows.clone()]).collect();
                    self.spread(plan, tracks, &values, of);
                    let mut gradients = vec![Alm::zeros(self.setup.l_max); skies];
                    let frames = self.frames(plan, tracks);
                    self.no_gradients(frames.as_ref(), skies, of);
                    for places in Self::batches(plan, tracks) {
                        self.batch(plan, tracks, &tables, places, 0, of);
                        self.gradients(0, frames.as_ref(), of, &mut gradients);
                    }
                    self.turn_back(frames.as_ref(), of, &mut gradients);
                    gradients
                })
            });
            let parts: Vec<_> = parts.collect();
            parts.iter().for_each(|part| add_to(&mut out, part));
        }
        self.products.back(out)
    }

    /// `Bt W B x` for several x, W being the rows' weights: [`Self::forward`] and [`Self::adjoint`] with each row computed once
    /// for both.
    #[must_use]
    pub fn normal(&self, plan: &RowPlan, skies: &[Alm], weight: &[f64]) -> Vec<Alm> {
        let (tables, memory) = (Tables::new(&self.setup, plan), Memory::default());
        let (count, skies) = (skies.len(), self.products.of(skies));
        let skies = skies.as_slice();
        let mut out = vec![Alm::zeros(self.setup.l_max); skies.len()];
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                memory.with_workspace(|of| {
                    let tracks = &plan.tracks[group.clone()];
                    self.no_amplitudes(tracks, skies.len(), &mut of.amplitudes);
                    let frames = self.frames(plan, tracks);
                    self.turn(frames.as_ref(), skies, of);
                    let batches = Self::batches(plan, tracks);
                    let made = batches.len();
                    for (number, places) in batches.into_iter().enumerate() {
                        self.batch(plan, tracks, &tables, places, number, of);
                        self.amplitudes(number, skies, frames.as_ref(), of);
                    }
                    let seen = self.interpolate(plan, tracks, count, of);
                    let weight = &weight[rows_of(tracks)];
                    let weighted = |seen: &Vec<Complex64>| -> Vec<Complex64> {
                        seen.iter().zip(weight).map(|(v, w)| v * *w).collect()
                    };
                    let weighted: Vec<Vec<Complex64>> = seen.iter().map(weighted).collect();
                    let weighted: Vec<&[Complex64]> = weighted.iter().map(Vec::as_slice).collect();
                    self.spread(plan, tracks, &weighted, of);
                    let mut gradients = vec![Alm::zeros(self.setup.l_max); skies.len()];
                    self.no_gradients(frames.as_ref(), skies.len(), of);
                    for number in 0..made {
                        self.gradients(number, frames.as_ref(), of, &mut gradients);
                    }
                    self.turn_back(frames.as_ref(), of, &mut gradients);
                    gradients
                })
            });
            let parts: Vec<_> = parts.collect();
            parts.iter().for_each(|gradients| add_to(&mut out, gradients));
        }
        self.products.back(out)
    }

    /// How the frames of the tracks' nodes are combined from a chosen few, if they are.
    fn frames(&self, plan: &RowPlan, tracks: &[Track]) -> Option<Frames> {
        if plan.direct { None } else { Frames::new(&plan.nodes[nodes_of(tracks)], self.setup.l_max) }
    }

    /// Turns skies into the chosen frames, if there are any.
    fn turn(&self, frames: Option<&Frames>, skies: &[Alm], of: &mut Workspace) {
        if let Some(frames) = frames {
            self.turns.turn_skies(&frames.chosen, skies, &mut of.turning, &mut of.basis);
        }
    }

    /// Makes room for gradients of skies in the chosen frames.
    fn no_gradients(&self, frames: Option<&Frames>, skies: usize, of: &mut Workspace) {
        if let Some(frames) = frames {
            make_room(&mut of.basis, self.setup.l_max, lanes_of(&frames.chosen) * skies);
            of.basis.iter_mut().flatten().for_each(|part| part.fill(0.0));
        }
    }

    /// Adds gradients in the chosen frames to those of skies.
    fn turn_back(&self, frames: Option<&Frames>, of: &mut Workspace, gradients: &mut [Alm]) {
        if let Some(frames) = frames {
            self.turns.turn_skies_back(&frames.chosen, &of.basis, &mut of.turning, gradients);
        }
    }

    /// Orders of an amplitude, mu = -l_max ..= l_max, padded to whole vectors.
    fn orders(&self) -> usize {
        (2 * self.setup.l_max + 1).next_multiple_of(LANES)
    }

    /// Zero amplitudes g of the tracks' nodes: `[node][sky][real or imaginary part][order]`.
    fn no_amplitudes(&self, tracks: &[Track], skies: usize, out: &mut Vec<f64>) {
        out.clear();
        out.resize(nodes_of(tracks).len() * skies * 2 * self.orders(), 0.0);
    }

    /// Nodes of tracks, in batches of one class: places among the tracks' nodes.
    fn batches(plan: &RowPlan, tracks: &[Track]) -> Vec<Vec<usize>> {
        let nodes = &plan.nodes[nodes_of(tracks)];
        let mut order: Vec<usize> = (0..nodes.len()).collect();
        // Pairs of one batch should need about as many quadrature points.
        let length = |k: usize| nodes[k].view.baseline_m;
        order.sort_by(|&a, &b| nodes[a].class.cmp(&nodes[b].class).then(length(a).total_cmp(&length(b))));
        order
            .chunk_by(|&a, &b| nodes[a].class == nodes[b].class)
            .flat_map(|same| same.chunks(BATCH).map(<[usize]>::to_vec))
            .collect()
    }

    /// Computes the patterns of batch `number`.
    fn batch(
        &self,
        plan: &RowPlan,
        tracks: &[Track],
        tables: &Tables,
        places: Vec<usize>,
        number: usize,
        of: &mut Workspace,
    ) {
        let first = nodes_of(tracks).start;
        if of.batches.len() <= number {
            of.batches.resize_with(number + 1, Batch::default);
        }
        let batch = &mut of.batches[number];
        batch.places = places;
        batch.nodes.clear();
        batch.nodes.extend(batch.places.iter().map(|&k| plan.nodes[first + k]));
        let class = tables.class(&batch.nodes);
        self.patterns.of(&self.turns, class, &batch.nodes, &mut of.cap, &mut batch.patterns);
    }

    /// Writes the amplitudes of a batch, from the skies in the chosen frames.
    fn amplitudes(&self, number: usize, skies: &[Alm], frames: Option<&Frames>, of: &mut Workspace) {
        let (orders, l_max) = (self.orders(), self.setup.l_max);
        let Workspace { batches, basis, turned, weights, turning, amplitudes: out, .. } = of;
        let batch = &batches[number];
        match frames {
            None => self.turns.turn_skies(&batch.nodes, skies, turning, turned),
            Some(frames) => {
                frames.weights_of(&batch.places, weights);
                frames.combined(basis, weights, [l_max, skies.len()], turned);
            }
        }
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

    /// The transpose of [`Self::amplitudes`], added to the gradients in the chosen frames, or to `out`.
    fn gradients(&self, number: usize, frames: Option<&Frames>, of: &mut Workspace, out: &mut [Alm]) {
        let (orders, l_max, skies) = (self.orders(), self.setup.l_max, out.len());
        let Workspace { batches, basis, turned, weights, turning, amplitudes, .. } = of;
        let batch = &batches[number];
        let lanes = lanes_of(&batch.nodes);
        let at = |place: usize| amplitudes[place] as Value;
        make_room(turned, l_max, lanes * skies);
        for (mu, [re, im]) in turned.iter_mut().enumerate() {
            for (group, places) in batch.places.chunks(LANES).enumerate() {
                let pattern = batch.patterns[mu].of(group);
                for sky in 0..skies {
                    let mut values = [[0.0; LANES]; 4];
                    for (lane, node) in places.iter().enumerate() {
                        let place = (node * skies + sky) * 2 * orders + l_max;
                        (values[0][lane], values[1][lane]) = (at(place + mu), at(place + orders + mu));
                        if mu > 0 {
                            (values[2][lane], values[3][lane]) = (at(place - mu), at(place + orders - mu));
                        }
                    }
                    let first = sky * lanes + group * LANES;
                    products_back(&values, pattern, &mut re[first..], &mut im[first..], skies * lanes);
                }
            }
        }
        match frames {
            None => self.turns.turn_skies_back(&batch.nodes, turned, turning, out),
            Some(frames) => {
                frames.weights_of(&batch.places, weights);
                frames.shared(turned, weights, basis, [l_max, skies]);
            }
        }
    }

    /// Values at all rows of tracks, one vector a sky, from the amplitudes of the skies' products.
    fn interpolate(
        &self,
        plan: &RowPlan,
        tracks: &[Track],
        skies: usize,
        of: &mut Workspace,
    ) -> Vec<Vec<Complex64>> {
        let first = nodes_of(tracks).start;
        let products = skies * self.products.count();
        let width = 2 * self.orders();
        let mut out = vec![Vec::with_capacity(rows_of(tracks).len()); skies];
        let Workspace { amplitudes, table, strides, padded, .. } = of;
        let [mut values, mut at] = [0, 1].map(|_| vec![Complex64::ZERO; products]);
        for track in tracks {
            let amplitudes = &amplitudes[(track.nodes.start - first) * products * width..];
            let amplitudes = &amplitudes[..track.nodes.len() * products * width];
            if track.tau.is_empty() {
                for (row, node) in track.rows.clone().zip(amplitudes.chunks_exact(products * width)) {
                    for (value, g) in values.iter_mut().zip(node.chunks_exact(width)) {
                        *value = self.at_phase(g, plan.gamma_rad[row]);
                    }
                    plan.combine(row, &values, &mut out);
                }
                continue;
            }
            self.phases.fill(amplitudes, width / 2, [track.nodes.len(), products], table);
            for row in track.rows.clone() {
                values.fill(Complex64::ZERO);
                for instant in plan.instants_of(track, row, &self.instants) {
                    let gamma_rad = plan.strides(track, row, instant, strides);
                    padded.set(table, strides);
                    self.phases.at(table, gamma_rad, padded, &mut at);
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

    /// The transpose of [`Self::interpolate`], for several vectors over the rows of the tracks: writes amplitudes.
    fn spread(&self, plan: &RowPlan, tracks: &[Track], values: &[&[Complex64]], of: &mut Workspace) {
        let (first, first_row) = (nodes_of(tracks).start, rows_of(tracks).start);
        let (width, skies) = (2 * self.orders(), values.len() * self.products.count());
        let Workspace { amplitudes: out, table, strides, padded, .. } = of;
        self.no_amplitudes(tracks, skies, out);
        let [mut of_row, mut at] = [0, 1].map(|_| vec![Complex64::ZERO; skies]);
        for track in tracks {
            let out = &mut out[(track.nodes.start - first) * skies * width..];
            let out = &mut out[..track.nodes.len() * skies * width];
            if track.tau.is_empty() {
                for (row, to) in track.rows.clone().zip(out.chunks_exact_mut(skies * width)) {
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
            self.phases.clear(table, [track.nodes.len(), skies]);
            for row in track.rows.clone() {
                plan.divide(row, values.iter().map(|values| values[row - first_row]), &mut of_row);
                for instant in plan.instants_of(track, row, &self.instants) {
                    let gamma_rad = plan.strides(track, row, instant, strides);
                    padded.set(table, strides);
                    at.iter_mut().zip(&of_row).for_each(|(at, value)| *at = instant.weight * value);
                    self.phases.add(table, gamma_rad, padded, &at);
                }
            }
            self.phases.collect(table, width / 2, out);
        }
    }
}

/// Degrees whose products are added in f32, before their sum is added to others in f64.
const DEGREES: usize = 16;

/// Sums over l of turned skies with patterns: for mu, and of the conjugate skies for -mu. Values of one l are `stride` apart.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2+fma"))]
fn products(re: &[Value], im: &[Value], stride: usize, pattern: &[Value]) -> [Lanes; 4] {
    let mut sums = [[0.0; LANES]; 4];
    let (re, im) = (re.chunks(DEGREES * stride), im.chunks(DEGREES * stride));
    for ((re, im), pattern) in re.zip(im).zip(pattern.chunks(DEGREES * VALUES)) {
        let mut some = [[0.0; LANES]; 4];
        for ((re, im), pattern) in re.chunks(stride).zip(im.chunks(stride)).zip(pattern.chunks_exact(VALUES))
        {
            let (re, im) = (&re[..LANES], &im[..LANES]);
            for k in 0..LANES {
                let [a, b, c, d] = [0, 1, 2, 3].map(|part| pattern[part * LANES + k]);
                some[0][k] += re[k] * a - im[k] * b;
                some[1][k] += re[k] * b + im[k] * a;
                some[2][k] += re[k] * c + im[k] * d;
                some[3][k] += re[k] * d - im[k] * c;
            }
        }
        for (sums, some) in sums.iter_mut().zip(&some) {
            sums.iter_mut().zip(some).for_each(|(sum, some)| *sum += f64::from(*some));
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

/// Nodes of consecutive tracks.
fn nodes_of(tracks: &[Track]) -> Range<usize> {
    tracks.first().map_or(0, |track| track.nodes.start)..tracks.last().map_or(0, |track| track.nodes.end)
}

/// Rows of consecutive tracks.
fn rows_of(tracks: &[Track]) -> Range<usize> {
    tracks.first().map_or(0, |track| track.rows.start)..tracks.last().map_or(0, |track| track.rows.end)
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

/// Tables that the rows of a plan share.
struct Tables {
    /// The classes of the nodes.
    classes: Vec<CapClass>,
    /// Index among `classes`, by the number of a class.
    places: Vec<usize>,
}

impl Tables {
    fn new(setup: &RowsSetup, plan: &RowPlan) -> Self {
        let mut numbers: Vec<usize> = plan.nodes.iter().map(|node| node.class as usize).collect();
        numbers.sort_unstable();
        numbers.dedup();
        let mut places = vec![0; plan.classes.len()];
        numbers.iter().enumerate().for_each(|(place, number)| places[*number] = place);
        let classes = numbers.par_iter().map(|number| CapClass::new(setup, &plan.classes[*number])).collect();
        Self { classes, places }
    }

    /// The class of a batch, which has at least one node.
    fn class(&self, nodes: &[RowNode]) -> &CapClass {
        &self.classes[self.places[nodes[0].class as usize]]
    }
}

/// Nodes of one class, and their patterns.
#[derive(Default)]
struct Batch {
    /// Places among the nodes of the group's tracks.
    places: Vec<usize>,
    nodes: Vec<RowNode>,
    /// By mu.
    patterns: Vec<NodePatterns>,
}

/// Buffers of a task on one group of tracks. They are kept for the next: tens of MB that come and go with each group
/// cost up to two fifths of a product's time in page faults, where antennas multiply the skies.
#[derive(Default)]
struct Workspace {
    cap: CapBuffers,
    batches: Vec<Batch>,
    turning: TurnBuffers,
    /// Skies in the chosen frames, then gradients there.
    basis: TurnedSkies,
    /// Skies in the frames of a batch, and its weights.
    turned: TurnedSkies,
    weights: Vec<Value>,
    /// `[node][sky][real or imaginary part][order]`.
    amplitudes: Vec<f64>,
    table: PhaseTable,
    strides: Vec<f64>,
    padded: PaddedShares,
}

/// Workspaces that no task uses now.
#[derive(Default)]
struct Memory(Mutex<Vec<Workspace>>);

impl Memory {
    fn with_workspace<T>(&self, to: impl FnOnce(&mut Workspace) -> T) -> T {
        let free = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut workspace = free().pop().unwrap_or_default();
        let out = to(&mut workspace);
        free().push(workspace);
        out
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
