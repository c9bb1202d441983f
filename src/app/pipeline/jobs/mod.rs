//! Jobs that run several graphs: groups of channels, studies, noise realisations, rounds of calibration, maps of states.

mod bound;
mod calibrate;
mod case;
mod group_steps;
mod groups;
mod mission;
mod noise_maps;
mod realisations;
mod simulation_groups;
mod state;
mod study;
mod study_file;
mod zoom;

pub use bound::{BoundSummary, bound};
pub use calibrate::{CalibrateJob, CalibrateProgress, CalibrateWatcher, calibrate, with_gains};
pub use case::CaseSummary;
pub use group_steps::{GroupStep, GroupStepWatcher, MapStep};
pub use groups::{GroupWatcher, channel_groups, replay_in_groups, run_in_groups};
pub use mission::Mission;
pub use realisations::{PowerSpread, RealisationSpread};
pub use simulation_groups::{MERGE, simulate_in_groups};
pub use state::{joint_channels, sample_state, solve_state, solve_states_jointly};
pub use study::{StudyStep, StudySummary, StudyWatcher, run_study};
pub use study_file::{Study, StudyCase, StudyError};
pub use zoom::{ZoomCentre, ZoomJob, ZoomReport, zoom_downlink};
