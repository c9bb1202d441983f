//! A listening ground that is killed again and again while three stations send.

use super::durable::taken;
use super::serving::Served;
use super::*;

const LINKS: usize = 3;

/// Packets of a station's first delivery, from which a new ground takes its instrument.
const FIRST_PACKETS: usize = 40;

/// Deliveries of the rest, each over a connection of its own.
const PARTS: usize = 20;

/// Most that a ground lives after it listens, ms.
const PATIENCE_MS: usize = 120;

/// Visibilities held one by one. One iteration shows all that more would, and its solution goes on to where it depends on the data alone.
const REFINED: [&str; 6] =
    ["--set", "map.engine=harmonic", "--set", "map.residual_max=1e-8", "--set", "map.refine.passes_max=1"];

/// A number from 0 on, of a generator of full period.
fn below(state: &mut u32, limit: usize) -> usize {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    (*state >> 16) as usize % limit
}

/// What a station heard: after the first delivery packets are lost, doubled and out of order, a tenth, a tenth and a third of them.
fn heard(packets: &[Vec<u8>], random: &mut u32) -> Vec<Vec<u8>> {
    let (first, rest) = packets.split_at(FIRST_PACKETS);
    let mut heard = Vec::new();
    for packet in rest {
        let copies = match below(random, 10) {
            0 => 0,
            1 => 2,
            _ => 1,
        };
        heard.extend(std::iter::repeat_n(packet.clone(), copies));
    }
    for k in 1..heard.len() {
        if below(random, 3) == 0 {
            let before = k - below(random, k.min(20));
            heard.swap(k, before);
        }
    }
    std::iter::once(first).chain(heard.chunks(heard.len().div_ceil(PARTS))).map(<[Vec<u8>]>::concat).collect()
}

/// Sends the parts that are left, until one is not answered.
fn send_left(address: &str, left: &mut Vec<Vec<u8>>) {
    while let Some(part) = left.first() {
        let answer = TcpStream::connect(address).and_then(|mut stream| {
            stream.write_all(part)?;
            stream.shutdown(Shutdown::Write)?;
            let mut answer = String::new();
            stream.read_to_string(&mut answer).map(|_| answer)
        });
        match answer {
            Ok(answer) if answer == taken(part) => drop(left.remove(0)),
            _ => return,
        }
    }
}

/// Kills a ground with a page at any moment while stations send, until it was killed so often or the time is over. Whenever all parts of
/// all stations were taken, what they held is there, to the bit. Returns the numbers of kills and of downlinks.
fn kill_and_send(more: &[&str], kills: usize, time: Duration) -> (usize, usize) {
    let place = Place::new();
    let packets = packets_of(&std::fs::read(place.downlink("packets")).unwrap());
    let (since, mut random) = (Instant::now(), 1);
    let (mut killed, mut rounds) = (0, 0);
    while killed < kills && since.elapsed() < time {
        let mut left = [(); LINKS].map(|()| heard(&packets, &mut random));
        let anyone = place
            .workplace
            .file("anyone.ccsds", &left.iter().flatten().flatten().copied().collect::<Vec<u8>>());
        let (state, out) = (place.path("state"), place.path("killed.out"));
        let listen = ["replay", "--listen", "tcp://127.0.0.1:0", "--map", place.pipeline(), "--out", &out];
        let parts_left = |left: &[Vec<Vec<u8>>]| left.iter().map(Vec::len).sum::<usize>();
        // Longer while nothing is taken, as on a busy machine.
        let mut patience_ms = PATIENCE_MS;
        while parts_left(&left) > 0 {
            let before = parts_left(&left);
            let ground = Served::start(&[&listen[..], &["--state", &state], more].concat());
            let address = ground.listening();
            std::thread::scope(|scope| {
                for parts in &mut left {
                    scope.spawn(|| send_left(&address, parts));
                }
                let mut page = TcpStream::connect(&ground.address).unwrap();
                write!(page, "GET /events HTTP/1.1\r\nHost: {}\r\n\r\n", ground.address).unwrap();
                // While it begins, reads, answers, or writes a checkpoint.
                std::thread::sleep(Duration::from_millis(below(&mut random, patience_ms) as u64));
                ground.kill();
            });
            killed += 1;
            patience_ms =
                if parts_left(&left) < before { PATIENCE_MS } else { (2 * patience_ms).min(1 << 14) };
        }
        let read = place.replay("anyone.out", &anyone, more);
        let map = ["replay", "--map", place.pipeline(), "--out", &out, "--json", "--state", &state];
        let resumed: Value = serde_json::from_str(&succeed(&[&map[..], more].concat())).unwrap();
        assert_eq!(resumed["ledger"], read["ledger"], "after {killed} kills");
        assert!(place.maps("killed.out") == place.maps("anyone.out"), "after {killed} kills");
        std::fs::remove_dir_all(&state).unwrap();
        rounds += 1;
    }
    (killed, rounds)
}

#[test]
fn what_a_killed_ground_has_taken_is_there() {
    let (kills, _) = kill_and_send(&[], 10, Duration::from_secs(600));
    assert!(kills >= 10);
}

#[test]
#[ignore = "takes minutes"]
fn long_what_a_ground_has_taken_is_there_after_a_thousand_kills() {
    let (kills, rounds) = kill_and_send(&REFINED, 1000, Duration::from_secs(1200));
    println!("{kills} kills, {rounds} downlinks, nothing lost");
}
