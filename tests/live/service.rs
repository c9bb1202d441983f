//! A ground as a service: what systemd, Prometheus and Grafana are told.

use std::collections::BTreeSet;
use std::os::unix::net::UnixDatagram;
use std::path::Path;

use super::common::process::{end, signal};
use super::serving::Served;
use super::*;

/// A file of the repository.
fn ours(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
}

/// A socket that a supervisor would have, and the messages on it.
struct Supervisor {
    socket: UnixDatagram,
    messages: Vec<String>,
}

impl Supervisor {
    fn new(socket: UnixDatagram) -> Self {
        socket.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        Self { socket, messages: Vec::new() }
    }

    /// Waits for a message that begins so.
    fn wait_for(&mut self, words: &str) {
        while !self.messages.iter().any(|message| message.starts_with(words)) {
            let mut bytes = [0; 4096];
            let count = self
                .socket
                .recv(&mut bytes)
                .unwrap_or_else(|e| panic!("no {words} ({e}) in {:?}", self.messages));
            self.messages.push(String::from_utf8(bytes[..count].to_vec()).unwrap());
        }
    }
}

#[test]
fn systemd_is_told_when_a_ground_is_ready_alive_and_ending() {
    let place = Place::new();
    let (out, state, path) = (place.path("out"), place.path("state"), place.path("notify"));
    let mut supervisor = Supervisor::new(UnixDatagram::bind(&path).unwrap());
    let ground = |socket: &str| {
        let mut command = Process::new(assert_cmd::cargo::cargo_bin("lunarray"));
        command.args([
            "replay",
            "--listen",
            "tcp://127.0.0.1:0",
            "--map",
            place.pipeline(),
            "--out",
            &out,
            "--state",
            &state,
        ]);
        command.env("NOTIFY_SOCKET", socket).env("WATCHDOG_USEC", "400000");
        command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
    };
    let mut child = ground(&path);
    supervisor.wait_for("READY=1\nSTATUS=0 senders connected");
    supervisor.wait_for("WATCHDOG=1");
    supervisor.wait_for("STATUS=0 senders connected, 0 bytes received, 0 maps published");
    signal(&child, "TERM");
    supervisor.wait_for("STOPPING=1");
    // Nothing was received: there is no map to be made, and that is the end it reports.
    end(&mut child);
    let readies = supervisor.messages.iter().filter(|message| message.contains("READY=1")).count();
    assert_eq!(readies, 1, "{:?}", supervisor.messages);
    // A socket that is not there is of no consequence.
    let mut child = ground(&place.path("nobody"));
    std::thread::sleep(Duration::from_millis(300));
    assert!(child.try_wait().unwrap().is_none());
    signal(&child, "TERM");
    end(&mut child);
}

/// Names that begin with `lunarray_` in a text.
fn metrics_in(text: &str) -> BTreeSet<String> {
    let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let words = text.split(|c: char| !is_name(c)).filter(|word| word.starts_with("lunarray_"));
    words.map(str::to_owned).collect()
}

#[test]
fn dashboard_and_alerts_name_metrics_that_exist() {
    let place = Place::new();
    // A ground that listens and keeps a state has all but the solver's, which are there while it iterates.
    let file = place.downlink("packets");
    let (out, state) = (place.path("out"), place.path("state"));
    let stations = place.secret("stations", "urumqi 0123456789abcdef");
    let listen = ["replay", "--listen", "tcp://127.0.0.1:0", "--connections", "1", "--map", place.pipeline()];
    let more = ["--out", &out, "--state", &state, "--stations", &stations, "--serve-after"];
    let served = Served::start(&[&listen[..], &more].concat());
    let sent = [b"token 0123456789abcdef\n", std::fs::read(file).unwrap().as_slice()].concat();
    assert!(finish(TcpStream::connect(served.listening()).unwrap(), &sent).starts_with("taken "));
    served.wait_for_phase("ended");
    let text = served.get("/metrics").text();
    // Zeros are exported, too: Prometheus needs a starting value to see an increase.
    for (end, count) in [("whole", 1), ("no-token", 0), ("unknown-token", 0)] {
        assert!(
            text.contains(&format!("lunarray_senders_ended_total{{end=\"{end}\"}} {count}\n")),
            "{end}: {text}"
        );
    }
    let mut known = metrics_in(&text);
    let collector = ours("src/app/serve/prometheus.rs");
    // Those of the solver, and of a ground that takes datagrams.
    let elsewhere = [
        ("solver_residual", "ratios"),
        ("solver_target", "ratios"),
        ("solver_iteration", ""),
        ("datagrams", "total"),
    ];
    for (name, unit) in elsewhere {
        assert!(collector.contains(&format!("\"{name}\"")));
        known.insert(format!("lunarray_{name}_{unit}").trim_end_matches('_').to_owned());
    }
    for path in ["docs/deploy/grafana.json", "docs/deploy/alerts.yml", "docs/live.md"] {
        let named = metrics_in(&ours(path));
        assert!(named.len() > 5, "{path}: {named:?}");
        let unknown: Vec<&String> = named.difference(&known).collect();
        assert!(unknown.is_empty(), "{path} names {unknown:?}, which /metrics does not have");
    }
    let dashboard: Value = serde_json::from_str(&ours("docs/deploy/grafana.json")).unwrap();
    let panels = dashboard["panels"].as_array().unwrap();
    let ids: BTreeSet<u64> = panels.iter().map(|panel| panel["id"].as_u64().unwrap()).collect();
    assert_eq!(ids.len(), panels.len());
    // Labels that rules choose by have the values that they name.
    for label in ["phase=\"failed\"", "stage=\"ground\"", "kind=\"visibilities\""] {
        assert!(text.contains(label) && ours("docs/deploy/alerts.yml").contains(label), "{label}");
    }
    drop(served);
    // Each alert leads to its place in the runbook, and each place there is an alert's.
    let (rules, runbook) = (ours("docs/deploy/alerts.yml"), ours("docs/runbook.md"));
    let alerts: BTreeSet<&str> =
        rules.lines().filter_map(|line| line.trim().strip_prefix("- alert: ")).collect();
    let places: BTreeSet<&str> = runbook.lines().filter_map(|line| line.strip_prefix("## ")).collect();
    assert!(alerts.len() > 10);
    assert_eq!(alerts, places);
    for alert in alerts {
        assert!(
            rules.contains(&format!("runbook_url: \"docs/runbook.md#{}\"", alert.to_lowercase())),
            "{alert}"
        );
    }
}
