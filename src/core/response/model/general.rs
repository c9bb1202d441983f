//! Visibilities of a band-limited sky for satellites at any positions.

use std::sync::Arc;

use num_complex::Complex64;

use super::{
    AntennaPatterns, AntennaSum, DaughterPosition, DirectSum, ModelError, PairPosition, VisibilityModel,
};
use crate::frames::AntennaResponse;
use crate::response::general::{
    GeneralRows, ObservationDetails, PairResponse, RowsError, RowsSetup, TimedPair,
};
use crate::sky::harmonics::Alm;
use crate::sky::{MapError, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Visibilities per batch: tables for the altitudes of an orbit take a second, whatever the size of the batch.
pub(super) const BATCH: usize = 250_000;

/// Maximum nside at which auto-correlation powers are summed: the random error from some 300 pixels on the limb is 1e-4 of a
/// power.
const POWERS_NSIDE: usize = 64;

/// Visibilities of a sky given by harmonic coefficients, for satellites at any positions with isotropic or individual antennas.
///
/// The rms error is below 1e-4 of the rms visibility of the same coefficients. Rows of B are computed at some times of a pair's
/// track ([`PairPosition::pair_time`]) and interpolated between them.
pub struct GeneralSum {
    frequency_hz: f64,
    rows: GeneralRows,
    sky: [Alm; 1],
    powers: Box<dyn VisibilityModel>,
    antennas: Option<Arc<dyn AntennaPatterns>>,
}

impl GeneralSum {
    /// Builds the model of `map` (K), whose coefficients in the ecliptic frame are `alm`.
    ///
    /// # Errors
    /// [`MapError`] if the map cannot be averaged over larger pixels.
    pub fn new(
        map: &SkyMap,
        alm: Alm,
        frequency_hz: f64,
        moon_radius_m: f64,
        antennas: Option<Arc<dyn AntennaPatterns>>,
    ) -> Result<Self, MapError> {
        let response = AntennaResponse::Isotropic;
        let setup = RowsSetup {
            l_max: alm.l_max(),
            wavelength_m: SPEED_OF_LIGHT_M_S / frequency_hz,
            moon_radius_m,
            response,
            polynomial_degree: antennas.as_ref().map_or(0, |antennas| antennas.degree()),
        };
        let coarse = map.degrade(map.nside().min(POWERS_NSIDE))?;
        let powers = DirectSum::new(&coarse, frequency_hz, moon_radius_m, response);
        let powers: Box<dyn VisibilityModel> = match &antennas {
            Some(antennas) => Box::new(AntennaSum::new(powers, Arc::clone(antennas))),
            None => Box::new(powers),
        };
        Ok(Self { frequency_hz, rows: GeneralRows::new(setup), sky: [alm], powers, antennas })
    }
}

impl VisibilityModel for GeneralSum {
    fn batch(&self) -> usize {
        BATCH
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        let frequency_hz = self.frequency_hz;
        if positions.iter().any(|position| position.span_rad != 0.0) {
            return Err(ModelError::Smearing { frequency_hz });
        }
        let pairs = positions.iter().enumerate().map(|(k, position)| {
            // Positions without a time get decreasing times, so that each becomes a track of its own.
            let (pair, time_s) = position.pair_time.unwrap_or_else(|| (Default::default(), -(k as f64)));
            TimedPair { pair, time_s, r_i_m: position.r_i_m, r_j_m: position.r_j_m }
        });
        let pairs: Vec<TimedPair> = pairs.collect();
        let refused = |error: RowsError| ModelError::Geometry { frequency_hz, refusal: error.refusal };
        let response = self.antennas.as_ref().map(|antennas| {
            move |k: usize| match positions[k].pair_time {
                Some((pair, t_s)) => {
                    let [a, b] = [pair.i, pair.j].map(|daughter| antennas.antenna(daughter, t_s));
                    PairResponse::of_antennas([&a, &b])
                }
                None => PairResponse::isotropic(),
            }
        });
        let observed = ObservationDetails {
            response: response.as_ref().map(|response| response as &(dyn Fn(usize) -> PairResponse + Sync)),
            ..ObservationDetails::default()
        };
        let plan = self.rows.plan_with(&pairs, &observed).map_err(refused)?;
        for values in self.rows.forward(&plan, &self.sky) {
            out.copy_from_slice(&values);
        }
        Ok(())
    }

    fn predict_powers(&mut self, daughters: &[DaughterPosition], out: &mut [f64]) -> Result<(), ModelError> {
        self.powers.predict_powers(daughters, out)
    }

    fn has_individual_antennas(&self) -> bool {
        self.antennas.is_some()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::sky::Frame;
    use crate::sky::harmonics::synthesis;
    use crate::units::Pair;
    use crate::units::vector::norm;

    /// A smooth sky, which nside 128 represents, so that direct sums are in error only at the limb.
    fn sky() -> (SkyMap, Alm) {
        let l_max = 8;
        let mut alm = Alm::zeros(l_max);
        for m in 0..=l_max {
            for (k, z) in alm.order_mut(m).iter_mut().enumerate() {
                let l = (m + k) as f64;
                let phase = if m == 0 { 0.0 } else { 2.1 * l + 0.7 * m as f64 };
                *z = Complex64::from_polar(100.0 / (1.0 + l), phase);
            }
        }
        let map = SkyMap::new(Frame::Ecliptic, synthesis(&alm, 128).unwrap()).unwrap();
        (map, alm)
    }

    fn positions(array: &Array, seconds: usize) -> Vec<PairPosition> {
        let mut out = Vec::new();
        // Two windows of two pairs.
        for window in 0..2 {
            for pair in [Pair { i: 0, j: 1 }, Pair { i: 1, j: 2 }] {
                for k in 0..seconds {
                    let time_s = 8_000.0 * f64::from(window) + 7.0 * k as f64;
                    out.push(PairPosition {
                        r_i_m: array.position_m(pair.i.into(), time_s),
                        r_j_m: array.position_m(pair.j.into(), time_s),
                        span_rad: 0.0,
                        pair_time: Some((pair, time_s)),
                    });
                }
            }
        }
        out
    }

    fn rms(values: impl IntoIterator<Item = f64>) -> f64 {
        let squares: Vec<f64> = values.into_iter().map(|v| v * v).collect();
        (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
    }

    #[test]
    fn visibilities_off_the_circle_are_those_of_direct_sums() {
        let config = ArrayConfig { eccentricity: 0.01, cross_track_ratio: 0.02, ..ArrayConfig::default() };
        let array = Array::new(&config).unwrap();
        let (map, alm) = sky();
        let (frequency_hz, moon_m) = (3e6, array.moon_radius_m());
        let places = positions(&array, 120);
        let mut general = GeneralSum::new(&map, alm, frequency_hz, moon_m, None).unwrap();
        let mut direct = DirectSum::new(&map, frequency_hz, moon_m, AntennaResponse::Isotropic);
        let mut found = vec![Complex64::ZERO; places.len()];
        let mut expected = found.clone();
        general.predict(&places, &mut found).unwrap();
        direct.predict(&places, &mut expected).unwrap();
        let error = rms(found.iter().zip(&expected).map(|(a, b)| (a - b).norm()));
        // The limb, a circle of 5.4 rad, crosses some 900 pixels of 0.46 deg with 6.4e-5 sr and an rms of 57 K. A random error of
        // 0.3 of each gives 0.03 K sr; twice that, as errors of neighbours are correlated.
        assert!(error < 0.06, "{error}");
        assert!(rms(expected.iter().map(|v| v.norm())) > 3.0);

        // Without times each row is computed on its own.
        let apart: Vec<PairPosition> =
            places.iter().step_by(40).map(|place| PairPosition { pair_time: None, ..*place }).collect();
        let mut alone = vec![Complex64::ZERO; apart.len()];
        general.predict(&apart, &mut alone).unwrap();
        let scale = rms(alone.iter().map(|v| v.norm()));
        let error = rms(alone.iter().zip(found.iter().step_by(40)).map(|(a, b)| (a - b).norm()));
        // The error that interpolation may have.
        assert!(error < 1e-4 * scale && error > 0.0, "{error} of {scale}");
    }

    /// Three stations on the far side, 106 and 182 m apart.
    fn stations(epoch: &str) -> Array {
        use crate::array::{Station, Stations};
        let places = [(170.0, -30.0, 0.0), (170.004, -30.0, 12.0), (170.0, -29.994, -4.0)];
        let station =
            |(longitude_deg, latitude_deg, height_m)| Station { longitude_deg, latitude_deg, height_m };
        let stations = Stations::List(places.map(station).to_vec());
        let config =
            ArrayConfig { satellites: 3, stations, stations_epoch: epoch.into(), ..ArrayConfig::default() };
        Array::new(&config).unwrap()
    }

    #[test]
    fn stations_see_what_other_code_says() {
        // Three pixels of nside 4, above and below the horizon as the Moon turns, at 10 MHz; real and imaginary parts of pairs 1-2, 1-3, 2-3.
        // pyuvsim 1.4.2 with lunarsky 1.0.1 (JPL's DE421): twice XX of `run_uvsim` on UniformBeam, world moon, the pixels' centres as sources of area * T
        // Jy; they are `sum(area * T * exp(-2j pi f / c n @ (r_i - r_j)))` over pixels with `n @ r > 0`, to 1e-5.
        let mut sky = vec![0.0; 192];
        for (pixel, kelvin) in [(10, 1e4), (97, 2e4), (150, 5e3)] {
            sky[pixel] = kelvin;
        }
        let sky = SkyMap::new(Frame::Ecliptic, sky).unwrap();
        let area_sr = 4.0 * std::f64::consts::PI / 192.0;
        for (epoch, expected, seen_k) in [
            ("2030-01-01T00:00:00", [[-1125.77, 606.21], [-585.01, -1393.12], [-273.96, 1532.75]], 2.5e4),
            ("2030-01-09T12:00:00", [[278.89, 171.22], [24.12, -326.36], [-150.20, -290.75]], 5e3),
            ("2030-01-20T03:00:00", [[0.0; 2]; 3], 0.0),
            ("2039-06-01T00:00:00", [[-220.03, -1290.37], [662.39, 1129.03], [-1224.31, 463.19]], 2e4),
        ] {
            let array = stations(epoch);
            let place = |[i, j]: [usize; 2]| PairPosition {
                r_i_m: array.position_m(i, 0.0),
                r_j_m: array.position_m(j, 0.0),
                span_rad: 0.0,
                pair_time: None,
            };
            let mut found = [Complex64::ZERO; 3];
            DirectSum::new(&sky, 1e7, array.moon_radius_m(), AntennaResponse::Isotropic)
                .predict(&[[0, 1], [0, 2], [1, 2]].map(place), &mut found)
                .unwrap();
            for (found, [re, im]) in found.into_iter().zip(expected) {
                let off = (found - Complex64::new(re, im)).norm();
                // The orientation is good to 0.005 deg, 8.7e-5 rad: 3.3e-3 rad of phase over 182 m, 6 wavelengths. Values have two decimals,
                // sums of f32 some 1e-6.
                assert!(off <= 3.4e-3 * area_sr * seen_k + 0.01, "{epoch}: {found} {re} {im}");
            }
        }
    }

    #[test]
    fn harmonics_from_the_ground_are_direct_sums() {
        let array = stations("2030-01-01T00:00:00");
        let (map, alm) = sky();
        let moon_m = array.moon_radius_m();
        let places = positions(&array, 40);
        let mut found = vec![Complex64::ZERO; places.len()];
        let mut expected = found.clone();
        GeneralSum::new(&map, alm, 1e7, moon_m, None).unwrap().predict(&places, &mut found).unwrap();
        DirectSum::new(&map, 1e7, moon_m, AntennaResponse::Isotropic)
            .predict(&places, &mut expected)
            .unwrap();
        let error = rms(found.iter().zip(&expected).map(|(a, b)| (a - b).norm()));
        // As off the circle above: the horizon, of 6.3 rad, crosses some 1,000 pixels.
        assert!(error < 0.06, "{error}");
        assert!(rms(expected.iter().map(|v| v.norm())) > 3.0);
    }

    #[test]
    fn powers_are_those_of_a_sky_above_the_limb() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let sky = SkyMap::constant(256, Frame::Ecliptic, 50.0).unwrap();
        let mut alm = Alm::zeros(4);
        alm.order_mut(0)[0] = Complex64::new(50.0 * (2.0 * TAU).sqrt(), 0.0);
        let mut model = GeneralSum::new(&sky, alm, 3e6, array.moon_radius_m(), None).unwrap();
        let r_m = array.position_m(3, 4e3);
        let mut power = [0.0];
        model
            .predict_powers(
                &[DaughterPosition {
                    r_m,
                    normal_hat: array.orbit_normal_hat(4e3),
                    ..DaughterPosition::default()
                }],
                &mut power,
            )
            .unwrap();
        // All directions except those within asin(R / r) of the nadir.
        let hidden = (array.moon_radius_m() / norm(r_m)).asin();
        let expected = 50.0 * TAU * (1.0 + hidden.cos());
        assert!((power[0] / expected - 1.0).abs() < 3e-4, "{} {expected}", power[0]);
    }

    #[test]
    fn averages_and_buried_satellites_are_refused() {
        let array = Array::new(&ArrayConfig::default()).unwrap();
        let (map, alm) = sky();
        let mut model = GeneralSum::new(&map, alm, 3e6, array.moon_radius_m(), None).unwrap();
        let place = positions(&array, 1)[0];
        let mut out = [Complex64::ZERO];
        let smeared = PairPosition { span_rad: 0.01, ..place };
        assert!(matches!(model.predict(&[smeared], &mut out), Err(ModelError::Smearing { .. })));
        let buried = PairPosition { r_j_m: place.r_j_m.map(|x| 0.8 * x), ..place };
        assert!(matches!(model.predict(&[buried], &mut out), Err(ModelError::Geometry { .. })));
    }
}
