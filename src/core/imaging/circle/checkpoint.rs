//! The setup and the sums of the harmonic engine in checkpoints.
//!
//! Sums are a byte for every node (if it has data, 1 and the number of pairs of draws of the errors by gains), then all rows of weights, of
//! right-hand sides and of those of the pairs of those nodes. The highest bit of the first byte says that the power of the errors (u128)
//! follows. A row is its bound (u64) and its sums: i32 for bounds below 2^31, else i64; only
//! the bound 0 for an empty row.

use super::HarmonicSetup;
use super::exact::ExactTori;
use super::grid::ALPHAS;
use super::grid::Grids;
use super::quanta::ExactNode;
use crate::frames::ERROR_DRAWS_MAX;
use crate::imaging::AccumulationError;
use crate::imaging::exact::checkpoint::{FrameReader, FrameWriter, RESPONSES, number_of, refused};
use crate::imaging::exact::fixed_point::rows::IntegerRow;
use crate::ranks::RankShare;
use crate::response::harmonic::{GeometryLimits, NominalOrbit};

/// The setup of a harmonic engine in a checkpoint.
#[derive(bincode::Encode, bincode::Decode)]
pub struct HarmonicHead {
    l_max: u32,
    frequency_hz: f64,
    baseline_m_max: f64,
    moon_radius_m: f64,
    response: u8,
    inclination_rad: f64,
    orbit_radius_m: f64,
    limits: [f64; 4],
    companion_seed: u64,
    weight_max: f64,
}

impl HarmonicHead {
    pub(super) fn new(setup: &HarmonicSetup) -> Self {
        let NominalOrbit { inclination_rad, radius_m, limits } = setup.orbit;
        Self {
            l_max: setup.l_max as u32,
            frequency_hz: setup.frequency_hz,
            baseline_m_max: setup.baseline_m_max,
            moon_radius_m: setup.moon_radius_m,
            response: number_of(&RESPONSES, &setup.response),
            inclination_rad,
            orbit_radius_m: radius_m,
            limits: [
                limits.out_of_track_deg_max,
                limits.inclination_deg_max,
                limits.altitude_m_max,
                limits.radial_deg_max,
            ],
            companion_seed: setup.companion_seed,
            weight_max: setup.weight_max,
        }
    }

    pub(super) fn setup(&self) -> Result<HarmonicSetup, AccumulationError> {
        let response = RESPONSES.get(usize::from(self.response)).copied();
        let [out_of_track_deg_max, inclination_deg_max, altitude_m_max, radial_deg_max] = self.limits;
        Ok(HarmonicSetup {
            l_max: self.l_max as usize,
            frequency_hz: self.frequency_hz,
            baseline_m_max: self.baseline_m_max,
            moon_radius_m: self.moon_radius_m,
            response: response
                .ok_or_else(|| refused(format!("response {}", self.response), "a known response"))?,
            orbit: NominalOrbit {
                inclination_rad: self.inclination_rad,
                radius_m: self.orbit_radius_m,
                limits: GeometryLimits {
                    out_of_track_deg_max,
                    inclination_deg_max,
                    altitude_m_max,
                    radial_deg_max,
                },
            },
            companion_seed: self.companion_seed,
            weight_max: self.weight_max,
        })
    }
}

/// The bit of the first node's byte by which the power of errors by gains is announced.
const POWER_FOLLOWS: u8 = 1 << 7;

impl ExactTori {
    pub(super) fn write(&self, grids: &Grids, out: &mut FrameWriter<'_>) -> Result<(), AccumulationError> {
        let has_data = |node: &Option<ExactNode>| node.as_ref().is_some_and(|node| !node.is_empty());
        let pairs = |node: &Option<ExactNode>| node.as_ref().map_or(0, ExactNode::error_pairs);
        let held = self.nodes.iter().map(|node| if has_data(node) { 1 + pairs(node) as u8 } else { 0 });
        let mut held: Vec<u8> = held.collect();
        if let Some(first) = held.first_mut().filter(|_| self.error_power > 0) {
            *first |= POWER_FOLLOWS;
        }
        out.write(&held)?;
        for node in self.nodes.iter().flatten().filter(|node| !node.is_empty()) {
            node.weights
                .iter()
                .try_for_each(|row| row.write(grids.weight_row(), |bytes| out.write(bytes)))?;
            let pairs = node.gain_errors[..node.error_pairs()].iter().flatten();
            node.right
                .iter()
                .chain(pairs)
                .try_for_each(|row| row.write(grids.data_row(), |bytes| out.write(bytes)))?;
        }
        if self.error_power > 0 {
            out.write(&self.error_power.to_le_bytes())?;
        }
        Ok(())
    }

    /// Reads the sums that a process with share `part` wrote, and keeps the rows of the share `kept`.
    pub(super) fn read(
        grids: &Grids,
        from: &mut FrameReader<'_>,
        part: RankShare,
        kept: RankShare,
    ) -> Result<Self, AccumulationError> {
        let mut tori = Self::zeros(grids);
        let mut held = vec![0; tori.nodes.len()];
        from.read(&mut held)?;
        let power_follows = held.first().is_some_and(|first| first & POWER_FOLLOWS > 0);
        if let Some(first) = held.first_mut() {
            *first &= !POWER_FOLLOWS;
        }
        for (node, held) in tori.nodes.iter_mut().zip(held) {
            let pairs = usize::from(held).saturating_sub(1);
            if pairs > ERROR_DRAWS_MAX / 2 {
                return Err(refused(format!("{held} for a node"), "0 to 33"));
            }
            if held > 0 {
                // Memory is allocated row by row, so that a forged head takes none.
                let mut read = ExactNode::zeros(grids);
                read.gain_errors = vec![vec![IntegerRow::default(); grids.data_points()]; pairs];
                let right = std::iter::once(&mut read.right).chain(&mut read.gain_errors);
                let rows = std::iter::once((&mut read.weights, grids.weight_row()))
                    .chain(right.map(|rows| (rows, grids.data_row())));
                for (rows, layout) in rows {
                    for (alpha, kept_row) in rows.iter_mut().enumerate() {
                        let row = IntegerRow::read(layout, |bytes| from.read(bytes))?;
                        let block = alpha / ALPHAS;
                        if !row.is_empty() && !part.holds(block) {
                            let found = format!("sums of block {block} of alphas");
                            return Err(refused(found, "those of the rank's own blocks"));
                        }
                        if kept.holds(block) {
                            *kept_row = row;
                        }
                    }
                }
                *node = (!read.is_empty()).then_some(read);
            }
        }
        if power_follows {
            let mut power = [0; 16];
            from.read(&mut power)?;
            tori.error_power = u128::from_le_bytes(power);
        }
        Ok(tori)
    }
}
