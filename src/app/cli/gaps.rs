//! `lunarray gaps`: list missing packets by their value for the map.

use std::fmt::Write as _;
use std::path::PathBuf;

use clap::Args;

use super::arguments::{input_path, picture_path};
use super::output::{CommandResult, Completion, print_json_line, print_notes, print_text};
use crate::downlink::PacketKind;
use crate::files::ProtectedInputs;
use crate::ground::archive::{ChannelCoverage, CoverageSurvey, GapReport, Gaps, RestartReport};
use crate::products::draw_coverage;

/// List missing packets, and what they would add to the map.
///
/// Reads a state folder of `lunarray replay --state`, one of its checkpoints, or a downlink file. Gaps are sorted by the gain of
/// their recovery: their weight relative to that in the map of the same channel, averaged over channels. Request the ranges of packet
/// counts from the spacecraft (the sequence count is the lower 14 bits). The content of a gap is estimated from that of a complete
/// window near it, and, for a state, from the fraction that entered the map. Missing positions count as the visibilities
/// that need them. Packets sent after the last one received, or before a restart of the counts, cannot be recognised as missing.
///
/// Example: lunarray gaps state/ --most 5 --picture coverage.png
#[derive(Debug, Args)]
pub(super) struct GapsArgs {
    /// State folder, checkpoint or downlink file.
    #[arg(value_name = "STATE|FILE", value_parser = input_path())]
    path: PathBuf,
    /// Maximum number of gaps shown; --json lists all.
    #[arg(long, default_value_t = 20)]
    most: usize,
    /// For scripts: fail (exit code 1) if anything is missing (any), or if the estimated gain of all gaps exceeds this percentage;
    /// with 0, also if any visibilities or positions are missing.
    #[arg(long, value_name = "any|PERCENT", value_parser = fail_if)]
    fail_if: Option<FailIf>,
    /// Write a picture (PNG, or SVG if its name ends so) of integration time over mission time, channel by channel.
    #[arg(long, value_name = "FILE.png", value_parser = picture_path())]
    picture: Option<PathBuf>,
    /// Print one JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

pub(super) fn execute(args: &GapsArgs) -> CommandResult {
    let _inputs = ProtectedInputs::of([&args.path]);
    let survey = CoverageSurvey::read(&args.path)?;
    print_notes(survey.notes());
    let gaps = survey.gaps();
    if let Some(path) = &args.picture {
        draw_coverage(&survey, &gaps)?.write(path)?;
    }
    if args.json {
        print_json_line(&gaps)?;
    } else {
        print_text(table(&gaps, args.most).trim_end())?;
    }
    let packets: u64 = gaps.gaps.iter().map(|gap| gap.to - gap.from + 1).sum();
    let waiting_h = waiting_h(&gaps);
    // Positions after the last ones received are in no gap.
    let adds = 100.0 * gaps.gaps.iter().map(|gap| gap.gain).sum::<f64>().max(lost_fraction(&gaps));
    let lacks_data =
        gaps.gaps.iter().any(|gap| matches!(gap.kind, PacketKind::Visibilities | PacketKind::Ephemeris))
            || waiting_h > 0.0;
    match args.fail_if {
        Some(FailIf::Any) if packets > 0 || waiting_h > 0.0 => Err(format!(
            "{packets} packets are missing, and {waiting_h:.3} h of visibilities have no positions; expected none"
        )
        .into()),
        // The gain is an estimate: with a limit of 0, any missing data fail even if their gain is 0.
        Some(FailIf::Above(limit)) if adds > limit || (limit == 0.0 && lacks_data) => {
            Err(format!("what is missing would add {adds:.4} %; expected at most {limit} %").into())
        }
        _ => Ok(Completion::Done),
    }
}

/// Integration time received without positions, hours.
fn waiting_h(gaps: &Gaps) -> f64 {
    gaps.channels.iter().map(|channel| channel.waiting_integration_s).sum::<f64>() / 3600.0
}

/// What is missing or has no positions, relative to the weight in the map, averaged over channels.
fn lost_fraction(gaps: &Gaps) -> f64 {
    let of_channel = |channel: &ChannelCoverage| {
        let lost = channel.missing_weight + channel.waiting_weight;
        if channel.weight > 0.0 { lost / channel.weight } else { f64::from(u8::from(lost > 0.0)) }
    };
    gaps.channels.iter().map(of_channel).sum::<f64>() / gaps.channels.len().max(1) as f64
}

/// Condition under which the command fails.
#[derive(Clone, Copy, Debug, PartialEq)]
enum FailIf {
    /// Any packet is missing.
    Any,
    /// The estimated gain of all gaps exceeds this percentage.
    Above(f64),
}

fn fail_if(text: &str) -> Result<FailIf, String> {
    match (text, text.trim_end_matches('%').trim().parse::<f64>()) {
        ("any", _) => Ok(FailIf::Any),
        (_, Ok(percent)) if (0.0..1e9).contains(&percent) => Ok(FailIf::Above(percent)),
        _ => Err("expected any, or a percentage of at least 0".into()),
    }
}

fn table(gaps: &Gaps, gaps_max: usize) -> String {
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "channel        MHz     packets  received, h  missing, h  without positions, h  weight lost"
    );
    for channel in &gaps.channels {
        let lost = channel.missing_weight + channel.waiting_weight;
        let lost_percent = if lost > 0.0 { 100.0 * lost / (channel.weight + lost) } else { 0.0 };
        let [received_h, missing_h, waiting_h] =
            [channel.integration_s, channel.missing_integration_s, channel.waiting_integration_s]
                .map(|time_s| time_s / 3600.0);
        let (number, packets) = (channel.channel, channel.packets);
        let mhz = channel.frequency_hz.map_or("?".to_owned(), |hz| format!("{:.4}", hz / 1e6));
        let _ = writeln!(
            text,
            "{number:<7} {mhz:>10} {packets:>11} {received_h:>12.2} {missing_h:>11.2} {waiting_h:>21.2} {lost_percent:>10.3} %"
        );
    }
    if !gaps.restarts.is_empty() {
        text.push('\n');
    }
    for RestartReport { kind, apid, last } in &gaps.restarts {
        let _ = writeln!(
            text,
            "{apid:#05x}: the spacecraft restarted its packet counts after packet {last} of {kind}; losses there are unknown"
        );
    }
    let waiting_h = waiting_h(gaps);
    if waiting_h > 0.0 && !gaps.gaps.iter().any(|gap| gap.kind == PacketKind::Ephemeris) {
        let _ = writeln!(
            text,
            "\n{waiting_h:.2} h of visibilities have no positions, and no packet of them is missing between those received: later ones are \
             missing, or none has come."
        );
    }
    if gaps.gaps.is_empty() {
        text.push_str("\nNo packets are missing between those received.");
        return text;
    }
    let _ = writeln!(text, "\n APID        from          to  lost, h  gain, %  lost by channel and pair");
    for gap in gaps.gaps.iter().take(gaps_max) {
        let GapReport { apid, from, to, integration_s, gain, .. } = gap;
        let (lost_h, gain_percent) = (integration_s / 3600.0, 100.0 * gain);
        let _ = write!(text, "{apid:#05x} {from:>11} {to:>11} {lost_h:>8.3} {gain_percent:>8.4}  ");
        text.push_str(&largest_losses(gap));
        text.push('\n');
    }
    text.push_str("What missing packets held is estimated from the windows around them, and may be of another channel or pair.\n");
    if gaps.gaps.len() > gaps_max {
        let _ = writeln!(text, "and {} more (see --most and --json)", gaps.gaps.len() - gaps_max);
    }
    text
}

fn largest_losses(gap: &GapReport) -> String {
    const SHOWN: usize = 3;
    let kind = match gap.kind {
        PacketKind::Visibilities => String::new(),
        PacketKind::Ephemeris if !gap.lost.is_empty() => format!("{}, needed by ", gap.kind),
        kind => return kind.to_string(),
    };
    let mut lost: Vec<_> = gap.lost.iter().collect();
    lost.sort_by(|a, b| b.integration_s.total_cmp(&a.integration_s));
    let shown: Vec<String> = lost
        .iter()
        .take(SHOWN)
        .map(|lost| format!("{}: {} {:.0} s", lost.channel, lost.pair, lost.integration_s))
        .collect();
    let more = lost.len().saturating_sub(SHOWN);
    let rest = if more > 0 { format!(", and {more} more") } else { String::new() };
    kind + &shown.join(", ") + &rest
}
