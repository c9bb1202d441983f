//! Checkpoints of the harmonic engine: versioned, bounded, with a checksum over everything.
//!
//! Layout: magic, length of the head (u32 LE), head (bincode), a byte for every node (1 if it holds something), the
//! sums of those nodes (raw little-endian f32), the waiting visibilities (f64); CRC-32C of all that (u32 LE).

use std::io::{Read, Write};

use super::spread::Pending;
use super::tori::Node;
use super::{BATCH, HarmonicEngine, HarmonicSetup};
use crate::accumulation::checked::{Checked, RESPONSES, Summed, number_of, refused};
use crate::accumulation::{AccumulationError, SumCounts};
use crate::array::harmonic::{GeometryLimits, NominalOrbit};

const MAGIC: &[u8; 8] = b"LNRHRM01";

/// Numbers that a waiting visibility takes.
const PENDING_NUMBERS: usize = 8;

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
    counts: SumCounts,
    pending: u32,
}

pub(super) fn write(engine: &HarmonicEngine, out: &mut dyn Write) -> Result<(), AccumulationError> {
    let mut out = Summed::new(out);
    let HarmonicSetup { l_max, frequency_hz, baseline_m_max, moon_radius_m, response, orbit, companion_seed } =
        engine.sums.setup;
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
        counts: engine.sums.counts,
        pending: engine.pending.len() as u32,
    })?;
    let nodes = &engine.sums.tori.nodes;
    let held: Vec<u8> = nodes.iter().map(|node| u8::from(node.is_some())).collect();
    out.write(&held)?;
    for node in nodes.iter().flatten() {
        out.singles(&node.weights)?;
        out.singles(&node.sides)?;
    }
    for p in &engine.pending {
        let [a, b, c, d] = p.sides;
        out.numbers(&[p.alpha_rad, p.gamma_rad, p.u, p.weight, a, b, c, d])?;
    }
    out.finish()?;
    Ok(())
}

pub(super) fn read(from: &mut dyn Read) -> Result<HarmonicEngine, AccumulationError> {
    let mut from = Checked::new(from);
    let mut magic = [0; 8];
    from.read(&mut magic)?;
    if &magic != MAGIC {
        return Err(refused(format!("{magic:02x?}"), "a harmonic engine's checkpoint, version 01"));
    }
    let head: Head = from.head()?;
    let mut engine = HarmonicEngine::new(setup_of(&head)?)?;
    if head.pending as usize > BATCH {
        return Err(refused(format!("{} waiting visibilities", head.pending), "at most 16384"));
    }
    engine.sums.counts = head.counts;
    let mut held = vec![0; engine.sums.tori.nodes.len()];
    from.read(&mut held)?;
    for (node, held) in engine.sums.tori.nodes.iter_mut().zip(held) {
        if held > 1 {
            return Err(refused(format!("{held} for a node"), "0 or 1"));
        }
        if held == 1 {
            // Memory follows the data that is there: a forged head ends at the first node that is not.
            let mut read = Node::zeros(&engine.sums.grids);
            from.singles(&mut read.weights)?;
            from.singles(&mut read.sides)?;
            *node = Some(read);
        }
    }
    let grids = &engine.sums.grids;
    for _ in 0..head.pending {
        let mut numbers = [0.0; PENDING_NUMBERS];
        from.numbers(&mut numbers)?;
        let [alpha_rad, gamma_rad, u, weight, sides @ ..] = numbers;
        let in_range =
            (0.0..=engine.sums.setup.baseline_m_max / engine.sums.setup.wavelength_m()).contains(&u);
        if !in_range || numbers.iter().any(|x| !x.is_finite()) || grids.nodes.count == 0 {
            return Err(refused(format!("a baseline of {u} wavelengths"), "one within the engine's limit"));
        }
        engine.pending.push(Pending { alpha_rad, gamma_rad, u, weight, sides });
    }
    from.finish()?;
    Ok(engine)
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
    })
}
