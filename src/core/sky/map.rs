//! HEALPix maps in memory.

use rayon::prelude::*;

use super::error::MapError;
use super::frame::{Frame, rotate};
use super::healpix::{
    is_valid_nside, nested_to_ring, nside_of, pixel_count, pixel_directions, ring_to_nested,
};
use crate::units::constants::HEALPIX_UNSEEN;
use crate::units::vector::Vec3;

const PIXELS_PER_TASK: usize = 4096;

/// Maximum temperature of a sky, K: above any source below 100 MHz, even solar bursts (1e15 K), and low enough that the square of a
/// visibility and its inverse stay within single precision.
pub const TEMPERATURE_K_MAX: f64 = 1e16;

/// Maximum power of ten by which UNSEEN may have been scaled: the result is still beyond any temperature.
const UNSEEN_DECADES: f64 = 13.0;

/// A HEALPix map in RING order, in K unless stated otherwise.
#[derive(Clone, Debug, PartialEq)]
pub struct SkyMap {
    nside: usize,
    frame: Frame,
    values: Vec<f64>,
}

/// Whether a value is UNSEEN: within 1e-5 of -1.6375e30, as in healpy, so that its single-precision form counts.
#[inline]
#[must_use]
pub fn is_unseen(value: f64) -> bool {
    (value - HEALPIX_UNSEEN).abs() <= 1e-5 * HEALPIX_UNSEEN.abs()
}

/// Whether a value is UNSEEN times a power of ten, as it is after a conversion of units.
fn is_scaled_unseen(value: f64) -> bool {
    let decades = (value / HEALPIX_UNSEEN).log10();
    // Single precision keeps seven digits.
    decades.abs() <= UNSEEN_DECADES && (decades - decades.round()).abs() < 1e-6 || is_unseen(value)
}

impl SkyMap {
    /// Creates a map from values in RING order.
    ///
    /// # Errors
    /// [`MapError::PixelCount`] if their number is not 12 nside^2.
    pub fn new(frame: Frame, values: Vec<f64>) -> Result<Self, MapError> {
        let nside = nside_of(values.len()).ok_or(MapError::PixelCount { pixels: values.len() })?;
        Ok(Self { nside, frame, values })
    }

    /// Creates a constant map.
    ///
    /// # Errors
    /// [`MapError::Nside`].
    pub fn constant(nside: usize, frame: Frame, value: f64) -> Result<Self, MapError> {
        check_nside(nside)?;
        Ok(Self { nside, frame, values: vec![value; pixel_count(nside)] })
    }

    /// Resolution parameter.
    #[must_use]
    pub fn nside(&self) -> usize {
        self.nside
    }

    /// Celestial frame.
    #[must_use]
    pub fn frame(&self) -> Frame {
        self.frame
    }

    /// Values in RING order.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Mutable values in RING order.
    #[doc(hidden)]
    pub fn values_mut(&mut self) -> &mut [f64] {
        &mut self.values
    }

    /// Consumes the map and returns its values in RING order.
    #[must_use]
    pub fn into_values(self) -> Vec<f64> {
        self.values
    }

    /// Creates a map of other values with the nside of this one.
    pub(super) fn with_values(&self, frame: Frame, values: Vec<f64>) -> Self {
        debug_assert_eq!(values.len(), self.values.len());
        Self { nside: self.nside, frame, values }
    }

    /// Directions of the map's pixel centres on ecliptic axes, in the order of its values, so that maps in any
    /// frame need no interpolation.
    #[must_use]
    pub fn directions_ecliptic(&self) -> Vec<Vec3> {
        let mut directions = pixel_directions(self.nside);
        if self.frame != Frame::Ecliptic {
            let rotation = self.frame.to_ecliptic();
            for direction in &mut directions {
                *direction = rotate(&rotation, *direction);
            }
        }
        directions
    }

    /// Averages the map down to `nside`. UNSEEN children are ignored; a pixel that has only such children is UNSEEN.
    ///
    /// # Errors
    /// [`MapError::Nside`]; [`MapError::Direction`] if `nside` is above the map's own.
    #[doc(hidden)]
    pub fn degrade(&self, nside: usize) -> Result<Self, MapError> {
        check_nside(nside)?;
        if nside > self.nside {
            let expected = "at most its own nside";
            return Err(MapError::Direction { verb: "degraded", from: self.nside, to: nside, expected });
        }
        if nside == self.nside {
            return Ok(self.clone());
        }
        let children = (self.nside / nside).pow(2);
        Ok(self.of_nested(nside, |nested| {
            let child = |c| self.values[nested_to_ring(self.nside, nested * children + c)];
            mean_of_seen((0..children).map(child))
        }))
    }

    /// Averages or splits the pixels of the map to `nside`.
    ///
    /// # Errors
    /// [`MapError::Nside`] unless `nside` is a valid power of two.
    pub fn resized(&self, nside: usize) -> Result<Self, MapError> {
        if nside <= self.nside { self.degrade(nside) } else { self.upgrade(nside) }
    }

    /// Splits every pixel into its children at `nside`.
    ///
    /// # Errors
    /// [`MapError::Nside`]; [`MapError::Direction`] if `nside` is below the map's own.
    #[doc(hidden)]
    pub fn upgrade(&self, nside: usize) -> Result<Self, MapError> {
        check_nside(nside)?;
        if nside < self.nside {
            let expected = "at least its own nside";
            return Err(MapError::Direction { verb: "upgraded", from: self.nside, to: nside, expected });
        }
        if nside == self.nside {
            return Ok(self.clone());
        }
        let children = (nside / self.nside).pow(2);
        Ok(self.of_nested(nside, |nested| self.values[nested_to_ring(self.nside, nested / children)]))
    }

    /// A map of this frame with the values of the pixels at `nside`, by their nested index.
    fn of_nested(&self, nside: usize, value_of: impl Fn(usize) -> f64 + Sync) -> Self {
        let mut values = vec![0.0; pixel_count(nside)];
        values.par_chunks_mut(PIXELS_PER_TASK).enumerate().for_each(|(task, chunk)| {
            for (k, value) in chunk.iter_mut().enumerate() {
                *value = value_of(ring_to_nested(nside, task * PIXELS_PER_TASK + k));
            }
        });
        Self { nside, frame: self.frame, values }
    }

    /// Checks that every pixel is a temperature of a sky, of at most 1e16 K in magnitude. Pixels may be negative, as in filtered
    /// maps, because only the power that a satellite receives matters.
    ///
    /// # Errors
    /// [`MapError::NoTemperature`] with the number of bad pixels and the first of them.
    #[doc(hidden)]
    pub fn check_temperatures(&self) -> Result<(), MapError> {
        let bad = |&(_, value): &(usize, &f64)| !(-TEMPERATURE_K_MAX..=TEMPERATURE_K_MAX).contains(value);
        let mut pixels = self.values.iter().enumerate().filter(bad);
        match pixels.next() {
            None => Ok(()),
            Some((first, &value)) => {
                let (count, total, most) = (1 + pixels.count(), self.values.len(), TEMPERATURE_K_MAX);
                Err(MapError::NoTemperature { count, total, first, value, most })
            }
        }
    }

    /// Checks that every pixel has a usable value.
    ///
    /// # Errors
    /// [`MapError::BadPixels`] with the number of pixels that are NaN, infinite or UNSEEN (in any unit), and the first of them.
    #[doc(hidden)]
    pub fn check_whole(&self) -> Result<(), MapError> {
        let bad = |&(_, &value): &(usize, &f64)| !value.is_finite() || is_scaled_unseen(value);
        let mut pixels = self.values.iter().enumerate().filter(bad);
        match pixels.next() {
            None => Ok(()),
            Some((first, &value)) => {
                let total = self.values.len();
                Err(MapError::BadPixels { count: 1 + pixels.count(), total, first, value })
            }
        }
    }
}

pub(super) fn check_nside(nside: usize) -> Result<(), MapError> {
    if is_valid_nside(nside) { Ok(()) } else { Err(MapError::Nside { nside }) }
}

fn mean_of_seen(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0_u32);
    for value in values.filter(|&value| !is_unseen(value)) {
        sum += value;
        count += 1;
    }
    if count == 0 { HEALPIX_UNSEEN } else { sum / f64::from(count) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::vector::dot;

    fn ramp(nside: usize) -> SkyMap {
        SkyMap::new(Frame::Galactic, (0..pixel_count(nside)).map(|p| p as f64).collect()).unwrap()
    }

    #[test]
    fn splitting_and_averaging_are_inverse() {
        let map = ramp(8);
        // Sums of 16 equal integers below 2^53 and their division by 16 are exact.
        assert_eq!(map.upgrade(32).unwrap().degrade(8).unwrap(), map);
    }

    #[test]
    fn children_lie_around_their_parent() {
        let fine = SkyMap::new(Frame::Ecliptic, (0..pixel_count(64)).map(|p| p as f64).collect()).unwrap();
        let parents = ramp(8).upgrade(64).unwrap();
        let coarse = pixel_directions(8);
        for (direction, &parent) in fine.directions_ecliptic().iter().zip(parents.values()) {
            // A pixel's corner is at most 1.2 times its side, sqrt(4 pi / 768) = 0.128, from its centre.
            assert!(dot(*direction, coarse[parent as usize]) > (0.128_f64 * 1.2).cos());
        }
    }

    #[test]
    fn unseen_children_do_not_count() {
        let mut map = SkyMap::constant(2, Frame::Ecliptic, 3.0).unwrap();
        map.values_mut()[nested_to_ring(2, 0)] = HEALPIX_UNSEEN;
        for child in 4..8 {
            map.values_mut()[nested_to_ring(2, child)] = f64::from(HEALPIX_UNSEEN as f32);
        }
        let coarse = map.degrade(1).unwrap();
        assert_eq!(coarse.values()[nested_to_ring(1, 0)], 3.0);
        assert!(is_unseen(coarse.values()[nested_to_ring(1, 1)]));
        let count = coarse.values().iter().filter(|&&value| value == 3.0).count();
        assert_eq!(count, 11);
    }

    #[test]
    fn bad_pixels_are_counted() {
        let mut map = ramp(4);
        assert_eq!(map.check_whole(), Ok(()));
        map.values_mut()[7] = HEALPIX_UNSEEN;
        map.values_mut()[100] = f64::NAN;
        map.values_mut()[101] = f64::INFINITY;
        let expected = MapError::BadPixels { count: 3, total: 192, first: 7, value: HEALPIX_UNSEEN };
        assert_eq!(map.check_whole(), Err(expected));
    }

    #[test]
    fn what_is_no_temperature_is_named() {
        let mut map = ramp(4);
        assert_eq!(map.check_temperatures(), Ok(()));
        for value in [-1e17, 1e307, f64::NAN, f64::INFINITY] {
            map.values_mut()[9] = value;
            map.values_mut()[150] = -1e20;
            map.values_mut()[151] = -1.0;
            let text = map.check_temperatures().unwrap_err().to_string();
            assert!(text.contains("2 of 192 pixels") && text.contains("pixel 9 with"), "{text}");
            assert!(text.contains(&format!("{value:e} K")), "{text}");
        }
    }

    #[test]
    fn senseless_sizes_are_refused() {
        assert_eq!(SkyMap::new(Frame::Ecliptic, vec![0.0; 13]), Err(MapError::PixelCount { pixels: 13 }));
        assert_eq!(SkyMap::new(Frame::Ecliptic, vec![]), Err(MapError::PixelCount { pixels: 0 }));
        assert_eq!(ramp(4).degrade(3), Err(MapError::Nside { nside: 3 }));
        assert!(matches!(ramp(4).degrade(8), Err(MapError::Direction { .. })));
        assert!(matches!(ramp(4).upgrade(2), Err(MapError::Direction { .. })));
    }
}
