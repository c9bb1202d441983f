//! Reports on what came over a socket: from whom, how much, and how it ended.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::downlink::receive::Listing;
use crate::downlink::receive::ReceptionCounters;
use crate::downlink::transport::packet_archive::PacketArchive;
use crate::downlink::wire::Format;

/// Begins an answer after which a sender may try again.
pub(super) const BUSY: &str = "busy: ";

/// Begins an answer after which it is of no use to try again.
pub(super) const CLOSED: &str = "closed ";

/// How a connection ended.
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
    /// No sound packet or frame for `idle_s_max`.
    Idle,
    /// No sound packet or frame in `garbage_bytes_max` bytes.
    Garbage,
    /// More than `memory_bytes_max` of incomplete data.
    Memory,
    /// A description of another instrument than the ground's.
    OtherInstrument,
    /// A description of an instrument of which the ground can make no maps.
    UnfitInstrument,
    /// The ground knows no instrument, and this one came without visibilities and their positions.
    Unconfirmed,
    /// It asked to be told what checkpoints hold, and the ground has no state.
    NoState,
    /// It did not begin with a token.
    NoToken,
    /// It began with a token that no station has.
    UnknownToken,
    /// Its packets could not be written into the raw archive.
    NotOnDisk,
    /// All places were taken, and it was the least useful.
    GaveWay,
    /// Its receiver failed: a bug in the program.
    Failed,
}

impl ConnectionEnd {
    /// All of them.
    pub const ALL: [Self; 16] = [
        Self::Whole,
        Self::Broken,
        Self::Stopped,
        Self::FirstPacket,
        Self::Idle,
        Self::Garbage,
        Self::Memory,
        Self::OtherInstrument,
        Self::UnfitInstrument,
        Self::Unconfirmed,
        Self::NoState,
        Self::NoToken,
        Self::UnknownToken,
        Self::NotOnDisk,
        Self::GaveWay,
        Self::Failed,
    ];
}

impl fmt::Display for ConnectionEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Whole => "the sender closed it",
            Self::Broken => "the connection broke",
            Self::Stopped => "the ground ended its run",
            Self::FirstPacket => "no sound packet within downlink.listen.first_packet_s_max",
            Self::Idle => "no sound packet for downlink.listen.idle_s_max",
            Self::Garbage => "no sound packet in downlink.listen.garbage_bytes_max",
            Self::Memory => "more incomplete data than downlink.listen.memory_bytes_max",
            Self::OtherInstrument => "packets of another instrument than the ground's",
            Self::UnfitInstrument => "an instrument that does not fit the ground's configuration",
            Self::Unconfirmed => {
                "no visibilities with positions confirmed its instrument, and the ground knows none"
            }
            Self::NoState => {
                "it asks for `held`, and the ground has no checkpoints; expected a ground with --state"
            }
            Self::NoToken => "it did not begin with `token TOKEN`, and the ground has --stations",
            Self::UnknownToken => "no station has its token",
            Self::NotOnDisk => "its packets could not be written into the archive; it has to send them again",
            Self::GaveWay => "it gave way to another; all downlink.listen.connections_max were taken",
            Self::Failed => "its receiver failed, which is a bug in the program",
        })
    }
}

/// One connection.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SenderReport {
    /// Its address.
    pub peer: String,
    /// The station whose token it gave.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub station: Option<String>,
    /// Format of its stream, if it was detected.
    pub format: Option<Format>,
    /// Bytes read.
    pub bytes: u64,
    /// Sound packets passed to the ground.
    pub packets: u64,
    /// How it ended.
    pub ended: ConnectionEnd,
}

/// Something that happened to a connection, told when it happens. As a value it has the field `event`.
#[derive(Debug, Serialize)]
pub struct ListenNote<'a> {
    /// What it was.
    #[serde(flatten)]
    pub(super) what: ListenEvent<'a>,
    /// Notes before it that were not told, as there were too many.
    #[serde(skip_serializing_if = "is_zero")]
    pub(super) untold: u64,
}

#[derive(Debug, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub(super) enum ListenEvent<'a> {
    /// It ended.
    Sender(&'a SenderReport),
    /// It found no place.
    SenderRefused { peer: String },
    /// It could not be accepted.
    AcceptFailed { reason: String },
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks so")]
fn is_zero(count: &u64) -> bool {
    *count == 0
}

impl ListenNote<'_> {
    /// Whether it is the regular end of a connection.
    #[must_use]
    pub fn is_regular(&self) -> bool {
        matches!(self.what, ListenEvent::Sender(SenderReport { ended: ConnectionEnd::Whole, .. }))
    }
}

impl fmt::Display for ListenNote<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.what {
            ListenEvent::Sender(SenderReport { peer, station, bytes, packets, ended, .. }) => {
                let station = station.iter().map(|name| format!(" ({name})")).collect::<String>();
                write!(f, "{peer}{station}: {bytes} bytes, {packets} packets; {ended}")
            }
            ListenEvent::SenderRefused { peer } => {
                write!(f, "{peer}: refused; there are downlink.listen.connections_max others")
            }
            ListenEvent::AcceptFailed { reason } => write!(f, "cannot accept a connection: {reason}"),
        }?;
        match self.untold {
            0 => Ok(()),
            untold => write!(f, " ({untold} notes before it are only in the summary)"),
        }
    }
}

/// What came from a station.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct StationCounts {
    /// Its connections that have ended.
    pub connections: u64,
    /// Bytes read, also from those that are open.
    pub bytes: u64,
    /// Sound packets passed to the ground by those that have ended.
    pub packets: u64,
    /// When a sound packet or frame came last.
    #[serde(skip)]
    pub heard: Option<Instant>,
}

/// What came in datagrams.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct DatagramReport {
    /// Address on which the ground listens.
    pub address: String,
    /// Datagrams received.
    pub received: u64,
    /// Bytes in them.
    pub bytes: u64,
    /// Sound packets passed to the ground.
    pub packets: u64,
    /// Datagrams without a sound packet or frame.
    pub malformed: u64,
    /// Datagrams of another instrument than the ground's.
    pub refused: u64,
    /// Datagrams that the system dropped because they came faster than they were read; `None` if it does not say.
    pub dropped_by_system: Option<u64>,
}

/// All connections of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ListenReport {
    /// Address on which the ground listened.
    pub address: String,
    /// Accepted connections.
    pub connections: u64,
    /// Connections refused because `connections_max` were open, all of them useful.
    pub refused: u64,
    /// Bytes read.
    pub bytes: u64,
    /// Sound packets passed to the ground.
    pub packets: u64,
    /// Sound packets refused because their connection described another instrument.
    pub packets_refused: u64,
    /// Largest backlog of packets, bytes.
    pub backlog_bytes_max: u64,
    /// Connections by end.
    pub ended: BTreeMap<ConnectionEnd, u64>,
    /// What came in datagrams, if the ground listens for them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub datagrams: Option<DatagramReport>,
    /// What came from each station that is known by its token.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub stations: BTreeMap<String, StationCounts>,
    /// The first connections.
    pub senders: Listing<SenderReport>,
    /// Counters of everything in the streams but packets.
    #[serde(skip)]
    pub(super) streams: ReceptionCounters,
}

impl ListenReport {
    /// Adds what the pipeline has not seen to the counters of a reception: everything but packets.
    pub fn complete(&self, reception: &mut ReceptionCounters) {
        reception.add_stream(&self.streams);
    }

    /// Stations that may send.
    pub(super) fn know<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        self.stations.extend(names.map(|name| (name.to_owned(), StationCounts::default())));
    }

    /// Counts bytes from a station; `is_sound` if there was a sound packet or frame among them.
    pub(super) fn hear(&mut self, station: &str, bytes: u64, is_sound: bool) {
        if !self.stations.contains_key(station) {
            self.stations.insert(station.to_owned(), StationCounts::default());
        }
        if let Some(counts) = self.stations.get_mut(station) {
            counts.bytes += bytes;
            counts.heard = if is_sound { Some(Instant::now()) } else { counts.heard };
        }
    }

    pub(super) fn close(&mut self, report: SenderReport, refused: u64, stream: &ReceptionCounters) {
        self.bytes += report.bytes;
        self.packets += report.packets;
        self.packets_refused += refused;
        if let Some(counts) = report.station.as_ref().and_then(|name| self.stations.get_mut(name)) {
            counts.connections += 1;
            counts.packets += report.packets;
        }
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
             {packets_refused} refused; backlog at most {} bytes",
            self.backlog_bytes_max
        )?;
        if let Some(DatagramReport {
            address,
            received,
            packets,
            malformed,
            refused,
            dropped_by_system,
            ..
        }) = &self.datagrams
        {
            let dropped = dropped_by_system.map_or("unknown".to_owned(), |count| count.to_string());
            write!(
                f,
                "\n  {address}: {received} datagrams, {packets} packets; {malformed} malformed, {refused} refused, {dropped} dropped \
                 by the system"
            )?;
        }
        for (ended, count) in &self.ended {
            write!(f, "\n  {count:>6}  {ended}")?;
        }
        for (name, StationCounts { connections, bytes, packets, .. }) in &self.stations {
            write!(f, "\n  {name}: {connections} connections, {bytes} bytes, {packets} packets")?;
        }
        Ok(())
    }
}

/// Live status of a listening ground.
#[derive(Debug, Default)]
pub struct ListenStatus {
    pub(super) open: AtomicUsize,
    pub(super) bytes: AtomicU64,
    pub(super) backlog_bytes: AtomicU64,
    /// Connections that wait for room in the backlog.
    pub(super) waiting: AtomicUsize,
    /// Ended connections that delivered packets.
    pub(super) done: AtomicU64,
    /// When the last sound packet or frame arrived.
    heard: Mutex<Option<Instant>>,
}

impl ListenStatus {
    /// Open connections.
    #[must_use]
    pub fn open(&self) -> usize {
        self.open.load(Ordering::Relaxed)
    }

    /// Bytes read so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Time since the last sound packet or frame from anyone; `None` before the first.
    #[must_use]
    pub fn silence(&self) -> Option<Duration> {
        self.heard.lock().unwrap_or_else(PoisonError::into_inner).map(|heard| heard.elapsed())
    }

    /// A sound packet or frame has arrived.
    pub(super) fn note_heard(&self) {
        *self.heard.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
    }

    /// Marks the backlog as empty.
    pub(super) fn clear_backlog(&self) {
        self.backlog_bytes.store(0, Ordering::Relaxed);
    }

    /// Backlog of packets at the last addition, bytes.
    #[must_use]
    pub fn backlog_bytes(&self) -> u64 {
        self.backlog_bytes.load(Ordering::Relaxed)
    }
}

/// Status and report, shared between threads.
#[derive(Clone, Debug, Default)]
pub struct Listening {
    /// Live status.
    pub status: Arc<ListenStatus>,
    /// Where packets are kept before they are taken, if they are.
    pub archive: Option<PacketArchive>,
    report: Arc<Mutex<ListenReport>>,
}

impl Listening {
    /// The report on the connections that have ended.
    #[must_use]
    pub fn report(&self) -> ListenReport {
        self.write().clone()
    }

    pub(super) fn write(&self) -> MutexGuard<'_, ListenReport> {
        self.report.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
