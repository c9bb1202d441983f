//! `lunarray extract`: cut packets out of a downlink.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;

use super::arguments::{input_path, output_path};
use super::output::{CommandResult, Completion, print_json_line, print_text};
use crate::downlink::receive::EventReader;
use crate::downlink::{DownlinkError, Event, PacketKind};
use crate::files::{AtomicFile, IfUnfinished, ProtectedInputs, Separator, numbered_lines, read_text};

/// Largest file of ranges that is read, bytes: a million lines.
const RANGES_BYTES_MAX: u64 = 1 << 24;

/// Cut the packets of given counts out of downlink files.
///
/// For a station that is asked to send missing packets again: ranges are lines of APID, first and last count, as *copy ranges* on the page
/// copies them and `lunarray gaps` lists them. Writes each intact packet of the files that is in a range, once, as CCSDS packets, which
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
    let mut found = std::collections::BTreeSet::new();
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
    let wanted: u64 = ranges.iter().map(|range| range.to - range.from + 1).sum();
    let counts: std::collections::BTreeSet<_> = found.iter().map(|(kind, count, _)| (kind, count)).collect();
    let (packets, missing) = (found.len(), wanted.saturating_sub(counts.len() as u64));
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

/// Parses ranges, one per line; lines without cells and comments (`#`) are skipped.
fn parse(text: &str) -> Result<Vec<PacketRange>, String> {
    let ranges: Vec<PacketRange> = numbered_lines(text)
        .map(|(number, line)| (number, line.split('#').next().unwrap_or_default().trim()))
        .map(|(number, line)| {
            parse_range(line).ok_or_else(|| {
                format!(
                    "line {number}: found `{line}`; expected APID, first and last count, such as 0x103 61 62"
                )
            })
        })
        .collect::<Result<_, _>>()?;
    if ranges.is_empty() { Err("no range; expected lines such as 0x103 61 62".into()) } else { Ok(ranges) }
}

fn parse_range(line: &str) -> Option<PacketRange> {
    let mut words = Separator::CommasOrBlanks.cells(line);
    let apid = words.next()?;
    let apid = match apid.strip_prefix("0x") {
        Some(digits) => u16::from_str_radix(digits, 16).ok()?,
        None => apid.parse().ok()?,
    };
    let (from, to) =
        (words.next()?.parse().ok()?, words.next().map_or(Some(None), |word| word.parse().ok().map(Some))?);
    let range = PacketRange { kind: PacketKind::of_apid(apid)?, from, to: to.unwrap_or(from) };
    (range.from <= range.to && words.next().is_none()).then_some(range)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_lines_of_apid_and_counts() {
        let found = parse("\u{feff}0x103 61 62\n\n,\n258, 14 # positions\n").unwrap();
        let range = |kind, from, to| PacketRange { kind, from, to };
        assert_eq!(found, [range(PacketKind::Visibilities, 61, 62), range(PacketKind::Ephemeris, 14, 14)]);
        for text in
            ["", "# nothing", "0x103", "0x103 5 4", "0x103 1 2 3", "0x999 1 2", "0x103 a b", "0x103 -1 2"]
        {
            assert!(parse(text).is_err(), "{text}");
        }
    }
}
