//! Senders that are told once a checkpoint on disk holds what they sent.

use super::*;

/// After the first checkpoint for senders, none within a test.
const SELDOM: &str = "downlink.listen.held_every_s=1000000";

/// A part of a downlink on its way: the sender requests `held`, has sent everything, and reads the answers.
fn ask(ground: &Ground, bytes: &[u8]) -> BufReader<TcpStream> {
    let mut stream = ground.connect();
    // In pieces that divide the line and a packet.
    stream.write_all(b"answer ").unwrap();
    stream.write_all(b"held\n").unwrap();
    stream.write_all(bytes).unwrap();
    stream.shutdown(Shutdown::Write).unwrap();
    BufReader::new(stream)
}

/// The next line of the answer; empty if there is none.
fn line(answer: &mut BufReader<TcpStream>) -> String {
    let mut line = String::new();
    answer.read_line(&mut line).unwrap();
    line
}

pub(super) fn taken(bytes: &[u8]) -> String {
    format!("taken {} bytes\n", bytes.len())
}

fn held(bytes: &[u8]) -> String {
    format!("held {} bytes\n", bytes.len())
}

/// Ends a ground with SIGKILL.
pub(super) fn kill(mut ground: Ground) {
    ground.child.kill().unwrap();
    ground.child.wait().unwrap();
}

/// A downlink in two parts, each of whole packets.
pub(super) fn halves(file: &str) -> [Vec<u8>; 2] {
    let packets = packets_of(&std::fs::read(file).unwrap());
    let (first, second) = packets.split_at(packets.len() / 2);
    [first.concat(), second.concat()]
}

impl Place {
    /// The checkpoint of a state after a session that receives nothing.
    pub(super) fn resumed(&self, state: &str) -> Vec<u8> {
        let (out, folder) = (self.path(&format!("{state}.resumed")), self.path(state));
        succeed(&["replay", "--map", self.pipeline(), "--out", &out, "--state", &folder]);
        self.checkpoint(state)
    }

    /// The checkpoint of a state that has a file's packets.
    pub(super) fn read_into(&self, state: &str, file: &str) -> Vec<u8> {
        self.replay(&format!("{state}.out"), file, &["--state", &self.path(state)]);
        self.checkpoint(state)
    }
}

#[test]
fn what_is_held_survives_a_kill_without_the_raw_archive() {
    let place = Place::new();
    let file = place.downlink("packets");
    let [first, second] = halves(&file);
    let half = place.read_into("half", &place.workplace.file("first", &first));
    let whole = place.read_into("whole", &file);
    let state = ["--state", &place.path("killed"), "--set", SELDOM, "--no-archive"];
    let ground = place.ground("killed.out", &state);
    let mut answer = ask(&ground, &first);
    assert_eq!([line(&mut answer), line(&mut answer)], [taken(&first), held(&first)]);
    let mut answer = ask(&ground, &second);
    assert_eq!(line(&mut answer), taken(&second));
    // What is held is on disk; without the archive what is taken is in memory alone.
    kill(ground);
    assert_ne!(line(&mut answer), held(&second));
    assert!(place.resumed("killed") == half, "something of what was held is lost");
    let ground = place.ground("killed.out", &state);
    let mut answer = ask(&ground, &second);
    assert_eq!([line(&mut answer), line(&mut answer)], [taken(&second), held(&second)]);
    kill(ground);
    assert!(place.resumed("killed") == whole, "something of what was held is lost");
    let (resumed, read) = (place.maps("killed.resumed"), place.maps("whole.out"));
    assert!(resumed == read);
}

#[test]
fn the_spacecraft_sends_again_what_a_killed_ground_did_not_hold() {
    let place = Place::new();
    let file = place.downlink("packets");
    let [first, second] = halves(&file);
    let length = first.len() + second.len();
    let whole = place.read_into("whole", &file);
    let state = ["--state", &place.path("killed"), "--set", SELDOM, "--no-archive"];
    let ground = place.ground("killed.out", &state);
    // The one checkpoint for senders.
    let mut answer = ask(&ground, &first);
    assert_eq!([line(&mut answer), line(&mut answer)], [taken(&first), held(&first)]);
    let url = ground.url.clone();
    let sender = std::thread::scope(|scope| {
        let url = &url;
        let sender = scope.spawn(|| {
            succeed(&["simulate", place.pipeline(), "--send", url, "--held", "--connect-s", "600"])
        });
        // The note on its connection; the other one is that of the first half.
        let since = Instant::now();
        while ground.said.lock().unwrap().matches("the sender closed it").count() < 2 {
            assert!(since.elapsed() < Duration::from_secs(300), "the downlink is not taken");
            std::thread::sleep(Duration::from_millis(20));
        }
        kill(ground);
        let again = place.ground("killed.out", &[&state[..], &["--listen", url]].concat());
        let said = sender.join().unwrap();
        kill(again);
        said
    });
    assert!(sender.contains(&format!("holds all {length} bytes")), "{sender}");
    assert!(place.resumed("killed") == whole);
}

#[test]
fn the_last_checkpoint_of_a_session_answers_too() {
    let place = Place::new();
    let file = place.downlink("packets");
    let [first, second] = halves(&file);
    let state = ["--state", &place.path("heard"), "--set", SELDOM, "--connections", "2"];
    let ground = place.ground("heard.out", &state);
    for part in [&first, &second] {
        // The second waits until the ground, which then has its two connections, ends.
        let mut answer = ask(&ground, part);
        assert_eq!([line(&mut answer), line(&mut answer)], [taken(part), held(part)]);
    }
    // Others are answered as ever, and repeated packets need no checkpoint.
    ground.succeed();
    assert!(place.checkpoint("heard") == place.read_into("read", &file));
    let ground = place.ground("heard.again", &["--state", &place.path("heard"), "--connections", "2"]);
    assert_eq!(ground.send(&first), taken(&first));
    let mut answer = ask(&ground, &second);
    assert_eq!(
        [line(&mut answer), line(&mut answer), line(&mut answer)],
        [taken(&second), held(&second), String::new()]
    );
    ground.succeed();
}

#[test]
fn without_checkpoints_nothing_is_said_to_be_held() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    // Without a state there are none: told at once, to any sender by name.
    let ground = place.ground("heard", &["--connections", "1"]);
    let mut stream = ground.connect();
    stream.write_all(b"answer held\n").unwrap();
    let mut said = String::new();
    stream.read_to_string(&mut said).unwrap();
    assert!(said.starts_with("closed ") && said.contains("--state"), "{said}");
    let send = ["simulate", place.pipeline(), "--send", &ground.url, "--held"];
    let said = complaint(&send);
    assert!(said.contains("requests `held`") && said.contains("--state"), "{said}");
    ground.send(&bytes);
    let summary = ground.succeed();
    assert_eq!(summary["listening"]["ended"]["no-state"], 2);
    // With a state that cannot be saved, a sender waits, and at the end of the session is told so.
    let state = place.path("lost");
    let set = ["--set", "downlink.listen.held_every_s=0", "--set", "runtime.grace_s=100000"];
    let ground = place.ground("lost.out", &[&["--state", &state][..], &set].concat());
    std::fs::remove_file(std::path::Path::new(&state).join("lock")).unwrap();
    let mut answer = ask(&ground, &bytes);
    assert_eq!(line(&mut answer), taken(&bytes));
    let killed = Process::new("kill").args(["-TERM", &ground.child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let last = line(&mut answer);
    assert!(last.starts_with("busy: ") && last.contains("not held"), "{last}");
    ground.end_without_summary();
    // `--held` without `--send` has nobody to ask.
    assert!(complaint(&["simulate", place.pipeline(), "--out", "x", "--held"]).contains("--send"));
}
