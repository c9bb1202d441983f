//! `--serve`: the page of a running command.

use std::path::Path;
use std::time::{Duration, Instant};

use clap::Args;
use serde_json::json;

use super::interrupt::Interrupt;
use super::log::say;
use super::output::CommandError;
use crate::pipeline::{Config, RunView};
use crate::serve::{ServeAddress, ServeError, Server, Subject};

/// Time for which a failure is served: several typical scrape intervals.
const FAILURE_SERVED: Duration = Duration::from_secs(20);

/// Interval of checks for a signal.
const POLL: Duration = Duration::from_millis(100);

/// Arguments for the page of a command.
#[derive(Debug, Args)]
pub(super) struct ServeArgs {
    /// Show the run in a browser: a port of this machine, or HOST:PORT. Port 0 chooses a free one; standard error prints
    /// `serving on http://HOST:PORT/`. The page is read-only.
    #[arg(long, value_name = "PORT|HOST:PORT")]
    serve: Option<ServeAddress>,
    /// Allow an address that other machines can reach. Anyone who connects can read all that is shown.
    #[arg(long, requires = "serve")]
    serve_remote: bool,
    /// Go on serving after the end of the run, until Ctrl-C or SIGTERM.
    #[arg(long, requires = "serve")]
    serve_after: bool,
}

impl ServeArgs {
    /// Starts the server, if it is requested.
    pub(super) fn start(
        &self,
        config: &Config,
        segment: &'static str,
        state: Option<&Path>,
        out: Option<&Path>,
    ) -> Result<Page, ServeError> {
        let Some(address) = &self.serve else { return Ok(Page { server: None, stays_after_end: false }) };
        let subject = Subject::new(config, segment, state);
        let subject = out.into_iter().fold(subject, Subject::with_maps_in);
        let server = Server::start(address, self.serve_remote, subject)?;
        let url = server.url().to_string();
        say("serving", &json!({ "url": url }), format_args!("serving on {url}"));
        Ok(Page { server: Some(server), stays_after_end: self.serve_after })
    }
}

/// The page of a command, if it is requested; dropping it stops the server.
pub(super) struct Page {
    server: Option<Server>,
    /// Whether to serve after the end of the run.
    stays_after_end: bool,
}

impl Page {
    /// Starts to show a run.
    pub(super) fn watch(&self, handles: &RunView) {
        if let Some(server) = &self.server {
            server.watch(handles);
        }
    }

    /// Shows the end of a run; `cancelled` tells whether a result is of a cancelled run.
    pub(super) fn conclude<T, E: Into<CommandError>>(
        &self,
        result: Result<T, E>,
        cancelled: impl FnOnce(&T) -> bool,
    ) -> Result<T, CommandError> {
        let result = result.map_err(Into::into);
        if let Some(server) = &self.server {
            let error = result.as_ref().err().map(ToString::to_string);
            server.conclude(error, result.as_ref().is_ok_and(cancelled));
        }
        result
    }

    /// After a failure, serves the failed status until monitoring has read it, a time limit or a signal.
    pub(super) fn serve_failure(&self, interrupt: &Interrupt) {
        let Some(server) = &self.server else { return };
        let since = Instant::now();
        while since.elapsed() < FAILURE_SERVED
            && !interrupt.cancel().is_cancelled()
            && !server.is_failure_scraped()
        {
            std::thread::sleep(POLL);
        }
    }

    /// After a run that was not interrupted, serves until a signal, if that is requested.
    pub(super) fn serve_until_interrupt(self, interrupt: &Interrupt) {
        let Some(server) = self.server.filter(|_| self.stays_after_end && !interrupt.cancel().is_cancelled())
        else {
            return;
        };
        let url = server.url().to_string();
        let message = format_args!("the run is over; serving on {url} until Ctrl-C");
        say("serving-on", &json!({ "url": url }), message);
        while !interrupt.cancel().is_cancelled() {
            std::thread::sleep(POLL);
        }
    }
}
