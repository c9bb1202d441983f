//! Exact sums at the nodes in baseline length: integers, row by row of a torus.
//!
//! A term is a product, rounded to a multiple of the quantum by adding [`BIAS`] in the same operation; its multiple is
//! what the bits of the sum are above those of the bias. A visibility whose terms would be greater than 2^21 quanta
//! has them rounded to the quantum times a power of two instead, so that it keeps its 21 bits: which power depends
//! on that visibility alone.
//!
//! Integers of a row take 32 bits while the greatest terms of all that was added to it could not sum to more, else
//! 64. That bound is a sum of integers too, so it does not depend on the order either.

use rayon::prelude::*;

use super::grid::{Grids, NODES, OVERHANG};
use super::spread::{Located, Pending, spread};
use super::tori::{Node, Tori};
use crate::accumulation::Direction;
use crate::accumulation::scale::Scale;

/// Quanta of the greatest weight that is taken; expected ones are 2^-10 of it and keep 20 bits.
const WEIGHT_QUANTA: f64 = 1_073_741_824.0; // 2^30
/// Quanta of a side of the greatest weight at a signal-to-noise ratio of one.
const SIDE_QUANTA: f64 = 16_777_216.0; // 2^24

/// Added to a term it leaves whole numbers; even, so that a term and its negative are rounded alike.
pub(super) const BIAS: f32 = 12_582_912.0; // 1.5 2^23
/// Greatest term, in its own quanta.
pub(super) const TERM_MAX: f64 = 2_097_152.0; // 2^21
/// Bounds below this hold in 32 bits.
const NARROW: u64 = 1 << 31;

/// What `terms` biased multiples hold too much.
#[inline(always)]
pub(super) fn biases(terms: usize) -> i32 {
    (BIAS.to_bits() as i32).wrapping_mul(terms as i32)
}

/// What weights and sides are counted in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Quanta {
    /// Of weights, (K sr)^-2.
    pub(super) weight: f64,
    /// Of sides, (K sr)^-1.
    pub(super) side: f64,
}

impl Quanta {
    pub(super) fn new(scale: Scale) -> Self {
        Self { weight: scale.weight / WEIGHT_QUANTA, side: scale.root / SIDE_QUANTA }
    }
}

/// Integers of one row, or of none if nothing was ever added.
#[derive(Clone, Debug, Default)]
pub(super) enum Integers {
    #[default]
    None,
    Narrow(Box<[i32]>),
    Wide(Box<[i64]>),
}

/// One alpha: `[diagonal or side][gamma]`.
#[derive(Clone, Debug, Default)]
pub(super) struct Row {
    /// No sum is greater than this, in quanta.
    bound: u64,
    pub(super) integers: Integers,
}

impl Row {
    /// Makes room for terms of together at most `most` quanta in each of `len` sums.
    #[inline(always)]
    pub(super) fn make_room(&mut self, most: u64, direction: Direction, len: usize) {
        let before = self.bound;
        self.bound = match direction {
            Direction::In => before.wrapping_add(most),
            Direction::Out => before.wrapping_sub(most),
        };
        let is_wide = self.bound.max(before) >= NARROW;
        match &self.integers {
            Integers::Wide(_) => {}
            Integers::Narrow(_) if !is_wide => {}
            _ => self.hold(is_wide, len),
        }
    }

    #[cold]
    fn hold(&mut self, is_wide: bool, len: usize) {
        self.integers = match (std::mem::take(&mut self.integers), is_wide) {
            (Integers::None, false) => Integers::Narrow(vec![0; len].into()),
            (Integers::None, true) => Integers::Wide(vec![0; len].into()),
            (Integers::Narrow(sums), true) => {
                Integers::Wide(sums.iter().map(|sum| i64::from(*sum)).collect())
            }
            (held, _) => held,
        };
    }

    /// Adds another row, or takes it out.
    fn combine(&mut self, other: &Self, direction: Direction) {
        let len = match &other.integers {
            Integers::None => return,
            Integers::Narrow(sums) => sums.len(),
            Integers::Wide(sums) => sums.len(),
        };
        self.make_room(other.bound, direction, len);
        let sign = if direction == Direction::In { 1 } else { -1 };
        match (&mut self.integers, &other.integers) {
            (Integers::Narrow(sums), Integers::Narrow(terms)) => {
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum = sum.wrapping_add(sign * term));
            }
            (Integers::Wide(sums), Integers::Narrow(terms)) => {
                sums.iter_mut().zip(terms).for_each(|(sum, term)| {
                    *sum = sum.wrapping_add(i64::from(sign) * i64::from(*term));
                });
            }
            (Integers::Wide(sums), Integers::Wide(terms)) => {
                let terms = terms.iter().map(|term| i64::from(sign).wrapping_mul(*term));
                sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum = sum.wrapping_add(term));
            }
            // A row that holds wide ones has a bound that is; low bits are right in any case.
            (Integers::Narrow(sums), Integers::Wide(terms)) => {
                sums.iter_mut()
                    .zip(terms)
                    .for_each(|(sum, term)| *sum = sum.wrapping_add(sign * *term as i32));
            }
            (Integers::None, _) | (_, Integers::None) => {}
        }
    }

    fn at(&self, index: usize) -> i64 {
        match &self.integers {
            Integers::None => 0,
            Integers::Narrow(sums) => i64::from(sums[index]),
            Integers::Wide(sums) => sums[index],
        }
    }

    /// The sums of each part of the row, what lies beyond its end brought round to its start; `None` if nothing is
    /// in the row.
    fn folded(&self, stride: usize, parts: usize) -> Option<impl Iterator<Item = i64>> {
        let points = stride - OVERHANG;
        (self.bound > 0).then(|| {
            (0..parts).flat_map(move |part| {
                (0..points).map(move |gamma| {
                    let sum = self.at(part * stride + gamma);
                    if gamma < OVERHANG {
                        sum.wrapping_add(self.at(part * stride + points + gamma))
                    } else {
                        sum
                    }
                })
            })
        })
    }

    /// Writes bound and sums; sums that fit 32 bits by the bound take no more.
    pub(super) fn write<E>(
        &self,
        (stride, parts): (usize, usize),
        mut out: impl FnMut(&[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        out(&self.bound.to_le_bytes())?;
        let Some(sums) = self.folded(stride, parts) else { return Ok(()) };
        let bytes: Vec<u8> = if self.bound < NARROW {
            sums.flat_map(|sum| (sum as i32).to_le_bytes()).collect()
        } else {
            sums.flat_map(i64::to_le_bytes).collect()
        };
        out(&bytes)
    }

    /// Reads what [`Row::write`] wrote.
    pub(super) fn read<E>(
        (stride, parts): (usize, usize),
        mut from: impl FnMut(&mut [u8]) -> Result<(), E>,
    ) -> Result<Self, E> {
        let mut bound = [0; 8];
        from(&mut bound)?;
        let mut row = Self::default();
        let bound = u64::from_le_bytes(bound);
        if bound == 0 {
            return Ok(row);
        }
        let points = stride - OVERHANG;
        let width = if bound < NARROW { 4 } else { 8 };
        let mut bytes = vec![0; width * points * parts];
        from(&mut bytes)?;
        row.make_room(bound, Direction::In, stride * parts);
        let places = (0..parts).flat_map(|part| part * stride..part * stride + points);
        match &mut row.integers {
            Integers::None => {}
            Integers::Narrow(sums) => {
                places.zip(bytes.as_chunks::<4>().0).for_each(|(at, b)| sums[at] = i32::from_le_bytes(*b));
            }
            Integers::Wide(sums) => {
                places.zip(bytes.as_chunks::<8>().0).for_each(|(at, b)| sums[at] = i64::from_le_bytes(*b));
            }
        }
        Ok(row)
    }

    /// The sums times `quantum`, into a row of the same layout.
    fn values(&self, stride: usize, quantum: f64, out: &mut [f32]) {
        let parts = out.len() / stride;
        let Some(mut sums) = self.folded(stride, parts) else { return };
        for out in out.chunks_exact_mut(stride) {
            for (out, sum) in out[..stride - OVERHANG].iter_mut().zip(&mut sums) {
                *out = (sum as f64 * quantum) as f32;
            }
        }
    }
}

/// The sums at one node.
#[derive(Clone, Debug)]
pub(super) struct ExactNode {
    /// By alpha: `[diagonal][gamma]`.
    pub(super) weights: Vec<Row>,
    /// By alpha: `[data re, data im, noise re, noise im][gamma]`.
    pub(super) sides: Vec<Row>,
}

impl ExactNode {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { weights: vec![Row::default(); grids.points], sides: vec![Row::default(); grids.data_points()] }
    }

    fn values(&self, grids: &Grids, quanta: Quanta) -> Node {
        let mut node = Node::zeros(grids);
        let parts = [
            (&self.weights, &mut node.weights, grids.weight_stride(), quanta.weight),
            (&self.sides, &mut node.sides, grids.data_stride(), quanta.side),
        ];
        for (rows, out, stride, quantum) in parts {
            let len = out.len() / rows.len();
            for (row, out) in rows.iter().zip(out.chunks_exact_mut(len)) {
                row.values(stride, quantum, out);
            }
        }
        node
    }

    /// Whether nothing is in it, because nothing was or all was taken out.
    pub(super) fn is_empty(&self) -> bool {
        self.weights.iter().chain(&self.sides).all(|row| row.bound == 0)
    }
}

/// All nodes; those that no visibility has reached take no memory, nor do alphas.
#[derive(Clone, Debug, Default)]
pub(super) struct ExactTori {
    pub(super) nodes: Vec<Option<ExactNode>>,
}

impl ExactTori {
    pub(super) fn zeros(grids: &Grids) -> Self {
        Self { nodes: vec![None; grids.nodes.count] }
    }

    /// Adds visibilities; those to be taken out have negative weights and sides.
    pub(super) fn add(
        &mut self,
        (grids, quanta): (&Grids, Quanta),
        pending: &[Pending],
        direction: Direction,
    ) {
        let located: Vec<Located> = pending.par_iter().map(|p| Located::new(grids, quanta, p)).collect();
        let mut reaching: Vec<Vec<u32>> = vec![Vec::new(); self.nodes.len()];
        for (k, visibility) in located.iter().enumerate() {
            for list in reaching.iter_mut().skip(visibility.first_node).take(NODES) {
                list.push(k as u32);
            }
        }
        self.nodes.par_iter_mut().zip(&reaching).enumerate().for_each(|(index, (node, reaching))| {
            if reaching.is_empty() {
                return;
            }
            let node = node.get_or_insert_with(|| ExactNode::zeros(grids));
            spread((grids, direction), index, (&located, reaching), node);
        });
    }

    /// Adds other sums, or takes them out.
    pub(super) fn combine(&mut self, grids: &Grids, other: &Self, direction: Direction) {
        self.nodes.par_iter_mut().zip(&other.nodes).for_each(|(node, other)| {
            let Some(other) = other else { return };
            let node = node.get_or_insert_with(|| ExactNode::zeros(grids));
            for (rows, others) in [(&mut node.weights, &other.weights), (&mut node.sides, &other.sides)] {
                rows.iter_mut().zip(others).for_each(|(row, other)| row.combine(other, direction));
            }
        });
    }

    /// The sums in f32.
    pub(super) fn values(&self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: &ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori { nodes: self.nodes.par_iter().map(|node| node.as_ref().and_then(value)).collect() }
    }

    /// The sums in f32; their integers are given up node by node.
    pub(super) fn into_values(self, grids: &Grids, quanta: Quanta) -> Tori {
        let value = |node: ExactNode| (!node.is_empty()).then(|| node.values(grids, quanta));
        Tori { nodes: self.nodes.into_par_iter().map(|node| node.and_then(value)).collect() }
    }
}
