//! Why a run fails.

use std::fmt;
use std::time::Duration;

use thiserror::Error;

/// Any error of a stage.
pub type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// Where in a stage's life something happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Moment {
    /// While working on this input, counted from 0; for a source, while making this item.
    Item(u64),
    /// In `finish`, after so many inputs; for a source, after so many items made.
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

/// Stages that had not ended when the deadline passed; shown as nothing if there are none.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Laggards {
    /// Their names, in the order in which they were added.
    pub stages: Vec<String>,
    /// How long they were waited for.
    pub waited: Duration,
}

impl fmt::Display for Laggards {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.stages.is_empty() {
            return Ok(());
        }
        let names = self.stages.join("`, `");
        write!(f, " (still running {:.1} s later: `{names}`)", self.waited.as_secs_f64())
    }
}

/// Why a graph cannot run, or did not run to its end.
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
        /// Where it stood.
        at: Moment,
        /// Who did not stop in time.
        laggards: Laggards,
        /// What the stage said.
        source: BoxError,
    },
    /// A stage panicked; the first failure of the run.
    #[error("stage `{stage}` panicked {at}: {message}{laggards}")]
    Panicked {
        /// Name of the stage.
        stage: String,
        /// Where it stood.
        at: Moment,
        /// The panic's message.
        message: String,
        /// Who did not stop in time.
        laggards: Laggards,
    },
    /// Nothing moved any more.
    #[error("nothing has moved for {:.1} s, in work: `{}`{laggards}", waited.as_secs_f64(), stages.join("`, `"))]
    Stalled {
        /// Names of the stages that were neither waiting for input nor for room.
        stages: Vec<String>,
        /// How long nothing moved.
        waited: Duration,
        /// Who did not stop in time.
        laggards: Laggards,
    },
    /// A thread could not be started.
    #[error("no thread for stage `{stage}`{laggards}; the system's limit on threads may be too low")]
    Thread {
        /// Name of the stage.
        stage: String,
        /// Who did not stop in time.
        laggards: Laggards,
        /// What the system said.
        source: std::io::Error,
    },
    /// A queue that can hold nothing.
    #[error("stage `{stage}`: queue capacity 0; expected at least 1")]
    Capacity {
        /// Name of the stage that fills the queue.
        stage: String,
    },
    /// A name that cannot be a thread's, or that is taken.
    #[error("stage name `{stage}`: expected a name of its own, not empty and without NUL")]
    Name {
        /// The name.
        stage: String,
    },
    /// A link that leads nowhere.
    #[error("nothing takes what stage `{stage}` gives; end its chain with a sink")]
    OpenEnd {
        /// Name of the stage.
        stage: String,
    },
    /// A link of another graph.
    #[error("the input of stage `{stage}` belongs to another graph")]
    ForeignLink {
        /// Name of the stage.
        stage: String,
    },
}
