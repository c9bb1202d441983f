//! Powers of the daughters by themselves: what carries the sky's mean.

use num_complex::Complex32;

use super::integrate::COMPLETE_MIN;
use super::kernel::LANES;
use crate::frames::{Flags, ObservingWindow, VisibilityBlock};
use crate::units::{ChannelId, Pair};

/// Powers of one daughter and channel that are held before they are handed on.
const HELD_MAX: usize = 256;

/// What a row of blocks says of powers, by daughter and lane.
#[derive(Clone, Debug, PartialEq)]
pub struct RowPowers {
    /// ProductSums of |x|^2, K sr, and the number of samples in them.
    pub sums: Vec<[(f64, u64); LANES]>,
    /// Samples that there should have been.
    pub samples: u64,
    /// Whether too many of them were out of range.
    pub saturated: Vec<[bool; LANES]>,
}

/// Integrates powers of up to `LANES` channels over whole rows.
///
/// A power comes out as the visibility of a daughter with herself: the mean of |x|^2, which for Gaussian samples has
/// the variance P^2 / n, and so the weight n / P^2.
pub struct AutoIntegrator {
    first_channel: usize,
    lanes: usize,
    window: ObservingWindow,
    duration_ticks: u32,
    from_ticks: u32,
    sums: Vec<[(f64, u64); LANES]>,
    saturated: Vec<[bool; LANES]>,
    samples: u64,
    held: Vec<Vec<VisibilityBlock>>,
}

impl AutoIntegrator {
    /// An integrator of `lanes` channels from `first_channel` on, of `daughters`, over `duration_s` or a row, whichever is
    /// longer.
    #[must_use]
    pub fn new(
        (first_channel, lanes): (usize, usize),
        daughters: usize,
        window: ObservingWindow,
        duration_s: f64,
    ) -> Self {
        Self {
            first_channel,
            lanes,
            window,
            duration_ticks: (duration_s * 1e6) as u32,
            from_ticks: 0,
            sums: vec![[(0.0, 0); LANES]; daughters],
            saturated: vec![[false; LANES]; daughters],
            samples: 0,
            held: vec![vec![VisibilityBlock::default(); lanes]; daughters],
        }
    }

    /// Adds a row that ends at `until_ticks` of the window.
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
        // A row like this one that would end too late begins the next integration.
        let elapsed = f64::from(until_ticks.saturating_sub(self.from_ticks));
        let one_more = elapsed * row.samples as f64 / self.samples.max(1) as f64;
        if elapsed + one_more > f64::from(self.duration_ticks) {
            self.close(until_ticks, out);
        }
    }

    /// Ends all integrations where they are, and hands on what is held.
    pub fn finish(&mut self, until_ticks: u32, out: &mut Vec<VisibilityBlock>) {
        if self.samples > 0 {
            self.close(until_ticks, out);
        }
        let held = self.held.iter_mut().flatten().map(std::mem::take);
        out.extend(held.filter(|block| !block.is_empty()));
    }

    fn close(&mut self, until_ticks: u32, out: &mut Vec<VisibilityBlock>) {
        for (daughter, held) in self.held.iter_mut().enumerate() {
            for (lane, block) in held.iter_mut().enumerate() {
                let (sum, count) = std::mem::take(&mut self.sums[daughter][lane]);
                let saturated = std::mem::take(&mut self.saturated[daughter][lane]);
                let power = sum / count as f64;
                let weight = (count as f64 / (power * power)) as f32;
                // Of silence, or of nothing that came, nothing is told.
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
                block.channel = ChannelId((self.first_channel + lane) as u16);
                block.pair = Pair { i: daughter as u8, j: daughter as u8 };
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
