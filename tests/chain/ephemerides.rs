//! Odd ephemeris packets of a downlink: what the ground makes of them, engine by engine.

use crate::common;

use std::collections::BTreeMap;
use std::path::Path;

use common::downlink::transmit;
use common::workplace::{Workplace, json, succeed};
use lunarray::downlink::{DownlinkConfig, DownlinkReader};
use lunarray::frames::{EphemerisSegment, GroundFrame};
use lunarray::units::vector::scale;
use serde_json::Value;

const SMALL: &str = r#"
name = "odd"
[sky]
nside = 8
[array]
satellites = 4
[spacecraft]
channels_hz = [3.0e6]
duration_s = 2e5
every_nth_window = 6
every_nth_integration = 2
flag_earth = false
baseline_wavelengths_max = 16.0
[map]
engine = 'pixel'
nside = 4
baseline_bp_max = 4.5
epsilon = 1e-4
[products]
pictures = false
"#;

const ENGINES: [(&str, &[&str]); 3] = [
    ("pixel", &["map.engine=pixel"]),
    ("harmonic", &["map.engine=harmonic"]),
    ("refined", &["map.engine=harmonic", "map.refine.passes_max=2"]),
];

struct Mission {
    place: Workplace,
    frames: Vec<GroundFrame>,
}

impl Mission {
    fn new() -> Self {
        let place = Workplace::new(SMALL);
        let path = place.path("sent.ccsds");
        succeed(&["simulate", &place.pipeline, "--out", &path]);
        let mut reader = DownlinkReader::open(Path::new(&path)).unwrap();
        let mut frames = Vec::new();
        while let Some(frame) = reader.next_frame().unwrap() {
            frames.push(frame);
        }
        Self { place, frames }
    }

    /// Visibilities from the start of a pass, by pair of satellites, until the next one.
    fn of_pass(&self, pass: usize) -> BTreeMap<(u8, u8), u64> {
        let mut counts = BTreeMap::new();
        let starts = self.frames.iter().scan(0, |seen, frame| {
            *seen += usize::from(matches!(frame, GroundFrame::Ephemeris(_)));
            Some((*seen, frame))
        });
        for (seen, frame) in starts {
            if let (true, GroundFrame::Visibilities(block)) = (seen == pass + 1, frame) {
                *counts.entry((block.pair.i, block.pair.j)).or_default() += block.len() as u64;
            }
        }
        counts
    }

    /// The frames with the ephemeris of one pass replaced by others.
    fn with(
        &self,
        pass: usize,
        change: impl Fn(&EphemerisSegment) -> Vec<EphemerisSegment>,
    ) -> Vec<GroundFrame> {
        let mut seen = 0;
        let mut out = Vec::new();
        for frame in &self.frames {
            match frame {
                GroundFrame::Ephemeris(segment) => {
                    let others = if seen == pass { change(segment) } else { vec![segment.clone()] };
                    seen += 1;
                    out.extend(others.into_iter().map(GroundFrame::Ephemeris));
                }
                other => out.push(other.clone()),
            }
        }
        out
    }

    /// Maps of a downlink by an engine: how many visibilities are in them, and how many were flagged, by reason.
    fn mapped(&self, name: &str, frames: &[GroundFrame], engine: &[&str]) -> (u64, BTreeMap<String, u64>) {
        let file = self.place.path(&format!("{name}.ccsds"));
        std::fs::write(&file, transmit(frames, &DownlinkConfig::default())).unwrap();
        let out = self.place.path(name);
        let mut args = vec!["replay", &file, "--map", &self.place.pipeline, "--out", &out];
        engine.iter().for_each(|set| args.extend(["--set", set]));
        succeed(&args);
        let text = std::fs::read_to_string(Path::new(&out).join("summary.json")).unwrap();
        let summary: Value = serde_json::from_str(&text).unwrap();
        let ledger = &summary["ledger"];
        let flagged = ledger["flagged"].as_object().unwrap();
        let flagged = flagged.iter().map(|(reason, count)| (reason.clone(), count.as_u64().unwrap()));
        (ledger["accumulated"].as_u64().unwrap(), flagged.collect())
    }
}

#[test]
fn odd_segments_leave_out_what_they_spoil_and_count_it() {
    let mission = Mission::new();
    let all: u64 = (0..8).flat_map(|pass| mission.of_pass(pass).into_values()).sum();
    let spoilt = mission.of_pass(1);
    let of_pass: u64 = spoilt.values().sum();
    let of_first: u64 = spoilt.iter().filter(|((i, _), _)| *i == 0).map(|(_, count)| count).sum();
    let of_two = spoilt[&(1, 2)];
    assert!(of_pass > 100 && of_first > 10 && of_two > 0 && all > 2 * of_pass, "{all} {spoilt:?}");
    // Of all nodes, positions of one satellite changed.
    let moved = |satellite: usize, change: fn(&[[f64; 3]]) -> [f64; 3]| {
        mission.with(1, move |segment| {
            let mut segment = segment.clone();
            for places in segment.positions_m.chunks_exact_mut(4) {
                places[satellite] = change(places);
            }
            vec![segment]
        })
    };
    let later = |segment: &EphemerisSegment, nodes: usize| EphemerisSegment {
        start: segment.start.plus_ticks(nodes as i64 * i64::from(segment.step_ticks)),
        positions_m: segment.positions_m[4 * nodes..].to_vec(),
        ..segment.clone()
    };
    let gap = mission.with(1, |_| Vec::new());
    let below = mission.with(1, |segment| {
        let mut low = segment.clone();
        low.positions_m.iter_mut().for_each(|r_m| *r_m = scale(0.8, *r_m));
        vec![low]
    });
    let one_place = moved(2, |places| places[1]);
    let escaping = moved(0, |places| scale(50.0, places[0]));
    // The second half again, beginning elsewhere; the second half first, then all; another one that begins at the same time.
    let overlap = mission.with(1, |segment| vec![segment.clone(), later(segment, 20)]);
    let back = mission.with(1, |segment| vec![later(segment, 20), segment.clone()]);
    let contradictory = mission.with(1, |segment| {
        let mut other = segment.clone();
        other.positions_m.iter_mut().for_each(|r_m| *r_m = scale(0.8, *r_m));
        vec![segment.clone(), other]
    });
    for (engine, set) in ENGINES {
        let whole = mission.mapped(&format!("{engine}-whole"), &mission.frames, set);
        assert!(whole.0 > all / 2, "{engine}: {whole:?}");
        for (name, frames, reason, most) in [
            ("gap", &gap, "no ephemeris", of_pass),
            ("below", &below, "refused by the engine: off the orbit's altitude", of_pass),
            ("one-place", &one_place, "refused by the engine: the baseline has no direction", of_two),
        ] {
            let found = mission.mapped(&format!("{engine}-{name}"), frames, set);
            let more = found.1.get(reason).copied().unwrap_or(0) - whole.1.get(reason).copied().unwrap_or(0);
            // All of those that the map would have had; those beyond its baselines may be counted as such.
            assert!(more > 0 && more <= most, "{engine} {name}: {found:?} {most}");
            assert!(found.0 < whole.0, "{engine} {name}");
            let sum =
                |(mapped, flagged): &(u64, BTreeMap<String, u64>)| mapped + flagged.values().sum::<u64>();
            assert_eq!(sum(&found), sum(&whole), "{engine} {name}");
        }
        // Baselines beyond all limits.
        let found = mission.mapped(&format!("{engine}-escaping"), &escaping, set);
        assert_eq!(
            found.1["baseline beyond the map's limit"],
            whole.1.get("baseline beyond the map's limit").unwrap_or(&0) + of_first
        );
        for (name, frames) in [("overlap", &overlap), ("back", &back), ("contradictory", &contradictory)] {
            let found = mission.mapped(&format!("{engine}-{name}"), frames, set);
            assert_eq!(found, whole, "{engine} {name}");
        }
    }
    let inspected = |name: &str| json(&["inspect", &mission.place.path(&format!("pixel-{name}.ccsds"))]);
    let summary = inspected("whole");
    let error_m = summary["ephemeris"]["interpolation_error_m_max"].as_f64().unwrap();
    assert!(error_m > 0.0 && error_m < 0.01, "{error_m}");
    assert_eq!(summary["ephemeris"]["contradictory"], 0);
    assert_eq!(inspected("contradictory")["ephemeris"]["contradictory"], 1);
    let said = succeed(&["inspect", &mission.place.path("pixel-contradictory.ccsds")]);
    assert!(
        said.contains("positions between nodes within ") && said.contains("1 segment contradicts"),
        "{said}"
    );
}
