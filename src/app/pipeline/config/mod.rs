//! From a pipeline file and overrides to a checked plan: keys, values with units, checks, hashes.

mod channel_lists;
mod downlink_settings;
mod effects;
mod engine;
mod error;
mod file_problems;
mod key_list;
mod memory;
mod notes;
mod plan;
mod problems;
mod quantities;
mod reader;
mod reference;
mod sections;
mod settings_path;
mod source;

pub(super) use downlink_settings::SETTINGS;
pub use downlink_settings::SettingsOrigin;
pub use effects::{NoEffect, condition_text};
pub(in crate::pipeline) use error::advice_off_circle;
pub use error::{ConfigError, PipelineError};
pub use memory::{MemoryLimit, MemorySource};
pub use plan::{Expected, Plan};
pub use problems::{Problem, Problems};
pub use reader::ReadProblem;
pub use reference::{KeyDescription, Shown, key_descriptions, reference};
pub use sections::Config;
pub(super) use sections::is_folder_name;
pub(super) use settings_path::{is_whole_at, number_at};
pub use source::{ConfigSource, QUICKLOOK};
pub(super) use source::{has_sections, study_key};
