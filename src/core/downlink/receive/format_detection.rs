//! Identifies streams that are not a downlink from their first bytes, for error messages.

use crate::downlink::wire::cadu::{FrameHeader, IDLE, SYNC_MARKER, SYNC_MARKER_BYTES, randomize};
use crate::files::{form_of, form_with_remedy};

/// Number of leading bytes of a stream that are kept to identify its format.
pub(super) const HEAD_BYTES: usize = 16 << 10;

/// Plausible lengths of transfer frames, bytes, including sync marker and parity.
const FRAME_BYTES: std::ops::RangeInclusive<usize> = 32..=2 * 2048;
/// Minimum number of consecutive frames or packets that identify a format.
const FRAMES_MIN: usize = 3;

/// Identifies a stream from its first bytes; `None` if they are not recognised.
pub(super) fn identify(head: &[u8]) -> Option<String> {
    form_with_remedy(head)
        .or_else(|| identify_unsupported_frames(head))
        .or_else(|| identify_unsupported_coding(head))
        .or_else(|| identify_packets(head))
        .or_else(|| identify_text(head))
}

/// Identifies what contains packets but is no stream of them: files in an archive, and transfer frames without sync markers, or not
/// randomized.
pub(super) fn identify_unsupported_frames(head: &[u8]) -> Option<String> {
    if let archive @ Some("a tar archive") = form_of(head) {
        return archive.and_then(|_| form_with_remedy(head));
    }
    if let Some(bytes) = frame_length(|at| head.get(at..)) {
        return Some(format!(
            "AOS transfer frames of {bytes} bytes without sync markers: supply the CADUs as received, or the space packets \
             extracted from the frames"
        ));
    }
    let (marked, bytes) = marker_period(head)?;
    let frame = |at: usize| marked.get(at + SYNC_MARKER_BYTES..);
    if is_telemetry(bytes, frame) {
        return Some(format!(
            "TM transfer frames of {bytes} bytes with sync markers (CCSDS 132.0-B): supply the space packets extracted from the frames"
        ));
    }
    is_chain(bytes, frame).then(|| {
        format!(
            "CADUs of {bytes} bytes whose blocks are not randomized: expected the pseudo-randomizer of CCSDS 131.0-B, and \
             Reed-Solomon (255, 223) parity"
        )
    })
}

/// Identifies frames with sync markers in a coding that the receiver does not support.
fn identify_unsupported_coding(head: &[u8]) -> Option<String> {
    let (marked, bytes) = marker_period(head)?;
    let derandomized_start = |at: usize| {
        let block = marked.get(at + SYNC_MARKER_BYTES..)?;
        let mut start = block.get(..block.len().min(8))?.to_vec();
        randomize(&mut start);
        Some(start)
    };
    let is_aos_header = |start: Vec<u8>| FrameHeader::parse(&start).is_some();
    let is_aos = (0..3).all(|k| derandomized_start(k * bytes).is_some_and(is_aos_header));
    let frames = if is_aos { "randomized AOS frames" } else { "frames of another kind or coding" };
    Some(format!(
        "{frames} of {bytes} bytes with sync markers, but not the expected CADUs: randomized blocks of 255 to 2040 bytes with \
         Reed-Solomon (255, 223) parity"
    ))
}

/// Length of consecutive frames that begin at byte 0.
fn frame_length<'a>(at: impl Fn(usize) -> Option<&'a [u8]>) -> Option<usize> {
    FrameHeader::parse(at(0)?)?;
    FRAME_BYTES.into_iter().find(|&bytes| is_chain(bytes, &at))
}

/// Whether headers at multiples of `bytes` have one spacecraft identifier and consecutive counts in each virtual channel.
fn is_chain<'a>(bytes: usize, at: impl Fn(usize) -> Option<&'a [u8]>) -> bool {
    let mut last_counts: Vec<Option<u32>> = vec![None; 64];
    let (mut spacecraft, mut consecutive, mut frames) = (None, 0, 0);
    while let Some(start) = at(frames * bytes).filter(|start| start.len() >= 8) {
        let Some(header) = FrameHeader::parse(start) else { return false };
        if *spacecraft.get_or_insert(header.spacecraft) != header.spacecraft {
            return false;
        }
        let before = last_counts[usize::from(header.channel & 0x3F)].replace(header.count);
        match before {
            Some(before) if before + 1 == header.count => consecutive += 1,
            Some(_) if header.channel != IDLE => return false,
            _ => {}
        }
        frames += 1;
    }
    frames >= FRAMES_MIN && consecutive + 1 >= FRAMES_MIN
}

/// Whether headers at multiples of `bytes` are those of TM frames of one spacecraft, with consecutive counts of its master channel.
fn is_telemetry<'a>(bytes: usize, at: impl Fn(usize) -> Option<&'a [u8]>) -> bool {
    let header = |k: usize| at(k * bytes).and_then(<[u8]>::first_chunk::<3>).copied();
    let Some([first, second, count]) = header(0) else { return false };
    // Version 0, ten bits of the spacecraft, three of the virtual channel, a flag.
    let is_next = |k: usize, [a, b, c]: [u8; 3]| {
        a == first && b >> 4 == second >> 4 && c == count.wrapping_add(k as u8)
    };
    let headers: Vec<[u8; 3]> = (0..).map_while(header).collect();
    first >> 6 == 0
        && headers.len() >= FRAMES_MIN
        && headers.into_iter().enumerate().all(|(k, found)| is_next(k, found))
}

/// The stream from its first sync marker on, and the distance between markers.
fn marker_period(head: &[u8]) -> Option<(&[u8], usize)> {
    let marker = SYNC_MARKER.to_be_bytes();
    let marked = &head[head.windows(SYNC_MARKER_BYTES).position(|bytes| bytes == marker)?..];
    let is_marked = |at: usize| marked.get(at..at + SYNC_MARKER_BYTES) == Some(&marker[..]);
    let period = FRAME_BYTES.into_iter().find(|&bytes| {
        let frames = (marked.len() / bytes).max(FRAMES_MIN);
        (1..frames).all(|k| is_marked(k * bytes))
    })?;
    Some((marked, period))
}

/// Identifies space packets of other missions: headers whose lengths lead from one to the next.
fn identify_packets(head: &[u8]) -> Option<String> {
    let (mut at, mut apids) = (0, Vec::new());
    while let Some(&[a, b, _, _, c, d]) = head.get(at..).and_then(<[u8]>::first_chunk) {
        let apid = u16::from_be_bytes([a, b]) & 0x7FF;
        // The packet version must be 0. A header of zeros is rejected, as in a run of zeros.
        if a >> 5 != 0 || (apid == 0 && c == 0 && d == 0) {
            return None;
        }
        apids.push(apid);
        at += usize::from(u16::from_be_bytes([c, d])) + 7;
    }
    if apids.len() < FRAMES_MIN {
        return None;
    }
    apids.sort_unstable();
    apids.dedup();
    let shown: Vec<String> = apids.iter().take(4).map(|apid| format!("{apid:#05x}")).collect();
    let more = if apids.len() > shown.len() { ", .." } else { "" };
    Some(format!("space packets of other APIDs: {}{more}", shown.join(", ")))
}

fn identify_text(head: &[u8]) -> Option<String> {
    let head = head.strip_prefix(b"\xef\xbb\xbf").unwrap_or(head);
    let is_text = |byte: &u8| matches!(byte, b'\t' | b'\n' | b'\r' | 0x20..=0x7e | 0x80..);
    if head.is_empty()
        || !head.iter().all(is_text)
        || std::str::from_utf8(&head[..head.len().min(512)]).is_err_and(|error| error.error_len().is_some())
    {
        return None;
    }
    let text = String::from_utf8_lossy(head);
    let text = text.trim_start();
    Some(match text {
        _ if text.starts_with('<') => format!("an XML document (<{}>)", root_element(text)),
        _ if text.starts_with("CCSDS_") => {
            let name = text.split(|c: char| c == '=' || c.is_whitespace()).next().unwrap_or_default();
            format!("a CCSDS message ({name}): orbit files (OEM) are given with the key array.oem")
        }
        _ if text.starts_with(['{', '[']) => "JSON or TOML".to_owned(),
        _ => "a text file".to_owned(),
    })
}

fn root_element(text: &str) -> String {
    let elements = text.split('<').skip(1).filter(|element| !element.starts_with(['?', '!']));
    let name = |element: &str| {
        element.chars().take_while(|c| c.is_alphanumeric() || "_-:".contains(*c)).take(40).collect()
    };
    elements.map(name).next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::downlink::wire::cadu::SCIENCE;

    fn frames(count: u32, bytes: usize) -> Vec<Vec<u8>> {
        let frame = |count: u32| {
            let channel = if count % 3 == 2 { IDLE } else { SCIENCE };
            let number = if channel == IDLE { count / 3 } else { count - count / 3 };
            let mut frame =
                FrameHeader { spacecraft: 0x4C, channel, count: number, count_bits: 28 }.to_bytes().to_vec();
            frame.extend((6..bytes).map(|k| (k as u32 * 7 + count) as u8));
            frame
        };
        (0..count).map(frame).collect()
    }

    #[test]
    fn unsupported_frames_are_identified() {
        let bare = frames(9, 1115).concat();
        assert!(
            identify(&bare).unwrap().starts_with("AOS transfer frames of 1115 bytes without sync markers")
        );
        let marked = |encode: fn(&mut [u8])| -> Vec<u8> {
            let block = |mut frame: Vec<u8>| {
                encode(&mut frame);
                [&SYNC_MARKER.to_be_bytes()[..], &frame].concat()
            };
            frames(9, 1115).into_iter().flat_map(block).collect()
        };
        let plain = identify(&marked(|_| {})).unwrap();
        assert!(plain.starts_with("CADUs of 1119 bytes whose blocks are not randomized"), "{plain}");
        let no_parity = identify(&marked(randomize)).unwrap();
        assert!(
            no_parity.starts_with("randomized AOS frames of 1119 bytes with sync markers"),
            "{no_parity}"
        );
        // Randomized frames may be valid, so they are no reason to refuse a stream.
        assert_eq!(identify_unsupported_frames(&marked(randomize)), None);
        // Version 0, spacecraft 0x123, channels 1 and 2, counts that wrap.
        let telemetry = |step: u8| -> Vec<u8> {
            let frame = |k: u8| {
                let header = [0x12, 0x32 + 2 * (k % 2), 250_u8.wrapping_add(step * k), k / 2, 0x18, 0];
                [&SYNC_MARKER.to_be_bytes()[..], &header, &[k; 1109]].concat()
            };
            (0..9).flat_map(frame).collect()
        };
        let found = identify_unsupported_frames(&telemetry(1)).unwrap();
        assert!(found.starts_with("TM transfer frames of 1119 bytes"), "{found}");
        assert_eq!(identify_unsupported_frames(&telemetry(3)), None);
        // A stream may begin anywhere.
        assert_eq!(identify(&marked(|_| {})[500..]), Some(plain));
    }

    #[test]
    fn other_formats_are_identified() {
        let packet = |apid: u16, bytes: usize| {
            let mut packet = (0x0800 | apid).to_be_bytes().to_vec();
            packet.extend([0xC0, 0, 0, (bytes - 1) as u8]);
            packet.extend(vec![0xA5; bytes]);
            packet
        };
        let packets = [packet(0x2A1, 30), packet(0x2A2, 7), packet(0x2A1, 12)].concat();
        for (head, name) in [
            (&b"\x1f\x8b\x08\x00"[..], "gzip"),
            (b"\x28\xb5\x2f\xfd\x04", "zstd"),
            (b"\x89HDF\r\n\x1a\n\0", "HDF5"),
            (b"SIMPLE  =                    T", "FITS"),
            (b"\xef\xbb\xbf<?xml version=\"1.0\"?>\n<!-- x -->\n<ndm id=\"1\">", "an XML document (<ndm>)"),
            (b"CCSDS_OEM_VERS = 2.0\n", "a CCSDS message (CCSDS_OEM_VERS)"),
            (b"{\"a\": 1}", "JSON"),
            (b"a,b,c\n1,2,3\n", "a text file"),
            (&packets, "space packets of other APIDs: 0x2a1, 0x2a2"),
        ] {
            assert!(identify(head).is_some_and(|found| found.contains(name)), "{name}: {:?}", identify(head));
        }
        // Packets in an archive would be found, and the rest of it taken for damage.
        let tar = [&b"s.ccsds"[..], &[0; 250], b"ustar  \0", &[0; 247], &packets].concat();
        let found = identify_unsupported_frames(&tar);
        assert_eq!(found.as_deref(), Some("a tar archive: unpack it first (tar -x)"));
        for unknown in [&[0; 600][..], &[0xFF; 600], b"", b"\x01"] {
            assert_eq!(identify(unknown), None);
        }
    }
}
