//! Additional noise realisations: further noise-only right-hand sides for the same weights.
//!
//! Two realisations are stored in a row like that of data and noise. Each has the same bits as the noise-only companion of an engine with its
//! seed, because noise depends only on seed and visibility, and integer sums do not depend on order.

use std::sync::Arc;

use rayon::prelude::*;

use super::grid::{Grids, NODES};
use super::quanta::{Quanta, right_values};
use super::spread::{GriddedTerms, TorusPoint, add_pair};
use super::sums::HarmonicSums;
use super::tori::{NodeSums, Tori};
use super::{HarmonicBasis, HarmonicEngine};
use crate::frames::PlacedVisibilities;
use crate::imaging::exact::engine::SkyBasis;
use crate::imaging::exact::fixed_point::Direction;
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::imaging::exact::noise::{NoiseKey, unit_noise};

/// A visibility whose noise realisations wait to be summed.
#[derive(Clone, Copy, Debug)]
struct NoisyVisibility {
    place: TorusPoint,
    weight: f64,
    key: NoiseKey,
    /// -1 to remove it.
    sign: f64,
}

/// Sums of a pair of noise realisations: `[node][alpha]` of rows `[first re, im, second re, im][gamma]`.
type PairTori = Vec<Option<Vec<IntegerRow>>>;

/// Sums of several noise realisations for the visibilities of an engine.
#[derive(Debug)]
pub struct NoiseSums {
    seeds: Vec<u64>,
    grids: Arc<Grids>,
    quanta: Quanta,
    realisation_pairs: Vec<PairTori>,
    pending: Vec<NoisyVisibility>,
}

impl NoiseSums {
    /// Creates empty sums for an empty engine, with one realisation per seed.
    #[must_use]
    pub fn new(engine: &HarmonicEngine, seeds: &[u64]) -> Self {
        let grids = Arc::clone(&engine.basis.grids);
        let realisation_pairs = vec![vec![None; grids.nodes.count]; seeds.len().div_ceil(2)];
        let pending = Vec::with_capacity(HarmonicBasis::BATCH);
        Self { seeds: seeds.to_vec(), grids, quanta: engine.basis.quanta, realisation_pairs, pending }
    }

    /// Maximum bytes per realisation, for maps up to `l_max` from baselines up to `u_max` wavelengths.
    #[must_use]
    pub fn bytes_each(l_max: usize, u_max: f64) -> u64 {
        let grids = Grids::new(l_max, u_max);
        // At most 64 bits per integer; two realisations share a row.
        (8 * grids.nodes.count * grids.right_len() / 2) as u64
    }

    /// Adds noise for the visibilities of a block that the engine accepts.
    pub fn add(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities) {
        self.change(engine, placed, 1.0);
    }

    /// Removes what [`Self::add`] added for a block.
    pub fn remove(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities) {
        self.change(engine, placed, -1.0);
    }

    fn change(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities, sign: f64) {
        for k in 0..placed.len() {
            if let Ok(accepted) = engine.accept(placed, k) {
                let (place, weight) = (accepted.place, accepted.weight);
                self.pending.push(NoisyVisibility { place, weight, key: NoiseKey::new(placed, k), sign });
            }
            if self.pending.len() >= HarmonicBasis::BATCH {
                self.flush();
            }
        }
    }

    fn flush(&mut self) {
        let Self { seeds, grids, quanta, realisation_pairs, pending } = self;
        let grid = |visibility: &NoisyVisibility| {
            let scale = visibility.sign * visibility.weight.sqrt();
            let noise = |seed: &u64| unit_noise(*seed, visibility.key) * scale;
            let pair = |seeds: &[u64]| [noise(&seeds[0]), seeds.get(1).map(noise).unwrap_or_default()];
            GriddedTerms::new(grids, *quanta, &visibility.place, seeds.chunks(2).map(pair))
        };
        let gridded: Vec<GriddedTerms> = pending.par_iter().map(grid).collect();
        let mut reaching: Vec<Vec<&GriddedTerms>> = vec![Vec::new(); grids.nodes.count];
        for visibility in &gridded {
            for list in reaching.iter_mut().skip(visibility.first_node).take(NODES) {
                list.push(visibility);
            }
        }
        realisation_pairs.par_iter_mut().enumerate().for_each(|(pair_index, nodes)| {
            nodes.par_iter_mut().zip(&reaching).enumerate().for_each(|(index, (node, reaching))| {
                if !reaching.is_empty() {
                    let rows = node.get_or_insert_with(|| vec![IntegerRow::default(); grids.data_points()]);
                    add_pair(grids, Direction::In, (index, pair_index), reaching, rows);
                }
            });
        });
        pending.clear();
    }

    /// The right-hand sides, one per seed, for the sums of the same visibilities.
    fn into_right_hand_sides(mut self, sums: &HarmonicSums) -> Vec<Vec<f64>> {
        self.flush();
        let Self { seeds, grids, quanta, realisation_pairs, .. } = self;
        let of_pair = |nodes: PairTori| {
            let value = |rows: Option<Vec<IntegerRow>>| {
                Some(NodeSums::of_right(right_values(&rows?, &grids, quanta)))
            };
            sums.projected(&Tori::in_memory(nodes.into_par_iter().map(value).collect()))
        };
        realisation_pairs.into_iter().flat_map(of_pair).take(seeds.len()).collect()
    }
}

impl HarmonicSums {
    /// Adds the right-hand sides of additional noise realisations.
    #[must_use]
    pub fn with_noise_realisations(mut self, realisations: NoiseSums) -> Self {
        self.noise_realisations = realisations.into_right_hand_sides(&self);
        self
    }
}
