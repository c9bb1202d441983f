//! A recorded downlink at the pace at which it was sent, faster, or step by step.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crossbeam_channel::{Receiver, RecvTimeoutError};

use super::socket::Teller;
use crate::downlink::error::DownlinkError;
use crate::downlink::receive::{Event, Intake};
use crate::downlink::wire::{CucTime, Format, Kind, PacketHeader};
use crate::runtime::{Flow, Outlet, Source, Units};

/// Bytes looked at before it is asked whether they may go: far less than a coded frame.
const PIECE_BYTES: usize = 128;

/// Longest wait before it is looked whether the run has been ended.
const POLL: Duration = Duration::from_millis(100);

/// When packets may go.
pub enum Pace {
    /// So many times as fast as their times pass.
    Speed(f64),
    /// Whenever somebody says so.
    Steps(Steps),
}

/// Going on by hand.
pub struct Steps {
    /// Mission time of a step, s; `None` for a pass.
    pub every_s: Option<f64>,
    /// A step for each message; once nobody can send any more, the stream is at its end.
    pub go: Receiver<()>,
    /// Is told whenever it waits.
    pub tell: Teller,
}

/// What holds the stream up.
#[derive(Clone, Copy, Debug)]
enum Gate {
    Open,
    /// Until then.
    Until(Instant),
    /// Until the next step.
    Step,
}

/// Gives the bytes of a source, all and unchanged, but no packet before its time. Times are those at which packets
/// were made, as their headers have them.
pub struct Paced<S> {
    source: S,
    pace: Pace,
    gate: Gate,
    /// Finds the packets; what it finds is only looked at.
    scout: Intake,
    /// Bytes that have not been given, and how many of the first of them the scout has.
    pending: VecDeque<Vec<u8>>,
    scouted: usize,
    /// Place of the first of them in the stream.
    given: u64,
    /// When the first packet went, and its time.
    start: Option<(Instant, CucTime)>,
    newest: CucTime,
    /// Time at which the next step begins.
    mark: CucTime,
    /// Whether a pass has ended since the last step.
    pass_over: bool,
    steps: u64,
    ended: bool,
}

impl<S> Paced<S> {
    /// A source at a pace.
    #[must_use]
    pub fn new(source: S, pace: Pace) -> Self {
        Self {
            source,
            pace,
            gate: Gate::Open,
            scout: Intake::unfiltered(),
            pending: VecDeque::new(),
            scouted: 0,
            given: 0,
            start: None,
            newest: CucTime::default(),
            mark: CucTime::default(),
            pass_over: false,
            steps: 0,
            ended: false,
        }
    }

    /// The source itself.
    pub fn source(&self) -> &S {
        &self.source
    }

    /// Looks at the next bytes; how many of them may go, all unless the gate closes.
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
                if let Some(gate) = judge(&self.pace, self.start, (self.mark, self.pass_over), &header) {
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

    /// Takes note of a packet that goes, or will when the gate opens.
    fn note(&mut self, header: &PacketHeader) {
        self.start.get_or_insert_with(|| (Instant::now(), header.time));
        self.newest = self.newest.max(header.time);
        self.pass_over = header.kind == Kind::Housekeeping;
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

    /// Waits a little at the gate.
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

    /// Gives the first bytes of what is pending.
    fn give(&mut self, bytes: Vec<u8>, out: &mut Outlet<Vec<u8>>) {
        self.given += bytes.len() as u64;
        if !bytes.is_empty() {
            out.push(bytes);
        }
    }

    fn say_step(&mut self) {
        self.steps += 1;
        if let Pace::Steps(steps) = &self.pace {
            let (now, start) = (self.newest.tai_s(), self.start.map_or(0.0, |(_, time)| time.tai_s()));
            let hours = (now - start) / 3600.0;
            (steps.tell)(&format!("step {} at {hours:.2} h: Enter goes on, end of input ends", self.steps));
        }
    }
}

/// What a packet has to wait for, if it has to.
fn judge(
    pace: &Pace,
    start: Option<(Instant, CucTime)>,
    (mark, pass_over): (CucTime, bool),
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

impl<S: Source<Out = Vec<u8>, Error = DownlinkError>> Source for Paced<S> {
    type Out = Vec<u8>;
    type Error = DownlinkError;

    fn next(&mut self, out: &mut Outlet<Vec<u8>>) -> Result<Flow, DownlinkError> {
        if !matches!(self.gate, Gate::Open) {
            self.wait();
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
            self.say_step();
        }
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.given, "bytes")
    }
}
