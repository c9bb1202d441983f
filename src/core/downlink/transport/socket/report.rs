//! Reports on connections and datagrams: senders, amounts, and how connections ended.

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

/// Beginning of an answer after which a sender may try again.
pub(super) const BUSY: &str = "busy: ";

/// Beginning of an answer after which trying again is useless.
pub(super) const CLOSED: &str = "closed ";

/// How a connection ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum ConnectionEnd {
    /// The sender closed the connection.
    Whole,
    /// The connection broke.
    Broken,
    /// The ground ended its run.
    Stopped,
    /// No valid packet or frame came within `first_packet_s_max`.
    FirstPacket,
    /// No valid packet or frame came for `idle_s_max`.
    Idle,
    /// No valid packet or frame came in `garbage_bytes_max` bytes.
    Garbage,
    /// The incomplete data exceeded `memory_bytes_max`.
    Memory,
    /// The sender described another instrument than the ground's.
    OtherInstrument,
    /// The sender described an instrument that the ground cannot map.
    UnfitInstrument,
    /// The ground had no instrument, and no visibilities with positions confirmed the sender's.
    Unconfirmed,
    /// The sender requested `held`, and the ground has no checkpoints.
    NoState,
    /// The connection did not begin with a token.
    NoToken,
    /// The connection began with a token that no station has.
    UnknownToken,
    /// The packets could not be written to the raw archive.
    NotOnDisk,
    /// The connection was evicted for a new one.
    GaveWay,
    /// The sender closed the connection, and its bytes had no valid packet, or were frames of an unsupported format.
    NotADownlink,
    /// The receiver panicked, which is a bug in the program.
    Failed,
}

impl ConnectionEnd {
    /// All ends.
    pub const ALL: [Self; 17] = [
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
        Self::NotADownlink,
        Self::Failed,
    ];
}

impl ConnectionEnd {
    /// Whether neither the sender nor its connection is to blame.
    fn is_regular(self) -> bool {
        matches!(self, Self::Whole | Self::Stopped | Self::GaveWay)
    }
}

impl fmt::Display for ConnectionEnd {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Whole => "the sender closed it",
            Self::Broken => "the connection broke",
            Self::Stopped => "the ground ended its run",
            Self::FirstPacket => "no valid packet within downlink.listen.first_packet_s_max",
            Self::Idle => "no valid packet for downlink.listen.idle_s_max",
            Self::Garbage => "no valid packet in downlink.listen.garbage_bytes_max",
            Self::Memory => "more incomplete data than downlink.listen.memory_bytes_max",
            Self::OtherInstrument => "packets of another instrument than the ground's",
            Self::UnfitInstrument => "an instrument that does not fit the ground's configuration",
            Self::Unconfirmed => {
                "no visibilities with positions confirmed its instrument, and the ground has none"
            }
            Self::NoState => {
                "it requests `held`, and the ground has no checkpoints; expected a ground with --state"
            }
            Self::NoToken => "it did not begin with `token TOKEN`, and the ground has --stations",
            Self::UnknownToken => "no station has its token",
            Self::NotOnDisk => "its packets could not be written to the archive; it has to send them again",
            Self::GaveWay => {
                "it gave way to another connection, as downlink.listen.connections_max were open"
            }
            Self::NotADownlink => "no valid packet in its bytes, or frames of an unsupported format",
            Self::Failed => "its receiver failed, which is a bug in the program",
        })
    }
}

/// The report on one connection.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct SenderReport {
    /// Address of the sender.
    pub peer: String,
    /// The station whose token the sender gave.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub station: Option<String>,
    /// Format of the stream, if it was detected.
    pub format: Option<Format>,
    /// Number of bytes read.
    pub bytes: u64,
    /// Number of valid packets forwarded to the ground.
    pub packets: u64,
    /// How the connection ended.
    pub ended: ConnectionEnd,
}

/// A note about an event of a connection, reported when it happens. In JSON, its field `event` has the kind of event.
#[derive(Debug, Serialize)]
pub struct ListenNote<'a> {
    #[serde(flatten)]
    pub(super) event: ListenEvent<'a>,
    /// Number of notes before this one that were suppressed, as there were too many.
    #[serde(skip_serializing_if = "is_zero")]
    pub(super) untold: u64,
}

#[derive(Debug, Serialize)]
#[serde(tag = "event", rename_all = "kebab-case")]
pub(super) enum ListenEvent<'a> {
    /// A connection ended.
    Sender(&'a SenderReport),
    /// A connection was refused, as there was no slot.
    SenderRefused { peer: String },
    /// A connection could not be accepted.
    AcceptFailed { reason: String },
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks so")]
fn is_zero(count: &u64) -> bool {
    *count == 0
}

impl ListenNote<'_> {
    /// Whether the note is the regular end of a connection.
    #[must_use]
    pub fn is_regular(&self) -> bool {
        matches!(self.event, ListenEvent::Sender(SenderReport { ended: ConnectionEnd::Whole, .. }))
    }
}

impl fmt::Display for ListenNote<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.event {
            ListenEvent::Sender(SenderReport { peer, station, bytes, packets, ended, .. }) => {
                let station = station.iter().map(|name| format!(" ({name})")).collect::<String>();
                write!(f, "{peer}{station}: {bytes} bytes, {packets} packets; {ended}")
            }
            ListenEvent::SenderRefused { peer } => {
                write!(f, "{peer}: refused; downlink.listen.connections_max other connections are open")
            }
            ListenEvent::AcceptFailed { reason } => write!(f, "cannot accept a connection: {reason}"),
        }?;
        match self.untold {
            0 => Ok(()),
            untold => write!(f, " ({untold} notes before it are only in the summary)"),
        }
    }
}

/// Counters of a station.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct StationCounts {
    /// Number of its connections that have ended.
    pub connections: u64,
    /// Those among them that ended otherwise than by the sender, by the end of the run, or for another sender's place.
    pub broken: u64,
    /// Number of faults in its streams: damaged packets, bytes of no packet, losses of synchronisation.
    pub faults: u64,
    /// Number of bytes read, including those of open connections.
    pub bytes: u64,
    /// Number of valid packets that ended connections have forwarded to the ground.
    pub packets: u64,
    /// When the last valid packet or frame came.
    #[serde(skip)]
    pub heard: Option<Instant>,
}

/// Counters of datagrams.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct DatagramReport {
    /// Address on which the ground listens.
    pub address: String,
    /// Number of datagrams received.
    pub received: u64,
    /// Number of bytes in them.
    pub bytes: u64,
    /// Number of valid packets forwarded to the ground.
    pub packets: u64,
    /// Datagrams without a valid packet or frame.
    pub malformed: u64,
    /// Datagrams of another instrument than the ground's.
    pub refused: u64,
    /// Datagrams that the system dropped because they came faster than they were read; `None` if the system does not report it.
    pub dropped_by_system: Option<u64>,
}

/// The report on all connections and datagrams of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct ListenReport {
    /// Address on which the ground listened.
    pub address: String,
    /// Number of accepted connections.
    pub connections: u64,
    /// Number of connections refused because `connections_max` active ones were open.
    pub refused: u64,
    /// Number of bytes read.
    pub bytes: u64,
    /// Number of valid packets forwarded to the ground.
    pub packets: u64,
    /// Number of valid packets refused because of their sender's instrument.
    pub packets_refused: u64,
    /// Maximum backlog of packets, bytes.
    pub backlog_bytes_max: u64,
    /// Number of connections by end.
    pub ended: BTreeMap<ConnectionEnd, u64>,
    /// Counters of datagrams, if the ground listens for them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub datagrams: Option<DatagramReport>,
    /// Counters of each station, by name.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub stations: BTreeMap<String, StationCounts>,
    /// Reports on the first connections.
    pub senders: Listing<SenderReport>,
    /// Counters of everything in the streams except valid packets.
    #[serde(skip)]
    pub(super) streams: ReceptionCounters,
}

impl ListenReport {
    /// Adds the counters of everything except valid packets, which the pipeline does not receive.
    pub fn complete(&self, reception: &mut ReceptionCounters) {
        reception.add_stream(&self.streams);
    }

    /// Adds the stations that may send, so that the report also shows those that never do.
    pub(super) fn add_stations<'a>(&mut self, names: impl Iterator<Item = &'a str>) {
        self.stations.extend(names.map(|name| (name.to_owned(), StationCounts::default())));
    }

    /// Counts bytes from a station and faults among them; `has_valid` if there was a valid packet or frame, too.
    pub(super) fn record_bytes(&mut self, station: &str, bytes: u64, faults: u64, has_valid: bool) {
        if !self.stations.contains_key(station) {
            self.stations.insert(station.to_owned(), StationCounts::default());
        }
        if let Some(counts) = self.stations.get_mut(station) {
            counts.bytes += bytes;
            counts.faults += faults;
            counts.heard = if has_valid { Some(Instant::now()) } else { counts.heard };
        }
    }

    pub(super) fn close(&mut self, report: SenderReport, refused: u64, stream: &ReceptionCounters) {
        self.bytes += report.bytes;
        self.packets += report.packets;
        self.packets_refused += refused;
        if let Some(counts) = report.station.as_ref().and_then(|name| self.stations.get_mut(name)) {
            counts.connections += 1;
            counts.packets += report.packets;
            counts.broken += u64::from(!report.ended.is_regular());
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
    /// Number of connections that wait for space in the backlog.
    pub(super) waiting: AtomicUsize,
    /// Number of ended connections that delivered packets.
    pub(super) done: AtomicU64,
    /// When the last valid packet or frame arrived.
    last_activity: Mutex<Option<Instant>>,
}

impl ListenStatus {
    /// Number of open connections.
    #[must_use]
    pub fn open(&self) -> usize {
        self.open.load(Ordering::Relaxed)
    }

    /// Number of bytes read.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Time since the last valid packet or frame from any sender; `None` before the first.
    #[must_use]
    pub fn silence(&self) -> Option<Duration> {
        self.last_activity.lock().unwrap_or_else(PoisonError::into_inner).map(|instant| instant.elapsed())
    }

    pub(super) fn record_activity(&self) {
        *self.last_activity.lock().unwrap_or_else(PoisonError::into_inner) = Some(Instant::now());
    }

    pub(super) fn clear_backlog(&self) {
        self.backlog_bytes.store(0, Ordering::Relaxed);
    }

    /// Backlog of packets after the last addition, bytes.
    #[must_use]
    pub fn backlog_bytes(&self) -> u64 {
        self.backlog_bytes.load(Ordering::Relaxed)
    }
}

/// Status and report of a listening ground, shared between threads.
#[derive(Clone, Debug, Default)]
pub struct Listening {
    /// Live status.
    pub status: Arc<ListenStatus>,
    /// The raw archive, if packets are kept.
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
