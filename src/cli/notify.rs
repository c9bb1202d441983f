//! Tells systemd how a ground is that runs as its service (`Type=notify`): ready, at work, alive, ending.
//!
//! A message is a datagram of lines `KEY=VALUE` to the socket that `NOTIFY_SOCKET` names (sd_notify(3)). Without the variable nothing
//! is sent; a message that cannot be sent is of no consequence.

use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use crate::pipeline::Watched;
use crate::runtime::Cancel;

/// Interval of looking for an interrupt.
const POLL: Duration = Duration::from_millis(100);

/// Least time between two texts of how it goes.
const STATUS_EVERY: Duration = Duration::from_secs(2);

const STOPPING: &str = "STOPPING=1\nSTATUS=saving what was received";

/// Tells until dropped.
pub(super) struct Notifier {
    stop: Sender<()>,
    thread: Option<JoinHandle<()>>,
}

impl Notifier {
    /// Says that the ground is ready, and goes on telling how it goes; `None` if nobody asked for it.
    pub(super) fn start(watched: &Watched, cancel: &Cancel) -> Option<Self> {
        let supervisor = Supervisor::of_environment()?;
        supervisor.tell(&format!("READY=1\nSTATUS={}", status_of(watched)));
        let (stop, stopped) = channel();
        let (watched, cancel) = (watched.clone(), cancel.clone());
        let thread = std::thread::spawn(move || {
            let (mut alive, mut shown, mut is_ending) = (Instant::now(), Instant::now(), false);
            while matches!(stopped.recv_timeout(POLL), Err(RecvTimeoutError::Timeout)) {
                if !is_ending && cancel.is_cancelled() {
                    supervisor.tell(STOPPING);
                    is_ending = true;
                }
                if supervisor.alive_every.is_some_and(|every| alive.elapsed() >= every) {
                    supervisor.tell("WATCHDOG=1");
                    alive = Instant::now();
                }
                if !is_ending && shown.elapsed() >= STATUS_EVERY {
                    supervisor.tell(&format!("STATUS={}", status_of(&watched)));
                    shown = Instant::now();
                }
            }
            // It may have ended between two looks.
            if !is_ending {
                supervisor.tell(STOPPING);
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

/// Where to tell.
struct Supervisor {
    socket: UnixDatagram,
    address: SocketAddr,
    /// Interval of signs of life: half of what the supervisor waits.
    alive_every: Option<Duration>,
}

impl Supervisor {
    fn of_environment() -> Option<Self> {
        let name = std::env::var("NOTIFY_SOCKET").ok()?;
        let number = |name: &str| std::env::var(name).ok()?.parse::<u64>().ok();
        let is_ours = number("WATCHDOG_PID").is_none_or(|process| process == u64::from(std::process::id()));
        let wait = number("WATCHDOG_USEC").filter(|&wait| is_ours && wait > 0).map(Duration::from_micros);
        let (socket, address) = (UnixDatagram::unbound().ok()?, address_of(&name)?);
        socket.set_nonblocking(true).ok()?;
        Some(Self { socket, address, alive_every: wait.map(|wait| wait / 2) })
    }

    fn tell(&self, message: &str) {
        let _ = self.socket.send_to_addr(message.as_bytes(), &self.address);
    }
}

/// A path, or a name after `@` in the namespace of Linux that has no files.
fn address_of(name: &str) -> Option<SocketAddr> {
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

/// One line on how it goes.
fn status_of(watched: &Watched) -> String {
    let mut parts = Vec::new();
    if let Some(listening) = &watched.listening {
        parts.push(format!("{} senders connected", listening.status.open()));
    }
    for stage in watched.metrics.snapshot() {
        let wanted = [("ground", "received"), ("publish", "published")];
        if let Some((_, done)) = wanted.iter().find(|(name, _)| *name == stage.name) {
            parts.push(format!("{} {} {done}", stage.units.count, stage.units.name));
        }
    }
    if let Some(saving) = watched.ground.as_ref().and_then(|ground| ground.saving.report()) {
        parts.push(match saving.unsaved {
            Some(_) => saving.to_string(),
            None => format!("{} checkpoints", saving.written),
        });
    }
    // A line break would begin another message.
    parts.join(", ").replace('\n', " ")
}
