//! Configuration of queues and threads.

use serde::{Deserialize, Serialize};

use crate::units::{Checks, InvalidValue};

/// Queues and threads. None of this changes a byte of the results.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RuntimeConfig {
    /// Greatest number of items between two stages.
    pub queue_capacity: usize,
    /// Threads for the work inside stages; 0 for one a core.
    pub threads: usize,
    /// Time that stages have to end after a failure, s.
    pub shutdown_s: f64,
    /// Time for maps of the data so far after Ctrl-C, s; solutions that take longer are cut off. What was received is saved
    /// first, and is not part of it.
    pub grace_s: f64,
    /// Longest time without progress before the run fails, s; must exceed the longest step, for example that of a
    /// solution. 0 for no limit.
    pub stall_s: f64,
}

impl Default for RuntimeConfig {
    fn default() -> Self {
        Self { queue_capacity: 64, threads: 0, shutdown_s: 10.0, grace_s: 2.5, stall_s: 0.0 }
    }
}

impl RuntimeConfig {
    /// Everything that is wrong with the configuration; empty if it is good.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::of("runtime");
        let capacity = self.queue_capacity;
        checks.number(
            "queue_capacity",
            capacity as f64,
            (1..=65_536).contains(&capacity),
            "1 to 65536 items",
        );
        checks.number(
            "threads",
            self.threads as f64,
            self.threads <= 1024,
            "at most 1024, or 0 for one a core",
        );
        let seconds = self.shutdown_s;
        checks.number("shutdown_s", seconds, (0.0..=3600.0).contains(&seconds), "0 s to 3600 s");
        let grace = self.grace_s;
        checks.number("grace_s", grace, (0.0..=1e6).contains(&grace), "0 s to 1e6 s");
        let stall = self.stall_s;
        checks.number(
            "stall_s",
            stall,
            stall == 0.0 || (0.1..=1e6).contains(&stall),
            "0.1 s to 1e6 s, or 0 for no limit",
        );
        checks.finish()
    }
}
