//! The packets of one kind received over all files and sessions.

use std::collections::BTreeMap;
use std::ops::Range;

use bincode::de::Decoder;
use bincode::enc::Encoder;
use bincode::error::{DecodeError, EncodeError};
use bincode::{Decode, Encode};

use crate::downlink::wire::{COUNT_MAX, CucTime};
use crate::units::IntervalSet;

/// The received set of one kind: packets by count and creation time, in any order of arrival. Memory grows with the
/// number of distinct times and of gaps.
///
/// Counts of 46 bits never wrap. They restart with the spacecraft, which the packets' times reveal: two packets with
/// the same count and different times are two packets, of two eras.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Taken {
    /// Intervals of counts with the same time: `(time, first)..(time, last + 1)`.
    packets: IntervalSet<(CucTime, u64)>,
}

/// The counts received between two restarts of the spacecraft's count.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Era {
    /// Time of its first packet received.
    pub from: CucTime,
    /// Missing counts: between packets received, and from 0 to the first.
    pub missing: Vec<Range<u64>>,
    /// One beyond the last count received. Packets sent after it, before the next era, are unknown.
    pub end: u64,
}

impl Taken {
    /// Adds a packet. Returns whether it is new.
    pub fn take(&mut self, count: u64, time: CucTime) -> bool {
        if self.contains(count, time) {
            return false;
        }
        self.packets.insert((time, count)..(time, count + 1));
        true
    }

    /// Removes a packet.
    pub fn forget(&mut self, count: u64, time: CucTime) {
        self.packets.remove((time, count)..(time, count + 1));
    }

    /// Whether a packet is in the set.
    #[must_use]
    pub fn contains(&self, count: u64, time: CucTime) -> bool {
        self.packets.contains((time, count))
    }

    /// Adds all packets of another set.
    pub fn absorb(&mut self, other: &Self) {
        other.packets.iter().for_each(|interval| self.packets.insert(interval));
    }

    /// Whether a decoded set is valid: disjoint intervals of possible counts.
    pub(crate) fn is_sound(&self) -> bool {
        self.packets.is_normalised() && self.packets.iter().all(|Range { end, .. }| end.1 <= COUNT_MAX + 1)
    }

    /// Number of packets.
    #[must_use]
    pub fn len(&self) -> u64 {
        // A forged set may have 2^46 packets at each of many times.
        self.packets.iter().fold(0, |sum: u64, Range { start, end }| sum.saturating_add(end.1 - start.1))
    }

    /// Whether the set is empty.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.packets.is_empty()
    }

    /// The eras, by time: where counts decrease with time, a new one begins.
    #[must_use]
    pub fn eras(&self) -> Vec<Era> {
        let mut eras: Vec<Era> = Vec::new();
        for Range { start: (time, start), end: (_, end) } in self.packets.iter() {
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

    /// Number of restarts among the packets received.
    #[must_use]
    pub fn restarts(&self) -> u64 {
        let mut end = 0;
        let decreases = |of: Range<(CucTime, u64)>| of.start.1 < std::mem::replace(&mut end, of.end.1);
        self.packets.iter().map(decreases).filter(|decreases| *decreases).count() as u64
    }

    /// Drops the packets with the earliest times until at most `intervals_max` intervals are left.
    pub(super) fn forget_oldest(&mut self, intervals_max: usize) {
        self.packets.drop_lowest(intervals_max);
    }
}

/// Stored as a map from (time, first count) to the count after the last.
impl Encode for Taken {
    fn encode<E: Encoder>(&self, encoder: &mut E) -> Result<(), EncodeError> {
        (self.packets.intervals() as u64).encode(encoder)?;
        self.packets.iter().try_for_each(|Range { start, end }| (start, end.1).encode(encoder))
    }
}

impl<C> Decode<C> for Taken {
    fn decode<D: Decoder<Context = C>>(decoder: &mut D) -> Result<Self, DecodeError> {
        let ends: BTreeMap<(CucTime, u64), u64> = Decode::decode(decoder)?;
        let ends = ends.into_iter().map(|((time, start), end)| ((time, start), (time, end)));
        Ok(Self { packets: IntervalSet::from_map(ends.collect()) })
    }
}

bincode::impl_borrow_decode!(Taken);

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
    fn forged_intervals_are_not_sound() {
        let mut taken = Taken::default();
        for (count, s) in [(3, 1), (4, 1), (9, 2), (COUNT_MAX, 3), (2, 7)] {
            taken.take(count, at(s));
        }
        assert!(taken.is_sound() && Taken::default().is_sound());
        taken.forget(3, at(1));
        assert!(taken.is_sound());
        let forged = |intervals: &[(u64, u64)]| {
            let ends = intervals.iter().map(|&(start, end)| ((at(1), start), (at(1), end)));
            Taken { packets: IntervalSet::from_map(ends.collect()) }.is_sound()
        };
        assert!(forged(&[(1, 2), (3, 9)]));
        // Nothing in it, backwards, overlapping, touching, and beyond all counts.
        for bad in [&[(4, 4)][..], &[(4, 3)], &[(1, 5), (4, 9)], &[(1, 5), (5, 9)], &[(7, u64::MAX)]] {
            assert!(!forged(bad), "{bad:?}");
        }
    }

    #[test]
    fn it_is_stored_as_a_map() {
        let mut taken = Taken::default();
        for (count, s) in [(3, 1), (4, 1), (9, 2), (2, 7)] {
            assert!(taken.take(count, at(s)));
        }
        let map = BTreeMap::from([((at(1), 3_u64), 5_u64), ((at(2), 9), 10), ((at(7), 2), 3)]);
        let config = bincode::config::standard();
        let bytes = bincode::encode_to_vec(&taken, config).unwrap();
        assert_eq!(bytes, bincode::encode_to_vec(map, config).unwrap());
        assert_eq!(bincode::decode_from_slice(&bytes, config).unwrap(), (taken, bytes.len()));
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
