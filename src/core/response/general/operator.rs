//! Products of skies with B and its transpose.

use std::ops::Range;

use num_complex::Complex64;
use rayon::prelude::*;

use super::antennas::SkyProducts;
use super::cap::{Patterns, batch_bytes};
use super::classes::tables_bytes;
use super::frames::Frames;
use super::instants::Instants;
use super::lanes::{LANES, Value};
use super::order_sums::{phase_sum, phase_terms, products, products_back};
use super::phases::PhaseGrid;
use super::plan::{GROUP_NODES, ObservationDetails, RowPlan, Track};
use super::skies::{padded_count, resize_buffers};
use super::turns::QuarterTurns;
use super::workspace::{Batch, Tables, Workspace, WorkspacePool};
use super::{RowsError, RowsSetup, TimedPair};
use crate::sky::harmonics::Alm;

/// Maximum number of rows of one class that a task computes together.
const BATCH: usize = 32;

/// Number of groups whose gradients are held until they are added.
const GROUPS_AT_ONCE: usize = 32;

/// Rows of B over spherical harmonics, for any positions.
#[derive(Clone, Debug)]
pub struct GeneralRows {
    /// The setup, with `l_max` raised by the degree of the response.
    setup: RowsSetup,
    products: SkyProducts,
    instants: Instants,
    turns: QuarterTurns,
    patterns: Patterns,
    phases: PhaseGrid,
}

impl GeneralRows {
    /// Prepares rows for a setup.
    #[must_use]
    pub fn new(setup: RowsSetup) -> Self {
        let products = SkyProducts::new(setup.polynomial_degree);
        let setup = RowsSetup { l_max: setup.l_max + products.degree(), ..setup };
        let turns = QuarterTurns::new(setup.l_max);
        let (patterns, phases) = (Patterns::new(setup), PhaseGrid::new(setup.l_max));
        Self { patterns, phases, turns, setup, products, instants: Instants::new() }
    }

    /// Plans the rows of visibilities. Few are computed where consecutive visibilities are of one pair and in the order of time.
    ///
    /// # Errors
    /// [`RowsError`] for the first visibility that has no row.
    pub fn plan(&self, pairs: &[TimedPair]) -> Result<RowPlan, RowsError> {
        self.plan_with(pairs, &ObservationDetails::default())
    }

    /// Plans rows as [`Self::plan`] for averages over integrations, and for pairs with individual responses.
    ///
    /// # Errors
    /// As [`Self::plan`].
    pub fn plan_with(
        &self,
        pairs: &[TimedPair],
        observed: &ObservationDetails<'_>,
    ) -> Result<RowPlan, RowsError> {
        RowPlan::new(&self.setup, pairs, observed, false)
    }

    /// Plans rows so that each is computed on its own, as a reference.
    ///
    /// # Errors
    /// As [`Self::plan`].
    pub fn plan_direct(&self, pairs: &[TimedPair]) -> Result<RowPlan, RowsError> {
        RowPlan::new(&self.setup, pairs, &ObservationDetails::default(), true)
    }

    /// Computes the visibilities `B x`, K sr, of skies given by coefficients up to `l_max`: one vector per sky.
    #[must_use]
    pub fn forward(&self, plan: &RowPlan, skies: &[Alm]) -> Vec<Vec<Complex64>> {
        let (tables, pool) = (Tables::new(&self.setup, plan), WorkspacePool::default());
        let (count, skies) = (skies.len(), self.products.multiply(skies));
        let skies = skies.as_slice();
        let values = plan.groups.par_iter().map(|group| {
            pool.with_workspace(|workspace| {
                let tracks = &plan.tracks[group.clone()];
                self.clear_amplitudes(tracks, skies.len(), &mut workspace.amplitudes);
                let frames = self.frames(plan, tracks);
                self.rotate_skies(frames.as_ref(), skies, workspace);
                for indices in Self::batches(plan, tracks) {
                    self.compute_patterns(plan, tracks, &tables, indices, 0, workspace);
                    self.compute_amplitudes(0, skies, frames.as_ref(), workspace);
                }
                self.interpolate(plan, tracks, count, workspace)
            })
        });
        concatenate(plan, count, values.collect())
    }

    /// Computes `Bt v` for each of several vectors of one value per row: `sum_t Re(conj(dV_t/dx) v_t)` with respect to `Re T_lm`
    /// and `Im T_lm`, as real and imaginary part.
    #[must_use]
    pub fn adjoint(&self, plan: &RowPlan, values: &[&[Complex64]]) -> Vec<Alm> {
        let tables = Tables::new(&self.setup, plan);
        let skies = values.len() * self.products.count();
        let out = self.sum_over_groups(plan, skies, |tracks, workspace, gradients| {
            let rows = row_range(tracks);
            let values: Vec<&[Complex64]> = values.iter().map(|values| &values[rows.clone()]).collect();
            self.interpolate_transposed(plan, tracks, &values, workspace);
            let frames = self.frames(plan, tracks);
            self.clear_gradients(frames.as_ref(), skies, workspace);
            for indices in Self::batches(plan, tracks) {
                self.compute_patterns(plan, tracks, &tables, indices, 0, workspace);
                self.compute_gradients(0, frames.as_ref(), workspace, gradients);
            }
            self.rotate_gradients_back(frames.as_ref(), workspace, gradients);
        });
        self.products.gradients_of_skies(out)
    }

    /// Sums gradients with respect to `skies` skies over the groups of a plan; `add` adds those of the tracks of a group. Sums are
    /// added in the order of the groups, so that results do not depend on threads.
    fn sum_over_groups(
        &self,
        plan: &RowPlan,
        skies: usize,
        add: impl Fn(&[Track], &mut Workspace, &mut [Alm]) + Sync,
    ) -> Vec<Alm> {
        let pool = WorkspacePool::default();
        let mut out = vec![Alm::zeros(self.setup.l_max); skies];
        for groups in plan.groups.chunks(GROUPS_AT_ONCE) {
            let parts = groups.par_iter().map(|group| {
                pool.with_workspace(|workspace| {
                    let mut gradients = vec![Alm::zeros(self.setup.l_max); skies];
                    add(&plan.tracks[group.clone()], workspace, &mut gradients);
                    gradients
                })
            });
            let parts: Vec<_> = parts.collect();
            parts.iter().for_each(|part| add_gradients(&mut out, part));
        }
        out
    }

    /// Computes `Bt W B x` for several x, with W the rows' weights; each row is computed once for both products.
    #[must_use]
    pub fn normal(&self, plan: &RowPlan, skies: &[Alm], weight: &[f64]) -> Vec<Alm> {
        let tables = Tables::new(&self.setup, plan);
        let (count, skies) = (skies.len(), self.products.multiply(skies));
        let skies = skies.as_slice();
        let out = self.sum_over_groups(plan, skies.len(), |tracks, workspace, gradients| {
            self.clear_amplitudes(tracks, skies.len(), &mut workspace.amplitudes);
            let frames = self.frames(plan, tracks);
            self.rotate_skies(frames.as_ref(), skies, workspace);
            let batches = Self::batches(plan, tracks);
            let batch_count = batches.len();
            for (number, indices) in batches.into_iter().enumerate() {
                self.compute_patterns(plan, tracks, &tables, indices, number, workspace);
                self.compute_amplitudes(number, skies, frames.as_ref(), workspace);
            }
            let mut visibilities = self.interpolate(plan, tracks, count, workspace);
            for visibilities in &mut visibilities {
                visibilities.iter_mut().zip(&weight[row_range(tracks)]).for_each(|(v, w)| *v *= *w);
            }
            let weighted: Vec<&[Complex64]> = visibilities.iter().map(Vec::as_slice).collect();
            self.interpolate_transposed(plan, tracks, &weighted, workspace);
            self.clear_gradients(frames.as_ref(), skies.len(), workspace);
            for number in 0..batch_count {
                self.compute_gradients(number, frames.as_ref(), workspace, gradients);
            }
            self.rotate_gradients_back(frames.as_ref(), workspace, gradients);
        });
        self.products.gradients_of_skies(out)
    }

    /// Chooses the frames from which those of the tracks' nodes are combined; `None` if each sky is rotated to all.
    fn frames(&self, plan: &RowPlan, tracks: &[Track]) -> Option<Frames> {
        if plan.direct { None } else { Frames::new(&plan.nodes[node_range(tracks)], self.setup.l_max) }
    }

    fn rotate_skies(&self, frames: Option<&Frames>, skies: &[Alm], workspace: &mut Workspace) {
        if let Some(frames) = frames {
            self.turns.rotate_skies(&frames.chosen, skies, &mut workspace.rotation, &mut workspace.basis);
        }
    }

    fn clear_gradients(&self, frames: Option<&Frames>, skies: usize, workspace: &mut Workspace) {
        if let Some(frames) = frames {
            resize_buffers(&mut workspace.basis, self.setup.l_max, padded_count(&frames.chosen) * skies);
            workspace.basis.iter_mut().flatten().for_each(|part| part.fill(0.0));
        }
    }

    /// Adds the gradients in the chosen frames to the gradients of skies.
    fn rotate_gradients_back(
        &self,
        frames: Option<&Frames>,
        workspace: &mut Workspace,
        gradients: &mut [Alm],
    ) {
        if let Some(frames) = frames {
            self.turns.rotate_skies_transposed(
                &frames.chosen,
                &workspace.basis,
                &mut workspace.rotation,
                gradients,
            );
        }
    }

    /// Number of orders mu = -l_max ..= l_max of an amplitude, padded to whole vectors.
    fn padded_orders(&self) -> usize {
        (2 * self.setup.l_max + 1).next_multiple_of(LANES)
    }

    /// Zeroes the amplitudes g of the tracks' nodes: `[node][sky][real or imaginary part][order]`.
    fn clear_amplitudes(&self, tracks: &[Track], skies: usize, out: &mut Vec<f64>) {
        out.clear();
        out.resize(node_range(tracks).len() * skies * 2 * self.padded_orders(), 0.0);
    }

    /// Divides the nodes of tracks into batches of one class: indices among the tracks' nodes.
    fn batches(plan: &RowPlan, tracks: &[Track]) -> Vec<Vec<usize>> {
        let nodes = &plan.nodes[node_range(tracks)];
        let mut order: Vec<usize> = (0..nodes.len()).collect();
        // Sorted by length, so that the pairs of a batch need similar numbers of quadrature points.
        let length = |k: usize| nodes[k].view.baseline_m;
        order.sort_by(|&a, &b| nodes[a].class.cmp(&nodes[b].class).then(length(a).total_cmp(&length(b))));
        order
            .chunk_by(|&a, &b| nodes[a].class == nodes[b].class)
            .flat_map(|same| same.chunks(BATCH).map(<[usize]>::to_vec))
            .collect()
    }

    /// Computes the patterns of batch `number`.
    fn compute_patterns(
        &self,
        plan: &RowPlan,
        tracks: &[Track],
        tables: &Tables,
        indices: Vec<usize>,
        number: usize,
        workspace: &mut Workspace,
    ) {
        let first = node_range(tracks).start;
        if workspace.batches.len() <= number {
            workspace.batches.resize_with(number + 1, Batch::default);
        }
        let batch = &mut workspace.batches[number];
        batch.indices = indices;
        batch.nodes.clear();
        batch.nodes.extend(batch.indices.iter().map(|&k| plan.nodes[first + k]));
        let class = tables.class(&batch.nodes);
        self.patterns.write_patterns(
            &self.turns,
            class,
            &batch.nodes,
            &mut workspace.cap,
            &mut batch.patterns,
        );
    }

    /// Computes the amplitudes of a batch from the skies in the chosen frames.
    fn compute_amplitudes(
        &self,
        number: usize,
        skies: &[Alm],
        frames: Option<&Frames>,
        workspace: &mut Workspace,
    ) {
        let (orders, l_max) = (self.padded_orders(), self.setup.l_max);
        let Workspace { batches, basis, rotated, weights, rotation, amplitudes: out, .. } = workspace;
        let batch = &batches[number];
        match frames {
            None => self.turns.rotate_skies(&batch.nodes, skies, rotation, rotated),
            Some(frames) => {
                frames.weights_for(&batch.indices, weights);
                frames.combine(basis, weights, [l_max, skies.len()], rotated);
            }
        }
        let lanes = padded_count(&batch.nodes);
        for (mu, [re, im]) in rotated.iter().enumerate() {
            for (group, indices) in batch.indices.chunks(LANES).enumerate() {
                let pattern = batch.patterns[mu].rows(group);
                for sky in 0..skies.len() {
                    let first = sky * lanes + group * LANES;
                    let sums = products(&re[first..], &im[first..], skies.len() * lanes, pattern);
                    for (lane, node) in indices.iter().enumerate() {
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

    /// Adds the transpose of [`Self::compute_amplitudes`] to the gradients in the chosen frames, or to `out`.
    fn compute_gradients(
        &self,
        number: usize,
        frames: Option<&Frames>,
        workspace: &mut Workspace,
        out: &mut [Alm],
    ) {
        let (orders, l_max, skies) = (self.padded_orders(), self.setup.l_max, out.len());
        let Workspace { batches, basis, rotated, weights, rotation, amplitudes, .. } = workspace;
        let batch = &batches[number];
        let lanes = padded_count(&batch.nodes);
        let at = |place: usize| amplitudes[place] as Value;
        resize_buffers(rotated, l_max, lanes * skies);
        for (mu, [re, im]) in rotated.iter_mut().enumerate() {
            for (group, indices) in batch.indices.chunks(LANES).enumerate() {
                let pattern = batch.patterns[mu].rows(group);
                for sky in 0..skies {
                    let mut values = [[0.0; LANES]; 4];
                    for (lane, node) in indices.iter().enumerate() {
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
            None => self.turns.rotate_skies_transposed(&batch.nodes, rotated, rotation, out),
            Some(frames) => {
                frames.weights_for(&batch.indices, weights);
                frames.combine_transposed(rotated, weights, basis, [l_max, skies]);
            }
        }
    }

    /// Interpolates the visibilities of all rows of tracks, one vector per sky, from the amplitudes of the skies' products.
    fn interpolate(
        &self,
        plan: &RowPlan,
        tracks: &[Track],
        skies: usize,
        workspace: &mut Workspace,
    ) -> Vec<Vec<Complex64>> {
        let first = node_range(tracks).start;
        let products = skies * self.products.count();
        let width = 2 * self.padded_orders();
        let mut out = vec![Vec::with_capacity(row_range(tracks).len()); skies];
        let Workspace { amplitudes, table, node_weights, padded, .. } = workspace;
        let [mut values, mut at] = [0, 1].map(|_| vec![Complex64::ZERO; products]);
        for track in tracks {
            let amplitudes = &amplitudes[(track.nodes.start - first) * products * width..];
            let amplitudes = &amplitudes[..track.nodes.len() * products * width];
            if track.tau.is_empty() {
                for (row, node) in track.rows.clone().zip(amplitudes.chunks_exact(products * width)) {
                    for (value, g) in values.iter_mut().zip(node.chunks_exact(width)) {
                        *value = self.sum_orders(g, plan.gamma_rad[row]);
                    }
                    plan.combine_products(row, &values, &mut out);
                }
                continue;
            }
            self.phases.transform(amplitudes, width / 2, [track.nodes.len(), products], table);
            for row in track.rows.clone() {
                values.fill(Complex64::ZERO);
                for instant in plan.instants_of(track, row, &self.instants) {
                    let gamma_rad = plan.node_weights(track, row, instant, node_weights);
                    padded.set(table, node_weights);
                    self.phases.interpolate(table, gamma_rad, padded, &mut at);
                    values.iter_mut().zip(&at).for_each(|(value, at)| *value += instant.weight * at);
                }
                plan.combine_products(row, &values, &mut out);
            }
        }
        out
    }

    /// Computes `sum_mu exp(-i mu gamma) g_mu`.
    fn sum_orders(&self, amplitudes: &[f64], gamma_rad: f64) -> Complex64 {
        let (re, im) = amplitudes.split_at(amplitudes.len() / 2);
        phase_sum(re, im, gamma_rad) * Complex64::cis(self.setup.l_max as f64 * gamma_rad)
    }

    /// Writes amplitudes by the transpose of [`Self::interpolate`], for several vectors over the rows of the tracks.
    fn interpolate_transposed(
        &self,
        plan: &RowPlan,
        tracks: &[Track],
        values: &[&[Complex64]],
        workspace: &mut Workspace,
    ) {
        let (first, first_row) = (node_range(tracks).start, row_range(tracks).start);
        let (width, skies) = (2 * self.padded_orders(), values.len() * self.products.count());
        let Workspace { amplitudes: out, table, node_weights, padded, .. } = workspace;
        self.clear_amplitudes(tracks, skies, out);
        let [mut products_of_row, mut at] = [0, 1].map(|_| vec![Complex64::ZERO; skies]);
        for track in tracks {
            let out = &mut out[(track.nodes.start - first) * skies * width..];
            let out = &mut out[..track.nodes.len() * skies * width];
            if track.tau.is_empty() {
                for (row, to) in track.rows.clone().zip(out.chunks_exact_mut(skies * width)) {
                    let gamma_rad = plan.gamma_rad[row];
                    plan.distribute_to_products(
                        row,
                        values.iter().map(|values| values[row - first_row]),
                        &mut products_of_row,
                    );
                    for (value, to) in products_of_row.iter().zip(to.chunks_exact_mut(width)) {
                        let turn = Complex64::cis(-(self.setup.l_max as f64) * gamma_rad);
                        let (re, im) = to.split_at_mut(width / 2);
                        phase_terms(value * turn, gamma_rad, re, im);
                    }
                }
                continue;
            }
            self.phases.clear(table, [track.nodes.len(), skies]);
            for row in track.rows.clone() {
                plan.distribute_to_products(
                    row,
                    values.iter().map(|values| values[row - first_row]),
                    &mut products_of_row,
                );
                for instant in plan.instants_of(track, row, &self.instants) {
                    let gamma_rad = plan.node_weights(track, row, instant, node_weights);
                    padded.set(table, node_weights);
                    at.iter_mut().zip(&products_of_row).for_each(|(at, value)| *at = instant.weight * value);
                    self.phases.interpolate_transposed(table, gamma_rad, padded, &at);
                }
            }
            self.phases.transform_transposed(table, width / 2, out);
        }
    }
}

/// Range of the nodes of consecutive tracks.
fn node_range(tracks: &[Track]) -> Range<usize> {
    tracks.first().map_or(0, |track| track.nodes.start)..tracks.last().map_or(0, |track| track.nodes.end)
}

/// Range of the rows of consecutive tracks.
fn row_range(tracks: &[Track]) -> Range<usize> {
    tracks.first().map_or(0, |track| track.rows.start)..tracks.last().map_or(0, |track| track.rows.end)
}

fn concatenate(plan: &RowPlan, skies: usize, groups: Vec<Vec<Vec<Complex64>>>) -> Vec<Vec<Complex64>> {
    let mut out = vec![Vec::with_capacity(plan.rows()); skies];
    for group in groups {
        for (out, values) in out.iter_mut().zip(group) {
            out.extend(values);
        }
    }
    out
}

fn add_gradients(sums: &mut [Alm], part: &[Alm]) {
    for (sum, part) in sums.iter_mut().zip(part) {
        sum.values_mut().iter_mut().zip(part.values()).for_each(|(sum, x)| *sum += x);
    }
}

/// Memory of rows up to `l_max` and `u_max` wavelengths without the visibilities, bytes: Legendre functions by class, and the buffers
/// of each thread. The angle between nadir and limb has a range of `limb_range_rad`. A response of some degree multiplies the number of skies by the number of its monomials.
#[must_use]
pub fn row_tables_bytes(
    l_max: usize,
    u_max: f64,
    limb_range_rad: f64,
    threads: usize,
    polynomial_degree: usize,
) -> u64 {
    let products = SkyProducts::new(polynomial_degree).count() as f64;
    let l_max = l_max + polynomial_degree;
    let coefficients = 0.25 * ((l_max + 2) as f64).powi(2);
    let turns = ((l_max + 2) as f64).powi(3) / 3.0;
    let gradients = (2 * GROUPS_AT_ONCE) as f64 * 16.0 * 2.0 * coefficients * products;
    // Amplitudes of two skies before and after the weights, and patterns.
    let group =
        1.5 * GROUP_NODES as f64 * (4.0 * 16.0 * (2 * l_max + 1) as f64 * products + 16.0 * coefficients);
    let batch = BATCH as f64 * 80.0 * coefficients + batch_bytes(l_max, u_max, BATCH);
    let classes = tables_bytes(l_max, u_max, limb_range_rad);
    (classes + 4.0 * turns + gradients + threads as f64 * (group + batch)) as u64
}
