//! Jobs that run several graphs: groups of channels, studies, noise realisations, rounds of calibration, maps of states.

mod bound;
mod calibrate;
mod case;
mod design;
mod design_file;
mod design_limits;
mod event;
mod groups;
mod joint;
mod mission;
mod noise_maps;
mod realisations;
mod sensitivity;
mod simulation_groups;
mod state;
mod step;
mod study;
mod study_file;
mod zoom;

pub use bound::{BoundSummary, bound};
pub use calibrate::{CalibrateJob, CalibrateProgress, CalibrateWatcher, calibrate, with_gains};
pub use case::CaseSummary;
pub use design::{DesignCheck, DesignRuns, DesignStep, DesignSummary, NotCompared, run_design};
pub use design_file::{Design, DesignObjective};
pub use design_limits::breathing_m_s_per_year;
pub use event::{JobEvent, JobWatcher, MapStep};
pub use groups::{channel_groups, replay_in_groups, run_in_groups};
pub use joint::{has_powers, joint_channels, solve_states_jointly};
pub use mission::Mission;
pub use realisations::{PowerSpread, RealisationSpread};
pub use sensitivity::{ArraySensitivity, SENSITIVITY_L_MAX};
pub use simulation_groups::{MERGE, simulate_in_groups};
pub use state::{sample_state, solve_state};
pub use study::{StudySummary, run_study};
pub use study_file::{Study, StudyCase, StudyError};
pub use zoom::{ZoomCentre, ZoomJob, ZoomReport, zoom_downlink};
