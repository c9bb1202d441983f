//! `lunarray compare`: a map against the truth.

use std::path::PathBuf;

use clap::Args;

use super::{CommandResult, Outcome};

/// Compare.
#[derive(Debug, Args)]
pub(super) struct CompareArgs {
    /// Map.
    map: PathBuf,
}

pub(super) fn execute(_: &CompareArgs) -> CommandResult {
    Ok(Outcome::Done)
}
