//! Rows of integers that take 32 bits each while that is enough.
//!
//! The integers of a row take 32 bits while the greatest terms of everything that was added to it could not sum to
//! more, else 64. That bound is a sum of integers too, so it does not depend on the order either.

use super::Direction;

/// Bounds below this hold in 32 bits.
const NARROW: u64 = 1 << 31;

/// How a row is laid out: parts behind one another, each with an overhang that folds back to its start.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::imaging) struct RowLayout {
    /// Integers of a part, its overhang included.
    pub(in crate::imaging) stride: usize,
    /// Number of parts.
    pub(in crate::imaging) parts: usize,
    /// Integers beyond the end of a part.
    pub(in crate::imaging) overhang: usize,
}

impl RowLayout {
    /// Integers of a row.
    pub(in crate::imaging) fn len(self) -> usize {
        self.stride * self.parts
    }

    /// Integers of a part without its overhang.
    pub(in crate::imaging) fn points(self) -> usize {
        self.stride - self.overhang
    }
}

/// The integers of a row; none if nothing was ever added.
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
    /// No sum is greater than this, in quanta.
    bound: u64,
    pub(in crate::imaging) integers: Integers,
}

impl IntegerRow {
    /// Makes room for terms of together at most `most` quanta in each of `len` sums.
    #[inline(always)]
    pub(in crate::imaging) fn make_room(&mut self, most: u64, direction: Direction, len: usize) {
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

    /// Adds another row, or removes it.
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

    /// Whether the row holds nothing.
    pub(in crate::imaging) fn is_empty(&self) -> bool {
        self.bound == 0
    }

    /// The sums of each part, its overhang folded back to its start; `None` if the row holds nothing.
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

    /// Writes bound and sums; sums that fit 32 bits by the bound take no more.
    pub(in crate::imaging) fn write<E>(
        &self,
        layout: RowLayout,
        mut out: impl FnMut(&[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        out(&self.bound.to_le_bytes())?;
        let Some(sums) = self.folded(layout) else { return Ok(()) };
        // In place and by `for_each`: a gigabyte of these is what an interrupted run waits for.
        let count = layout.points() * layout.parts;
        let bytes = if self.bound < NARROW {
            let mut bytes = vec![0; 4 * count];
            let mut places = bytes.as_chunks_mut::<4>().0.iter_mut();
            sums.for_each(|sum| {
                if let Some(place) = places.next() {
                    *place = (sum as i32).to_le_bytes();
                }
            });
            bytes
        } else {
            let mut bytes = vec![0; 8 * count];
            let mut places = bytes.as_chunks_mut::<8>().0.iter_mut();
            sums.for_each(|sum| {
                if let Some(place) = places.next() {
                    *place = sum.to_le_bytes();
                }
            });
            bytes
        };
        out(&bytes)
    }

    /// Reads what [`IntegerRow::write`] wrote.
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
        let width = if bound < NARROW { 4 } else { 8 };
        let mut bytes = vec![0; width * layout.points() * layout.parts];
        from(&mut bytes)?;
        row.make_room(bound, Direction::In, layout.len());
        let start = |part| part * layout.stride;
        let places = (0..layout.parts).flat_map(|part| start(part)..start(part) + layout.points());
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
    pub(in crate::imaging) fn values(&self, layout: RowLayout, quantum: f64, out: &mut [f32]) {
        let Some(mut sums) = self.folded(layout) else { return };
        for out in out.chunks_exact_mut(layout.stride) {
            for (out, sum) in out[..layout.points()].iter_mut().zip(&mut sums) {
                *out = (sum as f64 * quantum) as f32;
            }
        }
    }
}
