//! Sky powers of the daughters over a window, which determine the noise of each.

use crate::array::Array;
use crate::frames::ObservingWindow;
use crate::response::model::{DaughterPosition, ModelError, VisibilityModel};
use crate::units::TICKS_PER_SECOND;

/// Spacing of the instants at which powers that only set the noise are predicted, s: a ninth of a radian of the orbit. Cubic interpolation
/// does not resolve structure beyond l = 20, which the unocculted half of the sky attenuates by about l^-1.5. The relative error of a power is
/// 5e-4 for a sky with as much in each degree up to l = 40 as in its mean, and far less for a smoother sky.
pub(super) const NOISE_STEP_S: f64 = 150.0;
/// The same for powers that are sent. Interpolation lowers degree l by `11/720 (l step)^4` on average, 7e-4 for l = 4 at 150 s: as large as the
/// error of the mean of a map with powers, which finds the gains by such structure. At 50 s it is 81 times less.
pub(super) const SENT_STEP_S: f64 = 50.0;

/// Number of nodes that cubic interpolation needs beyond either end.
const MARGIN_NODES: f64 = 1.0;

/// Sky power `Int T A S dn` (K sr) along the arc of orbit that a window covers.
///
/// Daughters that follow each other on one circle share a table, as one that trails by an arc has the same power
/// later. Others have a table each.
pub(super) struct SkyPowers {
    /// Time of the first values of the tables, s.
    from_s: f64,
    step_s: f64,
    tables: Vec<Vec<f64>>,
}

impl SkyPowers {
    /// Predicts the powers of a model over each window, every `step_s` seconds.
    ///
    /// # Errors
    /// The model does not cover the positions.
    pub fn predict(
        model: &mut dyn VisibilityModel,
        array: &Array,
        windows: &[ObservingWindow],
        step_s: f64,
    ) -> Result<Vec<Self>, ModelError> {
        let shared = array.formation().is_some() && !model.has_individual_antennas();
        let tables = if shared { 1 } else { array.satellites() };
        // Arcs are longest at the start of a breathing period.
        let lags_s = (0..array.satellites()).map(|n| lag_s(array, n, 0.0));
        let longest_s = lags_s.fold(0.0, f64::max);
        let spans = windows.iter().map(|window| {
            let from_s = window.start.seconds() - longest_s - MARGIN_NODES * step_s;
            let length_s = (window.end.0 - window.start.0) as f64 / TICKS_PER_SECOND as f64;
            let steps = ((length_s + longest_s) / step_s).ceil() + 2.0 * MARGIN_NODES;
            (from_s, steps as usize + 1)
        });
        let spans: Vec<(f64, usize)> = spans.collect();
        let position = |n: usize, t_s: f64| DaughterPosition {
            r_m: if shared { array.trailing_position_m(0.0, t_s) } else { array.position_m(n, t_s) },
            normal_hat: array.normal_hat(n, t_s),
            daughter_time: Some((n as u8, t_s)),
        };
        let instants = |&(from_s, count): &(f64, usize)| (0..count).map(move |k| from_s + step_s * k as f64);
        let positions: Vec<DaughterPosition> = spans
            .iter()
            .flat_map(|span| (0..tables).flat_map(move |n| instants(span).map(move |t_s| position(n, t_s))))
            .collect();
        let mut powers = vec![0.0; positions.len()];
        model.predict_powers(&positions, &mut powers)?;
        let mut powers = powers.into_iter();
        let window_powers = |(from_s, count)| Self {
            from_s,
            step_s,
            tables: (0..tables).map(|_| powers.by_ref().take(count).collect()).collect(),
        };
        Ok(spans.into_iter().map(window_powers).collect())
    }

    /// Power of daughter `n` at a time of the window, K sr.
    pub fn at(&self, array: &Array, n: usize, t_s: f64) -> f64 {
        let lag_s = if self.tables.len() == 1 { lag_s(array, n, t_s) } else { 0.0 };
        let x = (t_s - lag_s - self.from_s) / self.step_s;
        let table = if self.tables.len() == 1 { &self.tables[0] } else { &self.tables[n] };
        // Four nodes of the table, at any time.
        let first = (x.floor() - MARGIN_NODES).clamp(0.0, table.len().saturating_sub(4) as f64) as usize;
        let x = x - first as f64;
        let nodes = table.iter().skip(first).take(4).enumerate();
        nodes
            .map(|(k, power)| {
                let others = (0..4).filter(|m| *m != k);
                power * others.map(|m| (x - m as f64) / (k as f64 - m as f64)).product::<f64>()
            })
            .sum()
    }
}

/// Time by which a daughter follows the first position of the array, s; 0 without a common circle.
fn lag_s(array: &Array, n: usize, t_s: f64) -> f64 {
    let Some(formation) = array.formation() else { return 0.0 };
    let speed_m_s = std::f64::consts::TAU * array.orbit_radius_m() / array.orbital_period_s();
    formation.arc_m(n, t_s).0 / speed_m_s
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::array::{Array, ArrayConfig, ObservingWindows};
    use crate::response::model::{ModelError, PairPosition};

    /// A sky whose power in the direction of the Moon is a wave of degree 5 along the orbit of this array.
    struct Wave {
        array: Arc<Array>,
    }

    impl Wave {
        fn power(&self, t_s: f64) -> f64 {
            2.0 + (5.0 * std::f64::consts::TAU * t_s / self.array.orbital_period_s()).cos()
        }
    }

    impl VisibilityModel for Wave {
        fn predict(
            &mut self,
            _: &[PairPosition],
            _: &mut [num_complex::Complex64],
        ) -> Result<(), ModelError> {
            Ok(())
        }

        fn predict_powers(
            &mut self,
            daughters: &[DaughterPosition],
            out: &mut [f64],
        ) -> Result<(), ModelError> {
            for (daughter, out) in daughters.iter().zip(out) {
                let t_s = daughter.daughter_time.map_or(0.0, |(_, t_s)| t_s);
                *out = self.power(t_s);
            }
            Ok(())
        }
    }

    /// The rms error over a window, of a wave of amplitude 1.
    fn error(step_s: f64) -> f64 {
        let array = Arc::new(Array::new(&ArrayConfig::default()).unwrap());
        let window = ObservingWindows::new(&array, 1.0e5, 2.0e5).next().unwrap();
        let mut wave = Wave { array: array.clone() };
        let powers = SkyPowers::predict(&mut wave, &array, &[window], step_s).unwrap().remove(0);
        let times = || (0..400).map(|k| window.start.seconds() + 5.0 * f64::from(k));
        let square = |t_s: f64| (powers.at(&array, 0, t_s) - wave.power(t_s - lag_s(&array, 0, t_s))).powi(2);
        (times().map(square).sum::<f64>() / 400.0).sqrt()
    }

    /// A cubic through four nodes is off by x(1-x)(1+x)(2-x)/24 of the fourth derivative: 0.0168 rms over a step, 0.0119 with the rms of a wave.
    /// The next term is less by some square of the phase a step, a third here.
    #[test]
    fn interpolation_of_powers_is_of_fourth_order() {
        let period_s = Array::new(&ArrayConfig::default()).unwrap().orbital_period_s();
        for step_s in [NOISE_STEP_S, SENT_STEP_S] {
            let phase = 5.0 * std::f64::consts::TAU * step_s / period_s;
            let expected = 0.0119 * phase.powi(4);
            let found = error(step_s);
            assert!((found / expected - 1.0).abs() < 0.35, "{step_s}: {found}, expected {expected}");
        }
    }
}
