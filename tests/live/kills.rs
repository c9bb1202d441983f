//! A listening ground that is killed again and again.

use super::durable::{kill, taken};
use super::*;

/// Parts in which a downlink is sent.
const PARTS: usize = 10;

/// A number from 0 on, of a generator of full period.
fn below(state: &mut u32, limit: usize) -> usize {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    (*state >> 16) as usize % limit
}

/// Kills a ground at any moment while stations send, until it was killed so often or the time is over. Whenever all of a downlink was
/// taken, all of it is there, to the bit. Returns the numbers of kills and of downlinks.
fn kill_and_send(kills: usize, time: Duration) -> (usize, usize) {
    let place = Place::new();
    let file = place.downlink("packets");
    let whole = place.read_into("whole", &file);
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let parts: Vec<Vec<u8>> =
        packets.chunks(packets.len().div_ceil(PARTS)).map(<[Vec<u8>]>::concat).collect();
    let (since, mut random) = (Instant::now(), 1);
    let (mut killed, mut rounds) = (0, 0);
    while killed < kills && since.elapsed() < time {
        let name = format!("state {rounds}");
        let state = ["--state", &place.path(&name)];
        let mut left: Vec<usize> = (0..parts.len()).collect();
        while !left.is_empty() {
            let ground = place.ground("killed.out", &state);
            // The first part alone makes the instrument known.
            let at = if left.contains(&0) { 0 } else { below(&mut random, left.len()) };
            let part = &parts[left[at]];
            match below(&mut random, 4) {
                // While it begins, or while it reads.
                0 => drop(ground.connect().write_all(&part[..below(&mut random, part.len())])),
                // Once it has answered, at once or a little later.
                wait => {
                    assert_eq!(ground.send(part), taken(part));
                    left.remove(at);
                    std::thread::sleep(Duration::from_millis(if wait == 1 {
                        0
                    } else {
                        below(&mut random, 30) as u64
                    }));
                }
            }
            kill(ground);
            killed += 1;
        }
        assert!(place.resumed(&name) == whole, "something of what was taken is lost, after {killed} kills");
        std::fs::remove_dir_all(place.path(&name)).unwrap();
        rounds += 1;
    }
    (killed, rounds)
}

#[test]
fn what_a_killed_ground_has_taken_is_there() {
    // Some fourteen kills a downlink.
    let (kills, _) = kill_and_send(14, Duration::from_secs(600));
    assert!(kills >= PARTS);
}

#[test]
#[ignore = "takes minutes"]
fn long_what_a_ground_has_taken_is_there_after_a_thousand_kills() {
    let (kills, rounds) = kill_and_send(1000, Duration::from_secs(300));
    println!("{kills} kills, {rounds} downlinks, nothing lost");
}
