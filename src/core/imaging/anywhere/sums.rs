//! Individual visibilities, and their sums on the nearest circular orbit.
//!
//! The circle's sums place each visibility on the nearest circle, which is accurate enough for a preconditioner but not for a map. The true
//! rows use the position of each.

use num_complex::Complex64;
use rayon::prelude::*;
use serde::Serialize;

use super::archived::{ArchivedVisibility, RefinedSetup};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::imaging::assumed_instrument::{AssumedInstrument, PairAntennas, is_same_pass};
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

/// Plans the rows of sorted visibilities, and makes their sums on the nearest circle.
pub(in crate::imaging) fn refined_sums(
    setup: &RefinedSetup,
    held: Vec<ArchivedVisibility>,
    assumed: &AssumedInstrument,
) -> Result<RefinedSums, AccumulationError> {
    let VisibilityColumns { at, bands, data, duration_s } = VisibilityColumns::new(setup, held);
    let (orbit, departures) = nearest_circle(setup, &|k| at[k], at.len());
    let circle = circle_sums(setup, orbit, &at, &bands, &data)?;
    let antennas = assumed.antennas_of(setup.response, setup.frequency_hz, &at)?;
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
        response: response.as_ref().map(|response| response as &(dyn Fn(usize) -> PairResponse + Sync)),
    };
    // Each visibility was checked when it was added.
    let plan = rows.plan_with(&at, &observed).map_err(|error| AccumulationError::Rows(error.refusal))?;
    Ok(RefinedSums { circle, rows, plan, at, data, departures })
}

/// Visibilities as one array per quantity.
pub(in crate::imaging) struct VisibilityColumns {
    pub(in crate::imaging) at: Vec<TimedPair>,
    bands: Vec<u16>,
    pub(in crate::imaging) data: RefinedData,
    duration_s: Vec<f32>,
}

impl VisibilityColumns {
    /// Splits visibilities into columns, and simulates their noise.
    pub(in crate::imaging) fn new(setup: &RefinedSetup, held: Vec<ArchivedVisibility>) -> Self {
        let data = RefinedData {
            value_k_sr: held.iter().map(|held| held.value_k_sr).collect(),
            weight: held.iter().map(|held| held.weight).collect(),
            noise: simulated_noise(setup, &held),
        };
        let bands = held.iter().map(|held| held.band).collect();
        let duration_s = held.iter().map(|held| held.duration_s).collect();
        Self { at: held.into_iter().map(|held| held.at).collect(), bands, data, duration_s }
    }
}

/// Simulated noise for the noise-only map, by visibility.
fn simulated_noise(setup: &RefinedSetup, held: &[ArchivedVisibility]) -> Vec<Complex64> {
    held.par_iter()
        .map(|held| {
            let block = PlacedVisibilities {
                channel: setup.channel,
                band: held.band,
                pair: held.at.pair,
                time_s: vec![held.at.time_s],
                ..PlacedVisibilities::default()
            };
            companion_noise(setup.companion_seed, &block, 0)
        })
        .collect()
}

/// Departures of the positions from the circle on which the preconditioner places them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, bincode::Encode, bincode::Decode)]
pub struct Departures {
    /// Inclination of the circle, degrees.
    pub circle_inclination_deg: f64,
    /// Radius of the circle, m.
    pub circle_radius_m: f64,
    /// Number of visibilities within `map.limits` of the circle.
    pub on_the_circle: u64,
    /// Number of visibilities beyond, whose positions only the refinement takes into account.
    pub by_refinement: u64,
    /// Maximum difference in altitude, m.
    pub altitude_m_max: f64,
    /// Maximum angle between a pair's plane and the circle's, degrees.
    pub tilt_deg_max: f64,
    /// Maximum angle between a baseline and the horizontal, degrees.
    pub radial_deg_max: f64,
}

/// The orbit normal (not normalised, m^2) from the motion of satellite i between two visibilities of a pair; `None` for different pairs or
/// passes. The plane of a pair itself would do only for satellites that follow each other.
fn orbit_normal(before: &TimedPair, after: &TimedPair) -> Option<Vec3> {
    is_same_pass(before, after).then(|| cross(before.r_i_m, after.r_i_m))
}

/// Mean inclination of the orbits; `None` if no two visibilities are of one pair and pass.
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

/// Orbital phase at visibility `k` of a sorted list: the angle of satellite i from the ascending node, 0 to 360 degrees. The orbital plane
/// comes from a neighbouring visibility; `None` without one, or for an equatorial orbit.
#[must_use]
pub fn orbit_phase_deg(at: &[TimedPair], k: usize) -> Option<f64> {
    let here = at.get(k)?;
    let after = at.get(k + 1).and_then(|after| orbit_normal(here, after));
    let before = k.checked_sub(1).and_then(|before| orbit_normal(at.get(before)?, here));
    let normal = after.or(before)?;
    let node = [-normal[1], normal[0], 0.0];
    let across = cross(normal, node);
    let node_length = node[0].hypot(node[1]);
    let normal_length = dot(normal, normal).sqrt();
    let phase = (dot(here.r_i_m, across) / normal_length).atan2(dot(here.r_i_m, node));
    (node_length > 0.0).then(|| phase.to_degrees().rem_euclid(360.0))
}

/// The circle of the mean radius and inclination, and the departures of all visibilities from it.
pub(in crate::imaging) fn nearest_circle(
    setup: &RefinedSetup,
    at: &dyn Fn(usize) -> TimedPair,
    count: usize,
) -> (NominalOrbit, Departures) {
    use std::f64::consts::PI;
    let orientation = |at: TimedPair| PairOrientation::of_pair(at.r_i_m, at.r_j_m).ok();
    let found: Vec<PairOrientation> = (0..count).filter_map(|k| orientation(at(k))).collect();
    let mean = |value: &dyn Fn(&PairOrientation) -> f64| {
        found.iter().map(value).sum::<f64>() / found.len().max(1) as f64
    };
    let orbit_rad =
        orbit_inclination_rad(at, count).unwrap_or_else(|| mean(&PairOrientation::prograde_inclination_rad));
    let inclination_deg = (orbit_rad.to_degrees() / INCLINATION_STEP_DEG).round() * INCLINATION_STEP_DEG;
    let mean_m = (mean(&|pair| pair.radius_m) / RADIUS_STEP_M).round() * RADIUS_STEP_M;
    // Positions are untrusted: the circle must lie above the surface and be larger than the longest baseline.
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
        for (maximum, value) in [
            (&mut departures.altitude_m_max, (pair.radius_m - radius_m).abs()),
            (&mut departures.tilt_deg_max, tilt_rad.to_degrees()),
            (&mut departures.radial_deg_max, radial_rad.to_degrees()),
        ] {
            *maximum = maximum.max(value);
        }
    }
    let unlimited = GeometryLimits {
        out_of_track_deg_max: f64::INFINITY,
        inclination_deg_max: f64::INFINITY,
        altitude_m_max: f64::INFINITY,
        radial_deg_max: f64::INFINITY,
    };
    (NominalOrbit { limits: unlimited, ..limited }, departures)
}

/// Maximum number of visibilities in a block for the circle's engine.
pub(in crate::imaging) const BLOCK: usize = 65_536;

/// Creates an engine for sums on a circle.
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

/// Makes the sums of all visibilities on the circle.
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
        let is_same_block = |k: &usize| at[*k].pair == at[first].pair && bands[*k] == bands[first];
        let end = (first + 1..at.len().min(first + BLOCK))
            .take_while(is_same_block)
            .last()
            .map_or(first + 1, |k| k + 1);
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
            gain_errors: Vec::new(),
        })?;
        first = end;
    }
    Ok(engine.into_sums())
}

/// Data of visibilities.
#[derive(Clone, Debug)]
pub struct RefinedData {
    /// Values, K sr.
    pub value_k_sr: Vec<Complex64>,
    /// Inverse variances of their real parts, (K sr)^-2.
    pub weight: Vec<f64>,
    /// Simulated noise for the noise-only map, in units of the standard deviation.
    pub noise: Vec<Complex64>,
}

/// Visibilities with their true rows of B, and their sums on the nearest circle.
#[derive(Clone, Debug)]
pub struct RefinedSums {
    /// The sums on the nearest circle, for the preconditioner.
    pub circle: HarmonicSums,
    /// Computes rows of B at any positions.
    pub rows: GeneralRows,
    /// The plan of the rows, in the order of `at`.
    pub plan: RowPlan,
    /// Pairs, times and positions, sorted.
    pub at: Vec<TimedPair>,
    /// Data, in the order of `at`.
    pub data: RefinedData,
    /// Departures from the circle.
    pub departures: Departures,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::units::Pair;

    /// A circular orbit rotated about x by its inclination and about z by its node.
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
            // Without a neighbour in time the plane is not known.
            assert_eq!(orbit_phase_deg(&all[..1], 0), None);
            let late = TimedPair { time_s: 1e6, ..all[1] };
            assert_eq!(orbit_phase_deg(&[all[0], late], 0), None);
        }
    }
}
