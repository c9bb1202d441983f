//! Noise of further realisations: right-hand sides of noise alone, whose weights an engine sums once for all of them.
//!
//! Two realisations take the place of a row of data and noise. Each has the bits that it has as the companion of an engine of its
//! own: its noise depends on its seed and the visibility alone, and sums of integers on nothing else.

use std::sync::Arc;

use rayon::prelude::*;

use super::grid::{Grids, NODES};
use super::operator::{RightHandSide, SharedTori};
use super::quanta::Quanta;
use super::spread::{LocatedNoise, TorusPoint, spread_noises};
use super::sums::{HarmonicSums, unknowns_of_gradient};
use super::tori::{NodeSums, Tori};
use super::{HarmonicBasis, HarmonicEngine};
use crate::frames::PlacedVisibilities;
use crate::imaging::exact::engine::SkyBasis;
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::imaging::exact::noise::{NoiseKey, unit_noise};

/// A visibility whose noise realisations are summed.
#[derive(Clone, Copy, Debug)]
struct NoisyVisibility {
    place: TorusPoint,
    weight: f64,
    key: NoiseKey,
}

/// Sums of noises, a pair of realisations each: `[node][alpha]` of rows `[re, im, other's re, im][gamma]`.
type PairTori = Vec<Option<Vec<IntegerRow>>>;

/// Sums of noise of several realisations, of the visibilities that an engine takes.
#[derive(Debug)]
pub struct NoiseSums {
    seeds: Vec<u64>,
    grids: Arc<Grids>,
    quanta: Quanta,
    pairs: Vec<PairTori>,
    pending: Vec<NoisyVisibility>,
}

impl NoiseSums {
    /// For the visibilities of an engine without data yet, a realisation for each seed.
    #[must_use]
    pub fn new(engine: &HarmonicEngine, seeds: &[u64]) -> Self {
        let grids = Arc::clone(&engine.basis.grids);
        let pairs = vec![vec![None; grids.nodes.count]; seeds.len().div_ceil(2)];
        let pending = Vec::with_capacity(HarmonicBasis::BATCH);
        Self { seeds: seeds.to_vec(), grids, quanta: engine.basis.quanta, pairs, pending }
    }

    /// Bytes for each realisation of maps up to `l_max` from baselines up to `u_max` wavelengths, at most.
    #[must_use]
    pub fn bytes_each(l_max: usize, u_max: f64) -> u64 {
        let grids = Grids::new(l_max, u_max);
        // Integers of 64 bits at most; two realisations share a row.
        (8 * grids.nodes.count * grids.right_len() / 2) as u64
    }

    /// Adds the noises of what the engine takes of these visibilities, as long as its sums have room.
    pub fn add(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities) {
        for k in 0..placed.len() {
            if let Ok(accepted) = engine.accept(placed, k) {
                let (place, weight) = (accepted.place, accepted.weight);
                self.pending.push(NoisyVisibility { place, weight, key: NoiseKey::new(placed, k) });
            }
            if self.pending.len() >= HarmonicBasis::BATCH {
                self.flush();
            }
        }
    }

    fn flush(&mut self) {
        let Self { seeds, grids, quanta, pairs, pending } = self;
        let locate = |one: &NoisyVisibility| {
            let noise = |seed: &u64| unit_noise(*seed, one.key) * one.weight.sqrt();
            let two = |seeds: &[u64]| [noise(&seeds[0]), seeds.get(1).map(noise).unwrap_or_default()];
            LocatedNoise::new(grids, *quanta, &one.place, seeds.chunks(2).map(two))
        };
        let located: Vec<LocatedNoise> = pending.par_iter().map(locate).collect();
        let mut reaching: Vec<Vec<&LocatedNoise>> = vec![Vec::new(); grids.nodes.count];
        for visibility in &located {
            for list in reaching.iter_mut().skip(visibility.first_node).take(NODES) {
                list.push(visibility);
            }
        }
        pairs.par_iter_mut().enumerate().for_each(|(pair, nodes)| {
            nodes.par_iter_mut().zip(&reaching).enumerate().for_each(|(index, (node, reaching))| {
                if !reaching.is_empty() {
                    let rows = node.get_or_insert_with(|| vec![IntegerRow::default(); grids.data_points()]);
                    spread_noises(grids, index, pair, reaching, rows);
                }
            });
        });
        pending.clear();
    }

    /// The right-hand sides, one a seed, beside the sums of the same visibilities.
    fn into_right_hand_sides(mut self, sums: &HarmonicSums) -> Vec<Vec<f64>> {
        self.flush();
        let Self { seeds, grids, quanta, pairs, .. } = self;
        let of_pair = |nodes: PairTori| {
            let value = |rows: Vec<IntegerRow>| {
                let mut right = vec![0.0; grids.right_len()];
                let layout = grids.data_row();
                let held = (0..).zip(&rows).filter(|(alpha, _)| grids.holds(*alpha)).map(|(_, row)| row);
                for (row, out) in held.zip(right.chunks_exact_mut(layout.len())) {
                    row.write_values(layout, quanta.right, out);
                }
                NodeSums { weights: Vec::new(), right }
            };
            let tori = Tori::held(nodes.into_par_iter().map(|rows| rows.map(value)).collect());
            let shared = SharedTori { tori: &tori, ..sums.shared() };
            [RightHandSide::Data, RightHandSide::Noise]
                .map(|of| unknowns_of_gradient(&sums.operator().project(&shared, of)))
        };
        pairs.into_iter().flat_map(of_pair).take(seeds.len()).collect()
    }
}

impl HarmonicSums {
    /// With the noises of further realisations.
    #[must_use]
    pub fn with_noise_realisations(mut self, noises: NoiseSums) -> Self {
        self.further = noises.into_right_hand_sides(&self);
        self
    }
}
