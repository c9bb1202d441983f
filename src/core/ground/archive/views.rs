//! Data derived from the records of the journal: counters, the ledger, received packets and blocks, and time spans.

use std::collections::BTreeMap;

use super::entry::JournalEntry;
use super::journal::{Journal, JournalRecord, SendingKey, SumsSpan};
use crate::calibration::{BlockKey, ReceivedBlocks};
use crate::downlink::{PacketKind, ReceptionCounters};
use crate::frames::VisibilityReason;
use crate::runtime::LedgerReport;
use crate::units::{ChannelId, MissionTime};

impl Journal {
    fn with_visibilities(&self) -> impl Iterator<Item = &JournalRecord> {
        self.visibilities.values().filter(|record| record.entry.visibilities > 0)
    }

    pub(in crate::ground) fn packets(&self) -> usize {
        self.with_visibilities().count()
    }

    /// Packets with visibilities, each with the fraction of its offered visibilities that was accumulated.
    pub(in crate::ground) fn accumulated_fractions(
        &self,
    ) -> impl Iterator<Item = (&JournalEntry, Option<f64>)> {
        self.with_visibilities().map(|record| {
            let offered = (record.offered > 0).then_some(record.offered);
            let share = offered.map(|offered| f64::from(record.accumulated) / f64::from(offered));
            (&record.entry, share)
        })
    }

    pub(in crate::ground) fn delivered(&self) -> impl Iterator<Item = (PacketKind, SendingKey)> {
        let visibilities = self.visibilities.keys().map(|sent| (PacketKind::Visibilities, *sent));
        visibilities.chain(self.others.keys().copied())
    }

    pub(in crate::ground) fn reception(&self) -> ReceptionCounters {
        let mut counters = ReceptionCounters::default();
        for record in self.visibilities.values() {
            counters.add_packet(PacketKind::Visibilities, record.bytes, &record.counts);
        }
        for ((kind, _), record) in &self.others {
            counters.add_packet(*kind, record.bytes, &record.counts);
        }
        counters
    }

    /// The received blocks and the spacecraft's reports.
    pub(in crate::ground) fn blocks(&self) -> ReceivedBlocks {
        let mut blocks = ReceivedBlocks::default();
        for record in self.with_visibilities() {
            let JournalEntry { channel, pair, start, visibilities, .. } = record.entry;
            blocks.insert(BlockKey { channel, pair, first: start });
            if !record.is_duplicate {
                blocks.count(record.window, u64::from(visibilities));
            }
        }
        for record in self.visibilities.values() {
            blocks.count_bad(record.window, u64::from(record.counts.visibilities_bad_value));
        }
        self.others.values().filter_map(|record| record.report).for_each(|report| blocks.report(report));
        blocks
    }

    pub(in crate::ground) fn ledger(&self) -> LedgerReport<VisibilityReason> {
        let mut ledger = LedgerReport::default();
        for record in self.visibilities.values() {
            ledger.accumulated = ledger.accumulated.saturating_add(u64::from(record.accumulated));
            if record.is_duplicate {
                ledger.sampled = ledger.sampled.saturating_add(u64::from(record.entry.visibilities));
            }
            for &(reason, count) in &record.left_out {
                let sum = ledger.left_out.entry(reason).or_default();
                *sum = sum.saturating_add(u64::from(count));
            }
        }
        ledger
    }

    /// First and last mission time, s, of the data offered to the engine of each channel of the sums.
    pub(in crate::ground) fn spans_s(&self) -> BTreeMap<ChannelId, [f64; 2]> {
        let mut spans: BTreeMap<ChannelId, [f64; 2]> = BTreeMap::new();
        for record in self.visibilities.values() {
            let Some(SumsSpan { channel, span_s: [first, last] }) = record.used else { continue };
            let span = spans.entry(channel).or_insert([first, last]);
            *span = [span[0].min(first), span[1].max(last)];
        }
        spans
    }

    /// Mission time of the latest visibilities in the sums, s.
    pub(in crate::ground) fn latest_s(&self) -> Option<f64> {
        self.spans_s().values().map(|[_, last]| *last).reduce(f64::max)
    }

    /// Whether the sums hold cross-correlations that overlap a time span.
    pub(in crate::ground) fn uses(&self, [from, to]: [MissionTime; 2]) -> bool {
        self.visibilities.values().any(|JournalRecord { entry, accumulated, .. }| {
            *accumulated > 0 && entry.pair.i != entry.pair.j && entry.start <= to && entry.end >= from
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use num_complex::Complex32;

    use super::*;
    use crate::calibration::CalibrationConfig;
    use crate::downlink::receive::PacketOutcome;
    use crate::downlink::{
        CucTime, DownlinkConfig, FORMAT_VERSION, PacketHeader, PacketSegment, Transmission,
    };
    use crate::frames::{
        AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, PlacedFrame,
        PlacedVisibilities, VisibilityBlock,
    };
    use crate::ground::archive::RecordDraft;
    use crate::ground::{DeliveredPacket, Ground, GroundConfig};
    use crate::imaging::{EngineKind, MapConfig};
    use crate::ranks::{Ranks, on_threads};
    use crate::runtime::{Outlet, Stage};
    use crate::units::Pair;

    fn block(pair: Pair, start: i64) -> GroundFrame {
        GroundFrame::Visibilities(VisibilityBlock {
            pair,
            start: MissionTime(start),
            offset_ticks: vec![0, 10],
            duration_ticks: vec![10; 2],
            value_k_sr: vec![Complex32::new(3.0, 0.0); 2],
            weight: vec![1.0; 2],
            flags: vec![Flags::GOOD; 2],
            ..VisibilityBlock::default()
        })
    }

    /// An instrument; auto-correlations; a pair without ephemeris, sent twice in different packets; reports.
    fn transmission() -> Vec<u8> {
        let instrument = Instrument {
            name: "test".to_owned(),
            epoch_tai_s: 2e9,
            moon_radius_m: 1_737_100.0,
            satellites: 8,
            channels: vec![Channel { frequency_hz: 3e6, width_hz: 8e3 }],
            response: AntennaResponse::Isotropic,
            seed: 7,
            configuration_hash: 1,
            spectrometer: None,
            noiseless: false,
        };
        let report = |time: i64, sampled: u64| {
            GroundFrame::Housekeeping(Housekeeping { time: MissionTime(time), sampled, dropped: 1 })
        };
        let frames = [
            GroundFrame::Instrument(instrument),
            block(Pair { i: 1, j: 1 }, 100),
            block(Pair { i: 0, j: 1 }, 200),
            report(500, 9),
            block(Pair { i: 0, j: 1 }, 200),
            block(Pair { i: 0, j: 2 }, 900),
            report(1000, 12),
        ];
        let mut transmission = Transmission::new(&DownlinkConfig::default()).unwrap();
        let mut bytes = Vec::new();
        frames.iter().for_each(|frame| transmission.send(frame, &mut bytes).unwrap());
        bytes
    }

    #[test]
    fn counts_of_a_ground_equal_those_derived_from_its_journal() {
        let folder = tempfile::tempdir().unwrap();
        let (calibration, map) = (CalibrationConfig::default(), MapConfig::default());
        let config = GroundConfig {
            calibration,
            calibrate: Default::default(),
            map,
            wait_bytes: 0,
            memory_max_bytes: None,
            group: None,
            part: None,
        };
        let mut ground = Ground::open(folder.path(), &config, u64::MAX).unwrap();
        ground.step(transmission(), &mut Outlet::collect()).unwrap();
        {
            let journal = &ground.archive.as_ref().unwrap().journal;
            assert_eq!(journal.reception(), ground.collector.counters());
            assert_eq!(journal.ledger(), ground.outcome.ledger.report());
            assert_eq!(&journal.blocks(), ground.calibrator.blocks());
            assert_eq!((journal.blocks().visibilities(), journal.ledger().sampled), (6, 2));
            assert_eq!(journal.delivered().count(), 7);
        }
        ground.finish(&mut Outlet::collect()).unwrap();
        let counts = (ground.outcome.ledger.balanced_report().unwrap(), ground.collector.counters());
        drop(ground);
        // A session without data has the same counts.
        let mut again = Ground::open(folder.path(), &config, u64::MAX).unwrap();
        again.finish(&mut Outlet::collect()).unwrap();
        assert_eq!((again.outcome.ledger.balanced_report().unwrap(), again.collector.counters()), counts);
    }

    #[test]
    fn ranks_keep_a_state_together() {
        let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let map = MapConfig { engine: EngineKind::Harmonic, ..MapConfig::default() };
        let calibration = CalibrationConfig::default();
        let config = GroundConfig {
            calibration,
            calibrate: Default::default(),
            map,
            wait_bytes: 1 << 20,
            memory_max_bytes: None,
            group: None,
            part: None,
        };
        let bytes = transmission();
        let first = &bytes[..bytes.len() / 2];
        let session_in = |folder: &Path, ranks: &Ranks, bytes: &[u8]| {
            let mut ground = Ground::open_with_ranks(folder, &config, u64::MAX, ranks).unwrap();
            assert_eq!(ground.ranks().share(), ranks.share());
            ground.step(bytes.to_vec(), &mut Outlet::collect()).unwrap();
            ground.finish(&mut Outlet::collect()).unwrap();
            let notes: Vec<String> = ground.notes().map(str::to_owned).collect();
            (ground.outcome.ledger.balanced_report().unwrap(), ground.collector.counters(), notes)
        };
        let session = |ranks: &Ranks, bytes: &[u8]| session_in(folder.path(), ranks, bytes);
        let expected = [first, &bytes, &[]].map(|bytes| session_in(other.path(), &Ranks::single(), bytes));
        let names = || {
            let entries = std::fs::read_dir(folder.path()).unwrap();
            let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
            names.filter(|name| name.ends_with(".lunarray")).collect::<BTreeSet<String>>()
        };
        let set = |number: usize, parts: usize| {
            (1..=parts).map(move |part| format!("checkpoint-{number:08}.{part}-of-{parts}.lunarray"))
        };
        assert!(on_threads(3, |ranks| session(ranks, first)).iter().all(|found| *found == expected[0]));
        assert_eq!(names(), set(1, 3).collect());
        // Another number of ranks resumes; a part left by an interrupted job is not used, and removed.
        std::fs::copy(
            folder.path().join("checkpoint-00000001.2-of-3.lunarray"),
            folder.path().join("checkpoint-00000002.2-of-3.lunarray"),
        )
        .unwrap();
        let whole = on_threads(2, |ranks| session(ranks, &bytes));
        assert_eq!(names(), set(1, 3).chain(set(2, 2)).collect());
        assert!(whole.iter().all(|found| *found == expected[1]));
        // A part that is damaged, or from another place in the stream, makes its set unusable.
        let damaged = folder.path().join("checkpoint-00000002.2-of-2.lunarray");
        std::fs::copy(folder.path().join("checkpoint-00000001.2-of-3.lunarray"), damaged).unwrap();
        let again = on_threads(2, |ranks| session(ranks, &bytes));
        assert!(again[0].2[0].contains("parts of one checkpoint"), "{:?}", again[0].2);
        assert_eq!((&again[1].0, &again[1].1), (&expected[1].0, &expected[1].1));
        // A single process resumes, and its checkpoints replace the earlier sets.
        let alone = session(&Ranks::single(), &[]);
        assert_eq!((&alone.0, &alone.1), (&expected[2].0, &expected[2].1));
        session(&Ranks::single(), &[]);
        let expected_names = [3, 4].map(|number| format!("checkpoint-{number:08}.lunarray"));
        assert_eq!(names(), expected_names.into_iter().collect());
    }

    #[test]
    fn spans_are_of_the_channels_of_the_sums() {
        let mut journal = Journal::default();
        for (count, times_s) in [(0, [3.0, 4.0]), (1, [1.0, 2.0])] {
            let (kind, segment, time) = (PacketKind::Visibilities, PacketSegment::Whole, CucTime(count));
            let header = PacketHeader { kind, segment, count, time, version: FORMAT_VERSION, bytes: 60 };
            let mut draft = RecordDraft::new(Some(&block(Pair { i: 0, j: 1 }, 200)));
            // The second of two sub-bands of channel 2.
            draft.entry.channel = ChannelId(5);
            let channel = ChannelId(2);
            draft.offer(&PlacedFrame::Visibilities(PlacedVisibilities { channel, ..Default::default() }));
            draft.used_span_s = Some(times_s);
            let packet = DeliveredPacket { header, checksum: 1, counts: PacketOutcome::default() };
            journal.record_visibilities(&packet, draft, &LedgerReport::default());
        }
        assert_eq!(journal.spans_s(), BTreeMap::from([(ChannelId(2), [1.0, 4.0])]));
    }
}
