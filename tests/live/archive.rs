//! What a ground has answered with `taken` is on disk, whatever ends it.

use super::durable::{halves, kill, taken};
use super::*;

/// Checkpoints of a state, by name.
fn checkpoints(place: &Place, state: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(place.path(state)).unwrap().map(|entry| entry.unwrap().path());
    entries.filter(|path| path.extension().is_some_and(|extension| extension == "lunarray")).collect()
}

/// Files with packets in the raw archive of a state.
fn segments(place: &Place, state: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(PathBuf::from(place.path(state)).join("archive")).unwrap();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    found.retain(|path| path.extension().is_some_and(|extension| extension == "ccsds"));
    found.sort();
    found
}

#[test]
fn a_mission_that_was_taken_survives_a_kill_before_the_first_checkpoint() {
    let place = Place::new();
    let file = place.downlink("packets");
    let parts = halves(&file);
    let whole = place.read_into("whole", &file);
    // After each half the ground is killed, and has no checkpoint.
    for part in &parts {
        let ground = place.ground("killed.out", &["--state", &place.path("killed")]);
        assert_eq!(ground.send(part), taken(part));
        kill(ground);
        for path in checkpoints(&place, "killed") {
            std::fs::remove_file(path).unwrap();
        }
    }
    assert!(place.resumed("killed") == whole, "something of what was taken is lost");
    assert!(place.maps("killed.resumed") == place.maps("whole.out"));
}

#[test]
fn kills_at_any_time_lose_nothing_that_was_taken() {
    let place = Place::new();
    let file = place.downlink("packets");
    let whole = place.read_into("whole", &file);
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let state = place.path("killed");
    // Small pieces, each sent twice; checkpoints come when they come.
    for (number, piece) in packets.chunks(packets.len().div_ceil(6)).enumerate() {
        let every = ["--checkpoint-every", ["1000000", "1", "300"][number % 3]];
        let ground = place.ground("killed.out", &[&["--state", &state][..], &every].concat());
        let piece = piece.concat();
        assert_eq!(ground.send(&piece), taken(&piece));
        std::thread::scope(|scope| {
            let again = scope.spawn(|| {
                // It may find the ground gone.
                let mut stream = ground.connect();
                let _ = stream.write_all(&piece);
            });
            std::thread::sleep(Duration::from_millis(7 * number as u64));
            again.join().unwrap();
        });
        kill(ground);
    }
    assert!(place.resumed("killed") == whole, "something of what was taken is lost");
    // Packets that came twice are kept once.
    let kept: usize = segments(&place, "killed").iter().map(|path| std::fs::read(path).unwrap().len()).sum();
    assert_eq!(kept, packets.iter().map(Vec::len).sum::<usize>());
    // The same from the raw archive alone, which is left as it is.
    let said = succeed(&["rebuild", &state, "--out", &place.path("rebuilt")]);
    assert!(said.contains(&format!("{} packets", packets.len())), "{said}");
    assert!(place.checkpoint("rebuilt") == whole);
    assert!(
        complaint(&["rebuild", &state, "--out", &place.path("rebuilt")]).contains("holds a state already")
    );
}

#[test]
fn a_damaged_archive_loses_what_is_damaged_and_says_so() {
    let place = Place::new();
    let file = place.downlink("packets");
    let bytes = std::fs::read(&file).unwrap();
    let ground = place.ground("killed.out", &["--state", &place.path("killed")]);
    assert_eq!(ground.send(&bytes), taken(&bytes));
    kill(ground);
    for path in checkpoints(&place, "killed") {
        std::fs::remove_file(path).unwrap();
    }
    let segment = &segments(&place, "killed")[0];
    let mut kept = std::fs::read(segment).unwrap();
    let last = kept.len() - 60;
    kept[last] ^= 1;
    std::fs::write(segment, kept).unwrap();
    let out = place.path("out");
    let args = ["replay", "--map", place.pipeline(), "--out", &out, "--state", &place.path("killed")];
    let output = common::workplace::lunarray(&args);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("1 stretches are damaged"), "{said}");
    // Sent again, it is whole.
    place.replay("again", &file, &["--state", &place.path("killed")]);
    assert!(place.checkpoint("killed") == place.read_into("whole", &file));
}

#[test]
fn what_was_retracted_stays_out_of_a_state_that_is_made_anew() {
    let place = Place::new();
    let file = place.downlink("packets");
    let [first, second] = halves(&file);
    let ground = place.ground("heard.out", &["--state", &place.path("heard"), "--connections", "1"]);
    ground.send(&[first.clone(), second.clone()].concat());
    ground.succeed();
    let bad = place.workplace.file("bad", &second);
    succeed(&["retract", &bad, "--state", &place.path("heard"), "--map", place.pipeline()]);
    succeed(&["rebuild", &place.path("heard"), "--out", &place.path("rebuilt")]);
    assert!(place.resumed("rebuilt") == place.resumed("heard"), "what was retracted has come back");
    // Taken again, it is there again, after a kill and in a state made anew.
    let ground = place.ground("heard.out", &["--state", &place.path("heard")]);
    assert_eq!(ground.send(&second), taken(&second));
    kill(ground);
    let whole = place.read_into("whole", &file);
    assert!(place.resumed("heard") == whole);
    succeed(&["rebuild", &place.path("heard"), "--out", &place.path("anew")]);
    assert!(place.checkpoint("anew") == whole);
}

#[test]
fn an_archive_that_cannot_be_written_takes_nothing() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    let ground = place.ground("heard.out", &["--state", &place.path("heard"), "--connections", "2"]);
    let (folder, gone) = (PathBuf::from(place.path("heard")).join("archive"), place.path("gone"));
    std::fs::rename(&folder, &gone).unwrap();
    let answer = ground.send(&bytes);
    assert!(answer.starts_with("busy: ") && answer.contains("not on disk"), "{answer}");
    std::fs::rename(&gone, &folder).unwrap();
    assert_eq!(ground.send(&bytes), taken(&bytes));
    let summary = ground.succeed();
    assert_eq!(summary["listening"]["ended"]["not-on-disk"], 1);
}

#[test]
fn a_checkpoint_follows_a_delivery_that_has_ended() {
    let place = Place::new();
    let file = place.downlink("packets");
    let bytes = std::fs::read(&file).unwrap();
    let ground = place.ground("heard.out", &["--state", &place.path("heard")]);
    ground.send(&bytes);
    let since = Instant::now();
    while checkpoints(&place, "heard").is_empty() {
        assert!(since.elapsed() < Duration::from_secs(60), "no checkpoint");
        std::thread::sleep(Duration::from_millis(20));
    }
    kill(ground);
    // It holds everything: nothing is left for the archive.
    let whole = place.read_into("whole", &file);
    std::fs::rename(place.path("heard/archive"), place.path("gone")).unwrap();
    assert!(place.resumed("heard") == whole);
}
