//! Taking packets out of a state again.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::error::StateError;
use super::folder::checkpoints;
use super::journal::{Line, Sent, digest};
use super::keeper::Keeper;
use crate::downlink::receive::EventReader;
use crate::downlink::{Event, Kind, PacketHeader};
use crate::frames::{GroundFrame, VisibilityReason};
use crate::ground::WaitingPacket;
use crate::pipeline::config::Config;
use crate::runtime::LedgerReport;
use crate::units::{ChannelId, MissionTime};

/// Packets that are named of those that stay.
const REFUSED_NAMED: usize = 20;

/// A packet that stays in the state.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Refused {
    /// Kind.
    pub kind: Kind,
    /// Packet count.
    pub count: u64,
    /// Why.
    pub reason: &'static str,
}

/// What has become of the packets of some files.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Retracted {
    /// Packets taken out, those that waited among them.
    pub packets: u64,
    /// Packets taken out that waited.
    pub waited: u64,
    /// Visibilities in packets taken out that had been read.
    pub visibilities: u64,
    /// Those of them that were in the sums.
    pub accumulated: u64,
    /// Packets that are not in the state.
    pub absent: u64,
    /// Packets of positions that others were placed by, and parts of payloads: they stay.
    pub kept: u64,
    /// Packets that stay because taking them out would take out something else.
    pub refused: u64,
    /// The first of those.
    pub named: Vec<Refused>,
}

/// Packets found in files on the way.
struct Found {
    report: Retracted,
    /// Visibilities within this stretch of time alone, if it is given.
    span: Option<[MissionTime; 2]>,
    /// Packets of which was decided.
    done: BTreeSet<(Kind, Sent)>,
    /// Packets other than visibilities that have been read.
    others: BTreeMap<(Kind, Sent), WaitingPacket>,
    channels: BTreeSet<ChannelId>,
}

impl Found {
    fn refuse(&mut self, header: &PacketHeader, reason: &'static str) {
        self.report.refused += 1;
        if self.report.named.len() < REFUSED_NAMED {
            self.report.named.push(Refused { kind: header.kind, count: header.count, reason });
        }
    }
}

impl Keeper {
    /// Takes every packet of `files` out of the state in `folder`, or, of a stretch of mission time, the packets of
    /// visibilities that lie in it. The state is the new one as a whole, or the old one.
    ///
    /// # Errors
    /// Those of [`Keeper::open`]; a folder without a state; a file that cannot be read; sums that do not hold what the
    /// journal says.
    pub fn retract(
        folder: &Path,
        files: &[PathBuf],
        span: Option<[MissionTime; 2]>,
        config: &Config,
    ) -> Result<(Self, Retracted), StateError> {
        if !folder.is_dir() || checkpoints(folder)?.is_empty() {
            return Err(StateError::without_checkpoint(folder));
        }
        let mut keeper = Self::open(folder, config, 0, u64::MAX)?;
        let report = Retracted::default();
        let (done, others, channels) = Default::default();
        let mut found = Found { report, span, done, others, channels };
        for file in files {
            keeper.retract_file(file, &mut found)?;
        }
        if span.is_none() {
            keeper.retract_others(&mut found);
        }
        keeper.settle_after(&found, config)?;
        if found.report.packets > 0 {
            // Twice, so that the checkpoint before the newest does not bring the packets back.
            keeper.checkpoint()?;
            keeper.checkpoint()?;
        }
        Ok((keeper, found.report))
    }

    fn retract_file(&mut self, path: &Path, found: &mut Found) -> Result<(), StateError> {
        let mut events = EventReader::open(path)?.unfiltered();
        events.for_each(|event| match event {
            Event::Packet(packet) => self.retract_packet(WaitingPacket::of(packet), found),
            _ => Ok(()),
        })?;
        if events.packets() == 0 {
            let (path, found) = (path.to_owned(), "not one packet".into());
            return Err(StateError::Damaged {
                path,
                found,
                expected: "a downlink file, as `lunarray replay` takes",
            });
        }
        Ok(())
    }

    fn retract_packet(&mut self, packet: WaitingPacket, found: &mut Found) -> Result<(), StateError> {
        let header = packet.header;
        let (kind, sent) = (header.kind, (header.time, header.count));
        if found.span.is_some_and(|span| !lies_in(&packet, span)) || found.done.contains(&(kind, sent)) {
            return Ok(());
        }
        found.done.insert((kind, sent));
        if !self.collector.has_taken(&header) {
            found.report.absent += 1;
            return Ok(());
        }
        if let Some(waiting) = self.collector.waiting().get(&header) {
            if waiting.check != packet.check {
                found.refuse(&header, OTHER_CONTENT);
                return Ok(());
            }
            self.collector.take_out(&header);
            found.report.packets += 1;
            found.report.waited += 1;
            return Ok(());
        }
        let check = match kind {
            Kind::Visibilities => self.journal.visibilities.get(&sent).map(|line| line.check),
            _ => self.journal.others.get(&(kind, sent)).map(|line| line.check),
        };
        match check {
            None => found.report.absent += 1,
            Some(check) if check != packet.check => found.refuse(&header, OTHER_CONTENT),
            Some(_) if kind == Kind::Visibilities => return self.retract_visibilities(packet, found),
            Some(_) => drop(found.others.insert((kind, sent), packet)),
        }
        Ok(())
    }

    /// Takes out a packet of visibilities that has been read, with this content.
    fn retract_visibilities(&mut self, packet: WaitingPacket, found: &mut Found) -> Result<(), StateError> {
        let header = packet.header;
        let sent = (header.time, header.count);
        let Some(line) = self.journal.visibilities.get(&sent).cloned() else { return Ok(()) };
        let account = Self::account_of(&line);
        let is_double = account.sampled > 0;
        let block = self.collector.read_again(&packet);
        if let Some(block) = block.filter(|_| !is_double) {
            if line.accumulated > 0 {
                let removed = if block.pair.i == block.pair.j {
                    self.calibrator.take_out_powers(block.clone())?
                } else {
                    let placed = self.calibrator.place_again(block.clone())?;
                    if digest(&placed) != line.digest {
                        found.refuse(&header, OTHER_POSITIONS);
                        return Ok(());
                    }
                    self.accumulator.remove(&placed)?.visibilities
                };
                if removed != u64::from(line.accumulated) {
                    let (expected, found) = (line.accumulated, removed);
                    return Err(StateError::NotInSums { count: header.count, found, expected });
                }
            }
            self.calibrator.forget_block(&block);
        }
        self.collector.take_back(&[packet]);
        self.outcome.ledger.withdraw(&account);
        self.journal.visibilities.remove(&sent);
        found.channels.insert(line.entry.channel);
        found.report.packets += 1;
        found.report.visibilities += u64::from(line.entry.visibilities);
        found.report.accumulated += u64::from(line.accumulated);
        Ok(())
    }

    /// What a line has posted to the ledger.
    fn account_of(line: &Line) -> LedgerReport<VisibilityReason> {
        let mut account =
            LedgerReport { accumulated: u64::from(line.accumulated), ..LedgerReport::default() };
        for &(reason, count) in &line.left_out {
            // Duplicates have been posted as sampled a second time.
            account.sampled += if reason == VisibilityReason::Duplicate { u64::from(count) } else { 0 };
            account.left_out.insert(reason, u64::from(count));
        }
        account
    }

    /// Takes out payloads of which all packets have been found and nothing else is made.
    fn retract_others(&mut self, found: &mut Found) {
        let lines: Vec<_> =
            found.others.keys().filter_map(|key| Some((*key, *self.journal.others.get(key)?))).collect();
        let mut payloads: BTreeMap<(Kind, Sent), Vec<(Kind, Sent)>> = BTreeMap::new();
        for ((kind, (time, count)), line) in &lines {
            payloads.entry((*kind, (*time, line.payload[0]))).or_default().push((*kind, (*time, *count)));
        }
        let kept = self.segments_kept(found);
        for keys in payloads.into_values() {
            let Some(line) = keys.first().and_then(|key| self.journal.others.get(key)).copied() else {
                continue;
            };
            let [first, last] = line.payload;
            if keys.len() as u64 != last - first + 1
                || line.segment.is_some_and(|start| kept.contains(&start))
            {
                found.report.kept += keys.len() as u64;
                continue;
            }
            let packets: Vec<WaitingPacket> =
                keys.iter().filter_map(|key| found.others.remove(key)).collect();
            found.report.packets += packets.len() as u64;
            match self.collector.take_back(&packets) {
                Some(GroundFrame::Housekeeping(report)) => self.calibrator.forget_report(&report),
                Some(GroundFrame::Ephemeris(segment)) if line.segment.is_some() => {
                    let others = keys.iter().collect::<BTreeSet<_>>();
                    let brought =
                        |(key, other): (&(Kind, Sent), &crate::ground::archive::journal::OtherLine)| {
                            other.segment == line.segment && !others.contains(key)
                        };
                    if !self.journal.others.iter().any(brought) {
                        self.calibrator.forget_segment(segment.start);
                    }
                }
                _ => {}
            }
            for key in &keys {
                self.journal.others.remove(key);
            }
        }
    }

    /// Beginnings of the positions that nothing but packets of the files has brought, and by which visibilities that
    /// stay were placed.
    fn segments_kept(&self, found: &Found) -> BTreeSet<MissionTime> {
        let starts = |is_found: bool| -> BTreeSet<MissionTime> {
            let lines = self.journal.others.iter();
            let lines = lines.filter(|(key, _)| found.others.contains_key(key) == is_found);
            lines.filter_map(|(_, line)| line.segment).collect()
        };
        let (mut only_found, others) = (starts(true), starts(false));
        only_found.retain(|start| {
            let segment = self.calibrator.ephemeris().segment(*start);
            !others.contains(start)
                && segment.is_some_and(|segment| self.journal.uses([segment.start, segment.end()]))
        });
        only_found
    }

    /// Makes everything else what it would be without the packets.
    fn settle_after(&mut self, found: &Found, config: &Config) -> Result<(), StateError> {
        for kind in Kind::ALL {
            let others = self.journal.others.keys().filter(|(of, _)| *of == kind).map(|(_, sent)| *sent);
            match kind {
                Kind::Visibilities => self.collector.retake(kind, self.journal.visibilities.keys().copied()),
                _ => self.collector.retake(kind, others),
            }
        }
        let spans_s = self.journal.spans_s();
        for channel in &found.channels {
            self.accumulator.set_span(*channel, spans_s.get(channel).copied());
        }
        if self.collector.begin_anew_if_empty() {
            self.begin_anew(config)?;
        }
        Ok(())
    }
}

const OTHER_CONTENT: &str = "its content differs from that of the packet in the state";
const OTHER_POSITIONS: &str = "the positions that are known now are others than those that it was placed by";

/// Whether a packet holds visibilities that all lie in a stretch of mission time.
fn lies_in(packet: &WaitingPacket, [from, to]: [MissionTime; 2]) -> bool {
    packet.span().is_some_and(|[first, last]| from <= first && last <= to)
}
