//! A model of short baselines only.

use num_complex::Complex64;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};

/// Another model on baselines up to a limit; longer ones see nothing.
///
/// A map holds nothing of what the longer ones resolve: its pixels would be points to them.
pub struct WithinBaselines {
    model: Box<dyn VisibilityModel>,
    longest_m: f64,
}

impl WithinBaselines {
    /// The model of a sky at a frequency, Hz, up to a limit, wavelengths.
    #[must_use]
    pub fn new(model: Box<dyn VisibilityModel>, frequency_hz: f64, longest_wavelengths: f64) -> Self {
        Self { model, longest_m: longest_wavelengths * SPEED_OF_LIGHT_M_S / frequency_hz }
    }
}

impl VisibilityModel for WithinBaselines {
    fn batch(&self) -> usize {
        self.model.batch()
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let is_short = |pair: &&PairPosition| norm(sub(pair.r_i_m, pair.r_j_m)) <= self.longest_m;
        let short: Vec<PairPosition> = positions.iter().filter(is_short).copied().collect();
        let mut values = vec![Complex64::ZERO; short.len()];
        if !short.is_empty() {
            self.model.predict(&short, &mut values)?;
        }
        let mut values = values.into_iter();
        for (out, pair) in out.iter_mut().zip(positions) {
            *out = if is_short(&pair) { values.next().unwrap_or_default() } else { Complex64::ZERO };
        }
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        self.model.predict_powers(daughters, out)
    }

    fn has_individual_antennas(&self) -> bool {
        self.model.has_individual_antennas()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::AntennaResponse;
    use crate::response::model::DirectSum;
    use crate::sky::{Frame, SkyMap};

    #[test]
    fn long_baselines_see_nothing_and_short_ones_all() {
        let sky = SkyMap::constant(4, Frame::Ecliptic, 100.0).unwrap();
        let direct = || DirectSum::new(&sky, 1e7, 1.7371e6, AntennaResponse::Isotropic);
        let pair = |length_m: f64| PairPosition {
            r_i_m: [2e6, length_m, 0.0],
            r_j_m: [2e6, 0.0, 0.0],
            ..PairPosition::default()
        };
        // 29.98 m a wavelength.
        let positions = [pair(90.0), pair(20.0), pair(59.0), pair(60.5)];
        let mut within = WithinBaselines::new(Box::new(direct()), 1e7, 2.0);
        let (mut found, mut all) = ([Complex64::ONE; 4], [Complex64::ZERO; 4]);
        within.predict(&positions, &mut found).unwrap();
        direct().predict(&positions, &mut all).unwrap();
        assert_eq!(found, [Complex64::ZERO, all[1], all[2], Complex64::ZERO]);
    }
}
