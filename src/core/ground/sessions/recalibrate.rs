//! Recalibrates the visibilities of an archive with new gains.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::calibration::{AntennaGains, AutoTable, CalibrationHook, Calibrator, ReceivedBlocks};
use crate::downlink::receive::EventReader;
use crate::downlink::{Event, PacketKind};
use crate::frames::GroundFrame;
use crate::ground::archive::draft::{RecordDraft, digest};
use crate::ground::archive::folder::checkpoints;
use crate::ground::archive::journal::{Journal, JournalRecord, SendingKey};
use crate::ground::archive::settings::settings_of;
use crate::ground::{DeliveredPacket, Ground, GroundConfig, GroundError, HeldPacket};
use crate::runtime::Outlet;
use crate::units::ChannelId;

/// Report on a recalibration.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Recalibrated {
    /// Number of packets whose visibilities were subtracted with the old gains and added with the new ones.
    pub packets: u64,
    /// Number of packets of visibilities whose gains did not change.
    pub unchanged: u64,
    /// Number of visibilities of the packets that were in the sums with the old gains.
    pub accumulated_before: u64,
    /// Number of visibilities of the packets that are in the sums with the new gains.
    pub accumulated: u64,
    /// Number of the calibration of the sums now; a state starts with 1.
    pub version: u32,
    /// Checksum of the new gains, as text.
    pub gains: String,
}

struct Recalibration {
    ground: Ground,
    journal: Journal,
    due: BTreeSet<SendingKey>,
    /// Records of packets that have been subtracted.
    removed: BTreeMap<SendingKey, JournalRecord>,
    report: Recalibrated,
}

impl Ground {
    /// Recalibrates the archive in `folder` from the gains of `config` to those of `new`, with the packets in `files`.
    ///
    /// The files have to contain all packets whose gains change. The sums are then those of an archive made with the new gains.
    /// Returns a report, and notes on checkpoints that could not be used. The change is atomic.
    ///
    /// # Errors
    /// Errors of [`Ground::open`] and [`Ground::retract`]; packets whose gains change and that are in no file; channels whose
    /// first data would change; packets from which bursts were subtracted.
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
        // Without snapshots.
        (config.map.snapshot_every_s, new.map.snapshot_every_s) = (0.0, 0.0);
        let gains = [gains_of(&config)?, gains_of(&new)?];
        let mut ground = Self::open(folder, &config, u64::MAX)?;
        let notes = ground.notes().map(str::to_owned).collect();
        let journal = ground.archive.as_mut().map(|archive| std::mem::take(&mut archive.journal));
        let journal = journal.unwrap_or_default();
        let due = packets_to_change(&ground, &journal, &gains);
        let peeled = due.iter().filter_map(|sent| journal.visibilities.get(sent));
        let peeled = peeled.filter(|record| is_peeled(&ground, record, new.calibration.sub_bands)).count();
        if peeled > 0 {
            return Err(GroundError::PeeledWithOldGains { packets: peeled });
        }
        let report = Recalibrated {
            unchanged: (journal.visibilities.len() - due.len()) as u64,
            ..Recalibrated::default()
        };
        let firsts = first_used(&journal);
        let mut work = Recalibration { ground, journal, due, removed: BTreeMap::new(), report };
        for_each_packet(files, &mut |packet| work.subtract(packet))?;
        if let Some((_, count)) = work.due.iter().find(|sent| !work.removed.contains_key(*sent)) {
            let missing = work.due.len() - work.removed.len();
            return Err(GroundError::GainsWithoutData { missing, count: *count });
        }
        work.add(files, &new)?;
        let moves = gains.iter().flatten().any(AntennaGains::corrects_positions);
        if config.map.is_harmonic() {
            work.check_first_data(&firsts, moves)?;
        }
        let report = work.write(&new)?;
        Ok((report, notes))
    }
}

/// The gains of the gains file; `None` if the configuration uses none.
fn gains_of(config: &GroundConfig) -> Result<Option<AntennaGains>, GroundError> {
    let file = config.calibration.gains_file.as_ref();
    let file = file.filter(|_| config.calibration.hook == CalibrationHook::AntennaGains);
    let draws = config.calibration.error_draws;
    Ok(file.map(|file| AntennaGains::read(file, draws)).transpose()?)
}

fn packets_to_change(
    ground: &Ground,
    journal: &Journal,
    gains: &[Option<AntennaGains>; 2],
) -> BTreeSet<SendingKey> {
    let Some(instrument) = ground.instrument() else { return BTreeSet::new() };
    let is_due = |record: &JournalRecord| {
        let entry = &record.entry;
        let Some(channel) = instrument.channel_of(entry.channel, entry.pair) else { return false };
        if record.is_duplicate || entry.visibilities == 0 || instrument.is_spectrum(entry.pair) {
            return false;
        }
        let span_s = [entry.start, entry.end].map(|time| time.seconds());
        match gains {
            [Some(old), Some(new)] => !old.is_equivalent(new, channel.frequency_hz, entry.pair, span_s),
            _ => true,
        }
    };
    let changed = journal.visibilities.iter().filter(|(_, record)| is_due(record));
    changed.map(|(sent, _)| *sent).collect()
}

/// Whether a light curve, which was fitted with the gains of a state, applies to visibilities of a packet.
fn is_peeled(ground: &Ground, record: &JournalRecord, sub_bands: usize) -> bool {
    let channel = usize::from(record.entry.channel.0) / sub_bands.max(1);
    let span_s = [record.entry.start, record.entry.end].map(|time| time.seconds());
    ground.calibrator.bursts().subtracts_in(ChannelId(channel as u16), span_s)
}

/// The first packet in the order of sending that is in the sums of each channel. Its positions define the channel's orbit.
fn first_used(journal: &Journal) -> BTreeMap<ChannelId, SendingKey> {
    let mut firsts = BTreeMap::new();
    for (sent, record) in &journal.visibilities {
        if let Some(used) = record.used {
            firsts.entry(used.channel).or_insert(*sent);
        }
    }
    firsts
}

fn for_each_packet(
    files: &[PathBuf],
    take: &mut dyn FnMut(&HeldPacket) -> Result<(), GroundError>,
) -> Result<(), GroundError> {
    for path in files {
        let mut events = EventReader::open(path)?.unfiltered();
        events.for_each(|event| match event {
            Event::Packet(packet) if packet.header.kind == PacketKind::Visibilities => {
                take(&HeldPacket::new(packet))
            }
            _ => Ok(()),
        })?;
        if events.packets() == 0 {
            let (path, found) = (path.clone(), "no packet".into());
            let expected = "a downlink file, as for `lunarray replay`";
            return Err(GroundError::Damaged { path, found, expected });
        }
    }
    Ok(())
}

impl Recalibration {
    /// Subtracts the visibilities of a packet from the sums, and keeps its record.
    fn subtract(&mut self, packet: &HeldPacket) -> Result<(), GroundError> {
        let sent = (packet.header.time, packet.header.count);
        let Some(record) = self.journal.visibilities.get(&sent) else { return Ok(()) };
        if !self.due.contains(&sent) || record.checksum != packet.checksum {
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
                    return Err(GroundError::EphemerisChanged { count });
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

    /// Adds the subtracted visibilities with the new gains, in the order of the files. A channel without remaining data starts anew.
    fn add(&mut self, files: &[PathBuf], new: &GroundConfig) -> Result<(), GroundError> {
        let Self { ground, journal, removed, report, .. } = self;
        let Ground { collector, calibrator: old, accumulator, archive: Some(archive), .. } = ground else {
            return Ok(());
        };
        accumulator.restore_spans(&journal.spans_s());
        archive.take_posts();
        let segments: Vec<_> = old.ephemeris().segments().cloned().collect();
        let resume = |calibrator: Calibrator, autos: AutoTable, blocks: ReceivedBlocks| {
            calibrator
                .resume(collector.instrument().cloned(), segments.iter().cloned(), autos, blocks)
                .with_bursts(old.bursts())
        };
        let posts = archive.posts();
        let mut calibrator =
            resume(new.calibrator(None, &posts)?, AutoTable::default(), ReceivedBlocks::default());
        for_each_packet(files, &mut |packet| {
            let sent = (packet.header.time, packet.header.count);
            let Some(record) = removed.get(&sent).filter(|record| record.checksum == packet.checksum) else {
                return Ok(());
            };
            if journal.visibilities.contains_key(&sent) {
                return Ok(());
            }
            let frame = GroundFrame::Visibilities(collector.decoded(packet).unwrap_or_default());
            let mut draft = RecordDraft::new(Some(&frame));
            if let Some(placed) = calibrator.accept(frame)? {
                draft.offer(&placed);
                draft.used_span_s = accumulator.accept(placed, &mut Outlet::collect())?;
            }
            let posted = archive.take_posts();
            report.accumulated += posted.accumulated;
            let (header, checksum) = (packet.header, packet.checksum);
            let delivered = DeliveredPacket { header, checksum, counts: record.counts };
            journal.record_visibilities(&delivered, draft, &posted);
            Ok(())
        })?;
        let mut autos = old.autos().cloned().unwrap_or_default();
        autos.merge(calibrator.autos().cloned().unwrap_or_default());
        let calibrator = resume(new.calibrator(None, &posts)?, autos, journal.blocks());
        (ground.calibrator, ground.gate) = (calibrator, None);
        Ok(())
    }

    /// Checks that channels with remaining data keep the orbit that they would have in a new archive.
    fn check_first_data(
        &self,
        before: &BTreeMap<ChannelId, SendingKey>,
        moves: bool,
    ) -> Result<(), GroundError> {
        let kept = self.journal.visibilities.iter().filter(|(sent, _)| !self.removed.contains_key(*sent));
        let kept: BTreeSet<ChannelId> = kept.filter_map(|(_, record)| Some(record.used?.channel)).collect();
        let now = first_used(&self.journal);
        let keeps_first = |channel: &ChannelId| {
            let first = before.get(channel);
            first == now.get(channel) && first.is_none_or(|sent| !moves || !self.removed.contains_key(sent))
        };
        match kept.iter().find(|channel| !keeps_first(channel)) {
            Some(channel) => Err(GroundError::FirstDataChanged { channel: *channel }),
            None => Ok(()),
        }
    }

    /// Writes the archive twice, so that falling back to the older checkpoint does not bring the old gains back.
    fn write(self, new: &GroundConfig) -> Result<Recalibrated, GroundError> {
        let Self { mut ground, journal, mut report, .. } = self;
        ground.accumulator.restore_spans(&journal.spans_s());
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
