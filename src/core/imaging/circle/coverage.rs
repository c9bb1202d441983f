//! Survey of a downlink: how much of its data the harmonic engine covers.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;

use serde::Serialize;

use super::nominal_orbit;
use crate::array::Ephemeris;
use crate::frames::{GroundFrame, Instrument, VisibilityBlock};
use crate::response::harmonic::{GeometryLimits, GeometryRefusal, NominalOrbit, PairOrientation};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Maximum number of visibilities that wait for their positions, some 250 MB as for a replay.
const WAITING_MAX: usize = 1 << 23;

/// The common circular orbit, and the numbers of visibilities on and off it.
#[derive(Clone, Debug, Default, Serialize)]
pub struct GeometryCoverage {
    /// Inclination of the common circle, degrees.
    pub inclination_deg: Option<f64>,
    /// Radius of the common circle, m.
    pub radius_m: Option<f64>,
    /// Visibilities within the limits.
    pub covered: u64,
    /// Visibilities that are refused, by reason.
    pub refused: BTreeMap<String, u64>,
    /// Good visibilities without an ephemeris.
    pub without_ephemeris: u64,
}

/// A survey of received frames.
#[derive(Debug, Default)]
pub struct GeometrySurvey {
    instrument: Option<Instrument>,
    ephemeris: Ephemeris,
    orbit: Option<NominalOrbit>,
    coverage: GeometryCoverage,
    refused: BTreeMap<GeometryRefusal, u64>,
    limits: GeometryLimits,
    /// Blocks whose positions have not come yet, and the number of their visibilities.
    waiting: VecDeque<VisibilityBlock>,
    waiting_visibilities: usize,
}

impl GeometrySurvey {
    /// Creates a survey with these limits.
    #[must_use]
    pub fn new(limits: GeometryLimits) -> Self {
        Self { limits, ..Self::default() }
    }

    /// Adds a frame to the survey.
    pub fn add(&mut self, frame: &GroundFrame) {
        match frame {
            GroundFrame::Instrument(instrument) => {
                self.instrument.get_or_insert_with(|| instrument.clone());
            }
            GroundFrame::Ephemeris(segment) => {
                // An invalid segment shows up as visibilities without ephemeris.
                self.ephemeris.insert(segment.clone());
            }
            // An auto-correlation has no baseline.
            GroundFrame::Visibilities(block) if block.pair.i == block.pair.j => {}
            GroundFrame::Visibilities(block) => {
                if self.ephemeris.count(block).0.without_ephemeris == 0 {
                    self.add_block(block);
                    return;
                }
                self.waiting_visibilities += block.len();
                self.waiting.push_back(block.clone());
                while self.waiting_visibilities > WAITING_MAX {
                    self.add_waiting();
                }
            }
            GroundFrame::Housekeeping(_) => {}
        }
    }

    /// Adds the block that has waited longest, with the positions known by now.
    fn add_waiting(&mut self) {
        if let Some(block) = self.waiting.pop_front() {
            self.waiting_visibilities -= block.len();
            self.add_block(&block);
        }
    }

    fn add_block(&mut self, block: &VisibilityBlock) {
        let channel = usize::from(block.channel.0);
        let Some(channel) = self.instrument.as_ref().and_then(|i| i.channels.get(channel)) else {
            return;
        };
        let wavelength_m = SPEED_OF_LIGHT_M_S / channel.frequency_hz;
        let (placed, counts) = self.ephemeris.place(block, channel.frequency_hz);
        self.coverage.without_ephemeris += counts.without_ephemeris;
        if self.orbit.is_none() {
            self.orbit = nominal_orbit(&placed, self.limits);
        }
        for (&r_i_m, &r_j_m) in placed.r_i_m.iter().zip(&placed.r_j_m) {
            let orbit = self.orbit.ok_or(GeometryRefusal::Degenerate);
            let pair = orbit.and_then(|o| o.pair(&PairOrientation::of_pair(r_i_m, r_j_m)?, wavelength_m));
            match pair {
                Ok(_) => self.coverage.covered += 1,
                Err(reason) => *self.refused.entry(reason).or_default() += 1,
            }
        }
    }

    /// The coverage found.
    #[must_use]
    pub fn finish(mut self) -> GeometryCoverage {
        while !self.waiting.is_empty() {
            self.add_waiting();
        }
        GeometryCoverage {
            inclination_deg: self.orbit.map(|orbit| orbit.inclination_rad.to_degrees()),
            radius_m: self.orbit.map(|orbit| orbit.radius_m),
            refused: self.refused.into_iter().map(|(reason, count)| (reason.to_string(), count)).collect(),
            ..self.coverage
        }
    }
}

impl fmt::Display for GeometryCoverage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Geometry, for the harmonic engine")?;
        if let (Some(inclination_deg), Some(radius_m)) = (self.inclination_deg, self.radius_m) {
            write!(f, "\ncircle of {:.1} km, inclined by {inclination_deg:.2} deg", radius_m / 1e3)?;
        }
        write!(f, "\ncovered                            {:>12}", self.covered)?;
        for (reason, count) in &self.refused {
            write!(f, "\nrefused: {reason:<25} {count:>12}")?;
        }
        write!(f, "\nwithout ephemeris                  {:>12}", self.without_ephemeris)
    }
}
