//! The thermal emission of the Moon.

use std::f64::consts::{PI, TAU};

use num_complex::Complex64;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel};
use crate::frames::AntennaResponse;
use crate::response::pixel::Comb;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{norm, sub};

/// Adds a Moon with a disc of uniform brightness temperature T to a sky model.
///
/// The disc is the region that the sky model treats as occulted, for a pair from either daughter. It equals a uniform sky of T
/// without the Moon minus the same sky with the Moon, so that the sum is `V(sky) + T (V_whole - V(1)) = V(sky - T) + T V_whole`:
/// one model of the sky minus T, and V_whole in closed form. V_whole depends only on the length of the baseline, and so holds for
/// averages over integrations too. Reflection is separate ([`WithFlatReflection`](super::WithFlatReflection)).
///
/// At 250 K and an altitude of 300 km, with the generated sky (rms visibility by baseline length in wavelengths):
///
/// | | Moon, K sr | sky at 1 MHz | at 10 MHz | at 30 MHz |
/// |---|---|---|---|---|
/// | power | 750 | 3.2e8 | 3.6e6 | 2.4e5 |
/// | visibilities, 2 to 4 | 19 | 3.5e7 | - | - |
/// | 4 to 8 | 8 | 1.6e7 | 1.0e5 | - |
/// | 8 to 16 | 3 | 8e6 | 5.0e4 | 3.7e3 |
/// | 16 to 32 | 1 | 4e6 | 2.9e4 | 1.8e3 |
///
/// The emission is 1e-6, 1e-4 and 1e-3 of the sky, and the ground does not correct for it. Direct sums alias on baselines of more
/// wavelengths than about half of nside: at nside 64 the disc then has 5 to 12 K sr, ten times too much. Harmonic sums do not alias.
pub struct WithEmission {
    sky_minus_moon: Box<dyn VisibilityModel>,
    frequency_hz: f64,
    response: AntennaResponse,
    temperature_k: f64,
}

impl WithEmission {
    /// Adds the disc to `sky_minus_moon`, the model of a sky from which `temperature_k` is subtracted in all directions.
    #[must_use]
    pub fn new(
        sky_minus_moon: Box<dyn VisibilityModel>,
        frequency_hz: f64,
        response: AntennaResponse,
        temperature_k: f64,
    ) -> Self {
        Self { sky_minus_moon, frequency_hz, response, temperature_k }
    }

    /// Visibility `T V_whole` of a uniform sky without the Moon, at `factor` times the frequency, K sr.
    fn uniform_k_sr(&self, position: &PairPosition, factor: f64) -> f64 {
        let baseline_m = norm(sub(position.r_i_m, position.r_j_m));
        let turns = baseline_m * self.frequency_hz / SPEED_OF_LIGHT_M_S * factor;
        self.temperature_k * uniform_sky_sr(self.response, turns)
    }
}

/// Visibility of a uniform sky of 1 K, `Int A exp(-2 pi i u . n) dn` over the whole sphere, sr, for a baseline of `u` wavelengths.
///
/// It is `4 pi j0(x)`, and `4 pi (j0(x) - j1(x) / x)` for dipoles normal to the baseline, with `x = 2 pi u`.
fn uniform_sky_sr(response: AntennaResponse, u: f64) -> f64 {
    let x = TAU * u;
    // For small x the quotient would cancel, and the next terms of the series are below 1e-18.
    let is_small = x < 1e-2;
    let j0 = if is_small { 1.0 - x * x / 6.0 * (1.0 - x * x / 20.0) } else { x.sin() / x };
    let j1_over_x = match is_small {
        true => (1.0 - x * x / 10.0 * (1.0 - x * x / 28.0)) / 3.0,
        false => (j0 - x.cos()) / (x * x),
    };
    match response {
        AntennaResponse::Isotropic | AntennaResponse::ThreeDipoles => 4.0 * PI * j0,
        AntennaResponse::DipoleNormal => 4.0 * PI * (j0 - j1_over_x),
    }
}

impl VisibilityModel for WithEmission {
    fn batch(&self) -> usize {
        self.sky_minus_moon.batch()
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        self.sky_minus_moon.predict(positions, out)?;
        out.iter_mut().zip(positions).for_each(|(out, position)| *out += self.uniform_k_sr(position, 1.0));
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        self.sky_minus_moon.predict_powers(daughters, out)?;
        let uniform_k_sr = self.temperature_k * uniform_sky_sr(self.response, 0.0);
        out.iter_mut().for_each(|out| *out += uniform_k_sr);
        Ok(())
    }

    fn predict_comb(
        &mut self,
        positions: &[PairPosition],
        comb: Comb,
        out: &mut [Complex64],
    ) -> Result<(), ModelError> {
        self.sky_minus_moon.predict_comb(positions, comb, out)?;
        for (k, out) in out.iter_mut().enumerate() {
            let factor = 1.0 + comb.first + comb.step * (k % comb.count) as f64;
            *out += self.uniform_k_sr(&positions[k / comb.count], factor);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    use crate::array::{Array, ArrayConfig};
    use crate::response::harmonic::{GeometryLimits, RotationTable};
    use crate::response::model::{DirectSum, GeneralSum, HarmonicSum, HarmonicSumSetup};
    use crate::sky::harmonics::Alm;
    use crate::sky::healpix::{pixel_area_sr, pixel_directions};
    use crate::sky::{Frame, SkyMap};
    use crate::units::vector::{Vec3, add, dot, scale};

    const MOON_K: f64 = 250.0;
    const FREQUENCY_HZ: f64 = 1e6;
    /// Resolution of the direct sums in these tests, which alias beyond some 60 wavelengths.
    const NSIDE: usize = 128;

    #[test]
    fn uniform_skies_are_those_of_sums() {
        // Midpoint rule over the polar angle from the baseline, with A = 1 - n_z^2 averaged along each ring; its error is
        // (x step)^2 / 24.
        let steps = 40_000;
        for u in [0.0, 1e-4, 0.0015, 0.0017, 0.3, 1.0, 7.25] {
            let mut expected = [0.0; 2];
            for k in 0..steps {
                let theta = PI * (k as f64 + 0.5) / f64::from(steps);
                let ring_sr = TAU * theta.sin() * PI / f64::from(steps);
                let fringe = (TAU * u * theta.cos()).cos();
                expected[0] += fringe * ring_sr;
                expected[1] += fringe * (1.0 - 0.5 * theta.sin().powi(2)) * ring_sr;
            }
            for (response, expected) in
                [AntennaResponse::Isotropic, AntennaResponse::DipoleNormal].into_iter().zip(expected)
            {
                let found = uniform_sky_sr(response, u);
                assert!((found - expected).abs() < 1e-6, "{u}: {found} {expected}");
            }
        }
    }

    fn array() -> Array {
        Array::new(&ArrayConfig::default()).unwrap()
    }

    fn positions(array: &Array) -> Vec<PairPosition> {
        let pairs = [(0, 1, 9e5), (2, 0, 9.03e5), (1, 3, 9e5), (0, 4, 2e3)];
        let at = |(i, j, t_s): (usize, usize, f64)| PairPosition {
            r_i_m: array.position_m(i, t_s),
            r_j_m: array.position_m(j, t_s),
            span_rad: 0.0,
            pair_time: None,
        };
        pairs.map(at).to_vec()
    }

    /// Visibility of the disc by a direct sum over the directions that the Moon hides from either daughter, K sr.
    fn disc(array: &Array, pair: &PairPosition, frequency_hz: f64, normal_hat: Option<Vec3>) -> Complex64 {
        let hides = |n: Vec3, r_m: Vec3| {
            // The line of sight passes below the surface.
            let along = -dot(n, r_m);
            let closest = add(r_m, scale(along, n));
            along > 0.0 && norm(closest) < array.moon_radius_m()
        };
        let mut sum = Complex64::ZERO;
        for n in pixel_directions(NSIDE) {
            if hides(n, pair.r_i_m) || hides(n, pair.r_j_m) {
                let turns = dot(n, sub(pair.r_i_m, pair.r_j_m)) * frequency_hz / SPEED_OF_LIGHT_M_S;
                let antenna = normal_hat.map_or(1.0, |normal| 1.0 - dot(n, normal).powi(2));
                sum += MOON_K * antenna * Complex64::cis(-TAU * turns);
            }
        }
        sum * pixel_area_sr(NSIDE)
    }

    /// Random error from the pixels on the limb, about sqrt(3 pi) nside times the sine of its radius, each of at most half a pixel.
    fn limb_k_sr() -> f64 {
        let pixels = 3.07 * NSIDE as f64 * 0.85;
        MOON_K * pixel_area_sr(NSIDE) * pixels.sqrt()
    }

    fn cold(nside: usize) -> SkyMap {
        SkyMap::new(Frame::Ecliptic, vec![-MOON_K; 12 * nside * nside]).unwrap()
    }

    fn cold_alm() -> Alm {
        let mut alm = Alm::zeros(0);
        *alm.get_mut(0, 0) = Complex64::new(-MOON_K * (4.0 * PI).sqrt(), 0.0);
        alm
    }

    fn harmonic(array: &Array, response: AntennaResponse) -> Box<dyn VisibilityModel> {
        let setup = HarmonicSumSetup {
            frequency_hz: FREQUENCY_HZ,
            orbit_radius_m: array.orbit_radius_m(),
            inclination_rad: array.inclination_rad(),
            moon_radius_m: array.moon_radius_m(),
            baseline_wavelengths_max: 60.0,
            response,
            limits: GeometryLimits::default(),
        };
        let rotation = Arc::new(RotationTable::new(0, array.inclination_rad()));
        Box::new(HarmonicSum::new(cold_alm(), setup, rotation).unwrap())
    }

    /// With a sky of 0 K a model gives the disc alone.
    #[test]
    fn every_model_gives_the_disc() {
        let array = array();
        let moon_m = array.moon_radius_m();
        let isotropic = AntennaResponse::Isotropic;
        let general = GeneralSum::new(&cold(64), cold_alm(), FREQUENCY_HZ, moon_m, None).unwrap();
        let mut models: Vec<(&str, AntennaResponse, Box<dyn VisibilityModel>)> = vec![
            ("harmonic", isotropic, harmonic(&array, isotropic)),
            ("general", isotropic, Box::new(general)),
        ];
        for response in [isotropic, AntennaResponse::DipoleNormal] {
            let direct = DirectSum::new(&cold(NSIDE), FREQUENCY_HZ, moon_m, response);
            models.push(("direct", response, Box::new(direct)));
        }
        models.push((
            "harmonic, dipoles",
            AntennaResponse::DipoleNormal,
            harmonic(&array, AntennaResponse::DipoleNormal),
        ));
        let positions = positions(&array);
        for (name, response, sky_minus_moon) in models {
            let mut model = WithEmission::new(sky_minus_moon, FREQUENCY_HZ, response, MOON_K);
            let normal_hat = array.orbit_normal_hat(9e5);
            let dipole =
                |t_s| (response == AntennaResponse::DipoleNormal).then(|| array.orbit_normal_hat(t_s));
            let mut found = vec![Complex64::ZERO; positions.len()];
            model.predict(&positions, &mut found).unwrap();
            for (k, position) in positions.iter().enumerate() {
                let expected = disc(&array, position, FREQUENCY_HZ, dipole([9e5, 9.03e5, 9e5, 2e3][k]));
                let off = (found[k] - expected).norm();
                assert!(off < limb_k_sr(), "{name} {k}: {} {expected}", found[k]);
            }
            let r_m = positions[0].r_i_m;
            let mut power = [0.0];
            model
                .predict_powers(
                    &[DaughterPosition { r_m, normal_hat, ..DaughterPosition::default() }],
                    &mut power,
                )
                .unwrap();
            // A cap of half angle asin(R / r) has 2 pi (1 - cos); dipoles across its axis lose pi (2/3 - cos + cos^3 / 3).
            let cos = (1.0 - (moon_m / norm(r_m)).powi(2)).sqrt();
            let across = PI * (2.0 / 3.0 - cos + cos.powi(3) / 3.0);
            let less_sr = if response == isotropic { 0.0 } else { across };
            let expected = MOON_K * (TAU * (1.0 - cos) - less_sr);
            // The general model sums powers at nside 64.
            assert!((power[0] - expected).abs() < 4.0 * limb_k_sr(), "{name}: {} {expected}", power[0]);
        }
    }

    #[test]
    fn combs_have_the_disc_at_each_frequency() {
        let array = array();
        let response = AntennaResponse::Isotropic;
        let direct = DirectSum::new(&cold(NSIDE), FREQUENCY_HZ, array.moon_radius_m(), response);
        let mut model = WithEmission::new(Box::new(direct), FREQUENCY_HZ, response, MOON_K);
        let positions = positions(&array);
        let comb = Comb { first: -0.04, step: 0.04, count: 3 };
        let mut found = vec![Complex64::ZERO; 3 * positions.len()];
        model.predict_comb(&positions, comb, &mut found).unwrap();
        for (k, found) in found.iter().enumerate() {
            let frequency_hz = FREQUENCY_HZ * (0.96 + 0.04 * (k % 3) as f64);
            let expected = disc(&array, &positions[k / 3], frequency_hz, None);
            assert!((found - expected).norm() < limb_k_sr(), "{k}: {found} {expected}");
        }
    }
}
