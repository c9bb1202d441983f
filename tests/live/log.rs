//! `--log json`: what is said on standard error, as one JSON object a line.

use super::common::process;
use super::*;

/// The lines of a log, each of which is an object with time, level and event.
fn lines(said: &str) -> Vec<Value> {
    let parsed: Vec<Value> = said
        .lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}")))
        .collect();
    for line in &parsed {
        let time = line["time"].as_str().unwrap();
        assert!(time.len() == "2026-11-23T05:46:34.123Z".len() && time.ends_with('Z'), "{line}");
        assert!(["info", "warn", "error"].contains(&line["level"].as_str().unwrap()), "{line}");
        assert!(line["event"].is_string(), "{line}");
    }
    parsed
}

fn events(lines: &[Value]) -> Vec<&str> {
    lines.iter().map(|line| line["event"].as_str().unwrap()).collect()
}

/// What a command says, with its exit code.
fn said(args: &[&str]) -> (i32, String) {
    let output = process::output(process::start(args));
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn every_line_of_a_ground_that_listens_is_an_object() {
    let place = Place::new();
    let bytes = std::fs::read(place.downlink("packets")).unwrap();
    let out = place.path("heard");
    let args = [
        "replay",
        "--log",
        "json",
        "--listen",
        "tcp://127.0.0.1:0",
        "--out",
        &out,
        "--map",
        place.pipeline(),
    ];
    // Long enough for a line of progress, which comes every ten seconds.
    let mut child = process::start(&[&args[..], &["--idle-s", "11"]].concat());
    let mut reader = BufReader::new(child.stderr.take().unwrap());
    let mut first = String::new();
    reader.read_line(&mut first).unwrap();
    assert_eq!([&lines(&first)[0]["event"], &lines(&first)[0]["segment"]], ["begin", "ground"]);
    let mut second = String::new();
    reader.read_line(&mut second).unwrap();
    let url = lines(&second)[0]["url"].as_str().unwrap().to_owned();
    let send = |bytes: &[u8]| finish(TcpStream::connect(url.strip_prefix("tcp://").unwrap()).unwrap(), bytes);
    // A regular end, and one that should be looked at.
    assert_eq!(send(&bytes), format!("taken {} bytes\n", bytes.len()));
    assert!(send(b"answer held\n").starts_with("closed "));
    let mut rest = String::new();
    reader.read_to_string(&mut rest).unwrap();
    assert!(process::output(child).status.success(), "{rest}");
    let told = lines(&(first + &second + &rest));
    let of = |event: &str| told.iter().filter(|line| line["event"] == event).collect::<Vec<_>>();
    let senders = of("sender");
    assert_eq!([&senders[0]["ended"], &senders[1]["ended"]], ["whole", "no-state"]);
    assert_eq!([&senders[0]["level"], &senders[1]["level"]], ["info", "warn"]);
    assert_eq!(senders[0]["bytes"].as_u64(), Some(bytes.len() as u64));
    assert!(senders[0]["peer"].as_str().unwrap().starts_with("127.0.0.1:"));
    // The fields of `--events`.
    let progress = of("progress");
    assert!(progress[0]["elapsed_s"].as_f64().unwrap() >= 10.0);
    assert_eq!(progress[0]["stages"][0]["name"], "read");
    assert!(progress[0]["ledger"].is_object() && progress[0]["reception"].is_object());
    assert_eq!(of("end").len(), 1);
    assert_eq!(of("end")[0]["status"], "complete");
}

#[test]
fn notes_errors_and_wrong_usage_are_objects_too() {
    let place = Place::new();
    // The pipeline has too few visibilities for its map, of which a note tells.
    let out = place.path("out");
    let run = [
        "run",
        place.pipeline(),
        "--format",
        "cadu",
        "--out",
        &out,
        "--set",
        "downlink.link.frame_loss=0.1",
        "--serve",
        "0",
    ];
    let (code, text) = said(&[&["--log", "json"], &run[..]].concat());
    let told = lines(&text);
    assert_eq!(code, 0, "{text}");
    // Notes on the configuration come first.
    assert_eq!(told.iter().find(|line| line["event"] != "note").unwrap()["event"], "serving");
    let expected = ["serving", "begin", "note", "incomplete", "progress", "map", "stage-ended", "end"];
    // Without the last report nobody knows what else is missing, or with it all is known: then nothing is said.
    assert!(events(&told).iter().all(|event| expected.contains(event)), "{text}");
    // However short the run.
    for event in ["begin", "progress", "end"] {
        assert!(events(&told).contains(&event), "{event}: {text}");
    }
    // An error with its causes; the option may stand anywhere.
    let missing = place.path("missing.ccsds");
    let (code, text) = said(&["replay", &missing, "--out", &out, "--log=json"]);
    let told = lines(&text);
    assert_eq!((code, events(&told)), (1, vec!["begin", "end", "error"]), "{text}");
    assert!(told[2]["message"].as_str().unwrap().contains("missing.ccsds") && told[2]["causes"].is_array());
    assert_eq!([&told[1]["status"], &told[2]["level"]], ["failed", "error"]);
    // Wrong usage, of which the command line itself is to blame.
    let (code, text) = said(&["replay", "--log", "json", "--no-such-option"]);
    assert_eq!((code, events(&lines(&text))), (2, vec!["usage"]), "{text}");
}

#[test]
fn as_text_all_is_as_without_the_option() {
    let place = Place::new();
    let missing = place.path("missing.ccsds");
    for args in [
        vec!["replay", &missing, "--out", "x"],
        vec!["check", place.pipeline(), "--set", "spacecraft.every_nth_window=0"],
        vec!["replay", "--no-such-option"],
    ] {
        let plain = said(&args);
        assert_eq!(said(&[&args[..], &["--log", "text"]].concat()), plain);
        assert!(!plain.1.is_empty() && !plain.1.starts_with('{'));
    }
    // Notes have the form that they always had.
    let file = place.downlink("packets");
    let packets = packets_of(&std::fs::read(&file).unwrap());
    let cut = place.workplace.file("cut.ccsds", &packets[..packets.len() / 2].concat());
    let (code, text) = said(&["replay", &cut, "--map", place.pipeline(), "--out", &place.path("out")]);
    assert!(code == 0 && text.starts_with("note: the ledger is "), "{text}");
}
