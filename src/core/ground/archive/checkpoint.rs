//! Reads and writes checkpoint files.

use std::fs::File;
use std::io::{BufReader, BufWriter, ErrorKind, Read, Seek, SeekFrom, Write};
use std::path::Path;

use bincode::Encode;
use bincode::enc::write::SizeWriter;
use bincode::error::{DecodeError, EncodeError};
use crc_fast::{CrcAlgorithm, Digest};

use super::calibration_state::CalibrationState;
use super::journal::Journal;
use crate::calibration::AutoTable;
use crate::frames::EphemerisSegment;
use crate::ground::{CollectorState, CollectorView, GroundError};
use crate::imaging::AccumulatorState;

const MAGIC: &[u8; 8] = b"LNRSTA13";
const ANY_VERSION: &[u8; 6] = b"LNRSTA";
const VERSION: &str = "a checkpoint of version 13; earlier ones lack how fringes of bursts turn, or more: make a new state \
with `lunarray rebuild`, or replay the files into a new folder";
/// Size of the magic, the length of the head, and the checksum, bytes.
const FIXED_BYTES: u64 = 24;

const CHUNK_BYTES: u64 = 1 << 20;

/// Maximum memory of a decoded head per byte on disk. The record of an ephemeris packet needs the most, 120 bytes for at
/// least 14.
const MEMORY_PER_BYTE: usize = 16;

/// The head of a checkpoint: data and the journal, without the sums.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::ground) struct ArchiveHead {
    /// Keys and values of the settings on which the sums depend.
    pub(in crate::ground) settings: Vec<(String, String)>,
    pub(in crate::ground) collector: CollectorState,
    pub(in crate::ground) ephemeris: Vec<EphemerisSegment>,
    pub(in crate::ground) autos: AutoTable,
    pub(in crate::ground) accumulator: AccumulatorState,
    pub(in crate::ground) journal: Journal,
    /// Default if the head ends before it.
    pub(in crate::ground) calibration: CalibrationState,
    /// Checksum of the encoded head. Heads with equal bytes are equal even if they contain NaN.
    pub(in crate::ground) checksum: u64,
}

/// A borrowed [`ArchiveHead`] for writing without copies of large fields.
#[derive(Encode)]
pub(in crate::ground) struct ArchiveHeadView<'a> {
    pub(in crate::ground) settings: &'a Vec<(String, String)>,
    pub(in crate::ground) collector: CollectorView<'a>,
    pub(in crate::ground) ephemeris: Vec<&'a EphemerisSegment>,
    pub(in crate::ground) autos: &'a AutoTable,
    pub(in crate::ground) accumulator: AccumulatorState,
    pub(in crate::ground) journal: &'a Journal,
    pub(in crate::ground) calibration: CalibrationState,
}

struct ChecksumWriter<'a, W> {
    inner: &'a mut W,
    crc: Digest,
}

impl<W: Write> Write for ChecksumWriter<'_, W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.inner.write(bytes)?;
        self.crc.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.inner.flush()
    }
}

/// Writes a checkpoint; `sums` writes its sums.
pub(in crate::ground) fn write(
    out: &mut impl Write,
    path: &Path,
    head: &ArchiveHeadView<'_>,
    sums: impl FnOnce(&mut dyn Write) -> Result<(), GroundError>,
) -> Result<(), GroundError> {
    let failed = || GroundError::io(path, "write");
    let damaged = |found: String| GroundError::Damaged {
        path: path.to_owned(),
        found,
        expected: "a serialisable state",
    };
    let config = bincode::config::standard();
    let mut size = SizeWriter::default();
    let refused = |error: EncodeError| damaged(error.to_string());
    bincode::encode_into_writer(head, &mut size, config).map_err(refused)?;
    let mut summed = ChecksumWriter { inner: out, crc: Digest::new(CrcAlgorithm::Crc64Nvme) };
    summed.write_all(MAGIC).map_err(failed())?;
    summed.write_all(&(size.bytes_written as u64).to_le_bytes()).map_err(failed())?;
    // The encoder makes many small writes.
    let mut buffered = BufWriter::with_capacity(1 << 16, &mut summed);
    bincode::encode_into_std_write(head, &mut buffered, config).map_err(|error| match error {
        EncodeError::Io { inner, .. } => failed()(inner),
        other => refused(other),
    })?;
    buffered.flush().map_err(failed())?;
    drop(buffered);
    sums(&mut summed)?;
    let crc = summed.crc.finalize();
    out.write_all(&crc.to_le_bytes()).map_err(failed())
}

/// Whether a checkpoint is intact and has this head.
pub(in crate::ground) fn is_of_head(path: &Path, head: &ArchiveHeadView<'_>) -> Result<bool, GroundError> {
    let found = read(path, |head, sums| {
        std::io::copy(sums, &mut std::io::sink()).map_err(GroundError::io(path, "read"))?;
        Ok(head.checksum)
    });
    let crc = Digest::new(CrcAlgorithm::Crc64Nvme);
    let mut sink = std::io::sink();
    let mut buffered = BufWriter::with_capacity(1 << 16, ChecksumWriter { inner: &mut sink, crc });
    let encoded = bincode::encode_into_std_write(head, &mut buffered, bincode::config::standard());
    let crc = match buffered.into_inner() {
        Ok(summed) => summed.crc,
        Err(_) => return Ok(false),
    };
    Ok(encoded.is_ok() && found.is_ok_and(|found| found == crc.finalize()))
}

/// Whether a file starts like a checkpoint of any version.
pub(in crate::ground) fn is_checkpoint(path: &Path) -> Result<bool, GroundError> {
    let mut magic = Vec::new();
    let file = File::open(path).map_err(GroundError::io(path, "open the file"))?;
    file.take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(GroundError::io(path, "read"))?;
    Ok(magic.len() == MAGIC.len() && magic.starts_with(ANY_VERSION))
}

/// Reads a checkpoint; `rest` takes the head and the reader of the sums.
pub(in crate::ground) fn read<T>(
    path: &Path,
    rest: impl FnOnce(ArchiveHead, &mut dyn Read) -> Result<T, GroundError>,
) -> Result<T, GroundError> {
    read_from(&mut open(path)?, path, rest)
}

pub(in crate::ground) fn verify(path: &Path) -> Result<(), GroundError> {
    verified_length(&mut open(path)?, path).map(|_| ())
}

fn open(path: &Path) -> Result<File, GroundError> {
    File::open(path).map_err(GroundError::io(path, "open the checkpoint"))
}

/// Reads a checkpoint from any reader, after verifying its checksum. Messages call it `path`.
pub(in crate::ground) fn read_from<T>(
    from: &mut (impl Read + Seek),
    path: &Path,
    rest: impl FnOnce(ArchiveHead, &mut dyn Read) -> Result<T, GroundError>,
) -> Result<T, GroundError> {
    let failed = || GroundError::io(path, "read");
    let damaged = |found: String, expected| GroundError::Damaged { path: path.to_owned(), found, expected };
    let bytes = verified_length(from, path)?;
    from.rewind().map_err(failed())?;
    let mut from = BufReader::with_capacity(bytes.min(CHUNK_BYTES) as usize, from);
    let mut fixed = [0; 16];
    from.read_exact(&mut fixed).map_err(failed())?;
    let (magic, length) = fixed.split_at(8);
    if magic != MAGIC {
        return Err(damaged(format!("{magic:02x?}"), VERSION));
    }
    let length = length.first_chunk().map_or(0, |length| u64::from_le_bytes(*length));
    if length > bytes - FIXED_BYTES {
        return Err(damaged(format!("a head of {length} bytes"), "a head that fits in the file"));
    }
    let mut encoded = vec![0; length as usize];
    from.read_exact(&mut encoded).map_err(failed())?;
    let (mut head, used) = decode(&encoded).map_err(|error| damaged(error.to_string(), "a head"))?;
    head.checksum = crc_fast::checksum(CrcAlgorithm::Crc64Nvme, &encoded);
    if used as u64 != length {
        return Err(damaged("bytes after the head".into(), "none"));
    }
    if !head.collector.is_sound() || !head.journal.is_sound() {
        return Err(damaged("invalid packets".into(), "packets that can be received"));
    }
    if !head.calibration.passes.is_sound(head.collector.instrument()) {
        return Err(damaged("invalid passes".into(), "passes of the instrument"));
    }
    let channels = head.collector.instrument().map_or(0, |instrument| instrument.channels.len());
    if !head.calibration.bursts.iter().all(|burst| burst.is_sound(channels)) {
        return Err(damaged("invalid bursts".into(), "bursts in channels of the instrument"));
    }
    if !head.calibration.searched.iter().all(|passes| passes.is_sound(channels)) {
        return Err(damaged("invalid passes".into(), "passes of channels of the instrument"));
    }
    let mut sums = from.take(bytes - FIXED_BYTES - length);
    let found = rest(head, &mut sums)?;
    match sums.limit() {
        0 => Ok(found),
        left => Err(damaged(format!("{left} bytes after the sums"), "none")),
    }
}

/// Decodes a head, and returns it with its length in bytes. Memory is limited in proportion to the bytes present, whatever lengths
/// they claim: by the smallest of a few fixed limits that suffices, at most four times as much.
fn decode(bytes: &[u8]) -> Result<(ArchiveHead, usize), DecodeError> {
    let limit = bytes.len().saturating_mul(MEMORY_PER_BYTE);
    match usize::BITS - limit.leading_zeros() {
        0..=20 => decode_within::<{ power_of_two(20) }>(bytes),
        21..=22 => decode_within::<{ power_of_two(22) }>(bytes),
        23..=24 => decode_within::<{ power_of_two(24) }>(bytes),
        25..=26 => decode_within::<{ power_of_two(26) }>(bytes),
        27..=28 => decode_within::<{ power_of_two(28) }>(bytes),
        29..=30 => decode_within::<{ power_of_two(30) }>(bytes),
        31..=32 => decode_within::<{ power_of_two(32) }>(bytes),
        33..=34 => decode_within::<{ power_of_two(34) }>(bytes),
        _ => decode_within::<{ power_of_two(36) }>(bytes),
    }
}

/// 2^`bits`, or what addresses can reach.
const fn power_of_two(bits: u32) -> usize {
    if bits < usize::BITS { 1 << bits } else { usize::MAX }
}

fn decode_within<const LIMIT: usize>(bytes: &[u8]) -> Result<(ArchiveHead, usize), DecodeError> {
    let config = bincode::config::standard().with_limit::<LIMIT>();
    let (fields, used) = bincode::decode_from_slice(bytes, config)?;
    let (settings, collector, ephemeris, autos, accumulator, journal) = fields;
    let (mut calibration, mut more) = match &bytes[used..] {
        [] => (CalibrationState::default(), 0),
        rest => bincode::decode_from_slice(rest, config)?,
    };
    if used + more < bytes.len() {
        let (bursts, last) = bincode::decode_from_slice(&bytes[used + more..], config)?;
        calibration.bursts = bursts;
        more += last;
    }
    if used + more < bytes.len() {
        let (searched, last) = bincode::decode_from_slice(&bytes[used + more..], config)?;
        calibration.searched = searched;
        more += last;
    }
    let head =
        ArchiveHead { settings, collector, ephemeris, autos, accumulator, journal, calibration, checksum: 0 };
    Ok((head, used + more))
}

/// Length of a checkpoint, bytes, after verifying its checksum.
fn verified_length(from: &mut (impl Read + Seek), path: &Path) -> Result<u64, GroundError> {
    let failed = || GroundError::io(path, "read");
    let damaged = |found: String, expected| GroundError::Damaged { path: path.to_owned(), found, expected };
    let bytes = from.seek(SeekFrom::End(0)).map_err(failed())?;
    if bytes < FIXED_BYTES {
        return Err(damaged(format!("{bytes} bytes"), "at least 24"));
    }
    from.rewind().map_err(failed())?;
    let mut body = from.by_ref().take(bytes - 8);
    let mut crc = Digest::new(CrcAlgorithm::Crc64Nvme);
    let mut chunk = vec![0; bytes.min(CHUNK_BYTES) as usize];
    loop {
        match body.read(&mut chunk) {
            Ok(0) => break,
            Ok(read) => crc.update(&chunk[..read]),
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(failed()(error)),
        }
    }
    let mut stored = [0; 8];
    from.read_exact(&mut stored).map_err(failed())?;
    let found = crc.finalize();
    if found != u64::from_le_bytes(stored) {
        return Err(damaged(format!("checksum {found:016x}"), "the checksum in the file"));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use std::ops::Range;

    use num_complex::Complex32;

    use super::*;
    use crate::calibration::{Calibrator, Identity, SearchedPasses};
    use crate::downlink::receive::PacketOutcome;
    use crate::downlink::{
        CucTime, DownlinkConfig, FORMAT_VERSION, PacketHeader, PacketKind, PacketSegment, Transmission,
    };
    use crate::frames::{
        AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, PlacedFrame, VisibilityBlock,
        VisibilityReason,
    };
    use crate::ground::archive::draft::RecordDraft;
    use crate::ground::{Collector, DeliveredPacket};
    use crate::imaging::Accumulator;
    use crate::runtime::{Ledger, Outlet, Stage};
    use crate::units::MissionTime;

    /// Calls `take` with a head whose parts are all non-empty.
    fn with_head<T>(take: impl FnOnce(&ArchiveHeadView<'_>) -> T) -> T {
        let channels = vec![Channel { frequency_hz: 3e6, width_hz: 8e3 }];
        let instrument = Instrument {
            name: "test".to_owned(),
            epoch_tai_s: 2e9,
            moon_radius_m: 1_737_100.0,
            satellites: 8,
            channels,
            response: AntennaResponse::Isotropic,
            seed: 7,
            configuration_hash: 1,
            spectrometer: None,
            noiseless: false,
        };
        let own = VisibilityBlock {
            offset_ticks: vec![0],
            duration_ticks: vec![10],
            value_k_sr: vec![Complex32::new(3.0, 0.0)],
            weight: vec![1.0],
            flags: vec![Flags::GOOD],
            ..VisibilityBlock::default()
        };
        let positions_m = vec![[0.0; 3]; 8 * 8];
        let segment = EphemerisSegment { start: MissionTime(0), step_ticks: 9, satellites: 8, positions_m };
        let frames = [
            GroundFrame::Instrument(instrument.clone()),
            GroundFrame::Visibilities(own),
            GroundFrame::Ephemeris(segment),
            GroundFrame::Housekeeping(Housekeeping { time: MissionTime(5), sampled: 9, dropped: 1 }),
        ];
        let ledger = Ledger::new();
        ledger.add_left_out(VisibilityReason::BaselineBeyondMap, 4);
        let mut accumulator = Accumulator::new(Default::default(), ledger.clone());
        let mut calibrator = Calibrator::new(Box::new(Identity), ledger.clone()).with_autos();
        let mut collector = Collector::new(1000);
        let mut transmission = Transmission::new(&DownlinkConfig::default()).unwrap();
        let mut bytes = Vec::new();
        for frame in frames {
            transmission.send(&frame, &mut bytes).unwrap();
            calibrator.step(frame, &mut Outlet::collect()).unwrap();
        }
        accumulator.step(PlacedFrame::Instrument(instrument), &mut Outlet::collect()).unwrap();
        collector.push(&bytes);
        collector.finish();
        while collector.next_delivery(&|_| true).unwrap().is_some() {}
        let (kind, segment, time) = (PacketKind::Visibilities, PacketSegment::Whole, CucTime(3));
        let header = PacketHeader { kind, segment, count: 3, time, version: FORMAT_VERSION, bytes: 60 };
        let mut journal = Journal::default();
        let packet = DeliveredPacket { header, checksum: 1, counts: PacketOutcome::default() };
        journal.record_visibilities(&packet, RecordDraft::default(), &ledger.report());
        let settings = vec![("map.nside".to_owned(), "4".to_owned())];
        let searched = SearchedPasses {
            channel: 0,
            frequency_hz: 3e6,
            passes: 5,
            not_searched: 4,
            not_searched_beside_burst: 3,
        };
        take(&ArchiveHeadView {
            settings: &settings,
            collector: collector.view(),
            ephemeris: calibrator.ephemeris().segments().collect(),
            autos: calibrator.autos().unwrap(),
            accumulator: accumulator.state(),
            journal: &journal,
            calibration: CalibrationState { searched: vec![searched], ..CalibrationState::default() },
        })
    }

    fn written(head: &ArchiveHeadView<'_>) -> Vec<u8> {
        let mut bytes = Vec::new();
        let sums =
            |out: &mut dyn Write| out.write_all(b"engines").map_err(GroundError::io(Path::new("x"), "write"));
        write(&mut bytes, Path::new("x"), head, sums).unwrap();
        bytes
    }

    fn read_back(bytes: &[u8]) -> Result<ArchiveHead, GroundError> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        read(file.path(), |head, sums| {
            std::io::copy(sums, &mut std::io::sink()).map_err(GroundError::io(file.path(), "read"))?;
            Ok(head)
        })
    }

    /// The byte range of each field, in the order of writing.
    fn fields(head: &ArchiveHeadView<'_>, bytes: usize) -> Vec<(&'static str, Range<usize>)> {
        let length = |size: Result<Vec<u8>, EncodeError>| size.unwrap().len();
        let config = bincode::config::standard();
        let lengths = [
            ("magic", 8),
            ("length", 8),
            ("settings", length(bincode::encode_to_vec(head.settings, config))),
            ("collector", length(bincode::encode_to_vec(&head.collector, config))),
            ("ephemeris", length(bincode::encode_to_vec(&head.ephemeris, config))),
            ("autos", length(bincode::encode_to_vec(head.autos, config))),
            ("accumulator", length(bincode::encode_to_vec(&head.accumulator, config))),
            ("journal", length(bincode::encode_to_vec(head.journal, config))),
            ("calibration", length(bincode::encode_to_vec(&head.calibration, config))),
            ("engines", 7),
            ("checksum", 8),
        ];
        let mut at = 0;
        let mut place = |(name, length): (&'static str, usize)| {
            at += length;
            (name, at - length..at)
        };
        let found: Vec<_> = lengths.map(&mut place).to_vec();
        assert_eq!(at, bytes);
        found
    }

    #[test]
    fn damage_in_any_field_is_found() {
        with_head(|head| {
            let good = written(head);
            assert_eq!(read_back(&good).unwrap().settings, *head.settings);
            for (name, range) in fields(head, good.len()) {
                assert!(!range.is_empty());
                for at in range {
                    let mut bad = good.clone();
                    bad[at] ^= 0x11;
                    assert!(matches!(read_back(&bad), Err(GroundError::Damaged { .. })), "{name}, byte {at}");
                }
            }
        });
    }

    #[test]
    fn forged_fields_are_errors_or_read_in_bounded_memory() {
        with_head(|head| {
            let good = written(head);
            for (_, range) in fields(head, good.len()) {
                for at in range.filter(|at| *at < good.len() - 8) {
                    // 0xFD announces a length of eight bytes, which gives the largest lengths.
                    for forged in [0xFD, 0xFC, 0x00] {
                        let mut bad = good.clone();
                        bad[at] = forged;
                        let body = bad.len() - 8;
                        let crc = crc_fast::checksum(CrcAlgorithm::Crc64Nvme, &bad[..body]);
                        bad[body..].copy_from_slice(&crc.to_le_bytes());
                        // With a valid checksum there must be no panic.
                        let _ = read_back(&bad);
                    }
                }
            }
        });
    }

    #[test]
    fn announced_lengths_reserve_no_more_than_the_bytes_there_allow() {
        // A list of settings that announces 4 GiB of memory, or just more than the limit, in heads of 60 bytes and of a
        // megabyte, is refused. Just below the limit, decoding fails only at the end of the bytes.
        let settings = size_of::<(String, String)>() as u64;
        for (bytes, limit) in [(60, 1 << 20), (1 << 20, 1 << 26)] {
            for (announced, is_refused) in [
                ((1_u64 << 32) / settings, true),
                (limit / settings + 1, true),
                (limit / settings - 1, false),
            ] {
                let mut forged = vec![0xFD];
                forged.extend(announced.to_le_bytes());
                forged.resize(bytes, 1);
                let error = decode(&forged).unwrap_err();
                let refused = matches!(error, DecodeError::LimitExceeded);
                assert_eq!(refused, is_refused, "{bytes}, {announced}: {error}");
            }
        }
    }

    #[test]
    fn what_is_written_is_read() {
        with_head(|head| {
            let found = read_back(&written(head)).unwrap();
            assert_eq!(found.journal, *head.journal);
            assert_eq!(found.calibration, head.calibration);
            assert_eq!(found.ephemeris.iter().collect::<Vec<_>>(), head.ephemeris);
            assert_eq!(found.accumulator, head.accumulator);
            assert!(found.autos == *head.autos && found.autos != AutoTable::default());
            let delivered = found.journal.delivered();
            let again = Collector::resume(found.collector, delivered, found.journal.reception());
            assert_eq!(again.view(), head.collector);
        });
    }

    #[test]
    fn an_earlier_version_is_refused_and_says_what_to_do() {
        with_head(|head| {
            for earlier in [b"LNRSTA10", b"LNRSTA11", b"LNRSTA12"] {
                let mut old = written(head);
                old[..8].copy_from_slice(earlier);
                let body = old.len() - 8;
                let crc = crc_fast::checksum(CrcAlgorithm::Crc64Nvme, &old[..body]);
                old[body..].copy_from_slice(&crc.to_le_bytes());
                let said = read_back(&old).unwrap_err().to_string();
                let is_said = said.contains("a checkpoint of version 13;") && MAGIC.ends_with(b"13");
                assert!(is_said && said.contains("replay the files into a new folder"), "{said}");
            }
        });
    }
}
