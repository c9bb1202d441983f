//! The state that all connections of the listening thread share.

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
use super::instrument_filter::SharedReception;
use super::report::{BUSY, ListenEvent, ListenNote, Listening};
use super::slots::ConnectionSlots;
use super::stations::Stations;
use crate::downlink::config::ListenConfig;
use crate::downlink::transport::packet_archive::{PacketArchive, Ticket};

/// Maximum number of notes in a burst; the mean rate is one per second.
const NOTES_BURST: f64 = 20.0;

/// A function that receives notes about connections.
pub type NoteHandler = Box<dyn Fn(&ListenNote<'_>) + Send + Sync>;

/// When listening ends before the run does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ListenLimits {
    /// Time without a valid packet or frame from any sender, s; 0 for no limit.
    pub idle_s: f64,
    /// Number of ended connections that delivered packets; 0 for no limit.
    pub connections: u64,
}

/// Packets on their way to the ground, and the space that they occupy in the backlog.
pub(super) struct PacketBatch {
    pub(super) bytes: Vec<u8>,
    pub(super) space: OwnedSemaphorePermit,
    /// When their last bytes were read.
    pub(super) arrived: std::time::Instant,
}

pub(super) struct ForwardedBatch {
    /// Number of bytes in all batches up to the end of this one.
    pub(super) mark: u64,
    /// Ticket for its packets, which must be on disk, or why they cannot be written; `None` without an archive.
    pub(super) ticket: Result<Option<Ticket>, String>,
}

pub(super) struct ListenContext {
    pub(super) config: ListenConfig,
    pub(super) until: ListenLimits,
    pub(super) reception: SharedReception,
    pub(super) listening: Listening,
    pub(super) slots: ConnectionSlots,
    /// Free space of the backlog, bytes.
    pub(super) backlog: Arc<Semaphore>,
    pub(super) batches: Sender<PacketBatch>,
    /// Number of bytes in all batches so far; locked while a batch is sent, so that batches are counted in order.
    pub(super) forwarded: Mutex<u64>,
    /// Answers senders that wait for a checkpoint; `None` without checkpoints.
    pub(super) held: Option<HeldAnswers>,
    /// Keeps packets on disk before they are acknowledged; `None` if they are not kept.
    pub(super) archive: Option<PacketArchive>,
    /// The stations that may send; `None` if every sender may.
    pub(super) stations: Option<Arc<Stations>>,
    /// True once reading must stop.
    pub(super) stop: Arc<watch::Sender<bool>>,
    pub(super) notes: Notes,
    /// When the last valid packet or frame arrived from any sender.
    pub(super) last_activity: Mutex<Instant>,
}

impl ListenContext {
    pub(super) fn backlog_capacity(config: &ListenConfig) -> usize {
        (config.backlog_bytes_max as usize).min(Semaphore::MAX_PERMITS)
    }

    /// Appends a batch to the archive, if there is one, and forwards it even if it could not be written. `None` if the ground
    /// accepts no more batches.
    pub(super) fn forward(&self, batch: PacketBatch) -> Option<ForwardedBatch> {
        let mut forwarded = self.forwarded.lock().unwrap_or_else(PoisonError::into_inner);
        *forwarded += batch.bytes.len() as u64;
        let mark = *forwarded;
        let ticket = self.archive.as_ref().map(|archive| archive.append(&batch.bytes, mark));
        self.batches.send(batch).ok().map(|()| ForwardedBatch { mark, ticket: ticket.transpose() })
    }

    pub(super) fn record_activity(&self) {
        *self.last_activity.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    }

    /// Waits until reading must stop.
    pub(super) async fn stopped(&self) {
        // An error means that the other end is gone, so reading must stop too.
        let _ = self.stop.subscribe().wait_for(|stop| *stop).await;
    }

    pub(super) fn is_over(&self) -> bool {
        let status = &self.listening.status;
        let ListenLimits { idle_s, connections } = self.until;
        if connections > 0 && status.done.load(Ordering::Relaxed) >= connections {
            return true;
        }
        if status.waiting.load(Ordering::Relaxed) > 0 {
            // The senders are not idle, as they wait for the ground.
            self.record_activity();
        }
        let last_activity = *self.last_activity.lock().unwrap_or_else(PoisonError::into_inner);
        idle_s > 0.0 && last_activity.elapsed().as_secs_f64() > idle_s
    }

    pub(super) fn refuse(&self, stream: &TcpStream, peer: SocketAddr) {
        self.listening.write().refused += 1;
        // A sender need not read the answer.
        let _ = stream.try_write(
            format!("{BUSY}downlink.listen.connections_max other connections are open\n").as_bytes(),
        );
        self.notes.report(ListenEvent::SenderRefused { peer: peer.to_string() });
    }
}

/// Which of two futures completed first.
pub(super) enum Race<A, B> {
    A(A),
    B(B),
}

/// Waits for the first of two futures; drops the other.
pub(super) async fn race<A, B>(a: impl Future<Output = A>, b: impl Future<Output = B>) -> Race<A, B> {
    let (mut a, mut b) = (pin!(a), pin!(b));
    std::future::poll_fn(|context| match a.as_mut().poll(context) {
        Poll::Ready(output) => Poll::Ready(Race::A(output)),
        Poll::Pending => b.as_mut().poll(context).map(Race::B),
    })
    .await
}

/// Reports events at a limited rate, so that people can read them.
pub(super) struct Notes {
    handler: NoteHandler,
    budget: Mutex<NoteBudget>,
}

struct NoteBudget {
    allowed: f64,
    updated: Instant,
    /// Number of notes suppressed since the last report.
    suppressed: u64,
}

impl Notes {
    pub(super) fn new(handler: NoteHandler) -> Self {
        let budget = NoteBudget { allowed: NOTES_BURST, updated: Instant::now(), suppressed: 0 };
        Self { handler, budget: Mutex::new(budget) }
    }

    pub(super) fn report(&self, event: ListenEvent<'_>) {
        let mut budget = self.budget.lock().unwrap_or_else(PoisonError::into_inner);
        budget.allowed = (budget.allowed + budget.updated.elapsed().as_secs_f64()).min(NOTES_BURST);
        budget.updated = Instant::now();
        if budget.allowed < 1.0 {
            budget.suppressed += 1;
            return;
        }
        budget.allowed -= 1.0;
        (self.handler)(&ListenNote { event, untold: std::mem::take(&mut budget.suppressed) });
    }
}
