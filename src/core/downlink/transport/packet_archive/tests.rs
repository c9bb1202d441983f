//! Tests of an archive in a folder.

use std::path::Path;

use super::folder::segment_name;
use super::writer::BATCH_STEP;
use super::*;
use crate::downlink::wire::{CucTime, PacketHeader, PacketSegment, packet_checksum};

/// A packet of visibilities with an arbitrary payload.
fn packet(count: u64) -> Vec<u8> {
    let payload = [count as u8; 100];
    let (kind, segment, time) = (PacketKind::Visibilities, PacketSegment::Whole, CucTime(1 << 40));
    let bytes = crate::downlink::wire::HEADER_BYTES + payload.len() + 4;
    let header = PacketHeader { kind, segment, count, time, version: crate::downlink::FORMAT_VERSION, bytes };
    let mut packet = [header.to_bytes().as_slice(), &payload].concat();
    packet.extend(packet_checksum(&packet));
    packet
}

fn packets(counts: std::ops::Range<u64>) -> Vec<u8> {
    counts.flat_map(packet).collect()
}

fn all_of(folder: &Path) -> (Vec<u8>, ArchiveScan) {
    let mut found = Vec::new();
    let take = |piece: Vec<u8>| -> Result<(), DownlinkError> {
        found.extend(piece);
        Ok(())
    };
    let scan = read_archive(folder, take).unwrap();
    (found, scan)
}

fn unsaved(folder: &Path, checkpoint: u64) -> u64 {
    let none = |_: Vec<u8>| -> Result<(), DownlinkError> { Ok(()) };
    read_unsaved(folder, Some(checkpoint), none).unwrap().packets
}

#[test]
fn every_packet_is_kept_once_and_marks_show_which_a_checkpoint_lacks() {
    let temp = tempfile::tempdir().unwrap();
    let archive = PacketArchive::open(temp.path(), u64::MAX).unwrap();
    // The last two come again, as from a second station.
    let ticket = archive.append(&packets(0..5), BATCH_STEP).unwrap();
    archive.append(&packets(3..8), 2 * BATCH_STEP).unwrap();
    archive.sync(ticket).unwrap();
    assert_eq!(all_of(temp.path()).0, packets(0..8));
    // Checkpoint 7 has the first batch, 8 has both.
    archive.record_checkpoint(7, BATCH_STEP, &[7]).unwrap();
    archive.record_checkpoint(8, 2 * BATCH_STEP, &[7, 8]).unwrap();
    assert_eq!([unsaved(temp.path(), 6), unsaved(temp.path(), 7), unsaved(temp.path(), 8)], [8, 3, 0]);
    drop(archive);
    // Another session continues in a new segment.
    let archive = PacketArchive::open(temp.path(), u64::MAX).unwrap();
    assert_eq!([unsaved(temp.path(), 7), unsaved(temp.path(), 8)], [3, 0]);
    archive.append(&packets(8..9), 130).unwrap();
    assert_eq!([unsaved(temp.path(), 8), archive.report().segments], [1, 2]);
    // Damaged marks are ignored: everything is read.
    let marks = std::fs::read_to_string(temp.path().join(MARKS)).unwrap();
    std::fs::write(temp.path().join(MARKS), marks.replacen('8', "9", 1)).unwrap();
    assert_eq!(unsaved_bytes(temp.path(), Some(8)).unwrap(), packets(0..9).len() as u64);
}

#[test]
fn a_flipped_bit_costs_one_packet_and_a_torn_end_only_the_last() {
    let temp = tempfile::tempdir().unwrap();
    let archive = PacketArchive::open(temp.path(), u64::MAX).unwrap();
    archive.append(&packets(0..4), 1).unwrap();
    drop(archive);
    let path = temp.path().join(segment_name(1));
    let mut bytes = std::fs::read(&path).unwrap();
    let length = packet(0).len();
    bytes[length + 50] ^= 4;
    bytes.truncate(4 * length - 30);
    std::fs::write(&path, bytes).unwrap();
    // The next segment is not read as the rest of the torn packet.
    let archive = PacketArchive::open(temp.path(), u64::MAX).unwrap();
    archive.append(&packets(4..6), 1).unwrap();
    let (found, scan) = all_of(temp.path());
    assert_eq!(found, [packets(0..1), packets(2..3), packets(4..6)].concat());
    assert_eq!((scan.packets, scan.damaged > 1), (4, true));
}

#[test]
fn retracted_packets_are_left_out_until_they_are_received_again() {
    let temp = tempfile::tempdir().unwrap();
    let archive = PacketArchive::open(temp.path(), u64::MAX).unwrap();
    archive.append(&packets(0..3), 1).unwrap();
    archive.retract(&[(PacketKind::Visibilities, 1, CucTime(1 << 40))]).unwrap();
    assert_eq!(all_of(temp.path()).0, [packet(0), packet(2)].concat());
    archive.append(&packets(0..3), 2).unwrap();
    assert_eq!(all_of(temp.path()).0, [packet(0), packet(2), packet(1)].concat());
    drop(archive);
    // A damaged list is an error, as retracted packets would return silently.
    let list = temp.path().join(RETRACTED);
    let text = std::fs::read_to_string(&list).unwrap();
    std::fs::write(&list, text.replacen("259", "258", 1)).unwrap();
    assert!(PacketArchive::open(temp.path(), u64::MAX).is_err());
}

#[test]
fn packets_that_could_not_be_written_are_accepted_when_they_are_sent_again() {
    let temp = tempfile::tempdir().unwrap();
    let folder = temp.path().join("archive");
    let archive = PacketArchive::open(&folder, u64::MAX).unwrap();
    std::fs::rename(&folder, temp.path().join("gone")).unwrap();
    assert!(archive.append(&packets(0..3), 1).is_err());
    assert_eq!((archive.report().failed, archive.report().unwritten.is_some()), (1, true));
    std::fs::rename(temp.path().join("gone"), &folder).unwrap();
    let ticket = archive.append(&packets(0..3), 2).unwrap();
    archive.sync(ticket).unwrap();
    assert_eq!(all_of(&folder).0, packets(0..3));
    assert_eq!(archive.report().unwritten, None);
}

#[test]
fn a_full_archive_deletes_the_oldest_segments_that_all_checkpoints_contain() {
    let temp = tempfile::tempdir().unwrap();
    // Three sessions, with a segment each.
    for count in 0..3 {
        let archive = PacketArchive::open(temp.path(), 1).unwrap();
        archive.append(&packets(count..count + 1), 1).unwrap();
        // A checkpoint with the segments of earlier sessions only.
        archive.record_checkpoint(1 + count, 0, &[count, 1 + count]).unwrap();
    }
    let archive = PacketArchive::open(temp.path(), 1).unwrap();
    assert!(!archive.report().is_whole);
    let (found, scan) = all_of(temp.path());
    // Checkpoint 2 contains the first segment, checkpoint 3 the first two: only the first may be deleted.
    assert_eq!((found, scan.first_segment), (packets(1..3), 2));
}
