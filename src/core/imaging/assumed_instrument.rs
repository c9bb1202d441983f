//! Integration times and antenna responses that the rows of a refined map assume.

use crate::array::{orbit_normal_hat, track_axes};
use crate::frames::AntennaResponse;
use crate::response::general::{PairResponse, TimedPair};
use crate::response::{AntennaQuery, MeasuredAntennas, MeasuredAntennasError, PatternsByFrequency};
use crate::units::vector::{Vec3, cross, dot, sub, unit};

/// Maximum time between positions that define a satellite's orbital plane, s: a quarter of a low orbit.
const SAME_PASS_S: f64 = 1500.0;

/// Whether `after` follows `before` in the same pass of the same pair.
pub(in crate::imaging) fn is_same_pass(before: &TimedPair, after: &TimedPair) -> bool {
    let interval_s = after.time_s - before.time_s;
    before.pair == after.pair && interval_s > 0.0 && interval_s < SAME_PASS_S
}

/// Maximum angle between a satellite's orbit normal and the normal of the pair's plane at which their dipoles count as parallel, rad. It is
/// the error of rows.
const SAME_NORMAL_RAD: f64 = 1e-5;

/// Maximum angle between the attitudes of two satellites at which three dipoles on each count as isotropic, rad. Half its square is the error
/// of rows.
const SAME_ATTITUDE_RAD: f64 = 3e-3;

/// The assumed antenna of a daughter.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AssumedAntenna {
    /// Tilt of its axis from the orbit normal: towards the direction of flight, and away from the Moon, degrees.
    pub tilt_deg: [f64; 2],
    /// Distortion q: a factor `1 + q P_2(cos theta)` of its voltage pattern, theta being the angle from the axis.
    pub distortion: f64,
}

/// The integration times and antenna responses that rows at true positions assume.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AssumedInstrument {
    /// Whether rows are averaged over integrations; otherwise they are taken in the middle.
    pub smear_integrations: bool,
    /// Antennas by daughter; those beyond the list are ideal.
    pub antennas: Vec<AssumedAntenna>,
    /// Distortions by frequency, added to those of `antennas`.
    pub patterns: PatternsByFrequency,
    /// Attitudes and patterns by files.
    pub measured: MeasuredAntennas,
    /// Satellites that these are of.
    pub satellites: usize,
    /// The mission's epoch, TAI seconds since 1958, for the dates of files.
    pub epoch_tai_s: f64,
}

/// Antennas of pairs whose response differs from that of the rows.
#[derive(Clone, Debug)]
pub(in crate::imaging) struct PairAntennas {
    assumed: AssumedInstrument,
    frequency_hz: f64,
    elements: AntennaResponse,
}

impl AssumedInstrument {
    /// Antennas of the pairs of sorted visibilities, where they differ from the response of the rows.
    ///
    /// # Errors
    /// Files that do not have these satellites, this frequency, or these times.
    pub(in crate::imaging) fn antennas_of(
        &self,
        elements: AntennaResponse,
        frequency_hz: f64,
        at: &[TimedPair],
    ) -> Result<Option<PairAntennas>, MeasuredAntennasError> {
        let measured = &self.measured;
        measured.require(self.satellites, elements, frequency_hz)?;
        for at in at {
            for daughter in [at.pair.i, at.pair.j] {
                measured.require_attitude(daughter.into(), [self.epoch_tai_s + at.time_s; 2])?;
            }
        }
        let found = PairAntennas { assumed: self.clone(), frequency_hz, elements };
        let is_tilted =
            || !measured.is_none() || self.antennas.iter().any(|antenna| antenna.tilt_deg != [0.0; 2]);
        let differs = match elements {
            AntennaResponse::Isotropic => false,
            AntennaResponse::DipoleNormal => is_tilted() || normals_leave_pair_planes(at),
            AntennaResponse::ThreeDipoles => is_tilted() || attitudes_differ(at),
        };
        Ok((self.is_distorted() || differs).then_some(found))
    }

    fn is_distorted(&self) -> bool {
        !self.patterns.is_ideal()
            || self.measured.has_patterns()
            || self.antennas.iter().any(|antenna| antenna.distortion != 0.0)
    }
}

impl PairAntennas {
    /// Degree of their responses, which are polynomials.
    pub(in crate::imaging) fn degree(&self) -> usize {
        self.elements.degree() + 4 * usize::from(self.assumed.is_distorted())
    }

    /// The response of the pair of visibility `k`.
    pub(in crate::imaging) fn response(&self, at: &[TimedPair], k: usize) -> PairResponse {
        let pair = &at[k];
        let [normal_i, normal_j] = normals(at, k);
        let Self { assumed, frequency_hz, elements } = self;
        let (frequency_hz, elements, tai_s) = (*frequency_hz, *elements, assumed.epoch_tai_s + pair.time_s);
        let antenna = |daughter: u8, r_m: Vec3, normal_hat: Vec3| {
            let satellite = usize::from(daughter);
            let known = assumed.antennas.get(satellite).copied().unwrap_or_default();
            let q = known.distortion + assumed.patterns.q(satellite, frequency_hz);
            let of = AntennaQuery { satellite, tai_s, frequency_hz, elements };
            assumed.measured.antenna(of, track_axes(r_m, normal_hat), known.tilt_deg, q)
        };
        let a = antenna(pair.pair.i, pair.r_i_m, normal_i);
        let b = antenna(pair.pair.j, pair.r_j_m, normal_j);
        PairResponse::of_antennas([&a, &b])
    }
}

/// Whether orbit normals, along which dipoles point, differ from the normals of the pairs' planes.
fn normals_leave_pair_planes(at: &[TimedPair]) -> bool {
    at.iter().enumerate().any(|(k, pair)| {
        let plane = unit(cross(pair.r_i_m, pair.r_j_m));
        normals(at, k).into_iter().any(|normal| {
            let off = cross(normal, plane);
            dot(off, off) > SAME_NORMAL_RAD * SAME_NORMAL_RAD
        })
    })
}

/// Whether the satellites of a pair, each aligned with its own orbit, have different attitudes.
fn attitudes_differ(at: &[TimedPair]) -> bool {
    at.iter().enumerate().any(|(k, pair)| {
        let [a, b] = normals(at, k);
        let (normals, verticals) = (sub(a, b), sub(unit(pair.r_i_m), unit(pair.r_j_m)));
        [normals, verticals]
            .into_iter()
            .any(|apart| dot(apart, apart) > SAME_ATTITUDE_RAD * SAME_ATTITUDE_RAD)
    })
}

/// The orbit normals of satellites i and j, from their motion to a neighbouring visibility; without one, the normal of the pair's plane.
fn normals(at: &[TimedPair], k: usize) -> [Vec3; 2] {
    let here = &at[k];
    let after = at.get(k + 1).filter(|after| is_same_pass(here, after)).map(|after| [here, after]);
    let before = k.checked_sub(1).map(|k| &at[k]).filter(|before| is_same_pass(before, here));
    let interval = after.or(before.map(|before| [before, here]));
    let plane = || {
        let normal = unit(cross(here.r_i_m, here.r_j_m));
        // If satellite j leads, this normal is reversed. Orbits are assumed prograde.
        if normal[2] < 0.0 { normal.map(|x| -x) } else { normal }
    };
    let normal = |position: fn(&TimedPair) -> Vec3| {
        interval.and_then(|[from, to]| orbit_normal_hat(position(from), position(to))).unwrap_or_else(plane)
    };
    [normal(|at| at.r_i_m), normal(|at| at.r_j_m)]
}
