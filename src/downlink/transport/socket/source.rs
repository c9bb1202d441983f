//! The packets of all senders, as a source.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, unbounded};
use tokio::sync::{Semaphore, watch};

use super::accept::listen;
use super::answers::HeldAnswers;
use super::config::ListenConfig;
use super::error::SocketError;
use super::listener::{ListenContext, ListenLimits, NoteHandler, Notes, PacketBatch};
use super::report::{DatagramReport, Listening};
use super::seats::Seats;
use super::sender_intake::{InstrumentCheck, Mission};
use super::stations::Stations;
use super::url::{TcpUrl, udp_name};
use crate::downlink::error::DownlinkError;
use crate::downlink::transport::packet_archive::PacketArchive;
use crate::frames::Instrument;
use crate::runtime::{Flow, Outlet, Source, Units};

/// Longest wait for packets between two checks for the end of the run.
const POLL: Duration = Duration::from_millis(100);

/// Listens, and passes on whole packets of all senders in the order in which they are found.
pub struct SocketSource {
    addresses: Vec<String>,
    config: ListenConfig,
    until: ListenLimits,
    /// Set until the run starts.
    waiting: Option<(Option<std::net::TcpListener>, Mission, NoteHandler)>,
    datagrams: Option<std::net::UdpSocket>,
    running: Option<(Receiver<PacketBatch>, JoinHandle<()>)>,
    room: Arc<Semaphore>,
    held: Option<HeldAnswers>,
    archive: Option<PacketArchive>,
    stations: Option<Arc<Stations>>,
    stop: Arc<watch::Sender<bool>>,
    listening: Listening,
    bytes: u64,
}

impl SocketSource {
    /// Binds one of the addresses; without any, only datagrams come. Senders may connect from now on; they are served when the run
    /// starts.
    ///
    /// # Errors
    /// No address can be bound.
    pub fn bind(
        addresses: &[SocketAddr],
        config: &ListenConfig,
        until: ListenLimits,
    ) -> Result<Self, SocketError> {
        let failed = |source| {
            let none = SocketAddr::from(([0, 0, 0, 0], 0));
            SocketError::Listen {
                url: TcpUrl::from(addresses.first().copied().unwrap_or(none)).to_string(),
                source,
            }
        };
        let bind = || {
            let listener = std::net::TcpListener::bind(addresses)?;
            listener.set_nonblocking(true)?;
            Ok((TcpUrl::from(listener.local_addr()?).to_string(), listener))
        };
        let bound = (!addresses.is_empty()).then(bind).transpose().map_err(failed)?;
        let (addresses, listener) = bound.map_or((Vec::new(), None), |(url, it)| (vec![url], Some(it)));
        let listening = Listening::default();
        listening.write().address = addresses.concat();
        Ok(Self {
            addresses,
            config: config.clone(),
            until,
            waiting: Some((listener, Mission::default(), Box::new(|_| {}))),
            datagrams: None,
            running: None,
            room: Arc::new(Semaphore::new(ListenContext::room_bytes(config))),
            held: None,
            archive: None,
            stations: None,
            stop: Arc::new(watch::Sender::new(false)),
            listening,
            bytes: 0,
        })
    }

    /// Listens for datagrams too, each a packet or a frame, at one of the addresses.
    ///
    /// # Errors
    /// No address can be bound.
    pub fn with_datagrams(mut self, addresses: &[SocketAddr]) -> Result<Self, SocketError> {
        let bind = || {
            let socket = std::net::UdpSocket::bind(addresses)?;
            socket.set_nonblocking(true)?;
            Ok((udp_name(socket.local_addr()?), socket))
        };
        let failed = |source| SocketError::Listen {
            url: addresses.first().map_or(String::new(), |first| udp_name(*first)),
            source,
        };
        let (address, socket) = bind().map_err(failed)?;
        let report = DatagramReport { address: address.clone(), ..DatagramReport::default() };
        self.listening.write().datagrams = Some(report);
        self.addresses.push(address);
        self.datagrams = Some(socket);
        Ok(self)
    }

    /// Accepts packets of this instrument only; with `None`, of the first whose visibilities come with positions.
    #[must_use]
    pub fn with_instrument(self, instrument: Option<Instrument>) -> Self {
        if let (Some((_, mission, _)), Some(instrument)) = (&self.waiting, &instrument) {
            mission.confirm(instrument);
        }
        self
    }

    /// Accepts an instrument only if `fits` says so.
    #[must_use]
    pub fn with_instrument_check(mut self, fits: InstrumentCheck) -> Self {
        if let Some((listener, mission, tell)) = self.waiting.take() {
            self.waiting = Some((listener, mission.with_instrument_check(fits), tell));
        }
        self
    }

    /// Answers senders that ask what checkpoints hold, through `answers`; the ground that writes them has to share it. Without it they
    /// are refused.
    #[must_use]
    pub fn with_held_answers(mut self, answers: &HeldAnswers) -> Self {
        self.held = Some(answers.clone());
        self
    }

    /// Keeps packets in `archive` before it tells a sender that they are taken.
    #[must_use]
    pub fn with_archive(mut self, archive: &PacketArchive) -> Self {
        self.archive = Some(archive.clone());
        self.listening.archive = Some(archive.clone());
        self
    }

    /// Takes packets of these stations only.
    #[must_use]
    pub fn with_stations(mut self, stations: Stations) -> Self {
        // Also those that never send.
        self.listening.write().know(stations.names());
        self.stations = Some(Arc::new(stations));
        self
    }

    /// Reports what happens to connections, one note at a time.
    #[must_use]
    pub fn with_note_handler(mut self, tell: NoteHandler) -> Self {
        if let Some((_, _, teller)) = &mut self.waiting {
            *teller = tell;
        }
        self
    }

    /// The addresses bound, with the ports that the system chose for port 0.
    #[must_use]
    pub fn addresses(&self) -> &[String] {
        &self.addresses
    }

    /// Status and report of its connections.
    #[must_use]
    pub fn listening(&self) -> Listening {
        self.listening.clone()
    }

    /// Starts the listener's thread.
    fn start(&mut self) -> Result<(), SocketError> {
        let Some((listener, mission, tell)) = self.waiting.take() else { return Ok(()) };
        let failed = |source: io::Error| SocketError::Start { source };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            // Two more: packets of a connection that ends reach the disk while another takes its place, and datagrams.
            .max_blocking_threads(self.config.connections_max + 2)
            .thread_name("listen-work")
            .build()
            .map_err(failed)?;
        let sockets = {
            let _inside = runtime.enter();
            let listener = listener.map(tokio::net::TcpListener::from_std).transpose().map_err(failed)?;
            let datagrams = self.datagrams.take().map(tokio::net::UdpSocket::from_std);
            (listener, datagrams.transpose().map_err(failed)?)
        };
        // Bounded by the room that batches occupy.
        let (batches, receiver) = unbounded();
        let shared = Arc::new(ListenContext {
            config: self.config.clone(),
            until: self.until,
            mission,
            listening: self.listening.clone(),
            seats: Seats::default(),
            room: Arc::clone(&self.room),
            batches,
            passed: Mutex::new(0),
            held: self.held.clone(),
            archive: self.archive.clone(),
            stations: self.stations.clone(),
            stop: Arc::clone(&self.stop),
            notes: Notes::new(tell),
            sign: Mutex::new(tokio::time::Instant::now()),
        });
        let run = move || runtime.block_on(listen(sockets, shared));
        let thread = std::thread::Builder::new().name("listen-net".to_owned()).spawn(run).map_err(failed)?;
        self.running = Some((receiver, thread));
        Ok(())
    }

    fn give(&mut self, batch: PacketBatch, out: &mut Outlet<Vec<u8>>) {
        self.bytes += batch.bytes.len() as u64;
        out.push_since(batch.bytes, batch.arrived);
        drop(batch.room);
    }

    /// Waits for the listener's thread, which is about to end.
    fn join(&mut self) -> Result<(), SocketError> {
        match self.running.take().map(|(_, thread)| thread.join()) {
            Some(Err(_)) => Err(SocketError::Panicked),
            _ => Ok(()),
        }
    }
}

impl Source for SocketSource {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        if self.waiting.is_some() && self.held.is_some() {
            // Nothing for the ground to take, but an occasion to show what its state holds.
            out.push(Vec::new());
        }
        self.start()?;
        let Some((receiver, _)) = &self.running else { return Ok(Flow::Done) };
        match out.await_input(|| receiver.recv_timeout(POLL)) {
            Ok(batch) => self.give(batch, out),
            Err(RecvTimeoutError::Timeout) => self.listening.status.clear_backlog(),
            Err(RecvTimeoutError::Disconnected) => {
                self.join()?;
                return Ok(Flow::Done);
            }
        }
        if self.held.as_ref().is_some_and(|held| held.ask(self.bytes)) {
            // Nothing for the ground to take, but an occasion for a checkpoint.
            out.push(Vec::new());
        }
        Ok(Flow::Continue)
    }

    /// Stops reading, but passes on what has been read.
    fn finish(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        self.stop.send_replace(true);
        while let Some(batch) = self.running.as_ref().and_then(|(receiver, _)| receiver.recv().ok()) {
            self.give(batch, out);
        }
        Ok(self.join()?)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

impl Drop for SocketSource {
    /// After a failure elsewhere nobody drains the backlog: connections that wait for room must not wait for ever.
    fn drop(&mut self) {
        self.stop.send_replace(true);
        self.room.close();
    }
}
