//! Other gains for the visibilities of an archive.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use super::draft::{RecordDraft, digest};
use super::folder::checkpoints;
use super::journal::{Journal, JournalRecord, Sent};
use super::settings::settings_of;
use crate::calibration::{AntennaGains, AutoTable, CalibrationHook, Calibrator, ReceivedBlocks};
use crate::downlink::receive::EventReader;
use crate::downlink::{Event, PacketKind};
use crate::frames::GroundFrame;
use crate::ground::{DeliveredPacket, Ground, GroundConfig, GroundError, HeldPacket};
use crate::imaging::EngineKind;
use crate::runtime::Outlet;
use crate::units::ChannelId;

/// Counts of a recalibration.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Recalibrated {
    /// Packets whose visibilities were taken out under the old gains and added under the new ones.
    pub packets: u64,
    /// Packets of visibilities to which the new gains do what the old ones did.
    pub unchanged: u64,
    /// Visibilities of the packets in the sums, under the old gains.
    pub accumulated_before: u64,
    /// Under the new ones.
    pub accumulated: u64,
    /// Number of the calibration that the sums are made with now; a state begins with 1.
    pub version: u32,
    /// The new gains, by their contents.
    pub gains: String,
}

/// A change of gains under way.
struct Recalibration {
    ground: Ground,
    journal: Journal,
    /// Packets that are to be taken out.
    due: BTreeSet<Sent>,
    /// Records of packets that have been taken out.
    removed: BTreeMap<Sent, JournalRecord>,
    report: Recalibrated,
}

impl Ground {
    /// Takes the visibilities of `files` out of the archive in `folder` under its gains, which `config` names, and adds them under
    /// those of `new`. Packets for which nothing changes need not be in the files; all others have to be. The sums are then those
    /// of an archive that was made with the new gains. Returns what became of them, and notes on checkpoints that could not be
    /// used. The archive holds the new contents as a whole, or the old ones.
    ///
    /// # Errors
    /// Those of [`Ground::open`] and [`Ground::retract`]; packets whose gains change and that are in no file; channels that
    /// would begin with other positions.
    #[doc(hidden)]
    pub fn recalibrate(
        folder: &Path,
        files: &[PathBuf],
        config: &GroundConfig,
        new: &GroundConfig,
    ) -> Result<(Recalibrated, Vec<String>), GroundError> {
        if !folder.is_dir() || checkpoints(folder)?.is_empty() {
            return Err(GroundError::without_checkpoint(folder));
        }
        let (mut config, mut new) = (config.clone(), new.clone());
        // Snapshots are not made again.
        (config.map.snapshot_every_s, new.map.snapshot_every_s) = (0.0, 0.0);
        let gains = [gains_of(&config)?, gains_of(&new)?];
        let mut ground = Self::open(folder, &config, u64::MAX)?;
        let notes = ground.notes().map(str::to_owned).collect();
        let journal = ground.archive.as_mut().map(|archive| std::mem::take(&mut archive.journal));
        let journal = journal.unwrap_or_default();
        let due = due(&ground, &journal, &gains);
        let report = Recalibrated {
            unchanged: (journal.visibilities.len() - due.len()) as u64,
            ..Recalibrated::default()
        };
        let firsts = first_used(&journal);
        let mut work = Recalibration { ground, journal, due, removed: BTreeMap::new(), report };
        each_packet(files, &mut |packet| work.take_out(packet))?;
        if let Some((_, count)) = work.due.iter().find(|sent| !work.removed.contains_key(*sent)) {
            let missing = work.due.len() - work.removed.len();
            return Err(GroundError::GainsWithoutData { missing, count: *count });
        }
        work.add_again(files, &new)?;
        let moves = gains.iter().flatten().any(AntennaGains::moves);
        if config.map.engine == EngineKind::Harmonic {
            work.check_beginnings(&firsts, moves)?;
        }
        let report = work.write(&new)?;
        Ok((report, notes))
    }
}

/// The gains of a file; `None` where they are not of one.
fn gains_of(config: &GroundConfig) -> Result<Option<AntennaGains>, GroundError> {
    let file = config.calibration.gains_file.as_ref();
    let file = file.filter(|_| config.calibration.hook == CalibrationHook::AntennaGains);
    Ok(file.map(|file| AntennaGains::read(file)).transpose()?)
}

/// Packets to which the new gains do something else.
fn due(ground: &Ground, journal: &Journal, gains: &[Option<AntennaGains>; 2]) -> BTreeSet<Sent> {
    let Some(instrument) = ground.instrument() else { return BTreeSet::new() };
    let is_due = |record: &JournalRecord| {
        let entry = &record.entry;
        let Some(channel) = instrument.channel_of(entry.channel, entry.pair) else { return false };
        if record.is_duplicate || entry.visibilities == 0 || instrument.is_spectrum(entry.pair) {
            return false;
        }
        let span_s = [entry.start, entry.end].map(|time| time.seconds());
        match gains {
            [Some(old), Some(new)] => !old.does_as(new, channel.frequency_hz, entry.pair, span_s),
            _ => true,
        }
    };
    let changed = journal.visibilities.iter().filter(|(_, record)| is_due(record));
    changed.map(|(sent, _)| *sent).collect()
}

/// The packet that was sent first of those in the sums of each channel. Its positions are those of the channel's circle.
fn first_used(journal: &Journal) -> BTreeMap<ChannelId, Sent> {
    let mut firsts = BTreeMap::new();
    for (sent, record) in &journal.visibilities {
        if let Some(used) = record.used {
            firsts.entry(used.channel).or_insert(*sent);
        }
    }
    firsts
}

fn each_packet(
    files: &[PathBuf],
    take: &mut dyn FnMut(&HeldPacket) -> Result<(), GroundError>,
) -> Result<(), GroundError> {
    for path in files {
        let mut events = EventReader::open(path)?.unfiltered();
        events.for_each(|event| match event {
            Event::Packet(packet) if packet.header.kind == PacketKind::Visibilities => {
                take(&HeldPacket::of(packet))
            }
            _ => Ok(()),
        })?;
        if events.packets() == 0 {
            let (path, found) = (path.clone(), "not one packet".into());
            let expected = "a downlink file, as `lunarray replay` takes";
            return Err(GroundError::Damaged { path, found, expected });
        }
    }
    Ok(())
}

impl Recalibration {
    /// Takes the visibilities of a packet out of the sums; its record waits.
    fn take_out(&mut self, packet: &HeldPacket) -> Result<(), GroundError> {
        let sent = (packet.header.time, packet.header.count);
        let Some(record) = self.journal.visibilities.get(&sent) else { return Ok(()) };
        if !self.due.contains(&sent) || record.check != packet.check {
            return Ok(());
        }
        let accumulated = u64::from(record.accumulated);
        if accumulated > 0 {
            let Ground { collector, calibrator, accumulator, .. } = &mut self.ground;
            let block = collector.decoded(packet).unwrap_or_default();
            let count = packet.header.count;
            let found = if block.pair.i == block.pair.j {
                calibrator.remove_autos(block)?
            } else {
                let placed = calibrator.calibrated(block)?;
                if digest(&placed) != record.digest {
                    return Err(GroundError::OtherPositions { count });
                }
                accumulator.remove(&placed)?.visibilities
            };
            if found != accumulated {
                return Err(GroundError::NotInSums { count, found, expected: record.accumulated });
            }
        }
        self.report.packets += 1;
        self.report.accumulated_before += accumulated;
        let record = self.journal.visibilities.remove(&sent);
        self.removed.extend(record.map(|record| (sent, record)));
        Ok(())
    }

    /// Adds the visibilities that were taken out, in the order of the files. A channel without remaining data begins anew.
    fn add_again(&mut self, files: &[PathBuf], new: &GroundConfig) -> Result<(), GroundError> {
        let Self { ground, journal, removed, report, .. } = self;
        let Ground { collector, calibrator: old, accumulator, archive: Some(archive), .. } = ground else {
            return Ok(());
        };
        accumulator.set_spans(&journal.spans_s());
        archive.take_posts();
        let segments: Vec<_> = old.ephemeris().segments().cloned().collect();
        let resume = |calibrator: Calibrator, autos: AutoTable, blocks: ReceivedBlocks| {
            calibrator.resume(collector.instrument().cloned(), segments.iter().cloned(), autos, blocks)
        };
        let posts = archive.posts();
        let mut calibrator =
            resume(new.calibrator(None, &posts)?, AutoTable::default(), ReceivedBlocks::default());
        each_packet(files, &mut |packet| {
            let sent = (packet.header.time, packet.header.count);
            let Some(record) = removed.get(&sent).filter(|record| record.check == packet.check) else {
                return Ok(());
            };
            if journal.visibilities.contains_key(&sent) {
                return Ok(());
            }
            let frame = GroundFrame::Visibilities(collector.decoded(packet).unwrap_or_default());
            let mut draft = RecordDraft::of(Some(&frame));
            if let Some(placed) = calibrator.accept(frame)? {
                draft.offer(&placed);
                draft.used_s = accumulator.accept(placed, &mut Outlet::collect())?;
            }
            let posted = archive.take_posts();
            report.accumulated += posted.accumulated;
            let (header, check) = (packet.header, packet.check);
            let delivered = DeliveredPacket { header, check, reading: record.reading };
            journal.record_visibilities(&delivered, draft, &posted);
            Ok(())
        })?;
        let mut autos = old.autos().cloned().unwrap_or_default();
        autos.merge(calibrator.autos().cloned().unwrap_or_default());
        let calibrator = resume(new.calibrator(None, &posts)?, autos, journal.blocks());
        (ground.calibrator, ground.gate) = (calibrator, None);
        Ok(())
    }

    /// Requires that channels with remaining data have the circle that they would have in a new archive.
    fn check_beginnings(&self, before: &BTreeMap<ChannelId, Sent>, moves: bool) -> Result<(), GroundError> {
        let kept = self.journal.visibilities.iter().filter(|(sent, _)| !self.removed.contains_key(*sent));
        let kept: BTreeSet<ChannelId> = kept.filter_map(|(_, record)| Some(record.used?.channel)).collect();
        let now = first_used(&self.journal);
        let same = |channel: &ChannelId| {
            let first = before.get(channel);
            first == now.get(channel) && first.is_none_or(|sent| !moves || !self.removed.contains_key(sent))
        };
        match kept.iter().find(|channel| !same(channel)) {
            Some(channel) => Err(GroundError::OtherBeginning { channel: *channel }),
            None => Ok(()),
        }
    }

    /// Writes the archive: twice, so that the checkpoint before the newest does not bring the old gains back.
    fn write(self, new: &GroundConfig) -> Result<Recalibrated, GroundError> {
        let Self { mut ground, journal, mut report, .. } = self;
        ground.accumulator.set_spans(&journal.spans_s());
        if let Some(archive) = &mut ground.archive {
            let settings = settings_of(new)?;
            let gains = settings.iter().find(|(key, _)| key == "calibration.gains_file");
            report.gains = gains.map(|(_, value)| value.clone()).unwrap_or_default();
            archive.version = archive.version.saturating_add(1);
            report.version = archive.version;
            archive.set_settings(settings);
            archive.journal = journal;
        }
        ground.checkpoint()?;
        if let Some(archive) = &mut ground.archive {
            archive.folder.drop_older()?;
        }
        ground.checkpoint()?;
        Ok(report)
    }
}
