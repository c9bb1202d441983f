//! `--mpi`: a command as one rank of a job.

use std::time::Duration;

use serde_json::{Value, json};

use super::interrupt::Interrupt;
use super::log::{self, Level};
use super::output::{CommandResult, Completion, is_broken_pipe, print_error};
use crate::pipeline::MemoryLimit;
use crate::ranks::{RankJob, Ranks, RanksError};

/// Exit code of a rank that failed.
const FAILED: u8 = 1;
/// How long the others let the first rank speak of what is amiss on all of them.
const PATIENCE: Duration = Duration::from_millis(500);

/// The job of a command; without `--mpi` it is alone.
pub(super) struct Job {
    job: Option<RankJob>,
    ranks: Ranks,
}

impl Job {
    /// Joins the job that the process was started in, if that is wanted.
    pub(super) fn join(is_wanted: bool) -> Result<Self, RanksError> {
        if !is_wanted {
            return Ok(Self { job: None, ranks: Ranks::single() });
        }
        let (job, ranks) = RankJob::start()?;
        Ok(Self { job: Some(job), ranks })
    }

    /// Those that share the sums.
    pub(super) fn ranks(&self) -> &Ranks {
        &self.ranks
    }

    /// Whether this is the process that talks and writes.
    pub(super) fn is_first(&self) -> bool {
        self.ranks.is_first()
    }

    /// The part of this machine's memory that is this rank's.
    pub(super) fn memory_limit(&self, limit: Option<MemoryLimit>) -> Option<MemoryLimit> {
        let here = self.job.as_ref().map_or(1, RankJob::ranks_here).max(1) as u64;
        limit.map(|limit| MemoryLimit { bytes: limit.bytes / here, ..limit })
    }

    /// How a command ended that failed because a signal ended its rank of several, or one of the others.
    pub(super) fn interrupted<T>(
        &self,
        ended: &Result<T, impl std::fmt::Display>,
        interrupt: &Interrupt,
    ) -> Option<Completion> {
        let error = ended
            .as_ref()
            .err()
            .filter(|_| self.ranks.is_distributed() && interrupt.cancel().is_cancelled())?;
        match log::is_json() {
            true => log::log_json(Level::Error, "error", &Value::Null, Some(&error.to_string())),
            false => log::print_line(format_args!("error: {error}")),
        }
        Some(interrupt.completion(true))
    }

    /// Ends what `work` has begun: in order once all ranks have done theirs, else all of them at once.
    pub(super) fn conclude(self, result: CommandResult) -> CommandResult {
        let Some(job) = self.job.filter(|_| self.ranks.is_distributed()) else { return result };
        let code = match result {
            Ok(Completion::Done) => return Ok(Completion::Done),
            Ok(Completion::Interrupted(code)) => code,
            Err(error) if is_broken_pipe(error.as_ref()) => return Err(error),
            Err(error) => {
                if !self.ranks.is_first() {
                    std::thread::sleep(PATIENCE);
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
