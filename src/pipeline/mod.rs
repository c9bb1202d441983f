//! From a configuration to a running graph: parse, validate, build, run.
//!
//! The only place where space and ground meet, and where concrete stages are wired.

mod config;
mod cost;
mod engine_cost;
mod error;
mod ground;
mod models;
mod plan;
mod run;
mod space;
pub mod state;
mod summary;

pub use config::{Config, ConfigError, ConfigSource, Problems, QUICKLOOK};
pub use cost::{ChannelCost, Cost};
pub use error::PipelineError;
pub use plan::{Expected, Plan};
pub use run::{Watched, Watcher, downlink_file, replay, run, simulate, use_threads};
pub use space::INTEGRATE;
pub use summary::{Segment, Summary};
