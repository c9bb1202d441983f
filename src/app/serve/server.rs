//! The server and its thread.

use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

use tokio::runtime::{Builder, Runtime};
use tokio::sync::{Semaphore, watch};
use tokio::time::{MissedTickBehavior, interval, sleep};

use super::address::ServeAddress;
use super::connection::accept;
use super::console::Console;
use super::error::ServeError;
use super::routes::{PageState, READERS_MAX};
use super::subject::Subject;
use crate::pipeline::RunView;

const UPDATE_INTERVAL: Duration = Duration::from_millis(500);

/// Delay before the shutdown, in which the last status reaches the connected clients.
const SHUTDOWN_DELAY: Duration = Duration::from_millis(150);

/// A running server; dropping it stops the server.
#[derive(Debug)]
pub struct Server {
    console: Arc<Console>,
    address: SocketAddr,
    newest_status: watch::Sender<Arc<str>>,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts a server. With `allow_remote` the address may be reachable by other machines, and any `Host` header is accepted.
    ///
    /// # Errors
    /// [`ServeError`]: an address on which it cannot listen; a thread that cannot be started.
    pub fn start(address: &ServeAddress, allow_remote: bool, subject: Subject) -> Result<Self, ServeError> {
        let start = |source| ServeError::Start { source };
        let listener = address.bind(allow_remote)?;
        listener.set_nonblocking(true).map_err(start)?;
        let address = listener.local_addr().map_err(start)?;
        let console = Arc::new(Console::new(subject));
        let (newest_status, status_receiver) = watch::channel(Arc::<str>::default());
        let (stop, stopped) = watch::channel(false);
        let (slow, readers) = (Arc::new(Semaphore::new(1)), Arc::new(Semaphore::new(READERS_MAX)));
        let page = PageState {
            console: Arc::clone(&console),
            newest_status: status_receiver,
            address,
            any_host: allow_remote,
            slow,
            readers,
        };
        let runtime =
            Builder::new_current_thread().enable_all().max_blocking_threads(1).build().map_err(start)?;
        let status_sender = newest_status.clone();
        let thread = std::thread::Builder::new()
            .name("serve".into())
            .spawn(move || serve(runtime, listener, page, &status_sender, stopped))
            .map_err(start)?;
        Ok(Self { console, address, newest_status, stop, thread: Some(thread) })
    }

    /// URL of the page.
    #[must_use]
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Starts to show a run.
    pub fn watch(&self, handles: &RunView) {
        self.console.set_run(handles);
        update(&self.console, &self.newest_status);
    }

    /// Whether metrics were read since the run failed.
    #[must_use]
    pub fn is_failure_scraped(&self) -> bool {
        self.console.is_failure_scraped.load(std::sync::atomic::Ordering::Relaxed)
    }

    /// Shows the end of the run, which was `cancelled` or failed with an `error`.
    pub fn conclude(&self, error: Option<String>, cancelled: bool) {
        // Earlier events have to precede the end in the log.
        update(&self.console, &self.newest_status);
        self.console.set_end(error, cancelled);
        update(&self.console, &self.newest_status);
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has already been reported.
            let _ = thread.join();
        }
    }
}

/// Updates the status, and sends it to the connected clients.
fn update(console: &Console, newest_status: &watch::Sender<Arc<str>>) {
    // A status of plain numbers and texts always has a JSON form.
    let text = serde_json::to_string(&console.update()).unwrap_or_default();
    newest_status.send_replace(text.into());
}

/// Serves connections and updates the status until `stopped`.
fn serve(
    runtime: Runtime,
    listener: TcpListener,
    page: PageState,
    newest_status: &watch::Sender<Arc<str>>,
    mut stopped: watch::Receiver<bool>,
) {
    let console = Arc::clone(&page.console);
    runtime.block_on(async {
        let accepting = tokio::spawn(accept(listener, page, stopped.clone()));
        let mut ticks = interval(UPDATE_INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = stopped.changed() => break,
                _ = ticks.tick() => update(&console, newest_status),
            }
        }
        accepting.abort();
        if console.clients.open.load(std::sync::atomic::Ordering::Relaxed) > 0 {
            sleep(SHUTDOWN_DELAY).await;
        }
    });
    // This does not wait for a picture that is being drawn.
    runtime.shutdown_background();
}
