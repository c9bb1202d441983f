//! Which packets of a kind have been taken, for good.

use std::collections::BTreeMap;
use std::ops::Range;

use bincode::{Decode, Encode};

use crate::downlink::wire::{COUNT_MAX, CucTime};

/// The packets of one kind that have been taken: an exact set of counts and the times at which they were made, whatever
/// the order in which they came, in memory that grows with the number of those times and of gaps.
///
/// Counts of 46 bits never wrap. After a restart of the spacecraft they begin anew, which packets' times tell: two
/// packets of one count that were made at different times are two packets, of two eras.
#[derive(Clone, Debug, Default, PartialEq, Eq, Encode, Decode)]
pub struct Taken {
    /// Stretches of counts made at one time: time and beginning, and end (one beyond the last).
    stretches: BTreeMap<(CucTime, u64), u64>,
}

/// The counts between two times at which the spacecraft began to count anew, as far as packets have come.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Era {
    /// Time of its first packet that came.
    pub from: CucTime,
    /// Counts that are missing: between packets that came, and from 0 to the first.
    pub missing: Vec<Range<u64>>,
    /// One beyond the last count that came. What was sent behind it, before the next era, is not known.
    pub end: u64,
}

impl Taken {
    /// Takes a packet; whether it was not there before.
    pub fn take(&mut self, count: u64, time: CucTime) -> bool {
        if self.contains(count, time) {
            return false;
        }
        self.insert(time, count, count + 1);
        true
    }

    /// Takes a packet out again.
    pub fn forget(&mut self, count: u64, time: CucTime) {
        let Some((start, end)) = self.stretch_of(count, time) else { return };
        self.stretches.remove(&(time, start));
        for (from, to) in [(start, count), (count + 1, end)] {
            if from < to {
                self.stretches.insert((time, from), to);
            }
        }
    }

    /// Whether a packet is among them.
    #[must_use]
    pub fn contains(&self, count: u64, time: CucTime) -> bool {
        self.stretch_of(count, time).is_some()
    }

    /// Takes what another set has too.
    pub fn absorb(&mut self, other: &Self) {
        for (&(time, start), &end) in &other.stretches {
            self.insert(time, start, end);
        }
    }

    /// Whether it is as taking packets makes it, which one that was read need not be: stretches of counts that packets
    /// have, apart.
    pub(crate) fn is_sound(&self) -> bool {
        let before = std::iter::once(None).chain(self.stretches.iter().map(Some));
        before.zip(&self.stretches).all(|(before, (&(time, start), &end))| {
            let apart = before.is_none_or(|(&(at, _), &until)| at != time || until < start);
            apart && start < end && end <= COUNT_MAX + 1
        })
    }

    /// Number of packets.
    #[must_use]
    pub fn len(&self) -> u64 {
        // A forged set may have 2^46 packets at each of many times.
        self.stretches.iter().fold(0, |sum: u64, ((_, start), end)| sum.saturating_add(end - start))
    }

    /// Whether none has been taken.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.stretches.is_empty()
    }

    /// What has come between one restart and the next: counts that go back with time are of another era.
    #[must_use]
    pub fn eras(&self) -> Vec<Era> {
        let mut eras: Vec<Era> = Vec::new();
        for (&(time, start), &end) in &self.stretches {
            if eras.last().is_none_or(|era| start < era.end) {
                eras.push(Era { from: time, ..Era::default() });
            }
            let Some(era) = eras.last_mut() else { continue };
            if era.end < start {
                era.missing.push(era.end..start);
            }
            era.end = end;
        }
        eras
    }

    /// Times that the spacecraft has begun to count anew, as far as packets have come.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        let mut end = 0;
        let goes_back = |(&(_, start), &to): (&(CucTime, u64), &u64)| start < std::mem::replace(&mut end, to);
        self.stretches.iter().map(goes_back).filter(|goes_back| *goes_back).count() as u64
    }

    /// Forgets the packets that were made first until no more than so many stretches are left.
    pub(crate) fn forget_oldest(&mut self, stretches_max: usize) {
        while self.stretches.len() > stretches_max {
            self.stretches.pop_first();
        }
    }

    /// Beginning and end of the stretch that a packet lies in.
    fn stretch_of(&self, count: u64, time: CucTime) -> Option<(u64, u64)> {
        let (&(at, start), &end) = self.stretches.range(..=(time, count)).next_back()?;
        (at == time && count < end).then_some((start, end))
    }

    /// Adds a stretch, joined with those of its time that it meets.
    fn insert(&mut self, time: CucTime, mut start: u64, mut end: u64) {
        while let Some((&(at, from), &to)) = self.stretches.range(..=(time, end)).next_back() {
            if at != time || to < start {
                break;
            }
            self.stretches.remove(&(at, from));
            (start, end) = (start.min(from), end.max(to));
        }
        self.stretches.insert((time, start), end);
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

    fn missing(taken: &Taken) -> Vec<Vec<u64>> {
        taken.eras().into_iter().map(|era| era.missing.into_iter().flatten().collect()).collect()
    }

    proptest! {
        #[test]
        fn it_is_a_set_whatever_the_order(
            packets in proptest::collection::vec((0..60_u64, 0..2_u64), 1..150),
            out in 0..60_u64,
        ) {
            // Two packets made at each instant, as those of a pass are; and once more after a restart.
            let made = |(count, era): (u64, u64)| at(count / 2 + 40 * era);
            let (mut taken, mut expected) = (Taken::default(), BTreeSet::new());
            for &(count, era) in &packets {
                prop_assert_eq!(taken.take(count, made((count, era))), expected.insert((era, count)));
            }
            prop_assert_eq!(taken.len(), expected.len() as u64);
            let mut sorted = Taken::default();
            for &(era, count) in &expected {
                sorted.take(count, made((count, era)));
            }
            prop_assert_eq!(&sorted, &taken);
            let of_era = |era: u64| expected.iter().filter(|(of, _)| *of == era).map(|(_, count)| *count).collect();
            let eras: [Vec<u64>; 2] = [of_era(0), of_era(1)];
            let is_restart = matches!((eras[0].last(), eras[1].first()), (Some(last), Some(first)) if first <= last);
            prop_assert_eq!(taken.restarts(), u64::from(is_restart));
            prop_assert_eq!(taken.eras().len(), 1 + usize::from(is_restart));
            let absent: Vec<Vec<u64>> = match is_restart {
                true => eras.iter().map(|era| (0..era[era.len() - 1]).filter(|c| !era.contains(c)).collect()).collect(),
                // One era as far as anyone knows.
                false => {
                    let all = eras.concat();
                    vec![(0..all[all.len() - 1]).filter(|count| !all.contains(count)).collect()]
                }
            };
            prop_assert_eq!(missing(&taken), absent);
            taken.forget(out, made((out, 0)));
            expected.remove(&(0, out));
            prop_assert_eq!(taken.len(), expected.len() as u64);
            prop_assert!(taken.take(out, made((out, 0))));
        }

        #[test]
        fn two_sets_make_one(both in proptest::collection::vec((0..60_u64, 0..3_u8), 0..80)) {
            let mut sets = [Taken::default(), Taken::default(), Taken::default()];
            for (count, whose) in both {
                // Counts from 40 on are of another era, counted from 0.
                let (count, time) = if count < 40 { (count, at(count / 3)) } else { (count - 40, at(count)) };
                for (k, set) in sets.iter_mut().enumerate() {
                    if k == 2 || whose == 2 || usize::from(whose) == k {
                        set.take(count, time);
                    }
                }
            }
            let [ours, theirs, together] = sets;
            for (mut one, other) in [(ours.clone(), &theirs), (theirs.clone(), &ours)] {
                one.absorb(other);
                prop_assert_eq!(&one, &together);
                prop_assert!(one.is_sound());
            }
        }
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
            let stretches = stretches.iter().map(|&(start, end)| ((at(1), start), end)).collect();
            Taken { stretches }.is_sound()
        };
        assert!(forged(&[(1, 2), (3, 9)]));
        // Nothing in it, backwards, overlapping, touching, and beyond all counts.
        for bad in [&[(4, 4)][..], &[(4, 3)], &[(1, 5), (4, 9)], &[(1, 5), (5, 9)], &[(7, u64::MAX)]] {
            assert!(!forged(bad), "{bad:?}");
        }
    }

    #[test]
    fn a_count_made_at_another_time_is_another_packet() {
        let mut taken = Taken::default();
        // What was sent after a restart comes first, then what was sent before it.
        assert!(taken.take(0, at(8)) && taken.take(2, at(9)));
        assert!(taken.take(0, at(1)) && taken.take(2, at(2)) && taken.take(7, at(3)));
        assert!(!taken.take(2, at(2)) && !taken.take(2, at(9)));
        assert_eq!(missing(&taken), [vec![1, 3, 4, 5, 6], vec![1]]);
        let [before, after] = taken.eras().try_into().unwrap();
        assert_eq!([(before.from, before.end), (after.from, after.end)], [(at(1), 8), (at(8), 3)]);
        assert_eq!(taken.restarts(), 1);
    }
}
