//! Progress of long work: a bar on a terminal, plain lines otherwise; and Ctrl-C.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::mpsc::{Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::CommandError;
use crate::runtime::{Cancel, Metrics};

/// Time between looks at the counters on a terminal.
const POLL: Duration = Duration::from_millis(200);
/// Time between lines where there is no terminal.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// A token that the first Ctrl-C (or SIGTERM) cancels; a second one ends the process at once.
pub(super) fn cancel_on_interrupt() -> Result<Cancel, CommandError> {
    let cancel = Cancel::new();
    let token = cancel.clone();
    ctrlc::set_handler(move || {
        if token.is_cancelled() {
            std::process::exit(130);
        }
        eprintln!("\ninterrupted: finishing with the data so far (again to stop at once)");
        token.cancel();
    })?;
    Ok(cancel)
}

/// Watches a running graph until dropped.
pub(super) struct Progress {
    stop: Sender<()>,
    thread: Option<JoinHandle<()>>,
}

impl Progress {
    /// Shows how far stage `stage` is, of `total` items taken or given; `total` 0 if that is unknown.
    pub(super) fn watch(metrics: Arc<Metrics>, stage: &'static str, total: u64) -> Self {
        let (stop, stopped) = channel();
        let thread = std::thread::spawn(move || {
            let shown = Shown::new(total);
            let wait = if shown.bar.is_some() { POLL } else { LINE_EVERY };
            while stopped.recv_timeout(wait).is_err_and(|e| e == std::sync::mpsc::RecvTimeoutError::Timeout) {
                shown.show(&metrics, stage);
            }
            if let Some(bar) = shown.bar {
                bar.finish_and_clear();
            }
        });
        Self { stop, thread: Some(thread) }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        // The thread may have ended already; then there is nobody to tell.
        let _ = self.stop.send(());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Shown {
    bar: Option<ProgressBar>,
    total: u64,
    since: Instant,
}

impl Shown {
    fn new(total: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let template = if total > 0 {
                "{elapsed_precise} [{bar:40}] {pos}/{len} windows, {eta} left  {msg}"
            } else {
                "{elapsed_precise} {spinner} {msg}"
            };
            let style = ProgressStyle::with_template(template);
            ProgressBar::new(total).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        });
        Self { bar, total, since: Instant::now() }
    }

    fn show(&self, metrics: &Metrics, stage: &str) {
        let stages = metrics.snapshot();
        let done = stages.iter().find(|s| s.name == stage).map_or(0, |s| s.items_in.saturating_sub(1));
        let message: Vec<String> = stages
            .iter()
            .filter(|s| !s.units.name.is_empty() && s.units.count > 0)
            .map(|s| format!("{} {} {}", s.name, s.units.count, s.units.name))
            .collect();
        let message = message.join(", ");
        match &self.bar {
            Some(bar) => {
                bar.set_position(done);
                bar.set_message(message);
            }
            None => {
                let elapsed_s = self.since.elapsed().as_secs();
                let of =
                    if self.total > 0 { format!(" {done}/{} windows,", self.total) } else { String::new() };
                eprintln!("{elapsed_s:>5} s:{of} {message}");
            }
        }
    }
}
