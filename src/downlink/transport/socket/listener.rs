//! The thread that listens: takes connections, and knows when it is enough.

use std::net::SocketAddr;
use std::pin::pin;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::Poll;
use std::time::Duration;

use crossbeam_channel::Sender;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, timeout};

use super::config::ListenConfig;
use super::connection::serve;
use super::report::Listening;
use super::sender_intake::Mission;

/// Between two looks at whether it is enough.
const TICK: Duration = Duration::from_millis(50);

/// Notes that may be said at once; later one a second.
const NOTES_AT_ONCE: f64 = 20.0;

/// Whom to tell what becomes of connections.
pub type Teller = Box<dyn Fn(&str) + Send + Sync>;

/// When a ground has listened long enough, besides when its run is ended.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Until {
    /// After so many seconds without a sound packet or frame of anyone; 0 for never.
    pub idle_s: f64,
    /// After so many connections that gave packets have ended; 0 for never.
    pub connections: u64,
}

/// Packets for the ground, and the room that they take until it has them.
pub(super) struct PacketBatch {
    pub(super) bytes: Vec<u8>,
    pub(super) room: OwnedSemaphorePermit,
}

/// What all connections share.
pub(super) struct ListenContext {
    pub(super) config: ListenConfig,
    pub(super) until: Until,
    pub(super) mission: Mission,
    pub(super) listening: Listening,
    pub(super) room: Arc<Semaphore>,
    pub(super) deliveries: Sender<PacketBatch>,
    /// True once nothing more is to be read.
    pub(super) stop: Arc<watch::Sender<bool>>,
    pub(super) notes: Notes,
    /// When a sound packet or frame came last, of anyone.
    pub(super) sign: Mutex<Instant>,
}

impl ListenContext {
    /// Room for all packets that may wait.
    pub(super) fn room_bytes(config: &ListenConfig) -> usize {
        (config.backlog_bytes_max as usize).min(Semaphore::MAX_PERMITS)
    }

    pub(super) fn note_sign(&self) {
        *self.sign.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }

    /// Waits until nothing more is to be read.
    pub(super) async fn stopped(&self) {
        // An error says that the other end is gone, which is the same.
        let _ = self.stop.subscribe().wait_for(|stop| *stop).await;
    }

    fn is_over(&self) -> bool {
        let status = &self.listening.status;
        let Until { idle_s, connections } = self.until;
        if connections > 0 && status.done.load(Ordering::Relaxed) >= connections {
            return true;
        }
        if status.waiting.load(Ordering::Relaxed) > 0 {
            // It is the ground that takes its time.
            self.note_sign();
        }
        let sign = *self.sign.lock().unwrap_or_else(PoisonError::into_inner);
        idle_s > 0.0 && sign.elapsed().as_secs_f64() > idle_s
    }

    fn refuse(&self, stream: &TcpStream, peer: SocketAddr) {
        self.listening.write().refused += 1;
        // Whether it is heard is no concern of ours.
        let _ = stream.try_write(b"closed: there are downlink.listen.connections_max others\n");
        self.notes.say(&format!("{peer}: refused; there are downlink.listen.connections_max others"));
    }
}

/// Listens until it is over, then until all connections have ended.
pub(super) async fn listen(listener: TcpListener, shared: Arc<ListenContext>) {
    let mut connections = JoinSet::new();
    shared.note_sign();
    while !shared.is_over() {
        while connections.try_join_next().is_some() {}
        match first(shared.stopped(), timeout(TICK, listener.accept())).await {
            First::A(()) => break,
            First::B(Err(_)) => {}
            First::B(Ok(Ok((stream, peer)))) => {
                if connections.len() >= shared.config.connections_max {
                    shared.refuse(&stream, peer);
                } else {
                    connections.spawn(serve(stream, peer, Arc::clone(&shared)));
                }
            }
            // No more files may be open, or the peer has gone already: others may come.
            First::B(Ok(Err(error))) => {
                shared.notes.say(&format!("a connection could not be taken: {error}"));
                sleep(TICK).await;
            }
        }
    }
    drop(listener);
    shared.stop.send_replace(true);
    while connections.join_next().await.is_some() {}
}

/// What ended first.
pub(super) enum First<A, B> {
    A(A),
    B(B),
}

/// Waits for the first of two to end; drops the other.
pub(super) async fn first<A, B>(a: impl Future<Output = A>, b: impl Future<Output = B>) -> First<A, B> {
    let (mut a, mut b) = (pin!(a), pin!(b));
    std::future::poll_fn(|context| match a.as_mut().poll(context) {
        Poll::Ready(found) => Poll::Ready(First::A(found)),
        Poll::Pending => b.as_mut().poll(context).map(First::B),
    })
    .await
}

/// Says what happens, but not faster than can be read.
pub(super) struct Notes {
    tell: Teller,
    /// Notes that may be said, as of when; and those that were not.
    budget: Mutex<(f64, Instant, u64)>,
}

impl Notes {
    pub(super) fn new(tell: Teller) -> Self {
        Self { tell, budget: Mutex::new((NOTES_AT_ONCE, Instant::now(), 0)) }
    }

    pub(super) fn say(&self, note: &str) {
        let mut budget = self.budget.lock().unwrap_or_else(PoisonError::into_inner);
        let (left, since, unsaid) = &mut *budget;
        *left = (*left + since.elapsed().as_secs_f64()).min(NOTES_AT_ONCE);
        *since = Instant::now();
        if *left < 1.0 {
            *unsaid += 1;
            return;
        }
        *left -= 1.0;
        match std::mem::take(unsaid) {
            0 => (self.tell)(note),
            unsaid => (self.tell)(&format!("{note} ({unsaid} notes before it are only in the summary)")),
        }
    }
}
