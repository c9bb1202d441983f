//! Visibilities kept one by one, for a map that is refined with their own positions.
//!
//! The circle's sums (see [`super`]) place each visibility on the nearest circle: near enough to precondition, not to map.
//! The true rows need the positions, so that visibilities are held in memory until the map is made. They are sorted before
//! anything is summed: results do not depend on the order in which they arrived.

use num_complex::Complex64;
use rayon::prelude::*;
use serde::Serialize;

use super::setup::{INCLINATION_STEP_DEG, RADIUS_STEP_M};
use super::{HarmonicEngine, HarmonicSetup, HarmonicSums};
use crate::accumulation::fixed_point::WeightScale;
use crate::accumulation::noise::companion_noise;
use crate::accumulation::{AccumulationError, Added, NormalEngine, Refusal, SumCounts};
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::response::general::{GeneralRows, PairAt, RowPlan, RowsSetup, check_positions};
use crate::response::harmonic::{GeometryLimits, NominalOrbit, PairOrientation};
use crate::units::ChannelId;
use crate::units::constants::SPEED_OF_LIGHT_M_S;
use crate::units::vector::cross;

/// Memory of a visibility while it is held, sorted and refined with, bytes: the arrays' elements, and what they grow by.
pub const REFINED_VISIBILITY_BYTES: u64 = 400;

/// Setup of an archive of visibilities.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefinedSetup {
    /// Channel.
    pub channel: ChannelId,
    /// Greatest degree of the map.
    pub l_max: usize,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Longest baseline that is accepted, m.
    pub baseline_m_max: f64,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna response.
    pub response: AntennaResponse,
    /// Seed of the noise-only companion.
    pub companion_seed: u64,
    /// Greatest weight that is accepted, (K sr)^-2.
    pub weight_max: f64,
    /// Departures from the circle up to which its sums alone would hold.
    pub limits: GeometryLimits,
    /// Most visibilities that are held.
    pub visibilities_max: u64,
}

/// A visibility that is held.
#[derive(Clone, Copy, Debug, PartialEq)]
struct HeldVisibility {
    at: PairAt,
    band: u16,
    value_k_sr: Complex64,
    weight: f64,
}

/// The visibilities of one channel, in memory.
#[derive(Clone, Debug)]
pub struct VisibilityArchive {
    setup: RefinedSetup,
    scale: WeightScale,
    held: Vec<HeldVisibility>,
}

impl VisibilityArchive {
    /// An empty archive.
    ///
    /// # Errors
    /// A greatest weight out of range.
    pub fn new(setup: RefinedSetup) -> Result<Self, AccumulationError> {
        Ok(Self { setup, scale: WeightScale::new(setup.weight_max)?, held: Vec::new() })
    }

    /// Takes visibilities.
    ///
    /// # Errors
    /// A block of another frequency. A visibility without a row of B, or for which there is no room, is counted as refused.
    pub fn add(&mut self, placed: &PlacedVisibilities) -> Result<Added, AccumulationError> {
        if placed.frequency_hz != self.setup.frequency_hz {
            return Err(AccumulationError::Frequency {
                expected_hz: self.setup.frequency_hz,
                found_hz: placed.frequency_hz,
            });
        }
        let mut added = Added::default();
        for k in 0..placed.len() {
            match self.accept(placed, k) {
                Ok(held) => {
                    self.held.push(held);
                    added.visibilities += 1;
                }
                Err(reason) => added.refuse(reason),
            }
        }
        Ok(added)
    }

    fn accept(&self, placed: &PlacedVisibilities, k: usize) -> Result<HeldVisibility, Refusal> {
        let (r_i_m, r_j_m) = (placed.r_i_m[k], placed.r_j_m[k]);
        check_positions(r_i_m, r_j_m, self.setup.moon_radius_m)?;
        let (value_k_sr, weight) = (placed.value_k_sr[k], placed.weight[k]);
        self.scale.check(value_k_sr, weight, self.setup.weight_max)?;
        if self.held.len() as u64 >= self.setup.visibilities_max {
            return Err(Refusal::Full);
        }
        let at = PairAt { pair: placed.pair, time_s: placed.time_s[k], r_i_m, r_j_m };
        Ok(HeldVisibility { at, band: placed.band, value_k_sr, weight })
    }

    /// Number, weight and power of the visibilities.
    #[must_use]
    pub fn counts(&self) -> SumCounts {
        let weight = self.held.iter().map(|held| held.weight).sum();
        let power = self.held.iter().map(|held| held.value_k_sr.norm_sqr() * held.weight).sum();
        SumCounts { visibilities: self.held.len() as u64, weight, power }
    }

    /// Sorts the visibilities, plans their rows, and sums them on the nearest circle.
    ///
    /// # Errors
    /// A setup that an engine does not take; no data.
    pub fn into_sums(self) -> Result<RefinedSums, AccumulationError> {
        let Self { setup, mut held, .. } = self;
        held.par_sort_unstable_by(|a, b| {
            order(a).partial_cmp(&order(b)).unwrap_or(std::cmp::Ordering::Equal)
        });
        let noise = noises(&setup, &held);
        let at: Vec<PairAt> = held.iter().map(|held| held.at).collect();
        let data = RefinedData {
            value_k_sr: held.iter().map(|held| held.value_k_sr).collect(),
            weight: held.iter().map(|held| held.weight).collect(),
            noise,
        };
        let bands: Vec<u16> = held.iter().map(|held| held.band).collect();
        drop(held);
        let (orbit, departures) = nearest_circle(&setup, &at);
        let circle = circle_sums(&setup, orbit, &at, &bands, &data)?;
        let rows = GeneralRows::new(RowsSetup {
            l_max: setup.l_max,
            wavelength_m: SPEED_OF_LIGHT_M_S / setup.frequency_hz,
            moon_radius_m: setup.moon_radius_m,
            response: setup.response,
        });
        // Each visibility was checked when it came.
        let plan = rows.plan(&at).map_err(|error| AccumulationError::Rows(error.refusal))?;
        Ok(RefinedSums { circle, rows, plan, at, data, departures })
    }
}

/// What visibilities are sorted by: nothing in it depends on how they arrived.
fn order(held: &HeldVisibility) -> (u8, u8, f64, u16, f64, f64, f64) {
    let HeldVisibility { at, band, value_k_sr, weight } = held;
    (at.pair.i, at.pair.j, at.time_s, *band, value_k_sr.re, value_k_sr.im, *weight)
}

/// Noise of the companion, by visibility.
fn noises(setup: &RefinedSetup, held: &[HeldVisibility]) -> Vec<Complex64> {
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

/// A satellite's positions further apart in time than this say nothing of its plane, s: a quarter of a low orbit.
const SAME_PASS_S: f64 = 1500.0;

/// Mean inclination of the orbits' planes, from where satellites move between visibilities; `None` if each stands alone. The
/// planes of pairs lie across them if satellites do not follow each other.
fn orbit_inclination_rad(at: &[PairAt]) -> Option<f64> {
    let (mut sum, mut count) = (0.0, 0.0);
    for (before, after) in at.iter().zip(at.iter().skip(1)) {
        let apart_s = after.time_s - before.time_s;
        if before.pair == after.pair && apart_s > 0.0 && apart_s < SAME_PASS_S {
            let normal = cross(before.r_i_m, after.r_i_m);
            sum += normal[0].hypot(normal[1]).atan2(normal[2]);
            count += 1.0;
        }
    }
    (count > 0.0).then(|| sum / count)
}

/// The circle of the mean radius and inclination of all.
fn nearest_circle(setup: &RefinedSetup, at: &[PairAt]) -> (NominalOrbit, Departures) {
    use std::f64::consts::PI;
    let found: Vec<PairOrientation> =
        at.iter().filter_map(|at| PairOrientation::of(at.r_i_m, at.r_j_m).ok()).collect();
    // A satellite j that leads turns the pair's plane upside down.
    let prograde = |pair: &PairOrientation| pair.inclination_rad.min(PI - pair.inclination_rad);
    let mean =
        |of: &dyn Fn(&PairOrientation) -> f64| found.iter().map(of).sum::<f64>() / found.len().max(1) as f64;
    let orbit_rad = orbit_inclination_rad(at).unwrap_or_else(|| mean(&prograde));
    let inclination_deg = (orbit_rad.to_degrees() / INCLINATION_STEP_DEG).round() * INCLINATION_STEP_DEG;
    let radius_m = (mean(&|pair| pair.radius_m) / RADIUS_STEP_M).round() * RADIUS_STEP_M;
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
const BLOCK: usize = 65_536;

/// The sums of all visibilities on the circle.
fn circle_sums(
    setup: &RefinedSetup,
    orbit: NominalOrbit,
    at: &[PairAt],
    bands: &[u16],
    data: &RefinedData,
) -> Result<HarmonicSums, AccumulationError> {
    let mut engine = HarmonicEngine::new(HarmonicSetup {
        l_max: setup.l_max,
        frequency_hz: setup.frequency_hz,
        baseline_m_max: setup.baseline_m_max,
        moon_radius_m: setup.moon_radius_m,
        response: setup.response,
        orbit,
        companion_seed: setup.companion_seed,
        weight_max: setup.weight_max,
    })?;
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
    pub at: Vec<PairAt>,
    /// Data in that order.
    pub data: RefinedData,
    /// How far they are from the circle.
    pub departures: Departures,
}
