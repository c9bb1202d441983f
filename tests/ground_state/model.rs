//! Random sequences of all that a state may meet, against a model of it: the set of packets that it has received.
//!
//! After each step every checkpoint of the state has the bits of a state that received the same packets at once; one
//! written in the middle of a session has them once what was still to be applied is.

mod mission;

use std::collections::HashMap;
use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::path::{Path, PathBuf};

use lunarray::array::{Array, ArrayConfig, segments_for};
use lunarray::calibration::CalibrationConfig;
use lunarray::downlink::transport::socket::{ListenConfig, ListenLimits, SocketSource};
use lunarray::downlink::{DownlinkConfig, DownlinkError, FileSource, PacketHeader, PacketKind};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::ground::archive::CoverageSurvey;
use lunarray::ground::{Ground, GroundConfig, GroundError};
use lunarray::imaging::MapConfig;
use lunarray::runtime::{Flow, Outlet, Source, Stage};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use mission::{Bench, Packets, digest};

use super::checkpoints;
use super::common::downlink::{packets_of, transmit};

const STATES: usize = 3;
const WINDOWS: i64 = 3;
/// Seconds from window to window, and how long each is.
const WINDOW_S: [i64; 2] = [9000, 1800];
const PAIRS: [Pair; 3] = [Pair { i: 0, j: 1 }, Pair { i: 0, j: 7 }, Pair { i: 3, j: 3 }];

/// Sequences in the gate: some seconds. `LUNARRAY_SEQUENCES=10000` for the long form.
const SEQUENCES: u64 = 60;

/// A state and what its checkpoints have received, oldest first.
struct State {
    folder: PathBuf,
    received: Vec<Packets>,
    /// Whether the newest has nothing left to apply: one of a session that was killed may.
    is_settled: bool,
}

impl State {
    fn new(folder: PathBuf) -> Self {
        Self { folder, received: Vec::new(), is_settled: true }
    }

    fn newest(&self) -> Packets {
        self.received.last().copied().unwrap_or(0)
    }

    /// Looks at all checkpoints again: each holds what its packets give.
    fn look(&mut self, bench: &mut Bench) {
        let mut received = Vec::new();
        for path in checkpoints(&self.folder) {
            let found = bench.mission.received(&path);
            let expected = bench.fresh(found);
            self.is_settled = digest(&path) == expected;
            assert!(self.is_settled || bench.settled(&path) == expected, "{} with {found:b}", path.display());
            received.push(found);
        }
        self.received = received;
    }
}

/// A sequence of random steps.
struct Sequence<'a> {
    bench: &'a mut Bench,
    random: ChaCha8Rng,
    states: Vec<State>,
    told: Vec<String>,
}

impl Sequence<'_> {
    fn chance(&mut self, share: f64) -> bool {
        self.random.random_bool(share)
    }

    fn below(&mut self, number: usize) -> usize {
        self.random.random_range(0..number)
    }

    fn tell(&mut self, step: &'static str, state: usize, packets: Packets) {
        *self.bench.steps.entry(step).or_default() += 1;
        self.told.push(format!("{step} {state} {packets:b}"));
    }

    /// Some packets in some order, some of them twice.
    fn some(&mut self) -> (Packets, Vec<usize>) {
        let share = [0.15, 0.5, 1.0][self.below(3)];
        let mut order: Vec<usize> =
            (0..self.bench.mission.packets.len()).filter(|_| self.random.random_bool(share)).collect();
        let packets = order.iter().map(|k| 1 << k).sum();
        match self.below(3) {
            0 => {}
            1 => order.reverse(),
            _ => order.shuffle(&mut self.random),
        }
        for k in 0..order.len() {
            if self.chance(0.1) {
                order.push(order[k]);
            }
        }
        (packets, order)
    }

    fn pieces(&mut self, bytes: &[u8]) -> Vec<Vec<u8>> {
        let length = [100, 1500, 1 << 20][self.below(3)];
        bytes.chunks(length).map(<[u8]>::to_vec).collect()
    }

    fn every(&mut self) -> u64 {
        [1, 10, 30, u64::MAX][self.below(4)]
    }

    fn replay(&mut self, at: usize) {
        let ((given, order), every) = (self.some(), self.every());
        self.tell("replay", at, given);
        let mut ground = self.bench.open(&self.states[at].folder, every);
        for piece in self.pieces(&self.bench.mission.bytes(&order)) {
            ground.step(piece, &mut Outlet::collect()).unwrap();
        }
        ground.finish(&mut Outlet::collect()).unwrap();
        drop(ground);
        self.expect(at, self.states[at].newest() | given);
    }

    /// Looks at a state that must have received just these packets.
    fn expect(&mut self, at: usize, packets: Packets) {
        self.states[at].look(self.bench);
        assert_eq!((self.states[at].newest(), self.states[at].is_settled), (packets, true));
    }

    /// A session that ends by force, perhaps while it writes a checkpoint or puts away an old one.
    fn kill(&mut self, at: usize) {
        let ((given, order), every) = (self.some(), self.every().min(30));
        self.tell("kill", at, given);
        let folder = self.states[at].folder.clone();
        let oldest = checkpoints(&folder).first().map(|path| (path.clone(), std::fs::read(path).unwrap()));
        let mut ground = self.bench.open(&folder, every);
        let pieces = self.pieces(&self.bench.mission.bytes(&order));
        let until = self.below(pieces.len() + 1);
        for piece in pieces.into_iter().take(until) {
            ground.step(piece, &mut Outlet::collect()).unwrap();
        }
        drop(ground);
        // A process that is killed leaves its folder, also if nothing but its lock is in there yet.
        std::fs::create_dir_all(&folder).unwrap();
        match (self.below(3), oldest) {
            (1, Some((path, bytes))) => std::fs::write(path, bytes).unwrap(),
            (2, _) => {
                std::fs::write(folder.join("checkpoint-00000099.lunarray.partial"), b"LNRSTA13").unwrap()
            }
            _ => {}
        }
        let before = self.states[at].newest();
        self.states[at].look(self.bench);
        let after = self.states[at].newest();
        assert_eq!((before & !after, after & !(before | given)), (0, 0), "{before:b} {given:b} {after:b}");
    }

    /// Calls `given` with the number of bytes that the source has given so far, from none on.
    fn drive(
        &mut self,
        mut source: impl Source<Out = Vec<u8>, Error = DownlinkError>,
        ground: &mut Ground,
        mut given: impl FnMut(usize),
    ) {
        let mut out = Outlet::collect();
        let mut bytes_given = 0;
        loop {
            given(bytes_given);
            let flow = source.next(&mut out).unwrap();
            for bytes in out.take() {
                bytes_given += bytes.len();
                ground.step(bytes, &mut Outlet::collect()).unwrap();
            }
            if flow == Flow::Done {
                break;
            }
        }
        ground.finish(&mut Outlet::collect()).unwrap();
    }

    /// A file that grows while it is read.
    fn follow(&mut self, at: usize) {
        let ((given, order), every) = (self.some(), self.every());
        self.tell("follow", at, given);
        let file = self.bench.path("growing.ccsds");
        let bytes = self.bench.mission.bytes(&order);
        let (first, rest) = bytes.split_at(self.below(bytes.len() + 1));
        std::fs::write(&file, first).unwrap();
        let mut ground = self.bench.open(&self.states[at].folder, every);
        let source = FileSource::follow(std::slice::from_ref(&file), 0.3).unwrap();
        // It grows once all that it was has been read: a writer of its own could be later than the source waits.
        let mut rest = Some(rest);
        self.drive(source, &mut ground, |given| {
            if given == first.len()
                && let Some(rest) = rest.take()
            {
                std::fs::File::options().append(true).open(&file).unwrap().write_all(rest).unwrap();
            }
        });
        assert!(rest.is_none());
        drop(ground);
        self.expect(at, self.states[at].newest() | given);
    }

    /// Packets from a sender, who describes the instrument first.
    fn listen(&mut self, at: usize) {
        // A new state learns its instrument only from a sender of visibilities with their positions.
        if self.states[at].newest() & 1 == 0 {
            return self.replay(at);
        }
        let ((given, mut order), every) = (self.some(), self.every());
        let given = given | 1;
        order.insert(0, 0);
        self.tell("listen", at, given);
        let bytes = self.bench.mission.bytes(&order);
        let mut ground = self.bench.open(&self.states[at].folder, every);
        let until = ListenLimits { idle_s: 0.0, connections: 1 };
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        let source = SocketSource::bind(&[any], &ListenConfig::default(), until).unwrap();
        let source = source.with_instrument(ground.instrument().cloned());
        let address = source.addresses()[0].strip_prefix("tcp://").unwrap().to_owned();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut stream = TcpStream::connect(address).unwrap();
                stream.write_all(&bytes).unwrap();
                stream.shutdown(std::net::Shutdown::Write).unwrap();
                let _ = stream.read_to_end(&mut Vec::new());
            });
            self.drive(source, &mut ground, |_| ());
        });
        drop(ground);
        self.expect(at, self.states[at].newest() | given);
    }

    /// Two states into a third.
    fn merge(&mut self, at: usize) {
        let [a, b] = [(at + 1) % STATES, (at + 2) % STATES];
        let (ours, theirs) = (self.states[a].newest(), self.states[b].newest());
        if self.states[a].received.is_empty() || self.states[b].received.is_empty() {
            return;
        }
        self.tell("merge", at, ours | theirs);
        let mission = &self.bench.mission;
        let parts = [self.states[a].folder.clone(), self.states[b].folder.clone()];
        let into = self.states[at].folder.clone();
        let read = |packets: Packets| {
            packets & mission.of_kind(PacketKind::Visibilities) & !mission.waiting(packets)
        };
        let are_apart = read(ours) & read(theirs) == 0;
        let is_new = self.states[at].received.is_empty();
        let are_settled = self.states[a].is_settled && self.states[b].is_settled;
        match Ground::merge(&into, &parts, &mission.config) {
            Err(GroundError::Downlink(DownlinkError::DuplicatePacket { .. })) => assert!(!are_apart),
            Err(GroundError::Occupied { .. }) => assert!(!is_new),
            Err(error) => panic!("{error}"),
            Ok(ground) => {
                // A merge may be repeated: then the state is that of the same packets already.
                assert!(is_new || self.states[at].newest() == ours | theirs);
                assert!(are_apart || !are_settled);
                drop(ground);
                self.expect(at, ours | theirs);
            }
        }
    }

    /// Takes out packets of visibilities and reports, whole windows, or everything; and some that are not there.
    fn retract(&mut self, at: usize) {
        let before = self.states[at].newest();
        if self.states[at].received.is_empty() {
            return;
        }
        let (mut given, _) = self.some();
        let mission = &self.bench.mission;
        let choice = self.random.random_range(0..5);
        match choice {
            0 => given = mission.all(),
            1 | 2 => {
                let window = Some(self.random.random_range(0..WINDOWS));
                given = mission.having(|k| mission.windows[k] == window);
            }
            _ => {
                given &= mission.of_kind(PacketKind::Visibilities) | mission.of_kind(PacketKind::Housekeeping)
            }
        }
        if given == 0 {
            return;
        }
        self.tell("retract", at, given);
        let mission = &self.bench.mission;
        let order: Vec<usize> = (0..mission.packets.len()).filter(|k| given >> k & 1 == 1).collect();
        let file = self.bench.path("out.ccsds");
        std::fs::write(&file, mission.bytes(&order)).unwrap();
        let folder = self.states[at].folder.clone();
        let (told, notes) = Ground::retract(&folder, &[file], None, &mission.config).unwrap();
        assert_eq!((told.packets, told.kept, told.refused), (u64::from((before & given).count_ones()), 0, 0));
        assert!(notes.is_empty());
        self.states[at].look(self.bench);
        // Neither brings them back.
        assert_eq!(self.states[at].received, [before & !given; 2]);
    }

    fn spoil(&mut self, path: &Path) {
        let mut bytes = std::fs::read(path).unwrap();
        let place = self.below(bytes.len());
        match self.below(3) {
            0 => bytes[place] ^= 1 << self.below(8),
            1 => bytes.truncate(place),
            _ => bytes.insert(place, 0x55),
        }
        std::fs::write(path, bytes).unwrap();
    }

    /// The newest checkpoint is damaged: the one before is used, and without one nothing is begun anew.
    fn damage(&mut self, at: usize) {
        let [.., newest] = &checkpoints(&self.states[at].folder)[..] else { return };
        self.tell("damage", at, 0);
        let good = std::fs::read(newest).unwrap();
        self.spoil(newest);
        let config = self.bench.mission.config.clone();
        let opened = Ground::open(&self.states[at].folder, &config, u64::MAX);
        let received = &self.states[at].received;
        let Some(&before) = received.len().checked_sub(2).and_then(|k| received.get(k)) else {
            assert!(matches!(opened, Err(GroundError::NoUsableCheckpoint { .. })));
            std::fs::write(newest, good).unwrap();
            return;
        };
        let mut ground = opened.unwrap();
        assert_eq!(ground.notes().count(), 1);
        ground.finish(&mut Outlet::collect()).unwrap();
        drop(ground);
        self.expect(at, before);
    }

    /// A copy of a state, its newest checkpoint damaged, is merged: what is copied stays as it is.
    fn copy(&mut self, at: usize) {
        let from = checkpoints(&self.states[at].folder);
        let [.., before, _] = self.states[at].received[..] else { return };
        self.tell("copy", at, 0);
        let (copy, into) = (self.bench.scratch("copy"), self.bench.scratch("into"));
        std::fs::create_dir(&copy).unwrap();
        for path in &from {
            std::fs::copy(path, copy.join(path.file_name().unwrap())).unwrap();
        }
        self.spoil(&copy.join(from.last().unwrap().file_name().unwrap()));
        let ground = Ground::merge(&into, &[copy], &self.bench.mission.config).unwrap();
        assert_eq!(ground.notes().count(), 1);
        drop(ground);
        let mut merged = State::new(into);
        merged.look(self.bench);
        assert_eq!(merged.newest(), before);
    }

    /// A state begins anew.
    fn forget(&mut self, at: usize) {
        self.tell("forget", at, 0);
        let _ = std::fs::remove_dir_all(&self.states[at].folder);
        self.states[at].received.clear();
        self.states[at].is_settled = true;
    }

    fn step(&mut self) {
        let at = self.below(STATES);
        match self.below(100) {
            0..30 => self.replay(at),
            30..48 => self.kill(at),
            48..64 => self.retract(at),
            64..76 => self.merge(at),
            76..86 => self.damage(at),
            86..90 => self.copy(at),
            90..97 => self.forget(at),
            97 | 98 => self.listen(at),
            _ => self.follow(at),
        }
    }

    fn run(&mut self) {
        for _ in 0..self.random.random_range(6..20) {
            self.step();
        }
        // Whatever has happened: with all packets, in any order, it is as if nothing had.
        for at in 0..STATES {
            let mut order: Vec<usize> = (0..self.bench.mission.packets.len()).collect();
            order.shuffle(&mut self.random);
            let bytes = self.bench.mission.bytes(&order);
            let mut ground = self.bench.open(&self.states[at].folder, u64::MAX);
            ground.step(bytes, &mut Outlet::collect()).unwrap();
            ground.finish(&mut Outlet::collect()).unwrap();
            drop(ground);
            let all = self.bench.mission.all();
            self.expect(at, all);
        }
    }
}

fn number(variable: &str, otherwise: u64) -> u64 {
    std::env::var(variable).map_or(otherwise, |text| text.parse().unwrap())
}

#[test]
fn a_state_is_what_its_packets_make_it_whatever_happens() {
    let first = number("LUNARRAY_SEQUENCE", 0);
    let mut bench = Bench::new();
    for seed in first..first + number("LUNARRAY_SEQUENCES", SEQUENCES) {
        let states = (0..STATES).map(|k| State::new(bench.scratch(&k.to_string())));
        let states = states.collect();
        let random = ChaCha8Rng::seed_from_u64(seed);
        let mut sequence = Sequence { bench: &mut bench, random, states, told: Vec::new() };
        let ran = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| sequence.run()));
        if let Err(panic) = ran {
            eprintln!("sequence {seed} (LUNARRAY_SEQUENCE={seed}):\n{}", sequence.told.join("\n"));
            std::panic::resume_unwind(panic);
        }
    }
    let mut steps: Vec<_> = bench.steps.into_iter().collect();
    steps.sort_unstable();
    eprintln!("{steps:?}; {} sets of packets", bench.fresh.len());
    assert!(steps.len() >= 8);
}
