//! Visibilities averaged over their integrations.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use num_complex::Complex64;

use super::{DaughterPosition, ModelError, PairPosition, VisibilityModel, predict_means};
use crate::array::Array;
use crate::response::general::Instants;
use crate::units::vector::{Vec3, norm, sub};

/// Averages an instantaneous model over integrations, by Gauss-Legendre quadrature in time along the array's orbits.
///
/// Positions without a pair and time ([`PairPosition::pair_time`]) or without a span are predicted as instants.
pub struct TimeAverage {
    model: Box<dyn VisibilityModel>,
    array: Arc<Array>,
    wavelength_m: f64,
    l_max: usize,
    instants: Instants,
}

impl TimeAverage {
    /// Averages `model`, whose sky has degrees up to `l_max`, at a wavelength, m.
    #[must_use]
    pub fn new(model: Box<dyn VisibilityModel>, array: Arc<Array>, wavelength_m: f64, l_max: usize) -> Self {
        Self { model, array, wavelength_m, l_max, instants: Instants::new() }
    }

    fn positions_at(&self, position: &PairPosition, t_s: f64) -> Option<[Vec3; 2]> {
        let (pair, _) = position.pair_time?;
        Some([pair.i, pair.j].map(|n| self.array.position_m(n.into(), t_s)))
    }

    /// Calls `take` with the positions at each instant of an integration, and their weight.
    fn for_each_instant(&self, position: &PairPosition, take: &mut dyn FnMut(PairPosition, f64)) {
        let instant = PairPosition { span_rad: 0.0, ..*position };
        let half_s = 0.5 * position.span_rad / TAU * self.array.orbital_period_s();
        let ends = position.pair_time.filter(|_| half_s > 0.0).and_then(|(pair, t_s)| {
            let [from, to] = [-half_s, half_s].map(|after_s| self.positions_at(position, t_s + after_s));
            Some((pair, t_s, from?, to?))
        });
        let Some((pair, t_s, from, to)) = ends else { return take(instant, 1.0) };
        let moved_m = norm(sub(sub(to[0], to[1]), sub(from[0], from[1])));
        let turned_rad = norm(sub(to[0], from[0])) / norm(position.r_i_m);
        let half_rad = [PI * moved_m / self.wavelength_m, 0.5 * self.l_max as f64 * turned_rad];
        for node in self.instants.for_phases(half_rad) {
            let time_s = t_s + half_s * node.offset;
            if let Some([r_i_m, r_j_m]) = self.positions_at(position, time_s) {
                let pair_time = Some((pair, time_s));
                take(PairPosition { r_i_m, r_j_m, span_rad: 0.0, pair_time }, node.weight);
            }
        }
    }
}

impl VisibilityModel for TimeAverage {
    fn batch(&self) -> usize {
        self.model.batch()
    }

    fn predict(&mut self, positions: &[PairPosition], out: &mut [Complex64]) -> Result<(), ModelError> {
        // In batches, to bound memory.
        let batch = self.model.batch().max(1024);
        for (positions, out) in positions.chunks(batch).zip(out.chunks_mut(batch)) {
            let (mut instants, mut terms) = (Vec::new(), Vec::new());
            for (index, position) in positions.iter().enumerate() {
                self.for_each_instant(position, &mut |instant, weight| {
                    instants.push(instant);
                    terms.push((index, weight));
                });
            }
            predict_means(self.model.as_mut(), &instants, &terms, out)?;
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
    use crate::array::ArrayConfig;
    use crate::frames::AntennaResponse;
    use crate::response::model::DirectSum;
    use crate::sky::healpix::pixel_directions;
    use crate::sky::{Frame, SkyMap};
    use crate::units::Pair;
    use crate::units::constants::SPEED_OF_LIGHT_M_S;

    #[test]
    fn averages_are_those_of_many_instants() {
        let config = ArrayConfig { eccentricity: 0.01, cross_track_ratio: 0.1, ..ArrayConfig::default() };
        let array = Arc::new(Array::new(&config).unwrap());
        // Smooth, so that values at the pixels' centres represent it.
        let nside = 64;
        let values = pixel_directions(nside).iter().map(|n| 300.0 + 200.0 * n[0] * n[2]).collect();
        let sky = SkyMap::new(Frame::Ecliptic, values).unwrap();
        let frequency_hz = 10e6;
        let sum = DirectSum::new(&sky, frequency_hz, array.moon_radius_m(), AntennaResponse::Isotropic);
        let mut plain = sum.clone();
        let wavelength_m = SPEED_OF_LIGHT_M_S / frequency_hz;
        let mut averaged = TimeAverage::new(Box::new(sum), Arc::clone(&array), wavelength_m, 2 * nside);
        let pair = Pair { i: 0, j: 3 };
        let place = |t_s: f64, length_s: f64| PairPosition {
            r_i_m: array.position_m(0, t_s),
            r_j_m: array.position_m(3, t_s),
            span_rad: TAU * length_s / array.orbital_period_s(),
            pair_time: Some((pair, t_s)),
        };
        for (t_s, length_s) in [(1e3, 0.5), (2e3, 4.0), (3e3, 60.0)] {
            let (mut found, mut middle) = ([Complex64::ZERO], [Complex64::ZERO]);
            averaged.predict(&[place(t_s, length_s)], &mut found).unwrap();
            plain.predict(&[place(t_s, 0.0)], &mut middle).unwrap();
            const PARTS: usize = 400;
            let part_s = length_s / PARTS as f64;
            let instants: Vec<PairPosition> =
                (0..PARTS).map(|k| place(t_s - 0.5 * length_s + part_s * (k as f64 + 0.5), 0.0)).collect();
            let mut values = vec![Complex64::ZERO; PARTS];
            plain.predict(&instants, &mut values).unwrap();
            let expected = values.iter().sum::<Complex64>() / PARTS as f64;
            let scale = values.iter().map(|v| v.norm()).fold(0.0, f64::max);
            // Pixels rise and set at the limb: 0.08 K sr each, of some 20 K sr.
            assert!((found[0] - expected).norm() < 5e-3 * scale, "{length_s}: {found:?} {expected}");
            let left_out = (middle[0] - expected).norm();
            assert!(
                length_s < 60.0 || (found[0] - expected).norm() < 0.1 * left_out,
                "{length_s}: {left_out}"
            );
        }
        let (mut found, mut expected) = ([Complex64::ZERO], [Complex64::ZERO]);
        averaged.predict(&[place(4e3, 0.0)], &mut found).unwrap();
        plain.predict(&[place(4e3, 0.0)], &mut expected).unwrap();
        assert_eq!(found, expected);
    }
}
