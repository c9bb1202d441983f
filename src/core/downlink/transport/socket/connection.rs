//! Serves one connection: reads it, forwards its packets, and enforces the limits.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::Notify;
use tokio::task::spawn_blocking;
use tokio::time::{Instant, sleep_until, timeout};

use super::answers::WaitingSender;
use super::listener::{ForwardedBatch, ListenContext, PacketBatch, Race, race};
use super::preamble::Preamble;
use super::report::{BUSY, CLOSED, ConnectionEnd, ListenEvent, SenderReport};
use super::stream_receiver::{Activity, StreamReceiver};
use crate::downlink::receive::ReceptionCounters;
use crate::downlink::transport::packet_archive::Ticket;

/// Maximum number of bytes read at a time. At a low rate it is smaller, so that a read takes a tenth of a second.
const READ_BYTES: usize = 1 << 16;
const READ_BYTES_MIN: usize = 1 << 8;
const READS_PER_S: f64 = 10.0;

/// Time limit for sending an answer.
const ANSWER: Duration = Duration::from_secs(1);

/// A time limit that means "no limit".
const NEVER: Duration = Duration::from_secs(1 << 29);

/// The receiver of a connection and its buffers.
struct ConnectionState {
    receiver: StreamReceiver,
    chunk: Vec<u8>,
    packets: Vec<u8>,
    /// Number of bytes of all senders up to the last packet that was forwarded.
    mark: u64,
    /// Ticket for the packets that must be on disk, or why they cannot be written; `None` without an archive.
    ticket: Result<Option<Ticket>, String>,
    /// When the last bytes arrived.
    arrived: Instant,
    /// Number of faults in the stream that are counted for its station.
    faults: u64,
}

/// The slot of a connection, which is released when this is dropped.
struct SlotGuard<'a> {
    shared: &'a Arc<ListenContext>,
    number: u64,
    /// Notified when the connection is evicted.
    evicted: Arc<Notify>,
}

impl Drop for SlotGuard<'_> {
    fn drop(&mut self) {
        self.shared.slots.release(self.number);
    }
}

/// Serves a connection from its first byte to the answer.
pub(super) async fn serve(mut stream: TcpStream, peer: SocketAddr, shared: Arc<ListenContext>) {
    let status = &shared.listening.status;
    status.open.fetch_add(1, Ordering::Relaxed);
    shared.listening.write().connections += 1;
    let (number, evicted) = shared.slots.take(peer.ip(), Instant::now());
    let slot = SlotGuard { shared: &shared, number, evicted };
    let mut bytes = 0;
    let (state, mut ended) = exchange(&mut stream, &slot, &mut bytes).await;
    let (mut packets, mut refused, mut format, mut foreign_format) = (0, 0, None, None);
    // Number of bytes of the downlink and, for a sender that asks for `held`, the mark of its last packet.
    let (mut sent, mut held_mark) = (bytes, None);
    let (mut mark, mut ticket) = (0, Ok(None));
    let (mut counters, mut station) = (ReceptionCounters::default(), None);
    let finished = state.map(|mut state| {
        spawn_blocking(move || {
            let finished = state.receiver.finish(&mut state.packets);
            (state, finished)
        })
    });
    if let Some(finished) = finished
        && let Ok((mut state, finished)) = finished.await
    {
        if let (ConnectionEnd::Whole, Err(refused)) = (ended, finished) {
            ended = refused;
        }
        if !forward_batch(&mut state, &slot).await {
            ended = ConnectionEnd::Stopped;
        }
        (packets, refused) = state.receiver.packets();
        format = state.receiver.format();
        let preamble = state.receiver.preamble();
        sent = bytes - preamble.bytes();
        // `taken` would let the sender delete what the ground does not have.
        if ended == ConnectionEnd::Whole && !state.receiver.is_empty_or_downlink() {
            ended = ConnectionEnd::NotADownlink;
            foreign_format = state.receiver.foreign_format();
        }
        held_mark = preamble.requests_held().then_some(state.mark);
        mark = state.mark;
        ticket = state.ticket;
        station = preamble.station().map(str::to_owned);
        counters = state.receiver.stream_counters();
        if let Some(station) = &station {
            shared.listening.write().record_bytes(station, 0, counters.faults() - state.faults, false);
        }
        let is_downlink = state.receiver.has_had_valid() && ended != ConnectionEnd::NotADownlink;
        status.done.fetch_add(u64::from(is_downlink), Ordering::Relaxed);
    }
    let synced = sync(ticket, &shared).await;
    if ended == ConnectionEnd::Whole && synced.is_err() {
        ended = ConnectionEnd::NotOnDisk;
    }
    let answer = match ended {
        ConnectionEnd::NotOnDisk => {
            format!("{BUSY}{sent} bytes are not on disk: {}\n", synced.err().unwrap_or_default())
        }
        ConnectionEnd::Whole => format!("taken {sent} bytes\n"),
        ConnectionEnd::GaveWay => format!("{BUSY}closed after {bytes} bytes: {ended}\n"),
        other => {
            let found = foreign_format.map(|format| format!(": {format}")).unwrap_or_default();
            format!("{CLOSED}after {bytes} bytes: {other}{found}\n")
        }
    };
    // A sender need not read the answer.
    let _ = timeout(ANSWER, stream.write_all(answer.as_bytes())).await;
    let report = SenderReport { peer: peer.to_string(), station, format, bytes, packets, ended };
    shared.notes.report(ListenEvent::Sender(&report));
    shared.listening.write().close(report, refused, &counters);
    status.open.fetch_sub(1, Ordering::Relaxed);
    drop(slot);
    if let Some(held) = &shared.held {
        held.record_end(mark);
    }
    if let (ConnectionEnd::Whole, Some(mark), Some(held)) = (ended, held_mark, &shared.held)
        && let Ok(stream) = stream.into_std()
    {
        held.add(WaitingSender { stream, bytes: sent, mark }, shared.config.connections_max);
    }
}

/// Reads until either side ends the connection. Returns no state if the receiver panicked.
async fn exchange(
    stream: &mut TcpStream,
    slot: &SlotGuard<'_>,
    bytes: &mut u64,
) -> (Option<ConnectionState>, ConnectionEnd) {
    let shared = slot.shared;
    let rate = shared.config.bytes_per_s_max;
    let read_bytes = match rate > 0.0 {
        true => ((rate / READS_PER_S) as usize).clamp(READ_BYTES_MIN, READ_BYTES),
        false => READ_BYTES,
    };
    let preamble = Preamble::new(shared.stations.clone(), shared.held.is_some());
    let mut state = ConnectionState {
        receiver: StreamReceiver::new(shared.reception.clone(), preamble),
        chunk: vec![0; read_bytes],
        packets: Vec::new(),
        mark: 0,
        ticket: Ok(None),
        arrived: Instant::now(),
        faults: 0,
    };
    // Time without a valid packet or frame, without the time in which the connection waited for the ground.
    let mut silence = Duration::ZERO;
    let mut due = Instant::now();
    loop {
        let read = match read(stream, slot, &mut state, &mut silence).await {
            Ok(read) => read,
            Err(ended) => return (Some(state), ended),
        };
        state.arrived = Instant::now();
        *bytes += read as u64;
        shared.listening.status.bytes.fetch_add(read as u64, Ordering::Relaxed);
        // On another thread, as work for this connection must not delay the others.
        let received = spawn_blocking(move || {
            let activity = state.receiver.receive(&state.chunk[..read], &mut state.packets);
            (state, activity)
        });
        let Ok((returned, activity)) = received.await else { return (None, ConnectionEnd::Failed) };
        state = returned;
        let Activity { has_valid, has_new } = activity.unwrap_or_default();
        if let Some(station) = state.receiver.preamble().station() {
            let faults = state.receiver.stream_counters().faults();
            shared.listening.write().record_bytes(station, read as u64, faults - state.faults, has_valid);
            state.faults = faults;
        }
        if has_valid {
            silence = Duration::ZERO;
            shared.record_activity();
            shared.listening.status.record_activity();
        }
        if has_new {
            shared.slots.record_new_packet(slot.number, Instant::now());
        }
        if !forward_batch(&mut state, slot).await {
            return (Some(state), ConnectionEnd::Stopped);
        }
        if let Err(ended) = activity.and(require_limits(&state.receiver, shared)) {
            return (Some(state), ended);
        }
        if rate > 0.0 {
            due = due.max(Instant::now()) + Duration::from_secs_f64(read as f64 / rate);
            sleep_until(due).await;
        }
    }
}

/// Reads the next bytes into the chunk, or returns why there are none.
async fn read(
    stream: &mut TcpStream,
    slot: &SlotGuard<'_>,
    state: &mut ConnectionState,
    silence: &mut Duration,
) -> Result<usize, ConnectionEnd> {
    let shared = slot.shared;
    let (limit_s, ended) = match state.receiver.has_had_valid() {
        true => (shared.config.idle_s_max, ConnectionEnd::Idle),
        false => (shared.config.first_packet_s_max, ConnectionEnd::FirstPacket),
    };
    let limit = if limit_s > 0.0 { Duration::from_secs_f64(limit_s) } else { NEVER };
    let since = Instant::now();
    let reading = timeout(limit.saturating_sub(*silence), stream.read(&mut state.chunk));
    let read = race(race(shared.stopped(), slot.evicted.notified()), reading).await;
    *silence += since.elapsed();
    match read {
        Race::A(Race::A(())) => Err(ConnectionEnd::Stopped),
        Race::A(Race::B(())) => Err(ConnectionEnd::GaveWay),
        Race::B(Err(_)) => Err(ended),
        Race::B(Ok(Err(_))) => Err(ConnectionEnd::Broken),
        Race::B(Ok(Ok(0))) => Err(ConnectionEnd::Whole),
        Race::B(Ok(Ok(read))) => Ok(read),
    }
}

/// Requires that a connection is within the limits of memory and garbage.
fn require_limits(receiver: &StreamReceiver, shared: &ListenContext) -> Result<(), ConnectionEnd> {
    if receiver.memory_bytes() as u64 > shared.config.memory_bytes_max {
        return Err(ConnectionEnd::Memory);
    }
    if receiver.bytes_since_valid() > shared.config.garbage_bytes_max {
        return Err(ConnectionEnd::Garbage);
    }
    Ok(())
}

/// Forwards the packets to the ground once the backlog has space; returns whether the ground still accepts packets.
async fn forward_batch(state: &mut ConnectionState, slot: &SlotGuard<'_>) -> bool {
    let bytes = std::mem::take(&mut state.packets);
    if bytes.is_empty() {
        return true;
    }
    let SlotGuard { shared, number, .. } = slot;
    let status = &shared.listening.status;
    let capacity = ListenContext::backlog_capacity(&shared.config);
    let needed = u32::try_from(bytes.len().min(capacity)).unwrap_or(u32::MAX);
    status.waiting.fetch_add(1, Ordering::Relaxed);
    shared.slots.set_blocked(*number, true, Instant::now());
    // Space is granted in the order of request, so that a fast sender does not displace a slow one.
    let space = Arc::clone(&shared.backlog).acquire_many_owned(needed).await;
    status.waiting.fetch_sub(1, Ordering::Relaxed);
    shared.slots.set_blocked(*number, false, Instant::now());
    let Ok(space) = space else { return false };
    let backlog = (capacity - shared.backlog.available_permits().min(capacity)) as u64;
    status.backlog_bytes.store(backlog, Ordering::Relaxed);
    {
        let mut report = shared.listening.write();
        report.backlog_bytes_max = report.backlog_bytes_max.max(backlog);
    }
    let batch = PacketBatch { bytes, space, arrived: state.arrived.into_std() };
    let forwarded = match shared.archive {
        None => shared.forward(batch),
        // The disk may be slow.
        Some(_) => {
            let shared = Arc::clone(shared);
            spawn_blocking(move || shared.forward(batch)).await.ok().flatten()
        }
    };
    let Some(ForwardedBatch { mark, ticket }) = forwarded else { return false };
    state.mark = mark;
    // The first failure is kept: the sender then has to send everything again.
    if state.ticket.is_ok() {
        state.ticket = ticket;
    }
    true
}

/// Waits until the packets of a sender are on disk, if there is an archive.
async fn sync(ticket: Result<Option<Ticket>, String>, shared: &ListenContext) -> Result<(), String> {
    let (Some(ticket), Some(archive)) = (ticket?, shared.archive.clone()) else { return Ok(()) };
    let synced = spawn_blocking(move || archive.sync(ticket)).await;
    synced.unwrap_or_else(|_| Err("the archive failed, which is a bug in the program".to_owned()))
}
