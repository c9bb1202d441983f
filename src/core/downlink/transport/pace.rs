//! Replays a recorded downlink at the pace at which it was sent, faster, or step by step.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError};

use crate::downlink::error::DownlinkError;
use crate::downlink::receive::{DownlinkReceiver, Event};
use crate::downlink::wire::{CucTime, Format, PacketHeader, PacketKind};
use crate::runtime::{Flow, Outlet, Source, Units};

/// Number of bytes examined between two decisions about their release, far less than a coded frame.
const PIECE_BYTES: usize = 128;

/// Maximum wait between two checks for the end of the run.
const POLL: Duration = Duration::from_millis(100);

/// When packets are released.
pub enum Pace {
    /// At this multiple of real time.
    Speed(f64),
    /// Step by step, on request.
    Steps(Steps),
}

/// A replay step by step.
pub struct Steps {
    /// Mission time of a step, s; `None` for one pass per step.
    pub every_s: Option<f64>,
    /// Requests of steps, one per message. The stream ends when the channel is disconnected.
    pub requests: Receiver<()>,
    /// Called with a prompt whenever the stream waits for a request.
    pub prompt: Box<dyn Fn(&str) + Send + Sync>,
}

/// Whether packets are released, and what the stream waits for otherwise.
#[derive(Clone, Copy, Debug)]
enum Gate {
    Open,
    /// Closed until an instant.
    Until(Instant),
    /// Closed until the next step is requested.
    Step,
}

/// Forwards the bytes of a source unchanged, but no packet before its time, which is the creation time in its header.
pub struct PacedSource<S> {
    source: S,
    pace: Pace,
    gate: Gate,
    /// Receiver that finds packets before their release.
    lookahead: DownlinkReceiver,
    /// Chunks that have not been released.
    pending: VecDeque<Vec<u8>>,
    /// Number of bytes of the first chunk that have been examined.
    examined: usize,
    released: u64,
    /// When the first packet was released, and its time.
    start: Option<(Instant, CucTime)>,
    latest: CucTime,
    /// Packet time at which the next step begins.
    next_step: CucTime,
    /// Whether a pass has just ended.
    pass_ended: bool,
    /// Whether positions or visibilities came since the last housekeeping report.
    in_pass: bool,
    steps: u64,
    is_ended: bool,
}

impl<S> PacedSource<S> {
    /// Paces a source.
    #[must_use]
    pub fn new(source: S, pace: Pace) -> Self {
        Self {
            source,
            pace,
            gate: Gate::Open,
            lookahead: DownlinkReceiver::unfiltered(),
            pending: VecDeque::new(),
            examined: 0,
            released: 0,
            start: None,
            latest: CucTime::default(),
            next_step: CucTime::default(),
            pass_ended: false,
            in_pass: false,
            steps: 0,
            is_ended: false,
        }
    }

    /// The source that is paced.
    pub fn source(&self) -> &S {
        &self.source
    }

    /// Examines the next bytes; returns how many may be released: all, unless the gate closes.
    fn examine(&mut self, bytes: &[u8]) -> usize {
        while self.examined < bytes.len() {
            let from = self.examined;
            let to = bytes.len().min(from + PIECE_BYTES);
            self.lookahead.push(&bytes[from..to]);
            self.examined = to;
            let mut first_retained = None;
            while let Some(event) = self.lookahead.next_event() {
                let Event::Packet(packet) = event else { continue };
                let (header, offset) = (packet.header, packet.offset);
                if let Some(gate) = gate_for(&self.pace, self.start, self.next_step, self.pass_ended, &header)
                {
                    self.gate = gate;
                    first_retained.get_or_insert(offset);
                }
                self.record(&header);
            }
            if let Some(offset) = first_retained {
                let is_plain = self.lookahead.format() != Some(Format::Cadu);
                let packet = offset.saturating_sub(self.released) as usize;
                return if is_plain { from.min(packet) } else { from };
            }
        }
        bytes.len()
    }

    /// Records a packet, which is released now or when the gate opens.
    fn record(&mut self, header: &PacketHeader) {
        self.start.get_or_insert_with(|| (Instant::now(), header.time));
        self.latest = self.latest.max(header.time);
        // A report ends a pass if data came since the last report; otherwise it begins a pass.
        self.pass_ended = header.kind == PacketKind::Housekeeping && self.in_pass;
        match header.kind {
            PacketKind::Housekeeping => self.in_pass = false,
            PacketKind::Ephemeris | PacketKind::Visibilities => self.in_pass = true,
            PacketKind::Instrument | PacketKind::Calibration => {}
        }
        if let Pace::Steps(Steps { every_s: Some(every_s), .. }) = self.pace {
            let step = ((every_s * f64::from(1 << 24)) as u64).max(1);
            let excess = self.latest.0.saturating_sub(self.next_step.0);
            let is_first = self.next_step == CucTime::default();
            if is_first {
                self.next_step = CucTime(self.latest.0.saturating_add(step));
            } else if self.latest >= self.next_step {
                self.next_step =
                    CucTime(self.next_step.0.saturating_add((excess / step + 1).saturating_mul(step)));
            }
        }
    }

    /// Waits at the gate for at most [`POLL`].
    fn wait(&mut self) {
        match (self.gate, &self.pace) {
            (Gate::Until(due), _) => {
                std::thread::sleep(due.saturating_duration_since(Instant::now()).min(POLL));
                if Instant::now() >= due {
                    self.gate = Gate::Open;
                }
            }
            (Gate::Step, Pace::Steps(steps)) => match steps.requests.recv_timeout(POLL) {
                Ok(()) => self.gate = Gate::Open,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => self.is_ended = true,
            },
            _ => self.gate = Gate::Open,
        }
    }

    fn release(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) {
        self.released += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
    }

    fn prompt(&mut self) {
        self.steps += 1;
        if let Pace::Steps(steps) = &self.pace {
            let (now, start) = (self.latest.tai_s(), self.start.map_or(0.0, |(_, time)| time.tai_s()));
            let hours = (now - start) / 3600.0;
            (steps.prompt)(&format!(
                "step {} at {hours:.2} h: Enter continues, end of input ends the run",
                self.steps
            ));
        }
    }
}

/// What a packet has to wait for; `None` if it may be released.
fn gate_for(
    pace: &Pace,
    start: Option<(Instant, CucTime)>,
    next_step: CucTime,
    pass_ended: bool,
    header: &PacketHeader,
) -> Option<Gate> {
    let (since, time) = start?;
    match pace {
        Pace::Speed(speed) => {
            let due = since + Duration::from_secs_f64((header.time.tai_s() - time.tai_s()).max(0.0) / speed);
            (due > Instant::now()).then_some(Gate::Until(due))
        }
        Pace::Steps(Steps { every_s: Some(_), .. }) => (header.time >= next_step).then_some(Gate::Step),
        Pace::Steps(Steps { every_s: None, .. }) => pass_ended.then_some(Gate::Step),
    }
}

impl<S: Source<Out = Vec<u8>, Error = DownlinkError>> Source for PacedSource<S> {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        if !matches!(self.gate, Gate::Open) {
            out.await_input(|| self.wait());
            return Ok(if self.is_ended { Flow::Done } else { Flow::Continue });
        }
        let Some(mut bytes) = self.pending.pop_front() else {
            let mut read = Outlet::collect();
            let flow = self.source.next(&mut read)?;
            self.pending.extend(read.into_vec());
            return Ok(if self.pending.is_empty() { flow } else { Flow::Continue });
        };
        let releasable = self.examine(&bytes);
        if releasable < bytes.len() || !matches!(self.gate, Gate::Open) {
            let rest = bytes.split_off(releasable);
            self.examined -= releasable;
            self.pending.push_front(rest);
        } else {
            self.examined = 0;
        }
        self.release(bytes, out);
        if matches!(self.gate, Gate::Step) {
            self.prompt();
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.released, "bytes")
    }
}
