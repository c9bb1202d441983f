//! The command in a folder of its own.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use serde_json::Value;

use super::schema::check_summary;

/// Real geometry, two channels, few visibilities.
pub const SMALL: &str = r#"
name = "small"
seed = 7
[sky]
nside = 8
[spacecraft]
channels_hz = [3.0e6, 10.0e6]
every_nth_window = 300
every_nth_integration = 2
baseline_wavelengths_max = 16.0
[downlink]
packet_bytes_max = 2048
[map]
engine = 'pixel'
nside = 4
epsilon = 1e-4
[products]
pictures = false
"#;

/// A folder with a pipeline file in it.
pub struct Workplace {
    folder: tempfile::TempDir,
    pub pipeline: String,
}

impl Workplace {
    pub fn new(pipeline: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipeline.toml");
        std::fs::write(&path, pipeline).unwrap();
        Self { pipeline: path.to_str().unwrap().to_owned(), folder }
    }

    pub fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    /// A file of these bytes.
    pub fn file(&self, name: &str, bytes: &[u8]) -> String {
        let path = self.path(name);
        std::fs::write(&path, bytes).unwrap();
        path
    }

    /// The pipeline's downlink.
    pub fn simulate(&self, name: &str, more: &[&str]) -> String {
        let file = self.path(name);
        succeed(&[&["simulate", self.pipeline.as_str(), "--out", &file], more].concat());
        file
    }
}

pub fn lunarray(args: &[&str]) -> std::process::Output {
    Command::cargo_bin("lunarray").unwrap().args(args).output().unwrap()
}

/// What a command prints that must succeed.
pub fn succeed(args: &[&str]) -> String {
    let output = lunarray(args);
    assert!(output.status.success(), "{args:?}: {}", String::from_utf8(output.stderr).unwrap());
    String::from_utf8(output.stdout).unwrap()
}

/// What a command says that must fail.
pub fn fail(args: &[&str]) -> String {
    let output = lunarray(args);
    assert!(!output.status.success(), "{args:?}: {}", String::from_utf8(output.stdout).unwrap());
    String::from_utf8(output.stderr).unwrap()
}

/// What a command prints with --json. The summary of a run is held to its schema.
pub fn json(args: &[&str]) -> Value {
    let found = serde_json::from_str(&succeed(&[args, &["--json"]].concat())).unwrap();
    if ["run", "replay"].contains(&args[0]) {
        check_summary(&found);
    }
    found
}

/// All files below a folder but the summary, which holds times, by their paths in it.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if !["summary.json", "pipeline.toml"].map(OsStr::new).contains(&path.file_name().unwrap())
            {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(path).unwrap());
            }
        }
    }
    assert!(!found.is_empty());
    found
}

/// The maps below a folder, and the noise maps.
pub fn maps(folder: &str) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = files(Path::new(folder));
    found.retain(|path, _| path.extension().is_some_and(|ending| ending == "fits"));
    assert!(!found.is_empty());
    found
}
