//! Replays a recorded downlink at the pace at which it was sent, faster, or step by step.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError};

use crate::downlink::error::DownlinkError;
use crate::downlink::receive::{DownlinkReceiver, Event};
use crate::downlink::wire::{CucTime, Format, PacketHeader, PacketKind};
use crate::runtime::{Flow, Outlet, Source, Units};

/// Bytes examined between two decisions about their release: far less than a coded frame.
const PIECE_BYTES: usize = 128;

/// Longest wait between two checks for the end of the run.
const POLL: Duration = Duration::from_millis(100);

/// When packets are released.
pub enum Pace {
    /// At this multiple of real time.
    Speed(f64),
    /// On request.
    Steps(Steps),
}

/// Steps on request.
pub struct Steps {
    /// Mission time of a step, s; `None` for one pass per step.
    pub every_s: Option<f64>,
    /// One step per message. The stream ends when the channel is disconnected.
    pub go: Receiver<()>,
    /// Called whenever the stream waits for a step.
    pub tell: Box<dyn Fn(&str) + Send + Sync>,
}

/// What the stream waits for.
#[derive(Clone, Copy, Debug)]
enum Gate {
    Open,
    /// An instant.
    Until(Instant),
    /// The next step.
    Step,
}

/// Passes on the bytes of a source unchanged, but no packet before its time. Times are the creation times in the
/// packets' headers.
pub struct PacedSource<S> {
    source: S,
    pace: Pace,
    gate: Gate,
    /// Finds the packets ahead of their release.
    scout: DownlinkReceiver,
    /// Chunks not yet released, and the number of bytes of the first that the scout has examined.
    pending: VecDeque<Vec<u8>>,
    scouted: usize,
    /// Bytes released so far.
    given: u64,
    /// When the first packet was released, and its time.
    start: Option<(Instant, CucTime)>,
    newest: CucTime,
    /// Packet time at which the next step begins.
    mark: CucTime,
    /// Whether a pass has ended since the last step.
    pass_over: bool,
    /// Whether positions or visibilities came since the last report of the spacecraft's counts.
    in_pass: bool,
    steps: u64,
    ended: bool,
}

impl<S> PacedSource<S> {
    /// Paces a source.
    #[must_use]
    pub fn new(source: S, pace: Pace) -> Self {
        Self {
            source,
            pace,
            gate: Gate::Open,
            scout: DownlinkReceiver::unfiltered(),
            pending: VecDeque::new(),
            scouted: 0,
            given: 0,
            start: None,
            newest: CucTime::default(),
            mark: CucTime::default(),
            pass_over: false,
            in_pass: false,
            steps: 0,
            ended: false,
        }
    }

    /// The source itself.
    pub fn source(&self) -> &S {
        &self.source
    }

    /// Examines the next bytes. Returns how many may be released: all, unless the gate closes.
    fn scout(&mut self, bytes: &[u8]) -> usize {
        while self.scouted < bytes.len() {
            let from = self.scouted;
            let to = bytes.len().min(from + PIECE_BYTES);
            self.scout.push(&bytes[from..to]);
            self.scouted = to;
            let mut first_held = None;
            while let Some(event) = self.scout.next_event() {
                let Event::Packet(packet) = event else { continue };
                let (header, offset) = (packet.header, packet.offset);
                if let Some(gate) = gate_for(&self.pace, self.start, self.mark, self.pass_over, &header) {
                    self.gate = gate;
                    first_held.get_or_insert(offset);
                }
                self.note(&header);
            }
            if let Some(offset) = first_held {
                let plain = self.scout.format() != Some(Format::Cadu);
                let packet = offset.saturating_sub(self.given) as usize;
                return if plain { from.min(packet) } else { from };
            }
        }
        bytes.len()
    }

    /// Records a packet that is released now or when the gate opens.
    fn note(&mut self, header: &PacketHeader) {
        self.start.get_or_insert_with(|| (Instant::now(), header.time));
        self.newest = self.newest.max(header.time);
        // A report ends a pass if something else came since the last one; else it begins the next.
        self.pass_over = header.kind == PacketKind::Housekeeping && self.in_pass;
        match header.kind {
            PacketKind::Housekeeping => self.in_pass = false,
            PacketKind::Ephemeris | PacketKind::Visibilities => self.in_pass = true,
            PacketKind::Instrument | PacketKind::Calibration => {}
        }
        if let Pace::Steps(Steps { every_s: Some(every_s), .. }) = self.pace {
            let step = ((every_s * f64::from(1 << 24)) as u64).max(1);
            let begun = self.newest.0.saturating_sub(self.mark.0);
            let first = self.mark == CucTime::default();
            if first {
                self.mark = CucTime(self.newest.0.saturating_add(step));
            } else if self.newest >= self.mark {
                self.mark = CucTime(self.mark.0.saturating_add((begun / step + 1).saturating_mul(step)));
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
            (Gate::Step, Pace::Steps(steps)) => match steps.go.recv_timeout(POLL) {
                Ok(()) => self.gate = Gate::Open,
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => self.ended = true,
            },
            _ => self.gate = Gate::Open,
        }
    }

    /// Releases bytes.
    fn give(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) {
        self.given += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
    }

    fn announce_step(&mut self) {
        self.steps += 1;
        if let Pace::Steps(steps) = &self.pace {
            let (now, start) = (self.newest.tai_s(), self.start.map_or(0.0, |(_, time)| time.tai_s()));
            let hours = (now - start) / 3600.0;
            (steps.tell)(&format!("step {} at {hours:.2} h: Enter continues, end of input ends", self.steps));
        }
    }
}

/// What a packet has to wait for, if anything.
fn gate_for(
    pace: &Pace,
    start: Option<(Instant, CucTime)>,
    mark: CucTime,
    pass_over: bool,
    header: &PacketHeader,
) -> Option<Gate> {
    let (since, time) = start?;
    match pace {
        Pace::Speed(speed) => {
            let due = since + Duration::from_secs_f64((header.time.tai_s() - time.tai_s()).max(0.0) / speed);
            (due > Instant::now()).then_some(Gate::Until(due))
        }
        Pace::Steps(Steps { every_s: Some(_), .. }) => (header.time >= mark).then_some(Gate::Step),
        Pace::Steps(Steps { every_s: None, .. }) => pass_over.then_some(Gate::Step),
    }
}

impl<S: Source<Out = Vec<u8>, Error = DownlinkError>> Source for PacedSource<S> {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        if !matches!(self.gate, Gate::Open) {
            out.await_input(|| self.wait());
            return Ok(if self.ended { Flow::Done } else { Flow::Continue });
        }
        let Some(mut bytes) = self.pending.pop_front() else {
            let mut read = Outlet::collect();
            let flow = self.source.next(&mut read)?;
            self.pending.extend(read.into_vec());
            return Ok(if self.pending.is_empty() { flow } else { Flow::Continue });
        };
        let goes = self.scout(&bytes);
        if goes < bytes.len() || !matches!(self.gate, Gate::Open) {
            let rest = bytes.split_off(goes);
            self.scouted -= goes;
            self.pending.push_front(rest);
        } else {
            self.scouted = 0;
        }
        self.give(bytes, out);
        if matches!(self.gate, Gate::Step) {
            self.announce_step();
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.given, "bytes")
    }
}
