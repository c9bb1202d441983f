//! Checkpoints of the harmonic engine: versioned, bounded, with a checksum over everything.
//!
//! Layout: magic, length of the head (u32 LE), head (bincode), a byte for every node (1 if it holds something); of
//! those nodes every row of weights and of sides: its bound (u64 LE, 0 for an empty row, of which nothing follows) and
//! its sums, i32 LE for bounds below 2^31, else i64; CRC-32C of all that (u32 LE). Nothing in it depends on how the
//! data came.

use std::io::{Read, Write};

use super::exact::{ExactNode, Row};
use super::grid::{Grids, NODES};
use super::{HarmonicEngine, HarmonicSetup};
use crate::accumulation::AccumulationError;
use crate::accumulation::checked::{Checked, RESPONSES, Summed, number_of, refused};
use crate::accumulation::scale::Totals;
use crate::response::harmonic::{GeometryLimits, NominalOrbit};

const MAGIC: &[u8; 8] = b"LNRHRM03";

const VERSION: &str = "a harmonic engine's checkpoint, version 03; those before rounded otherwise or were not exact: sum the data anew";

#[derive(bincode::Encode, bincode::Decode)]
struct Head {
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
    totals: Totals,
}

pub(super) fn write(engine: &HarmonicEngine, out: &mut dyn Write) -> Result<(), AccumulationError> {
    let mut out = Summed::new(out);
    let HarmonicSetup {
        l_max,
        frequency_hz,
        baseline_m_max,
        moon_radius_m,
        response,
        orbit,
        companion_seed,
        weight_max,
    } = engine.setup;
    let limits = orbit.limits;
    out.write(MAGIC)?;
    out.head(Head {
        l_max: l_max as u32,
        frequency_hz,
        baseline_m_max,
        moon_radius_m,
        response: number_of(&RESPONSES, &response),
        inclination_rad: orbit.inclination_rad,
        orbit_radius_m: orbit.radius_m,
        limits: [
            limits.out_of_track_deg_max,
            limits.inclination_deg_max,
            limits.altitude_m_max,
            limits.radial_deg_max,
        ],
        companion_seed,
        weight_max,
        totals: engine.totals,
    })?;
    let filled = |node: &Option<ExactNode>| node.as_ref().is_some_and(|node| !node.is_empty());
    let nodes = &engine.tori.nodes;
    let held: Vec<u8> = nodes.iter().map(|node| u8::from(filled(node))).collect();
    out.write(&held)?;
    let [weights, sides] = layouts(&engine.grids);
    for node in nodes.iter().flatten().filter(|node| !node.is_empty()) {
        node.weights.iter().try_for_each(|row| row.write(weights, |bytes| out.write(bytes)))?;
        node.sides.iter().try_for_each(|row| row.write(sides, |bytes| out.write(bytes)))?;
    }
    out.finish()?;
    Ok(())
}

pub(super) fn read(from: &mut dyn Read) -> Result<HarmonicEngine, AccumulationError> {
    let mut from = Checked::new(from);
    let mut magic = [0; 8];
    from.read(&mut magic)?;
    if &magic != MAGIC {
        return Err(refused(format!("{magic:02x?}"), VERSION));
    }
    let head: Head = from.head()?;
    let mut engine = HarmonicEngine::new(setup_of(&head)?)?;
    engine.totals = head.totals;
    let mut held = vec![0; engine.tori.nodes.len()];
    from.read(&mut held)?;
    let [weights, sides] = layouts(&engine.grids);
    for (node, held) in engine.tori.nodes.iter_mut().zip(held) {
        if held > 1 {
            return Err(refused(format!("{held} for a node"), "0 or 1"));
        }
        if held == 1 {
            // Memory follows the data that is there: a forged head ends at the first row that is not.
            let mut read = ExactNode::zeros(&engine.grids);
            for row in &mut read.weights {
                *row = Row::read(weights, |bytes| from.read(bytes))?;
            }
            for row in &mut read.sides {
                *row = Row::read(sides, |bytes| from.read(bytes))?;
            }
            *node = Some(read);
        }
    }
    from.finish()?;
    Ok(engine)
}

/// Length and number of the parts of a row of weights and of one of sides.
fn layouts(grids: &Grids) -> [(usize, usize); 2] {
    [(grids.weight_stride(), NODES), (grids.data_stride(), 4)]
}

fn setup_of(head: &Head) -> Result<HarmonicSetup, AccumulationError> {
    let response = RESPONSES.get(usize::from(head.response)).copied();
    let [out_of_track_deg_max, inclination_deg_max, altitude_m_max, radial_deg_max] = head.limits;
    Ok(HarmonicSetup {
        l_max: head.l_max as usize,
        frequency_hz: head.frequency_hz,
        baseline_m_max: head.baseline_m_max,
        moon_radius_m: head.moon_radius_m,
        response: response.ok_or_else(|| refused(format!("response {}", head.response), "a known one"))?,
        orbit: NominalOrbit {
            inclination_rad: head.inclination_rad,
            radius_m: head.orbit_radius_m,
            limits: GeometryLimits {
                out_of_track_deg_max,
                inclination_deg_max,
                altitude_m_max,
                radial_deg_max,
            },
        },
        companion_seed: head.companion_seed,
        weight_max: head.weight_max,
    })
}
