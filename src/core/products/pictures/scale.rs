//! Colour scales, which map values to colours.

use super::canvas::Colour;
use super::error::PictureError;
use super::labels;
use super::labels::Ticks;
use crate::numerics::percentiles;
use crate::sky::is_unseen;

/// Limits of a scale if there are no values. They are widened later.
const DEFAULT_LIMITS: (f64, f64) = (1.0, 1.0);

/// Mapping of values to positions on a scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scaling {
    /// Linear scale.
    #[default]
    Linear,
    /// Logarithmic scale.
    Log,
}

/// Palette of a scale.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Palette {
    /// Black through purple and orange to light yellow, for intensities.
    #[default]
    Inferno,
    /// Blue through white to red, for differences.
    Diverging,
}

/// Colour of zero and negative values on a logarithmic scale.
pub(super) const NEGATIVE: Colour = [70, 130, 220];

pub(super) const UNSEEN: Colour = [160, 160, 160];

/// A colour scale, which several maps may share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColourScale {
    low: f64,
    high: f64,
    scaling: Scaling,
    palette: Palette,
}

impl ColourScale {
    /// A scale between given limits.
    ///
    /// # Errors
    /// [`PictureError::Limits`] unless both are finite, `low < high` and, for logarithmic scales, `low > 0`.
    pub fn new(low: f64, high: f64, scaling: Scaling, palette: Palette) -> Result<Self, PictureError> {
        let (positive, name, more) = match scaling {
            Scaling::Linear => (true, "linear", ""),
            Scaling::Log => (low > 0.0, "logarithmic", " and low > 0"),
        };
        if !(low < high && (high - low).is_finite() && positive) {
            return Err(PictureError::Limits { low, high, scaling: name, more });
        }
        Ok(Self { low, high, scaling, palette })
    }

    /// A scale from the 0.5 % to the 99.5 % quantile of `values`, without unseen pixels.
    ///
    /// The scale is always valid: the limits of constant or missing values are widened, and a logarithmic scale uses only
    /// positive values.
    #[must_use]
    pub fn robust(values: &[f64], scaling: Scaling, palette: Palette) -> Self {
        let usable = |v: &f64| is_seen(*v) && (scaling == Scaling::Linear || *v > 0.0);
        let (low, high) =
            percentiles(values.iter().copied().filter(usable).collect(), 0.5, 99.5).unwrap_or(DEFAULT_LIMITS);
        Self::widened(low, high, scaling, palette)
    }

    /// A diverging scale, symmetric about zero, up to the 99 % quantile of `|values|`.
    #[must_use]
    #[doc(hidden)]
    pub fn symmetric(values: &[f64]) -> Self {
        let sizes = values.iter().copied().filter(|v| is_seen(*v)).map(f64::abs).collect();
        let (_, limit) = percentiles(sizes, 0.0, 99.0).unwrap_or(DEFAULT_LIMITS);
        let limit = if limit > 0.0 { limit.clamp(1e-300, 1e300) } else { 1.0 };
        Self { low: -limit, high: limit, scaling: Scaling::Linear, palette: Palette::Diverging }
    }

    fn widened(low: f64, high: f64, scaling: Scaling, palette: Palette) -> Self {
        let (low, high) = (low.clamp(-1e300, 1e300), high.clamp(-1e300, 1e300));
        let width_min = 1e-9 * low.abs().max(high.abs());
        let (low, high) = match scaling {
            _ if high - low > width_min => (low, high),
            Scaling::Linear => {
                let margin = if low == 0.0 { 1.0 } else { 0.1 * low.abs() };
                (low - margin, low + margin)
            }
            Scaling::Log => (low / 1.2, low * 1.2),
        };
        Self { low, high, scaling, palette }
    }

    /// Lower limit of the scale.
    #[must_use]
    #[doc(hidden)]
    pub fn low(&self) -> f64 {
        self.low
    }

    /// Upper limit of the scale.
    #[must_use]
    #[doc(hidden)]
    pub fn high(&self) -> f64 {
        self.high
    }

    /// Position of a value on the scale, 0 to 1 within the limits.
    pub(super) fn position(&self, value: f64) -> f64 {
        match self.scaling {
            Scaling::Linear => (value - self.low) / (self.high - self.low),
            Scaling::Log if value > 0.0 => (value / self.low).ln() / (self.high / self.low).ln(),
            Scaling::Log => f64::NEG_INFINITY,
        }
    }

    /// Colour of a value: grey if unseen, blue if not positive on a logarithmic scale.
    pub(super) fn colour(&self, value: f64) -> Colour {
        if !is_seen(value) {
            UNSEEN
        } else if self.is_off_scale(value) {
            NEGATIVE
        } else {
            self.colour_at(self.position(value))
        }
    }

    /// Whether a value is not positive on a logarithmic scale.
    pub(super) fn is_off_scale(&self, value: f64) -> bool {
        self.scaling == Scaling::Log && value <= 0.0 && is_seen(value)
    }

    /// Colour at a position of the scale.
    pub(super) fn colour_at(&self, position: f64) -> Colour {
        let position = position.clamp(0.0, 1.0);
        match self.palette {
            Palette::Inferno => colorous::INFERNO.eval_continuous(position),
            Palette::Diverging => colorous::RED_BLUE.eval_continuous(1.0 - position),
        }
        .into_array()
    }

    pub(super) fn is_light(&self) -> bool {
        self.palette == Palette::Diverging
    }

    pub(super) fn ticks(&self, wanted: usize) -> Ticks {
        match self.scaling {
            Scaling::Linear => labels::linear(self.low, self.high, wanted),
            Scaling::Log => labels::logarithmic(self.low, self.high, wanted),
        }
    }
}

/// Whether a pixel has a value, which is finite and not UNSEEN.
pub(super) fn is_seen(value: f64) -> bool {
    value.is_finite() && !is_unseen(value)
}
