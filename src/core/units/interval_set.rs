//! Sets of half-open intervals.

use std::collections::BTreeMap;
use std::ops::Range;

/// A set of values, held as disjoint half-open intervals `start..end`. Intervals that overlap or touch are merged.
///
/// Lookup, insertion and removal take a time that grows as the logarithm of the number of intervals, plus that of the intervals they merge
/// or remove. Memory depends on that number only; [`IntervalSet::insert_bridging`] and [`IntervalSet::drop_lowest`] bound it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IntervalSet<T> {
    /// End of each interval by its start.
    ends: BTreeMap<T, T>,
}

impl<T> Default for IntervalSet<T> {
    fn default() -> Self {
        Self { ends: BTreeMap::new() }
    }
}

impl<T: Copy + Ord> IntervalSet<T> {
    /// Adds an interval.
    pub fn insert(&mut self, interval: Range<T>) {
        let Range { start, end } = self.take_merged(interval);
        if start < end {
            self.ends.insert(start, end);
        }
    }

    /// Adds an interval unless the set would then have more than `intervals_max`; in that case the next lower interval is extended over the
    /// gap instead. If there is no lower one, nothing is added.
    pub fn insert_bridging(&mut self, interval: Range<T>, intervals_max: usize) {
        let Range { start, end } = self.take_merged(interval);
        if start >= end {
            return;
        }
        if self.ends.len() < intervals_max {
            self.ends.insert(start, end);
        } else if let Some((_, end_below)) = self.ends.range_mut(..start).next_back() {
            *end_below = end;
        }
    }

    /// Removes all values of an interval from the set.
    pub fn remove(&mut self, interval: Range<T>) {
        if interval.is_empty() {
            return;
        }
        while let Some((&start, &end)) = self.ends.range(..interval.end).next_back() {
            if end <= interval.start {
                return;
            }
            self.ends.remove(&start);
            if start < interval.start {
                self.ends.insert(start, interval.start);
            }
            if interval.end < end {
                self.ends.insert(interval.end, end);
            }
        }
    }

    /// Removes everything.
    pub fn clear(&mut self) {
        self.ends.clear();
    }

    /// Removes the lowest intervals until at most `intervals_max` are left.
    pub fn drop_lowest(&mut self, intervals_max: usize) {
        while self.ends.len() > intervals_max {
            self.ends.pop_first();
        }
    }

    /// Whether the set holds a value.
    #[must_use]
    pub fn contains(&self, value: T) -> bool {
        self.ends.range(..=value).next_back().is_some_and(|(_, end)| value < *end)
    }

    /// Number of intervals.
    #[must_use]
    pub fn intervals(&self) -> usize {
        self.ends.len()
    }

    /// Whether the set is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// The intervals in increasing order.
    pub fn iter(&self) -> impl Iterator<Item = Range<T>> + '_ {
        self.ends.iter().map(|(start, end)| *start..*end)
    }

    /// The lowest interval.
    #[must_use]
    pub fn lowest(&self) -> Option<Range<T>> {
        self.ends.first_key_value().map(|(start, end)| *start..*end)
    }

    /// The highest interval.
    #[must_use]
    pub fn highest(&self) -> Option<Range<T>> {
        self.ends.last_key_value().map(|(start, end)| *start..*end)
    }

    /// Removes all intervals that overlap or touch the given one, and returns their union with it.
    fn take_merged(&mut self, Range { mut start, mut end }: Range<T>) -> Range<T> {
        if start >= end {
            return start..end;
        }
        while let Some((&from, &to)) = self.ends.range(..=end).next_back() {
            if to < start {
                break;
            }
            self.ends.remove(&from);
            (start, end) = (start.min(from), end.max(to));
        }
        start..end
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn set_of(intervals: &[(i64, i64)]) -> IntervalSet<i64> {
        let mut set = IntervalSet::default();
        intervals.iter().for_each(|(start, end)| set.insert(*start..*end));
        set
    }

    #[test]
    fn intervals_that_overlap_or_touch_are_merged() {
        let set = set_of(&[(0, 11), (20, 31), (50, 61), (11, 16), (18, 21), (55, 58), (29, 53), (7, 7)]);
        assert_eq!(set.iter().collect::<Vec<_>>(), [0..16, 18..61]);
    }

    #[test]
    fn a_full_set_bridges_the_gap_below_a_new_interval() {
        let mut set = set_of(&[(10, 20), (30, 40)]);
        set.insert_bridging(15..25, 2);
        assert_eq!(set.iter().collect::<Vec<_>>(), [10..25, 30..40]);
        set.insert_bridging(50..60, 2);
        assert_eq!(set.iter().collect::<Vec<_>>(), [10..25, 30..60]);
        // There is no lower interval to extend.
        set.insert_bridging(0..5, 2);
        assert_eq!(set.iter().collect::<Vec<_>>(), [10..25, 30..60]);
    }

    #[test]
    fn the_lowest_intervals_are_dropped_first() {
        let mut set = set_of(&[(0, 1), (2, 3), (4, 5)]);
        set.drop_lowest(1);
        assert!(set.iter().eq(std::iter::once(4..5)));
    }

    /// Whether the intervals are in order, not empty, and neither overlap nor touch.
    fn is_normalised(set: &IntervalSet<i64>) -> bool {
        let intervals: Vec<_> = set.iter().collect();
        intervals.iter().all(|interval| interval.start < interval.end)
            && intervals.windows(2).all(|pair| pair[0].end < pair[1].start)
    }

    proptest! {
        #[test]
        fn it_agrees_with_a_set_of_single_values(
            steps in proptest::collection::vec((any::<bool>(), 0..50_i64, 0..12_i64), 1..60),
        ) {
            let (mut set, mut expected) = (IntervalSet::default(), BTreeSet::new());
            for (adds, start, length) in steps {
                let interval = start..start + length;
                if adds {
                    set.insert(interval.clone());
                    expected.extend(interval);
                } else {
                    set.remove(interval.clone());
                    expected.retain(|value| !interval.contains(value));
                }
                prop_assert!(is_normalised(&set));
                prop_assert_eq!(set.iter().flatten().collect::<BTreeSet<_>>(), expected.clone());
                prop_assert!((-1..70).all(|value| set.contains(value) == expected.contains(&value)));
                prop_assert_eq!(set.is_empty(), expected.is_empty());
            }
        }
    }
}
