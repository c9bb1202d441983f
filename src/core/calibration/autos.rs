//! Table of the daughters' auto-correlations, each once, in any order.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use bincode::{Decode, Encode};

use crate::frames::{AutoPower, Instrument, PlacedVisibilities};
use crate::units::{ChannelId, MissionTime, Pair};

/// Capacity of a table. It takes 130 MB of memory and 60 MB of a checkpoint, and holds more than two hours of 30
/// channels at one integration per second.
pub const AUTOS_MAX: usize = 2_000_000;

/// Half ticks per second: middles of integrations are whole numbers of half ticks.
const HALF_TICKS_PER_SECOND: f64 = 2e6;

/// Channel, daughter, and the middle of the integration in half ticks.
type AutoKey = (ChannelId, u8, i64);

/// A calibrated power and the standard deviation of its noise, K sr.
type Power = [f64; 2];

/// Number of auto-correlations of a block that were inserted or not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct AutoInsertion {
    pub(super) kept: u64,
    /// Not inserted: the integration is in the table already.
    pub(super) duplicates: u64,
    /// Not inserted: the table is full.
    pub(super) refused: u64,
}

/// Auto-correlations by channel, daughter and time: at most [`AUTOS_MAX`], more only after a merge.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct AutoTable {
    powers: BTreeMap<AutoKey, Power>,
}

impl AutoTable {
    /// Inserts auto-correlations of a daughter, up to `capacity` in the table.
    pub(super) fn insert(&mut self, placed: &PlacedVisibilities, capacity: usize) -> AutoInsertion {
        let mut insertion = AutoInsertion::default();
        for (key, power) in powers(placed) {
            let is_full = self.powers.len() >= capacity;
            match self.powers.entry(key) {
                Entry::Occupied(_) => insertion.duplicates += 1,
                Entry::Vacant(_) if is_full => insertion.refused += 1,
                Entry::Vacant(entry) => {
                    entry.insert(power);
                    insertion.kept += 1;
                }
            }
        }
        insertion
    }

    /// Removes entries equal to those of `placed`; returns their number.
    pub(super) fn remove(&mut self, placed: &PlacedVisibilities) -> u64 {
        let mut removed = 0;
        for (key, power) in powers(placed) {
            if self.powers.get(&key) == Some(&power) {
                self.powers.remove(&key);
                removed += 1;
            }
        }
        removed
    }

    /// Inserts the entries of another table; where both have an integration, the entry of `self` stays.
    pub fn merge(&mut self, other: Self) {
        for (key, power) in other.powers {
            self.powers.entry(key).or_insert(power);
        }
    }

    /// Powers of a daughter in one channel between two times, both included: middle of the integration, s, and power,
    /// K sr.
    pub fn between(
        &self,
        channel: ChannelId,
        daughter: u8,
        [from, to]: [MissionTime; 2],
    ) -> impl Iterator<Item = (f64, f64)> + '_ {
        let key = |time: MissionTime| (channel, daughter, time.0.saturating_mul(2));
        let powers = self.powers.range(key(from)..=key(to.max(from)));
        powers.map(|((.., half_ticks), [power_k_sr, _])| {
            (*half_ticks as f64 / HALF_TICKS_PER_SECOND, *power_k_sr)
        })
    }

    /// All powers, by channel, daughter and time.
    #[must_use]
    pub fn list(&self, instrument: &Instrument) -> Vec<AutoPower> {
        let power = |(&(channel, daughter, half_ticks), &[power_k_sr, sigma_k_sr]): (&AutoKey, &Power)| {
            let channel = instrument.channel_of(channel, Pair { i: daughter, j: daughter })?;
            Some(AutoPower {
                daughter,
                frequency_hz: channel.frequency_hz,
                width_hz: channel.width_hz,
                time_s: half_ticks as f64 / HALF_TICKS_PER_SECOND,
                power_k_sr,
                sigma_k_sr,
            })
        };
        self.powers.iter().filter_map(power).collect()
    }
}

fn powers(placed: &PlacedVisibilities) -> impl Iterator<Item = (AutoKey, Power)> {
    let Pair { i: daughter, .. } = placed.pair;
    (0..placed.len()).map(move |k| {
        // Times are exact to a hundredth of a half tick even after centuries.
        let half_ticks = (placed.time_s[k] * HALF_TICKS_PER_SECOND).round() as i64;
        let sigma_k_sr = placed.weight[k].sqrt().recip();
        ((placed.channel, daughter, half_ticks), [placed.value_k_sr[k].re, sigma_k_sr])
    })
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;
    use crate::frames::{AntennaResponse, Channel};

    fn auto_correlations(daughter: u8, times_s: &[f64], power_k_sr: f64) -> PlacedVisibilities {
        PlacedVisibilities {
            channel: ChannelId(1),
            pair: Pair { i: daughter, j: daughter },
            time_s: times_s.to_vec(),
            r_i_m: vec![[0.0; 3]; times_s.len()],
            r_j_m: vec![[0.0; 3]; times_s.len()],
            value_k_sr: vec![Complex64::new(power_k_sr, 0.0); times_s.len()],
            weight: vec![0.25; times_s.len()],
            ..PlacedVisibilities::default()
        }
    }

    #[test]
    fn each_power_is_inserted_once_and_others_are_counted() {
        let mut table = AutoTable::default();
        // Half a tick apart, far from the epoch.
        let first = auto_correlations(3, &[3e8, 3e8 + 0.5e-6, 3e8 + 1.0], 7.0);
        assert_eq!(table.insert(&first, 5), AutoInsertion { kept: 3, ..AutoInsertion::default() });
        assert_eq!(table.insert(&first, 5), AutoInsertion { duplicates: 3, ..AutoInsertion::default() });
        let other = auto_correlations(2, &[1.0, 2.0, 3e8], 8.0);
        assert_eq!(table.insert(&other, 5), AutoInsertion { kept: 2, refused: 1, duplicates: 0 });
        // A different power is not removed, nor one that was never inserted.
        assert_eq!(table.remove(&auto_correlations(3, &[3e8], 7.5)), 0);
        assert_eq!(table.remove(&other), 2);

        let mut both = AutoTable::default();
        let _ = both.insert(&auto_correlations(4, &[5.0], 9.0), 1);
        both.merge(table.clone());
        both.merge(table);
        let channel = |frequency_hz| Channel { frequency_hz, width_hz: 4e3 };
        let instrument = Instrument {
            name: "test".to_owned(),
            epoch_tai_s: 2e9,
            moon_radius_m: 1_737_100.0,
            satellites: 8,
            channels: vec![channel(1e6), channel(3e6)],
            response: AntennaResponse::Isotropic,
            seed: 7,
            configuration_hash: 1,
            spectrometer: None,
            noiseless: false,
        };
        let power = |daughter, time_s, power_k_sr| AutoPower {
            daughter,
            frequency_hz: 3e6,
            width_hz: 4e3,
            time_s,
            power_k_sr,
            sigma_k_sr: 2.0,
        };
        let expected =
            [power(3, 3e8, 7.0), power(3, 3e8 + 0.5e-6, 7.0), power(3, 3e8 + 1.0, 7.0), power(4, 5.0, 9.0)];
        assert_eq!(both.list(&instrument), expected);
    }
}
