//! Paced replays.

use super::*;

/// Times of the packets of a file, s.
fn times(file: &str) -> Vec<f64> {
    let packets = packets_of(&std::fs::read(file).unwrap());
    packets.iter().map(|packet| PacketHeader::parse(packet).unwrap().time.tai_s()).collect()
}

#[test]
fn a_pace_changes_no_bit() {
    let place = Place::new();
    let [plain, coded] = ["packets", "cadu"].map(|format| place.downlink(format));
    let times = times(&plain);
    let span = times.last().unwrap() - times[0];
    let fast = place.replay("read", &plain, &[]);
    for (name, file) in [("plain", &plain), ("coded", &coded)] {
        let since = Instant::now();
        let found = place.replay(name, file, &["--speed", &format!("{}", span / 1.5)]);
        // The last packet may not be released earlier.
        assert!(since.elapsed().as_secs_f64() >= 1.5);
        assert!(place.maps(name) == place.maps("read"), "{name}");
        assert_eq!(found["ledger"], fast["ledger"]);
    }
}

/// Replays step by step with a number of input lines; returns the messages.
fn step(place: &Place, name: &str, file: &str, step: &str, lines: usize) -> String {
    let output = assert_cmd::Command::cargo_bin("lunarray")
        .unwrap()
        .args(["replay", file, "--map", place.pipeline(), "--out", &place.path(name), "--step", step])
        .write_stdin("\n".repeat(lines))
        .output()
        .unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    said
}

#[test]
fn steps_are_passes_or_times() {
    let place = Place::new();
    let [plain, coded] = ["packets", "cadu"].map(|format| place.downlink(format));
    place.replay("read", &plain, &[]);
    let bytes = std::fs::read(&plain).unwrap();
    let packets = packets_of(&bytes);
    let ends = pass_ends(&packets);
    let passes = ends.iter().filter(|ends| **ends).count();
    assert!(passes > 4);
    // Two steps release three passes.
    let (mut left, mut three) = (3, Vec::new());
    for (packet, ends) in packets.iter().zip(&ends) {
        if left > 0 {
            three.extend_from_slice(packet);
            left -= u32::from(*ends);
        }
    }
    let cut = place.path("three");
    std::fs::write(&cut, three).unwrap();
    place.replay("three.out", &cut, &[]);
    for (name, file) in [("plain", &plain), ("coded", &coded)] {
        step(&place, name, file, "pass", passes);
        assert!(place.maps(name) == place.maps("read"), "{name}");
        let begun = format!("{name}.three");
        let said = step(&place, &begun, file, "pass", 2);
        assert_eq!(said.matches("Enter continues").count(), 3, "{said}");
        assert!(place.maps(&begun) == place.maps("three.out"), "{name}");
    }
    // Steps of a tenth of the time, and a little more: nine marks on the way.
    let times = times(&plain);
    let every = (times.last().unwrap() - times[0]) / 9.5;
    let said = step(&place, "times", &plain, &format!("{every}s"), 100);
    let mut begun: Vec<u64> = times.iter().map(|time| ((time - times[0]) / every) as u64).collect();
    begun.dedup();
    assert_eq!(said.matches("Enter continues").count(), begun.len() - 1, "{said}");
    assert!(place.maps("times") == place.maps("read"));
}

#[test]
fn files_are_sent_as_a_station_sends_them() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    let [first, second] = super::durable::halves(&place.path("small.packets"));
    let files = [place.workplace.file("first", &first), place.workplace.file("second", &second)];
    let ground = place.ground("heard", &["--state", &place.path("state"), "--connections", "2"]);
    let send = ["send", &files[0], &files[1], "--to", &ground.url];
    let said = succeed(&send);
    assert!(said.contains(&format!("confirmed all {} bytes", bytes.len())), "{said}");
    // At a pace, and to a checkpoint; what is sent again is applied once.
    let said = succeed(&[&send[..], &["--speed", "1e9", "--held", "--json"]].concat());
    let said: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(said["confirmed"], bytes.len());
    let heard = ground.succeed();
    let read = place.replay("read", &place.path("small.packets"), &[]);
    assert_eq!(heard["ledger"], read["ledger"]);
    assert!(place.maps("heard") == place.maps("read"));
}
