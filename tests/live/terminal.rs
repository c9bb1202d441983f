//! `lunarray top`: the page in a terminal.

use super::common::process::{end, wait_until};
use super::serving::{Served, finished};
use super::*;

/// Whole numbers as people read them.
fn grouped(number: &Value) -> String {
    let digits = number.as_u64().unwrap().to_string();
    let mut text = String::new();
    for (k, digit) in digits.chars().enumerate() {
        if k > 0 && (digits.len() - k).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[test]
fn a_terminal_shows_what_the_interface_says() {
    let place = Place::new();
    let served = finished(&place, "out");
    let status = served.json("/api/status");
    let text = succeed(&["top", &served.address, "--once"]);
    // What has ended stands still: clock, rates.
    std::thread::sleep(Duration::from_millis(1100));
    assert_eq!(text, succeed(&["top", &format!("http://{}/", served.address), "--once"]));
    assert!(!text.contains('\u{1b}'), "{text}");
    // For programs: what the interface says.
    let mut printed: Value = serde_json::from_str(&succeed(&["top", &served.address, "--json"])).unwrap();
    let mut status = status;
    // Ages grow from one question to the next.
    for said in [&mut printed, &mut status] {
        for channel in said["channels"].as_array_mut().unwrap() {
            assert!(channel.as_object_mut().unwrap().remove("age_s").is_some());
        }
    }
    for key in ["ledger", "reception", "channels"] {
        assert_eq!(printed[key].take(), status[key], "{key}");
    }
    let row = |name: &str| {
        let found = text.lines().find(|line| line.contains(&format!("\u{2502}{name} ")));
        found.unwrap_or_else(|| panic!("no {name} in\n{text}"))
    };
    assert!(text.starts_with("lunarray small \u{b7} whole chain \u{b7} ended"), "{text}");
    for stage in status["stages"].as_array().unwrap() {
        assert!(row(stage["name"].as_str().unwrap()).contains("ended"), "{text}");
    }
    let ledger = &status["ledger"];
    let flagged = ledger["flagged"].as_object().unwrap().iter();
    let mut entries: Vec<(String, &Value)> =
        flagged.map(|(reason, count)| (format!("flagged: {reason}"), count)).collect();
    assert!(!entries.is_empty());
    entries.extend(["sampled", "accumulated"].map(|name| (name.to_owned(), &ledger[name])));
    for (name, count) in entries {
        assert!(text.contains(&format!(" {}  {name}", grouped(count))), "{name} in\n{text}");
    }
    assert!(text.contains("balanced"), "{text}");
    for kind in ["instrument", "ephemeris", "visibilities", "housekeeping"] {
        let line = text.lines().find(|line| line.contains(&format!("\u{2502}{kind} ")));
        let words: Vec<&str> =
            line.unwrap().split('\u{2502}').rev().nth(1).unwrap().split_whitespace().collect();
        let of = &status["reception"][kind];
        let counts = ["packets", "missing", "damaged", "duplicates"].map(|key| grouped(&of[key]));
        assert_eq!(words[1..], counts, "{text}");
    }
    for channel in status["channels"].as_array().unwrap() {
        let line = text
            .lines()
            .find(|line| line.contains(&format!("{:.3}", channel["frequency_hz"].as_f64().unwrap() / 1e6)));
        assert!(line.unwrap().contains(&grouped(&channel["figures"]["visibilities"])), "{text}");
    }
    assert!(text.contains("rho_l"), "{text}");
    assert!(served.end().success());
}

#[test]
fn a_terminal_without_a_server_or_without_a_terminal_says_so() {
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = silent.local_addr().unwrap().to_string();
    drop(silent);
    assert!(complaint(&["top", &address, "--once"]).contains("--serve"));
    // Another server.
    let other = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = other.local_addr().unwrap().to_string();
    let answering = std::thread::spawn(move || {
        let (mut stream, _) = other.accept().unwrap();
        let _ = stream.read(&mut [0; 1024]);
        stream.write_all(b"HTTP/1.1 200 OK\r\nContent-Length: 6\r\n\r\n<html>").unwrap();
    });
    assert!(complaint(&["top", &address, "--once"]).contains("expected 200 and the JSON"));
    answering.join().unwrap();
    let place = Place::new();
    let served = finished(&place, "out");
    assert!(complaint(&["top", &served.address]).contains("--once"));
    assert!(complaint(&["top", "nonsense"]).contains("PORT or HOST:PORT"));
}

/// `lunarray top` in a terminal of its own, which `script` makes; ended by `keys` or by a signal. The terminal's answer to `stty -a`
/// before and after, and how it ended.
fn in_a_terminal(served: &Served, keys: &str) -> String {
    let binary = assert_cmd::cargo::cargo_bin("lunarray");
    let run = format!(
        "stty rows 40 cols 100; stty -a; {} top {}; echo code $?; stty -a",
        binary.display(),
        served.address
    );
    let mut command = Process::new("script");
    command.args(["-qec", &run, "/dev/null"]).env("TERM", "xterm-256color").env("SHELL", "/bin/sh");
    let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let (mut input, mut output) = (child.stdin.take().unwrap(), child.stdout.take().unwrap());
    let said = Arc::new(Mutex::new(Vec::new()));
    let heard = Arc::clone(&said);
    let reader = std::thread::spawn(move || {
        let mut bytes = [0; 4096];
        while let Ok(count @ 1..) = output.read(&mut bytes) {
            heard.lock().unwrap().extend_from_slice(&bytes[..count]);
        }
    });
    let text = || String::from_utf8_lossy(&said.lock().unwrap()).into_owned();
    // A blank is drawn by moving on.
    wait_until("the screen", || text().contains("Ledger"));
    input.write_all(keys.as_bytes()).unwrap();
    wait_until("its end", || text().contains("code "));
    assert!(end(&mut child).0.success());
    drop(input);
    reader.join().unwrap();
    text()
}

#[test]
#[ignore = "needs the command `script` of util-linux"]
fn a_terminal_is_as_it_was_afterwards() {
    let place = Place::new();
    let served = finished(&place, "out");
    for keys in ["q", "\u{3}", "\u{1b}[Cq"] {
        let text = in_a_terminal(&served, keys);
        assert!(text.contains("code 0"), "{text}");
        // The other screen is entered and left, and the cursor is there again.
        let last = |code: &str| text.rfind(code).unwrap_or_else(|| panic!("no {code:?} in {text}"));
        assert!(last("\u{1b}[?1049l") > last("\u{1b}[?1049h"), "{text}");
        assert!(last("\u{1b}[?25h") > last("\u{1b}[?25l"), "{text}");
        let modes: Vec<&str> =
            text.lines().filter(|line| line.contains("icanon") && line.contains("echo")).collect();
        assert!(modes.len() == 2 && modes[0] == modes[1] && modes[0].contains(" icanon"), "{modes:?}");
    }
}
