//! Serves one connection: reads it, finds its packets, passes them on, and enforces the limits.

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
use super::listener::{First, ListenContext, PacketBatch, PassedBatch, first};
use super::preamble::Preamble;
use super::report::{BUSY, CLOSED, ConnectionEnd, ListenEvent, SenderReport};
use super::sender_intake::{SenderIntake, Signs};
use crate::downlink::receive::ReceptionCounters;
use crate::downlink::transport::packet_archive::Ticket;

/// Bytes read at a time; fewer at rates so low that a read would take longer than a tenth of a second.
const READ_BYTES: usize = 1 << 16;
const READ_BYTES_MIN: usize = 1 << 8;
const READS_PER_S: f64 = 10.0;

/// Time limit for sending an answer.
const ANSWER: Duration = Duration::from_secs(1);

/// Stands for "no limit".
const NEVER: Duration = Duration::from_secs(1 << 29);

/// A connection's receiver, and its buffers.
struct ConnectionState {
    intake: SenderIntake,
    chunk: Vec<u8>,
    packets: Vec<u8>,
    /// Bytes of all senders up to the last packet passed on.
    mark: u64,
    /// What of them has to be on disk; why it cannot be; `None` without an archive.
    ticket: Result<Option<Ticket>, String>,
    /// When the last bytes arrived.
    arrived: Instant,
}

/// A connection's place.
struct SeatGuard<'a> {
    shared: &'a Arc<ListenContext>,
    number: u64,
    /// Tells the connection to give way.
    leave: Arc<Notify>,
}

impl Drop for SeatGuard<'_> {
    fn drop(&mut self) {
        self.shared.seats.release(self.number);
    }
}

/// Receives everything that a sender sends.
pub(super) async fn serve(mut stream: TcpStream, peer: SocketAddr, shared: Arc<ListenContext>) {
    let status = &shared.listening.status;
    status.open.fetch_add(1, Ordering::Relaxed);
    shared.listening.write().connections += 1;
    let (number, leave) = shared.seats.take(peer.ip(), Instant::now());
    let seat = SeatGuard { shared: &shared, number, leave };
    let mut bytes = 0;
    let (state, mut ended) = exchange(&mut stream, &seat, &mut bytes).await;
    let (mut packets, mut refused, mut format) = (0, 0, None);
    // Bytes of the downlink, and where its last packet is, for a sender that asks until it is held.
    let (mut sent, mut mark) = (bytes, None);
    let (mut passed, mut ticket) = (0, Ok(None));
    let (mut counters, mut station) = (ReceptionCounters::default(), None);
    let finished = state.map(|mut state| {
        spawn_blocking(move || {
            let finished = state.intake.finish(&mut state.packets);
            (state, finished)
        })
    });
    if let Some(finished) = finished
        && let Ok((mut state, finished)) = finished.await
    {
        if let (ConnectionEnd::Whole, Err(refused)) = (ended, finished) {
            ended = refused;
        }
        if !forward_batch(&mut state, &seat).await {
            ended = ConnectionEnd::Stopped;
        }
        (packets, refused) = state.intake.packets();
        format = state.intake.format();
        let preamble = state.intake.preamble();
        sent = bytes - preamble.bytes();
        mark = preamble.asks_held().then_some(state.mark);
        passed = state.mark;
        ticket = state.ticket;
        station = preamble.station().map(str::to_owned);
        counters = state.intake.stream();
        status.done.fetch_add(u64::from(state.intake.is_alive()), Ordering::Relaxed);
    }
    let on_disk = on_disk(ticket, &shared).await;
    if ended == ConnectionEnd::Whole && on_disk.is_err() {
        ended = ConnectionEnd::NotOnDisk;
    }
    let answer = match ended {
        ConnectionEnd::NotOnDisk => {
            format!("{BUSY}{sent} bytes are not on disk: {}\n", on_disk.err().unwrap_or_default())
        }
        ConnectionEnd::Whole => format!("taken {sent} bytes\n"),
        ConnectionEnd::GaveWay => format!("{BUSY}closed after {bytes} bytes: {ended}\n"),
        other => format!("{CLOSED}after {bytes} bytes: {other}\n"),
    };
    // A sender need not read the answer.
    let _ = timeout(ANSWER, stream.write_all(answer.as_bytes())).await;
    let report = SenderReport { peer: peer.to_string(), station, format, bytes, packets, ended };
    shared.notes.say(ListenEvent::Sender(&report));
    shared.listening.write().close(report, refused, &counters);
    status.open.fetch_sub(1, Ordering::Relaxed);
    drop(seat);
    if let Some(held) = &shared.held {
        held.note_end(passed);
    }
    if let (ConnectionEnd::Whole, Some(mark), Some(held)) = (ended, mark, &shared.held)
        && let Ok(stream) = stream.into_std()
    {
        held.add(WaitingSender { stream, bytes: sent, mark }, shared.config.connections_max);
    }
}

/// Reads until either side ends the connection. Returns no state if the receiver failed.
async fn exchange(
    stream: &mut TcpStream,
    seat: &SeatGuard<'_>,
    bytes: &mut u64,
) -> (Option<ConnectionState>, ConnectionEnd) {
    let shared = seat.shared;
    let rate = shared.config.bytes_per_s_max;
    let read_bytes = match rate > 0.0 {
        true => ((rate / READS_PER_S) as usize).clamp(READ_BYTES_MIN, READ_BYTES),
        false => READ_BYTES,
    };
    let preamble = Preamble::new(shared.stations.clone(), shared.held.is_some());
    let intake = SenderIntake::new(shared.mission.clone(), preamble);
    let mut state = ConnectionState {
        intake,
        chunk: vec![0; read_bytes],
        packets: Vec::new(),
        mark: 0,
        ticket: Ok(None),
        arrived: Instant::now(),
    };
    // Time spent waiting for the sender only.
    let mut silence = Duration::ZERO;
    let mut due = Instant::now();
    loop {
        let read = match read(stream, seat, &mut state, &mut silence).await {
            Ok(read) => read,
            Err(ended) => return (Some(state), ended),
        };
        state.arrived = Instant::now();
        *bytes += read as u64;
        shared.listening.status.bytes.fetch_add(read as u64, Ordering::Relaxed);
        // On another thread: work for this connection must not delay the others.
        let found = spawn_blocking(move || {
            let found = state.intake.take(&state.chunk[..read], &mut state.packets);
            (state, found)
        });
        let Ok((back, found)) = found.await else { return (None, ConnectionEnd::Failed) };
        state = back;
        let Signs { is_alive, is_new } = found.unwrap_or_default();
        if let Some(station) = state.intake.preamble().station() {
            shared.listening.write().hear(station, read as u64, is_alive);
        }
        if is_alive {
            silence = Duration::ZERO;
            shared.note_sign();
            shared.listening.status.note_heard();
        }
        if is_new {
            shared.seats.note_new(seat.number, Instant::now());
        }
        if !forward_batch(&mut state, seat).await {
            return (Some(state), ConnectionEnd::Stopped);
        }
        if let Err(ended) = found.and(within_limits(&state.intake, shared)) {
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
    seat: &SeatGuard<'_>,
    state: &mut ConnectionState,
    silence: &mut Duration,
) -> Result<usize, ConnectionEnd> {
    let shared = seat.shared;
    let (limit_s, ended) = match state.intake.is_alive() {
        true => (shared.config.idle_s_max, ConnectionEnd::Idle),
        false => (shared.config.first_packet_s_max, ConnectionEnd::FirstPacket),
    };
    let limit = if limit_s > 0.0 { Duration::from_secs_f64(limit_s) } else { NEVER };
    let since = Instant::now();
    let reading = timeout(limit.saturating_sub(*silence), stream.read(&mut state.chunk));
    let read = first(first(shared.stopped(), seat.leave.notified()), reading).await;
    *silence += since.elapsed();
    match read {
        First::A(First::A(())) => Err(ConnectionEnd::Stopped),
        First::A(First::B(())) => Err(ConnectionEnd::GaveWay),
        First::B(Err(_)) => Err(ended),
        First::B(Ok(Err(_))) => Err(ConnectionEnd::Broken),
        First::B(Ok(Ok(0))) => Err(ConnectionEnd::Whole),
        First::B(Ok(Ok(read))) => Ok(read),
    }
}

fn within_limits(intake: &SenderIntake, shared: &ListenContext) -> Result<(), ConnectionEnd> {
    if intake.held_bytes() as u64 > shared.config.memory_bytes_max {
        return Err(ConnectionEnd::Memory);
    }
    if intake.bytes_in_vain() > shared.config.garbage_bytes_max {
        return Err(ConnectionEnd::Garbage);
    }
    Ok(())
}

/// Passes the packets found to the ground once there is room. Returns whether the ground still accepts any.
async fn forward_batch(state: &mut ConnectionState, seat: &SeatGuard<'_>) -> bool {
    let bytes = std::mem::take(&mut state.packets);
    if bytes.is_empty() {
        return true;
    }
    let SeatGuard { shared, number, .. } = seat;
    let status = &shared.listening.status;
    let all = ListenContext::room_bytes(&shared.config);
    let needed = u32::try_from(bytes.len().min(all)).unwrap_or(u32::MAX);
    status.waiting.fetch_add(1, Ordering::Relaxed);
    shared.seats.note_wait(*number, true, Instant::now());
    // Room is granted in the order of request, so that a fast sender does not crowd out a slow one.
    let room = Arc::clone(&shared.room).acquire_many_owned(needed).await;
    status.waiting.fetch_sub(1, Ordering::Relaxed);
    shared.seats.note_wait(*number, false, Instant::now());
    let Ok(room) = room else { return false };
    let backlog = (all - shared.room.available_permits().min(all)) as u64;
    status.backlog_bytes.store(backlog, Ordering::Relaxed);
    {
        let mut report = shared.listening.write();
        report.backlog_bytes_max = report.backlog_bytes_max.max(backlog);
    }
    let batch = PacketBatch { bytes, room, arrived: state.arrived.into_std() };
    let passed = match shared.archive {
        None => shared.pass(batch),
        // A disk may be slow.
        Some(_) => {
            let shared = Arc::clone(shared);
            spawn_blocking(move || shared.pass(batch)).await.ok().flatten()
        }
    };
    let Some(PassedBatch { mark, ticket }) = passed else { return false };
    state.mark = mark;
    // One piece that is not on disk is enough for the sender to send again.
    if state.ticket.is_ok() {
        state.ticket = ticket;
    }
    true
}

/// Waits until what a sender has sent is on disk, if there is an archive.
async fn on_disk(ticket: Result<Option<Ticket>, String>, shared: &ListenContext) -> Result<(), String> {
    let (Some(ticket), Some(archive)) = (ticket?, shared.archive.clone()) else { return Ok(()) };
    let synced = spawn_blocking(move || archive.sync(ticket)).await;
    synced.unwrap_or_else(|_| Err("the archive failed, which is a bug in the program".to_owned()))
}
