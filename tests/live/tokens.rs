//! Stations that are known by their tokens.

use std::os::unix::fs::PermissionsExt;

use super::*;

const STATIONS: &str = "malargue 0123456789abcdef0123456789abcdef\nurumqi fedcba9876543210\n";

#[test]
fn a_ground_takes_packets_of_its_stations_alone_and_tells_them_apart() {
    let place = Place::new();
    let file = place.downlink("packets");
    place.replay("read", &file, &[]);
    let bytes = std::fs::read(&file).unwrap();
    let half = bytes.len() / 2;
    let stations = place.secret("stations", STATIONS);
    let state = place.path("state");
    let with = ["--stations", &stations, "--state", &state, "--connections", "3"];
    let ground = place.ground("heard", &with);
    let sent = |opening: &str, bytes: &[u8]| ground.send(&[opening.as_bytes(), bytes].concat());
    // Whoever gives no token of a station: nothing of it is taken. Few bytes, so that the answer is not lost with the connection.
    let few = &bytes[..2000];
    assert_eq!(
        sent("", few),
        "closed after 2000 bytes: it did not begin with `token TOKEN`, and the ground has --stations\n"
    );
    assert!(sent("token 0123456789abcdef\n", few).ends_with("no station has its token\n"));
    assert!(sent("answer held\ntoken fedcba9876543210\n", few).contains("did not begin with"));
    // Who knows one: the answers count its packets, not the opening.
    assert_eq!(sent("token fedcba9876543210\n", &bytes[..half]), format!("taken {half} bytes\n"));
    let both = sent("token 0123456789abcdef0123456789abcdef\nanswer held\n", &bytes);
    assert_eq!(both, format!("taken {0} bytes\nheld {0} bytes\n", bytes.len()));
    // The spacecraft, with a file of its own.
    let own = place.secret("own", "malargue 0123456789abcdef0123456789abcdef");
    let said = succeed(&["simulate", place.pipeline(), "--send", &ground.url, "--token", &own]);
    assert!(said.contains(&format!("confirmed all {} bytes", bytes.len())), "{said}");
    let summary = ground.succeed();
    let listening = &summary["listening"];
    let counts = |name: &str, key: &str| listening["stations"][name][key].as_u64().unwrap();
    assert_eq!([counts("malargue", "connections"), counts("urumqi", "connections")], [2, 1]);
    // The half that urumqi sent ends within a packet; nobody's connection broke.
    assert_eq!([counts("malargue", "faults"), counts("urumqi", "faults")], [0, 1]);
    assert_eq!([counts("malargue", "broken"), counts("urumqi", "broken")], [0, 0]);
    // With the lines before the packets.
    let opening = "token 0123456789abcdef0123456789abcdef\n".len();
    let whole = 2 * (bytes.len() + opening) + "answer held\n".len();
    assert_eq!(counts("malargue", "bytes"), whole as u64);
    assert_eq!(counts("malargue", "packets"), 2 * packets_of(&bytes).len() as u64);
    let ended = &listening["ended"];
    assert_eq!([&ended["no-token"], &ended["unknown-token"], &ended["whole"]], [2, 1, 3]);
    let named = listening["senders"]["listed"].as_array().unwrap().iter();
    assert_eq!(named.filter(|sender| sender["station"] == "urumqi").count(), 1);
    assert!(place.maps("heard") == place.maps("read"));
}

#[test]
fn a_spacecraft_without_the_token_is_told_so_at_once() {
    let place = Place::new();
    let stations = place.secret("stations", STATIONS);
    let ground = place.ground("heard", &["--stations", &stations, "--idle-s", "600"]);
    let wrong = place.secret("wrong", "malargue 0123456789abcdee0123456789abcdef");
    // It does not try again until --connect-s is over.
    let sends = ["simulate", place.pipeline(), "--send", &ground.url, "--connect-s", "10000"];
    let said = complaint(&[&sends[..], &["--token", &wrong]].concat());
    assert!(said.contains("receiver closed the connection"), "{said}");
    // Files that give a secret away, or hold several of them.
    std::fs::set_permissions(&wrong, std::fs::Permissions::from_mode(0o644)).unwrap();
    assert!(complaint(&[&sends[..], &["--token", &wrong]].concat()).contains("chmod 600"));
    assert!(complaint(&[&sends[..], &["--token", &stations]].concat()).contains("2 stations"));
    let out = place.path("out");
    let listens = ["replay", "--listen", "tcp://127.0.0.1:0", "--out", &out, "--stations", &wrong];
    let refused = lunarray(&listens);
    assert!(
        refused.status.code() == Some(2) && String::from_utf8_lossy(&refused.stderr).contains("chmod 600")
    );
    let mut ground = ground;
    ground.child.kill().unwrap();
    ground.child.wait().unwrap();
}
