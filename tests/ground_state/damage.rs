//! Checkpoints that do not hold.

use super::common::workplace::{fail, lunarray};
use super::{ENGINES, Ground, checkpoints};

use std::path::Path;

#[test]
fn a_damaged_checkpoint_is_told_and_the_one_before_used() {
    for (engine, more) in ENGINES {
        let place = Ground::with(more);
        let file = place.downlink();
        let every = ["--checkpoint-every", "2000"];
        place.replay("state", &[&file], &every);
        let good = place.bytes("state");
        let head = 16 + place.head("state").len();
        // Magic, length, all over the head and the engines, checksum; and files cut short.
        let spread = |from: usize, to: usize| (0..4).map(move |k| from + (to - from) * (2 * k + 1) / 8);
        let places = [0, 9, 16].into_iter().chain(spread(16, head)).chain(spread(head, good.len() - 8));
        let places: Vec<usize> = places.chain([good.len() - 9, good.len() - 1]).collect();
        let flipped = places.iter().map(|&at| {
            let mut bad = good.clone();
            bad[at] ^= 0x20;
            (at, bad)
        });
        let cut = [0, 7, 23, head, good.len() - 1].map(|at| (at, good[..at].to_vec()));
        for (at, bad) in flipped.chain(cut) {
            let path = place.newest("state");
            std::fs::write(&path, bad).unwrap();
            let output = place.output("state", &[&file], &every);
            let said = String::from_utf8(output.stderr).unwrap();
            assert!(output.status.success(), "{engine}, byte {at}: {said}");
            let name = path.file_name().unwrap().to_str().unwrap();
            let told = said.contains(name) && said.contains("resuming from the previous checkpoint");
            assert!(told, "{engine}, byte {at}: {said}");
            assert!(place.bytes("state") == good, "{engine}, byte {at}");
        }
        // Of two generations: damage of the older one changes nothing while the newer one holds.
        let folder = place.path("state");
        let [older, _] = checkpoints(Path::new(&folder)).try_into().unwrap();
        std::fs::write(&older, b"nothing").unwrap();
        let output = place.output("state", &[&file], &every);
        assert!(output.status.success() && !String::from_utf8(output.stderr).unwrap().contains("note:"));
        assert!(place.bytes("state") == good, "{engine}");
        // With none that holds, it does not silently begin anew, and leaves what there is.
        for path in checkpoints(Path::new(&folder)) {
            std::fs::write(path, b"nothing").unwrap();
        }
        let output = place.output("state", &[&file], &every);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success() && said.contains("none of its 2 checkpoints can be used"), "{said}");
        assert_eq!(checkpoints(Path::new(&folder)).len(), 2);
    }
}

#[test]
fn looking_at_a_damaged_state_says_so_and_changes_nothing() {
    let place = Ground::new();
    let file = place.downlink();
    place.replay("state", &[&file], &["--checkpoint-every", "2000"]);
    let (newest, state, out) = (place.newest("state"), place.path("state"), place.path("merged"));
    std::fs::write(&newest, b"nothing").unwrap();
    let merge = ["merge", &state, "--map", &place.pipeline, "--out", &out];
    for args in [&["gaps", &state][..], &merge] {
        let output = lunarray(args);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success(), "{said}");
        let name = newest.file_name().unwrap().to_str().unwrap();
        assert!(
            said.contains(name) && said.contains("resuming from the previous checkpoint"),
            "{args:?}: {said}"
        );
        assert_eq!(std::fs::read(&newest).unwrap(), b"nothing", "{args:?}");
        if args[0] == "merge" {
            let said = String::from_utf8(output.stdout).unwrap();
            assert!(said.starts_with("Merged 1 state with"), "{said}");
        }
    }
    let twice = fail(&["merge", &state, &state, "--map", &place.pipeline, "--out", &place.path("twice")]);
    assert!(twice.contains("named twice"), "{twice}");
}
