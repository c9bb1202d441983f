//! Events of the instrument that a ground tells while it finds gains.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use lunarray::downlink::{DownlinkReader, PacketHeader, PacketKind};
use lunarray::frames::GroundFrame;
use serde_json::Value;

use super::{Mission, sets_of};
use crate::common::downlink::packets_of;

/// Pass, daughter and channel.
type Place = (u64, u32, usize);

impl Mission {
    /// The true errors, by pass (of those that were sent, from 0), daughter (from 1) and channel, of a column: the least and
    /// the greatest at the start, middle and end of the pass.
    fn truth(&self, column: usize) -> BTreeMap<Place, [f64; 2]> {
        let text = std::fs::read_to_string(format!("{}.instrument.csv", self.file)).unwrap();
        let rows: Vec<Vec<f64>> = text
            .lines()
            .skip(1)
            .map(|line| line.split(',').map(|number| number.parse().unwrap()).collect())
            .collect();
        let windows: BTreeSet<u64> = rows.iter().map(|row| row[0] as u64).collect();
        let mut truth = BTreeMap::new();
        for row in rows {
            let pass = windows.iter().position(|window| *window == row[0] as u64).unwrap() as u64;
            let value = row[column];
            let span = truth.entry((pass, row[2] as u32, row[3] as usize)).or_insert([value; 2]);
            *span = [span[0].min(value), span[1].max(value)];
        }
        truth
    }

    /// Least and greatest true change from each pass to the next, where there is any.
    fn changes(&self, column: usize) -> BTreeMap<Place, [f64; 2]> {
        let truth = self.truth(column);
        let change = |((pass, daughter, channel), now): (&Place, &[f64; 2])| {
            let before = truth.get(&(pass.checked_sub(1)?, *daughter, *channel))?;
            let change = [now[0] - before[1], now[1] - before[0]];
            (change != [0.0; 2]).then_some(((*pass, *daughter, *channel), change))
        };
        truth.iter().filter_map(change).collect()
    }
}

/// The lines of a file of events that tell what happened to the instrument.
fn told(text: &str) -> Vec<Value> {
    let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
    lines.filter(|line| line["event"] == "instrument").map(|line| line["what"].clone()).collect()
}

/// Events of a mission as they were told, which are those of the summary; the settings say which kinds there can be.
fn events(mission: &Mission, file: &str, kind: &str) -> Vec<Value> {
    let lines = mission.place.path("events.jsonl");
    let summary = mission.solve(file, "live", &["--events", &lines]);
    let told = told(&std::fs::read_to_string(lines).unwrap());
    let all = summary["calibration"]["events"].as_array().unwrap();
    for event in told.iter().chain(all) {
        assert_eq!(event["event"], kind, "{event}");
    }
    // Those told live were judged by what was known then: sizes of jumps may differ a little.
    let who = |event: &Value| ["pass", "daughter", "channel", "from_s"].map(|name| event[name].clone());
    let told: Vec<_> = told.iter().map(who).collect();
    assert!(!all.is_empty() && all.iter().all(|event| told.contains(&who(event))), "{all:?} of {told:?}");
    all.clone()
}

#[test]
fn jumps_of_clocks_are_told() {
    let mission = Mission::new(&["instrument.clock_ns={step_rms=60.0,step_every_s=1.6e6}"]);
    let events = events(&mission, &mission.file, "clock-jump");
    let found: BTreeMap<(u64, u64), f64> = events
        .iter()
        .map(|event| {
            let number = |name: &str| event[name].as_u64().unwrap();
            ((number("pass"), number("daughter")), event["change_ns"].as_f64().unwrap())
        })
        .collect();
    let mut expected: BTreeMap<(u64, u64), f64> = BTreeMap::new();
    for ((pass, daughter, _), [least, greatest]) in mission.changes(7) {
        assert_eq!(least, greatest, "a jump within a pass");
        expected.insert((pass, daughter.into()), least);
    }
    eprintln!("clocks: {expected:.2?}, found {found:.2?}");
    assert!(expected.len() >= 2, "{expected:?}");
    assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    for (place, change_ns) in expected {
        // Phases are known to a degree or so: at 5 MHz a degree is 0.6 ns.
        assert!((found[&place] - change_ns).abs() < 2.0, "{place:?}: {} for {change_ns}", found[&place]);
    }
}

#[test]
fn steps_of_amplitudes_are_told() {
    let mission = Mission::new(&["instrument.amplitude={step_rms=0.3,step_every_s=3.2e6}"]);
    let events = events(&mission, &mission.file, "gain-step");
    let mut found = BTreeMap::new();
    for event in &events {
        let number = |name: &str| event[name].as_u64().unwrap();
        for channel in event["channels"].as_array().unwrap() {
            let place = (number("pass"), number("daughter") as u32, channel[0].as_u64().unwrap() as usize);
            found.insert(place, channel[1].as_f64().unwrap());
        }
    }
    let expected = mission.changes(5);
    eprintln!("amplitudes: {expected:.3?}, found factors {found:.3?}");
    // Small steps are within what the noise leaves; of one within a pass the solution has some part.
    let large: Vec<&Place> = expected
        .iter()
        .filter(|(_, [least, greatest])| *least > 0.1 || *greatest < -0.1)
        .map(|(place, _)| place)
        .collect();
    assert!(large.len() >= 2, "{expected:?}");
    assert!(large.iter().all(|place| found.contains_key(place)));
    for (place, factor) in found {
        let [least, greatest] = expected.get(&place).unwrap_or_else(|| panic!("{place:?}: nothing changed"));
        // Amplitudes are known to a percent or so.
        let change: f64 = f64::ln(factor);
        assert!(change > least - 0.05 && change < greatest + 0.05, "{place:?}: {change}");
    }
}

#[test]
fn interference_in_a_channel_is_told() {
    let mission = Mission::new(&[]);
    let sets = ["instrument.outlier_probability=0.2", "instrument.outlier_sigma=30.0"];
    let spoilt = mission.place.simulate("spoilt.ccsds", &sets_of(&sets));
    // Packets of the second channel from the data with outliers, all others from those without.
    let [clean, spoilt] = [&mission.file, &spoilt].map(|file| packets_of(&std::fs::read(file).unwrap()));
    assert_eq!(clean.len(), spoilt.len());
    let mixed: Vec<&[u8]> = clean
        .iter()
        .zip(&spoilt)
        .map(|(a, b)| if channel_of(a) == Some(1) { &b[..] } else { &a[..] })
        .collect();
    let mixed = mission.place.file("mixed.ccsds", &mixed.concat());
    let events = events(&mission, &mixed, "interference");
    let found: Vec<(u64, u64)> = events
        .iter()
        .map(|event| (event["pass"].as_u64().unwrap(), event["channel"].as_u64().unwrap()))
        .collect();
    assert_eq!(found, (0..8).map(|pass| (pass, 1)).collect::<Vec<_>>());
    for event in &events {
        // A pass has some 700 visibilities of a channel: 0.2 scatters by 0.015. Outliers within 7 of 30 sigma are 3 % of them.
        let part = event["outliers"].as_f64().unwrap();
        assert!((part - 0.2).abs() < 0.06, "{part}");
    }
}

/// The channel of a packet of visibilities: the first field of its payload.
fn channel_of(packet: &[u8]) -> Option<u16> {
    let header = PacketHeader::parse(packet)?;
    (header.kind == PacketKind::Visibilities).then(|| u16::from_le_bytes([packet[22], packet[23]]))
}

#[test]
fn bursts_are_told() {
    let mission = Mission::new(&[]);
    let sets = ["instrument.burst_every_s=1e4", "instrument.burst_s=200.0", "instrument.burst_k_sr=3e7"];
    let spoilt = mission.place.simulate("spoilt.ccsds", &sets_of(&sets));
    // When: where the visibilities differ from those without bursts.
    let read = |file: &str| {
        let mut reader = DownlinkReader::open(Path::new(file)).unwrap();
        let mut values = BTreeMap::new();
        while let Some(frame) = reader.next_frame().unwrap() {
            if let GroundFrame::Visibilities(block) = frame {
                for k in 0..block.len() {
                    let time_s = block.middle_s(k);
                    let value = block.value_k_sr[k];
                    values.insert((block.channel, block.pair, time_s.to_bits()), (time_s, value));
                }
            }
        }
        values
    };
    let (clean, other) = (read(&mission.file), read(&spoilt));
    let burst_s: Vec<f64> =
        other.iter().filter(|(key, value)| clean[key].1 != value.1).map(|(_, (time_s, _))| *time_s).collect();
    assert!(!burst_s.is_empty());
    let events = events(&mission, &spoilt, "burst");
    let number = |event: &Value, name: &str| event[name].as_f64().unwrap();
    let spans: Vec<[f64; 2]> =
        events.iter().map(|event| [number(event, "from_s"), number(event, "until_s")]).collect();
    eprintln!("bursts: {spans:.0?}");
    // A sixtieth of a pass on either side.
    let bin_s = 60.0;
    for [from_s, until_s] in &spans {
        let within = |time_s: &&f64| (from_s - bin_s..until_s + bin_s).contains(*time_s);
        let there: Vec<&f64> = burst_s.iter().filter(within).collect();
        assert!(!there.is_empty(), "nothing at {from_s} s to {until_s} s");
    }
    let missed = burst_s.iter().filter(|time_s| {
        !spans.iter().any(|[from_s, until_s]| (from_s - bin_s..until_s + bin_s).contains(*time_s))
    });
    assert_eq!(missed.count(), 0, "of {}", burst_s.len());
}
