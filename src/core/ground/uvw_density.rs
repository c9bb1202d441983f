//! Density of the baselines in the uvw space.

use serde::Serialize;

use crate::frames::PlacedVisibilities;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, scale, sub};

/// Cells along a side of a plane; a multiple of four.
const CELLS: usize = 64;

/// Stride of counted visibilities. A baseline moves by an eighth of a wavelength between visibilities, so that a cell is
/// crossed in many more visibilities than this.
const EVERY: u64 = 8;

/// Maximum half side of a plane, wavelengths. 2^22 is longer than any baseline in lunar orbit at the observed frequencies.
const EXTENT_WAVELENGTHS_MAX: f64 = 4_194_304.0;

/// Horizontal and vertical axis of each plane.
const PLANES: [[usize; 2]; 3] = [[0, 1], [0, 2], [1, 2]];

/// Histogram of the baselines `r_i - r_j` of one channel in the planes u-v, u-w and v-w, on Moon-centred ecliptic axes.
///
/// Only one sign of each baseline is counted. The planes grow by factors of two with the longest baseline, so that counts are kept.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct UvwDensity {
    /// Centre frequency of the channel, Hz.
    pub frequency_hz: f64,
    /// Visibilities so far.
    pub visibilities: u64,
    /// Stride of counted visibilities, beginning with the first.
    pub every: u64,
    /// Counted visibilities whose baseline is too long for the planes.
    pub beyond: u64,
    /// Half side of a plane, wavelengths: cells extend from minus this to this.
    pub extent_wavelengths: f64,
    /// Cells along a side.
    pub cells: usize,
    /// Counts in the planes u-v, u-w and v-w, in rows of rising second axis.
    pub planes: [Vec<u64>; 3],
}

impl UvwDensity {
    /// An empty histogram for a channel at a frequency, Hz.
    #[must_use]
    pub fn new(frequency_hz: f64) -> Self {
        Self {
            frequency_hz,
            visibilities: 0,
            every: EVERY,
            beyond: 0,
            extent_wavelengths: 1.0,
            cells: CELLS,
            planes: [(); 3].map(|()| vec![0; CELLS * CELLS]),
        }
    }

    /// Counts the baselines of visibilities.
    pub fn add(&mut self, placed: &PlacedVisibilities) {
        let first = (EVERY - self.visibilities % EVERY) % EVERY;
        self.visibilities += placed.len() as u64;
        let per_m = placed.frequency_hz / SPEED_OF_LIGHT_M_S;
        for (r_i_m, r_j_m) in
            placed.r_i_m.iter().zip(&placed.r_j_m).skip(first as usize).step_by(EVERY as usize)
        {
            self.count(scale(per_m, sub(*r_i_m, *r_j_m)));
        }
    }

    fn count(&mut self, uvw: Vec3) {
        let longest = uvw.iter().fold(0.0, |longest: f64, x| longest.max(x.abs()));
        // NaN counts as too long.
        if !uvw.iter().all(|x| x.abs() < EXTENT_WAVELENGTHS_MAX) {
            self.beyond += 1;
            return;
        }
        while longest >= self.extent_wavelengths {
            self.widen();
        }
        let cell = |axis: usize| ((uvw[axis] / self.extent_wavelengths + 1.0) * (CELLS / 2) as f64) as usize;
        for (plane, [x, y]) in self.planes.iter_mut().zip(PLANES) {
            plane[cell(y).min(CELLS - 1) * CELLS + cell(x).min(CELLS - 1)] += 1;
        }
    }

    /// Doubles the side of the planes by merging cells.
    fn widen(&mut self) {
        self.extent_wavelengths *= 2.0;
        for plane in &mut self.planes {
            let mut wide = vec![0; CELLS * CELLS];
            let cell = |k: usize| CELLS / 4 + k / 2;
            for (k, count) in plane.iter().enumerate().filter(|(_, count)| **count > 0) {
                wide[cell(k / CELLS) * CELLS + cell(k % CELLS)] += count;
            }
            *plane = wide;
        }
    }
}

#[cfg(test)]
mod tests {
    use num_complex::Complex64;

    use super::*;

    /// Visibilities at one wavelength a metre with these baselines.
    fn placed(uvw: &[Vec3]) -> PlacedVisibilities {
        let count = uvw.len();
        PlacedVisibilities {
            frequency_hz: SPEED_OF_LIGHT_M_S,
            time_s: vec![0.0; count],
            r_i_m: uvw.to_vec(),
            r_j_m: vec![[0.0; 3]; count],
            value_k_sr: vec![Complex64::ZERO; count],
            weight: vec![1.0; count],
            ..PlacedVisibilities::default()
        }
    }

    #[test]
    fn every_eighth_baseline_is_in_its_cell_however_blocks_are_split_and_planes_grow() {
        let baseline = |k: usize| {
            let (x, turn) = (0.37 * k as f64, 0.1 * k as f64);
            [x * turn.cos(), -x * turn.sin(), 0.3 - 0.2 * x]
        };
        let all: Vec<Vec3> = (0..1000).map(baseline).collect();
        let mut whole = UvwDensity::new(SPEED_OF_LIGHT_M_S);
        whole.add(&placed(&all));
        let mut parts = UvwDensity::new(SPEED_OF_LIGHT_M_S);
        let mut from = 0;
        for length in [3, 1, 0, 5, 17, 8, 500, 466] {
            parts.add(&placed(&all[from..from + length]));
            from += length;
        }
        assert_eq!(whole, parts);
        // The longest is 0.37 times 999 wavelengths.
        assert_eq!((whole.visibilities, whole.beyond, whole.extent_wavelengths), (1000, 0, 512.0));
        let side = |x: f64| ((x + 512.0) / 16.0).floor() as usize;
        for (plane, [x, y]) in whole.planes.iter().zip([[0, 1], [0, 2], [1, 2]]) {
            let mut expected = vec![0; 64 * 64];
            all.iter().step_by(8).for_each(|uvw| expected[64 * side(uvw[y]) + side(uvw[x])] += 1);
            assert_eq!(plane, &expected);
        }
    }

    #[test]
    fn forged_positions_are_counted_and_in_no_cell() {
        let mut density = UvwDensity::new(SPEED_OF_LIGHT_M_S);
        for x in [f64::NAN, f64::INFINITY, -1e300, 4_194_304.0, 1.0] {
            density.add(&placed(&[[x, 0.0, 0.0]; 8]));
        }
        assert_eq!((density.visibilities, density.beyond), (40, 4));
        assert_eq!(density.planes.each_ref().map(|plane| plane.iter().sum::<u64>()), [1; 3]);
    }
}
