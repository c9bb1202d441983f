//! Which packets of a kind have been taken, for good.

use std::collections::BTreeMap;
use std::ops::Range;

use bincode::{Decode, Encode};

use super::cuc::CucTime;

/// The counts between two times at which the spacecraft began to count anew.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
struct Era {
    /// Time of its earliest packet that came.
    from: CucTime,
    /// Greatest count, and the time of that packet.
    newest: (u64, CucTime),
    /// Stretches of counts: beginning and end (one beyond the last).
    stretches: BTreeMap<u64, u64>,
}

impl Era {
    fn take(&mut self, count: u64, time: CucTime) -> bool {
        let before = self.stretches.range(..=count).next_back().map(|(&start, &end)| (start, end));
        if before.is_some_and(|(_, end)| end > count) {
            return false;
        }
        self.from = self.from.min(time);
        self.newest = self.newest.max((count, time));
        let start = before.filter(|(_, end)| *end == count).map_or(count, |(start, _)| start);
        let end = self.stretches.remove(&(count + 1)).unwrap_or(count + 1);
        self.stretches.insert(start, end);
        true
    }

    fn contains(&self, count: u64) -> bool {
        self.stretches.range(..=count).next_back().is_some_and(|(_, &end)| end > count)
    }

    /// Adds a stretch, joined with those that it meets.
    fn insert(&mut self, mut start: u64, mut end: u64) {
        while let Some((&from, &to)) = self.stretches.range(..=end).next_back() {
            if to < start {
                break;
            }
            self.stretches.remove(&from);
            (start, end) = (start.min(from), end.max(to));
        }
        self.stretches.insert(start, end);
    }

    fn forget(&mut self, count: u64) {
        let Some((&start, &end)) = self.stretches.range(..=count).next_back() else { return };
        if end <= count {
            return;
        }
        self.stretches.remove(&start);
        for (from, to) in [(start, count), (count + 1, end)] {
            if from < to {
                self.stretches.insert(from, to);
            }
        }
    }
}

/// The packets of one kind that have been taken: an exact set, whatever the order in which they came, in memory
/// that grows with the number of gaps alone.
///
/// Counts of 46 bits never wrap. After a restart of the spacecraft they begin anew, which packets' times tell: a count
/// that is not above the greatest, of a packet made later, is of another era. The packets of an era are told from
/// those of the one before by their time.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
pub struct Taken {
    eras: Vec<Era>,
}

impl Taken {
    /// Takes a packet; whether it was not there before.
    pub fn take(&mut self, count: u64, time: CucTime) -> bool {
        let at = self.era_of(count, time);
        self.eras[at].take(count, time)
    }

    /// Takes a packet out again.
    pub fn forget(&mut self, count: u64, time: CucTime) {
        if let Some(era) = self.eras.iter_mut().rev().find(|era| era.from <= time) {
            era.forget(count);
        }
    }

    /// Whether a packet is among them.
    #[must_use]
    pub fn contains(&self, count: u64, time: CucTime) -> bool {
        let era = self.eras.iter().rev().find(|era| era.from <= time);
        era.is_some_and(|era| era.contains(count))
    }

    /// Takes what another set has too, if both know one era at most; says whether they do.
    pub fn absorb(&mut self, other: &Self) -> bool {
        let (Some(theirs), []) = (other.eras.first(), other.eras.get(1..).unwrap_or_default()) else {
            return other.eras.is_empty();
        };
        match self.eras.as_mut_slice() {
            [] => self.eras.push(theirs.clone()),
            [era] => {
                era.from = era.from.min(theirs.from);
                era.newest = era.newest.max(theirs.newest);
                for (&start, &end) in &theirs.stretches {
                    era.insert(start, end);
                }
            }
            _ => return false,
        }
        true
    }

    /// The first count that both have, where both know one era at most.
    #[must_use]
    pub fn common(&self, other: &Self) -> Option<u64> {
        let (ours, theirs) = (self.eras.first()?, other.eras.first()?);
        let meets = |(&start, &end): (&u64, &u64)| {
            let from = ours.stretches.range(..=start).next_back().map_or(start, |(&start, _)| start);
            let common = ours.stretches.range(from..end).find(|(_, stretch)| **stretch > start);
            common.map(|(&first, _)| first.max(start))
        };
        theirs.stretches.iter().find_map(meets)
    }

    /// Number of packets.
    #[must_use]
    pub fn len(&self) -> u64 {
        self.eras.iter().flat_map(|era| &era.stretches).map(|(start, end)| end - start).sum()
    }

    /// Whether none has been taken.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Counts that are missing, era by era: between packets that came, and from the era's beginning to the first.
    #[must_use]
    pub fn missing(&self) -> Vec<Vec<Range<u64>>> {
        self.eras().into_iter().map(|(_, missing)| missing).collect()
    }

    /// [`Taken::missing`], with the time of the earliest packet of each era.
    #[must_use]
    pub fn eras(&self) -> Vec<(CucTime, Vec<Range<u64>>)> {
        let missing = |era: &Era| {
            let ends = std::iter::once(0).chain(era.stretches.values().copied());
            let gaps = ends.zip(era.stretches.keys()).map(|(end, &start)| end..start);
            (era.from, gaps.filter(|gap| !gap.is_empty()).collect())
        };
        self.eras.iter().map(missing).collect()
    }

    /// Place of the era of a packet, which is made if it is the first of it.
    fn era_of(&mut self, count: u64, time: CucTime) -> usize {
        let new = || Era { from: time, ..Era::default() };
        if self.eras.is_empty() {
            self.eras.push(new());
        }
        let at = self.eras.iter().rposition(|era| era.from <= time).unwrap_or(0);
        let (newest, made) = self.eras[at].newest;
        let known = !self.eras[at].stretches.is_empty();
        if known && count <= newest && time > made {
            let next = self.eras.get(at + 1).and_then(|era| era.stretches.keys().next());
            if next.is_none_or(|&first| count >= first) {
                self.eras.insert(at + 1, new());
            }
            return at + 1;
        }
        at
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    fn at(s: u64) -> CucTime {
        CucTime(s << 24)
    }

    proptest! {
        #[test]
        fn it_is_a_set_whatever_the_order(counts in proptest::collection::vec(0..60_u64, 1..150), out in 0..60_u64) {
            let (mut taken, mut expected) = (Taken::default(), BTreeSet::new());
            for &count in &counts {
                // Two packets made at each instant, as those of a pass are.
                prop_assert_eq!(taken.take(count, at(count / 2)), expected.insert(count));
            }
            prop_assert_eq!(taken.len(), expected.len() as u64);
            let last = expected.last().copied().unwrap();
            let missing: Vec<u64> = taken.missing().into_iter().flatten().flatten().collect();
            let absent: Vec<u64> = (0..last).filter(|count| !expected.contains(count)).collect();
            prop_assert_eq!(missing, absent);
            let mut sorted = Taken::default();
            for &count in &expected {
                sorted.take(count, at(count / 2));
            }
            prop_assert_eq!(&sorted, &taken);
            taken.forget(out, at(out / 2));
            expected.remove(&out);
            prop_assert_eq!(taken.len(), expected.len() as u64);
            prop_assert!(taken.take(out, at(out / 2)));
        }
    }

    proptest! {
        #[test]
        fn two_sets_make_one(both in proptest::collection::vec((0..60_u64, 0..3_u8), 0..80)) {
            let mut sets = [Taken::default(), Taken::default(), Taken::default()];
            let mut counts = [BTreeSet::new(), BTreeSet::new()];
            for (count, whose) in both {
                for (k, counts) in counts.iter_mut().enumerate() {
                    if whose == 2 || usize::from(whose) == k {
                        sets[k].take(count, at(count));
                        counts.insert(count);
                    }
                }
                sets[2].take(count, at(count));
            }
            let [mut ours, theirs, together] = sets;
            prop_assert_eq!(ours.common(&theirs), counts[0].intersection(&counts[1]).next().copied());
            prop_assert!(theirs.is_empty() || theirs.contains(*counts[1].first().unwrap(), at(60)));
            prop_assert!(ours.absorb(&theirs));
            prop_assert_eq!(ours, together);
        }
    }

    #[test]
    fn a_restart_begins_another_era() {
        let mut taken = Taken::default();
        assert!(taken.take(0, at(1)) && taken.take(9, at(5)));
        assert!(taken.take(3, at(8)), "made later, counted lower: after a restart");
        assert!(taken.take(1, at(7)) && taken.take(4, at(8)));
        assert!(!taken.take(3, at(8)) && !taken.take(9, at(5)) && !taken.take(1, at(7)));
        assert!(taken.take(8, at(5)), "late, of the first era");
        let missing: Vec<Vec<u64>> =
            taken.missing().into_iter().map(|era| era.into_iter().flatten().collect()).collect();
        assert_eq!(missing, [(1..8).collect(), vec![0, 2]]);
    }
}
