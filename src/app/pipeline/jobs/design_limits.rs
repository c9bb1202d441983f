//! What the limits of a design are held against: distances of satellites, and velocity changes for breathing.

use super::design_file::DesignLimits;
use crate::pipeline::config::Plan;
use crate::units::constants::YEAR_S;
use crate::units::vector::{norm, sub};

/// Why a plan is outside the limits, if it is.
pub(super) fn outside(plan: &Plan, limits: &DesignLimits) -> Option<String> {
    let [closest_m, span_m] = distances_m(plan);
    // Arcs are told by their length, of which a chord lacks a little.
    if closest_m < limits.closest_m_min * (1.0 - 1e-6) {
        return Some(format!("two satellites come as close as {closest_m:.1} m"));
    }
    if span_m < limits.span_m_min || limits.span_m_max.is_some_and(|limit| span_m > limit) {
        return Some(format!("the greatest distance of two satellites is {span_m:.0} m"));
    }
    let keeping = breathing_m_s_per_year(plan)?;
    let limit = limits.keeping_m_s_per_year_max?;
    (keeping > limit).then(|| format!("breathing takes {keeping:.2} m/s a year"))
}

/// Orbits of a mission, and places on each, at which distances off one circle are taken.
const ORBITS_MAX: f64 = 256.0;
const PHASES: usize = 64;

/// The least and the greatest distance of two satellites, m: on one circle at the turnarounds of the formation, else at 64 instants of each orbit,
/// or of 256 orbits of a mission with more, observed or not.
fn distances_m(plan: &Plan) -> [f64; 2] {
    let array = &plan.array;
    let instants_s: Vec<f64> = match array.formation() {
        // Arcs are linear in time between these.
        Some(formation) => vec![0.0, 0.5 * formation.period_s()],
        None => {
            let (orbit_s, duration_s) = (array.orbital_period_s(), plan.config.spacecraft.duration_s);
            let orbits = (duration_s / orbit_s).ceil().clamp(1.0, ORBITS_MAX) as usize;
            let step_s = (duration_s - orbit_s).max(0.0) / (orbits - 1).max(1) as f64;
            // Breathing off the circle turns in between, and narrowest first at half its period.
            let turn_s = 0.5 * plan.config.array.breathing.period_s;
            let turns = (!plan.config.array.has_own_orbits() && turn_s < duration_s).then_some(turn_s);
            let starts = (0..orbits).map(|k| k as f64 * step_s).chain(turns);
            let phases =
                |start_s: f64| (0..PHASES).map(move |k| start_s + k as f64 * orbit_s / PHASES as f64);
            starts.flat_map(phases).filter(|t_s| *t_s <= duration_s).collect()
        }
    };
    let mut found = [f64::INFINITY, 0.0_f64];
    for t_s in instants_s {
        let places: Vec<_> = (0..array.satellites()).map(|n| array.position_m(n, t_s)).collect();
        for (k, first) in places.iter().enumerate() {
            for second in &places[k + 1..] {
                let apart_m = norm(sub(*first, *second));
                found = [found[0].min(apart_m), found[1].max(apart_m)];
            }
        }
    }
    found
}

/// Velocity change that breathing takes of the satellite that moves most, m/s a year; `None` without a formation.
///
/// A change dv along the track makes a satellite drift by -3 dv on average (Hill's equations), so that turning a drift v into -v takes 2 v / 3,
/// twice a period. Other forces on the orbit are not in it.
#[must_use]
pub fn breathing_m_s_per_year(plan: &Plan) -> Option<f64> {
    let formation = plan.array.formation()?;
    let drifts = (0..formation.satellites()).map(|n| formation.arc_m(n, 0.0).1.abs());
    Some(2.0 * YEAR_S / formation.period_s() * 2.0 / 3.0 * drifts.fold(0.0, f64::max))
}

#[cfg(test)]
mod tests {
    use super::super::study_file::case_plan;
    use super::*;

    /// Two satellites of eccentricity e with opposite apsides, and a third on their circle.
    #[test]
    fn distances_off_the_circle_are_those_of_whole_orbits() {
        let one = |eccentricity: f64, periapsis_deg: f64| {
            let anomaly_deg = periapsis_deg;
            format!(
                "{{ semi_major_axis_m = 2037.1e3, eccentricity = {eccentricity}, inclination_deg = 30.0, node_longitude_deg = 0.0, \
                 periapsis_deg = {periapsis_deg}, mean_anomaly_deg = {anomaly_deg} }}"
            )
        };
        let overrides = vec![
            "array.satellites=3".to_owned(),
            format!("array.kepler=[{}, {}, {}]", one(0.01, 0.0), one(0.01, 180.0), one(0.0, 0.0)),
            "spacecraft.duration_s=1e5".to_owned(),
        ];
        let source = crate::pipeline::config::ConfigSource { overrides, ..Default::default() };
        let [closest_m, span_m] = distances_m(&case_plan(&source, None).unwrap());
        // Relative to the third they move on an ellipse of a e by 2 a e, on opposite sides.
        let ae_m = 2037.1e3 * 0.01;
        // 64 phases miss an extreme by up to (2 pi / 128)^2 / 2 = 0.12 %, of four times as much across; terms of e^2 are 1 %.
        assert!((closest_m / ae_m - 1.0).abs() < 0.02, "{closest_m}");
        assert!((span_m / (4.0 * ae_m) - 1.0).abs() < 0.02, "{span_m}");
    }
}
