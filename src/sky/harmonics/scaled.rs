//! Numbers far below the range of f64.

/// Values above this are scaled down by [`RESCALE_DOWN`] and counted one power higher.
pub(crate) const RESCALE_ABOVE: f64 = 1.157_920_892_373_162e77; // 2^256
/// 2^-512.
pub(crate) const RESCALE_DOWN: f64 = 7.458_340_731_200_207e-155;
const RESCALE_UP: f64 = 1.340_780_792_994_259_7e154; // 2^512
const RESCALE_BELOW: f64 = 1.0 / RESCALE_ABOVE;

/// `mantissa * 2^(512 power)` with the mantissa between 2^-256 and 2^256, or zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Scaled {
    pub(crate) mantissa: f64,
    /// A whole number, kept as f64 so that vector code can compare it beside the mantissa.
    pub(crate) power: f64,
}

impl Scaled {
    pub(crate) const ONE: Self = Self { mantissa: 1.0, power: 0.0 };

    /// `x^0 ..= x^count` for |x| <= 1.
    pub(crate) fn powers(x: f64, count: usize) -> Vec<Self> {
        let mut powers = Vec::with_capacity(count + 1);
        let mut power = Self::ONE;
        for _ in 0..=count {
            powers.push(power);
            power = power.times(x);
        }
        powers
    }

    /// Times a factor of ordinary size.
    pub(crate) fn times(self, factor: f64) -> Self {
        Self { mantissa: self.mantissa * factor, power: self.power }.normal()
    }

    pub(crate) fn product(self, other: Self) -> Self {
        Self { mantissa: self.mantissa * other.mantissa, power: self.power + other.power }.normal()
    }

    fn normal(self) -> Self {
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
