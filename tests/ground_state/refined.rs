//! Visibilities that a state holds one by one, for maps that are refined with their own positions and for maps of pixels without their
//! matrix: whatever the order, the sessions and the kills, the map is that of the packets.

use std::path::{Path, PathBuf};

use super::common::workplace::{fail, json, lunarray, succeed};
use super::{Ground, VISIBILITIES, checkpoints, identity, leave_out, packets};

/// The second file of a segment.
fn copy_of(segment: &Path) -> PathBuf {
    let name = segment.file_name().unwrap().to_str().unwrap().replace(".segment", ".copy.segment");
    segment.with_file_name(name)
}

/// Two passes show all that more would, and an inner solution goes on to where it depends on the sums alone.
pub const REFINED: &str = "[map]\nengine = \"harmonic\"\nresidual_max = 1e-9\nrefine = { passes_max = 2 }";

/// A dozen products show all that more would: they begin at nothing.
const MATRIX_FREE: &str = "[map]\nengine = \"pixel\"\nmatrix = \"free\"\niterations_max = 12";

fn segments(folder: &str) -> Vec<PathBuf> {
    let mut found: Vec<PathBuf> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    found.retain(|path| path.extension().is_some_and(|extension| extension == "segment"));
    found.sort();
    found
}

#[test]
fn any_order_and_any_sessions_make_the_same_refined_map() {
    any_order_and_any_sessions_make_the_same(REFINED);
}

#[test]
fn any_order_and_any_sessions_make_the_same_map_of_rows_made_again() {
    any_order_and_any_sessions_make_the_same(MATRIX_FREE);
}

fn any_order_and_any_sessions_make_the_same(engine: &str) {
    let place = Ground::with(engine);
    let file = place.downlink();
    let reach = ["--wait-bytes", "10000000"];
    let once = place.replay("once", &[&file], &reach);
    // Without a state it is the same, so that a state adds nothing of its own.
    let plain = place.path("plain");
    succeed(&["replay", &file, "--map", &place.pipeline, "--out", &plain]);
    let map = |maps: std::collections::BTreeMap<PathBuf, Vec<u8>>| -> Vec<Vec<u8>> {
        maps.into_iter().filter(|(path, _)| path.ends_with("map.fits")).map(|(_, bytes)| bytes).collect()
    };
    assert!(map(super::common::workplace::maps(&plain)) == place.maps("once"));
    // Backwards, in three sessions with checkpoints on the way.
    let all = packets(&file);
    let (head, rest): (Vec<_>, Vec<_>) =
        all.into_iter().partition(|packet| identity(packet).0 != VISIBILITIES);
    let head = place.file("head.ccsds", &head.concat());
    let mut parts: Vec<Vec<u8>> = rest;
    parts.reverse();
    let size = parts.len().div_ceil(3);
    for (k, part) in parts.chunks(size).enumerate() {
        let part = place.file(&format!("part-{k}.ccsds"), &part.concat());
        place.replay("thrice", &[&head, &part], &["--checkpoint-every", "500"]);
    }
    let last = place.replay("thrice", &[], &[]);
    assert_eq!(last["ledger"]["accumulated"], once["ledger"]["accumulated"]);
    assert!(place.maps("thrice") == place.maps("once"));
    // Each of the two checkpoints that are kept has its segments, and nothing else is left: without both files of any of them one
    // checkpoint does not hold.
    let state = place.path("thrice");
    assert!(!segments(&state).is_empty() && checkpoints(state.as_ref()).len() == 2);
    for segment in segments(&state) {
        if segment.to_str().unwrap().ends_with(".copy.segment") {
            continue;
        }
        let bytes = std::fs::read(&segment).unwrap();
        assert_eq!(std::fs::read(copy_of(&segment)).unwrap(), bytes);
        std::fs::remove_file(&segment).unwrap();
        std::fs::remove_file(copy_of(&segment)).unwrap();
        let broken = |checkpoint: &PathBuf| {
            let alone = tempfile::tempdir().unwrap();
            for file in segments(&state).iter().chain([checkpoint]) {
                std::fs::copy(file, alone.path().join(file.file_name().unwrap())).unwrap();
            }
            let [out, alone] = [place.path("alone"), alone.path().to_str().unwrap().to_owned()];
            !lunarray(&["replay", "--map", &place.pipeline, "--out", &out, "--state", &alone])
                .status
                .success()
        };
        assert!(checkpoints(state.as_ref()).iter().any(broken), "{}", segment.display());
        std::fs::write(copy_of(&segment), &bytes).unwrap();
        std::fs::write(&segment, bytes).unwrap();
    }
    // States of different stations, put together in either order.
    for station in 0..2 {
        let hears = |packet: &Vec<u8>| {
            let (apid, count) = identity(packet);
            apid != VISIBILITIES || (count.wrapping_mul(2_654_435_761) >> 7) % 2 == station
        };
        let heard: Vec<Vec<u8>> = packets(&file).into_iter().filter(hears).collect();
        let heard = place.file(&format!("{station}.ccsds"), &heard.concat());
        place.replay(&format!("{station}"), &[&heard], &reach);
    }
    for (out, order) in [("ab", ["0", "1"]), ("ba", ["1", "0"])] {
        let [first, second] = order.map(|state| place.path(state));
        succeed(&["merge", &first, &second, "--map", &place.pipeline, "--out", &place.path(out)]);
        place.replay(out, &[], &[]);
        assert!(place.maps(out) == place.maps("once"), "{out}");
    }
    // More than may be held is refused when states are put together.
    let [first, second] = ["0", "1"].map(|state| place.path(state));
    let few = "map.refine.visibilities_max=100";
    let merge =
        ["merge", &first, &second, "--map", &place.pipeline, "--out", &place.path("few"), "--set", few];
    let said = fail(&merge);
    assert!(said.contains("map.refine.visibilities_max = 100"), "{said}");
}

#[test]
fn what_is_retracted_leaves_no_trace_in_a_refined_map() {
    what_is_retracted_leaves_no_trace(REFINED);
}

#[test]
fn what_is_retracted_leaves_no_trace_in_a_map_of_rows_made_again() {
    what_is_retracted_leaves_no_trace(MATRIX_FREE);
}

fn what_is_retracted_leaves_no_trace(engine: &str) {
    let place = Ground::with(engine);
    let file = place.downlink();
    place.replay("once", &[&file], &[]);
    let never = place.file("never.ccsds", &leave_out(&file, 21..60));
    place.replay("without", &[&never], &[]);
    place.replay("state", &[&file], &[]);
    let meant =
        |packet: &Vec<u8>| identity(packet).0 == VISIBILITIES && (21..60).contains(&identity(packet).1);
    let some: Vec<Vec<u8>> = packets(&file).into_iter().filter(meant).collect();
    let some = place.file("some.ccsds", &some.concat());
    let gone = json(&["retract", &some, "--state", &place.path("state"), "--map", &place.pipeline]);
    assert_eq!([&gone["packets"], &gone["refused"]], [39, 0]);
    place.replay("state", &[], &[]);
    assert!(place.maps("state") == place.maps("without"));
    place.replay("state", &[&file], &[]);
    assert!(place.maps("state") == place.maps("once"));
}

#[test]
fn more_than_may_be_held_is_left_out_and_counted() {
    more_than_may_be_held_is_left_out(REFINED);
}

#[test]
fn more_rows_than_may_be_held_are_left_out_and_counted() {
    more_than_may_be_held_is_left_out(MATRIX_FREE);
}

fn more_than_may_be_held_is_left_out(engine: &str) {
    let place = Ground::with(engine);
    let file = place.downlink();
    let few = ["--set", "map.refine.visibilities_max=200"];
    let summary = place.replay("state", &[&file], &few);
    let whole = place.replay("whole", &[&file], &[]);
    let of = |summary: &serde_json::Value| summary["ledger"]["accumulated"].as_u64().unwrap();
    // So many of each channel.
    let channels = whole["channels"].as_array().unwrap().len() as u64;
    assert!(of(&whole) > 200 * channels);
    assert_eq!(of(&summary), 200 * channels, "{}", summary["ledger"]);
    let left_out = summary["ledger"].to_string();
    assert!(left_out.contains("full") || left_out.contains("room"), "{left_out}");
}

#[test]
fn a_damaged_segment_is_told_and_the_checkpoint_before_serves() {
    let place = Ground::with(REFINED);
    let file = place.downlink();
    let half: Vec<Vec<u8>> = packets(&file);
    let half = place.file("half.ccsds", &half[..half.len() / 2].concat());
    place.replay("state", &[&half], &[]);
    place.replay("state", &[&file], &[]);
    let folder = place.path("state");
    let newest = segments(&folder).pop().unwrap();
    let good = std::fs::read(&newest).unwrap();
    let mut bad = good.clone();
    bad[40] ^= 1;
    // One bit of any one file loses nothing.
    for segment in segments(&folder) {
        let whole = std::fs::read(&segment).unwrap();
        let mut flipped = whole.clone();
        flipped[100] ^= 1;
        std::fs::write(&segment, flipped).unwrap();
        let survey = json(&["gaps", &folder]);
        assert_eq!(survey["gaps"].as_array().unwrap().len(), 0);
        let alone = tempfile::tempdir().unwrap();
        for file in segments(&folder).into_iter().chain(checkpoints(Path::new(&folder))) {
            std::fs::copy(&file, alone.path().join(file.file_name().unwrap())).unwrap();
        }
        let [out, alone] = [place.path("alone"), alone.path().to_str().unwrap().to_owned()];
        let output = lunarray(&["replay", "--map", &place.pipeline, "--out", &out, "--state", &alone]);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success() && !said.contains("segment"), "{said}");
        std::fs::write(&segment, whole).unwrap();
    }
    // Of both it loses a checkpoint.
    let newest = PathBuf::from(newest.to_str().unwrap().replace(".copy.segment", ".segment"));
    std::fs::write(copy_of(&newest), &bad).unwrap();
    std::fs::write(&newest, &bad).unwrap();
    // The one before lacks the second half, which comes again.
    let before = checkpoints(Path::new(&folder)).len();
    assert_eq!(before, 2);
    let output = place.output("state", &[&file], &[]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("segment"), "{said}");
    place.replay("once", &[&file], &[]);
    assert!(place.maps("state") == place.maps("once"));
    // Without it, nothing is taken for what it is not.
    for path in segments(&folder) {
        std::fs::remove_file(path).unwrap();
    }
    let output = place.output("state", &[&file], &[]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && said.contains("no such file"), "{said}");
}
