//! Rows of integers of 32 bits each, widened to 64 bits when necessary.
//!
//! A row has 32-bit integers while a bound on its sums allows it: the sum of the maximum terms of all additions. The bound
//! is a sum of integers too, so it does not depend on their order.

use super::Direction;

/// Bound below which sums fit 32 bits.
const NARROW_BOUND: u64 = 1 << 31;

/// The layout of a row: consecutive parts, each with an overhang that is added to its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::imaging) struct RowLayout {
    /// Number of integers of a part, including its overhang.
    pub(in crate::imaging) stride: usize,
    pub(in crate::imaging) parts: usize,
    /// Number of integers beyond the end of a part.
    pub(in crate::imaging) overhang: usize,
}

impl RowLayout {
    /// Number of integers of a row.
    pub(in crate::imaging) fn len(self) -> usize {
        self.stride * self.parts
    }

    /// Number of integers of a part, without its overhang.
    pub(in crate::imaging) fn points(self) -> usize {
        self.stride - self.overhang
    }
}

/// The integers of a row; `None` before the first addition.
#[derive(Clone, Debug, Default)]
pub(in crate::imaging) enum Integers {
    #[default]
    None,
    Narrow(Box<[i32]>),
    Wide(Box<[i64]>),
}

/// A row of sums, with a bound on them.
#[derive(Clone, Debug, Default)]
pub(in crate::imaging) struct IntegerRow {
    /// Upper bound of the sums, in quanta.
    bound: u64,
    pub(in crate::imaging) integers: Integers,
}

impl IntegerRow {
    /// Makes room for terms that change each of `len` sums by at most `change_max` quanta.
    #[inline(always)]
    pub(in crate::imaging) fn make_room(&mut self, change_max: u64, direction: Direction, len: usize) {
        let before = self.bound;
        self.bound = match direction {
            Direction::In => before.wrapping_add(change_max),
            Direction::Out => before.wrapping_sub(change_max),
        };
        let is_wide = self.bound.max(before) >= NARROW_BOUND;
        match &self.integers {
            Integers::Wide(_) => {}
            Integers::Narrow(_) if !is_wide => {}
            _ => self.allocate(is_wide, len),
        }
    }

    #[cold]
    fn allocate(&mut self, is_wide: bool, len: usize) {
        self.integers = match (std::mem::take(&mut self.integers), is_wide) {
            (Integers::None, false) => Integers::Narrow(vec![0; len].into()),
            (Integers::None, true) => Integers::Wide(vec![0; len].into()),
            (Integers::Narrow(sums), true) => {
                Integers::Wide(sums.iter().map(|sum| i64::from(*sum)).collect())
            }
            (unchanged, _) => unchanged,
        };
    }

    /// Adds another row or removes it, depending on the direction.
    pub(in crate::imaging) fn combine(&mut self, other: &Self, direction: Direction) {
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
            // Does not occur, as a wide row has a large bound; the low bits would be right.
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

    /// Whether the row is empty.
    pub(in crate::imaging) fn is_empty(&self) -> bool {
        self.bound == 0
    }

    /// The sums of each part, with its overhang added to its start; `None` if the row is empty.
    fn folded(&self, layout: RowLayout) -> Option<impl Iterator<Item = i64>> {
        let (points, stride) = (layout.points(), layout.stride);
        (!self.is_empty()).then(|| {
            (0..layout.parts).flat_map(move |part| {
                (0..points).map(move |index| {
                    let sum = self.at(part * stride + index);
                    if index < layout.overhang {
                        sum.wrapping_add(self.at(part * stride + points + index))
                    } else {
                        sum
                    }
                })
            })
        })
    }

    /// Writes the bound and the sums, in 32 bits if the bound allows it.
    pub(in crate::imaging) fn write<E>(
        &self,
        layout: RowLayout,
        mut out: impl FnMut(&[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        out(&self.bound.to_le_bytes())?;
        let Some(sums) = self.folded(layout) else { return Ok(()) };
        // In place and by `for_each` for speed: an interrupted run waits for gigabytes of these.
        let count = layout.points() * layout.parts;
        let bytes = if self.bound < NARROW_BOUND {
            let mut bytes = vec![0; 4 * count];
            let mut fields = bytes.as_chunks_mut::<4>().0.iter_mut();
            sums.for_each(|sum| {
                if let Some(field) = fields.next() {
                    *field = (sum as i32).to_le_bytes();
                }
            });
            bytes
        } else {
            let mut bytes = vec![0; 8 * count];
            let mut fields = bytes.as_chunks_mut::<8>().0.iter_mut();
            sums.for_each(|sum| {
                if let Some(field) = fields.next() {
                    *field = sum.to_le_bytes();
                }
            });
            bytes
        };
        out(&bytes)
    }

    /// Reads a row that [`IntegerRow::write`] wrote.
    pub(in crate::imaging) fn read<E>(
        layout: RowLayout,
        mut from: impl FnMut(&mut [u8]) -> Result<(), E>,
    ) -> Result<Self, E> {
        let mut bound = [0; 8];
        from(&mut bound)?;
        let mut row = Self::default();
        let bound = u64::from_le_bytes(bound);
        if bound == 0 {
            return Ok(row);
        }
        let width = if bound < NARROW_BOUND { 4 } else { 8 };
        let mut bytes = vec![0; width * layout.points() * layout.parts];
        from(&mut bytes)?;
        row.make_room(bound, Direction::In, layout.len());
        let start = |part| part * layout.stride;
        let indices = (0..layout.parts).flat_map(|part| start(part)..start(part) + layout.points());
        match &mut row.integers {
            Integers::None => {}
            Integers::Narrow(sums) => {
                indices.zip(bytes.as_chunks::<4>().0).for_each(|(at, b)| sums[at] = i32::from_le_bytes(*b));
            }
            Integers::Wide(sums) => {
                indices.zip(bytes.as_chunks::<8>().0).for_each(|(at, b)| sums[at] = i64::from_le_bytes(*b));
            }
        }
        Ok(row)
    }

    /// Writes the sums times `quantum` to a row of the same layout.
    pub(in crate::imaging) fn write_values(&self, layout: RowLayout, quantum: f64, out: &mut [f32]) {
        let Some(mut sums) = self.folded(layout) else { return };
        for out in out.chunks_exact_mut(layout.stride) {
            for (out, sum) in out[..layout.points()].iter_mut().zip(&mut sums) {
                *out = (sum as f64 * quantum) as f32;
            }
        }
    }
}
