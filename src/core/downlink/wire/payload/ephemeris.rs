//! Satellite positions.
//!
//! Record: `start_ticks` i64, `step_ticks` u32, `satellites` u8, `nodes` u32. Array: positions, f64 x 3, m, node by
//! node, `satellites` each.

use bincode::{Decode, Encode};

use super::arrays::{Arrays, put_vec3};
use super::{PayloadFault, put_record, require, require_length, require_time, take_record};
use crate::frames::{EphemerisSegment, Instrument};
use crate::units::MissionTime;

/// Minimum number of nodes of a segment, which one interpolation needs.
pub const NODES_MIN: usize = 8;
/// Maximum number of nodes of a segment: two months at one per minute. (With 64 satellites the payload limit is lower.)
const NODES_MAX: usize = 100_000;
/// Maximum coordinate, m: beyond any orbit about the Moon.
const COORDINATE_M_MAX: f64 = 1e9;

#[derive(Encode, Decode)]
struct EphemerisRecord {
    start_ticks: i64,
    step_ticks: u32,
    satellites: u8,
    nodes: u32,
}

pub(crate) fn encode(
    segment: &EphemerisSegment,
    instrument: &Instrument,
    out: &mut Vec<u8>,
) -> Result<(), PayloadFault> {
    check(segment, instrument)?;
    let record = EphemerisRecord {
        start_ticks: segment.start.0,
        step_ticks: segment.step_ticks,
        satellites: segment.satellites,
        nodes: segment.nodes() as u32,
    };
    put_record("ephemeris", record, out)?;
    put_vec3(&segment.positions_m, out);
    Ok(())
}

pub(crate) fn decode(bytes: &[u8], instrument: &Instrument) -> Result<EphemerisSegment, PayloadFault> {
    let (record, rest) = take_record::<EphemerisRecord>("ephemeris", bytes)?;
    let positions = (record.nodes as usize).saturating_mul(usize::from(record.satellites));
    require_length("ephemeris positions", positions.saturating_mul(24), rest.len())?;
    let segment = EphemerisSegment {
        start: MissionTime(record.start_ticks),
        step_ticks: record.step_ticks,
        satellites: record.satellites,
        positions_m: Arrays(rest).vec3(positions),
    };
    check(&segment, instrument)?;
    Ok(segment)
}

fn check(segment: &EphemerisSegment, instrument: &Instrument) -> Result<(), PayloadFault> {
    let satellites = usize::from(segment.satellites);
    let is_equal = segment.satellites == instrument.satellites;
    require(is_equal, "satellites of an ephemeris", satellites as f64, "as many as the instrument has")?;
    require(segment.step_ticks > 0, "step_ticks", f64::from(segment.step_ticks), "positive")?;
    let nodes = segment.nodes();
    require_length("ephemeris positions", nodes * satellites, segment.positions_m.len())?;
    require((NODES_MIN..=NODES_MAX).contains(&nodes), "nodes", nodes as f64, "8 to 100000")?;
    require_time(segment.start)?;
    require_time(segment.end())?;
    // A NaN is out of range too.
    let is_in_range = |x: &f64| x.abs() <= COORDINATE_M_MAX;
    match segment.positions_m.as_flattened().iter().find(|x| !is_in_range(x)) {
        None => Ok(()),
        Some(x) => require(false, "position (m)", *x, "at most 1e9 m from the Moon"),
    }
}
