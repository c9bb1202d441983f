//! The setup of a harmonic engine, and its memory.

use super::grid::ALPHAS;
use super::grid::Grids;
use super::operator::Operator;
use crate::frames::{AntennaResponse, PlacedVisibilities};
use crate::imaging::AccumulationError;
use crate::imaging::config::L_MAX;
use crate::response::harmonic::{
    GeometryLimits, NominalOrbit, PairOrientation, PatternGeometry, degree_count,
};
use crate::units::constants::SPEED_OF_LIGHT_M_S;

/// Setup of a harmonic engine; only engines of equal setup can be merged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HarmonicSetup {
    /// Maximum degree of the map.
    pub l_max: usize,
    /// Frequency, Hz.
    pub frequency_hz: f64,
    /// Longest baseline that is accepted, m.
    pub baseline_m_max: f64,
    /// Radius of the body that hides the sky, m.
    pub moon_radius_m: f64,
    /// Antenna response.
    pub response: AntennaResponse,
    /// The common circular orbit.
    pub orbit: NominalOrbit,
    /// Seed of the noise-only companion map.
    pub companion_seed: u64,
    /// Maximum weight that is accepted, (K sr)^-2; it sets the resolution of the sums.
    pub weight_max: f64,
}

/// Maximum baseline that is accepted, wavelengths.
const U_MAX: f64 = 10_000.0;

/// Step of nominal inclinations, which are rounded so that they do not depend on which data arrive first.
pub(in crate::imaging) const INCLINATION_STEP_DEG: f64 = 0.05;
/// Step of nominal radii.
pub(in crate::imaging) const RADIUS_STEP_M: f64 = 100.0;

/// The nominal orbit from the first pair with a defined orientation; `None` if there is none.
#[must_use]
pub fn nominal_orbit(placed: &PlacedVisibilities, limits: GeometryLimits) -> Option<NominalOrbit> {
    let mut pairs = placed.r_i_m.iter().zip(&placed.r_j_m);
    let found = pairs.find_map(|(&r_i_m, &r_j_m)| PairOrientation::of_pair(r_i_m, r_j_m).ok())?;
    let inclination_deg =
        (found.prograde_inclination_rad().to_degrees() / INCLINATION_STEP_DEG).round() * INCLINATION_STEP_DEG;
    Some(NominalOrbit {
        inclination_rad: inclination_deg.to_radians(),
        radius_m: (found.radius_m / RADIUS_STEP_M).round() * RADIUS_STEP_M,
        limits,
    })
}

impl HarmonicSetup {
    /// Wavelength, m.
    #[must_use]
    pub fn wavelength_m(&self) -> f64 {
        SPEED_OF_LIGHT_M_S / self.frequency_hz
    }

    pub(super) fn check(&self) -> Result<(), AccumulationError> {
        let orbit = &self.orbit;
        let u_max = self.baseline_m_max / self.wavelength_m();
        for (name, value, is_valid, expected) in [
            ("l_max", self.l_max as f64, (1..=L_MAX).contains(&self.l_max), "1 to 1024"),
            ("frequency_hz", self.frequency_hz, self.frequency_hz > 0.0, "a positive number"),
            ("moon_radius_m", self.moon_radius_m, self.moon_radius_m > 0.0, "a positive number"),
            ("orbit radius_m", orbit.radius_m, orbit.radius_m > self.moon_radius_m, "more than the Moon's"),
            (
                "inclination_rad",
                orbit.inclination_rad,
                (0.0..=std::f64::consts::PI).contains(&orbit.inclination_rad),
                "0 to pi",
            ),
            (
                "baseline_m_max",
                self.baseline_m_max,
                self.baseline_m_max > 0.0 && self.baseline_m_max < orbit.radius_m && u_max <= U_MAX,
                "above 0, at most 1e4 wavelengths and less than the orbit's radius",
            ),
        ] {
            if !(is_valid && value.is_finite()) {
                return Err(AccumulationError::Setup { name, value, expected });
            }
        }
        Ok(())
    }

    pub(super) fn grids(&self) -> Grids {
        Grids::new(self.l_max, self.baseline_m_max / self.wavelength_m())
    }

    pub(super) fn operator(&self, grids: &Grids) -> Operator {
        let geometry = PatternGeometry {
            orbit_radius_m: self.orbit.radius_m,
            moon_radius_m: self.moon_radius_m,
            wavelength_m: self.wavelength_m(),
            response: self.response,
        };
        Operator::new(self.l_max, grids.clone(), geometry, self.orbit.inclination_rad, 0.0)
    }
}

/// The memory of an engine and its solution, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HarmonicMemory {
    /// The sums themselves, if baselines of all lengths occur.
    pub sums: u64,
    /// Patterns and rotations, shared by an engine and its snapshots.
    pub tables: u64,
    /// Workspaces of the threads during a solution, and the results of all blocks of alphas.
    pub workspace: u64,
}

/// The memory of an engine for maps up to `l_max` from baselines up to `u_max` wavelengths, when `threads` threads solve for `at_once` maps
/// together.
#[must_use]
pub fn memory(l_max: usize, u_max: f64, threads: usize, at_once: usize) -> HarmonicMemory {
    let grids = Grids::new(l_max, u_max);
    let SharedSize { blocks, product_bytes } = shared_size(l_max);
    HarmonicMemory {
        sums: grids.nodes.count as u64 * grids.node_bytes(),
        tables: Operator::table_bytes(l_max, &grids),
        workspace: threads as u64 * Operator::workspace_bytes(l_max, &grids, at_once)
            + (blocks * at_once) as u64 * product_bytes,
    }
}

/// Memory of the sums of a pair of draws of the errors by gains, in units of all other sums.
pub(super) fn error_pair_share(l_max: usize, u_max: f64) -> f64 {
    let grids = Grids::new(l_max, u_max);
    grids.right_len() as f64 / (grids.weights_len() + grids.right_len()) as f64
}

/// The amounts that ranks divide and exchange.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SharedSize {
    /// Number of blocks of alphas, which are divided among ranks.
    pub blocks: usize,
    /// Bytes that each rank sends and receives for one product with BtN^-1B.
    pub product_bytes: u64,
}

/// The amounts that ranks divide and exchange for maps up to `l_max`.
#[must_use]
pub fn shared_size(l_max: usize) -> SharedSize {
    SharedSize {
        blocks: Grids::new(l_max, 1.0).points.div_ceil(ALPHAS),
        // Real and imaginary parts of (l_max + 1) (l_max + 2) / 2 coefficients, in 64 bits each.
        product_bytes: 8 * ((l_max + 1) * (l_max + 2)) as u64,
    }
}

/// The size of one product with BtN^-1B if all nodes and phases have data.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ApplicationSize {
    /// Number of points of a line of phases.
    pub points: usize,
    /// Number of lines: alphas times nodes.
    pub lines: usize,
    /// Multiply-adds of its matrix products.
    pub matrix_multiply_adds: f64,
}

/// The size of a product for maps up to `l_max` from baselines up to `u_max` wavelengths.
#[must_use]
pub fn application_size(l_max: usize, u_max: f64) -> ApplicationSize {
    let grids = Grids::new(l_max, u_max);
    let (points, nodes) = (grids.points, grids.nodes.count);
    let patterns: usize = (0..=l_max).map(|mu| degree_count(l_max, mu)).sum();
    // Forward and back, real and imaginary parts, both signs of mu.
    let matrix_multiply_adds = (2 * 2 * 2 * points * nodes * patterns) as f64;
    ApplicationSize { points, lines: points * nodes, matrix_multiply_adds }
}
