//! What came over a socket, from whom, and how it ended.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use serde::Serialize;

use crate::downlink::receive::Listing;
use crate::downlink::receive::ReceptionCounters;
use crate::downlink::wire::Format;

/// How a connection has ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ConnectionEnd {
    /// The sender closed it.
    Whole,
    /// It broke.
    Broken,
    /// The ground ended its run.
    Stopped,
    /// No sound packet or frame within `first_packet_s_max`.
    FirstPacket,
    /// None for `idle_s_max`.
    Idle,
    /// None among `garbage_bytes_max` bytes.
    Garbage,
    /// More than `memory_bytes_max` in hand.
    Memory,
    /// The description of another instrument than the one that the ground knows.
    OtherInstrument,
    /// Its receiver failed: a bug of the program.
    Failed,
}

impl fmt::Display for ConnectionEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Whole => "the sender closed it",
            Self::Broken => "the connection broke",
            Self::Stopped => "the ground has ended its run",
            Self::FirstPacket => "no sound packet within downlink.listen.first_packet_s_max",
            Self::Idle => "no sound packet for downlink.listen.idle_s_max",
            Self::Garbage => "no sound packet in downlink.listen.garbage_bytes_max",
            Self::Memory => "more unfinished than downlink.listen.memory_bytes_max",
            Self::OtherInstrument => "packets of another instrument than the ground's",
            Self::Failed => "its receiver failed, which is a bug of the program",
        })
    }
}

/// One connection.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SenderReport {
    /// Its address.
    pub peer: String,
    /// Format of its stream, if it was found out.
    pub format: Option<Format>,
    /// Bytes read.
    pub bytes: u64,
    /// Sound packets handed to the ground.
    pub packets: u64,
    /// How it ended.
    pub ended: ConnectionEnd,
}

/// All connections of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ListenReport {
    /// Where the ground listened.
    pub address: String,
    /// Connections taken.
    pub connections: u64,
    /// Connections refused because there were `connections_max`.
    pub refused: u64,
    /// Bytes read.
    pub bytes: u64,
    /// Sound packets handed to the ground.
    pub packets: u64,
    /// Sound packets that were not, of connections that were closed for their instrument.
    pub packets_refused: u64,
    /// Most bytes of packets that waited for the ground.
    pub backlog_bytes_max: u64,
    /// Connections by how they ended.
    pub ended: BTreeMap<ConnectionEnd, u64>,
    /// The first of them.
    pub senders: Listing<SenderReport>,
    /// What else than packets was in the streams; of packets, nothing.
    #[serde(skip)]
    pub(super) streams: ReceptionCounters,
}

impl ListenReport {
    /// Adds to the account of a reception what its chain has not seen: all but the packets.
    pub fn complete(&self, reception: &mut ReceptionCounters) {
        reception.add_stream(&self.streams);
    }

    pub(super) fn close(&mut self, report: SenderReport, refused: u64, stream: &ReceptionCounters) {
        self.bytes += report.bytes;
        self.packets += report.packets;
        self.packets_refused += refused;
        *self.ended.entry(report.ended).or_default() += 1;
        self.senders.push(report);
        self.streams.add_stream(stream);
    }
}

impl fmt::Display for ListenReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { address, connections, refused, bytes, packets, packets_refused, .. } = self;
        write!(
            f,
            "{address}: {connections} connections, {refused} refused; {bytes} bytes, {packets} packets, \
             {packets_refused} refused; at most {} bytes waited",
            self.backlog_bytes_max
        )?;
        for (ended, count) in &self.ended {
            write!(f, "\n  {count:>6}  {ended}")?;
        }
        Ok(())
    }
}

/// What can be seen while a ground listens.
#[derive(Debug, Default)]
pub struct ListenStatus {
    pub(super) open: AtomicUsize,
    pub(super) bytes: AtomicU64,
    pub(super) backlog_bytes: AtomicU64,
    /// Connections that wait for room.
    pub(super) waiting: AtomicUsize,
    /// Connections that gave packets and have ended.
    pub(super) done: AtomicU64,
}

impl ListenStatus {
    /// Connections that are open.
    #[must_use]
    pub fn open(&self) -> usize {
        self.open.load(Ordering::Relaxed)
    }

    /// Bytes read so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Says that nothing waits.
    pub(super) fn clear_backlog(&self) {
        self.backlog_bytes.store(0, Ordering::Relaxed);
    }

    /// Bytes of packets that wait for the ground, when some were added last.
    #[must_use]
    pub fn backlog_bytes(&self) -> u64 {
        self.backlog_bytes.load(Ordering::Relaxed)
    }
}

/// Both, shared.
#[derive(Clone, Debug, Default)]
pub struct Listening {
    /// For looking at on the way.
    pub status: Arc<ListenStatus>,
    account: Arc<Mutex<ListenReport>>,
}

impl Listening {
    /// The account of the connections that have ended.
    #[must_use]
    pub fn report(&self) -> ListenReport {
        self.write().clone()
    }

    pub(super) fn write(&self) -> MutexGuard<'_, ListenReport> {
        self.account.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
