//! Powers of the daughters over mission time, for a waterfall plot.

use std::collections::BTreeMap;

use serde::Serialize;
use serde::ser::{SerializeStruct, Serializer};

const BINS_MAX: usize = 256;

const DAUGHTERS_MAX: usize = 64;

const BIN_S_MIN: f64 = 15.0;

/// Sum of powers, K sr, and the number of powers.
type PowerSum = (f64, u64);

/// Mean powers of one channel by time and daughter. Memory is bounded, as the time bins grow by factors of two.
#[derive(Clone, Debug, PartialEq)]
pub struct PowerWaterfall {
    bin_s: f64,
    /// Sums by the number of the time bin, counted from the mission epoch.
    sums: BTreeMap<i64, Vec<PowerSum>>,
}

impl Default for PowerWaterfall {
    fn default() -> Self {
        Self { bin_s: BIN_S_MIN, sums: BTreeMap::new() }
    }
}

impl PowerWaterfall {
    /// Adds a power of a daughter (from 0), K sr, at a mission time, s.
    pub fn add(&mut self, daughter: u8, time_s: f64, power_k_sr: f64) {
        let daughter = usize::from(daughter);
        if daughter >= DAUGHTERS_MAX || !time_s.is_finite() || !power_k_sr.is_finite() {
            return;
        }
        let sums = self.sums.entry((time_s / self.bin_s).floor() as i64).or_default();
        if sums.len() <= daughter {
            sums.resize(daughter + 1, (0.0, 0));
        }
        sums[daughter].0 += power_k_sr;
        sums[daughter].1 += 1;
        while self.sums.len() > BINS_MAX {
            self.widen();
        }
    }

    fn widen(&mut self) {
        self.bin_s *= 2.0;
        for (number, sums) in std::mem::take(&mut self.sums) {
            let wide = self.sums.entry(number >> 1).or_default();
            wide.resize(wide.len().max(sums.len()), (0.0, 0));
            for (to, from) in wide.iter_mut().zip(sums) {
                *to = (to.0 + from.0, to.1 + from.1);
            }
        }
    }
}

/// Serialises `time_s`, the width of a bin; `times_s`, the start of each; and `powers_k_sr` by bin and daughter, `null` where
/// there is none.
impl Serialize for PowerWaterfall {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mean = |&(sum, count): &PowerSum| (count > 0).then(|| sum / count as f64);
        let times_s: Vec<f64> = self.sums.keys().map(|&number| number as f64 * self.bin_s).collect();
        let powers: Vec<Vec<Option<f64>>> =
            self.sums.values().map(|sums| sums.iter().map(mean).collect()).collect();
        let mut out = serializer.serialize_struct("PowerWaterfall", 3)?;
        out.serialize_field("time_s", &self.bin_s)?;
        out.serialize_field("times_s", &times_s)?;
        out.serialize_field("powers_k_sr", &powers)?;
        out.end()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_those_of_all_powers_however_wide_the_times() {
        let mut waterfall = PowerWaterfall::default();
        let power = |k: u32| 5.0 + f64::from(k % 10);
        // Ten powers of each of two daughters in 15 s, before and after the epoch.
        for k in 0..10_000 {
            for daughter in [0, 2] {
                waterfall.add(daughter, 1.5 * f64::from(k) - 7500.0, power(k) + f64::from(daughter));
            }
        }
        waterfall.add(200, 0.0, 1.0);
        waterfall.add(0, f64::NAN, 1.0);
        // 1000 times of 15 s are 250 of 60 s.
        let serialised = serde_json::to_value(&waterfall).unwrap();
        assert_eq!(serialised["time_s"], 60.0);
        let times = serialised["times_s"].as_array().unwrap();
        assert_eq!((times.len(), &times[0], &times[249]), (250, &(-7500.0).into(), &7440.0.into()));
        // The mean of 5 to 14.
        for row in serialised["powers_k_sr"].as_array().unwrap() {
            assert_eq!(*row, serde_json::json!([9.5, null, 11.5]));
        }
    }
}
