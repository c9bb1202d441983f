//! A ground that remembers: every packet once, whatever comes twice, late, or is ended by force.
#![allow(clippy::unwrap_used, clippy::panic)] // Also in the helpers.

#[path = "../common/mod.rs"]
mod common;

mod damage;
mod ending;
#[cfg(target_os = "linux")] // How calls of the system are caught differs elsewhere.
mod faults;
mod forged;
mod gaps;
mod kill;
mod merge;
mod model;
mod order;
mod refined;
mod retract;

use std::path::{Path, PathBuf};

use common::workplace::{SMALL, Workplace, json};
use serde_json::Value;

/// The two engines, each with what is to be added to the pipeline.
///
/// Solutions of the harmonic engine go on to where they depend on the sums alone, not on where the iteration ends.
const ENGINES: [(&str, &str); 2] =
    [("pixel", ""), ("harmonic", "[map]\nengine = \"harmonic\"\nresidual_max = 1e-9")];

/// Less than the downlink holds, so that not all that follows a gap waits to the end.
const WAIT_BYTES: &str = "100000";

/// A ground in a folder of its own.
struct Ground(Workplace);

impl std::ops::Deref for Ground {
    type Target = Workplace;

    fn deref(&self) -> &Workplace {
        &self.0
    }
}

impl Ground {
    fn new() -> Self {
        Self::with("")
    }

    /// With one more line for the section `[map]`.
    fn with(engine: &str) -> Self {
        Self(Workplace::new(&SMALL.replace(
            "[map]\nengine = 'pixel'",
            if engine.is_empty() { "[map]\nengine = 'pixel'" } else { engine },
        )))
    }

    fn downlink(&self) -> String {
        self.simulate("small.ccsds", &[])
    }

    /// Arguments of a session.
    fn session(&self, state: &str, files: &[&str], more: &[&str]) -> Vec<String> {
        let (out, state) = (self.path(&format!("{state}.out")), self.path(state));
        let fixed = ["--map", &self.pipeline, "--out", &out, "--state", &state, "--json"];
        let wait = ["--wait-bytes", WAIT_BYTES];
        let wait = if more.contains(&"--wait-bytes") { &[] } else { wait.as_slice() };
        let all = [&["replay"], files, &fixed, wait, more].concat();
        all.into_iter().map(str::to_owned).collect()
    }

    fn output(&self, state: &str, files: &[&str], more: &[&str]) -> std::process::Output {
        let args = self.session(state, files, more);
        // No map of an earlier session is taken for one of this.
        let _ = std::fs::remove_dir_all(self.path(&format!("{state}.out")));
        common::workplace::lunarray(&args.iter().map(String::as_str).collect::<Vec<_>>())
    }

    fn replay(&self, state: &str, files: &[&str], more: &[&str]) -> Value {
        let output = self.output(state, files, more);
        assert!(output.status.success(), "{}", String::from_utf8(output.stderr).unwrap());
        serde_json::from_slice(&output.stdout).unwrap()
    }

    fn gaps(&self, state: &str) -> Value {
        json(&["gaps", &self.path(state)])
    }

    /// The newest checkpoint of a state.
    fn newest(&self, state: &str) -> PathBuf {
        checkpoints(Path::new(&self.path(state))).pop().unwrap()
    }

    fn bytes(&self, state: &str) -> Vec<u8> {
        std::fs::read(self.newest(state)).unwrap()
    }

    /// All of the newest checkpoint but the engines: packets, journal, accounts, positions.
    fn head(&self, state: &str) -> Vec<u8> {
        let bytes = self.bytes(state);
        let length = u64::from_le_bytes(*bytes[8..].first_chunk().unwrap());
        bytes[16..16 + length as usize].to_vec()
    }

    fn maps(&self, state: &str) -> Vec<Vec<u8>> {
        let maps = common::workplace::maps(&self.path(&format!("{state}.out")));
        maps.into_iter().filter(|(path, _)| path.ends_with("map.fits")).map(|(_, bytes)| bytes).collect()
    }
}

/// The checkpoints in a folder, oldest first.
fn checkpoints(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten();
    let mut found: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    found.retain(|path| path.extension().is_some_and(|extension| extension == "lunarray"));
    found.sort();
    found
}

/// Number and kind of a packet: its sequence count and application process identifier.
fn identity(packet: &[u8]) -> (u16, u64) {
    let word = |at: usize| u16::from_be_bytes([packet[at], packet[at + 1]]);
    (word(0) & 0x7FF, u64::from(word(2) & 0x3FFF))
}

/// Identifier of packets of visibilities.
const VISIBILITIES: u16 = 0x103;

/// The packets of a downlink file.
fn packets(file: &str) -> Vec<Vec<u8>> {
    common::downlink::packets_of(&std::fs::read(file).unwrap())
}

/// A file without the visibility packets of these counts.
fn leave_out(file: &str, counts: std::ops::Range<u64>) -> Vec<u8> {
    let is_kept = |packet: &Vec<u8>| {
        let (apid, count) = identity(packet);
        apid != VISIBILITIES || !counts.contains(&count)
    };
    packets(file).into_iter().filter(is_kept).collect::<Vec<_>>().concat()
}
