//! From a configuration to a running graph: parse, validate, build, run.
//!
//! The only place where space and ground meet, and where concrete stages are connected. Uses every folder before it. Of its rooms
//! each uses only those before it: `config`, `cost`, `graph`, `jobs`.

mod config;
mod cost;
pub(crate) mod graph;
mod jobs;

pub use config::{
    Config, ConfigError, ConfigSource, Expected, KeyDescription, MemoryLimit, MemorySource, NoEffect,
    PipelineError, Plan, Problem, Problems, QUICKLOOK, ReadProblem, Shown, key_descriptions, reference,
};
pub use cost::{ChannelCost, Cost, GroupSize, MapGroup, MemoryAdvice, RankCost, RunGroups, Segment};
pub use graph::{
    BlockSummary, CalibrateRound, CalibrateSummary, Destination, GroundSource, INTEGRATE, READ, RunScope,
    RunSummary, SampleCounts, SampleSummary, Watched, Watcher, downlink_file, replay, run, run_among,
    sample_stages, simulate, sky_notes, use_threads,
};
pub use jobs::{
    CalibrateJob, CalibrateProgress, CalibrateWatcher, CaseSummary, GroupStep, GroupStepWatcher,
    GroupWatcher, MERGE, MapStep, PowerSpread, RealisationSpread, Study, StudyCase, StudyError, StudyStep,
    StudySummary, StudyWatcher, calibrate, channel_groups, replay_in_groups, run_in_groups, run_study,
    simulate_in_groups, solve_state, with_gains,
};
