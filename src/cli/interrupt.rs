//! Ctrl-C and other signals: the first asks a run to end in order, the second ends the process.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use super::output::{Completion, print_notes};
use crate::runtime::Cancel;

/// Signals that end a run in order.
#[cfg(unix)]
const SIGNALS: [i32; 3] = [SIGINT, SIGTERM, signal_hook::consts::SIGHUP];
/// Signals that end a run in order.
#[cfg(not(unix))]
const SIGNALS: [i32; 2] = [SIGINT, SIGTERM];

/// What a shell adds to the number of the signal by which a command ended.
const SHELL_BASE: i32 = 128;

/// Cancels a run on the first signal.
#[derive(Debug, Default)]
pub(super) struct Interrupt {
    cancel: Cancel,
    /// The last signal; 0 if there was none.
    signal: Arc<AtomicUsize>,
    armed: AtomicBool,
}

impl Interrupt {
    /// The token that a signal cancels.
    pub(super) fn cancel(&self) -> &Cancel {
        &self.cancel
    }

    /// From now on the first signal cancels and the second ends the process at once. Before, any signal ends it: there is
    /// nothing to save. Signals that the process was told to ignore when it was started, as `nohup` does, stay ignored.
    ///
    /// All is done within the signal handler: nothing that a thread waits for can delay it.
    fn arm(&self) -> std::io::Result<()> {
        let ignored = ignored_signals();
        for signal in SIGNALS.into_iter().filter(|signal| ignored >> (signal - 1) & 1 == 0) {
            // In this order: the first signal finds the flag unset.
            flag::register_conditional_shutdown(signal, SHELL_BASE + signal, self.cancel.flag())?;
            flag::register_usize(signal, Arc::clone(&self.signal), signal.unsigned_abs() as usize)?;
            flag::register(signal, self.cancel.flag())?;
        }
        Ok(())
    }

    /// As [`Interrupt::arm`], once for all runs of a command: armed twice, it would take the first signal for the second. If that fails,
    /// says so: signals then end the process as they do by default.
    pub(super) fn arm_or_note(&self) {
        if self.armed.swap(true, Ordering::Relaxed) {
            return;
        }
        if let Err(error) = self.arm() {
            print_notes([format!(
                "signals cannot be handled ({error}); any of them will end the process at once"
            )]);
        }
    }

    /// How a command ended whose run says whether it was `cancelled`.
    pub(super) fn completion(&self, cancelled: bool) -> Completion {
        match self.signal.load(Ordering::Relaxed) {
            _ if !cancelled => Completion::Done,
            signal => Completion::Interrupted(u8::try_from(SHELL_BASE as usize + signal).unwrap_or(u8::MAX)),
        }
    }

    /// As [`Interrupt::completion`], for a command that runs until it is told to end: SIGTERM is its regular end, unless
    /// received data was neither saved nor made into maps.
    pub(super) fn completion_of_service(&self, cancelled: bool, is_saved: bool) -> Completion {
        let is_told = self.signal.load(Ordering::Relaxed) == SIGTERM.unsigned_abs() as usize;
        if is_told && is_saved { Completion::Done } else { self.completion(cancelled) }
    }
}

/// The signals that this process ignores, one bit each, SIGHUP (1) in the lowest. 0 where the system does not tell.
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}
