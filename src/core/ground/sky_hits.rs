//! Number of visibilities for which each direction of the sky was above the lunar limb.

use serde::Serialize;

use crate::array::hidden_by_moon;
use crate::frames::PlacedVisibilities;
use crate::sky::healpix::{pixel_count, pixel_directions, pixel_of};
use crate::units::vector::{Vec3, norm, scale};

/// nside of the map and of the histogram of pair midpoints. Its pixels are 3.7 degrees wide.
const NSIDE: usize = 16;

/// Stride of counted visibilities.
const EVERY: u64 = 8;

/// Histogram of the selenocentric directions of pair midpoints for the visibilities of one channel. It is cheap to update; the
/// occultation by the Moon is computed on request.
#[derive(Clone, Debug)]
pub struct SkyHits {
    frequency_hz: f64,
    visibilities: u64,
    /// Counted visibilities by the direction of the pair midpoint, RING order.
    midpoints: Vec<u64>,
    counted: u64,
    /// Sum of the distances of the midpoints from the centre of the Moon, m.
    radius_sum_m: f64,
}

/// Map of the number of visibilities by direction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HitsMap {
    /// Centre frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// Visibilities so far.
    pub visibilities: u64,
    /// Stride of counted visibilities, beginning with the first.
    pub every: u64,
    /// nside of the map.
    pub nside: usize,
    /// Visibilities for which the Moon did not occult the direction, RING order, ecliptic axes. Midpoints are rounded to pixel
    /// centres of this nside, so that the limb is accurate to two degrees.
    pub hits: Vec<u64>,
}

impl SkyHits {
    /// An empty histogram for a channel at a frequency, Hz.
    #[must_use]
    pub fn new(frequency_hz: f64) -> Self {
        let midpoints = vec![0; pixel_count(NSIDE)];
        Self { frequency_hz, visibilities: 0, midpoints, counted: 0, radius_sum_m: 0.0 }
    }

    /// Counts visibilities. Forged positions without a direction are not in the histogram.
    pub fn add(&mut self, placed: &PlacedVisibilities) {
        let first = (EVERY - self.visibilities % EVERY) % EVERY;
        self.visibilities += placed.len() as u64;
        for (r_i_m, r_j_m) in
            placed.r_i_m.iter().zip(&placed.r_j_m).skip(first as usize).step_by(EVERY as usize)
        {
            let midpoint_m: Vec3 = std::array::from_fn(|k| 0.5 * (r_i_m[k] + r_j_m[k]));
            let radius_m = norm(midpoint_m);
            if radius_m.is_normal() && radius_m < 1e12 {
                self.midpoints[pixel_of(NSIDE, scale(radius_m.recip(), midpoint_m))] += 1;
                self.counted += 1;
                self.radius_sum_m += radius_m;
            }
        }
    }

    /// Computes the map for a Moon of this radius, m, with some ten million comparisons.
    #[must_use]
    pub fn map(&self, moon_radius_m: f64) -> HitsMap {
        let directions = pixel_directions(NSIDE);
        let radius_m = self.radius_sum_m / self.counted.max(1) as f64;
        let mut hits = vec![0; directions.len()];
        for (count, midpoint) in self.midpoints.iter().zip(&directions).filter(|(count, _)| **count > 0) {
            let midpoint_m = scale(radius_m, *midpoint);
            for (hits, n_hat) in hits.iter_mut().zip(&directions) {
                if !hidden_by_moon(midpoint_m, *n_hat, moon_radius_m) {
                    *hits += EVERY * count;
                }
            }
        }
        let Self { frequency_hz, visibilities, .. } = *self;
        HitsMap { frequency_hz, visibilities, every: EVERY, nside: NSIDE, hits }
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;
    use crate::units::vector::dot;

    /// Visibilities of a 2 km pair with these midpoints.
    fn placed(middles_m: &[Vec3]) -> PlacedVisibilities {
        let count = middles_m.len();
        let side = |by_m: f64| middles_m.iter().map(|r| [r[0], r[1], r[2] + by_m]).collect();
        PlacedVisibilities {
            frequency_hz: 1e7,
            time_s: vec![0.0; count],
            r_i_m: side(-1e3),
            r_j_m: side(1e3),
            value_k_sr: vec![Complex64::ZERO; count],
            weight: vec![1.0; count],
            ..PlacedVisibilities::default()
        }
    }

    #[test]
    fn a_direction_has_the_visibilities_for_which_the_moon_is_not_before_it() {
        let (moon_m, radius_m) = (1.7371e6, 2.0371e6);
        let turn = |k: usize| 0.1 * k as f64;
        let middles: Vec<Vec3> =
            (0..400).map(|k| [radius_m * turn(k).cos(), radius_m * turn(k).sin(), 0.0]).collect();
        let mut whole = SkyHits::new(1e7);
        whole.add(&placed(&middles));
        let mut parts = SkyHits::new(1e7);
        middles.chunks(7).for_each(|part| parts.add(&placed(part)));
        let map = whole.map(moon_m);
        assert_eq!(map, parts.map(moon_m));
        assert_eq!((map.visibilities, map.hits.len()), (400, 3072));
        // Counted by the angles from the centre of the Moon and of the limb; directions within the rounding may be either.
        let limb = (moon_m / radius_m).asin();
        let blur = 2.6_f64.to_radians();
        for (n_hat, hits) in pixel_directions(16).iter().zip(&map.hits) {
            let seen = |margin: f64| {
                let from_moon = |r: &&Vec3| (-dot(**r, *n_hat) / radius_m).clamp(-1.0, 1.0).acos();
                8 * middles.iter().step_by(8).filter(|r| from_moon(r) > limb + margin).count() as u64
            };
            assert!((seen(blur)..=seen(-blur)).contains(hits), "{n_hat:?}: {hits}");
        }
        // The poles of the orbit are always seen.
        assert_eq!(map.hits[0], 400);
    }

    #[test]
    fn forged_positions_are_in_no_place() {
        let mut hits = SkyHits::new(1e7);
        for x in [f64::NAN, f64::INFINITY, -1e300] {
            hits.add(&placed(&[[x, 0.0, 0.0]; 8]));
        }
        assert_eq!(hits.map(1.7371e6).hits.iter().sum::<u64>(), 0);
    }
}
