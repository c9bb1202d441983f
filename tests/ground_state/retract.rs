//! A bad file taken out again.

use serde_json::Value;

use super::common::workplace::json;
use super::{ENGINES, Ground, VISIBILITIES, identity, leave_out, packets};

/// Positions.
const EPHEMERIS: u16 = 0x102;

fn retract(place: &Ground, state: &str, files: &[&str], more: &[&str]) -> Value {
    let state = place.path(state);
    json(&[&["retract"], files, &["--state", &state, "--map", &place.pipeline], more].concat())
}

fn count(report: &Value, key: &str) -> u64 {
    report[key].as_u64().unwrap()
}

/// A packet whose visibilities are thrice as large, and whose check holds.
fn thrice(packet: &[u8]) -> Vec<u8> {
    let mut bad = packet.to_vec();
    let end = bad.len() - 4;
    // Behind headers (22 bytes) and record (16): offsets and durations of four bytes, then real and imaginary parts.
    let visibilities = (end - 38) / 21;
    for value in bad[38 + 8 * visibilities..38 + 16 * visibilities].chunks_exact_mut(4) {
        let value: &mut [u8; 4] = value.try_into().unwrap();
        *value = (3.0 * f32::from_le_bytes(*value)).to_le_bytes();
    }
    let check = crc_fast::crc32_iscsi(&bad[..end]).to_be_bytes();
    bad[end..].copy_from_slice(&check);
    bad
}

/// The visibility packets of these counts, made bad.
fn bad_copies(file: &str, counts: std::ops::Range<u64>) -> Vec<u8> {
    let is_meant =
        |packet: &&Vec<u8>| identity(packet).0 == VISIBILITIES && counts.contains(&identity(packet).1);
    packets(file).iter().filter(is_meant).flat_map(|packet| thrice(packet)).collect()
}

#[test]
fn a_bad_file_goes_and_a_good_copy_takes_its_place() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.downlink();
        let once = place.replay("once", &[&file], &[]);
        let never = place.file("never.ccsds", &leave_out(&file, 21..60));
        let without = place.replay("without", &[&never], &[]);
        let bad = place.file("bad.ccsds", &bad_copies(&file, 21..60));
        let spoilt = place.replay("state", &[&bad, &never], &[]);
        assert_eq!(spoilt["ledger"], once["ledger"]);
        assert!(place.maps("state") != place.maps("once"));

        // The good copies are not what was applied: they stay out, and nothing changes.
        let before = place.bytes("state");
        let refused = retract(&place, "state", &[&file], &["--from-s", "0"]);
        assert_eq!(count(&refused, "refused"), 60 - 21);
        assert_eq!(refused["named"][0]["count"], 21);
        assert!(count(&refused, "packets") > 0);
        place.replay("state", &[&never], &[]);
        assert!(place.head("state") == before[16..16 + place.head("state").len()]);

        let gone = retract(&place, "state", &[&bad], &[]);
        assert_eq!([count(&gone, "packets"), count(&gone, "absent"), count(&gone, "refused")], [39, 0, 0]);
        let accumulated = |summary: &Value| count(&summary["ledger"], "accumulated");
        assert_eq!(count(&gone, "accumulated"), accumulated(&once) - accumulated(&without));
        // As if it had never been there: ledger, gaps, maps.
        let left = place.replay("state", &[], &[]);
        assert_eq!(left["ledger"], without["ledger"]);
        assert_eq!(place.gaps("state"), place.gaps("without"));
        assert!(place.maps("state") == place.maps("without"), "{engine}");
        // Twice is once.
        let again = retract(&place, "state", &[&bad], &[]);
        assert_eq!([count(&again, "packets"), count(&again, "absent")], [0, 39]);
        // And a good copy is as if the bad one had never come.
        let mended = place.replay("state", &[&file], &[]);
        assert_eq!(mended["ledger"], once["ledger"]);
        assert!(place.head("state") == place.head("once"), "{engine}");
        assert!(place.maps("state") == place.maps("once"), "{engine}");
    }
}

#[test]
fn the_last_pass_goes_with_everything_it_brought() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let packets = packets(&place.downlink());
        // From the positions of a late window on.
        let is_start =
            |k: &usize| identity(&packets[*k]).0 == EPHEMERIS && identity(&packets[*k - 1]).0 != EPHEMERIS;
        let cut = (packets.len() * 2 / 3..packets.len()).find(is_start).unwrap();
        let first = place.file("first.ccsds", &packets[..cut].concat());
        let last = place.file("last.ccsds", &packets[cut..].concat());
        let never = place.replay("never", &[&first], &[]);
        place.replay("state", &[&first, &last], &[]);
        let gone = retract(&place, "state", &[&last], &[]);
        assert_eq!(count(&gone, "packets"), (packets.len() - cut) as u64);
        assert!(place.head("state") == place.head("never"), "{engine}");
        let left = place.replay("state", &[], &[]);
        assert_eq!(left["ledger"], never["ledger"]);
        assert!(place.maps("state") == place.maps("never"), "{engine}");
        // With all files gone, a state that has never seen anything.
        retract(&place, "state", &[&first], &[]);
        place.replay("state", &[&first], &[]);
        assert!(place.bytes("state") == place.bytes("never"), "{engine}");
    }
}

#[test]
fn what_waits_goes_and_what_others_need_stays() {
    let place = Ground::new();
    let file = place.downlink();
    let reach = ["--wait-bytes", "10000000"];
    // Of the windows of the second half no positions: their visibilities wait.
    let all = packets(&file);
    let half = all.len() / 2;
    let second = half + all[half..].iter().position(|packet| identity(packet).0 == EPHEMERIS).unwrap();
    let without = |apids: &'static [u16]| {
        let kept =
            all.iter().enumerate().filter(|(k, packet)| *k < second || !apids.contains(&identity(packet).0));
        kept.flat_map(|(_, packet)| packet.clone()).collect::<Vec<u8>>()
    };
    let part = place.file("part.ccsds", &without(&[EPHEMERIS]));
    place.replay("state", &[&part], &reach);
    let tail = place.file("tail.ccsds", &all[second..].concat());
    let gone = retract(&place, "state", &[&tail], &["--from-s", "0"]);
    assert_eq!(count(&gone, "packets"), count(&gone, "waited"));
    assert!(count(&gone, "packets") > 10);
    let never = place.file("never.ccsds", &without(&[EPHEMERIS, VISIBILITIES]));
    place.replay("never", &[&never], &reach);
    assert!(place.bytes("state") == place.bytes("never"));

    // Positions alone: all visibilities were placed by them.
    let is_of = |apid: u16| move |packet: &Vec<u8>| identity(packet).0 == apid;
    let positions: Vec<Vec<u8>> = packets(&file).into_iter().filter(is_of(EPHEMERIS)).collect();
    let positions = place.file("positions.ccsds", &positions.concat());
    place.replay("whole", &[&file], &reach);
    let before = place.bytes("whole");
    let kept = retract(&place, "whole", &[&positions], &[]);
    assert_eq!(count(&kept, "kept"), packets(&positions).len() as u64);
    assert!(count(&kept, "packets") == 0 && place.bytes("whole") == before);

    // A stretch of mission time: the packets of a window.
    let day = ["--from-s", "1e6", "--to-s", "1.5e7"];
    let gone = retract(&place, "whole", &[&file], &day);
    assert!(count(&gone, "packets") > 5 && count(&gone, "waited") == 0);
    let left = place.replay("whole", &[], &[]);
    let lost = count(&left["ledger"]["lost"][0], "count");
    assert_eq!(lost, count(&gone, "visibilities"));
    assert_eq!(left["ledger"]["lost"][0]["reason"], "not received");
    place.replay("whole", &[&file], &[]);
    place.replay("once", &[&file], &reach);
    assert!(place.head("whole") == place.head("once"));
}

#[test]
fn a_file_of_another_mission_takes_nothing_out() {
    let place = Ground::new();
    let file = place.downlink();
    // The same seed, and a channel in common: packets of that are equal.
    let other = place.simulate("other.ccsds", &["--set", "spacecraft.channels_hz=[3e6, 12e6]"]);
    let ours: std::collections::BTreeSet<Vec<u8>> = packets(&file).into_iter().collect();
    let is_common = |packet: &&Vec<u8>| identity(packet).0 == VISIBILITIES && ours.contains(*packet);
    assert!(packets(&other).iter().filter(is_common).count() > 10);
    place.replay("state", &[&file], &[]);
    let before = place.bytes("state");
    let state = place.path("state");
    for files in [&[&other][..], &[&file, &other]] {
        let files: Vec<&str> = files.iter().map(|file| file.as_str()).collect();
        let args = [&["retract"], &files[..], &["--state", &state, "--map", &place.pipeline]].concat();
        let said = super::common::workplace::fail(&args);
        assert!(said.contains("another instrument") && said.contains(&other), "{said}");
        assert!(place.bytes("state") == before);
    }
}

#[test]
fn a_place_without_a_state_is_told() {
    let place = Ground::new();
    let file = place.downlink();
    let state = place.path("nothing");
    let args = ["retract", &file, "--state", &state, "--map", &place.pipeline];
    let said = super::common::workplace::fail(&args);
    assert!(said.contains("no checkpoint") && !std::path::Path::new(&state).exists(), "{said}");
}
