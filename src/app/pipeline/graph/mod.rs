//! From a plan to a running graph: the stages of space and ground, and the summary of what they did.

pub(super) mod calibrate_products;
pub(super) mod finish;
pub(super) mod found_solutions;
pub(super) mod ground_segment;
pub(super) mod joint;
mod live_gains;
pub(crate) mod models;
pub(super) mod run;
mod sample_summary;
pub(crate) mod sampling;
pub(crate) mod space_segment;
mod stepwise;
pub(super) mod summary;
mod view;

pub use found_solutions::{CalibrateRound, CalibrateSummary};
pub use joint::SumsStorage;
pub(crate) use run::SHUTDOWN;
pub use run::{
    Destination, GroundSource, OnStart, READ, downlink_file, main_products, replay, require_products_folder,
    run, run_with_ranks, simulate, use_threads,
};
pub use sample_summary::{BlockSummary, SampleCounts, SampleSummary};
pub use sampling::sample_stages;
pub use space_segment::{INTEGRATE, sky_notes};
pub use stepwise::StepwiseRun;
pub use summary::{RunScope, RunSummary};
pub use view::RunView;
pub(crate) use view::{Change, RunChanges};
