//! From a configuration to a running graph: parse, validate, build, run.
//!
//! Space and ground segment meet only here, where concrete stages are connected. Of the folders `config`, `cost`, `graph` and `jobs`,
//! each uses only those before it.

mod config;
mod cost;
pub(crate) mod graph;
mod jobs;

pub use config::{Config, ConfigError, ConfigSource, PipelineError, Plan};
#[doc(hidden)]
pub use config::{
    Expected, KeyDescription, MemoryLimit, MemorySource, NoEffect, Problem, Problems, QUICKLOOK, ReadProblem,
    SettingsOrigin, Shown, condition_text, key_descriptions, reference,
};
#[doc(hidden)]
pub use cost::{ChannelCost, Cost, GroupSize, MapGroup, MemoryAdvice, RankCost, RunGroups, Segment};
#[doc(hidden)]
pub use graph::{
    BlockSummary, CalibrateRound, INTEGRATE, READ, RunScope, SampleCounts, SampleSummary, StepwiseRun,
    SumsStorage, downlink_file, main_products, require_products_folder, run_with_ranks, sample_stages,
    sky_notes, use_threads,
};
pub use graph::{
    CalibrateSummary, Destination, GroundSource, OnStart, RunSummary, RunView, replay, run, simulate,
};
pub(crate) use graph::{Change, RunChanges};
#[doc(hidden)]
pub use jobs::{
    ArraySensitivity, BoundSummary, BurstsReport, CalibrateProgress, CalibrateWatcher, CaseSummary, Design,
    DesignCheck, DesignObjective, DesignRuns, DesignStep, DesignSummary, JobEvent, JobWatcher, MERGE,
    MapStep, NotCompared, PowerSpread, RealisationSpread, SENSITIVITY_L_MAX, Study, StudyCase, StudyError,
    StudySummary, ZoomCentre, ZoomJob, ZoomReport, bound, breathing_m_s_per_year, bursts_of_downlink,
    channel_groups, has_powers, joint_channels, replay_in_groups, run_design, run_in_groups, run_study,
    sample_state, simulate_in_groups, solve_state, solve_states_jointly, with_gains, zoom_downlink,
};
pub use jobs::{CalibrateJob, Mission, calibrate};
