//! `--mpi`: a command as one rank of a job.

use std::time::Duration;

use serde_json::{Value, json};

use super::interrupt::Interrupt;
use super::log::{self, Level};
use super::output::{CommandResult, Completion, is_broken_pipe, print_error};
use crate::pipeline::MemoryLimit;
use crate::ranks::{RankJob, Ranks, RanksError};

const FAILED: u8 = 1;
/// Delay of other ranks before they print an error, so that one on all ranks is printed by the first.
const ERROR_DELAY: Duration = Duration::from_millis(500);

/// The MPI job of a command; without `--mpi`, a single process.
pub(super) struct Job {
    job: Option<RankJob>,
    ranks: Ranks,
}

impl Job {
    /// Joins the MPI job in which the process was started, if `is_wanted`.
    pub(super) fn join(is_wanted: bool) -> Result<Self, RanksError> {
        if !is_wanted {
            return Ok(Self { job: None, ranks: Ranks::single() });
        }
        let (job, ranks) = RankJob::start()?;
        Ok(Self { job: Some(job), ranks })
    }

    /// The ranks that share the normal equations.
    pub(super) fn ranks(&self) -> &Ranks {
        &self.ranks
    }

    /// Whether this is the rank that prints and writes.
    pub(super) fn is_first(&self) -> bool {
        self.ranks.is_first()
    }

    /// Divides a memory limit among the ranks on this machine.
    pub(super) fn memory_limit(&self, limit: Option<MemoryLimit>) -> Option<MemoryLimit> {
        let local_ranks = self.job.as_ref().map_or(1, RankJob::ranks_here).max(1) as u64;
        limit.map(|limit| MemoryLimit { bytes: limit.bytes / local_ranks, ..limit })
    }

    /// The completion of one of several ranks that failed because a signal ended it or another rank; prints the error.
    pub(super) fn completion_if_interrupted<T>(
        &self,
        result: &Result<T, impl std::fmt::Display>,
        interrupt: &Interrupt,
    ) -> Option<Completion> {
        let error = result
            .as_ref()
            .err()
            .filter(|_| self.ranks.is_distributed() && interrupt.cancel().is_cancelled())?;
        match log::is_json() {
            true => log::log_json(Level::Error, "error", &Value::Null, Some(&error.to_string())),
            false => log::print_line(format_args!("error: {error}")),
        }
        Some(interrupt.completion(true))
    }

    /// Ends the job: normally if this rank succeeded, otherwise by aborting all ranks.
    pub(super) fn conclude(self, result: CommandResult) -> CommandResult {
        let Some(job) = self.job.filter(|_| self.ranks.is_distributed()) else { return result };
        let code = match result {
            Ok(Completion::Done) => return Ok(Completion::Done),
            Ok(Completion::Interrupted(code)) => code,
            Err(error) if is_broken_pipe(error.as_ref()) => return Err(error),
            Err(error) => {
                if !self.ranks.is_first() {
                    std::thread::sleep(ERROR_DELAY);
                }
                print_error(error.as_ref());
                FAILED
            }
        };
        let rank = self.ranks.share().rank;
        log::say("job-ended", &json!({ "rank": rank }), format_args!("rank {rank} ends the job"));
        job.abort(code)
    }
}
