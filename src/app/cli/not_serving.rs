//! Replacement of `serving` for builds without the feature `serve`.

use std::path::Path;

use clap::Args;

use super::interrupt::Interrupt;
use super::output::CommandError;
use crate::pipeline::{Config, RunView};

/// No arguments.
#[derive(Debug, Args)]
pub(super) struct ServeArgs {}

impl ServeArgs {
    pub(super) fn start(
        &self,
        _config: &Config,
        _segment: &str,
        _state: Option<&Path>,
        _out: Option<&Path>,
    ) -> Result<Page, CommandError> {
        Ok(Page)
    }
}

pub(super) struct Page;

impl Page {
    pub(super) fn watch(&self, _watched: &RunView) {}

    pub(super) fn conclude<T, E: Into<CommandError>>(
        &self,
        result: Result<T, E>,
        _cancelled: impl FnOnce(&T) -> bool,
    ) -> Result<T, CommandError> {
        result.map_err(Into::into)
    }

    pub(super) fn serve_failure(&self, _interrupt: &Interrupt) {}

    pub(super) fn serve_until_interrupt(self, _interrupt: &Interrupt) {}
}
