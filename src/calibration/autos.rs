//! The daughters' own powers, each once, whatever the order in which they came.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use bincode::{Decode, Encode};

use crate::frames::{AutoPower, Instrument, PlacedVisibilities};
use crate::units::{ChannelId, Pair};

/// Most powers that are taken: 130 MB of memory and 60 MB of a checkpoint, more than two hours of every second of 30
/// channels.
pub const AUTOS_MAX: usize = 2_000_000;

/// Half ticks in a second: middles of integrations are whole numbers of them.
const HALF_TICKS_A_SECOND: f64 = 2e6;

/// Where, whose, and the middle of the integration in halves of ticks.
type Key = (ChannelId, u8, i64);

/// A calibrated power and the standard deviation of its noise, K sr.
type Power = [f64; 2];

/// What has become of some powers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Account {
    pub(super) kept: u64,
    /// Of an integration that is in the table already.
    pub(super) twice: u64,
    /// More than the table takes.
    pub(super) beyond: u64,
}

/// Powers by channel, daughter and time. It takes two million; tables that are put together keep what both have.
#[derive(Clone, Debug, Default, PartialEq, Encode, Decode)]
pub struct AutoTable {
    powers: BTreeMap<Key, Power>,
}

impl AutoTable {
    /// Takes powers of a daughter.
    pub(super) fn take(&mut self, placed: &PlacedVisibilities, most: usize) -> Account {
        let mut account = Account::default();
        for (key, power) in powers(placed) {
            let is_full = self.powers.len() >= most;
            match self.powers.entry(key) {
                Entry::Occupied(_) => account.twice += 1,
                Entry::Vacant(_) if is_full => account.beyond += 1,
                Entry::Vacant(place) => {
                    place.insert(power);
                    account.kept += 1;
                }
            }
        }
        account
    }

    /// Takes powers out again; how many of them were there.
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

    /// Takes what another has too; of the same integration its own stays.
    pub fn absorb(&mut self, other: Self) {
        for (key, power) in other.powers {
            self.powers.entry(key).or_insert(power);
        }
    }

    /// The powers by channel, daughter and time.
    #[must_use]
    pub fn list(&self, instrument: &Instrument) -> Vec<AutoPower> {
        let power = |(&(channel, daughter, half_ticks), &[power_k_sr, sigma_k_sr]): (&Key, &Power)| {
            let channel = instrument.channel_of(channel, Pair { i: daughter, j: daughter })?;
            Some(AutoPower {
                daughter,
                frequency_hz: channel.frequency_hz,
                width_hz: channel.width_hz,
                time_s: half_ticks as f64 / HALF_TICKS_A_SECOND,
                power_k_sr,
                sigma_k_sr,
            })
        };
        self.powers.iter().filter_map(power).collect()
    }
}

fn powers(placed: &PlacedVisibilities) -> impl Iterator<Item = (Key, Power)> {
    let Pair { i: daughter, .. } = placed.pair;
    (0..placed.len()).map(move |k| {
        // Times are exact to a hundredth of that after centuries.
        let half_ticks = (placed.time_s[k] * HALF_TICKS_A_SECOND).round() as i64;
        let sigma_k_sr = placed.weight[k].sqrt().recip();
        ((placed.channel, daughter, half_ticks), [placed.value_k_sr[k].re, sigma_k_sr])
    })
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;
    use crate::frames::{AntennaResponse, Channel};

    fn own(daughter: u8, times_s: &[f64], power_k_sr: f64) -> PlacedVisibilities {
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
    fn each_power_is_taken_once_and_the_rest_counted() {
        let mut table = AutoTable::default();
        // Half a tick apart, far from the epoch.
        let first = own(3, &[3e8, 3e8 + 0.5e-6, 3e8 + 1.0], 7.0);
        assert_eq!(table.take(&first, 5), Account { kept: 3, ..Account::default() });
        assert_eq!(table.take(&first, 5), Account { twice: 3, ..Account::default() });
        let other = own(2, &[1.0, 2.0, 3e8], 8.0);
        assert_eq!(table.take(&other, 5), Account { kept: 2, beyond: 1, twice: 0 });
        // What differs stays, as does what never came in.
        assert_eq!(table.remove(&own(3, &[3e8], 7.5)), 0);
        assert_eq!(table.remove(&other), 2);

        let mut both = AutoTable::default();
        let _ = both.take(&own(4, &[5.0], 9.0), 1);
        both.absorb(table.clone());
        both.absorb(table);
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
