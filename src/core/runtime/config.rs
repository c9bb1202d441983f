//! Configuration of queues and threads.

use crate::units::{Checks, InvalidValue, keys};

keys! {
    /// Queues and threads. None of this changes a byte of the results.
    pub struct RuntimeConfig {
        /// Maximum number of items between two stages.
        expert queue_capacity: usize = 64;
        /// Threads for the work inside stages; 0 for one per core.
        everyday threads: usize = 0;
        /// Time for maps of the data so far after Ctrl-C; longer solutions are cut off. What was received is saved before.
        everyday grace_s: f64 = 2.5;
        /// Maximum time without progress before the run fails; must exceed the longest step, such as a solution. 0 for no limit.
        expert stall_s: f64 = 0.0;
    }
}

impl RuntimeConfig {
    /// All problems of the configuration; empty if it is valid.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("runtime");
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
            "at most 1024, or 0 for one per core",
        );
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
