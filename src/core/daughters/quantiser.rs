//! Analogue-to-digital conversion: level control and quantiser.

use multiversion::multiversion;

use super::config::FLOAT_BITS;
use crate::frames::Samples;

/// Spacing of levels, in standard deviations of one part, with the highest efficiency for a Gaussian (Thompson, Moran
/// & Swenson 2017, Table 8.2 and Eq. 8.84): efficiencies 0.6366, 0.8812, 0.9885 for 1, 2, 4 bits. For 8 bits the
/// spacing is wider than the optimum, 0.0308, so that 5 standard deviations still fit; efficiency 0.9999.
fn spacing(bits: u32) -> f64 {
    match bits {
        // One bit holds the sign: +- one standard deviation preserves the power.
        1 => 2.0,
        2 => 0.9957,
        4 => 0.3352,
        _ => 0.04,
    }
}

/// Quantiser of one channel of one daughter, with its level control.
#[derive(Clone, Debug)]
pub struct Quantiser {
    bits: u32,
    /// Fraction of the step towards a block's power that the level control takes.
    level_gain: f64,
    /// Power estimate that sets the level, K sr.
    power: Option<f64>,
}

impl Quantiser {
    /// Creates a quantiser of `bits` (1, 2, 4, 8, or 32 for none) whose level control follows the power of blocks of
    /// `block_s` with a time constant, s.
    #[must_use]
    pub fn new(bits: u32, block_s: f64, time_constant_s: f64) -> Self {
        Self { bits, level_gain: 1.0 - (-block_s / time_constant_s).exp(), power: None }
    }

    /// Quantises a block of samples (sqrt(K sr)) and counts the parts out of range. Earlier blocks set the level; the first
    /// block sets its own.
    pub fn quantise(&mut self, re: &[f32], im: &[f32]) -> (Samples, u32) {
        if self.bits == FLOAT_BITS || re.is_empty() {
            return (Samples::Float { re: re.to_vec(), im: im.to_vec() }, 0);
        }
        let measured = (square(re) + square(im)) / re.len() as f64;
        let power = self.power.unwrap_or(measured);
        self.power = Some(power + self.level_gain * (measured - power));
        // Without power any step is right.
        let step = (spacing(self.bits) * (0.5 * power).sqrt()).max(f64::from(f32::MIN_POSITIVE)) as f32;
        let half = 1_i32 << (self.bits - 1);
        let (mut re_codes, mut im_codes) = (vec![0; re.len()], vec![0; im.len()]);
        let out_of_range = encode(re, step, half, &mut re_codes) + encode(im, step, half, &mut im_codes);
        // A sign cannot be out of range.
        let saturated = if self.bits == 1 { 0 } else { out_of_range };
        (Samples::Codes { bits: self.bits as u8, step, re: re_codes, im: im_codes }, saturated)
    }
}

/// Sum of squares, accumulated in `LANES` interleaved partial sums.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn square(values: &[f32]) -> f64 {
    const LANES: usize = 16;
    let mut sums = [0.0_f64; LANES];
    let (chunks, rest) = values.as_chunks::<LANES>();
    for chunk in chunks {
        for (sum, value) in sums.iter_mut().zip(chunk) {
            *sum += f64::from(*value) * f64::from(*value);
        }
    }
    let rest: f64 = rest.iter().map(|&x| f64::from(x) * f64::from(x)).sum();
    sums.iter().sum::<f64>() + rest
}

#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn encode(values: &[f32], step: f32, half: i32, codes: &mut [i8]) -> u32 {
    // The bits of an f32 from 256 to 512 are 8 integer bits above 15 fraction bits, so a shift gives the floor. A
    // conversion instruction does more, and does not vectorise.
    const UP: f32 = 256.0;
    const REST: u32 = 15;
    let (scale, limit) = (1.0 / step, half as f32);
    let mut out_of_range = 0_u32;
    for (code, value) in codes.iter_mut().zip(values) {
        let level = (value * scale).max(-limit).min(limit - 0.5);
        let whole = (level + (limit + UP)).to_bits() >> REST;
        *code = (whole as u8).wrapping_sub(half as u8).cast_signed();
        out_of_range += u32::from(value.abs() * scale > limit);
    }
    out_of_range
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn codes_are_levels_and_values_out_of_range_are_counted() {
        // Power 2: a standard deviation of 1 in each part.
        let mut values: Vec<f32> = (0..1000).map(|k| if k % 2 == 0 { 1.0 } else { -1.0 }).collect();
        (values[0], values[1], values[2], values[3]) = (0.1, -0.1, 1.9, -2.1);
        values[4] = (1000.0 - 994.0 - 2.0 * 0.01 - 1.9 * 1.9 - 2.1 * 2.1_f32).abs().sqrt();
        for (bits, expected) in
            [(1, [0, -1, 0, -1]), (2, [0, -1, 1, -2]), (4, [0, -1, 5, -7]), (8, [2, -3, 47, -53])]
        {
            let mut quantiser = Quantiser::new(bits, 0.1, 10.0);
            quantiser.power = Some(2.0);
            let (samples, saturated) = quantiser.quantise(&values, &values);
            let Samples::Codes { step, re, im, .. } = samples else { panic!("not quantised") };
            assert_eq!((&re[..4], &re), (&expected[..], &im), "{bits} bits");
            assert!((f64::from(step) - spacing(bits)).abs() < 1e-6);
            // Of +-1, 1.9 and -2.1 only the last is beyond 2 levels of 2 bits, 1.99.
            assert_eq!(saturated, if bits == 2 { 2 } else { 0 }, "{bits} bits");
        }
    }

    #[test]
    fn the_level_follows_the_power_with_its_time_constant() {
        let block = |amplitude: f32| vec![amplitude; 64];
        let mut quantiser = Quantiser::new(8, 0.1, 1.0);
        let mut step = 0.0;
        for k in 0..=10 {
            let (samples, _) = quantiser.quantise(&block(if k == 0 { 1.0 } else { 2.0 }), &block(0.0));
            let Samples::Codes { step: found, .. } = samples else { panic!("not quantised") };
            step = found;
        }
        // Nine blocks of power 4 after one of power 1: 4 - 3 exp(-0.9), half of it in each part.
        let power = 4.0 - 3.0 * (-0.9_f32).exp();
        assert!((step / (0.04 * (0.5 * power).sqrt()) - 1.0).abs() < 1e-5);
    }
}
