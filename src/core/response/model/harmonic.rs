//! Visibilities of a band-limited sky by spherical harmonics, for satellites on one circle.

use std::sync::Arc;

use num_complex::Complex64;
use rayon::prelude::*;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::frames::AntennaResponse;
use crate::response::harmonic::{
    GeometryLimits, GeometryRefusal, HarmonicError, HarmonicModel, ModelSettings, NominalOrbit,
    PairOrientation, PairState, PatternGeometry, RotationTable,
};
use crate::sky::harmonics::Alm;
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Visibilities per batch: some twenty windows of the fiducial array at 10 MHz. Twice as many are no faster.
pub(super) const BATCH: usize = 100_000;

/// Maximum degree of the sky for auto-correlation powers: the coefficients of the visibility mask fall as l^-1.5, so
/// that higher degrees contribute 1e-4.
const POWERS_L_MAX: usize = 96;

const POSITIONS_PER_TASK: usize = 1024;

/// Parameters of a [`HarmonicSum`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarmonicSumSetup {
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Radius of the array's orbit, m.
    pub orbit_radius_m: f64,
    /// Inclination of the array's orbit, rad.
    pub inclination_rad: f64,
    /// Radius of the Moon, m.
    pub moon_radius_m: f64,
    /// Longest baseline, wavelengths.
    pub baseline_wavelengths_max: f64,
    /// Response of the daughters.
    pub response: AntennaResponse,
    /// Departures from the circle that are neglected.
    pub limits: GeometryLimits,
}

/// Visibilities of a sky given by harmonic coefficients, for an array on one circular orbit.
///
/// Rms error 1e-5 of the rms visibility of the same coefficients.
pub struct HarmonicSum {
    setup: HarmonicSumSetup,
    orbit: NominalOrbit,
    model: HarmonicModel,
    powers: HarmonicModel,
}

impl HarmonicSum {
    /// Builds the model of `sky` (K, ecliptic frame); takes seconds at l = 1024.
    ///
    /// Channels with the same band limit can share `rotation`.
    ///
    /// # Errors
    /// [`ModelError::Harmonic`].
    pub fn new(
        sky: Alm,
        setup: HarmonicSumSetup,
        rotation: Arc<RotationTable<f32>>,
    ) -> Result<Self, ModelError> {
        let refused = |source| harmonic(&setup, source);
        let geometry = PatternGeometry {
            orbit_radius_m: setup.orbit_radius_m,
            moon_radius_m: setup.moon_radius_m,
            wavelength_m: SPEED_OF_LIGHT_M_S / setup.frequency_hz,
            response: setup.response,
        };
        let settings = |u_max| ModelSettings::new(geometry, setup.inclination_rad, u_max);
        let smooth = truncate(&sky, POWERS_L_MAX);
        Ok(Self {
            setup,
            orbit: NominalOrbit {
                inclination_rad: setup.inclination_rad,
                radius_m: setup.orbit_radius_m,
                limits: setup.limits,
            },
            powers: HarmonicModel::new(smooth, settings(0.0)).map_err(refused)?,
            model: HarmonicModel::with_rotation(sky, settings(setup.baseline_wavelengths_max), rotation)
                .map_err(refused)?,
        })
    }

    /// Converts a position to its state on the orbit; `true` if satellite j leads.
    fn state(&self, position: &PairPosition) -> Result<(PairState, bool), GeometryRefusal> {
        let wavelength_m = SPEED_OF_LIGHT_M_S / self.setup.frequency_hz;
        let found = PairOrientation::of_pair(position.r_i_m, position.r_j_m)?;
        let pair = self.orbit.pair(&found, wavelength_m)?;
        Ok((PairState { span_rad: position.span_rad, ..pair.state }, pair.reversed))
    }

    fn states(&self, positions: &[PairPosition]) -> Result<Vec<(PairState, bool)>, GeometryRefusal> {
        positions.par_iter().with_min_len(POSITIONS_PER_TASK).map(|position| self.state(position)).collect()
    }
}

fn harmonic(setup: &HarmonicSumSetup, source: HarmonicError) -> ModelError {
    ModelError::Harmonic { frequency_hz: setup.frequency_hz, source }
}

fn truncate(sky: &Alm, l_max: usize) -> Alm {
    let mut truncated = Alm::zeros(l_max.min(sky.l_max()));
    for m in 0..=truncated.l_max() {
        let count = truncated.order(m).len();
        truncated.order_mut(m).copy_from_slice(&sky.order(m)[..count]);
    }
    truncated
}

impl VisibilityModel for HarmonicSum {
    fn batch(&self) -> usize {
        BATCH
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let frequency_hz = self.setup.frequency_hz;
        let refused =
            |refusal: GeometryRefusal| ModelError::Geometry { frequency_hz, refusal: refusal.into() };
        let (states, reversed): (Vec<PairState>, Vec<bool>) =
            self.states(positions).map_err(refused)?.into_iter().unzip();
        self.model.visibilities(&states, out).map_err(|source| harmonic(&self.setup, source))?;
        for (out, reversed) in out.iter_mut().zip(reversed) {
            if reversed {
                *out = out.conj();
            }
        }
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        let frequency_hz = self.setup.frequency_hz;
        let refused =
            |refusal: GeometryRefusal| ModelError::Geometry { frequency_hz, refusal: refusal.into() };
        let wavelength_m = SPEED_OF_LIGHT_M_S / self.setup.frequency_hz;
        let state = |daughter: &DaughterPosition| {
            let orientation = PairOrientation::of_satellite(daughter.r_m, daughter.normal_hat)?;
            Ok(self.orbit.pair(&orientation, wavelength_m)?.state)
        };
        let states: Result<Vec<PairState>, GeometryRefusal> = daughters.iter().map(state).collect();
        let states = states.map_err(refused)?;
        let mut values = vec![Complex64::ZERO; states.len()];
        self.powers.visibilities(&states, &mut values).map_err(|source| harmonic(&self.setup, source))?;
        for (out, value) in out.iter_mut().zip(values) {
            *out = value.re;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::response::model::DirectSum;
    use crate::sky::healpix::pixel_directions;
    use crate::sky::{Frame, SkyMap};
    use std::f64::consts::PI;

    #[test]
    fn powers_of_single_daughters_are_those_of_direct_sums() {
        const NSIDE: usize = 64;
        let array = Array::new(&ArrayConfig::default()).unwrap();
        // T = 3 + 2 (3 z^2 - 1): far from isotropic, so that the axis of a dipole matters.
        let mut alm = Alm::zeros(4);
        *alm.get_mut(0, 0) = (3.0 * (4.0 * PI).sqrt()).into();
        *alm.get_mut(2, 0) = (2.0 / (5.0 / (16.0 * PI)).sqrt()).into();
        let values = pixel_directions(NSIDE).iter().map(|n| 3.0 + 2.0 * (3.0 * n[2] * n[2] - 1.0)).collect();
        let sky = SkyMap::new(Frame::Ecliptic, values).unwrap();
        let daughters = [0.0, 1500.0, 3e6].map(|t_s| DaughterPosition {
            r_m: array.position_m(4, t_s),
            normal_hat: array.orbit_normal_hat(t_s),
            daughter_time: None,
        });
        for response in [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal] {
            let setup = HarmonicSumSetup {
                frequency_hz: 1e6,
                orbit_radius_m: array.orbit_radius_m(),
                inclination_rad: array.inclination_rad(),
                moon_radius_m: array.moon_radius_m(),
                baseline_wavelengths_max: 1.0,
                response,
                limits: GeometryLimits::default(),
            };
            let table = Arc::new(RotationTable::new(4, array.inclination_rad()));
            let mut harmonic = HarmonicSum::new(alm.clone(), setup, table).unwrap();
            let mut direct = DirectSum::new(&sky, 1e6, array.moon_radius_m(), response);
            let (mut found, mut expected) = ([0.0; 3], [0.0; 3]);
            harmonic.predict_powers(&daughters, &mut found).unwrap();
            direct.predict_powers(&daughters, &mut expected).unwrap();
            for (found, expected) in found.into_iter().zip(expected) {
                // Direct sums count the 4 nside pixels on the limb fully or not at all: a random error of half a pixel each.
                let limb = 0.5 * (4.0 * NSIDE as f64).sqrt() * 4.0 * PI / (12 * NSIDE * NSIDE) as f64;
                assert!((found - expected).abs() < 4.0 * 7.0 * limb, "{response:?}: {found} {expected}");
            }
        }
    }
}
