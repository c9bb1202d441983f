//! Integration times and antenna responses that the ground assumes.

use crate::array::{orbit_normal_hat, tilted_axes};
use crate::frames::AntennaResponse;
use crate::response::PatternsByFrequency;
use crate::response::general::{PairResponse, TimedPair};
use crate::response::pixel::SatelliteAntenna;
use crate::units::vector::{Vec3, cross, dot, sub, unit};

/// Positions of a satellite further apart in time than this do not define its plane, s: a quarter of a low orbit.
const SAME_PASS_S: f64 = 1500.0;

/// Whether one visibility follows another of the same pair soon after.
pub(in crate::imaging) fn is_same_pass(before: &TimedPair, after: &TimedPair) -> bool {
    let apart_s = after.time_s - before.time_s;
    before.pair == after.pair && apart_s > 0.0 && apart_s < SAME_PASS_S
}

/// Greatest angle between a satellite's orbit normal and that of the pair's plane at which their dipoles count as parallel, rad: rows
/// err by it.
const SAME_NORMAL_RAD: f64 = 1e-5;

/// Greatest angle between the attitudes of two satellites at which three dipoles on each count as isotropic, rad: rows err by half its
/// square.
const SAME_ATTITUDE_RAD: f64 = 3e-3;

/// The antenna of a daughter.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AssumedAntenna {
    /// Tilt of its axis from the orbit's normal towards the track's direction, and away from the Moon, degrees.
    pub tilt_deg: [f64; 2],
    /// q of a factor `1 + q P_2(cos)` of its voltage, with the angle from the axis.
    pub distortion: f64,
}

/// Integration times and antenna responses in the rows at true positions.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AssumedInstrument {
    /// Whether visibilities are averages over their integrations, or instants in their middle.
    pub smear_integrations: bool,
    /// Antennas by daughter; those beyond the list are ideal.
    pub antennas: Vec<AssumedAntenna>,
    /// Distortions of their patterns by frequency, which are added to theirs.
    pub patterns: PatternsByFrequency,
}

/// Antennas of pairs that differ from the response of the rows.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct PairAntennas {
    antennas: Vec<AssumedAntenna>,
    patterns: PatternsByFrequency,
    frequency_hz: f64,
    elements: AntennaResponse,
}

impl AssumedInstrument {
    /// Antennas of the pairs of sorted visibilities, where they differ from the response of the rows.
    pub(in crate::imaging) fn antennas_of(
        &self,
        elements: AntennaResponse,
        frequency_hz: f64,
        at: &[TimedPair],
    ) -> Option<PairAntennas> {
        let (antennas, patterns) = (self.antennas.clone(), self.patterns.clone());
        let found = PairAntennas { antennas, patterns, frequency_hz, elements };
        let is_tilted = || self.antennas.iter().any(|antenna| antenna.tilt_deg != [0.0; 2]);
        let differs = match elements {
            AntennaResponse::Isotropic => false,
            AntennaResponse::DipoleNormal => is_tilted() || leave_the_plane(at),
            AntennaResponse::ThreeDipoles => is_tilted() || turn_apart(at),
        };
        (found.is_distorted() || differs).then_some(found)
    }
}

impl PairAntennas {
    fn is_distorted(&self) -> bool {
        !self.patterns.is_ideal() || self.antennas.iter().any(|antenna| antenna.distortion != 0.0)
    }

    /// Degree of their responses, which are polynomials.
    pub(in crate::imaging) fn degree(&self) -> usize {
        self.elements.degree() + 4 * usize::from(self.is_distorted())
    }

    /// The response of a pair.
    pub(in crate::imaging) fn response(&self, at: &[TimedPair], k: usize) -> PairResponse {
        let pair = &at[k];
        let [normal_i, normal_j] = normals(at, k);
        let antenna = |daughter: u8, r_m: Vec3, normal_hat: Vec3| {
            let known = self.antennas.get(usize::from(daughter)).copied().unwrap_or_default();
            let axes_hat = tilted_axes(r_m, normal_hat, known.tilt_deg);
            let distortion = known.distortion + self.patterns.q(daughter.into(), self.frequency_hz);
            SatelliteAntenna { elements: self.elements, axes_hat, distortion }
        };
        let a = antenna(pair.pair.i, pair.r_i_m, normal_i);
        let b = antenna(pair.pair.j, pair.r_j_m, normal_j);
        PairResponse::of_antennas([&a, &b])
    }
}

/// Whether dipoles along the normals of orbits are not along those of the pairs' planes.
fn leave_the_plane(at: &[TimedPair]) -> bool {
    at.iter().enumerate().any(|(k, pair)| {
        let plane = unit(cross(pair.r_i_m, pair.r_j_m));
        normals(at, k).into_iter().any(|normal| {
            let off = cross(normal, plane);
            dot(off, off) > SAME_NORMAL_RAD * SAME_NORMAL_RAD
        })
    })
}

/// Whether the satellites of a pair, each upright in its own orbit, have different attitudes.
fn turn_apart(at: &[TimedPair]) -> bool {
    at.iter().enumerate().any(|(k, pair)| {
        let [a, b] = normals(at, k);
        let (normals, verticals) = (sub(a, b), sub(unit(pair.r_i_m), unit(pair.r_j_m)));
        [normals, verticals]
            .into_iter()
            .any(|apart| dot(apart, apart) > SAME_ATTITUDE_RAD * SAME_ATTITUDE_RAD)
    })
}

/// Normals of the orbits of satellites i and j, as they move from or to a neighbouring visibility; without one that of their plane.
fn normals(at: &[TimedPair], k: usize) -> [Vec3; 2] {
    let here = &at[k];
    let after = at.get(k + 1).filter(|after| is_same_pass(here, after)).map(|after| [here, after]);
    let before = k.checked_sub(1).map(|k| &at[k]).filter(|before| is_same_pass(before, here));
    let moves = after.or(before.map(|before| [before, here]));
    let plane = || {
        let normal = unit(cross(here.r_i_m, here.r_j_m));
        // A satellite j that leads turns it upside down; orbits are prograde more often than not.
        if normal[2] < 0.0 { normal.map(|x| -x) } else { normal }
    };
    let normal = |of: fn(&TimedPair) -> Vec3| {
        moves.and_then(|[from, to]| orbit_normal_hat(of(from), of(to))).unwrap_or_else(plane)
    };
    [normal(|at| at.r_i_m), normal(|at| at.r_j_m)]
}
