//! What the accumulation of a channel hands to its solution.

use std::sync::Arc;

use crate::frames::Instrument;
use crate::imaging::method::MapEquations;
use crate::units::ChannelId;

/// A copy of the sums of one channel, to be solved while more data arrives.
pub struct Snapshot {
    /// Instrument.
    pub instrument: Arc<Instrument>,
    /// Channel.
    pub channel: ChannelId,
    /// Number of the snapshot in its channel, from 1.
    pub number: u32,
    /// Whether it holds all data.
    pub is_final: bool,
    /// Mission times of its first and last data, s.
    pub span_s: [f64; 2],
    /// nside of its map.
    pub nside: usize,
    /// Its normal equations, or its visibilities.
    pub data: Box<dyn MapEquations>,
}
