//! Commands that run while the test does something to them.

use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

/// Longest time that a test waits for anything, on however busy a machine.
const PATIENCE: Duration = Duration::from_secs(300);

/// Starts the command with its outputs in pipes.
pub fn start(args: &[&str]) -> Child {
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
    command.args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap()
}

/// The address on which a ground says that it listens; what it says later is read and dropped.
pub fn listening(child: &mut Child) -> String {
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let url = loop {
        // It fails here if the ground ends before it listens.
        let line = lines.next().unwrap().unwrap();
        if let Some(url) = line.strip_prefix("listening on ") {
            break url.to_owned();
        }
    };
    std::thread::spawn(move || lines.for_each(drop));
    url
}

/// Sends a signal such as `INT`.
pub fn signal(child: &Child, name: &str) {
    let sent = Command::new("kill").args([&format!("-{name}"), &child.id().to_string()]).status();
    assert!(sent.unwrap().success(), "kill -{name}");
}

/// Waits until `is_so`.
pub fn wait_until(what: &str, mut is_so: impl FnMut() -> bool) {
    let since = Instant::now();
    while !is_so() {
        assert!(since.elapsed() < PATIENCE, "waited in vain: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Waits for the end; returns the status, and how long it took.
pub fn end(child: &mut Child) -> (ExitStatus, Duration) {
    let since = Instant::now();
    wait_until("the end", || child.try_wait().unwrap().is_some());
    (child.wait().unwrap(), since.elapsed())
}

/// Waits for the end, and returns what was printed.
pub fn output(mut child: Child) -> Output {
    let mut readers = Vec::new();
    for pipe in [
        child.stdout.take().map(|pipe| Box::new(pipe) as Box<dyn Read + Send>),
        child.stderr.take().map(|pipe| Box::new(pipe) as Box<dyn Read + Send>),
    ] {
        readers.push(std::thread::spawn(move || {
            let mut bytes = Vec::new();
            pipe.map(|mut pipe| pipe.read_to_end(&mut bytes));
            bytes
        }));
    }
    let (status, _) = end(&mut child);
    let mut read = readers.into_iter().map(|reader| reader.join().unwrap());
    let (stdout, stderr) = (read.next().unwrap(), read.next().unwrap());
    Output { status, stdout, stderr }
}

/// Files in a folder of which the names begin with `.`: locks, and what is being written.
pub fn hidden(folder: &Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let is_hidden = |path: &std::path::PathBuf| {
        path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'))
    };
    entries.map(|entry| entry.path()).filter(is_hidden).collect()
}

/// Bytes that were written so far of the file `name` in a folder.
pub fn written(folder: &Path, name: &str) -> u64 {
    let start = format!(".{name}.");
    let is_its = |path: &std::path::PathBuf| {
        path.file_name().is_some_and(|found| found.to_string_lossy().starts_with(&start))
    };
    let lengths = hidden(folder).into_iter().filter(is_its).filter_map(|path| std::fs::metadata(path).ok());
    lengths.map(|found| found.len()).max().unwrap_or(0)
}
