//! States put together.

use super::common::workplace::{fail, succeed};
use super::{ENGINES, Ground, VISIBILITIES, identity, leave_out, packets};

/// Merges states and takes nothing more.
fn merge(place: &Ground, states: &[&str], out: &str) -> Vec<String> {
    let states: Vec<String> = states.iter().map(|state| place.path(state)).collect();
    let mut args = vec!["merge".to_owned()];
    args.extend(states);
    args.extend(["--map", &place.pipeline, "--out", &place.path(out)].map(str::to_owned));
    args
}

fn strs(args: &[String]) -> Vec<&str> {
    args.iter().map(String::as_str).collect()
}

#[test]
fn states_make_one_whatever_their_order() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.downlink();
        let reach = ["--wait-bytes", "10000000"];
        let once = place.replay("once", &[&file], &reach);
        let at_once = place.replay("at-once", &[&file], &["--wait-bytes", "0"]);
        assert_eq!(at_once["ledger"], once["ledger"]);
        // Three stations: of visibilities each hears a third, here and there; of the rest all of it.
        for station in 0..3 {
            let hears = |packet: &Vec<u8>| {
                let (apid, count) = identity(packet);
                apid != VISIBILITIES || (count.wrapping_mul(2_654_435_761) >> 7) % 3 == station
            };
            let heard: Vec<Vec<u8>> = packets(&file).into_iter().filter(hears).collect();
            let heard = place.file(&format!("{station}.ccsds"), &heard.concat());
            place.replay(&format!("{station}"), &[&heard], &reach);
            place.replay(&format!("{station} at once"), &[&heard], &["--wait-bytes", "0"]);
        }
        let orders = [["0", "1", "2"], ["2", "0", "1"], ["1", "2", "0"]];
        for (k, order) in orders.iter().enumerate() {
            // The bits of one ground that heard all.
            let out = format!("merged {k}");
            succeed(&strs(&merge(&place, order, &out)));
            assert!(place.bytes(&out) == place.bytes("once"), "{engine}, {order:?}");
            let out = format!("merged at once {k}");
            let states = order.map(|station| format!("{station} at once"));
            succeed(&strs(&merge(&place, &states.each_ref().map(String::as_str), &out)));
            assert!(place.bytes(&out) == place.bytes("at-once"), "{engine}, {order:?}");
            place.replay(&out, &[&file], &[]);
            assert!(place.maps(&out) == place.maps("once"), "{engine}");
        }
        // Without a map file the settings are those that the states hold.
        let mut unnamed = merge(&place, &orders[0], "unnamed");
        unnamed.drain(4..6);
        assert!(!unnamed.contains(&"--map".to_owned()));
        succeed(&strs(&unnamed));
        assert!(place.bytes("unnamed") == place.bytes("once"), "{engine}");
    }
}

#[test]
fn a_merge_that_was_ended_after_its_checkpoint_is_repeated() {
    for (engine, more) in ENGINES.into_iter().chain([("refined", super::refined::REFINED)]) {
        let place = Ground::with(more);
        let file = place.downlink();
        for (name, lost) in [("first", 41..1000), ("second", 0..41)] {
            let path = place.file(&format!("{name}.ccsds"), &leave_out(&file, lost));
            place.replay(name, &[&path], &[]);
        }
        succeed(&strs(&merge(&place, &["first", "second"], "both")));
        let bytes = place.bytes("both");
        succeed(&strs(&merge(&place, &["second", "first"], "both")));
        assert!(place.bytes("both") == bytes, "{engine}");
        // Of other states it is not the same.
        let said = fail(&strs(&merge(&place, &["first"], "both")));
        assert!(said.contains("holds a state already"), "{engine}: {said}");
    }
}

#[test]
fn states_of_the_same_visibilities_are_refused() {
    let place = Ground::new();
    let file = place.downlink();
    let states = [("first", 41..1000, "0"), ("second", 0..30, "0")];
    for (name, lost, wait) in states {
        let path = place.file(&format!("{name}.ccsds"), &leave_out(&file, lost));
        place.replay(name, &[&path], &["--wait-bytes", wait]);
    }
    let said = fail(&strs(&merge(&place, &["first", "second"], "more")));
    assert!(said.contains("count 30 is in the sums of both"), "{said}");
    let said = fail(&strs(&merge(&place, &["first", "second"], "first")));
    assert!(said.contains("first: is one of the states to merge; expected a new folder"), "{said}");
    // What one has read and the other lets wait is taken once: without positions it can make nothing of it, which it says.
    let mut third = packets(&place.file("later.ccsds", &leave_out(&file, 0..30)));
    third.retain(|packet| identity(packet).0 != 0x102);
    let path = place.file("third.ccsds", &third.concat());
    assert!(!place.output("third", &[&path], &["--wait-bytes", "10000000"]).status.success());
    succeed(&strs(&merge(&place, &["first", "third"], "both")));
    assert_eq!(place.gaps("both")["gaps"].as_array().unwrap().len(), 0);
}
