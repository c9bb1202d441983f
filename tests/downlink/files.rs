//! Downlink files: written, truncated, damaged, inspected.

use std::fs;
use std::path::Path;

use lunarray::array::{Array, ArrayConfig, Ephemeris, segments_for};
use lunarray::downlink::wire::cadu::randomize;
use lunarray::downlink::{
    Contents, DownlinkConfig, DownlinkError, DownlinkReader, DownlinkWriter, FileSource, Format, PacketHeader,
};
use lunarray::frames::{
    AntennaResponse, Channel, Flags, GroundFrame, Housekeeping, Instrument, VisibilityBlock,
};
use lunarray::units::{ChannelId, MissionTime, Pair};
use num_complex::Complex32;

const VISIBILITIES: u32 = 2_000;

fn frames() -> Vec<GroundFrame> {
    let array = Array::new(&ArrayConfig::default()).unwrap();
    let mut frames = vec![GroundFrame::Instrument(Instrument {
        name: "files".to_owned(),
        // 2037-01-01T00:00:00 UTC with 37 leap seconds: 28855 days after 1958-01-01.
        epoch_tai_s: 28_855.0 * 86_400.0 + 37.0,
        moon_radius_m: 1_737_100.0,
        satellites: 8,
        channels: vec![
            Channel { frequency_hz: 3e6, width_hz: 8e3 },
            Channel { frequency_hz: 1e7, width_hz: 8e3 },
        ],
        response: AntennaResponse::Isotropic,
        seed: 1,
        configuration_hash: 0xABCD,
        spectrometer: None,
        noiseless: false,
    })];
    for window in 0..2 {
        let start = MissionTime(8_248_680_000 * window);
        let end = start.plus_ticks(2_750_000_000);
        frames.extend(segments_for(&array, start, end, 60.0).into_iter().map(GroundFrame::Ephemeris));
        for channel in 0..2 {
            frames.push(GroundFrame::Visibilities(VisibilityBlock {
                channel: ChannelId(channel),
                pair: Pair { i: 0, j: 1 + channel as u8 },
                start,
                offset_ticks: (0..VISIBILITIES).map(|k| 1_000_000 * k).collect(),
                duration_ticks: vec![500_000; VISIBILITIES as usize],
                value_k_sr: vec![Complex32::new(1.0, -1.0); VISIBILITIES as usize],
                weight: vec![1.0; VISIBILITIES as usize],
                flags: (0..VISIBILITIES).map(|k| Flags(u8::from(k % 100 == 0))).collect(),
            }));
        }
        let sampled = 2 * u64::from(VISIBILITIES) * (window as u64 + 1);
        frames.push(GroundFrame::Housekeeping(Housekeeping { time: end, sampled, dropped: 0 }));
    }
    frames
}

fn write(path: &Path) -> u64 {
    let mut writer = DownlinkWriter::create(path, &DownlinkConfig::default()).unwrap();
    for frame in frames() {
        writer.write(&frame).unwrap();
    }
    writer.finish().unwrap()
}

#[test]
fn a_file_has_its_name_only_when_it_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    let partial = folder.path().join("pass.ccsds.partial");
    fs::write(&path, "an older file").unwrap();
    let mut writer = DownlinkWriter::create(&path, &DownlinkConfig::default()).unwrap();
    for frame in frames() {
        writer.write(&frame).unwrap();
    }
    // It has a name that nobody else chooses.
    assert_eq!((partial.exists(), fs::read_dir(folder.path()).unwrap().count()), (false, 2));
    assert_eq!(fs::read(&path).unwrap(), b"an older file");
    let bytes = writer.bytes();
    assert_eq!(writer.finish().unwrap(), bytes);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    assert_eq!(fs::metadata(&path).unwrap().len(), bytes);
}

#[test]
fn every_visibility_is_read_and_placed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    write(&path);
    let mut reader = DownlinkReader::open(&path).unwrap();
    let mut ephemeris = Ephemeris::default();
    let (mut placed, mut flagged, mut channels) = (0, 0, Vec::new());
    while let Some(frame) = reader.next_frame().unwrap() {
        match frame {
            GroundFrame::Instrument(instrument) => channels = instrument.channels,
            GroundFrame::Ephemeris(segment) => {
                ephemeris.insert(segment);
            }
            GroundFrame::Visibilities(block) => {
                let frequency_hz = channels[usize::from(block.channel.0)].frequency_hz;
                let (_, counts) = ephemeris.place(&block, frequency_hz);
                assert_eq!(counts.without_ephemeris, 0);
                placed += counts.placed;
                flagged += counts.flagged.values().sum::<u64>();
            }
            GroundFrame::Housekeeping(counts) => assert_eq!(placed + flagged, counts.sampled),
        }
    }
    assert_eq!((placed, flagged), (4 * 1_980, 4 * 20));
    assert_eq!(reader.counters().visibilities_decoded, 8_000);
}

#[test]
fn a_second_file_goes_on_with_what_the_first_has_taught() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    write(&path);
    let mut first = DownlinkReader::open(&path).unwrap();
    while first.next_frame().unwrap().is_some() {}
    let mut bytes = fs::read(&path).unwrap();
    bytes.drain(..PacketHeader::parse(&bytes).unwrap().bytes);
    let mut second =
        DownlinkReader::new(bytes.as_slice(), Path::new("again")).with_decoder(first.into_decoder());
    while second.next_frame().unwrap().is_some() {}
    assert_eq!(second.counters().visibilities_decoded, 16_000);
}

#[test]
fn a_sound_file_is_said_to_be_so() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    let bytes = write(&path);
    let contents = Contents::read(&path).unwrap();
    assert!(contents.is_sound());
    let json = serde_json::to_value(&contents).unwrap();
    assert_eq!(json["bytes"], bytes);
    let of_kinds: u64 = contents.packets.iter().map(|row| row.bytes).sum();
    assert_eq!(of_kinds, bytes);
    assert_eq!(json["span"]["start_utc"], "2037-01-01T00:00:00.000");
    // The last integration begins 1999 s into the second window and lasts half a second.
    assert_eq!(json["span"]["end_s"], 8_248.68 + 1_999.5);
    assert_eq!(json["visibilities"]["count"], 8_000);
    assert_eq!(json["visibilities"]["integration_s"], 4_000.0);
    assert_eq!(json["baselines"][1]["pair"], "1-3");
    assert_eq!(json["baselines"][1]["channel"], 1);
    assert_eq!(json["baselines"][1]["flagged"], 40);
    assert_eq!(json["channels"][0]["frequency_hz"], 3e6);
    assert_eq!(json["channels"][0]["count"], 4_000);
    assert_eq!(json["ephemeris"]["covered"]["count"], 2);
    // Nodes are whole microseconds apart: the last is less than as many ticks late as there are nodes.
    let covered_s = json["ephemeris"]["covered_s"].as_f64().unwrap();
    assert!((0.0..1e-4).contains(&(covered_s - 5_500.0)), "{covered_s}");
    assert_eq!(json["housekeeping"]["sampled"], 8_000);
    let text = contents.to_string();
    for part in ["pass.ccsds", "sound", "1-2", "10.000 MHz", "visibilities  8000", "0x103"] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn damage_is_told_with_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    write(&path);
    let bytes = fs::read(&path).unwrap();
    let mut packets = Vec::new();
    let mut at = 0;
    while let Some(header) = PacketHeader::parse(&bytes[at..]) {
        packets.push((at, header));
        at += header.bytes;
    }
    let whole: Vec<(usize, PacketHeader)> =
        packets.iter().filter(|(_, header)| header.kind.apid() == 0x103).copied().collect();
    let [(bad, bad_header), (lost, lost_header)] = [whole[2], whole[5]];
    let mut damaged = bytes.clone();
    damaged[bad + 100] ^= 1;
    damaged.drain(lost..lost + lost_header.bytes);
    damaged.splice(lost..lost, [0xAA; 33]);
    damaged.truncate(damaged.len() - 1);
    fs::write(&path, damaged).unwrap();

    let contents = Contents::read(&path).unwrap();
    assert!(!contents.is_sound());
    let bad_entry = &contents.bad_checksums.listed[0];
    assert_eq!((bad_entry.offset, bad_entry.count), (bad as u64, bad_header.count));
    let gap = &contents.gaps.listed[0];
    assert_eq!((gap.from, gap.to, gap.count), (lost_header.count, lost_header.count, 1));
    assert!(gap.after_s <= gap.before_s && gap.after_s > Some(0.0));
    let garbage = &contents.garbage.listed[0];
    assert_eq!((garbage.offset, garbage.bytes), (lost as u64, 33));
    let cut = packets.last().unwrap().1.bytes as u64 - 1;
    assert_eq!(contents.truncated_bytes, cut);
    assert_eq!([contents.gaps.count, contents.bad_checksums.count, contents.garbage.count], [1, 1, 1]);
    let text = contents.to_string();
    for part in ["gaps: 1", "bad checksums: 1", "garbage: 1", "33 bytes", "truncated"] {
        assert!(text.contains(part), "{part}: {text}");
    }
}

#[test]
fn empty_foreign_and_missing_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("some.file");
    let said = |path: &Path| {
        let error = Contents::read(path).unwrap_err();
        let same = DownlinkReader::open(path).and_then(|mut reader| reader.next_frame()).unwrap_err();
        assert_eq!(error.to_string(), same.to_string());
        assert!(error.to_string().contains("some.file"));
        error
    };
    assert!(matches!(said(&path), DownlinkError::Io { .. }));
    fs::write(&path, "").unwrap();
    assert!(matches!(said(&path), DownlinkError::EmptyFile { .. }));
    fs::write(&path, "SIMPLE  =                    T".repeat(96)).unwrap();
    assert!(matches!(said(&path), DownlinkError::NotADownlink { bytes: 2880, .. }));
    assert!(said(&path).to_string().contains("expected CCSDS space packets"));
    for (bytes, name) in [
        (&b"SIMPLE  =                    T"[..], "a FITS file"),
        (b"\xfd7zXZ\x00\x00", "an xz file: expand it first"),
        (b"\x89HDF\r\n\x1a\n\0\0", "an HDF5 file"),
        (b"<?xml version=\"1.0\"?><ndm></ndm>", "an XML document (<ndm>)"),
    ] {
        fs::write(&path, bytes).unwrap();
        assert!(said(&path).to_string().contains(name), "{name}: {}", said(&path));
    }
    for bytes in [&b"\x1f\x8b\x08\x00\x00\x00"[..], b"\x28\xb5\x2f\xfd\x24\x01"] {
        fs::write(&path, bytes).unwrap();
        assert!(
            said(&path).to_string().contains("file is damaged after 0 decompressed bytes"),
            "{}",
            said(&path)
        );
    }
}

/// Packets of a file, each whole.
fn packets(bytes: &[u8]) -> Vec<&[u8]> {
    let (mut rest, mut found) = (bytes, Vec::new());
    while let Some(header) = PacketHeader::parse(rest) {
        let (packet, after) = rest.split_at(header.bytes);
        found.push(packet);
        rest = after;
    }
    found
}

/// An idle packet of the standard: APID all ones, no secondary header.
fn idle_packet(bytes: usize) -> Vec<u8> {
    let mut packet = vec![0x07, 0xFF, 0xC0, 0x00];
    packet.extend(((bytes - 7) as u16).to_be_bytes());
    packet.resize(bytes, 0x55);
    packet
}

#[test]
fn idle_packets_are_no_garbage() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    write(&path);
    let bytes = fs::read(&path).unwrap();
    let mut filled = idle_packet(100);
    for packet in packets(&bytes) {
        filled.extend_from_slice(packet);
        filled.extend(idle_packet(7));
        filled.extend(idle_packet(1500));
    }
    let idle = filled.len() - bytes.len();
    fs::write(&path, &filled).unwrap();
    let contents = Contents::read(&path).unwrap();
    assert!(contents.is_sound(), "{contents}");
    assert_eq!((contents.idle_bytes, contents.visibilities.count), (idle as u64, 8_000));
    // Nothing is passed over by a claim: what follows an idle packet has to be one, or ours.
    let mut forged = packets(&bytes)[0].to_vec();
    forged.extend(&idle_packet(30_000)[..6]);
    packets(&bytes)[1..].iter().for_each(|packet| forged.extend_from_slice(packet));
    fs::write(&path, &forged).unwrap();
    let contents = Contents::read(&path).unwrap();
    assert_eq!((contents.garbage.count, contents.visibilities.count), (1, 8_000));
    // A file that ends within one is cut.
    fs::write(&path, &filled[..filled.len() - 1]).unwrap();
    assert_eq!(Contents::read(&path).unwrap().truncated_bytes, 1_499);
}

#[test]
fn a_file_that_lacks_visibilities_is_not_sound() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    write(&path);
    let bytes = fs::read(&path).unwrap();
    // Without its first packets of visibilities: no gap shows it.
    let is_visibilities =
        |packet: &&&[u8]| PacketHeader::parse(packet).is_some_and(|header| header.kind.apid() == 0x103);
    let all = packets(&bytes);
    let first = all.iter().position(|packet| is_visibilities(&packet)).unwrap();
    let rest: Vec<u8> =
        all.iter().enumerate().filter(|(k, _)| *k != first).flat_map(|(_, packet)| packet.to_vec()).collect();
    fs::write(&path, &rest).unwrap();
    let contents = Contents::read(&path).unwrap();
    let lost = 8_000 - contents.visibilities.count;
    assert!(lost > 0 && contents.gaps.count == 0 && contents.is_undamaged() && !contents.is_sound());
    assert_eq!(contents.found_minus_reported(), Some(-(lost as i64)));
    let text = contents.to_string();
    assert!(text.contains(&format!("not sound: {lost} of 8000 visibilities")), "{text}");
    assert!(!text.contains("\nsound"), "{text}");
    // Without the spacecraft's counts nothing is known.
    let uncounted: Vec<u8> = all
        .iter()
        .filter(|packet| PacketHeader::parse(packet).is_none_or(|header| header.kind.apid() != 0x105))
        .flat_map(|packet| packet.to_vec())
        .collect();
    fs::write(&path, &uncounted).unwrap();
    let contents = Contents::read(&path).unwrap();
    assert!(!contents.is_sound() && contents.to_string().contains("no report of the spacecraft's counts"));
}

#[test]
fn a_file_in_any_order_is_as_sound_as_in_the_order_of_sending() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    // The positions are in segments.
    let config = DownlinkConfig { packet_bytes_max: 2_000, ..DownlinkConfig::default() };
    let mut writer = DownlinkWriter::create(&path, &config).unwrap();
    frames().iter().for_each(|frame| writer.write(frame).unwrap());
    writer.finish().unwrap();
    let bytes = fs::read(&path).unwrap();
    let sent = packets(&bytes);
    let is_segment = |packet: &&[u8]| packet[2] >> 6 != 3;
    assert!(sent.iter().any(is_segment));
    // Of every kind: the order, not the packets, says how many are late.
    let contents_of = |packets: &[&[u8]]| {
        fs::write(&path, packets.concat()).unwrap();
        let contents = Contents::read(&path).unwrap();
        let mut value = serde_json::to_value(&contents).unwrap();
        for kind in ["instrument", "ephemeris", "visibilities", "housekeeping"] {
            value["reception"][kind]["late"] = 0.into();
        }
        (contents, value)
    };
    let (whole, in_order) = contents_of(&sent);
    assert!(whole.is_sound(), "{whole}");
    let orders: [Vec<usize>; 3] = [
        (0..sent.len()).rev().collect(),
        (0..sent.len() / 2).flat_map(|k| [2 * k + 1, 2 * k]).chain(sent.len() / 2 * 2..sent.len()).collect(),
        (sent.len() / 3..sent.len()).chain(0..sent.len() / 3).collect(),
    ];
    for order in &orders {
        let turned: Vec<&[u8]> = order.iter().map(|k| sent[*k]).collect();
        let (contents, value) = contents_of(&turned);
        assert!(contents.is_sound() && contents.to_string().contains("\nsound: "), "{contents}");
        assert_eq!(value, in_order);
        // Two neighbours lost, of visibilities: one gap, before the packet that follows them in the order of sending.
        let of_visibilities: Vec<usize> =
            (0..sent.len()).filter(|k| PacketHeader::parse(sent[*k]).unwrap().kind.apid() == 0x103).collect();
        let [lost, also_lost, next] = [2, 3, 4].map(|k| of_visibilities[k]);
        let rest: Vec<usize> = order.iter().copied().filter(|k| ![lost, also_lost].contains(k)).collect();
        let (contents, _) = contents_of(&rest.iter().map(|k| sent[*k]).collect::<Vec<_>>());
        assert_eq!(contents.gaps.count, 1, "{contents}");
        let count = |k: usize| PacketHeader::parse(sent[k]).unwrap().count;
        let offset: usize = rest.iter().take_while(|k| **k != next).map(|k| sent[*k].len()).sum();
        let gap = &contents.gaps.listed[0];
        assert_eq!((gap.from, gap.to, gap.offset), (count(lost), count(also_lost), offset as u64));
        assert_eq!(contents.reception.visibilities.missing, 2);
        assert!(contents.to_string().contains("\nnot sound: "), "{contents}");
    }
}

#[test]
fn there_is_always_a_verdict() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.ccsds");
    write(&path);
    let bytes = fs::read(&path).unwrap();
    let sent = packets(&bytes);
    let without = |is_lost: &dyn Fn(usize, &PacketHeader) -> bool| {
        let kept =
            sent.iter().enumerate().filter(|(k, packet)| !is_lost(*k, &PacketHeader::parse(packet).unwrap()));
        fs::write(&path, kept.flat_map(|(_, packet)| packet.to_vec()).collect::<Vec<u8>>()).unwrap();
        Contents::read(&path).unwrap().to_string()
    };
    // All visibilities are there, but not all positions; no description; no counts.
    let ephemeris: Vec<usize> =
        (0..sent.len()).filter(|k| PacketHeader::parse(sent[*k]).unwrap().kind.apid() == 0x102).collect();
    let second = ephemeris[1];
    let lacks_positions = without(&|k, _| k == second);
    assert!(
        lacks_positions.contains("\nnot sound: ") && lacks_positions.contains("gaps: 1"),
        "{lacks_positions}"
    );
    let lacks_description = without(&|_, header| header.kind.apid() == 0x101);
    assert!(lacks_description.contains("\nnot sound: "), "{lacks_description}");
    assert!(lacks_description.contains("no instrument description came"), "{lacks_description}");
    let lacks_counts = without(&|_, header| header.kind.apid() == 0x105);
    assert!(lacks_counts.contains("\nnot known to be sound: "), "{lacks_counts}");
}

#[test]
fn frames_of_another_kind_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pass.cadu");
    let config = DownlinkConfig { format: Format::Cadu, ..DownlinkConfig::default() };
    let mut writer = DownlinkWriter::create(&path, &config).unwrap();
    frames().iter().for_each(|frame| writer.write(frame).unwrap());
    writer.finish().unwrap();
    let cadus = fs::read(&path).unwrap();
    assert!(Contents::read(&path).unwrap().is_sound());
    // 1279 octets each: a marker and 5 x 255 of which 5 x 223 are the frame.
    let blocks: Vec<Vec<u8>> = cadus
        .chunks_exact(1279)
        .map(|cadu| {
            let mut block = cadu[4..].to_vec();
            randomize(&mut block);
            block
        })
        .collect();
    let said = |bytes: Vec<u8>| {
        fs::write(&path, bytes).unwrap();
        let replayed = FileSource::open(std::slice::from_ref(&path)).err().map(|error| error.to_string());
        let inspected = Contents::read(&path).unwrap_err().to_string();
        assert_eq!(replayed.as_ref(), Some(&inspected));
        inspected
    };
    let bare = said(blocks.iter().flat_map(|block| block[..5 * 223].to_vec()).collect());
    assert!(bare.contains("AOS transfer frames of 1115 bytes without sync markers"), "{bare}");
    let plain =
        said(blocks.iter().flat_map(|block| [&[0x1A, 0xCF, 0xFC, 0x1D], &block[..]].concat()).collect());
    assert!(plain.contains("CADUs of 1279 bytes whose blocks are not randomized"), "{plain}");
}

#[test]
fn an_output_that_cannot_be_written_is_named() {
    let folder = tempfile::tempdir().unwrap();
    // Folders are made; a file in the way of one is an error.
    let path = folder.path().join("no such folder");
    fs::write(&path, "").unwrap();
    let path = path.join("pass.ccsds");
    let error = DownlinkWriter::create(&path, &DownlinkConfig::default()).unwrap_err();
    assert!(error.to_string().contains("no such folder"), "{error}");
    let config = DownlinkConfig { packet_bytes_max: 10, repeat_bytes: 0, ..DownlinkConfig::default() };
    assert_eq!(config.problems().len(), 2);
    assert!(DownlinkWriter::create(&folder.path().join("x"), &config).is_err());
}
