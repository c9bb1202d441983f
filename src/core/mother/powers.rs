//! Sky powers of the daughters over a window, which determine the noise of each.

use crate::array::Array;
use crate::frames::ObservingWindow;
use crate::response::model::{DaughterPosition, ModelError, VisibilityModel};
use crate::units::TICKS_PER_SECOND;

/// Spacing of the instants at which powers are predicted, s: a ninth of a radian of the orbit. Cubic interpolation
/// does not resolve structure beyond l = 20, which the unocculted half of the sky attenuates by about l^-1.5. The
/// relative error of a power is 5e-4 for a sky with as much in each degree up to l = 40 as in its mean, and far less
/// for a smoother sky.
const STEP_S: f64 = 150.0;

/// Number of nodes that cubic interpolation needs beyond either end.
const MARGIN_NODES: f64 = 1.0;

/// Sky power `Int T A S dn` (K sr) along the arc of orbit that a window covers.
///
/// Daughters that follow each other on one circle share a table, as one that trails by an arc has the same power
/// later. Others have a table each.
pub(super) struct SkyPowers {
    /// Time of the first values of the tables, s.
    from_s: f64,
    tables: Vec<Vec<f64>>,
}

impl SkyPowers {
    /// Predicts the powers of a model over each window.
    ///
    /// # Errors
    /// The model does not cover the positions.
    pub fn predict(
        model: &mut dyn VisibilityModel,
        array: &Array,
        windows: &[ObservingWindow],
    ) -> Result<Vec<Self>, ModelError> {
        let shared = array.formation().is_some() && !model.has_individual_antennas();
        let tables = if shared { 1 } else { array.satellites() };
        // Arcs are longest at the start of a breathing period.
        let lags_s = (0..array.satellites()).map(|n| lag_s(array, n, 0.0));
        let longest_s = lags_s.fold(0.0, f64::max);
        let spans = windows.iter().map(|window| {
            let from_s = window.start.seconds() - longest_s - MARGIN_NODES * STEP_S;
            let length_s = (window.end.0 - window.start.0) as f64 / TICKS_PER_SECOND as f64;
            let steps = ((length_s + longest_s) / STEP_S).ceil() + 2.0 * MARGIN_NODES;
            (from_s, steps as usize + 1)
        });
        let spans: Vec<(f64, usize)> = spans.collect();
        let position = |n: usize, t_s: f64| DaughterPosition {
            r_m: if shared { array.trailing_position_m(0.0, t_s) } else { array.position_m(n, t_s) },
            normal_hat: array.normal_hat(n, t_s),
            daughter_time: Some((n as u8, t_s)),
        };
        let instants = |&(from_s, count): &(f64, usize)| (0..count).map(move |k| from_s + STEP_S * k as f64);
        let positions: Vec<DaughterPosition> = spans
            .iter()
            .flat_map(|span| (0..tables).flat_map(move |n| instants(span).map(move |t_s| position(n, t_s))))
            .collect();
        let mut powers = vec![0.0; positions.len()];
        model.predict_powers(&positions, &mut powers)?;
        let mut powers = powers.into_iter();
        let window_powers = |(from_s, count)| Self {
            from_s,
            tables: (0..tables).map(|_| powers.by_ref().take(count).collect()).collect(),
        };
        Ok(spans.into_iter().map(window_powers).collect())
    }

    /// Power of daughter `n` at a time of the window, K sr.
    pub fn at(&self, array: &Array, n: usize, t_s: f64) -> f64 {
        let lag_s = if self.tables.len() == 1 { lag_s(array, n, t_s) } else { 0.0 };
        let x = (t_s - lag_s - self.from_s) / STEP_S;
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
