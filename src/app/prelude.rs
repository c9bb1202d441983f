//! What most programs use: `use lunarray::prelude::*;`.

pub use crate::array::{Array, ArrayConfig, Ephemeris};
pub use crate::calibration::{Calibration, CalibrationError, CalibrationReport};
pub use crate::downlink::{Contents, DownlinkReader};
pub use crate::frames::{
    AntennaResponse, EphemerisSegment, GroundFrame, Instrument, PlacedVisibilities, VisibilityBlock,
};
pub use crate::imaging::{NormalEngine, NormalSums, PixelEngine, PixelSetup, solve_pixels};
pub use crate::pipeline::{Mission, Plan, RunSummary};
pub use crate::runtime::{Cancel, Flow, Graph, Outlet, Sink, Source, Stage, Units};
pub use crate::sky::{Frame, SkyMap, compare};
pub use crate::units::{ChannelId, MissionTime, Pair};
