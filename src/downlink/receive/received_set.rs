//! The set of packets of a kind that have been received.

use std::collections::BTreeMap;
use std::ops::Range;

use crate::downlink::wire::CucTime;

/// The packets of one kind that have been received: an exact set of counts and creation times. Memory grows with the
/// number of those times and of gaps.
///
/// Counts of 46 bits never wrap. After a restart of the spacecraft they begin again at 0: two packets of the same count
/// and different creation times are two packets, of two eras.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ReceivedSet {
    /// Runs of counts made at one time: time and beginning, and end (one beyond the last).
    runs: BTreeMap<(CucTime, u64), u64>,
}

/// The counts between two restarts of the spacecraft, as far as packets were received.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Era {
    /// Time of its first packet.
    pub from: CucTime,
    /// Missing counts: between packets that were received, and from 0 to the first.
    pub missing: Vec<Range<u64>>,
    /// One beyond the last count. What was sent after it, before the next era, is not known.
    pub end: u64,
}

impl ReceivedSet {
    /// Inserts a packet; returns whether it is new.
    pub fn insert(&mut self, count: u64, time: CucTime) -> bool {
        if self.contains(count, time) {
            return false;
        }
        self.insert_run(time, count, count + 1);
        true
    }

    /// Removes a packet.
    pub fn remove(&mut self, count: u64, time: CucTime) {
        let Some((start, end)) = self.run_of(count, time) else { return };
        self.runs.remove(&(time, start));
        for (from, to) in [(start, count), (count + 1, end)] {
            if from < to {
                self.runs.insert((time, from), to);
            }
        }
    }

    /// Whether a packet is among them.
    #[must_use]
    pub fn contains(&self, count: u64, time: CucTime) -> bool {
        self.run_of(count, time).is_some()
    }

    /// Number of packets.
    #[must_use]
    pub fn len(&self) -> u64 {
        self.runs.iter().map(|((_, start), end)| end - start).sum()
    }

    /// Whether it is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.runs.is_empty()
    }

    /// What was received between one restart and the next: a count that is lower at a later time starts another era.
    #[must_use]
    pub fn eras(&self) -> Vec<Era> {
        let mut eras: Vec<Era> = Vec::new();
        for (&(time, start), &end) in &self.runs {
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

    /// Restarts of the spacecraft, as far as packets show.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        let mut end = 0;
        let goes_back = |(&(_, start), &to): (&(CucTime, u64), &u64)| start < std::mem::replace(&mut end, to);
        self.runs.iter().map(goes_back).filter(|goes_back| *goes_back).count() as u64
    }

    /// Removes the earliest packets until at most `runs_max` runs are left.
    pub(crate) fn remove_oldest(&mut self, runs_max: usize) {
        while self.runs.len() > runs_max {
            self.runs.pop_first();
        }
    }

    /// Beginning and end of the run that a packet lies in.
    fn run_of(&self, count: u64, time: CucTime) -> Option<(u64, u64)> {
        let (&(at, start), &end) = self.runs.range(..=(time, count)).next_back()?;
        (at == time && count < end).then_some((start, end))
    }

    /// Inserts a run, joined with those of its time that it meets.
    fn insert_run(&mut self, time: CucTime, mut start: u64, mut end: u64) {
        while let Some((&(at, from), &to)) = self.runs.range(..=(time, end)).next_back() {
            if at != time || to < start {
                break;
            }
            self.runs.remove(&(at, from));
            (start, end) = (start.min(from), end.max(to));
        }
        self.runs.insert((time, start), end);
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

    fn missing(received: &ReceivedSet) -> Vec<Vec<u64>> {
        received.eras().into_iter().map(|era| era.missing.into_iter().flatten().collect()).collect()
    }

    proptest! {
        #[test]
        fn it_is_a_set_whatever_the_order(
            packets in proptest::collection::vec((0..60_u64, 0..2_u64), 1..150),
            out in 0..60_u64,
        ) {
            // Two packets made at each instant, as those of a pass are; and once more after a restart.
            let made = |(count, era): (u64, u64)| at(count / 2 + 40 * era);
            let (mut received, mut expected) = (ReceivedSet::default(), BTreeSet::new());
            for &(count, era) in &packets {
                prop_assert_eq!(received.insert(count, made((count, era))), expected.insert((era, count)));
            }
            prop_assert_eq!(received.len(), expected.len() as u64);
            let mut sorted = ReceivedSet::default();
            for &(era, count) in &expected {
                sorted.insert(count, made((count, era)));
            }
            prop_assert_eq!(&sorted, &received);
            let of_era = |era: u64| expected.iter().filter(|(of, _)| *of == era).map(|(_, count)| *count).collect();
            let eras: [Vec<u64>; 2] = [of_era(0), of_era(1)];
            let is_restart = matches!((eras[0].last(), eras[1].first()), (Some(last), Some(first)) if first <= last);
            prop_assert_eq!(received.restarts(), u64::from(is_restart));
            prop_assert_eq!(received.eras().len(), 1 + usize::from(is_restart));
            let absent: Vec<Vec<u64>> = match is_restart {
                true => eras.iter().map(|era| (0..era[era.len() - 1]).filter(|c| !era.contains(c)).collect()).collect(),
                // One era as far as anyone knows.
                false => {
                    let all = eras.concat();
                    vec![(0..all[all.len() - 1]).filter(|count| !all.contains(count)).collect()]
                }
            };
            prop_assert_eq!(missing(&received), absent);
            received.remove(out, made((out, 0)));
            expected.remove(&(0, out));
            prop_assert_eq!(received.len(), expected.len() as u64);
            prop_assert!(received.insert(out, made((out, 0))));
        }
    }

    #[test]
    fn a_count_made_at_another_time_is_another_packet() {
        let mut received = ReceivedSet::default();
        // What was sent after a restart comes first, then what was sent before it.
        assert!(received.insert(0, at(8)) && received.insert(2, at(9)));
        assert!(received.insert(0, at(1)) && received.insert(2, at(2)) && received.insert(7, at(3)));
        assert!(!received.insert(2, at(2)) && !received.insert(2, at(9)));
        assert_eq!(missing(&received), [vec![1, 3, 4, 5, 6], vec![1]]);
        let [before, after] = received.eras().try_into().unwrap();
        assert_eq!([(before.from, before.end), (after.from, after.end)], [(at(1), 8), (at(8), 3)]);
        assert_eq!(received.restarts(), 1);
    }
}
