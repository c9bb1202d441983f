//! The scale of exact sums, which follows from the maximum weight, and their totals.

use num_complex::Complex64;

use crate::imaging::{AccumulationError, Refusal, SumCounts};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Boltzmann's constant, J/K.
const BOLTZMANN_J_K: f64 = 1.380_649e-23;
/// The solid angle of the sky visible at an altitude of 300 km, sr.
const VISIBLE_SKY_SR: f64 = 9.6;
/// The longest integration time of the paper's array, s.
const INTEGRATION_S: f64 = 25.0;
/// Factor above the weight expected for a sky of Cane's brightness, for longer integrations, fainter skies and gains.
const HEADROOM: f64 = 1024.0;
/// Maximum signal-to-noise ratio of one visibility; sky noise limits it to 600.
const SIGNAL_TO_NOISE_MAX: f64 = 16_384.0;
/// Minimum weight in units of the scale; a smaller one would be rounded to zero in the pixel engine's sums.
const WEIGHT_FRACTION_MIN: f64 = 2.273_736_754_432_320_6e-13; // 2^-42
/// Steps per unit of the scale in which weights are counted.
const WEIGHT_STEPS: f64 = 18_446_744_073_709_551_616.0; // 2^64
/// Steps per noise variance in which powers are counted: each power is at most 2^29, so there is room for 2^51 of them.
const POWER_STEPS: f64 = 281_474_976_710_656.0; // 2^48

/// The default maximum weight of visibilities in a channel, (K sr)^-2.
///
/// It is `2 dnu dt / T_sys^2` for 25 s under the mean sky of Cane (1979, MNRAS 189, 465), times 1024. It does not depend on
/// the data, so that engines of one channel always agree.
#[must_use]
pub fn automatic_weight_max(frequency_hz: f64, width_hz: f64) -> f64 {
    let mhz = frequency_hz / 1e6;
    let depth = 5.0 * mhz.powf(-2.1);
    let galaxy = 2.48e-20 * mhz.powf(-0.52) * -(-depth).exp_m1() / depth;
    let brightness = galaxy + 1.06e-20 * mhz.powf(-0.8) * (-depth).exp();
    let sky_k = brightness * (SPEED_OF_LIGHT_M_S / frequency_hz).powi(2) / (2.0 * BOLTZMANN_J_K);
    HEADROOM * 2.0 * width_hz * INTEGRATION_S / (sky_k * VISIBLE_SKY_SR).powi(2)
}

/// The scale of weights: the smallest power of four not below `weight_max`, so that its square root is a power of two.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeightScale {
    /// The scale, (K sr)^-2.
    pub(in crate::imaging) weight: f64,
    /// Its square root, (K sr)^-1.
    pub(in crate::imaging) root: f64,
}

impl WeightScale {
    pub(in crate::imaging) fn new(weight_max: f64) -> Result<Self, AccumulationError> {
        if !(1e-60..=1e60).contains(&weight_max) {
            let expected = "1e-60 to 1e60 (K sr)^-2";
            return Err(AccumulationError::Setup { name: "weight_max", value: weight_max, expected });
        }
        let half = (0.5 * weight_max.log2()).ceil() as i32;
        // The logarithm may be rounded down.
        let half = if 4_f64.powi(half) < weight_max { half + 1 } else { half };
        Ok(Self { weight: 4_f64.powi(half), root: 2_f64.powi(half) })
    }

    /// Checks that a value (K sr) of this weight can be summed.
    pub(in crate::imaging) fn check(
        self,
        value: Complex64,
        weight: f64,
        weight_max: f64,
    ) -> Result<(), Refusal> {
        if !(value.re.is_finite() && value.im.is_finite() && weight > 0.0 && weight.is_finite()) {
            return Err(Refusal::NotFinite);
        }
        let signal = value.re.abs().max(value.im.abs()) * weight.sqrt();
        let is_negligible = weight < WEIGHT_FRACTION_MIN * self.weight;
        if weight > weight_max || is_negligible || signal > SIGNAL_TO_NOISE_MAX {
            return Err(Refusal::OutOfRange);
        }
        Ok(())
    }
}

/// The direction of a change: addition or removal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// Addition.
    In,
    /// Removal.
    Out,
}

impl Direction {
    /// The sign of the change, 1 or -1.
    pub(in crate::imaging) fn sign(self) -> f64 {
        match self {
            Self::In => 1.0,
            Self::Out => -1.0,
        }
    }
}

/// Exact totals of visibilities: their number, their weight in steps of 2^-64 of the scale, and their power in steps of 2^-48 of the noise
/// variance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, bincode::Encode, bincode::Decode)]
pub struct Totals {
    visibilities: u64,
    weight: u128,
    power: u128,
}

impl Totals {
    /// The totals of one visibility that [`WeightScale::check`] accepts; its value is in K sr.
    pub(in crate::imaging) fn single(scale: WeightScale, weight: f64, value: Complex64) -> Self {
        Self {
            visibilities: 1,
            weight: (weight / scale.weight * WEIGHT_STEPS).round() as u128,
            power: (value.norm_sqr() * weight * POWER_STEPS).round() as u128,
        }
    }

    /// Adds or removes other totals; `None` if the result would be negative or too large.
    pub(in crate::imaging) fn combined(self, other: Self, direction: Direction) -> Option<Self> {
        let Self { visibilities, weight, power } = other;
        Some(match direction {
            Direction::In => Self {
                visibilities: self.visibilities.checked_add(visibilities)?,
                weight: self.weight.checked_add(weight)?,
                power: self.power.checked_add(power)?,
            },
            Direction::Out => Self {
                visibilities: self.visibilities.checked_sub(visibilities)?,
                weight: self.weight.checked_sub(weight)?,
                power: self.power.checked_sub(power)?,
            },
        })
    }

    /// The total weight in units of the scale.
    pub(in crate::imaging) fn scales(self) -> f64 {
        self.weight as f64 / WEIGHT_STEPS
    }

    pub(in crate::imaging) fn counts(self, scale: WeightScale) -> SumCounts {
        SumCounts {
            visibilities: self.visibilities,
            weight: self.scales() * scale.weight,
            power: self.power as f64 / POWER_STEPS,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_are_the_next_power_of_four() {
        for (weight_max, weight, root) in
            [(1.0, 1.0, 1.0), (1.01, 4.0, 2.0), (4.0, 4.0, 2.0), (0.2, 0.25, 0.5)]
        {
            assert_eq!(WeightScale::new(weight_max).unwrap(), WeightScale { weight, root });
        }
        for weight_max in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e-70, 1e70] {
            assert!(WeightScale::new(weight_max).is_err());
        }
    }

    #[test]
    fn negligible_weights_are_refused() {
        let scale = WeightScale::new(1.0).unwrap();
        let check = |weight: f64| scale.check(Complex64::new(1.0, 0.0), weight, 1.0);
        assert_eq!(check(1.0), Ok(()));
        assert_eq!(check(0.5_f64.powi(42)), Ok(()));
        // The last one is the smallest weight that a packet can represent.
        for weight in [0.5_f64.powi(43), f64::from(f32::from_bits(1))] {
            assert_eq!(check(weight), Err(Refusal::OutOfRange));
        }
    }

    /// A value of 3 - 4i K sr with weight 2 has a power of 50.
    #[test]
    fn totals_are_added_and_removed_exactly() {
        let scale = WeightScale::new(4.0).unwrap();
        let one = Totals::single(scale, 2.0, Complex64::new(3.0, -4.0));
        let two = one.combined(Totals::single(scale, 1.0, Complex64::new(0.5, 0.0)), Direction::In).unwrap();
        assert_eq!(two.counts(scale), SumCounts { visibilities: 2, weight: 3.0, power: 50.25 });
        let other = two.combined(one, Direction::Out).unwrap();
        assert_eq!(other.counts(scale), SumCounts { visibilities: 1, weight: 1.0, power: 0.25 });
        assert_eq!(other.combined(one, Direction::Out), None);
        // There is room for 2^51 visibilities of the maximum power.
        let greatest = Complex64::new(1.0, 1.0) * SIGNAL_TO_NOISE_MAX;
        assert!(Totals::single(scale, 1.0, greatest).power.leading_zeros() >= 51 - 1);
    }

    /// Cane's 4.96e6, 2.92e5 and 1.78e4 K at 3, 10 and 30 MHz, as tabulated to three digits.
    #[test]
    fn the_automatic_limit_follows_the_sky() {
        for (mhz, sky_k) in [(3.0, 4.96e6), (10.0, 2.92e5), (30.0, 1.78e4)] {
            let expected = 1024.0 * 2.0 * 8e3 * 25.0 / (9.6_f64 * sky_k).powi(2);
            let found = automatic_weight_max(mhz * 1e6, 8e3);
            assert!((found / expected - 1.0).abs() < 0.01, "{mhz} MHz: {found:e} {expected:e}");
        }
    }
}
