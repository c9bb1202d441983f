//! A listening ground, a sending spacecraft, and paced replays: the same bits as through a file.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)] // Also in the helpers.

mod alerts;
mod archive;
mod broker;
#[path = "../common/mod.rs"]
mod common;
mod crowd;
mod datagrams;
mod durable;
mod events;
mod kills;
mod log;
mod pace;
mod page;
mod panels;
mod restart;
mod senders;
mod service;
mod serving;
mod soak;
mod stations;
mod terminal;
#[cfg(unix)]
mod tokens;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command as Process, ExitStatus, Stdio};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use common::downlink::{mission, packets_of, pass_ends, transmit};
use common::schema::check_summary;
use common::workplace::{SMALL, Workplace, fail, lunarray, succeed};
use lunarray::downlink::transport::socket::{ListenConfig, ListenLimits, SocketSource};
use lunarray::downlink::{
    CucTime, DownlinkConfig, FORMAT_VERSION, PACKET_BYTES_MAX, PacketHeader, PacketKind, PacketSegment,
};
use lunarray::runtime::{Flow, Outlet, Source};
use serde_json::Value;

/// A pipeline in a folder, and the grounds' outputs.
struct Place {
    workplace: Workplace,
}

impl Place {
    fn new() -> Self {
        Self { workplace: Workplace::new(SMALL) }
    }

    fn path(&self, name: &str) -> String {
        self.workplace.path(name)
    }

    fn pipeline(&self) -> &str {
        &self.workplace.pipeline
    }

    fn downlink(&self, format: &str) -> String {
        self.workplace.simulate(&format!("small.{format}"), &["--format", format])
    }

    /// Replays a file; returns the summary.
    fn replay(&self, name: &str, file: &str, more: &[&str]) -> Value {
        let out = self.path(name);
        let fixed = ["replay", file, "--map", self.pipeline(), "--out", &out, "--json"];
        let summary = serde_json::from_str(&succeed(&[&fixed, more].concat())).unwrap();
        check_summary(&summary);
        summary
    }

    /// Starts a listening ground.
    fn ground(&self, name: &str, more: &[&str]) -> Ground {
        let out = self.path(name);
        let listen =
            if more.contains(&"--listen") { &[] } else { ["--listen", "tcp://127.0.0.1:0"].as_slice() };
        let fixed = ["replay", "--map", self.pipeline(), "--out", &out, "--json"];
        Ground::start(&[&fixed, listen, more].concat())
    }

    /// A file that nobody else can read.
    #[cfg(unix)]
    fn secret(&self, name: &str, text: &str) -> String {
        use std::os::unix::fs::PermissionsExt;
        let path = self.workplace.file(name, text.as_bytes());
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
        path
    }

    fn maps(&self, name: &str) -> Vec<Vec<u8>> {
        let mut folders: Vec<PathBuf> = std::fs::read_dir(self.path(name))
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(|path| path.is_dir())
            .collect();
        folders.sort();
        assert!(!folders.is_empty());
        folders.iter().map(|folder| std::fs::read(folder.join("map.fits")).unwrap()).collect()
    }

    /// The newest checkpoint of a state.
    fn checkpoint(&self, state: &str) -> Vec<u8> {
        let entries = std::fs::read_dir(self.path(state)).unwrap();
        let mut found: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
        found.retain(|path| path.extension().is_some_and(|extension| extension == "lunarray"));
        std::fs::read(found.iter().max().unwrap()).unwrap()
    }
}

fn complaint(args: &[&str]) -> String {
    let text = fail(args);
    assert!(!text.contains("panicked"), "{args:?}: {text}");
    text
}

/// A process that listens.
struct Ground {
    child: Child,
    url: String,
    said: Arc<Mutex<String>>,
    reader: JoinHandle<()>,
}

impl Ground {
    fn start(args: &[&str]) -> Self {
        let mut command = Process::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let mut child = command.args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
        let said = Arc::new(Mutex::new(String::new()));
        let note = |said: &Arc<Mutex<String>>, line: &str| *said.lock().unwrap() += &format!("{line}\n");
        let url = loop {
            let line = lines.next().expect("the ground ended before it listened").unwrap();
            note(&said, &line);
            if let Some(url) = line.strip_prefix("listening on ") {
                break url.to_owned();
            }
        };
        let shared = Arc::clone(&said);
        let reader = std::thread::spawn(move || lines.for_each(|line| note(&shared, &line.unwrap())));
        Self { child, url, said, reader }
    }

    fn connect(&self) -> TcpStream {
        TcpStream::connect(self.url.strip_prefix("tcp://").unwrap()).unwrap()
    }

    /// Sends everything, closes, and returns the answer.
    fn send(&self, bytes: &[u8]) -> String {
        finish(self.connect(), bytes)
    }

    /// Peak memory, bytes.
    fn memory(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
        1024 * line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap()
    }

    fn wait_for(&self, text: &str) {
        let since = Instant::now();
        while !self.said.lock().unwrap().contains(text) {
            assert!(
                since.elapsed() < Duration::from_secs(60),
                "no `{text}` in {}",
                self.said.lock().unwrap()
            );
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for its end: status, summary, messages.
    fn end(mut self) -> (ExitStatus, Value, String) {
        let mut text = String::new();
        self.child.stdout.take().unwrap().read_to_string(&mut text).unwrap();
        let status = self.child.wait().unwrap();
        self.reader.join().unwrap();
        let said = self.said.lock().unwrap().clone();
        let summary = serde_json::from_str(&text).unwrap_or_else(|_| panic!("{text}{said}"));
        check_summary(&summary);
        (status, summary, said)
    }

    fn end_without_summary(mut self) -> (ExitStatus, String) {
        let status = self.child.wait().unwrap();
        self.reader.join().unwrap();
        let said = self.said.lock().unwrap().clone();
        (status, said)
    }

    fn succeed(self) -> Value {
        let (status, summary, said) = self.end();
        assert!(status.success(), "{said}");
        summary
    }
}

/// Sends the rest, closes, and returns the answer.
fn finish(mut stream: TcpStream, bytes: &[u8]) -> String {
    stream.write_all(bytes).unwrap();
    stream.shutdown(Shutdown::Write).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

/// Every byte of packets is accounted for.
fn assert_closed(reception: &Value) {
    let of = |key: &str| reception[key].as_u64().unwrap();
    let kinds = ["instrument", "ephemeris", "visibilities", "calibration", "housekeeping"];
    let packets: u64 = kinds.iter().map(|kind| reception[kind]["bytes"].as_u64().unwrap()).sum();
    let others = ["bytes_garbage", "bytes_truncated", "bytes_damaged", "bytes_duplicate", "bytes_beyond"];
    let others: u64 = others.iter().map(|key| of(key)).sum();
    assert_eq!(of("bytes"), packets + others, "{reception}");
}
