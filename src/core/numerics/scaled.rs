//! Numbers far below the range of f64, as a mantissa and a power of 2^512.
//!
//! Recurrences in the degree start from such numbers and grow into the range of f64.

use std::ops::Range;

/// Values above this are scaled by [`RESCALE_DOWN`], and their power is raised by one.
const RESCALE_ABOVE: f64 = 1.157_920_892_373_162e77; // 2^256
/// 2^-512.
const RESCALE_DOWN: f64 = 7.458_340_731_200_207e-155;
const RESCALE_UP: f64 = 1.340_780_792_994_259_7e154; // 2^512
const RESCALE_BELOW: f64 = 1.0 / RESCALE_ABOVE;

/// `mantissa * 2^(512 power)` with the mantissa between 2^-256 and 2^256, or zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scaled {
    pub(crate) mantissa: f64,
    /// A whole number, stored as f64 so that vector code can compare it beside the mantissa.
    pub(crate) power: f64,
}

impl Scaled {
    pub(crate) const ONE: Self = Self { mantissa: 1.0, power: 0.0 };

    /// The powers `x^0 ..= x^count` for |x| <= 1.
    pub(crate) fn powers(x: f64, count: usize) -> Vec<Self> {
        let mut powers = Vec::with_capacity(count + 1);
        let mut power = Self::ONE;
        for _ in 0..=count {
            powers.push(power);
            power = power.times(x);
        }
        powers
    }

    /// The product with a factor whose size is near one.
    pub(crate) fn times(self, factor: f64) -> Self {
        Self { mantissa: self.mantissa * factor, power: self.power }.normalised()
    }

    pub(crate) fn product(self, other: Self) -> Self {
        Self { mantissa: self.mantissa * other.mantissa, power: self.power + other.power }.normalised()
    }

    fn normalised(self) -> Self {
        let Self { mantissa, power } = self;
        if mantissa == 0.0 {
            Self { mantissa: 0.0, power: 0.0 }
        } else if mantissa.abs() > RESCALE_ABOVE {
            Self { mantissa: mantissa * RESCALE_DOWN, power: power + 1.0 }
        } else if mantissa.abs() < RESCALE_BELOW {
            Self { mantissa: mantissa * RESCALE_UP, power: power - 1.0 }
        } else {
            self
        }
    }

    /// As f64; zero when below 2^-256.
    pub(crate) fn value(self) -> f64 {
        if self.power == 0.0 { self.mantissa } else { 0.0 }
    }
}

/// State of a three-term recurrence in many lanes, each with a power of 2^512 that scales its stored values.
#[derive(Clone, Debug)]
pub(crate) struct ScaledLanes {
    /// Latest value.
    pub(crate) current: Vec<f64>,
    /// The value before it, with the same power.
    pub(crate) previous: Vec<f64>,
    /// See [`Scaled::power`].
    pub(crate) power: Vec<f64>,
    /// Latest value as f64; zero when below 2^-256.
    pub(crate) value: Vec<f64>,
}

impl ScaledLanes {
    /// Lanes of zeros.
    pub(crate) fn zeros(lanes: usize) -> Self {
        let zeros = || vec![0.0; lanes];
        Self { current: zeros(), previous: zeros(), power: zeros(), value: zeros() }
    }

    /// Starts the recurrence of a lane.
    pub(crate) fn set(&mut self, lane: usize, start: Scaled) {
        self.current[lane] = start.mantissa;
        self.previous[lane] = 0.0;
        self.power[lane] = start.power;
        self.value[lane] = start.value();
    }

    /// The lanes in `range`, all four slices of its length.
    #[inline(always)]
    pub(crate) fn slices(&mut self, range: Range<usize>) -> LaneSlices<'_> {
        LaneSlices {
            current: &mut self.current[range.clone()],
            previous: &mut self.previous[range.clone()],
            power: &mut self.power[range.clone()],
            value: &mut self.value[range],
        }
    }
}

/// Consecutive lanes of [`ScaledLanes`].
pub(crate) struct LaneSlices<'a> {
    pub(crate) current: &'a mut [f64],
    pub(crate) previous: &'a mut [f64],
    pub(crate) power: &'a mut [f64],
    pub(crate) value: &'a mut [f64],
}

/// Makes `next` the current value of a lane, and scales the lane down once it has grown out of range.
#[inline(always)]
pub(crate) fn advance(next: f64, [current, previous, power, value]: [&mut f64; 4]) {
    let grown = next.abs() > RESCALE_ABOVE;
    let scale = if grown { RESCALE_DOWN } else { 1.0 };
    let new_power = *power + if grown { 1.0 } else { 0.0 };
    *previous = *current * scale;
    *current = next * scale;
    *power = new_power;
    *value = if new_power == 0.0 { next * scale } else { 0.0 };
}
