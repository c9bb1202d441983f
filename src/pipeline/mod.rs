//! From a configuration to a running graph: parse, validate, build, run.
//!
//! The only place where space and ground meet, and where concrete stages are connected. Uses every folder before it.

mod calibrate;
mod calibrate_products;
mod channel_lists;
pub(crate) mod config;
mod config_reader;
mod config_source;
mod cost;
mod downlink_settings;
pub(crate) mod error;
mod file_problems;
mod found_solutions;
mod ground_segment;
mod groups;
mod live_gains;
mod memory;
pub(crate) mod models;
mod noise_maps;
mod notes;
pub(crate) mod plan;
mod problems;
mod quantities;
mod rates;
mod realisations;
mod reference;
mod run;
mod sample_summary;
pub(crate) mod sampling;
mod simulation_groups;
pub(crate) mod space_segment;
mod state;
mod study;
mod study_file;
mod summary;

pub use calibrate::{CalibrateJob, CalibrateProgress, CalibrateWatcher, calibrate, with_gains};
pub use config::Config;
pub use config_reader::ReadProblem;
pub use config_source::{ConfigError, ConfigSource, QUICKLOOK};
pub use cost::{ChannelCost, Cost, RankCost, Segment};
pub use error::PipelineError;
pub use found_solutions::{CalibrateRound, CalibrateSummary};
pub use groups::{
    GroupSize, GroupStep, GroupStepWatcher, GroupWatcher, MapGroup, MapStep, MemoryAdvice, RunGroups,
    channel_groups, replay_in_groups, run_in_groups,
};
pub use memory::{MemoryLimit, MemorySource};
pub use plan::{Expected, Plan};
pub use problems::{Problem, Problems};
pub use realisations::{PowerSpread, RealisationSpread};
pub use reference::{KeyDescription, REFERENCE, key_descriptions};
pub use run::{
    Destination, GroundSource, READ, Watched, Watcher, downlink_file, replay, run, run_among, simulate,
    use_threads,
};
pub use sample_summary::{BlockSummary, SampleCounts, SampleSummary};
pub use sampling::sample_stages;
pub use simulation_groups::{MERGE, simulate_in_groups};
pub use space_segment::{INTEGRATE, sky_notes};
pub use state::{sample_state, solve_state};
pub use study::{CaseSummary, StudyStep, StudySummary, StudyWatcher, run_study};
pub use study_file::{Study, StudyCase, StudyError};
pub use summary::{RunScope, RunSummary};
