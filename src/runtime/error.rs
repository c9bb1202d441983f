//! Errors of a run.

use std::fmt;
use std::time::Duration;

use thiserror::Error;

/// Any error of a stage.
pub type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// Position of a stage when something happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Moment {
    /// While it processed this input, counted from 0; a source: while it made this item.
    Item(u64),
    /// In `finish`, after this number of inputs; a source: of items.
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

/// Stages that had not ended by the deadline; displayed as an empty string if there are none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct UnfinishedStages {
    /// Their names, in the order in which they were added.
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

/// Why a graph cannot run, or did not finish.
///
/// A stage's own error is the `source()`, not part of the message: print the chain.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RuntimeError {
    /// A stage returned an error; the first one of the run.
    #[error("stage `{stage}` failed {at}{laggards}")]
    Failed {
        /// Name of the stage.
        stage: String,
        /// Its position.
        at: Moment,
        /// Stages that did not stop in time.
        laggards: UnfinishedStages,
        /// The stage's error.
        source: BoxError,
    },
    /// A stage panicked; the first failure of the run.
    #[error("stage `{stage}` panicked {at}: {message}{laggards}")]
    Panicked {
        /// Name of the stage.
        stage: String,
        /// Its position.
        at: Moment,
        /// The panic's message.
        message: String,
        /// Stages that did not stop in time.
        laggards: UnfinishedStages,
    },
    /// No stage made progress any more.
    #[error("no stage made progress for {:.1} s; in a step: `{}`{laggards}", waited.as_secs_f64(), stages.join("`, `"))]
    Stalled {
        /// Names of the stages that waited neither for input nor for room.
        stages: Vec<String>,
        /// How long there was no progress.
        waited: Duration,
        /// Stages that did not stop in time.
        laggards: UnfinishedStages,
    },
    /// A thread could not be started.
    #[error("no thread for stage `{stage}`{laggards}; the system's limit on threads may be too low")]
    Thread {
        /// Name of the stage.
        stage: String,
        /// Stages that did not stop in time.
        laggards: UnfinishedStages,
        /// The system's error.
        source: std::io::Error,
    },
    /// A queue without capacity.
    #[error("stage `{stage}`: queue capacity 0; expected at least 1")]
    Capacity {
        /// Name of the stage that fills the queue.
        stage: String,
    },
    /// A name that is invalid for a thread, or in use.
    #[error("stage name `{stage}`: expected a unique name, not empty and without NUL")]
    Name {
        /// The name.
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
