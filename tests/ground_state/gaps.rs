//! What is missing, and a state that is refused.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use lunarray::calibration::{CalibrationConfig, Calibrator};
use lunarray::downlink::{Decoder, Event, PacketReceiver};
use lunarray::frames::{GroundFrame, PlacedFrame};
use lunarray::imaging::MapConfig;
use lunarray::runtime::{Ledger, Outlet, Stage};
use lunarray::units::Pair;
use serde_json::Value;

use super::common::workplace::{SMALL, Workplace, json, lunarray, succeed};
use super::{Ground, VISIBILITIES, identity, leave_out, packets};

/// Identifier of packets of positions.
const POSITIONS: u16 = 0x102;

/// What a map of nside 4 takes of a packet of visibilities.
#[derive(Clone, Copy, Default)]
struct Worth {
    channel: u16,
    pair: Pair,
    visibilities: u64,
    weight: f64,
}

/// What every packet of visibilities in a sound file is worth: what can be placed on baselines within the map's limit.
fn worth(file: &str) -> BTreeMap<u64, Worth> {
    let map = MapConfig { nside: 4, ..MapConfig::default() };
    let hook = CalibrationConfig::default().build(Path::new("")).unwrap();
    let mut calibrator = Calibrator::new(hook, Ledger::new());
    let (mut receiver, mut decoder) = (PacketReceiver::new(), Decoder::new());
    receiver.push(&std::fs::read(file).unwrap());
    receiver.finish();
    let mut found = BTreeMap::new();
    while let Some(event) = receiver.next_event() {
        let Event::Packet(packet) = event else { continue };
        let Some(frame) = decoder.accept(&event) else { continue };
        let mut worth = match &frame {
            GroundFrame::Visibilities(block) => {
                Worth { channel: block.channel.0, pair: block.pair, ..Worth::default() }
            }
            _ => Worth::default(),
        };
        let mut placed = Outlet::collect();
        calibrator.step(frame, &mut placed).unwrap();
        for frame in placed.items() {
            let PlacedFrame::Visibilities(placed) = frame else { continue };
            for (k, (a, b)) in placed.r_i_m.iter().zip(&placed.r_j_m).enumerate() {
                let length_m = (0..3).map(|x| (a[x] - b[x]).powi(2)).sum::<f64>().sqrt();
                if length_m <= map.baseline_m_max(placed.frequency_hz) {
                    worth.visibilities += 1;
                    worth.weight += placed.weight[k];
                }
            }
        }
        if packet.header.kind.apid() == VISIBILITIES {
            found.insert(packet.header.count, worth);
        }
    }
    found
}

/// A pipeline in which the formation, which breathes in fourteen days, changes little from pass to pass.
fn half_a_day_from_pass_to_pass() -> String {
    SMALL
        .replace("every_nth_window = 300", "every_nth_window = 5\nduration_s = 1.2e6")
        .replace("packet_bytes_max = 2048", "packet_bytes_max = 1024")
        .replace("every_nth_integration = 2", "")
        .replace("baseline_wavelengths_max = 16.0", "")
        .replace("[3.0e6, 10.0e6]", "[1.0e6, 3.0e6]")
        .replace("[spacecraft]", "[array]\nsatellites = 4\n[array.breathing]\nspan_m_max = 5e3\n[spacecraft]")
}

#[test]
fn gaps_stand_in_the_order_of_what_their_recovery_adds() {
    let place = Ground(Workplace::new(&half_a_day_from_pass_to_pass()));
    let file = place.downlink();
    let (worth, all) = (worth(&file), packets(&file));
    // Each pass ends with the spacecraft's own counts.
    let mut passes: Vec<&[Vec<u8>]> = all.split_inclusive(|packet| identity(packet).0 == 0x105).collect();
    // And begins with them.
    passes.retain(|packets| packets.iter().any(|packet| identity(packet).0 == VISIBILITIES));
    let counts = |pass: usize, apid: u16| {
        let of_kind = passes[pass].iter().filter(|packet| identity(packet).0 == apid);
        let counts: Vec<u64> = of_kind.map(|packet| identity(packet).1).collect();
        counts[0]..counts[counts.len() - 1] + 1
    };
    // A pass; in another its positions; a fifth of a third; and single packets, of which the map takes something, or
    // nothing for all that they weigh.
    let (first, third) = (counts(2, VISIBILITIES), counts(9, VISIBILITIES));
    // Single packets are told apart where those on either side are of the same channel and pair.
    let stream = |count: u64| (worth[&count].channel, worth[&count].pair);
    let is_within = |count: &u64| stream(count - 1) == stream(*count) && stream(count + 1) == stream(*count);
    let single = |passes: Range<usize>, is_useful: bool| {
        let mut counts = passes.flat_map(|pass| counts(pass, VISIBILITIES)).filter(is_within);
        counts.find(|count| (worth[count].weight > 0.0) == is_useful).unwrap()
    };
    let (useful, useless) = (single(12..18, true), single(20..26, false));
    let lost: [(u16, Range<u64>); 5] = [
        (POSITIONS, counts(6, POSITIONS)),
        (VISIBILITIES, first),
        (VISIBILITIES, third.start..third.start + (third.end - third.start) / 5),
        (VISIBILITIES, useful..useful + 1),
        (VISIBILITIES, useless..useless + 1),
    ];
    let is_in = |packet: &&Vec<u8>, gap: &(u16, Range<u64>)| {
        let (apid, count) = identity(packet);
        apid == gap.0 && gap.1.contains(&count)
    };
    let kept: Vec<u8> =
        all.iter().filter(|packet| !lost.iter().any(|gap| is_in(packet, gap))).flatten().copied().collect();
    let reach = ["--wait-bytes", "10000000"];
    let state = place.replay("state", &[&place.file("kept", &kept)], &reach);
    let found = place.gaps("state");
    let told: Vec<(u64, u64, f64)> = (found["gaps"].as_array().unwrap().iter())
        .map(|gap| {
            (gap["apid"].as_u64().unwrap(), gap["from"].as_u64().unwrap(), gap["gain"].as_f64().unwrap())
        })
        .collect();

    // What is in the map, and what the recovery of each gap brings.
    let without: Vec<u64> =
        lost[1..].iter().flat_map(|(_, gap)| gap.clone()).chain(counts(6, VISIBILITIES)).collect();
    let mut in_map: BTreeMap<u16, f64> = BTreeMap::new();
    for (count, worth) in &worth {
        *in_map.entry(worth.channel).or_default() += if without.contains(count) { 0.0 } else { worth.weight };
    }
    let mut expected: Vec<(u64, u64, f64)> = Vec::new();
    for (k, gap) in lost.iter().enumerate() {
        let brought: Vec<u64> =
            if gap.0 == POSITIONS { counts(6, VISIBILITIES).collect() } else { gap.1.clone().collect() };
        // Held to what a replay of the gap alone adds.
        let name = format!("copy {k}");
        std::fs::create_dir(place.path(&name)).unwrap();
        let newest = place.newest("state");
        std::fs::copy(&newest, Path::new(&place.path(&name)).join(newest.file_name().unwrap())).unwrap();
        let packets: Vec<u8> = all.iter().filter(|packet| is_in(packet, gap)).flatten().copied().collect();
        let more = place.replay(&name, &[&place.file("more", &packets)], &reach);
        let accumulated = |told: &Value| told["ledger"]["accumulated"].as_u64().unwrap();
        let visibilities: u64 = brought.iter().map(|count| worth[count].visibilities).sum();
        assert_eq!(accumulated(&more) - accumulated(&state), visibilities, "{gap:?}");
        let gain: f64 = brought.iter().map(|count| worth[count].weight / in_map[&worth[count].channel]).sum();
        // In the mean over two channels.
        let gain = gain / 2.0;
        expected.push((u64::from(gap.0), gap.1.start, gain));
    }
    expected.sort_by(|a, b| b.2.total_cmp(&a.2));
    assert_eq!(told.len(), expected.len());
    let [most, least] = [expected[0].2, expected[4].2];
    assert!(most > 0.01 && least == 0.0);
    for (told, expected) in told.iter().zip(&expected) {
        assert_eq!((told.0, told.1), (expected.0, expected.1));
        // Estimated from passes half a day away, in which the formation breathes by a few percent; a single packet may be
        // near the end of a pass, where integrations are shorter.
        assert!((told.2 - expected.2).abs() < 0.1 * expected.2 + 0.03 * most, "{told:?} {expected:?}");
    }
    // The instrument's channels are named; -0 is 0.
    assert_eq!(found["channels"][1]["frequency_hz"], 3.0e6);
    assert!(!succeed(&["gaps", &place.path("state")]).contains("-0.0"));
}

#[test]
fn a_channel_of_which_nothing_came_is_named() {
    let place = Ground::new();
    let file = place.downlink();
    let of_first = |packet: &&Vec<u8>| {
        // A record begins with the channel's number.
        identity(packet).0 != VISIBILITIES || packet[lunarray::downlink::HEADER_BYTES] == 0
    };
    let all = packets(&file);
    let kept: Vec<u8> = all.iter().filter(of_first).flatten().copied().collect();
    assert!(kept.len() < all.concat().len());
    let table = succeed(&["gaps", &place.file("first", &kept)]);
    assert!(table.contains("3.0000") && table.contains("10.0000"), "{table}");
}

fn total(gaps: &Value, key: &str) -> f64 {
    gaps["channels"].as_array().unwrap().iter().map(|channel| channel[key].as_f64().unwrap()).sum()
}

#[test]
fn gaps_are_told_in_packets_and_in_integration_time() {
    let place = Ground::new();
    let file = place.downlink();
    assert_eq!(json(&["gaps", &file])["gaps"].as_array().unwrap().len(), 0);
    let bad = place.path("bad.ccsds");
    std::fs::write(&bad, leave_out(&file, 21..40)).unwrap();
    let found = json(&["gaps", &bad]);
    assert_eq!(found["gaps"].as_array().unwrap().len(), 1);
    let gap = &found["gaps"][0];
    assert_eq!([&gap["apid"], &gap["from"], &gap["to"]], [0x103, 21, 39]);
    // What is received and what is missing are together what was sent, as well as passes resemble each other: the
    // formation breathes, and with it the number of integrations short enough for a baseline.
    let sent = total(&json(&["gaps", &file]), "integration_s");
    let (received, missing) = (total(&found, "integration_s"), total(&found, "missing_integration_s"));
    let lost = sent - received;
    assert!(lost > 0.1 * sent && (missing / lost - 1.0).abs() < 0.3, "{missing} s told, {lost} s lost");

    // A state tells the same packets, and nothing once they have come. Of their weight it counts what its map takes.
    place.replay("state", &[&bad], &[]);
    let told = place.gaps("state");
    for key in ["apid", "from", "to", "between_s", "integration_s"] {
        assert_eq!(told["gaps"][0][key], gap[key]);
    }
    for key in ["integration_s", "missing_integration_s"] {
        assert_eq!(total(&told, key), total(&found, key));
    }
    assert!(total(&told, "weight") < total(&found, "weight"));
    let picture = place.path("coverage.png");
    let table = succeed(&["gaps", &place.path("state"), "--picture", &picture]);
    assert!(table.contains("0x103"), "{table}");
    assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    let whole = place.replay("state", &[&file], &[]);
    assert_eq!(place.gaps("state")["gaps"].as_array().unwrap().len(), 0);
    let once = place.replay("once", &[&file], &[]);
    assert_eq!(whole["ledger"], once["ledger"]);
}

#[test]
fn visibilities_without_positions_are_told_as_lost() {
    let place = Ground::new();
    let file = place.downlink();
    let all = packets(&file);
    let positions: Vec<u64> = all
        .iter()
        .map(|packet| identity(packet))
        .filter(|(apid, _)| *apid == POSITIONS)
        .map(|(_, count)| count)
        .collect();
    let middle = positions[positions.len() / 3]..positions[2 * positions.len() / 3];
    let is_kept = |packet: &&Vec<u8>| {
        let (apid, count) = identity(packet);
        apid != POSITIONS || !middle.contains(&count)
    };
    let kept: Vec<u8> = all.iter().filter(is_kept).flatten().copied().collect();
    let lacking = place.file("lacking.ccsds", &kept);
    let (whole, found) = (json(&["gaps", &file]), json(&["gaps", &lacking]));
    // All visibilities have come.
    assert_eq!(total(&found, "integration_s"), total(&whole, "integration_s"));
    assert_eq!(total(&found, "missing_weight"), 0.0);
    // The weights of the same file with positions are those that lack without.
    let [before, after, waiting] =
        [total(&whole, "weight"), total(&found, "weight"), total(&found, "waiting_weight")];
    // They are sums of equal numbers in another order.
    assert!(before - after > 0.1 * before && ((before - after) / waiting - 1.0).abs() < 1e-9);
    assert!(total(&found, "waiting_integration_s") > 0.1 * total(&found, "integration_s"));
    let table = succeed(&["gaps", &lacking]);
    for (of_whole, of_found) in
        whole["channels"].as_array().unwrap().iter().zip(found["channels"].as_array().unwrap())
    {
        let [before, after] = [of_whole, of_found].map(|channel| channel["weight"].as_f64().unwrap());
        let percent = format!("{:.3} %", 100.0 * (1.0 - after / before));
        assert!(table.contains(&percent), "{percent}: {table}");
    }
}

#[test]
fn positions_lost_at_an_end_are_told_by_every_command() {
    let place = Ground::new();
    let file = place.downlink();
    assert!(succeed(&["inspect", &file]).contains("\nsound:"));
    let all = packets(&file);
    let is_position = |packet: &&Vec<u8>| identity(packet).0 == POSITIONS;
    let positions = all.iter().filter(is_position).count();
    for (name, lost) in [("first", 0..2), ("last", positions - 2..positions), ("all", 0..positions)] {
        let mut number = 0..;
        let kept: Vec<u8> = (all.iter())
            .filter(|packet| !is_position(packet) || !lost.contains(&number.next().unwrap()))
            .flatten()
            .copied()
            .collect();
        let lacking = place.file(name, &kept);
        let table = succeed(&["gaps", &lacking]);
        assert_eq!(table.contains("none has come"), name != "first", "{table}");
        for limit in ["any", "0", "1"] {
            assert_eq!(
                lunarray(&["gaps", &lacking, "--fail-if", limit]).status.code(),
                Some(1),
                "{name} {limit}"
            );
        }
        let told = succeed(&["inspect", &lacking]);
        assert!(told.contains("not sound: ") && !told.contains("\nsound:"), "{name}: {told}");
    }
}

#[test]
fn a_state_of_other_settings_is_refused() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("state", &[&file], &[]);
    // What is made of the sums may change: no file is needed.
    place.replay("state", &[], &["--set", "map.epsilon=1e-3"]);
    let output = place.output("state", &[&file], &["--set", "map.nside=8"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success());
    assert!(said.contains("map.nside = 4") && said.contains("expected 8"), "{said}");
}

#[test]
fn what_is_missing_is_cut_out_and_fails_a_script_until_it_has_come() {
    let place = Ground::new();
    let file = place.downlink();
    let lacking = place.file("lacking.ccsds", &leave_out(&file, 5..9));
    place.replay("state", &[&lacking], &[]);
    let state = place.path("state");
    assert!(lunarray(&["gaps", &state, "--fail-if", "99"]).status.success());
    assert_eq!(lunarray(&["gaps", &state, "--fail-if", "0"]).status.code(), Some(1));
    let output = lunarray(&["gaps", &state, "--fail-if", "any"]);
    assert_eq!(output.status.code(), Some(1));
    // The list is printed all the same.
    assert!(String::from_utf8(output.stdout).unwrap().contains("0x103"));
    let found = place.gaps("state");
    let ranges: Vec<String> = found["gaps"]
        .as_array()
        .unwrap()
        .iter()
        .map(|gap| format!("{} {} {}\n", gap["apid"], gap["from"], gap["to"]))
        .collect();
    let ranges = place.file("ranges", ranges.concat().as_bytes());
    let again = place.path("again.ccsds");
    // From a coded downlink, too.
    let coded = place.simulate("small.cadu", &["--format", "cadu"]);
    let said = json(&["extract", &coded, "--ranges", &ranges, "--out", &again]);
    assert_eq!([&said["packets"], &said["missing"]], [4, 0]);
    let cut: Vec<Vec<u8>> = packets(&again);
    let meant = |packet: &&Vec<u8>| identity(packet).0 == 0x103 && (5..9).contains(&identity(packet).1);
    assert!(cut.iter().eq(packets(&file).iter().filter(meant)));
    place.replay("state", &[&again], &[]);
    assert!(lunarray(&["gaps", &state, "--fail-if", "any"]).status.success());
    place.replay("once", &[&file], &[]);
    assert!(place.bytes("state") == place.bytes("once"));
}

#[test]
fn a_gap_over_windows_holds_the_rest_of_one_and_others_like_those_near_it() {
    // Windows four weeks apart, in which the formation has breathed: channels and pairs come and go.
    let place = Ground::new();
    let file = place.downlink();
    let all = worth(&file);
    // The last packet of the second window and the three of the third.
    let lacking = place.file("lacking", &leave_out(&file, 5..9));
    place.replay("state", &[&lacking], &[]);
    let found = place.gaps("state");
    let gap = &found["gaps"][0];
    assert_eq!([&gap["from"], &gap["to"]], [5, 8]);
    let told: Vec<(u64, u64)> = (gap["lost"].as_array().unwrap().iter())
        .map(|lost| (lost["channel"].as_u64().unwrap(), lost["packets"].as_u64().unwrap()))
        .collect();
    let true_packets = (5..9).filter(|count| all[count].channel == 0).count() as u64;
    assert!(told.iter().all(|(channel, _)| *channel == 0), "{told:?}");
    assert_eq!((told.iter().map(|(_, packets)| packets).sum::<u64>(), true_packets), (4, 4));
    let sum = |counts: &mut dyn Iterator<Item = &u64>| counts.map(|count| all[count].weight).sum::<f64>();
    let received = sum(&mut all.keys().filter(|count| all[*count].channel == 0 && !(5..9).contains(*count)));
    let truth = sum(&mut all.keys().filter(|count| (5..9).contains(*count))) / received / 2.0;
    let gain = gap["gain"].as_f64().unwrap();
    // Four weeks on, baselines differ by a third.
    assert!(truth > 0.0 && (gain / truth - 1.0).abs() < 0.5, "{gain} told, {truth} true");
}

#[test]
fn packed_downlinks_are_read_by_every_command() {
    let place = Ground::new();
    let file = place.downlink();
    let bytes = std::fs::read(&file).unwrap();
    let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    std::io::Write::write_all(&mut gzip, &bytes).unwrap();
    let zstd = ruzstd::encoding::compress_to_vec(&bytes[..], ruzstd::encoding::CompressionLevel::Fastest);
    // Their names do not matter.
    let packed = [place.file("gzip", &gzip.finish().unwrap()), place.file("zstd.ccsds", &zstd)];
    let plain = place.replay("plain", &[&file], &[]);
    let ranges = place.file("ranges", b"0x103 5 8\n");
    let told = |file: &str| {
        let mut told = json(&["inspect", file]);
        told["file"] = Value::Null;
        told
    };
    for (file, state) in packed.iter().zip(["a", "b"]) {
        assert_eq!(place.replay(state, &[file], &[])["ledger"], plain["ledger"]);
        assert!(place.bytes(state) == place.bytes("plain"));
        assert_eq!(json(&["gaps", file])["gaps"], Value::Array(Vec::new()));
        assert_eq!(told(file), told(&place.path("small.ccsds")));
        let again = place.path("again");
        assert_eq!(json(&["extract", file, "--ranges", &ranges, "--out", &again])["packets"], 4);
    }
    // What is damaged is said, and is damaged data.
    let cut = std::fs::read(&packed[0]).unwrap();
    let cut = place.file("cut", &cut[..cut.len() / 2]);
    let output = lunarray(&["inspect", &cut]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(said.contains("the gzip file is damaged after") && said.contains("it ends early"), "{said}");
}
