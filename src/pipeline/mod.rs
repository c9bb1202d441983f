//! From a configuration to a running graph: parse, validate, build, run.
//!
//! The only place where space and ground meet, and where concrete stages are wired.

mod bench;
mod config;
mod cost;
mod engine_cost;
mod error;
mod ground;
mod models;
mod notes;
mod plan;
mod run;
mod sample_summary;
mod sampling;
mod space;
pub mod state;
mod summary;

pub use bench::{
    BENCH_STAGES, Bench, BenchSettings, ChainRun, GrowthRow, Machine, QueueDepths, Rate, bench, bench_config,
};
pub use config::{Config, ConfigError, ConfigSource, Problems, QUICKLOOK};
pub use cost::{ChannelCost, Cost};
pub use error::PipelineError;
pub use ground::{Receiving, WAIT_BYTES};
pub use plan::{Expected, Plan};
pub use run::{
    Destination, GroundSource, READ, Watched, Watcher, downlink_file, replay, run, simulate, use_threads,
};
pub use sample_summary::{BlockSummary, SampleSummary};
pub use sampling::{SampleCounts, sample_stages};
pub use space::INTEGRATE;
pub use summary::{Segment, Summary};
