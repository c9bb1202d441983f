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
use super::routes::{PageState, READERS_MAX, router};
use super::subject::Subject;
use crate::pipeline::Watched;

/// Interval between two looks at the run.
const TICK: Duration = Duration::from_millis(500);

/// Time for the last status to reach those who are connected.
const LAST_WORDS: Duration = Duration::from_millis(150);

/// A server at work; it ends when dropped.
#[derive(Debug)]
pub struct Server {
    console: Arc<Console>,
    address: SocketAddr,
    news: watch::Sender<Arc<str>>,
    stop: watch::Sender<bool>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Starts to serve; on addresses that other machines can reach only if `allow_remote`, and then under any name.
    ///
    /// # Errors
    /// [`ServeError`]: an address that cannot be had, or no thread.
    pub fn start(address: &ServeAddress, allow_remote: bool, subject: Subject) -> Result<Self, ServeError> {
        let start = |source| ServeError::Start { source };
        let listener = address.bind(allow_remote)?;
        listener.set_nonblocking(true).map_err(start)?;
        let own = listener.local_addr().map_err(start)?;
        let console = Arc::new(Console::new(subject));
        let (news, reader) = watch::channel(Arc::<str>::default());
        let (stop, stopped) = watch::channel(false);
        let (slow, readers) = (Arc::new(Semaphore::new(1)), Arc::new(Semaphore::new(READERS_MAX)));
        let desk = PageState {
            console: Arc::clone(&console),
            news: reader,
            own,
            any_host: allow_remote,
            slow,
            readers,
        };
        let runtime =
            Builder::new_current_thread().enable_all().max_blocking_threads(1).build().map_err(start)?;
        let teller = news.clone();
        let thread = std::thread::Builder::new()
            .name("serve".into())
            .spawn(move || work(runtime, listener, desk, &teller, stopped))
            .map_err(start)?;
        Ok(Self { console, address: own, news, stop, thread: Some(thread) })
    }

    /// Where it can be seen.
    #[must_use]
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// The run that it shows begins.
    pub fn watch(&self, watched: &Watched) {
        self.console.begin(watched);
        tell(&self.console, &self.news);
    }

    /// Whether metrics were read since the run failed.
    #[must_use]
    pub fn is_failure_told(&self) -> bool {
        self.console.failure_told.load(std::sync::atomic::Ordering::Relaxed)
    }

    /// The run has ended: `cancelled` early, or with an `error`.
    pub fn conclude(&self, error: Option<String>, cancelled: bool) {
        // What happened before the end stands before it in the log.
        tell(&self.console, &self.news);
        self.console.end(error, cancelled);
        tell(&self.console, &self.news);
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stop.send_replace(true);
        if let Some(thread) = self.thread.take() {
            // It panics only through a bug, which has been reported.
            let _ = thread.join();
        }
    }
}

/// Looks at the run, and passes the status on to those who are connected.
fn tell(console: &Console, news: &watch::Sender<Arc<str>>) {
    let status = console.look();
    // A status of plain numbers and texts can always be written.
    let text = serde_json::to_string(&status).unwrap_or_default();
    news.send_replace(text.into());
}

fn work(
    runtime: Runtime,
    listener: TcpListener,
    desk: PageState,
    news: &watch::Sender<Arc<str>>,
    mut stopped: watch::Receiver<bool>,
) {
    let console = Arc::clone(&desk.console);
    runtime.block_on(async {
        let accepting = tokio::spawn(accept(listener, router(desk), Arc::clone(&console), stopped.clone()));
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        loop {
            tokio::select! {
                _ = stopped.changed() => break,
                _ = ticks.tick() => tell(&console, news),
            }
        }
        accepting.abort();
        if console.visitors.open.load(std::sync::atomic::Ordering::Relaxed) > 0 {
            sleep(LAST_WORDS).await;
        }
    });
    // A picture that is being drawn is not waited for.
    runtime.shutdown_background();
}
