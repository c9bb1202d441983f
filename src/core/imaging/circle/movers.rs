//! Bodies that move over the sky, in the sums: what a body of unit power adds to the data, month by month.
//!
//! A static map smears a body to an arc. With a flux f for each body and month beside the map, `V = B x + P f + noise`, where a column of P has
//! the visibilities of the body at unit power in its month: its direction by date, the Moon's shadow and the antennas as in a row of B, at the
//! middle of each integration. The sums are then `BtN^-1P` beside the right-hand side, which are gridded as it is, `P'N^-1P` and `P'N^-1V`.
//! Months are 30 days of mission time. A visibility is in one of them, so that a pair of right-hand sides takes both bodies.

use std::collections::BTreeMap;
use std::sync::Arc;

use num_complex::Complex64;
use rayon::prelude::*;

use super::grid::{Grids, NODES};
use super::mover_columns::{Column, MONTH_S, MoverColumns};
use super::quanta::{Quanta, right_values};
use super::spread::{GriddedTerms, TorusPoint, add_pair};
use super::sums::HarmonicSums;
use super::tori::{NodeSums, Tori};
use super::{HarmonicBasis, HarmonicEngine, HarmonicSetup};
use crate::array::body_hat_by_date;
use crate::frames::PlacedVisibilities;
use crate::imaging::exact::engine::{Accepted, SkyBasis};
use crate::imaging::exact::fixed_point::Direction;
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::response::beacon::plane_wave;
use crate::response::pixel::PairGeometry;
use crate::response::pixel::exact::envelope;
use crate::sky::Body;
use crate::units::vector::{Vec3, sub};

/// Maximum number of bodies: their right-hand sides are gridded in pairs.
pub const BODIES_MAX: usize = 2;

/// Maximum number of months with a column: each takes a solution for every body.
pub const MONTHS_MAX: usize = 32;

/// Power of the bodies in the sums, in units of the noise of a visibility of the largest weight. Expected weights are 2^-10 of that, so that
/// terms are some 2^20 quanta; with the largest total weight sums are below 2^62 of them.
const POWER: f64 = 32.0;

/// Steps per unit of sums that are not gridded. Each term is below 2^10 in them, or a datum in units of its noise times 2^5.
const STEPS: f64 = 1_099_511_627_776.0; // 2^40

/// A visibility that waits to be summed.
#[derive(Clone, Copy, Debug)]
struct Waiting {
    month: i64,
    time_s: f64,
    r_m: [Vec3; 2],
    place: TorusPoint,
    weight: f64,
    value_k_sr: Complex64,
    /// Of the noise-only map, in units of the standard deviation.
    noise: Complex64,
    /// -1 to remove it.
    sign: f64,
}

/// Sums of a visibility, or of a month, that are not gridded, in steps. Integers do not depend on the order of addition.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Products {
    /// `P'N^-1P`: of the first body, of both, of the second.
    bodies: [i128; 3],
    /// `P'N^-1V` of each body.
    data: [i128; 2],
    /// The same of the noise of the noise-only map.
    noise: [i128; 2],
}

impl Products {
    fn add(&mut self, other: &Self) {
        let all = |sums: &mut [i128], others: &[i128]| {
            sums.iter_mut().zip(others).for_each(|(sum, other)| *sum = sum.wrapping_add(*other));
        };
        all(&mut self.bodies, &other.bodies);
        all(&mut self.data, &other.data);
        all(&mut self.noise, &other.noise);
    }
}

/// The sums of a month: at each node `[alpha]` of rows `[first body re, im, second re, im][gamma]`, and products.
#[derive(Debug)]
struct MonthSums {
    nodes: Vec<Option<Vec<IntegerRow>>>,
    products: Products,
}

/// Sums of bodies for the visibilities of an engine.
#[derive(Debug)]
pub struct MoverSums {
    bodies: Vec<Body>,
    epoch_tai_s: f64,
    setup: HarmonicSetup,
    unit_k_sr: f64,
    grids: Arc<Grids>,
    quanta: Quanta,
    months: BTreeMap<i64, MonthSums>,
    /// Visibilities beyond the last month that has a column.
    beyond: i64,
    pending: Vec<Waiting>,
}

impl MoverSums {
    /// Creates empty sums for an empty engine; `bodies` are at most [`BODIES_MAX`].
    #[must_use]
    pub fn new(engine: &HarmonicEngine, bodies: &[Body], epoch_tai_s: f64) -> Self {
        let setup = *engine.setup();
        Self {
            bodies: bodies.to_vec(),
            epoch_tai_s,
            setup,
            unit_k_sr: POWER / setup.weight_max.sqrt(),
            grids: Arc::clone(&engine.basis.grids),
            quanta: engine.basis.quanta,
            months: BTreeMap::new(),
            beyond: 0,
            pending: Vec::with_capacity(HarmonicBasis::BATCH),
        }
    }

    /// Adds the visibilities of a block that the engine accepts.
    pub fn add(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities) {
        self.change(engine, placed, 1.0);
    }

    /// Removes what [`Self::add`] added for a block.
    pub fn remove(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities) {
        self.change(engine, placed, -1.0);
    }

    fn change(&mut self, engine: &HarmonicEngine, placed: &PlacedVisibilities, sign: f64) {
        for k in 0..placed.len() {
            let Ok(accepted) = engine.accept(placed, k) else { continue };
            let Accepted { place, weight, value_k_sr, noise, .. } = accepted;
            let time_s = placed.time_s[k];
            let month = (time_s / MONTH_S).floor() as i64;
            if !self.months.contains_key(&month) {
                if self.months.len() >= MONTHS_MAX {
                    self.beyond += sign as i64;
                    continue;
                }
                let nodes = vec![None; self.grids.nodes.count];
                self.months.insert(month, MonthSums { nodes, products: Products::default() });
            }
            let r_m = [placed.r_i_m[k], placed.r_j_m[k]];
            self.pending.push(Waiting { month, time_s, r_m, place, weight, value_k_sr, noise, sign });
            if self.pending.len() >= HarmonicBasis::BATCH {
                self.flush();
            }
        }
    }

    /// The visibilities of the bodies at unit power, as the engine grids those of the sky.
    fn unit(&self, waiting: &Waiting) -> [Complex64; BODIES_MAX] {
        let [r_i_m, r_j_m] = waiting.r_m;
        let HarmonicSetup { frequency_hz, moon_radius_m, response, .. } = self.setup;
        let pair = PairGeometry { r_i_m, r_j_m, frequency_hz, moon_radius_m, response };
        let of_body = |body: &Body| {
            let n_hat = body_hat_by_date(*body, self.epoch_tai_s, waiting.time_s);
            let power_k_sr = self.unit_k_sr * envelope(&pair, n_hat);
            let seen = plane_wave(power_k_sr, n_hat, sub(r_i_m, r_j_m), frequency_hz);
            if waiting.place.is_conjugated { seen.conj() } else { seen }
        };
        std::array::from_fn(|k| self.bodies.get(k).map(of_body).unwrap_or_default())
    }

    /// The terms of a visibility; `None` if no body is seen.
    fn terms(&self, waiting: &Waiting) -> Option<(i64, GriddedTerms, Products)> {
        let unit = self.unit(waiting);
        if unit.iter().all(|seen| *seen == Complex64::ZERO) {
            return None;
        }
        let &Waiting { place, weight, sign, .. } = waiting;
        let value = if place.is_conjugated { waiting.value_k_sr.conj() } else { waiting.value_k_sr };
        let noise = waiting.noise * weight.sqrt();
        let steps = |a: Complex64, b: Complex64| (sign * STEPS * (a.conj() * b).re).round() as i128;
        let products = Products {
            bodies: [[0, 0], [0, 1], [1, 1]].map(|[a, b]| steps(weight * unit[a], unit[b])),
            data: unit.map(|seen| steps(seen, weight * value)),
            noise: unit.map(|seen| steps(seen, noise)),
        };
        let pair = [unit.map(|seen| sign * weight * seen)];
        Some((waiting.month, GriddedTerms::new(&self.grids, self.quanta, &place, pair.into_iter()), products))
    }

    fn flush(&mut self) {
        let found: Vec<_> = self.pending.par_iter().filter_map(|waiting| self.terms(waiting)).collect();
        let grids = &self.grids;
        for (number, month) in &mut self.months {
            let mut reaching: Vec<Vec<&GriddedTerms>> = vec![Vec::new(); grids.nodes.count];
            for (_, terms, products) in found.iter().filter(|(of, ..)| of == number) {
                month.products.add(products);
                for list in reaching.iter_mut().skip(terms.first_node).take(NODES) {
                    list.push(terms);
                }
            }
            let nodes = month.nodes.par_iter_mut().zip(&reaching).enumerate();
            nodes.filter(|(_, (_, reaching))| !reaching.is_empty()).for_each(|(index, (node, reaching))| {
                let rows = node.get_or_insert_with(|| vec![IntegerRow::default(); grids.data_points()]);
                add_pair(grids, Direction::In, (index, 0), reaching, rows);
            });
        }
        self.pending.clear();
    }

    /// The columns, for the sums of the same visibilities. Columns of bodies that are never seen are left out.
    fn into_columns(mut self, sums: &HarmonicSums) -> MoverColumns {
        self.flush();
        let Self { bodies, setup, unit_k_sr, grids, quanta, months, beyond, .. } = self;
        let (mut columns, mut right, mut of_months) = (Vec::new(), Vec::new(), Vec::new());
        for (month, MonthSums { nodes, products }) in months {
            let value = |rows: Option<Vec<IntegerRow>>| {
                Some(NodeSums::of_right(right_values(&rows?, &grids, quanta)))
            };
            let tori = Tori::in_memory(nodes.into_par_iter().map(value).collect());
            for ((which, body), mut of_body) in bodies.iter().enumerate().zip(sums.projected(&tori)) {
                if products.bodies[2 * which] > 0 {
                    of_body.iter_mut().for_each(|value| *value /= unit_k_sr);
                    columns.push(Column { body: *body, month });
                    right.push(of_body);
                    of_months.push((which, products));
                }
            }
        }
        let number = |steps: i128, power: i32| steps as f64 / STEPS / unit_k_sr.powi(power);
        let product = |a: usize, b: usize| match columns[a].month == columns[b].month {
            true => number(of_months[a].1.bodies[of_months[a].0 + of_months[b].0], 2),
            false => 0.0,
        };
        let order = 0..columns.len();
        MoverColumns {
            products: order
                .clone()
                .flat_map(|a| order.clone().map(move |b| (a, b)))
                .map(|(a, b)| product(a, b))
                .collect(),
            data: of_months.iter().map(|(which, sums)| number(sums.data[*which], 1)).collect(),
            noise: of_months.iter().map(|(which, sums)| number(sums.noise[*which], 1)).collect(),
            columns,
            right,
            frequency_hz: setup.frequency_hz,
            beyond: beyond.max(0) as u64,
        }
    }
}

impl HarmonicSums {
    /// Adds the columns of bodies that move.
    #[must_use]
    pub fn with_movers(mut self, movers: MoverSums) -> Self {
        self.movers = Some(movers.into_columns(&self));
        self
    }
}
