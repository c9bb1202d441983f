//! From a configuration to a running graph: parse, validate, build, run.
//!
//! The only place where space and ground meet, and where concrete stages are connected. Uses every folder before it.

mod bound;
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
mod mission;
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

#[doc(hidden)]
pub use bound::{BoundSummary, bound};
pub use calibrate::{CalibrateJob, calibrate};
#[doc(hidden)]
pub use calibrate::{CalibrateProgress, CalibrateWatcher, with_gains};
pub use config::Config;
#[doc(hidden)]
pub use config_reader::ReadProblem;
#[doc(hidden)]
pub use config_source::QUICKLOOK;
pub use config_source::{ConfigError, ConfigSource};
#[doc(hidden)]
pub use cost::{ChannelCost, Cost, RankCost, Segment};
pub use error::PipelineError;
#[doc(hidden)]
pub use found_solutions::CalibrateRound;
pub use found_solutions::CalibrateSummary;
#[doc(hidden)]
pub use groups::{
    GroupSize, GroupStep, GroupStepWatcher, GroupWatcher, MapGroup, MapStep, MemoryAdvice, RunGroups,
    channel_groups, replay_in_groups, run_in_groups,
};
#[doc(hidden)]
pub use memory::{MemoryLimit, MemorySource};
pub use mission::Mission;
#[doc(hidden)]
pub use plan::Expected;
pub use plan::Plan;
#[doc(hidden)]
pub use problems::{Problem, Problems};
#[doc(hidden)]
pub use realisations::{PowerSpread, RealisationSpread};
#[doc(hidden)]
pub use reference::{KeyDescription, REFERENCE, key_descriptions};
pub use run::{Destination, GroundSource, Watched, Watcher, replay, run, simulate};
#[doc(hidden)]
pub use run::{READ, downlink_file, run_among, use_threads};
#[doc(hidden)]
pub use sample_summary::{BlockSummary, SampleCounts, SampleSummary};
#[doc(hidden)]
pub use sampling::sample_stages;
#[doc(hidden)]
pub use simulation_groups::{MERGE, simulate_in_groups};
#[doc(hidden)]
pub use space_segment::{INTEGRATE, sky_notes};
#[doc(hidden)]
pub use state::solve_state;
#[doc(hidden)]
pub use study::{CaseSummary, StudyStep, StudySummary, StudyWatcher, run_study};
#[doc(hidden)]
pub use study_file::{Study, StudyCase, StudyError};
#[doc(hidden)]
pub use summary::RunScope;
pub use summary::RunSummary;
