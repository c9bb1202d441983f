//! Integration of auto-correlations, which carry the sky's mean.

use num_complex::Complex32;

use super::integrate::COMPLETE_MIN;
use super::kernel::LANES;
use crate::array::EarthOccultation;
use crate::frames::{Flags, ObservingWindow, VisibilityBlock};
use crate::units::{ChannelId, Pair};

/// Maximum number of auto-correlations in a block of one daughter and channel.
const HELD_MAX: usize = 256;

/// Powers of a row of blocks.
#[derive(Clone, Debug, PartialEq)]
pub struct RowPowers {
    /// Sum of |x|^2, K sr, and number of samples, by daughter and lane.
    pub sums: Vec<[(f64, u64); LANES]>,
    /// Expected number of samples.
    pub samples: u64,
    /// Whether too many samples were out of range, by daughter and lane.
    pub saturated: Vec<[bool; LANES]>,
}

/// Integrates the auto-correlations of up to `LANES` channels over whole rows.
///
/// An auto-correlation is sent as the visibility of a daughter with itself: the mean of |x|^2, which for Gaussian samples
/// has the variance P^2 / n, and so the weight n / P^2.
pub struct AutoIntegrator {
    first_channel: usize,
    lanes: usize,
    window: ObservingWindow,
    /// Occultation of the Earth, if auto-correlations with the Earth in sight are flagged.
    shadow: Option<EarthOccultation>,
    duration_ticks: u32,
    from_ticks: u32,
    sums: Vec<[(f64, u64); LANES]>,
    saturated: Vec<[bool; LANES]>,
    samples: u64,
    held: Vec<Vec<VisibilityBlock>>,
}

impl AutoIntegrator {
    /// Creates an integrator of `lanes` channels from `first_channel` on, over `duration_s` or one row, whichever is
    /// longer.
    #[must_use]
    pub fn new(
        first_channel: usize,
        lanes: usize,
        daughters: usize,
        window: ObservingWindow,
        duration_s: f64,
    ) -> Self {
        Self {
            first_channel,
            lanes,
            window,
            shadow: None,
            duration_ticks: (duration_s * 1e6) as u32,
            from_ticks: 0,
            sums: vec![[(0.0, 0); LANES]; daughters],
            saturated: vec![[false; LANES]; daughters],
            samples: 0,
            held: vec![vec![VisibilityBlock::default(); lanes]; daughters],
        }
    }

    /// Flags auto-correlations of daughters that see the Earth.
    #[must_use]
    pub fn with_earth_occultation(self, shadow: Option<EarthOccultation>) -> Self {
        Self { shadow, ..self }
    }

    /// Adds a row that ends `until_ticks` after the window's start.
    pub fn add(&mut self, row: &RowPowers, until_ticks: u32, out: &mut Vec<VisibilityBlock>) {
        self.samples += row.samples;
        for (daughter, (sums, saturated)) in row.sums.iter().zip(&row.saturated).enumerate() {
            for lane in 0..self.lanes {
                let own = &mut self.sums[daughter][lane];
                own.0 += sums[lane].0;
                own.1 += sums[lane].1;
                self.saturated[daughter][lane] |= saturated[lane];
            }
        }
        // If one more such row would exceed the integration time, it starts the next integration.
        let elapsed = f64::from(until_ticks.saturating_sub(self.from_ticks));
        let one_more = elapsed * row.samples as f64 / self.samples.max(1) as f64;
        if elapsed + one_more > f64::from(self.duration_ticks) {
            self.close(until_ticks, out);
        }
    }

    /// Ends all integrations and emits all held blocks.
    pub fn finish(&mut self, until_ticks: u32, out: &mut Vec<VisibilityBlock>) {
        if self.samples > 0 {
            self.close(until_ticks, out);
        }
        let held = self.held.iter_mut().flatten().map(std::mem::take);
        out.extend(held.filter(|block| !block.is_empty()));
    }

    fn close(&mut self, until_ticks: u32, out: &mut Vec<VisibilityBlock>) {
        let [from, until] =
            [self.from_ticks, until_ticks].map(|ticks| self.window.start.plus_ticks(ticks.into()));
        for (daughter, held) in self.held.iter_mut().enumerate() {
            for (lane, block) in held.iter_mut().enumerate() {
                let (sum, count) = std::mem::take(&mut self.sums[daughter][lane]);
                let saturated = std::mem::take(&mut self.saturated[daughter][lane]);
                let power = sum / count as f64;
                let weight = (count as f64 / (power * power)) as f32;
                // Without samples or without power there is nothing to send.
                if !(weight.is_finite() && weight > 0.0) {
                    continue;
                }
                let mut flags = Flags::GOOD;
                if (count as f64) < COMPLETE_MIN * self.samples as f64 {
                    flags.0 |= Flags::INCOMPLETE.0;
                }
                if saturated {
                    flags.0 |= Flags::SATURATED.0;
                }
                let pair = Pair { i: daughter as u8, j: daughter as u8 };
                if self.shadow.as_ref().is_some_and(|shadow| !shadow.covers(pair, from, until)) {
                    flags.0 |= Flags::EARTH.0;
                }
                block.channel = ChannelId((self.first_channel + lane) as u16);
                block.pair = pair;
                block.start = self.window.start;
                block.offset_ticks.push(self.from_ticks);
                block.duration_ticks.push(until_ticks - self.from_ticks);
                block.value_k_sr.push(Complex32::new(power as f32, 0.0));
                block.weight.push(weight);
                block.flags.push(flags);
                if block.len() >= HELD_MAX {
                    out.push(std::mem::take(block));
                }
            }
        }
        self.samples = 0;
        self.from_ticks = until_ticks;
    }
}
