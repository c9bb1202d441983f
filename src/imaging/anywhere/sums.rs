//! Visibilities one by one, and their sums on the nearest circle.
//!
//! The circle's sums (see [`super`]) place each visibility on the nearest circle: near enough to precondition, not to map.
//! The true rows need the positions of each.

use num_complex::Complex64;
use rayon::prelude::*;
use serde::Serialize;

use super::archived::{ArchivedVisibility, RefinedSetup};
use super::assumed_instrument::{AssumedInstrument, PairAntennas, is_same_pass};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::imaging::circle::{HarmonicEngine, HarmonicSetup, HarmonicSums};
use crate::imaging::circle::{INCLINATION_STEP_DEG, RADIUS_STEP_M};
use crate::imaging::exact::noise::companion_noise;
use crate::imaging::{AccumulationError, NormalEngine};
use crate::response::general::{
    GeneralRows, ObservationDetails, PairResponse, RowPlan, RowsSetup, TimedPair,
};
use crate::response::harmonic::{GeometryLimits, NominalOrbit, PairOrientation};
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::{Vec3, cross, dot};

/// Plans the rows of sorted visibilities, and sums them on the nearest circle.
pub(in crate::imaging) fn refined_sums(
    setup: &RefinedSetup,
    held: Vec<ArchivedVisibility>,
    assumed: &AssumedInstrument,
) -> Result<RefinedSums, AccumulationError> {
    let VisibilityColumns { at, bands, data, duration_s } = taken_apart(setup, held);
    let (orbit, departures) = nearest_circle(setup, &|k| at[k], at.len());
    let circle = circle_sums(setup, orbit, &at, &bands, &data)?;
    let antennas = assumed.antennas_of(setup.response, setup.frequency_hz, &at);
    let rows = GeneralRows::new(RowsSetup {
        l_max: setup.l_max,
        wavelength_m: SPEED_OF_LIGHT_M_S / setup.frequency_hz,
        moon_radius_m: setup.moon_radius_m,
        response: if antennas.is_some() { AntennaResponse::Isotropic } else { setup.response },
        polynomial_degree: antennas.as_ref().map_or(0, PairAntennas::degree),
    });
    let response = antennas.as_ref().map(|antennas| |k: usize| antennas.response(&at, k));
    let observed = ObservationDetails {
        duration_s: if assumed.smear_integrations { &duration_s } else { &[] },
        response: response.as_ref().map(|of| of as &(dyn Fn(usize) -> PairResponse + Sync)),
    };
    // Each visibility was checked when it came.
    let plan = rows.plan_with(&at, &observed).map_err(|error| AccumulationError::Rows(error.refusal))?;
    Ok(RefinedSums { circle, rows, plan, at, data, departures })
}

/// Visibilities as lists.
pub(in crate::imaging) struct VisibilityColumns {
    pub(in crate::imaging) at: Vec<TimedPair>,
    bands: Vec<u16>,
    pub(in crate::imaging) data: RefinedData,
    duration_s: Vec<f32>,
}

/// Positions, sub-bands, data and lengths of visibilities.
pub(in crate::imaging) fn taken_apart(
    setup: &RefinedSetup,
    held: Vec<ArchivedVisibility>,
) -> VisibilityColumns {
    let noise = noises(setup, &held);
    let data = RefinedData {
        value_k_sr: held.iter().map(|held| held.value_k_sr).collect(),
        weight: held.iter().map(|held| held.weight).collect(),
        noise,
    };
    let bands = held.iter().map(|held| held.band).collect();
    let duration_s = held.iter().map(|held| held.duration_s).collect();
    VisibilityColumns { at: held.into_iter().map(|held| held.at).collect(), bands, data, duration_s }
}

/// Noise of the companion, by visibility.
fn noises(setup: &RefinedSetup, held: &[ArchivedVisibility]) -> Vec<Complex64> {
    held.par_iter()
        .map(|held| {
            let one = PlacedVisibilities {
                channel: setup.channel,
                band: held.band,
                pair: held.at.pair,
                time_s: vec![held.at.time_s],
                ..PlacedVisibilities::default()
            };
            companion_noise(setup.companion_seed, &one, 0)
        })
        .collect()
}

/// How far the positions are from the circle on which the preconditioner places them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct Departures {
    /// Inclination of the circle, degrees.
    pub circle_inclination_deg: f64,
    /// Radius of the circle, m.
    pub circle_radius_m: f64,
    /// Visibilities within `map.limits` of it, which its sums hold as they are.
    pub on_the_circle: u64,
    /// Visibilities beyond, which are in the map by refinement alone.
    pub by_refinement: u64,
    /// Greatest difference in altitude, m.
    pub altitude_m_max: f64,
    /// Greatest difference between the planes of a pair and the circle, degrees.
    pub tilt_deg_max: f64,
    /// Greatest angle between a baseline and the horizontal, degrees.
    pub radial_deg_max: f64,
}

/// The normal of the orbit, m^2 and as the satellite turns, from where it moves to until the next visibility of the pair; `None` if
/// the next is another pair's or another pass's. The planes of pairs lie across the orbit's if satellites do not follow each other.
fn orbit_normal(before: &TimedPair, after: &TimedPair) -> Option<Vec3> {
    is_same_pass(before, after).then(|| cross(before.r_i_m, after.r_i_m))
}

/// Mean inclination of the orbits' planes; `None` if each visibility stands alone.
fn orbit_inclination_rad(at: &dyn Fn(usize) -> TimedPair, count: usize) -> Option<f64> {
    let (mut sum, mut found) = (0.0, 0.0);
    for k in 1..count {
        if let Some(normal) = orbit_normal(&at(k - 1), &at(k)) {
            sum += normal[0].hypot(normal[1]).atan2(normal[2]);
            found += 1.0;
        }
    }
    (found > 0.0).then(|| sum / found)
}

/// Phase of the orbit at visibility `k` of sorted ones, degrees from 0 to 360: the angle of satellite i from the ascending node, in the
/// plane in which it moves from or to a neighbouring visibility. `None` without one, or for an orbit over the equator.
#[must_use]
pub fn orbit_phase_deg(at: &[TimedPair], k: usize) -> Option<f64> {
    let here = at.get(k)?;
    let after = at.get(k + 1).and_then(|after| orbit_normal(here, after));
    let before = k.checked_sub(1).and_then(|before| orbit_normal(at.get(before)?, here));
    let normal = after.or(before)?;
    let node = [-normal[1], normal[0], 0.0];
    let across = cross(normal, node);
    let length = node[0].hypot(node[1]);
    let turned = dot(normal, normal).sqrt();
    let phase = (dot(here.r_i_m, across) / turned).atan2(dot(here.r_i_m, node));
    (length > 0.0).then(|| phase.to_degrees().rem_euclid(360.0))
}

/// The circle of the mean radius and inclination of all.
pub(in crate::imaging) fn nearest_circle(
    setup: &RefinedSetup,
    at: &dyn Fn(usize) -> TimedPair,
    count: usize,
) -> (NominalOrbit, Departures) {
    use std::f64::consts::PI;
    let orientation = |at: TimedPair| PairOrientation::of_pair(at.r_i_m, at.r_j_m).ok();
    let found: Vec<PairOrientation> = (0..count).filter_map(|k| orientation(at(k))).collect();
    // A satellite j that leads turns the pair's plane upside down.
    let prograde = |pair: &PairOrientation| pair.inclination_rad.min(PI - pair.inclination_rad);
    let mean =
        |of: &dyn Fn(&PairOrientation) -> f64| found.iter().map(of).sum::<f64>() / found.len().max(1) as f64;
    let orbit_rad = orbit_inclination_rad(at, count).unwrap_or_else(|| mean(&prograde));
    let inclination_deg = (orbit_rad.to_degrees() / INCLINATION_STEP_DEG).round() * INCLINATION_STEP_DEG;
    let mean_m = (mean(&|pair| pair.radius_m) / RADIUS_STEP_M).round() * RADIUS_STEP_M;
    // A circle above the surface, which has room for the longest baseline: positions may be just above it, or anything that was sent.
    let radius_m = mean_m.max(setup.moon_radius_m.max(setup.baseline_m_max) + RADIUS_STEP_M);
    let inclination_rad = inclination_deg.to_radians();
    let limited = NominalOrbit { inclination_rad, radius_m, limits: setup.limits };
    let wavelength_m = SPEED_OF_LIGHT_M_S / setup.frequency_hz;
    let mut departures = Departures {
        circle_inclination_deg: inclination_deg,
        circle_radius_m: radius_m,
        ..Departures::default()
    };
    for pair in &found {
        match limited.pair(pair, wavelength_m) {
            Ok(_) => departures.on_the_circle += 1,
            Err(_) => departures.by_refinement += 1,
        }
        let tilts = [pair.inclination_rad, PI - pair.inclination_rad].map(|i| (i - inclination_rad).abs());
        let tilt_rad = tilts[0].min(tilts[1]);
        let radial_rad = (pair.radius_difference_m.abs() / pair.baseline_m).min(1.0).asin();
        for (greatest, value) in [
            (&mut departures.altitude_m_max, (pair.radius_m - radius_m).abs()),
            (&mut departures.tilt_deg_max, tilt_rad.to_degrees()),
            (&mut departures.radial_deg_max, radial_rad.to_degrees()),
        ] {
            *greatest = greatest.max(value);
        }
    }
    let anywhere = GeometryLimits {
        out_of_track_deg_max: f64::INFINITY,
        inclination_deg_max: f64::INFINITY,
        altitude_m_max: f64::INFINITY,
        radial_deg_max: f64::INFINITY,
    };
    (NominalOrbit { limits: anywhere, ..limited }, departures)
}

/// Visibilities that are handed to the circle's engine together.
pub(in crate::imaging) const BLOCK: usize = 65_536;

/// An engine for sums on a circle.
pub(in crate::imaging) fn circle_engine(
    setup: &RefinedSetup,
    orbit: NominalOrbit,
) -> Result<HarmonicEngine, AccumulationError> {
    HarmonicEngine::new(HarmonicSetup {
        l_max: setup.l_max,
        frequency_hz: setup.frequency_hz,
        baseline_m_max: setup.baseline_m_max,
        moon_radius_m: setup.moon_radius_m,
        response: setup.response,
        orbit,
        companion_seed: setup.companion_seed,
        weight_max: setup.weight_max,
    })
}

/// The sums of all visibilities on the circle.
fn circle_sums(
    setup: &RefinedSetup,
    orbit: NominalOrbit,
    at: &[TimedPair],
    bands: &[u16],
    data: &RefinedData,
) -> Result<HarmonicSums, AccumulationError> {
    let mut engine = circle_engine(setup, orbit)?;
    let mut first = 0;
    while first < at.len() {
        let same = |k: &usize| at[*k].pair == at[first].pair && bands[*k] == bands[first];
        let end =
            (first + 1..at.len().min(first + BLOCK)).take_while(same).last().map_or(first + 1, |k| k + 1);
        let block = &at[first..end];
        let _ = engine.add(&PlacedVisibilities {
            channel: setup.channel,
            band: bands[first],
            frequency_hz: setup.frequency_hz,
            pair: at[first].pair,
            time_s: block.iter().map(|at| at.time_s).collect(),
            r_i_m: block.iter().map(|at| at.r_i_m).collect(),
            r_j_m: block.iter().map(|at| at.r_j_m).collect(),
            value_k_sr: data.value_k_sr[first..end].to_vec(),
            weight: data.weight[first..end].to_vec(),
            duration_s: Vec::new(),
        })?;
        first = end;
    }
    Ok(engine.into_sums())
}

/// What was measured.
#[derive(Clone, Debug)]
pub struct RefinedData {
    /// Values, K sr.
    pub value_k_sr: Vec<Complex64>,
    /// Inverse variances of their real parts, (K sr)^-2.
    pub weight: Vec<f64>,
    /// Noise of the noise-only companion, in units of the standard deviation.
    pub noise: Vec<Complex64>,
}

/// Visibilities with their true rows of B, and their sums on the nearest circle.
#[derive(Clone, Debug)]
pub struct RefinedSums {
    /// The sums of the nearest circle: a preconditioner, not a map.
    pub circle: HarmonicSums,
    /// Rows of B for any positions.
    pub rows: GeneralRows,
    /// The plan of the rows, in the order of `at`.
    pub plan: RowPlan,
    /// Pairs, times and positions, sorted.
    pub at: Vec<TimedPair>,
    /// Data in that order.
    pub data: RefinedData,
    /// How far they are from the circle.
    pub departures: Departures,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::Pair;

    /// A circular orbit turned about x by its inclination and about z by its node, as text books have it.
    #[test]
    fn phases_are_those_from_the_ascending_node() {
        for (inclination_deg, node_deg) in [(30.0_f64, 0.0_f64), (30.0, 200.0), (150.0, -40.0), (89.0, 77.0)]
        {
            let ((si, ci), (so, co)) =
                (inclination_deg.to_radians().sin_cos(), node_deg.to_radians().sin_cos());
            let at = |k: usize| {
                let (sp, cp) = (0.3 + 0.2 * k as f64).sin_cos();
                let [x, y] = [2e6 * cp, 2e6 * sp];
                let r_i_m = [x * co - y * so * ci, x * so + y * co * ci, y * si];
                TimedPair { pair: Pair { i: 0, j: 1 }, time_s: 60.0 * k as f64, r_i_m, r_j_m: [0.0; 3] }
            };
            let all: Vec<TimedPair> = (0..40).map(at).collect();
            for k in 0..all.len() {
                let expected = (0.3 + 0.2 * k as f64).to_degrees().rem_euclid(360.0);
                let found = orbit_phase_deg(&all, k).unwrap();
                assert!(
                    (found - expected).abs() < 1e-6,
                    "{inclination_deg} {node_deg} {k}: {found} {expected}"
                );
            }
            // Alone, or long before the next, its plane is not known.
            assert_eq!(orbit_phase_deg(&all[..1], 0), None);
            let late = TimedPair { time_s: 1e6, ..all[1] };
            assert_eq!(orbit_phase_deg(&[all[0], late], 0), None);
        }
    }
}
