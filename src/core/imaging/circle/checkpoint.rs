//! The setup and the sums of the harmonic engine in checkpoints.
//!
//! Sums are a byte for every node (1 if it has data), then all rows of weights and right-hand sides of those nodes. A row is its bound (u64)
//! and its sums: i32 for bounds below 2^31, else i64; only the bound 0 for an empty row.

use super::HarmonicSetup;
use super::exact::ExactTori;
use super::grid::ALPHAS;
use super::grid::Grids;
use super::quanta::ExactNode;
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

impl ExactTori {
    pub(super) fn write(&self, grids: &Grids, out: &mut FrameWriter<'_>) -> Result<(), AccumulationError> {
        let has_data = |node: &Option<ExactNode>| node.as_ref().is_some_and(|node| !node.is_empty());
        let held: Vec<u8> = self.nodes.iter().map(|node| u8::from(has_data(node))).collect();
        out.write(&held)?;
        for node in self.nodes.iter().flatten().filter(|node| !node.is_empty()) {
            node.weights
                .iter()
                .try_for_each(|row| row.write(grids.weight_row(), |bytes| out.write(bytes)))?;
            node.right.iter().try_for_each(|row| row.write(grids.data_row(), |bytes| out.write(bytes)))?;
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
        for (node, held) in tori.nodes.iter_mut().zip(held) {
            if held > 1 {
                return Err(refused(format!("{held} for a node"), "0 or 1"));
            }
            if held == 1 {
                // Memory is allocated row by row, so that a forged head takes none.
                let mut read = ExactNode::zeros(grids);
                let rows = [(&mut read.weights, grids.weight_row()), (&mut read.right, grids.data_row())];
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
        Ok(tori)
    }
}
