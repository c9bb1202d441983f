//! Work on a thread, with an eye on Ctrl-C.

use std::sync::mpsc::{RecvTimeoutError, sync_channel};
use std::time::Duration;

use lunarray::runtime::Cancel;
use pyo3::prelude::*;

use crate::error::{Failure, exception, refused};

/// How often signals are looked for.
const POLL: Duration = Duration::from_millis(50);

/// What a caller does from time to time while it waits; an error ends the work.
pub(crate) type Tick<'a> = &'a mut dyn FnMut(Python<'_>) -> PyResult<()>;

/// Does `work` on a thread without the interpreter's lock. An exception while it waits (Ctrl-C, or what `tick` raises)
/// cancels the work and is raised once the work has ended; a second one is raised at once and leaves the work behind.
pub(crate) fn wait_for<T: Send + 'static>(
    py: Python<'_>,
    cancel: &Cancel,
    tick: Tick<'_>,
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
        if let Err(error) = py.check_signals().and_then(|()| if raised.is_none() { tick(py) } else { Ok(()) })
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
