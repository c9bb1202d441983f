//! From a configuration to a running graph: parse, validate, build, run.
//!
//! The only place where space and ground meet, and where concrete stages are wired.

pub(crate) mod config;
mod cost;
mod engine_cost;
pub(crate) mod error;
mod ground_segment;
pub(crate) mod models;
mod notes;
pub(crate) mod plan;
mod run;
mod sample_summary;
pub(crate) mod sampling;
pub(crate) mod space_segment;
mod summary;

pub use config::{Config, ConfigError, ConfigSource, Problems, QUICKLOOK};
pub use cost::{ChannelCost, Cost};
pub use error::PipelineError;
pub use plan::{Expected, Plan};
pub use run::{
    Destination, GroundSource, READ, Watched, Watcher, downlink_file, replay, run, simulate, use_threads,
};
pub use sample_summary::{BlockSummary, SampleSummary};
pub use sampling::{SampleCounts, sample_stages};
pub use space_segment::INTEGRATE;
pub use summary::{Segment, Summary};
