//! Receives datagrams over UDP, each with packets or a frame.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::net::UdpSocket;
use tokio::task::spawn_blocking;
use tokio::time::{Instant, timeout};

use super::instrument_filter::SharedReception;
use super::listener::{ListenContext, PacketBatch, Race, race};
use super::preamble::Preamble;
use super::report::DatagramReport;
use super::stream_receiver::StreamReceiver;
use crate::downlink::transport::packet_archive::Ticket;
use crate::downlink::wire::cadu::SYNC_MARKER;

const DATAGRAM_BYTES_MAX: usize = 1 << 16;
/// Number of bytes of datagrams after which they are processed.
const ROUND_BYTES: usize = 1 << 20;
/// Maximum number of senders; a further one replaces the one that has been silent longest.
const SENDERS_MAX: usize = 64;
/// Interval at which packets are synchronised to disk and the system's count of dropped datagrams is read.
const TICK: Duration = Duration::from_secs(1);

/// The receivers of one sender of datagrams. A packet is complete in its datagram; a frame continues the one before it.
struct DatagramSender {
    peer: SocketAddr,
    packets: StreamReceiver,
    frames: StreamReceiver,
    last_received: Instant,
}

impl DatagramSender {
    fn new(peer: SocketAddr, reception: &SharedReception) -> Self {
        let receiver = || StreamReceiver::new(reception.clone(), Preamble::new(None, false));
        Self { peer, packets: receiver(), frames: receiver(), last_received: Instant::now() }
    }

    fn packets(&self) -> u64 {
        self.packets.packets().0 + self.frames.packets().0
    }
}

struct DatagramSenders {
    reception: SharedReception,
    senders: Vec<DatagramSender>,
}

impl DatagramSenders {
    /// The receivers of a sender, which may be new.
    fn sender(&mut self, peer: SocketAddr) -> &mut DatagramSender {
        let at = match self.senders.iter().position(|sender| sender.peer == peer) {
            Some(at) => at,
            None => {
                let new = DatagramSender::new(peer, &self.reception);
                let oldest = self.senders.iter().enumerate().min_by_key(|(_, sender)| sender.last_received);
                match oldest.map(|(at, _)| at).filter(|_| self.senders.len() >= SENDERS_MAX) {
                    Some(at) => {
                        self.senders[at] = new;
                        at
                    }
                    None => {
                        self.senders.push(new);
                        self.senders.len() - 1
                    }
                }
            }
        };
        &mut self.senders[at]
    }

    /// Processes a datagram and appends its packets to `out`; returns whether it had a valid packet or frame.
    fn receive(
        &mut self,
        peer: SocketAddr,
        bytes: &[u8],
        out: &mut Vec<u8>,
        report: &mut DatagramReport,
    ) -> bool {
        let sender = self.sender(peer);
        let before = sender.packets();
        let activity = match bytes.starts_with(&SYNC_MARKER.to_be_bytes()) {
            true => sender.frames.receive_continued(bytes, out),
            false => sender.packets.receive_datagram(bytes, out),
        };
        sender.last_received = Instant::now();
        report.received += 1;
        report.bytes += bytes.len() as u64;
        report.packets += sender.packets() - before;
        match activity {
            Ok(activity) => {
                report.malformed += u64::from(!activity.has_valid);
                activity.has_valid
            }
            Err(_) => {
                report.refused += 1;
                // The next datagrams from this address may describe the ground's instrument.
                self.senders.retain(|sender| sender.peer != peer);
                false
            }
        }
    }

    /// Ends the streams of all senders; appends their remaining packets to `out`.
    fn finish(&mut self, out: &mut Vec<u8>, report: &mut DatagramReport) {
        for sender in &mut self.senders {
            let before = sender.packets();
            // Packets of an unconfirmed instrument are refused.
            let _ = (sender.packets.finish(out), sender.frames.finish(out));
            report.packets += sender.packets() - before;
        }
    }
}

/// Receives datagrams until the run ends.
pub(super) async fn receive(socket: UdpSocket, shared: Arc<ListenContext>) {
    let mut senders = DatagramSenders { reception: shared.reception.clone(), senders: Vec::new() };
    let mut buffer = vec![0; DATAGRAM_BYTES_MAX];
    let mut unsynced = None;
    let mut tick = Instant::now();
    loop {
        let mut round = Vec::new();
        match race(shared.stopped(), timeout(TICK, socket.recv_from(&mut buffer))).await {
            Race::A(()) => break,
            Race::B(Ok(Ok((length, peer)))) => round.push((peer, buffer[..length].to_vec())),
            Race::B(_) => {}
        }
        let mut bytes = 0;
        while bytes < ROUND_BYTES && !round.is_empty() {
            let Ok((length, peer)) = socket.try_recv_from(&mut buffer) else { break };
            bytes += length;
            round.push((peer, buffer[..length].to_vec()));
        }
        let Some((returned, packets)) = process_round(senders, round, &shared).await else { return };
        senders = returned;
        match forward(packets, &shared).await {
            Some(ticket) => unsynced = ticket.or(unsynced),
            None => break,
        }
        if tick.elapsed() >= TICK {
            tick = Instant::now();
            if let Some(report) = &mut shared.listening.write().datagrams {
                report.dropped_by_system = dropped_by_system(&socket);
            }
            sync(unsynced.take(), &shared).await;
        }
    }
    let mut packets = Vec::new();
    if let Some(report) = &mut shared.listening.write().datagrams {
        senders.finish(&mut packets, report);
        report.dropped_by_system = dropped_by_system(&socket);
    }
    let last = forward(packets, &shared).await.flatten();
    sync(last.or(unsynced), &shared).await;
}

/// Finds the packets of some datagrams on another thread, so that the work does not delay other senders.
async fn process_round(
    mut senders: DatagramSenders,
    round: Vec<(SocketAddr, Vec<u8>)>,
    shared: &Arc<ListenContext>,
) -> Option<(DatagramSenders, Vec<u8>)> {
    let status = &shared.listening.status;
    status.bytes.fetch_add(round.iter().map(|(_, bytes)| bytes.len() as u64).sum(), Ordering::Relaxed);
    let mut report = shared.listening.write().datagrams.clone().unwrap_or_default();
    let processed = spawn_blocking(move || {
        let (mut packets, mut has_valid) = (Vec::new(), false);
        for (peer, bytes) in round {
            has_valid |= senders.receive(peer, &bytes, &mut packets, &mut report);
        }
        (senders, packets, report, has_valid)
    });
    let (senders, packets, report, has_valid) = processed.await.ok()?;
    shared.listening.write().datagrams = Some(report);
    if has_valid {
        shared.record_activity();
        status.record_activity();
    }
    Some((senders, packets))
}

/// Forwards packets to the ground once the backlog has space; returns a ticket for those that must be on disk, and `None` if
/// the ground accepts no more packets.
async fn forward(bytes: Vec<u8>, shared: &Arc<ListenContext>) -> Option<Option<Ticket>> {
    if bytes.is_empty() {
        return Some(None);
    }
    let needed = bytes.len().min(ListenContext::backlog_capacity(&shared.config));
    let needed = u32::try_from(needed).unwrap_or(u32::MAX);
    let space = Arc::clone(&shared.backlog).acquire_many_owned(needed).await.ok()?;
    let batch = PacketBatch { bytes, space, arrived: std::time::Instant::now() };
    let shared = Arc::clone(shared);
    // The disk may be slow.
    let forwarded = spawn_blocking(move || shared.forward(batch)).await.ok().flatten()?;
    // A sender of datagrams gets no answer; the archive's report has the failure.
    Some(forwarded.ticket.ok().flatten())
}

async fn sync(ticket: Option<Ticket>, shared: &ListenContext) {
    if let (Some(ticket), Some(archive)) = (ticket, shared.archive.clone()) {
        // The archive's report has a failure.
        let _ = spawn_blocking(move || archive.sync(ticket)).await;
    }
}

/// Number of datagrams that the system dropped before they were read; `None` if the system does not report it.
#[cfg(not(unix))]
fn dropped_by_system(_: &UdpSocket) -> Option<u64> {
    None
}

/// Number of datagrams that the system dropped before they were read; `None` if the system does not report it.
#[cfg(unix)]
fn dropped_by_system(socket: &UdpSocket) -> Option<u64> {
    use std::os::fd::AsRawFd;
    let link = std::fs::read_link(format!("/proc/self/fd/{}", socket.as_raw_fd())).ok()?;
    let inode = link.to_str()?.strip_prefix("socket:[")?.strip_suffix(']')?.to_owned();
    let tables = ["/proc/net/udp", "/proc/net/udp6"].map(std::fs::read_to_string);
    tables.iter().flatten().find_map(|table| dropped_in(table, &inode))
}

/// The last column of a socket's row, by its inode (proc(5), net/udp).
#[cfg(unix)]
fn dropped_in(table: &str, inode: &str) -> Option<u64> {
    let rows = table.lines().map(|row| row.split_whitespace().collect::<Vec<_>>());
    let row = rows.filter(|row| row.len() > 10).find(|row| row[9] == inode)?;
    row.last()?.parse().ok()
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn the_number_of_dropped_datagrams_is_read_from_the_systems_table() {
        let table = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ref pointer drops\n\
                     1: 0100007F:1267 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4711 2 0000000000000000 0\n\
                     2: 0100007F:1268 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4712 2 0000000000000000 31\n";
        assert_eq!(dropped_in(table, "4712"), Some(31));
        assert_eq!(dropped_in(table, "4713"), None);
    }
}
