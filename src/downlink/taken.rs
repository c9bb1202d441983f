//! Which packets of a kind have been taken, for good.

use std::collections::BTreeMap;
use std::ops::Range;

use bincode::{Decode, Encode};

use super::cuc::CucTime;
use super::header::COUNT_MAX;

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

    /// Takes what another set has too. Eras of the two are one if their times overlap, or if the counts of the later
    /// go on above those of the earlier; false, with nothing taken, if that would make one of two that are known apart.
    pub fn absorb(&mut self, other: &Self) -> bool {
        let ours = self.eras.iter().map(|era| (era, 0));
        let mut all: Vec<(&Era, usize)> = ours.chain(other.eras.iter().map(|era| (era, 1))).collect();
        all.retain(|(era, _)| !era.stretches.is_empty());
        all.sort_by_key(|(era, _)| era.from);
        // How many eras of either set are in each.
        let mut joined: Vec<(Era, [usize; 2])> = Vec::new();
        for (era, whose) in all {
            let first = era.stretches.keys().next().copied().unwrap_or_default();
            match joined.last_mut() {
                Some((last, of))
                    if era.from <= last.newest.1 || (of[whose] == 0 && first > last.newest.0) =>
                {
                    last.newest = last.newest.max(era.newest);
                    era.stretches.iter().for_each(|(&start, &end)| last.insert(start, end));
                    of[whose] += 1;
                }
                _ => joined.push((era.clone(), [1 - whose, whose])),
            }
        }
        let sound = joined.iter().all(|(_, of)| of.iter().all(|eras| *eras <= 1));
        if sound {
            self.eras = joined.into_iter().map(|(era, _)| era).collect();
        }
        sound
    }

    /// Whether it is as taking packets makes it, which one that was read need not be: stretches of counts that packets
    /// have, in order and apart.
    pub(super) fn is_sound(&self) -> bool {
        self.eras.iter().all(|era| {
            let ends = std::iter::once(None).chain(era.stretches.values().map(Some));
            let mut stretches = ends.zip(&era.stretches);
            era.newest.0 <= COUNT_MAX
                && stretches.all(|(before, (start, end))| {
                    before.is_none_or(|before| before < start) && start < end && *end <= COUNT_MAX + 1
                })
        })
    }

    /// Number of packets.
    #[must_use]
    pub fn len(&self) -> u64 {
        let stretches = self.eras.iter().flat_map(|era| &era.stretches);
        // A hostile stream makes eras of 2^46 packets, one a packet.
        stretches.fold(0, |sum: u64, (start, end)| sum.saturating_add(end - start))
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
            prop_assert!(theirs.is_empty() || theirs.contains(*counts[1].first().unwrap(), at(60)));
            prop_assert!(ours.absorb(&theirs));
            prop_assert_eq!(ours, together);
        }
    }

    #[test]
    fn eras_are_put_together_by_their_times() {
        // Counts 0..10 at 0..10 s; then anew, 0..8 at 20..28 s; each has heard some of them.
        let all: Vec<(u64, CucTime)> =
            (0..10).map(|k| (k, at(k))).chain((0..8).map(|k| (k, at(20 + k)))).collect();
        for heard in 0..1_u64 << 8 {
            let mut sets = [Taken::default(), Taken::default(), Taken::default()];
            for (k, &(count, time)) in all.iter().enumerate() {
                // A fixed pattern of who has heard what, another one each time; nobody misses the first two.
                let whose = if k < 2 || (10..12).contains(&k) { k as u64 } else { heard >> (k % 8) };
                sets[(whose % 2) as usize].take(count, time);
                sets[2].take(count, time);
            }
            let [ours, theirs, together] = sets;
            for (mut one, other) in [(ours.clone(), &theirs), (theirs.clone(), &ours)] {
                assert!(one.absorb(other), "{heard:b}");
                assert_eq!(one, together, "{heard:b}");
            }
        }
    }

    #[test]
    fn eras_that_one_knows_apart_are_not_made_one() {
        let (mut two, mut one) = (Taken::default(), Taken::default());
        for (count, s) in [(5, 1), (6, 2), (3, 8), (9, 9)] {
            two.take(count, at(s));
        }
        // Counted on, as far as this one knows, across the restart.
        one.take(7, at(3));
        one.take(8, at(9));
        let before = two.clone();
        assert!(!two.absorb(&one));
        assert_eq!(two, before);
    }

    #[test]
    fn forged_stretches_are_not_sound() {
        let mut taken = Taken::default();
        for (count, s) in [(3, 1), (4, 1), (9, 2), (COUNT_MAX, 3), (2, 7)] {
            taken.take(count, at(s));
        }
        assert!(taken.is_sound() && Taken::default().is_sound());
        taken.forget(3, at(1));
        assert!(taken.is_sound());
        let forged = |stretches: &[(u64, u64)]| {
            let stretches = stretches.iter().copied().collect();
            Taken { eras: vec![Era { stretches, ..Era::default() }] }.is_sound()
        };
        assert!(forged(&[(1, 2), (3, 9)]));
        // Nothing in it, backwards, overlapping, touching, and beyond all counts.
        for bad in [&[(4, 4)][..], &[(4, 3)], &[(1, 5), (4, 9)], &[(1, 5), (5, 9)], &[(7, u64::MAX)]] {
            assert!(!forged(bad), "{bad:?}");
        }
        let newest = (u64::MAX, at(1));
        assert!(!Taken { eras: vec![Era { newest, ..Era::default() }] }.is_sound());
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
