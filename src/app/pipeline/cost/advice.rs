//! Warning for a ground segment whose normal equations will outgrow memory.

use std::fmt;

use super::estimate::memory_bytes;
use super::groups::{complete_costs, memory_solutions};
use crate::frames::Instrument;
use crate::imaging::MapConfig;
use crate::imaging::cost::EngineCost;
use crate::pipeline::config::{Config, MemoryLimit};
use crate::units::bytes_text;

/// Warning that the normal equations of all channels will outgrow memory.
#[derive(Clone, Debug, PartialEq)]
pub struct MemoryAdvice {
    /// Number of mapped channels.
    pub channels: usize,
    /// nside of the maps.
    pub nside: usize,
    /// Estimated memory of the complete sums of all channels, bytes.
    pub needed_bytes: f64,
    /// Available memory.
    pub limit: MemoryLimit,
    /// A smaller nside whose sums fit, and their memory, bytes.
    pub fitting: Option<(usize, f64)>,
}

impl MemoryAdvice {
    /// Advice for a ground segment with these settings; `None` if the complete sums fit.
    #[must_use]
    pub fn new(config: &Config, instrument: &Instrument, limit: MemoryLimit) -> Option<Self> {
        let draws = config.calibration.known_error_draws();
        let needed = |map: &MapConfig| {
            let costs: Vec<EngineCost> = complete_costs(instrument, map, draws).into_values().collect();
            (costs.len(), memory_bytes(0.0, &costs, memory_solutions(map)))
        };
        let (channels, needed_bytes) = needed(&config.map);
        if needed_bytes <= limit.bytes as f64 {
            return None;
        }
        let smaller_nsides = std::iter::successors(Some(config.map.nside / 2), |nside| Some(nside / 2));
        let fitting = smaller_nsides.take_while(|nside| *nside > 0).find_map(|nside| {
            let map = MapConfig { nside, l_max: 0, ..config.map.clone() };
            Some((nside, needed(&map).1)).filter(|(_, bytes)| *bytes <= limit.bytes as f64)
        });
        Some(Self { channels, nside: config.map.nside, needed_bytes, limit, fitting })
    }
}

impl fmt::Display for MemoryAdvice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the sums of {} channels at map.nside = {} grow to an estimated {} over a mission, and {} are available ({})",
            self.channels,
            self.nside,
            bytes_text(self.needed_bytes),
            bytes_text(self.limit.bytes as f64),
            self.limit.source
        )?;
        if let Some((nside, bytes)) = self.fitting {
            write!(f, "; at map.nside = {nside} they take {}", bytes_text(bytes))?;
        }
        write!(
            f,
            "; map fewer with --channels, or from files with replay --groups auto, which takes as many at a time as fit"
        )
    }
}
