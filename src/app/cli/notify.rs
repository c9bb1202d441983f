//! Notifies systemd of the state of a ground segment that runs as a service (`Type=notify`): ready, status, watchdog, stopping.
//!
//! A message is a datagram of lines `KEY=VALUE` to the socket that `NOTIFY_SOCKET` names (sd_notify(3)). Without the variable nothing
//! is sent; failures to send are ignored.

use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::pipeline::RunView;
use crate::runtime::Cancel;

/// Interval of checks for cancellation.
const POLL: Duration = Duration::from_millis(100);

const STATUS_EVERY: Duration = Duration::from_secs(2);

const STOPPING: &str = "STOPPING=1\nSTATUS=saving what was received";

/// Sends notifications until dropped.
pub(super) struct Notifier {
    stop: Sender<()>,
    thread: Option<JoinHandle<()>>,
}

impl Notifier {
    /// Reports that the ground segment is ready, and starts to send its status; `None` without a supervisor.
    pub(super) fn start(view: &RunView, cancel: &Cancel) -> Option<Self> {
        let supervisor = Supervisor::from_environment()?;
        supervisor.send(&format!("READY=1\nSTATUS={}", status_line(view)));
        let (stop, stopped) = channel();
        let (view, cancel) = (view.clone(), cancel.clone());
        let thread = std::thread::spawn(move || {
            let (mut alive, mut shown, mut is_ending) = (Instant::now(), Instant::now(), false);
            while matches!(stopped.recv_timeout(POLL), Err(RecvTimeoutError::Timeout)) {
                if !is_ending && cancel.is_cancelled() {
                    supervisor.send(STOPPING);
                    is_ending = true;
                }
                if supervisor.watchdog_every.is_some_and(|every| alive.elapsed() >= every) {
                    supervisor.send("WATCHDOG=1");
                    alive = Instant::now();
                }
                if !is_ending && shown.elapsed() >= STATUS_EVERY {
                    supervisor.send(&format!("STATUS={}", status_line(&view)));
                    shown = Instant::now();
                }
            }
            // The run may have ended between two checks.
            if !is_ending {
                supervisor.send(STOPPING);
            }
        });
        Some(Self { stop, thread: Some(thread) })
    }
}

impl Drop for Notifier {
    fn drop(&mut self) {
        let _ = self.stop.send(());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Supervisor {
    socket: UnixDatagram,
    address: SocketAddr,
    /// Interval of watchdog messages: half of the supervisor's timeout.
    watchdog_every: Option<Duration>,
}

impl Supervisor {
    fn from_environment() -> Option<Self> {
        let name = std::env::var("NOTIFY_SOCKET").ok()?;
        let number = |name: &str| std::env::var(name).ok()?.parse::<u64>().ok();
        let is_ours = number("WATCHDOG_PID").is_none_or(|process| process == u64::from(std::process::id()));
        let timeout =
            number("WATCHDOG_USEC").filter(|&timeout| is_ours && timeout > 0).map(Duration::from_micros);
        let (socket, address) = (UnixDatagram::unbound().ok()?, socket_address(&name)?);
        socket.set_nonblocking(true).ok()?;
        Some(Self { socket, address, watchdog_every: timeout.map(|timeout| timeout / 2) })
    }

    fn send(&self, message: &str) {
        let _ = self.socket.send_to_addr(message.as_bytes(), &self.address);
    }
}

/// Address of a socket: a path, or `@` and a name in Linux's abstract namespace.
fn socket_address(name: &str) -> Option<SocketAddr> {
    match name.strip_prefix('@') {
        #[cfg(target_os = "linux")]
        Some(name) => {
            use std::os::linux::net::SocketAddrExt;
            SocketAddr::from_abstract_name(name).ok()
        }
        #[cfg(not(target_os = "linux"))]
        Some(_) => None,
        None => SocketAddr::from_pathname(name).ok(),
    }
}

fn status_line(view: &RunView) -> String {
    let mut parts = Vec::new();
    if let Some(listening) = &view.listening {
        parts.push(format!("{} senders connected", listening.status.open()));
    }
    for stage in view.stages() {
        let verbs = [("ground", "received"), ("publish", "published")];
        if let Some((_, verb)) = verbs.iter().find(|(name, _)| *name == stage.name) {
            parts.push(format!("{} {} {verb}", stage.units.count, stage.units.name));
        }
    }
    if let Some(saving) = view.saving() {
        parts.push(match saving.unsaved {
            Some(_) => saving.to_string(),
            None => format!("{} checkpoints", saving.written),
        });
    }
    // A line break would begin another message.
    parts.join(", ").replace('\n', " ")
}
