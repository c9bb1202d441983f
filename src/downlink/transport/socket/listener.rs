//! What all connections of the listening thread share.

use std::net::SocketAddr;
use std::pin::pin;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::Poll;

use crossbeam_channel::Sender;
use tokio::net::TcpStream;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};
use tokio::time::Instant;

use super::answers::HeldAnswers;
use super::config::ListenConfig;
use super::report::{BUSY, ListenEvent, ListenNote, Listening};
use super::seats::Seats;
use super::sender_intake::Mission;
use super::stations::Stations;
use crate::downlink::transport::packet_archive::{PacketArchive, Ticket};

/// Number of notes allowed at once; after that one per second.
const NOTES_AT_ONCE: f64 = 20.0;

/// Receives notes about connections.
pub type NoteHandler = Box<dyn Fn(&ListenNote<'_>) + Send + Sync>;

/// When listening ends, apart from the end of the run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ListenLimits {
    /// After this time without a sound packet or frame from anyone, s; 0 for never.
    pub idle_s: f64,
    /// After this number of connections that delivered packets have ended; 0 for never.
    pub connections: u64,
}

/// Packets on their way to the ground, and the room that they occupy in the backlog.
pub(super) struct PacketBatch {
    pub(super) bytes: Vec<u8>,
    pub(super) room: OwnedSemaphorePermit,
    /// When their last bytes were read.
    pub(super) arrived: std::time::Instant,
}

/// What became of a batch that was passed on.
pub(super) struct PassedBatch {
    /// Bytes in all batches up to its end.
    pub(super) mark: u64,
    /// What has to reach the disk; why it cannot; or `None` without an archive.
    pub(super) ticket: Result<Option<Ticket>, String>,
}

/// What all connections share.
pub(super) struct ListenContext {
    pub(super) config: ListenConfig,
    pub(super) until: ListenLimits,
    pub(super) mission: Mission,
    pub(super) listening: Listening,
    pub(super) seats: Seats,
    pub(super) room: Arc<Semaphore>,
    pub(super) batches: Sender<PacketBatch>,
    /// Bytes in all batches so far; locked while one is sent, so that batches are counted in their order.
    pub(super) passed: Mutex<u64>,
    /// Who is told what checkpoints hold; `None` if there are none.
    pub(super) held: Option<HeldAnswers>,
    /// Where packets are kept before a sender is told that they are taken; `None` if they are not.
    pub(super) archive: Option<PacketArchive>,
    /// Who may send; `None` for everyone.
    pub(super) stations: Option<Arc<Stations>>,
    /// True once reading must stop.
    pub(super) stop: Arc<watch::Sender<bool>>,
    pub(super) notes: Notes,
    /// When the last sound packet or frame arrived, from anyone.
    pub(super) sign: Mutex<Instant>,
}

impl ListenContext {
    /// Size of the backlog, bytes.
    pub(super) fn room_bytes(config: &ListenConfig) -> usize {
        (config.backlog_bytes_max as usize).min(Semaphore::MAX_PERMITS)
    }

    /// Keeps a batch in the archive, if there is one, and passes it on, also if it could not be kept. `None` if nobody takes it.
    pub(super) fn pass(&self, batch: PacketBatch) -> Option<PassedBatch> {
        let mut passed = self.passed.lock().unwrap_or_else(PoisonError::into_inner);
        *passed += batch.bytes.len() as u64;
        let mark = *passed;
        let ticket = self.archive.as_ref().map(|archive| archive.append(&batch.bytes, mark));
        self.batches.send(batch).ok().map(|()| PassedBatch { mark, ticket: ticket.transpose() })
    }

    pub(super) fn note_sign(&self) {
        *self.sign.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }

    /// Waits until reading must stop.
    pub(super) async fn stopped(&self) {
        // An error means that the other end is gone, which is the same.
        let _ = self.stop.subscribe().wait_for(|stop| *stop).await;
    }

    pub(super) fn is_over(&self) -> bool {
        let status = &self.listening.status;
        let ListenLimits { idle_s, connections } = self.until;
        if connections > 0 && status.done.load(Ordering::Relaxed) >= connections {
            return true;
        }
        if status.waiting.load(Ordering::Relaxed) > 0 {
            // The ground is slow, not the senders.
            self.note_sign();
        }
        let sign = *self.sign.lock().unwrap_or_else(PoisonError::into_inner);
        idle_s > 0.0 && sign.elapsed().as_secs_f64() > idle_s
    }

    pub(super) fn refuse(&self, stream: &TcpStream, peer: SocketAddr) {
        self.listening.write().refused += 1;
        // A sender need not read the answer.
        let _ =
            stream.try_write(format!("{BUSY}there are downlink.listen.connections_max others\n").as_bytes());
        self.notes.say(ListenEvent::SenderRefused { peer: peer.to_string() });
    }
}

/// Which of two futures completed first.
pub(super) enum First<A, B> {
    A(A),
    B(B),
}

/// Waits for the first of two futures; drops the other.
pub(super) async fn first<A, B>(a: impl Future<Output = A>, b: impl Future<Output = B>) -> First<A, B> {
    let (mut a, mut b) = (pin!(a), pin!(b));
    std::future::poll_fn(|context| match a.as_mut().poll(context) {
        Poll::Ready(found) => Poll::Ready(First::A(found)),
        Poll::Pending => b.as_mut().poll(context).map(First::B),
    })
    .await
}

/// Reports events, but no faster than people can read.
pub(super) struct Notes {
    tell: NoteHandler,
    /// Notes allowed, as of when; and notes suppressed.
    budget: Mutex<(f64, Instant, u64)>,
}

impl Notes {
    pub(super) fn new(tell: NoteHandler) -> Self {
        Self { tell, budget: Mutex::new((NOTES_AT_ONCE, Instant::now(), 0)) }
    }

    pub(super) fn say(&self, what: ListenEvent<'_>) {
        let mut budget = self.budget.lock().unwrap_or_else(PoisonError::into_inner);
        let (left, since, unsaid) = &mut *budget;
        *left = (*left + since.elapsed().as_secs_f64()).min(NOTES_AT_ONCE);
        *since = Instant::now();
        if *left < 1.0 {
            *unsaid += 1;
            return;
        }
        *left -= 1.0;
        (self.tell)(&ListenNote { what, untold: std::mem::take(unsaid) });
    }
}
