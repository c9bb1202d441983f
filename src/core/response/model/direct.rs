//! Visibilities by direct sums over the pixels of a sky.

use faer::{Accum, MatMut, MatRef, Par};
use num_complex::Complex64;
use rayon::prelude::*;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::frames::AntennaResponse;
use crate::response::pixel::exact::centre_row;
use crate::response::pixel::{
    Comb, Directions, PairGeometry, SingleGeometry, comb_sums, four_sky_sums, sky_powers, sky_sums,
};
use crate::sky::SkyMap;
use crate::sky::healpix::pixel_area_sr;
use crate::units::vector::Vec3;

/// Direct sum of a sky over the centres of its own pixels, without resampling.
///
/// It costs one fringe per pixel and visibility.
#[derive(Clone, Debug)]
pub struct DirectSum {
    frequency_hz: f64,
    directions: Directions,
    /// K.
    values: Vec<f32>,
    area_sr: f64,
    moon_radius_m: f64,
    response: AntennaResponse,
}

impl DirectSum {
    /// Builds the sum over `sky` (K, any frame) at `frequency_hz`.
    #[must_use]
    pub fn new(sky: &SkyMap, frequency_hz: f64, moon_radius_m: f64, response: AntennaResponse) -> Self {
        Self {
            frequency_hz,
            directions: Directions::from(sky.directions_ecliptic().as_slice()),
            values: sky.values().iter().map(|&value| value as f32).collect(),
            area_sr: pixel_area_sr(sky.nside()),
            moon_radius_m,
            response,
        }
    }
}

impl DirectSum {
    /// Directions of the pixels, their values (K) and their area, sr.
    pub(super) fn sky(&self) -> (&Directions, &[f32], f64) {
        (&self.directions, &self.values, self.area_sr)
    }

    pub(super) fn single(&self, daughter: &DaughterPosition) -> SingleGeometry {
        SingleGeometry {
            r_m: daughter.r_m,
            normal_hat: daughter.normal_hat,
            moon_radius_m: self.moon_radius_m,
            response: self.response,
        }
    }

    pub(super) fn pairs(&self, positions: &[PairPosition]) -> Result<Vec<PairGeometry>, ModelError> {
        if positions.iter().any(|position| position.span_rad != 0.0) {
            return Err(ModelError::Smearing { frequency_hz: self.frequency_hz });
        }
        let pair = |position: &PairPosition| PairGeometry {
            r_i_m: position.r_i_m,
            r_j_m: position.r_j_m,
            frequency_hz: self.frequency_hz,
            moon_radius_m: self.moon_radius_m,
            response: self.response,
        };
        let pairs: Vec<PairGeometry> = positions.iter().map(pair).collect();
        let dipoles = self.response == AntennaResponse::DipoleNormal;
        if dipoles && pairs.iter().any(|pair| pair.orbit_normal().is_none()) {
            return Err(ModelError::NoPlane { frequency_hz: self.frequency_hz });
        }
        Ok(pairs)
    }
}

/// Direct sum with its first moments over the direction, from which its derivatives with respect to the baseline follow.
#[derive(Clone, Debug)]
pub struct DirectMoments {
    sum: DirectSum,
    /// The sky times each component of its direction, K.
    moments: [Vec<f32>; 3],
}

impl DirectMoments {
    /// Builds the model of `sky` (K, any frame) at `frequency_hz`.
    #[must_use]
    pub fn new(sky: &SkyMap, frequency_hz: f64, moon_radius_m: f64, response: AntennaResponse) -> Self {
        let directions = sky.directions_ecliptic();
        let moment = |axis: usize| {
            sky.values().iter().zip(&directions).map(|(value, n_hat)| (value * n_hat[axis]) as f32).collect()
        };
        let moments = [moment(0), moment(1), moment(2)];
        Self { sum: DirectSum::new(sky, frequency_hz, moon_radius_m, response), moments }
    }

    /// Predicts the visibility of each position, and the sums weighted by the x, y and z of the direction on ecliptic axes, K sr.
    ///
    /// # Errors
    /// As [`VisibilityModel::predict`].
    pub fn predict(&self, positions: &[PairPosition]) -> Result<Vec<[Complex64; 4]>, ModelError> {
        let pairs = self.sum.pairs(positions)?;
        let [x, y, z] = self.moments.each_ref().map(Vec::as_slice);
        let skies_k = [&self.sum.values[..], x, y, z];
        // Lengths agree by construction, so the sums cannot fail.
        Ok(four_sky_sums(&pairs, &self.sum.directions, skies_k, self.sum.area_sr).unwrap_or_default())
    }
}

const ROWS: usize = 16;

impl DirectMoments {
    /// Directions of the sky's pixels.
    #[must_use]
    pub fn directions(&self) -> Vec<Vec3> {
        let directions = &self.sum.directions;
        (0..directions.len()).map(|k| directions.get(k)).collect()
    }

    /// Sums the sky weighted by functions of the direction, K sr: for each position the real parts of all functions, then
    /// the imaginary parts. `functions` holds their values at [`Self::directions`], direction by direction.
    ///
    /// # Errors
    /// As [`VisibilityModel::predict`].
    pub fn weighted_sums(
        &self,
        positions: &[PairPosition],
        functions: &[f32],
    ) -> Result<Vec<f32>, ModelError> {
        let pairs = self.sum.pairs(positions)?;
        let directions = self.directions();
        let count = functions.len() / directions.len().max(1);
        let mut sums = vec![0.0; 2 * count * pairs.len()];
        if count == 0 {
            return Ok(sums);
        }
        sums.par_chunks_mut(2 * count * ROWS).zip(pairs.par_chunks(ROWS)).for_each(|(sums, pairs)| {
            let mut rows = Vec::with_capacity(2 * pairs.len() * directions.len());
            for pair in pairs {
                let row = centre_row(pair, &directions);
                let scaled =
                    |(value, kelvin): (f64, &f32)| (value * self.sum.area_sr * f64::from(*kelvin)) as f32;
                let values = &self.sum.values;
                rows.extend(row.iter().map(|value| value.re).zip(values).map(scaled));
                rows.extend(row.iter().map(|value| value.im).zip(values).map(scaled));
            }
            faer::linalg::matmul::matmul(
                MatMut::from_row_major_slice_mut(sums, 2 * pairs.len(), count),
                Accum::Replace,
                MatRef::from_row_major_slice(&rows, 2 * pairs.len(), directions.len()),
                MatRef::from_row_major_slice(functions, directions.len(), count),
                1.0,
                Par::Seq,
            );
        });
        Ok(sums)
    }
}

impl VisibilityModel for DirectSum {
    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let pairs = self.pairs(positions)?;
        // Lengths agree by construction, so the sums cannot fail.
        let sums = sky_sums(&pairs, &self.directions, &self.values, self.area_sr).unwrap_or_default();
        for (out, sum) in out.iter_mut().zip(sums) {
            *out = sum.visibility_k_sr;
        }
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        let singles: Vec<SingleGeometry> = daughters.iter().map(|daughter| self.single(daughter)).collect();
        // Lengths agree by construction, so the sums cannot fail.
        let powers = sky_powers(&singles, &self.directions, &self.values, self.area_sr).unwrap_or_default();
        for (out, power) in out.iter_mut().zip(powers) {
            *out = power;
        }
        Ok(())
    }

    fn predict_comb(
        &mut self,
        positions: &[PairPosition],
        comb: Comb,
        out: &mut [Complex64],
    ) -> Result<(), ModelError> {
        let pairs = self.pairs(positions)?;
        // Lengths agree by construction, so the sums cannot fail.
        let sums = comb_sums(&pairs, comb, &self.directions, &self.values, self.area_sr).unwrap_or_default();
        for (out, sum) in out.iter_mut().zip(sums) {
            *out = sum;
        }
        Ok(())
    }
}
