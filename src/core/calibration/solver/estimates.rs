//! Estimates of gains and daughters, and counts of the visibilities behind them.

use bincode::{Decode, Encode};
use serde::Serialize;

use super::layout::ParameterLayout;
use super::robust_fit::RobustFit;
use super::sums::ModelledBlock;

/// Quality state of the gain of a daughter in a channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Encode, Decode)]
#[serde(rename_all = "kebab-case")]
pub enum GainState {
    /// The gain is good.
    Good,
    /// There are no data.
    NoData,
    /// There is only noise where a working receiver would deliver signal, or the amplitude is almost zero.
    Dead,
    /// There is too little signal to decide, or the phase is less certain than required.
    Uncertain,
    /// The iteration did not converge.
    NotConverged,
    /// The model does not match the data: the solution leaves too much of the signal unexplained.
    PoorFit,
    /// Another position explains the data as well, or daughters contradict one another.
    Ambiguous,
    /// The gain changes within the interval by more than the permitted phase uncertainty.
    Unstable,
}

impl GainState {
    /// Name of the state in tables.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::NoData => "no-data",
            Self::Dead => "dead",
            Self::Uncertain => "uncertain",
            Self::NotConverged => "not-converged",
            Self::PoorFit => "poor-fit",
            Self::Ambiguous => "ambiguous",
            Self::Unstable => "unstable",
        }
    }
}

/// Gain of one daughter in one channel.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct GainEstimate {
    /// Centre of the channel, Hz.
    pub frequency_hz: f64,
    /// Amplitude of the voltage gain.
    pub amplitude: f64,
    /// Standard deviation of the natural logarithm of the amplitude, with the excess of residuals over noise.
    pub amplitude_sigma: f64,
    /// Phase relative to the reference daughter, clock included, deg, -180 to 180.
    pub phase_deg: f64,
    /// Standard deviation of the phase, deg, with the excess of residuals over noise: changes within the interval and
    /// errors of the model.
    pub phase_sigma_deg: f64,
    /// Rms change of the phase within the interval, deg; 0 where it may be noise.
    pub phase_scatter_deg: f64,
    /// Rms change of the logarithm of the amplitude within the interval; 0 where it may be noise.
    pub amplitude_scatter: f64,
    /// Fraction of the daughter's signal that the solution leaves unexplained; 0 where it may be noise.
    pub unexplained: f64,
    /// Number of visibilities used.
    pub visibilities: u64,
    /// Number of visibilities left out as outliers.
    pub outliers: u64,
    /// First and last time of those used, s since the epoch: of what is before and after nothing is told.
    pub data_s: [f64; 2],
    /// Standard deviations by noise alone, of the amplitude's logarithm and of the phase (rad).
    #[serde(skip)]
    pub noise_sigma: [f64; 2],
    /// Standard deviations of the errors, of the same, that a map has by this gain.
    #[serde(skip)]
    pub map_sigma: [f64; 2],
    /// Quality state.
    pub state: GainState,
}

/// Estimates of one daughter.
#[derive(Clone, Debug, PartialEq, Serialize, Encode, Decode)]
pub struct DaughterEstimate {
    /// Number of the daughter, from 1.
    pub daughter: u32,
    /// Clock offset relative to the reference's, ns; 0 where it is not solved for.
    pub clock_ns: f64,
    /// Standard deviation of the clock offset, ns.
    pub clock_sigma_ns: f64,
    /// Error of the positions in packets relative to the reference's: along the track, across it, away from the Moon,
    /// m.
    pub position_m: [f64; 3],
    /// Standard deviations of the position error, m.
    pub position_sigma_m: [f64; 3],
    /// Gains by channel.
    pub gains: Vec<GainEstimate>,
}

/// Distribution of outliers over channels and time.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Encode, Decode)]
pub struct OutlierFractions {
    /// Fraction of visibilities that are outliers, by channel and by sixtieth of the interval; NaN without
    /// visibilities.
    pub by_channel_and_time: Vec<Vec<f64>>,
}

impl OutlierFractions {
    /// Whether there are fractions for this number of channels.
    pub(in crate::calibration) fn has_channels(&self, channels: usize) -> bool {
        let parts = &self.by_channel_and_time;
        parts.len() == channels && parts.iter().all(|times| times.len() == TIME_PARTS)
    }
}

/// Number of parts of an interval in which outliers are counted.
const TIME_PARTS: usize = 60;

/// Counts of visibilities and outliers.
pub(super) struct Counts {
    pub(super) used: u64,
    pub(super) out: u64,
    pub(super) by_gain: Vec<[u64; 2]>,
    /// First and last time of those used, by channel and daughter.
    pub(super) data_s: Vec<[f64; 2]>,
    /// Counts of all visibilities and of outliers, by channel and part of the interval.
    by_time: Vec<[[u64; 2]; TIME_PARTS]>,
}

impl Counts {
    pub(super) fn of(blocks: &[ModelledBlock], [from_s, until_s]: [f64; 2], fitted: &RobustFit) -> Self {
        let layout: &ParameterLayout = &fitted.layout;
        let gains = layout.satellites * layout.frequencies_hz.len();
        let by_time = vec![[[0; 2]; TIME_PARTS]; layout.frequencies_hz.len()];
        let (by_gain, data_s) = (vec![[0; 2]; gains], vec![[until_s, from_s]; gains]);
        let mut counts = Self { used: 0, out: 0, by_gain, data_s, by_time };
        for (block, is_pair_used) in blocks.iter().zip(&fitted.is_pair_used) {
            let inside = (0..block.time_s.len()).filter(|&k| (from_s..until_s).contains(&block.time_s[k]));
            if !is_pair_used {
                // The pair counts only for its daughters that are left out of the solution.
                let of = |n: u8| block.channel * layout.satellites + usize::from(n);
                let left_out =
                    [of(block.pair.i), of(block.pair.j)].into_iter().filter(|k| fitted.dropped_gains[*k]);
                for k in left_out {
                    counts.by_gain[k][0] += inside.clone().count() as u64;
                    counts.extend(k, inside.clone().map(|place| block.time_s[place]));
                }
                continue;
            }
            for k in inside.clone() {
                let part = (block.time_s[k] - from_s) / (until_s - from_s) * TIME_PARTS as f64;
                let [all, out] = &mut counts.by_time[block.channel][(part as usize).min(TIME_PARTS - 1)];
                (*all, *out) = (*all + 1, *out + u64::from(block.is_out[k]));
            }
            let (out, used): (Vec<usize>, Vec<usize>) = inside.partition(|&k| block.is_out[k]);
            for n in [block.pair.i, block.pair.j] {
                let gain = block.channel * layout.satellites + usize::from(n);
                counts.extend(gain, used.iter().map(|&place| block.time_s[place]));
            }
            let (used, out) = (used.len() as u64, out.len() as u64);
            (counts.used, counts.out) = (counts.used + used, counts.out + out);
            for n in [block.pair.i, block.pair.j] {
                let gain = &mut counts.by_gain[block.channel * layout.satellites + usize::from(n)];
                *gain = [gain[0] + used, gain[1] + out];
            }
        }
        counts
            .data_s
            .iter_mut()
            .filter(|[first_s, last_s]| first_s > last_s)
            .for_each(|none| *none = [from_s; 2]);
        counts
    }

    fn extend(&mut self, gain: usize, times_s: impl Iterator<Item = f64>) {
        let [first_s, last_s] = &mut self.data_s[gain];
        for time_s in times_s {
            (*first_s, *last_s) = (first_s.min(time_s), last_s.max(time_s));
        }
    }

    pub(super) fn parts(&self) -> OutlierFractions {
        let row = |times: &[[u64; 2]; TIME_PARTS]| {
            times.iter().map(|[all, out]| *out as f64 / *all as f64).collect::<Vec<f64>>()
        };
        OutlierFractions { by_channel_and_time: self.by_time.iter().map(row).collect() }
    }
}
