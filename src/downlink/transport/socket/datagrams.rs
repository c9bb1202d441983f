//! Receives datagrams over UDP, each a packet or a frame.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::net::UdpSocket;
use tokio::task::spawn_blocking;
use tokio::time::{Instant, timeout};

use super::listener::{First, ListenContext, PacketBatch, first};
use super::preamble::Preamble;
use super::report::DatagramReport;
use super::sender_intake::{Mission, SenderIntake};
use crate::downlink::transport::packet_archive::Ticket;
use crate::downlink::wire::cadu::SYNC_MARKER;

/// Longest datagram, bytes.
const DATAGRAM_BYTES_MAX: usize = 1 << 16;
/// Datagrams that are taken at once, bytes.
const ROUND_BYTES: usize = 1 << 20;
/// Senders that are told apart; one more takes the place of the one that has been silent longest.
const SENDERS_MAX: usize = 64;
/// Interval at which what came reaches the disk, and the system's count of lost datagrams is read.
const TICK: Duration = Duration::from_secs(1);

/// Packets and frames of one sender: a packet is whole in its datagram, and a frame goes on with the one before it.
struct DatagramSender {
    peer: SocketAddr,
    packets: SenderIntake,
    frames: SenderIntake,
    heard: Instant,
}

impl DatagramSender {
    fn new(peer: SocketAddr, mission: &Mission) -> Self {
        let intake = || SenderIntake::new(mission.clone(), Preamble::new(None, false));
        Self { peer, packets: intake(), frames: intake(), heard: Instant::now() }
    }

    fn packets(&self) -> u64 {
        self.packets.packets().0 + self.frames.packets().0
    }
}

/// All senders of datagrams.
struct DatagramSenders {
    mission: Mission,
    senders: Vec<DatagramSender>,
}

impl DatagramSenders {
    fn sender(&mut self, peer: SocketAddr) -> &mut DatagramSender {
        let at = match self.senders.iter().position(|sender| sender.peer == peer) {
            Some(at) => at,
            None => {
                let new = DatagramSender::new(peer, &self.mission);
                let oldest = self.senders.iter().enumerate().min_by_key(|(_, sender)| sender.heard);
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

    /// Takes one datagram, and appends its packets to `out`. Returns whether there was a sound packet or frame.
    fn take(
        &mut self,
        peer: SocketAddr,
        bytes: &[u8],
        out: &mut Vec<u8>,
        report: &mut DatagramReport,
    ) -> bool {
        let sender = self.sender(peer);
        let before = sender.packets();
        let found = match bytes.starts_with(&SYNC_MARKER.to_be_bytes()) {
            true => sender.frames.take_frame(bytes, out),
            false => sender.packets.take_packet(bytes, out),
        };
        sender.heard = Instant::now();
        report.received += 1;
        report.bytes += bytes.len() as u64;
        report.packets += sender.packets() - before;
        match found {
            Ok(signs) => {
                report.malformed += u64::from(!signs.is_alive);
                signs.is_alive
            }
            Err(_) => {
                report.refused += 1;
                // Another at the same address may be of the ground's mission.
                self.senders.retain(|sender| sender.peer != peer);
                false
            }
        }
    }

    /// Passes on what waited for the end.
    fn finish(&mut self, out: &mut Vec<u8>, report: &mut DatagramReport) {
        for sender in &mut self.senders {
            let before = sender.packets();
            // What was not confirmed until now never will be.
            let _ = (sender.packets.finish(out), sender.frames.finish(out));
            report.packets += sender.packets() - before;
        }
    }
}

/// Receives datagrams until the run ends.
pub(super) async fn receive(socket: UdpSocket, shared: Arc<ListenContext>) {
    let mut senders = DatagramSenders { mission: shared.mission.clone(), senders: Vec::new() };
    let mut buffer = vec![0; DATAGRAM_BYTES_MAX];
    let mut unsynced = None;
    let mut tick = Instant::now();
    loop {
        let mut round = Vec::new();
        match first(shared.stopped(), timeout(TICK, socket.recv_from(&mut buffer))).await {
            First::A(()) => break,
            First::B(Ok(Ok((length, peer)))) => round.push((peer, buffer[..length].to_vec())),
            First::B(_) => {}
        }
        let mut bytes = 0;
        while bytes < ROUND_BYTES && !round.is_empty() {
            let Ok((length, peer)) = socket.try_recv_from(&mut buffer) else { break };
            bytes += length;
            round.push((peer, buffer[..length].to_vec()));
        }
        let (back, packets) = match take_round(senders, round, &shared).await {
            Some(taken) => taken,
            None => return,
        };
        senders = back;
        match pass_on(packets, &shared).await {
            Some(ticket) => unsynced = ticket.or(unsynced),
            None => break,
        }
        if tick.elapsed() >= TICK {
            tick = Instant::now();
            if let Some(report) = &mut shared.listening.write().datagrams {
                report.dropped_by_system = dropped(&socket);
            }
            sync(unsynced.take(), &shared).await;
        }
    }
    let mut packets = Vec::new();
    if let Some(report) = &mut shared.listening.write().datagrams {
        senders.finish(&mut packets, report);
        report.dropped_by_system = dropped(&socket);
    }
    let last = pass_on(packets, &shared).await.flatten();
    sync(last.or(unsynced), &shared).await;
}

/// Finds the packets of some datagrams, on another thread: the work must not delay other senders.
async fn take_round(
    mut senders: DatagramSenders,
    round: Vec<(SocketAddr, Vec<u8>)>,
    shared: &Arc<ListenContext>,
) -> Option<(DatagramSenders, Vec<u8>)> {
    let status = &shared.listening.status;
    status.bytes.fetch_add(round.iter().map(|(_, bytes)| bytes.len() as u64).sum(), Ordering::Relaxed);
    let mut report = shared.listening.write().datagrams.clone().unwrap_or_default();
    let taken = spawn_blocking(move || {
        let (mut packets, mut is_alive) = (Vec::new(), false);
        for (peer, bytes) in round {
            is_alive |= senders.take(peer, &bytes, &mut packets, &mut report);
        }
        (senders, packets, report, is_alive)
    });
    let (senders, packets, report, is_alive) = taken.await.ok()?;
    shared.listening.write().datagrams = Some(report);
    if is_alive {
        shared.note_sign();
        status.note_heard();
    }
    Some((senders, packets))
}

/// Passes packets to the ground once there is room. Returns what has to reach the disk; `None` if the ground takes no more.
async fn pass_on(bytes: Vec<u8>, shared: &Arc<ListenContext>) -> Option<Option<Ticket>> {
    if bytes.is_empty() {
        return Some(None);
    }
    let needed = bytes.len().min(ListenContext::room_bytes(&shared.config));
    let needed = u32::try_from(needed).unwrap_or(u32::MAX);
    let room = Arc::clone(&shared.room).acquire_many_owned(needed).await.ok()?;
    let batch = PacketBatch { bytes, room, arrived: std::time::Instant::now() };
    let shared = Arc::clone(shared);
    // A disk may be slow.
    let passed = spawn_blocking(move || shared.pass(batch)).await.ok().flatten()?;
    // Nobody can be told to send again; the archive tells that it cannot be written.
    Some(passed.ticket.ok().flatten())
}

/// Brings to the disk what came.
async fn sync(ticket: Option<Ticket>, shared: &ListenContext) {
    if let (Some(ticket), Some(archive)) = (ticket, shared.archive.clone()) {
        // As above.
        let _ = spawn_blocking(move || archive.sync(ticket)).await;
    }
}

/// Datagrams that the system has dropped before they were read, where it says so.
#[cfg(not(unix))]
fn dropped(_: &UdpSocket) -> Option<u64> {
    None
}

/// Datagrams that the system has dropped before they were read, where it says so.
#[cfg(unix)]
fn dropped(socket: &UdpSocket) -> Option<u64> {
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
    fn the_system_says_how_many_datagrams_it_dropped() {
        let table = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ref pointer drops\n\
                     1: 0100007F:1267 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4711 2 0000000000000000 0\n\
                     2: 0100007F:1268 00000000:0000 07 00000000:00000000 00:00000000 00000000     0        0 4712 2 0000000000000000 31\n";
        assert_eq!(dropped_in(table, "4712"), Some(31));
        assert_eq!(dropped_in(table, "4713"), None);
    }
}
