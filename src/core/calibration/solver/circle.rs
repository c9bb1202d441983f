//! Visibilities of a map by spherical harmonics, for pairs on one circular orbit.

use std::f64::consts::TAU;
use std::sync::Arc;

use num_complex::Complex64;

use crate::frames::AntennaResponse;
use crate::numerics::median;
use crate::response::harmonic::{GeometryLimits, PairOrientation, RotationTable};
use crate::response::model::{
    DirectSum, HarmonicSum, HarmonicSumSetup, ModelError, PairPosition, VisibilityModel,
};
use crate::sky::harmonics::{Alm, AnalysisOptions, Method};
use crate::sky::healpix::pixel_count;
use crate::sky::{Frame, MapError, SkyMap};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Longest baseline for a map, in wavelengths per nside: two and a half times the one whose fringe is two pixels
/// wide.
const WAVELENGTHS_OF_NSIDE: f64 = 2.5;

/// Maximum baseline, wavelengths; bounds the tables.
const WAVELENGTHS_MAX: f64 = 320.0;

/// Largest nside for which tables are made: some 2 GB per channel.
pub(super) const NSIDE_MAX: usize = 256;

/// Tolerated phase error of a pair off its circle, rad: of its fringe and of the Moon's limb.
const PHASE_RAD_MAX: f64 = 1e-3;

/// Circles are rounded to multiples of these steps, far below what matters, so that consecutive passes share one
/// circle.
const INCLINATION_STEP_DEG: f64 = 5e-5;
const RADIUS_STEP_M: f64 = 1.0;

/// Longest chord of a circle that is accepted, radii.
const CHORD_MAX: f64 = 1.99;

/// Minimum number of visibilities of a pass times pixels for which the tables of a circle are made. Sums over pixels
/// take 1 ns each; the tables take a second or more, for all passes of a mission on one circle. The choice must not
/// depend on whether tables exist already, as results would depend on it.
const PRODUCTS_MIN: usize = 5_000_000;

/// A circular orbit.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Circle {
    inclination_deg: f64,
    radius_m: f64,
}

impl Circle {
    /// The circle of a pass, taken as prograde: the median of its longer baselines up to `baseline_m_max`, whose
    /// planes are known best.
    fn of(pairs: &[Option<PairOrientation>], baseline_m_max: f64) -> Option<Self> {
        let within = |pair: &&PairOrientation| pair.baseline_m <= baseline_m_max;
        let pairs: Vec<&PairOrientation> = pairs.iter().flatten().filter(within).collect();
        let longest_m = pairs.iter().map(|pair| pair.baseline_m).fold(0.0, f64::max);
        let long = || pairs.iter().filter(|pair| pair.baseline_m >= 0.5 * longest_m);
        let inclination_deg =
            median(long().map(|pair| pair.prograde_inclination_rad().to_degrees()).collect())?;
        Some(Self {
            inclination_deg: (inclination_deg / INCLINATION_STEP_DEG).round() * INCLINATION_STEP_DEG,
            radius_m: (median(long().map(|pair| pair.radius_m).collect())? / RADIUS_STEP_M).round()
                * RADIUS_STEP_M,
        })
    }

    /// Whether a pair is on the circle, to within a negligible phase.
    fn contains(&self, pair: &PairOrientation, wavelength_m: f64) -> bool {
        let tilt_rad = (pair.prograde_inclination_rad() - self.inclination_rad()).abs();
        let off_rad = tilt_rad + pair.radius_difference_m.abs() / pair.baseline_m;
        (pair.radius_m - self.radius_m).abs() <= RADIUS_STEP_M
            && off_rad * TAU * (pair.baseline_m / wavelength_m + 1.0) <= PHASE_RAD_MAX
    }

    fn inclination_rad(&self) -> f64 {
        self.inclination_deg.to_radians()
    }
}

/// Longest baseline of the tables for a map, wavelengths.
#[must_use]
pub fn wavelengths_max(nside: usize) -> f64 {
    (WAVELENGTHS_OF_NSIDE * nside as f64).min(WAVELENGTHS_MAX)
}

/// Rotation table of the last circle, shared by all channels.
#[derive(Default)]
pub(super) struct Rotations {
    last: Option<(Circle, Arc<RotationTable<f32>>)>,
}

impl Rotations {
    fn of(&mut self, circle: Circle, l_max: usize) -> Arc<RotationTable<f32>> {
        match &self.last {
            Some((last, table)) if *last == circle && table.l_max() == l_max => Arc::clone(table),
            _ => {
                let table = Arc::new(RotationTable::new(l_max, circle.inclination_rad()));
                self.last = Some((circle, Arc::clone(&table)));
                table
            }
        }
    }
}

/// Sky of a channel: harmonics for pairs on the circle, sums over pixels for the others.
pub(super) struct CircleSky {
    alm: Alm,
    nside: usize,
    frequency_hz: f64,
    moon_radius_m: f64,
    response: AntennaResponse,
    /// Minimum number of visibilities of a pass times pixels for which tables are made.
    products_min: usize,
    /// Tables of the last circle.
    last_tables: Option<(Circle, HarmonicSum)>,
    pixel_sum: DirectSum,
}

impl CircleSky {
    /// Creates the sky of `map` (K) to degree 5/2 nside. Tables are used `always`, or where they save time.
    ///
    /// # Errors
    /// The map has pixels without value.
    pub(super) fn new(
        map: &SkyMap,
        frequency_hz: f64,
        moon_radius_m: f64,
        response: AntennaResponse,
        always: bool,
    ) -> Result<Self, MapError> {
        let nside = map.nside();
        let alm = map.harmonics(5 * nside / 2, &AnalysisOptions { method: Method::ACCURATE })?;
        let alm = match map.frame() {
            Frame::Ecliptic => alm,
            frame => alm.rotated(&frame.to_ecliptic()),
        };
        let pixel_sum = DirectSum::new(map, frequency_hz, moon_radius_m, response);
        let products_min = if always { 0 } else { PRODUCTS_MIN };
        Ok(Self {
            alm,
            nside,
            frequency_hz,
            moon_radius_m,
            response,
            products_min,
            last_tables: None,
            pixel_sum,
        })
    }

    /// Visibilities of the positions of a pass, K sr: by harmonics for those on its circle, if they are many; by sums
    /// over pixels for all others.
    ///
    /// # Errors
    /// Neither covers the positions.
    pub(super) fn predict(
        &mut self,
        positions: &[PairPosition],
        rotations: &mut Rotations,
    ) -> Result<Vec<Complex64>, ModelError> {
        let wavelength_m = SPEED_OF_LIGHT_M_S / self.frequency_hz;
        let longest_m = wavelengths_max(self.nside) * wavelength_m;
        let pairs: Vec<Option<PairOrientation>> =
            positions.iter().map(|at| PairOrientation::of_pair(at.r_i_m, at.r_j_m).ok()).collect();
        let circle = Circle::of(&pairs, longest_m).filter(|circle| circle.radius_m > self.moon_radius_m);
        let is_on = |pair: &Option<PairOrientation>| match (circle, pair) {
            (Some(circle), Some(pair)) => {
                pair.baseline_m <= longest_m.min(CHORD_MAX * circle.radius_m)
                    && circle.contains(pair, wavelength_m)
            }
            _ => false,
        };
        let mut on: Vec<bool> = pairs.iter().map(is_on).collect();
        let count = on.iter().filter(|on| **on).count();
        if count * pixel_count(self.nside) < self.products_min {
            on.fill(false);
        }
        let chosen = |which: bool| -> Vec<PairPosition> {
            positions.iter().zip(&on).filter(|(_, on)| **on == which).map(|(position, _)| *position).collect()
        };
        let (on_circle, off_circle) = (chosen(true), chosen(false));
        let [mut found, mut pixel_values] =
            [&on_circle, &off_circle].map(|positions| vec![Complex64::ZERO; positions.len()]);
        if let (Some(circle), false) = (circle, on_circle.is_empty()) {
            self.tables(circle, rotations)?.predict(&on_circle, &mut found)?;
        }
        self.pixel_sum.predict(&off_circle, &mut pixel_values)?;
        let (mut found, mut pixel_values) = (found.into_iter(), pixel_values.into_iter());
        let next = |on: bool| if on { found.next() } else { pixel_values.next() };
        Ok(on.into_iter().map(next).map(Option::unwrap_or_default).collect())
    }

    /// Tables of a circle, from the last call or new.
    fn tables(&mut self, circle: Circle, rotations: &mut Rotations) -> Result<&mut HarmonicSum, ModelError> {
        let last_tables = match self.last_tables.take() {
            Some((before, sum)) if before == circle => sum,
            _ => self.new_tables(circle, rotations)?,
        };
        Ok(&mut self.last_tables.insert((circle, last_tables)).1)
    }

    fn new_tables(&self, circle: Circle, rotations: &mut Rotations) -> Result<HarmonicSum, ModelError> {
        let wavelength_m = SPEED_OF_LIGHT_M_S / self.frequency_hz;
        let u_max = wavelengths_max(self.nside).min(CHORD_MAX * circle.radius_m / wavelength_m);
        let setup = HarmonicSumSetup {
            frequency_hz: self.frequency_hz,
            orbit_radius_m: circle.radius_m,
            inclination_rad: circle.inclination_rad(),
            moon_radius_m: self.moon_radius_m,
            baseline_wavelengths_max: u_max,
            response: self.response,
            // Positions on the circle were selected before.
            limits: GeometryLimits {
                out_of_track_deg_max: 1.0,
                inclination_deg_max: 0.0,
                altitude_m_max: 2.0 * RADIUS_STEP_M,
                radial_deg_max: 1.0,
            },
        };
        HarmonicSum::new(self.alm.clone(), setup, rotations.of(circle, self.alm.l_max()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::array::{Array, ArrayConfig};
    use crate::sky::harmonics::Transform;
    use crate::sky::healpix::pixel_area_sr;
    use crate::units::vector::{add, norm, scale, sub, unit};
    use crate::units::{StreamKind, random_stream};
    use rand::RngExt;

    const FREQUENCY_HZ: f64 = 10e6;
    const ISOTROPIC: AntennaResponse = AntennaResponse::Isotropic;

    fn array() -> Array {
        Array::new(&ArrayConfig::default()).unwrap()
    }

    /// A sky of degrees up to 24 above a level of 10 K.
    fn sky(nside: usize) -> SkyMap {
        let mut stream = random_stream(3, StreamKind::Probe, [0, 0]);
        let mut alm = Alm::zeros(24);
        for m in 0..=24 {
            for l in m..=24 {
                let im = if m == 0 { 0.0 } else { stream.random::<f64>() - 0.5 };
                *alm.get_mut(l, m) = Complex64::new(stream.random::<f64>() - 0.5, im);
            }
        }
        *alm.get_mut(0, 0) = (10.0 * (4.0 * std::f64::consts::PI).sqrt()).into();
        let values = Transform::new(nside, 24).unwrap().synthesis(&alm).unwrap();
        SkyMap::new(Frame::Ecliptic, values).unwrap()
    }

    /// Number of visibilities of a pass.
    const COUNT: usize = 60;

    /// Positions of two daughters of an array over part of an orbit.
    fn pass(array: &Array, [i, j]: [usize; 2]) -> Vec<PairPosition> {
        let at = |t_s: f64| PairPosition {
            r_i_m: array.position_m(i, t_s),
            r_j_m: array.position_m(j, t_s),
            span_rad: 0.0,
            pair_time: None,
        };
        (0..COUNT).map(|k| at(1000.0 + 20.0 * k as f64)).collect()
    }

    /// Positions as of `pass`, with the first daughter further from the Moon.
    fn raised(array: &Array, pair: [usize; 2], by_m: f64) -> Vec<PairPosition> {
        let raise = |position: PairPosition| {
            let r_i_m = add(position.r_i_m, scale(by_m, unit(position.r_i_m)));
            PairPosition { r_i_m, ..position }
        };
        pass(array, pair).into_iter().map(raise).collect()
    }

    fn direct(array: &Array, nside: usize, positions: &[PairPosition]) -> Vec<Complex64> {
        let mut sum = DirectSum::new(&sky(nside), FREQUENCY_HZ, array.moon_radius_m(), ISOTROPIC);
        let mut values = vec![Complex64::ZERO; positions.len()];
        sum.predict(positions, &mut values).unwrap();
        values
    }

    fn circle_sky(array: &Array) -> CircleSky {
        CircleSky::new(&sky(64), FREQUENCY_HZ, array.moon_radius_m(), ISOTROPIC, true).unwrap()
    }

    fn bits(values: &[Complex64]) -> Vec<[u64; 2]> {
        values.iter().map(|value| [value.re.to_bits(), value.im.to_bits()]).collect()
    }

    /// Asserts that visibilities are those of the sky; checks one of every `step`.
    fn assert_of_the_sky(array: &Array, positions: &[PairPosition], found: &[Complex64], step: usize) {
        const FINE: usize = 256;
        let some: Vec<PairPosition> = positions.iter().step_by(step).copied().collect();
        let expected = direct(array, FINE, &some);
        // Direct sums count the 4 nside pixels on the limb as whole: a random error of half a pixel each, of some 12
        // K.
        let limb = 0.5 * (4.0 * FINE as f64).sqrt() * pixel_area_sr(FINE) * 12.0;
        for (found, expected) in found.iter().step_by(step).zip(&expected) {
            assert!((found - expected).norm() < 4.0 * limb, "{found} {expected} {limb}");
        }
        // The signal is well above this limb error.
        let power = expected.iter().map(Complex64::norm_sqr).sum::<f64>() / expected.len() as f64;
        assert!(power.sqrt() > 20.0 * limb, "{power}");
    }

    #[test]
    fn pairs_on_a_circle_have_the_visibilities_of_sums_over_fine_pixels() {
        let array = array();
        let positions = pass(&array, [0, 1]);
        let mut sky_of_circle = circle_sky(&array);
        let found = sky_of_circle.predict(&positions, &mut Rotations::default()).unwrap();
        assert_of_the_sky(&array, &positions, &found, 4);
        assert!(sky_of_circle.last_tables.is_some());
    }

    #[test]
    fn a_negligible_phase_leaves_a_pair_on_its_circle() {
        let array = array();
        // 1 mm of 600 m is 2e-6 rad: 2e-4 rad of phase at 10 MHz. A pair of 2 km determines the plane.
        let mut positions = pass(&array, [0, 2]);
        positions.extend(raised(&array, [0, 1], 1e-3));
        let mut sky_of_circle = circle_sky(&array);
        let found = sky_of_circle.predict(&positions, &mut Rotations::default()).unwrap();
        let pixel_values = direct(&array, 64, &positions);
        assert!(found.iter().zip(&pixel_values).all(|(found, pixel_values)| found != pixel_values));
        assert_of_the_sky(&array, &positions[COUNT..], &found[COUNT..], 10);
    }

    #[test]
    fn pairs_off_the_circle_or_too_long_are_summed_over_pixels() {
        let array = array();
        let mut positions = pass(&array, [0, 1]);
        let wavelength_m = SPEED_OF_LIGHT_M_S / FREQUENCY_HZ;
        let longest = pass(&array, [0, 7]);
        assert!(norm(sub(longest[0].r_i_m, longest[0].r_j_m)) > 2.5 * 64.0 * wavelength_m);
        positions.extend(longest);
        let moved = positions.len();
        positions.extend(raised(&array, [0, 1], 1.0));
        let mut sky_of_circle = circle_sky(&array);
        let found = sky_of_circle.predict(&positions, &mut Rotations::default()).unwrap();
        let expected = direct(&array, 64, &positions);
        assert_eq!(bits(&found[COUNT..]), bits(&expected[COUNT..]));
        assert!(found[..COUNT].iter().zip(&expected[..COUNT]).all(|(found, expected)| found != expected));
        // The raised pairs alone: no circle fits them, not even their own, and none is made.
        let mut alone = circle_sky(&array);
        let found = alone.predict(&positions[moved..], &mut Rotations::default()).unwrap();
        assert_eq!(bits(&found), bits(&expected[moved..]));
        assert!(alone.last_tables.is_none());
    }

    #[test]
    fn few_visibilities_are_summed_over_pixels() {
        let array = array();
        let positions = pass(&array, [0, 1]);
        let predict = |positions: &[PairPosition]| {
            let mut auto =
                CircleSky::new(&sky(64), FREQUENCY_HZ, array.moon_radius_m(), ISOTROPIC, false).unwrap();
            let found = auto.predict(positions, &mut Rotations::default()).unwrap();
            (found, auto.last_tables.is_some())
        };
        let (found, is_made) = predict(&positions);
        assert!(!is_made);
        assert_eq!(bits(&found), bits(&direct(&array, 64, &positions)));
        // 120 visibilities of 49,152 pixels are more than 5e6 products.
        assert!(predict(&positions.repeat(2)).1);
    }

    #[test]
    fn maps_that_are_too_fine_for_tables_are_refused_by_name() {
        use crate::calibration::solver::{SkyModel, SolverConfig};
        let fine = SkyMap::new(Frame::Ecliptic, vec![1.0; 12 * 512 * 512]).unwrap();
        let of = |sky_model: SkyModel| SolverConfig { sky_model, ..SolverConfig::default() };
        let refused = of(SkyModel::Harmonic).can_model(std::slice::from_ref(&fine)).unwrap_err();
        assert_eq!(refused.key, "calibrate.sky_model");
        assert!(refused.to_string().contains("nside 512"), "{refused}");
        for sky_model in [SkyModel::Auto, SkyModel::Direct] {
            of(sky_model).can_model(std::slice::from_ref(&fine)).unwrap();
            assert!(!of(sky_model).is_harmonic(512));
        }
        of(SkyModel::Harmonic).can_model(&[sky(64)]).unwrap();
    }

    #[test]
    fn another_circle_before_changes_no_bit() {
        let array = array();
        let positions = pass(&array, [1, 2]);
        let higher = Array::new(&ArrayConfig { altitude_m: 350e3, ..ArrayConfig::default() }).unwrap();
        let mut rotations = Rotations::default();
        let mut sky_of_circle = circle_sky(&array);
        let first = sky_of_circle.predict(&positions, &mut rotations).unwrap();
        let pixel_sum = sky_of_circle.predict(&pass(&higher, [1, 2]), &mut rotations).unwrap();
        assert_ne!(bits(&pixel_sum), bits(&first));
        assert_eq!(bits(&sky_of_circle.predict(&positions, &mut rotations).unwrap()), bits(&first));
        let mut other = circle_sky(&array);
        assert_eq!(bits(&other.predict(&positions, &mut Rotations::default()).unwrap()), bits(&first));
    }
}
