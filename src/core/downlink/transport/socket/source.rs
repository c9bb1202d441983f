//! The source of the packets of all senders.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam_channel::{Receiver, RecvTimeoutError, unbounded};
use tokio::sync::{Semaphore, watch};

use super::accept::listen;
use super::answers::HeldAnswers;
use super::instrument_filter::{InstrumentCheck, SharedReception};
use super::listener::{ListenContext, ListenLimits, NoteHandler, Notes, PacketBatch};
use super::report::{DatagramReport, Listening};
use super::slots::ConnectionSlots;
use super::stations::Stations;
use super::url::{TcpUrl, udp_url};
use crate::downlink::config::ListenConfig;
use crate::downlink::error::{DownlinkError, SocketError};
use crate::downlink::transport::packet_archive::PacketArchive;
use crate::frames::Instrument;
use crate::runtime::{Flow, Outlet, Source, Units};

/// Maximum wait for packets between two checks for the end of the run.
const POLL: Duration = Duration::from_millis(100);

/// Listens, and forwards the complete packets of all senders in the order in which they are found.
pub struct SocketSource {
    addresses: Vec<String>,
    config: ListenConfig,
    until: ListenLimits,
    /// What the listener's thread needs; `None` once it has started.
    pending: Option<PendingListener>,
    datagrams: Option<std::net::UdpSocket>,
    running: Option<(Receiver<PacketBatch>, JoinHandle<()>)>,
    backlog: Arc<Semaphore>,
    held: Option<HeldAnswers>,
    archive: Option<PacketArchive>,
    stations: Option<Arc<Stations>>,
    stop: Arc<watch::Sender<bool>>,
    listening: Listening,
    bytes: u64,
}

struct PendingListener {
    listener: Option<std::net::TcpListener>,
    reception: SharedReception,
    note_handler: NoteHandler,
}

impl SocketSource {
    /// Binds one of the addresses; without addresses, the source receives only datagrams. Senders can connect from now on, and
    /// are served once the run starts.
    ///
    /// # Errors
    /// No address can be bound.
    pub fn bind(
        addresses: &[SocketAddr],
        config: &ListenConfig,
        until: ListenLimits,
    ) -> Result<Self, SocketError> {
        let failed = |source| {
            let unspecified = SocketAddr::from(([0, 0, 0, 0], 0));
            SocketError::Listen {
                url: TcpUrl::from(addresses.first().copied().unwrap_or(unspecified)).to_string(),
                source,
            }
        };
        let bind = || {
            let listener = std::net::TcpListener::bind(addresses)?;
            listener.set_nonblocking(true)?;
            Ok((TcpUrl::from(listener.local_addr()?).to_string(), listener))
        };
        let bound = (!addresses.is_empty()).then(bind).transpose().map_err(failed)?;
        let (addresses, listener) = match bound {
            Some((url, listener)) => (vec![url], Some(listener)),
            None => (Vec::new(), None),
        };
        let listening = Listening::default();
        listening.write().address = addresses.concat();
        Ok(Self {
            addresses,
            config: config.clone(),
            until,
            pending: Some(PendingListener {
                listener,
                reception: SharedReception::default(),
                note_handler: Box::new(|_| {}),
            }),
            datagrams: None,
            running: None,
            backlog: Arc::new(Semaphore::new(ListenContext::backlog_capacity(config))),
            held: None,
            archive: None,
            stations: None,
            stop: Arc::new(watch::Sender::new(false)),
            listening,
            bytes: 0,
        })
    }

    /// Also receives datagrams, each with packets or a frame, at one of the addresses.
    ///
    /// # Errors
    /// No address can be bound.
    pub fn with_datagrams(mut self, addresses: &[SocketAddr]) -> Result<Self, SocketError> {
        let bind = || {
            let socket = std::net::UdpSocket::bind(addresses)?;
            socket.set_nonblocking(true)?;
            Ok((udp_url(socket.local_addr()?), socket))
        };
        let failed = |source| SocketError::Listen {
            url: addresses.first().map_or(String::new(), |first| udp_url(*first)),
            source,
        };
        let (address, socket) = bind().map_err(failed)?;
        let report = DatagramReport { address: address.clone(), ..DatagramReport::default() };
        self.listening.write().datagrams = Some(report);
        self.addresses.push(address);
        self.datagrams = Some(socket);
        Ok(self)
    }

    /// Accepts packets of this instrument only. With `None`, the source adopts the first instrument whose visibilities come with
    /// positions.
    #[must_use]
    pub fn with_instrument(self, instrument: Option<Instrument>) -> Self {
        if let (Some(pending), Some(instrument)) = (&self.pending, &instrument) {
            pending.reception.adopt_or_compare(instrument);
        }
        self
    }

    /// Adopts an instrument only if `is_supported` returns true.
    #[must_use]
    pub fn with_instrument_check(mut self, is_supported: InstrumentCheck) -> Self {
        if let Some(pending) = &mut self.pending {
            pending.reception.set_instrument_check(is_supported);
        }
        self
    }

    /// Answers senders that request `held`, through `answers`, which the ground that writes the checkpoints must share. Without
    /// it such senders are refused.
    #[must_use]
    pub fn with_held_answers(mut self, answers: &HeldAnswers) -> Self {
        self.held = Some(answers.clone());
        self
    }

    /// Keeps packets in `archive` before they are acknowledged to their sender.
    #[must_use]
    pub fn with_archive(mut self, archive: &PacketArchive) -> Self {
        self.archive = Some(archive.clone());
        self.listening.archive = Some(archive.clone());
        self
    }

    /// Accepts packets of these stations only.
    #[must_use]
    pub fn with_stations(mut self, stations: Stations) -> Self {
        self.listening.write().add_stations(stations.names());
        self.stations = Some(Arc::new(stations));
        self
    }

    /// Calls `note_handler` with events of connections.
    #[must_use]
    pub fn with_note_handler(mut self, note_handler: NoteHandler) -> Self {
        if let Some(pending) = &mut self.pending {
            pending.note_handler = note_handler;
        }
        self
    }

    /// The bound addresses, with the ports that the system chose for port 0.
    #[must_use]
    pub fn addresses(&self) -> &[String] {
        &self.addresses
    }

    /// Status and report of the connections.
    #[must_use]
    pub fn listening(&self) -> Listening {
        self.listening.clone()
    }

    fn start(&mut self) -> Result<(), SocketError> {
        let Some(PendingListener { listener, reception, note_handler }) = self.pending.take() else {
            return Ok(());
        };
        let failed = |source: io::Error| SocketError::Start { source };
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            // Two more: for datagrams, and for a connection whose packets are synchronised to disk while another has its slot.
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
        // Bounded by the space that batches occupy in the backlog.
        let (batches, receiver) = unbounded();
        let shared = Arc::new(ListenContext {
            config: self.config.clone(),
            until: self.until,
            reception,
            listening: self.listening.clone(),
            slots: ConnectionSlots::default(),
            backlog: Arc::clone(&self.backlog),
            batches,
            forwarded: Mutex::new(0),
            held: self.held.clone(),
            archive: self.archive.clone(),
            stations: self.stations.clone(),
            stop: Arc::clone(&self.stop),
            notes: Notes::new(note_handler),
            last_activity: Mutex::new(tokio::time::Instant::now()),
        });
        let run = move || runtime.block_on(listen(sockets, shared));
        let thread = std::thread::Builder::new().name("listen-net".to_owned()).spawn(run).map_err(failed)?;
        self.running = Some((receiver, thread));
        Ok(())
    }

    /// Forwards a batch and frees its space in the backlog.
    fn forward(&mut self, batch: PacketBatch, out: &mut Outlet<Vec<u8>>) {
        self.bytes += batch.bytes.len() as u64;
        out.push_since(batch.bytes, batch.arrived);
        drop(batch.space);
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
        if self.pending.is_some() && self.held.is_some() {
            // An empty piece lets the ground report the bytes that its state contains.
            out.push(Vec::new());
        }
        self.start()?;
        let Some((receiver, _)) = &self.running else { return Ok(Flow::Done) };
        match out.await_input(|| receiver.recv_timeout(POLL)) {
            Ok(batch) => self.forward(batch, out),
            Err(RecvTimeoutError::Timeout) => self.listening.status.clear_backlog(),
            Err(RecvTimeoutError::Disconnected) => {
                self.join()?;
                return Ok(Flow::Done);
            }
        }
        if self.held.as_ref().is_some_and(|held| held.request_checkpoint(self.bytes)) {
            // An empty piece lets the ground write a checkpoint.
            out.push(Vec::new());
        }
        Ok(Flow::Continue)
    }

    /// Stops reading, and forwards all packets that have been read.
    fn finish(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<(), DownlinkError> {
        self.stop.send_replace(true);
        while let Some(batch) = self.running.as_ref().and_then(|(receiver, _)| receiver.recv().ok()) {
            self.forward(batch, out);
        }
        Ok(self.join()?)
    }

    fn units(&self) -> Units {
        Units::of(self.bytes, "bytes")
    }
}

impl Drop for SocketSource {
    /// Ends connections that wait for space in the backlog, which nobody empties after a failure elsewhere.
    fn drop(&mut self) {
        self.stop.send_replace(true);
        self.backlog.close();
    }
}
