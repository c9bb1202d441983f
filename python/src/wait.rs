//! Work on a thread, with an eye on Ctrl-C; and none in a fork of a process that has worked.

use std::process;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

use lunarray::runtime::Cancel;
use pyo3::prelude::*;

use crate::error::{Failure, exception, refused};

/// How often signals are looked for.
const POLL: Duration = Duration::from_millis(50);

/// What a caller does from time to time while it waits; an error ends the work.
pub(crate) type WhileWaiting<'a> = &'a mut dyn FnMut(Python<'_>) -> PyResult<()>;

/// The process whose threads work; 0 before any does.
static WORKER: AtomicU32 = AtomicU32::new(0);

/// Requires that the threads that work are those of this process. A fork has a copy of their memory without the threads
/// themselves, and would wait for them for ever.
pub(crate) fn require_threads() -> PyResult<()> {
    let me = process::id();
    match WORKER.compare_exchange(0, me, Ordering::Relaxed, Ordering::Relaxed) {
        Err(worker) if worker != me => Err(forked(worker)),
        _ => Ok(()),
    }
}

/// Requires the process `owner`, which began this.
pub(crate) fn require_process(owner: u32) -> PyResult<()> {
    if owner == process::id() { Ok(()) } else { Err(forked(owner)) }
}

fn forked(worker: u32) -> PyErr {
    refused(format!(
        "process {} is a fork of process {worker}, in which lunarray has worked, and the threads that work are in that alone: \
         expected a process of its own, such as multiprocessing.get_context(\"spawn\") starts",
        process::id()
    ))
}

/// Does `work` on a thread without the interpreter's lock. An exception while it waits (Ctrl-C, or what `while_waiting` raises)
/// cancels the work and is raised once the work has ended; a second one is raised at once and leaves the work behind.
pub(crate) fn wait_for<T: Send + 'static>(
    py: Python<'_>,
    cancel: &Cancel,
    while_waiting: WhileWaiting<'_>,
    work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    require_threads()?;
    wait_alone(py, cancel, while_waiting, work)
}

/// As [`wait_for`], for work that needs no thread but its own, which a fork can begin.
fn wait_alone<T: Send + 'static>(
    py: Python<'_>,
    cancel: &Cancel,
    while_waiting: WhileWaiting<'_>,
    work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    let (sender, mut receiver) = sync_channel(1);
    std::thread::Builder::new()
        .name("lunarray".to_owned())
        .spawn(move || {
            // Nobody may wait any more.
            let _ = sender.send(work());
        })
        .map_err(exception)?;
    let mut raised: Option<PyErr> = None;
    loop {
        let (back, found) = py.detach(move || {
            let found = receiver.recv_timeout(POLL);
            (receiver, found)
        });
        receiver = back;
        match found {
            Ok(result) => return raised.map_or_else(|| result.map_err(exception), Err),
            Err(RecvTimeoutError::Disconnected) => {
                return Err(refused(
                    "a bug of lunarray: a thread has panicked, with its reason on standard error".to_owned(),
                ));
            }
            Err(RecvTimeoutError::Timeout) => {}
        }
        if let Err(error) =
            py.check_signals().and_then(|()| if raised.is_none() { while_waiting(py) } else { Ok(()) })
        {
            if raised.is_some() {
                return Err(error);
            }
            cancel.cancel();
            raised = Some(error);
        }
    }
}

/// As [`wait_for`], with nothing to do meanwhile.
pub(crate) fn wait<T: Send + 'static>(
    py: Python<'_>,
    cancel: &Cancel,
    work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    wait_for(py, cancel, &mut |_| Ok(()), work)
}

/// As [`wait`], for work that reads a downlink and needs no thread but its own.
pub(crate) fn wait_to_read<T: Send + 'static>(
    py: Python<'_>,
    cancel: &Cancel,
    work: impl FnOnce() -> Result<T, Failure> + Send + 'static,
) -> PyResult<T> {
    wait_alone(py, cancel, &mut |_| Ok(()), work)
}
