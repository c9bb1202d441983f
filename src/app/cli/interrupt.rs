//! Ctrl-C and other signals: the first cancels a run, the second ends the process.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

use super::output::{Completion, print_notes};
#[cfg(unix)]
use crate::files::remove_unfinished;
use crate::runtime::Cancel;

/// Signals that cancel a run.
#[cfg(unix)]
const SIGNALS: [i32; 3] = [SIGINT, SIGTERM, signal_hook::consts::SIGHUP];
/// Signals that cancel a run.
#[cfg(not(unix))]
const SIGNALS: [i32; 2] = [SIGINT, SIGTERM];

/// Exit code of a command that a signal ended, minus the number of the signal; a convention of shells.
const SHELL_BASE: i32 = 128;

/// Time after the first signal within which others are the same request: a shell or `timeout` may signal a process and its group.
const SAME: Duration = Duration::from_millis(200);

/// What an armed [`Interrupt`] sets at a signal: the run to cancel, the signal's number, and, [`SAME`] later, that the next ends the
/// process.
static ARMED: OnceLock<(Cancel, Arc<AtomicUsize>, Arc<AtomicBool>)> = OnceLock::new();

/// Whether the thread of [`remove_files_on_signal`] runs.
static IS_WATCHED: AtomicBool = AtomicBool::new(false);

/// Makes signals remove the files that are being written before they end the process, in commands without an [`Interrupt`], and
/// before that is armed. Without it, or if it fails, they end the process at once.
#[cfg(unix)]
pub(super) fn remove_files_on_signal() {
    let ignored = ignored_signals();
    let handled = SIGNALS.into_iter().filter(|signal| ignored >> (signal - 1) & 1 == 0);
    let Ok(mut signals) = signal_hook::iterator::Signals::new(handled) else { return };
    IS_WATCHED.store(true, Ordering::Relaxed);
    std::thread::spawn(move || {
        for signal in signals.forever() {
            if let Some((cancel, number, is_second)) = ARMED.get() {
                // The signal may have come just before the handlers were installed.
                number.store(signal.unsigned_abs() as usize, Ordering::Relaxed);
                cancel.cancel();
                if !is_second.load(Ordering::Relaxed) {
                    std::thread::sleep(SAME);
                    is_second.store(true, Ordering::Relaxed);
                }
                continue;
            }
            remove_unfinished();
            let _ = signal_hook::low_level::emulate_default_handler(signal);
        }
    });
}

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

    /// Installs the handlers: the first signal cancels the run, a second, at least [`SAME`] later, ends the process immediately. Before
    /// this call, any signal ends the process, as there is nothing to save. Signals that are ignored at the start, as by `nohup`,
    /// stay ignored.
    ///
    /// All but the wait for [`SAME`] happens in the signal handler, so that a blocked thread cannot delay it.
    fn arm(&self) -> std::io::Result<()> {
        // A flag of its own: the thread of `remove_files_on_signal` may cancel before the shutdown looks.
        let is_second = Arc::new(AtomicBool::new(false));
        let armed = (self.cancel.clone(), Arc::clone(&self.signal), Arc::clone(&is_second));
        // Without the thread, or if it serves another run, nothing sets the flag later.
        let is_watched = ARMED.set(armed).is_ok() && IS_WATCHED.load(Ordering::Relaxed);
        let ignored = ignored_signals();
        for signal in SIGNALS.into_iter().filter(|signal| ignored >> (signal - 1) & 1 == 0) {
            // The order matters: at the first signal, the shutdown must find the flag unset.
            flag::register_conditional_shutdown(signal, SHELL_BASE + signal, Arc::clone(&is_second))?;
            if !is_watched {
                flag::register(signal, Arc::clone(&is_second))?;
            }
            flag::register_usize(signal, Arc::clone(&self.signal), signal.unsigned_abs() as usize)?;
            flag::register(signal, self.cancel.flag())?;
        }
        Ok(())
    }

    /// Installs the handlers once for all runs of a command, as a second installation would take the first signal for the second.
    /// Prints a note on failure; signals then end the process, as is the default.
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

    /// The completion of a command whose run was `cancelled` or not.
    pub(super) fn completion(&self, cancelled: bool) -> Completion {
        match self.signal.load(Ordering::Relaxed) {
            _ if !cancelled => Completion::Done,
            signal => Completion::Interrupted(u8::try_from(SHELL_BASE as usize + signal).unwrap_or(u8::MAX)),
        }
    }

    /// The completion of a service, which runs until it is interrupted: SIGTERM is its regular end, unless received data were neither
    /// saved nor mapped.
    pub(super) fn completion_of_service(&self, cancelled: bool, is_saved: bool) -> Completion {
        let is_terminated = self.signal.load(Ordering::Relaxed) == SIGTERM.unsigned_abs() as usize;
        if is_terminated && is_saved { Completion::Done } else { self.completion(cancelled) }
    }
}

/// Bit mask of the signals that this process ignores, SIGHUP (1) in the lowest bit; 0 if the system does not report it.
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok()).unwrap_or(0)
}
