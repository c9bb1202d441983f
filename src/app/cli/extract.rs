//! `lunarray extract`: cut packets out of a downlink.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::PathBuf;

use clap::Args;

use super::arguments::{input_path, output_path};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::downlink::receive::EventReader;
use crate::downlink::{COUNT_MAX, DownlinkError, Event, PacketKind};
use crate::files::{AtomicFile, IfUnfinished, ProtectedInputs, Separator, numbered_lines, read_text};

/// Largest file of ranges that is read, bytes: a million lines.
const RANGES_BYTES_MAX: u64 = 1 << 24;

/// Cut the packets of given counts out of downlink files.
///
/// For a station that is asked to send missing packets again: ranges are lines of APID, first and last count, as *copy ranges* on the page
/// copies them; `lunarray gaps` has them in its first columns. Writes each intact packet of the files that is in a range, once, as CCSDS packets, which
/// `lunarray replay` and a listening ground take.
///
/// Example: lunarray extract pass-*.cadu --ranges ranges.txt --out again.ccsds
#[derive(Debug, Args)]
pub(super) struct ExtractArgs {
    /// Downlink files, packets or CADUs.
    #[arg(required = true, value_name = "FILE", value_parser = input_path())]
    files: Vec<PathBuf>,
    /// File of ranges, one per line: APID, first and last count, such as `0x103 61 62`; - for standard input.
    #[arg(long, value_name = "FILE|-")]
    ranges: PathBuf,
    /// File for the packets.
    #[arg(short, long, value_name = "FILE", value_parser = output_path())]
    out: PathBuf,
    /// Print one JSON object instead of text: packets, missing, out.
    #[arg(long)]
    json: bool,
}

/// Packets of one kind with consecutive counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct PacketRange {
    kind: PacketKind,
    from: u64,
    to: u64,
}

pub(super) fn execute(args: &ExtractArgs) -> CommandResult {
    let _inputs = ProtectedInputs::of(args.files.iter().chain([&args.ranges]));
    let name = args.ranges.display();
    let text = match args.ranges.as_os_str() == "-" {
        true => std::io::read_to_string(std::io::stdin()),
        false => read_text(&args.ranges, RANGES_BYTES_MAX),
    };
    let text = text.map_err(|error| format!("{name}: cannot read: {error}"))?;
    let ranges = parse(&text).map_err(|reason| format!("{name}: {reason}"))?;
    let failed =
        |error: std::io::Error| DownlinkError::Io { path: args.out.clone(), action: "write", source: error };
    let mut out = AtomicFile::create(&args.out, IfUnfinished::Remove).map_err(failed)?;
    let mut found = BTreeSet::new();
    for file in &args.files {
        let mut events = EventReader::open(file)?.unfiltered();
        events.for_each(|event| -> Result<(), DownlinkError> {
            let Event::Packet(packet) = event else { return Ok(()) };
            let header = packet.header;
            let is_wanted = |range: &PacketRange| {
                range.kind == header.kind && (range.from..=range.to).contains(&header.count)
            };
            if ranges.iter().any(is_wanted) && found.insert((header.kind, header.count, header.time)) {
                let mut bytes = Vec::new();
                packet.append_to(&mut bytes);
                out.write_all(&bytes).map_err(failed)?;
            }
            Ok(())
        })?;
        events.require_packets()?;
    }
    if found.is_empty() {
        return Err(format!("none of the packets in {name} is in the files; expected at least one").into());
    }
    out.finish().map_err(failed)?;
    let counts: BTreeSet<_> = found.iter().map(|(kind, count, _)| (kind, count)).collect();
    let (packets, missing) = (found.len(), wanted(&ranges) - counts.len() as u64);
    if args.json {
        print_json_line(&serde_json::json!({ "packets": packets, "missing": missing, "out": args.out }))?;
    } else {
        let rest = if missing > 0 {
            format!("; {missing} of the ranges are not in the files")
        } else {
            String::new()
        };
        print_text(&format!("{packets} packets in {}{rest}", args.out.display()))?;
    }
    Ok(Completion::Done)
}

/// Number of packets in ranges; those in several count once.
fn wanted(ranges: &[PacketRange]) -> u64 {
    let mut ranges = ranges.to_vec();
    ranges.sort_by_key(|range| (range.kind, range.from));
    // Counts of a kind fit 46 bits, so that sums of all kinds do not overflow.
    let of_kind = |ranges: &[PacketRange]| {
        let (mut packets, mut next) = (0, 0);
        for range in ranges {
            let from = range.from.max(next);
            packets += (range.to + 1).saturating_sub(from);
            next = next.max(range.to + 1);
        }
        packets
    };
    ranges.chunk_by(|a, b| a.kind == b.kind).map(of_kind).sum()
}

/// Parses ranges, one per line; lines without cells and comments (`#`) are skipped.
fn parse(text: &str) -> Result<Vec<PacketRange>, String> {
    let ranges: Vec<PacketRange> = numbered_lines(text)
        .map(|(number, line)| (number, line.split('#').next().unwrap_or_default().trim()))
        .map(|(number, line)| {
            parse_range(line)
                .map_err(|expected| format!("line {number}: found `{line}`; expected {expected}"))
        })
        .collect::<Result<_, _>>()?;
    if ranges.is_empty() { Err("no range; expected lines such as 0x103 61 62".into()) } else { Ok(ranges) }
}

/// Parses a range; an error is what was expected.
fn parse_range(line: &str) -> Result<PacketRange, String> {
    let form = "APID, first and last count, such as 0x103 61 62";
    let cells: Vec<_> = Separator::CommasOrBlanks.cells(line).collect();
    let words: Vec<&str> = cells.iter().map(AsRef::as_ref).collect();
    let (apid, from, to) = match words[..] {
        [apid, count] => (apid, count, count),
        [apid, from, to] => (apid, from, to),
        _ => return Err(form.to_owned()),
    };
    let number = match apid.strip_prefix("0x") {
        Some(digits) => u16::from_str_radix(digits, 16),
        None => apid.parse(),
    };
    let kind = PacketKind::of_apid(number.map_err(|_| form)?);
    let kind = kind.ok_or_else(|| {
        let known: Vec<String> = PacketKind::ALL.iter().map(|kind| format!("{:#x}", kind.apid())).collect();
        format!("one of the APIDs {}", known.join(", "))
    })?;
    let count = |word: &str| {
        let found = word.parse().ok().filter(|count| *count <= COUNT_MAX);
        // Digits alone are a number that is too large.
        let is_number = !word.is_empty() && word.bytes().all(|digit| digit.is_ascii_digit());
        let most = || format!("counts of at most {COUNT_MAX}, the largest of a packet");
        found.ok_or_else(|| if is_number { most() } else { form.to_owned() })
    };
    let range = PacketRange { kind, from: count(from)?, to: count(to)? };
    match range.from <= range.to {
        true => Ok(range),
        false => Err("a first count that is not above the last".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_lines_of_apid_and_counts() {
        let found = parse("\u{feff}0x103 61 62\n\n,\n258, 14 # positions\n").unwrap();
        let range = |kind, from, to| PacketRange { kind, from, to };
        assert_eq!(found, [range(PacketKind::Visibilities, 61, 62), range(PacketKind::Ephemeris, 14, 14)]);
        for (text, expected) in [
            ("", "no range"),
            ("# nothing", "no range"),
            ("0x103", "first and last count"),
            ("0x103 5 4", "`0x103 5 4`; expected a first count that is not above the last"),
            ("0x103 1 2 3", "first and last count"),
            ("0x999 1 2", "one of the APIDs 0x101, 0x102, 0x103"),
            ("0x103 a b", "first and last count"),
            ("0x103 -1 2", "first and last count"),
            // Packets have counts of 46 bits.
            (
                "0x103 0 70368744177664",
                "line 1: found `0x103 0 70368744177664`; expected counts of at most 70368744177663",
            ),
            ("0x103 0 18446744073709551616", "expected counts of at most 70368744177663"),
        ] {
            let said = parse(text).unwrap_err();
            assert!(said.contains(expected), "{text}: {said}");
        }
    }

    #[test]
    fn packets_of_ranges_are_counted_once() {
        for (text, expected) in [
            ("0x103 0 70368744177663", 1 << 46),
            ("0x103 0 70368744177663\n0x102 0 70368744177663", 1 << 47),
            ("0x103 61 62\n0x103 62 64\n0x103 61\n0x102 61", 5),
        ] {
            assert_eq!(wanted(&parse(text).unwrap()), expected, "{text}");
        }
    }
}
