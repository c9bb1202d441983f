//! How many visibilities saw each direction of the sky.

use serde::Serialize;

use crate::array::hidden_by_moon;
use crate::frames::PlacedVisibilities;
use crate::sky::healpix::{pixel_count, pixel_directions, pixel_of};
use crate::units::vector::{Vec3, norm, scale};

/// nside of the sky's directions and of the pairs' directions: pixels of 3.7 degrees.
const NSIDE: usize = 16;

/// Every n-th visibility is counted.
const EVERY: u64 = 8;

/// Where the middles of pairs stood, seen from the Moon, at the visibilities of one channel. That costs little per visibility; what
/// the Moon hid from them is worked out when somebody asks.
#[derive(Clone, Debug)]
pub struct SkyHits {
    frequency_hz: f64,
    visibilities: u64,
    /// Counted ones by the direction of the middle, RING order.
    places: Vec<u64>,
    counted: u64,
    /// Sum of the distances of the middles from the Moon's, m.
    radius_sum_m: f64,
}

/// Visibilities by direction.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct HitsMap {
    /// Centre frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// Visibilities so far.
    pub visibilities: u64,
    /// Every n-th is counted, beginning with the first.
    pub every: u64,
    /// nside of the map.
    pub nside: usize,
    /// Visibilities for which the Moon did not hide the direction, RING order, ecliptic axes. Pairs stand in the middles of pixels
    /// of this nside: a limb is off by up to two degrees.
    pub hits: Vec<u64>,
}

impl SkyHits {
    /// Nothing at a frequency, Hz.
    #[must_use]
    pub fn new(frequency_hz: f64) -> Self {
        let places = vec![0; pixel_count(NSIDE)];
        Self { frequency_hz, visibilities: 0, places, counted: 0, radius_sum_m: 0.0 }
    }

    /// Counts visibilities. Those without a direction, which are forged, are in no place.
    pub fn add(&mut self, placed: &PlacedVisibilities) {
        let first = (EVERY - self.visibilities % EVERY) % EVERY;
        self.visibilities += placed.len() as u64;
        for (r_i_m, r_j_m) in
            placed.r_i_m.iter().zip(&placed.r_j_m).skip(first as usize).step_by(EVERY as usize)
        {
            let middle_m: Vec3 = std::array::from_fn(|k| 0.5 * (r_i_m[k] + r_j_m[k]));
            let radius_m = norm(middle_m);
            if radius_m.is_normal() && radius_m < 1e12 {
                self.places[pixel_of(NSIDE, scale(radius_m.recip(), middle_m))] += 1;
                self.counted += 1;
                self.radius_sum_m += radius_m;
            }
        }
    }

    /// The map, for a Moon of this radius, m. Some ten million comparisons.
    #[must_use]
    pub fn map(&self, moon_radius_m: f64) -> HitsMap {
        let directions = pixel_directions(NSIDE);
        let radius_m = self.radius_sum_m / self.counted.max(1) as f64;
        let mut hits = vec![0; directions.len()];
        for (count, place) in self.places.iter().zip(&directions).filter(|(count, _)| **count > 0) {
            let stands_m = scale(radius_m, *place);
            for (hits, n_hat) in hits.iter_mut().zip(&directions) {
                if !hidden_by_moon(stands_m, *n_hat, moon_radius_m) {
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

    /// Visibilities of a pair 2 km apart whose middle stands there.
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
        // By the angle from the Moon's middle and the limb's, counted one by one; those within the blur may go either way.
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
