//! Errors of a run.

use std::fmt;
use std::time::Duration;

use thiserror::Error;

/// Any error of a stage.
pub type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// Position of a stage in its input at a failure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Moment {
    /// In the step on this input, counted from 0. For a source, on this output.
    Item(u64),
    /// In `finish`, after this number of inputs. For a source, of outputs.
    Finish(u64),
}

impl fmt::Display for Moment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Item(sequence) => write!(f, "at item {sequence}"),
            Self::Finish(count) => write!(f, "in finish, after {count} items"),
        }
    }
}

/// Stages that had not ended by the deadline. Displayed as an empty string if there are none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct UnfinishedStages {
    /// Names of the stages, in the order in which they were added.
    pub stages: Vec<String>,
    /// How long the supervisor waited for them.
    pub waited: Duration,
}

impl fmt::Display for UnfinishedStages {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.stages.is_empty() {
            return Ok(());
        }
        let names = self.stages.join("`, `");
        write!(f, " (still running {:.1} s later: `{names}`)", self.waited.as_secs_f64())
    }
}

/// Errors of building or running a graph.
///
/// The error of a stage is the `source()` and not part of the message, so that the whole chain should be printed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RuntimeError {
    /// The first failure was an error of a stage.
    #[error("stage `{stage}` failed {at}{unfinished}")]
    Failed {
        /// Name of the stage.
        stage: String,
        /// Position of the stage.
        at: Moment,
        /// Stages that had not ended by the deadline.
        unfinished: UnfinishedStages,
        /// Error of the stage.
        source: BoxError,
    },
    /// The first failure was a panic of a stage.
    #[error("stage `{stage}` panicked {at}: {message}{unfinished}")]
    Panicked {
        /// Name of the stage.
        stage: String,
        /// Position of the stage.
        at: Moment,
        /// Message of the panic.
        message: String,
        /// Stages that had not ended by the deadline.
        unfinished: UnfinishedStages,
    },
    /// No stage made progress within the time limit.
    #[error("no stage made progress for {:.1} s; in a step: `{}`{unfinished}", waited.as_secs_f64(), stages.join("`, `"))]
    Stalled {
        /// Names of the stages that waited neither for input nor for space in their queue.
        stages: Vec<String>,
        /// Time without progress.
        waited: Duration,
        /// Stages that had not ended by the deadline.
        unfinished: UnfinishedStages,
    },
    /// A thread could not be started.
    #[error(
        "cannot start a thread for stage `{stage}`{unfinished}; the limit of the system on threads may be too low"
    )]
    Thread {
        /// Name of the stage.
        stage: String,
        /// Stages that had not ended by the deadline.
        unfinished: UnfinishedStages,
        /// Error of the system.
        source: std::io::Error,
    },
    /// A queue without capacity.
    #[error("stage `{stage}`: queue capacity 0; expected at least 1")]
    Capacity {
        /// Name of the stage that fills the queue.
        stage: String,
    },
    /// A stage name that is in use, or invalid as a thread name.
    #[error("stage name `{stage}` is in use or invalid; expected a unique name, not empty and without NUL")]
    Name {
        /// Name of the stage.
        stage: String,
    },
    /// A link without a receiver.
    #[error("no stage takes the output of stage `{stage}`; end its chain with a sink")]
    OpenEnd {
        /// Name of the stage.
        stage: String,
    },
    /// A link that belongs to another graph.
    #[error("the input of stage `{stage}` belongs to another graph")]
    ForeignLink {
        /// Name of the stage.
        stage: String,
    },
}
