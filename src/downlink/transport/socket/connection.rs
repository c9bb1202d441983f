//! One connection: reads, has packets found, hands them on, and keeps it to the limits.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::task::spawn_blocking;
use tokio::time::{Instant, sleep_until, timeout};

use super::listener::{First, ListenContext, PacketBatch, first};
use super::report::{ConnectionEnd, SenderReport};
use super::sender_intake::SenderIntake;
use crate::downlink::receive::ReceptionCounters;

/// Bytes read at a time; fewer where the rate is so low that they would take longer than a tenth of a second.
const READ_BYTES: usize = 1 << 16;
const READ_BYTES_MIN: usize = 1 << 8;
const READS_PER_S: f64 = 10.0;

/// How long an answer may take to send.
const ANSWER: Duration = Duration::from_secs(1);

/// Where a limit of 0 means none.
const NEVER: Duration = Duration::from_secs(1 << 29);

/// A connection's receiver and the bytes between it and the socket.
struct ConnectionState {
    line: SenderIntake,
    chunk: Vec<u8>,
    packets: Vec<u8>,
}

/// Takes all that a sender sends.
pub(super) async fn serve(mut stream: TcpStream, peer: SocketAddr, shared: Arc<ListenContext>) {
    let status = &shared.listening.status;
    status.open.fetch_add(1, Ordering::Relaxed);
    shared.listening.write().connections += 1;
    let mut bytes = 0;
    let (work, mut ended) = exchange(&mut stream, &shared, &mut bytes).await;
    let (mut packets, mut refused, mut format) = (0, 0, None);
    let mut account = ReceptionCounters::default();
    let finished = work.map(|mut work| {
        spawn_blocking(move || {
            work.line.finish(&mut work.packets);
            work
        })
    });
    if let Some(finished) = finished
        && let Ok(mut work) = finished.await
    {
        if !hand_on(std::mem::take(&mut work.packets), &shared).await {
            ended = ConnectionEnd::Stopped;
        }
        (packets, refused) = work.line.packets();
        format = work.line.format();
        account = work.line.stream();
        status.done.fetch_add(u64::from(work.line.is_alive()), Ordering::Relaxed);
    }
    let answer = match ended {
        ConnectionEnd::Whole => format!("taken {bytes} bytes\n"),
        other => format!("closed after {bytes} bytes: {other}\n"),
    };
    // Whether it is heard is no concern of ours.
    let _ = timeout(ANSWER, stream.write_all(answer.as_bytes())).await;
    shared.notes.say(&format!("{peer}: {bytes} bytes, {packets} packets; {ended}"));
    let report = SenderReport { peer: peer.to_string(), format, bytes, packets, ended };
    shared.listening.write().close(report, refused, &account);
    status.open.fetch_sub(1, Ordering::Relaxed);
}

/// Reads until the end, whosever it is. Without its work if that has failed.
async fn exchange(
    stream: &mut TcpStream,
    shared: &ListenContext,
    bytes: &mut u64,
) -> (Option<ConnectionState>, ConnectionEnd) {
    let rate = shared.config.bytes_per_s_max;
    let read_bytes = match rate > 0.0 {
        true => ((rate / READS_PER_S) as usize).clamp(READ_BYTES_MIN, READ_BYTES),
        false => READ_BYTES,
    };
    let line = SenderIntake::new(shared.mission.clone());
    let mut work = ConnectionState { line, chunk: vec![0; read_bytes], packets: Vec::new() };
    // Time spent waiting for the sender alone.
    let mut silence = Duration::ZERO;
    let mut due = Instant::now();
    loop {
        let read = match read(stream, shared, &mut work, &mut silence).await {
            Ok(read) => read,
            Err(ended) => return (Some(work), ended),
        };
        *bytes += read as u64;
        shared.listening.status.bytes.fetch_add(read as u64, Ordering::Relaxed);
        // Found on another thread: what is hard work here must not keep other connections waiting.
        let found = spawn_blocking(move || {
            let found = work.line.take(&work.chunk[..read], &mut work.packets);
            (work, found)
        });
        let Ok((back, found)) = found.await else { return (None, ConnectionEnd::Failed) };
        work = back;
        if matches!(found, Ok(true)) {
            silence = Duration::ZERO;
            shared.note_sign();
        }
        let packets = std::mem::take(&mut work.packets);
        if !hand_on(packets, shared).await {
            return (Some(work), ConnectionEnd::Stopped);
        }
        if let Err(ended) = found.and(within_limits(&work.line, shared)) {
            return (Some(work), ended);
        }
        if rate > 0.0 {
            due = due.max(Instant::now()) + Duration::from_secs_f64(read as f64 / rate);
            sleep_until(due).await;
        }
    }
}

/// The next bytes, into the chunk; or why there are none.
async fn read(
    stream: &mut TcpStream,
    shared: &ListenContext,
    work: &mut ConnectionState,
    silence: &mut Duration,
) -> Result<usize, ConnectionEnd> {
    let (limit_s, ended) = match work.line.is_alive() {
        true => (shared.config.idle_s_max, ConnectionEnd::Idle),
        false => (shared.config.first_packet_s_max, ConnectionEnd::FirstPacket),
    };
    let limit = if limit_s > 0.0 { Duration::from_secs_f64(limit_s) } else { NEVER };
    let since = Instant::now();
    let reading = timeout(limit.saturating_sub(*silence), stream.read(&mut work.chunk));
    let read = first(shared.stopped(), reading).await;
    *silence += since.elapsed();
    match read {
        First::A(()) => Err(ConnectionEnd::Stopped),
        First::B(Err(_)) => Err(ended),
        First::B(Ok(Err(_))) => Err(ConnectionEnd::Broken),
        First::B(Ok(Ok(0))) => Err(ConnectionEnd::Whole),
        First::B(Ok(Ok(read))) => Ok(read),
    }
}

fn within_limits(line: &SenderIntake, shared: &ListenContext) -> Result<bool, ConnectionEnd> {
    if line.held_bytes() as u64 > shared.config.memory_bytes_max {
        return Err(ConnectionEnd::Memory);
    }
    if line.bytes_in_vain() > shared.config.garbage_bytes_max {
        return Err(ConnectionEnd::Garbage);
    }
    Ok(true)
}

/// Hands packets to the ground once there is room; whether it still takes any.
async fn hand_on(bytes: Vec<u8>, shared: &ListenContext) -> bool {
    if bytes.is_empty() {
        return true;
    }
    let status = &shared.listening.status;
    let all = ListenContext::room_bytes(&shared.config);
    let needed = u32::try_from(bytes.len().min(all)).unwrap_or(u32::MAX);
    status.waiting.fetch_add(1, Ordering::Relaxed);
    // Room is given out in the order of asking, so that a fast sender does not crowd out a slow one.
    let room = Arc::clone(&shared.room).acquire_many_owned(needed).await;
    status.waiting.fetch_sub(1, Ordering::Relaxed);
    let Ok(room) = room else { return false };
    let backlog = (all - shared.room.available_permits().min(all)) as u64;
    status.backlog_bytes.store(backlog, Ordering::Relaxed);
    {
        let mut account = shared.listening.write();
        account.backlog_bytes_max = account.backlog_bytes_max.max(backlog);
    }
    shared.deliveries.send(PacketBatch { bytes, room }).is_ok()
}
