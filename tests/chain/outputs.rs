//! Files that several processes want to write.
#![cfg(unix)]

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::Command;

use super::common::process::{end, hidden, output, signal, start, wait_until};
use super::common::workplace::{SMALL, Workplace, fail, files, succeed};

#[test]
fn of_two_simulations_to_one_file_one_is_refused() {
    let place = Workplace::new(SMALL);
    let alone = std::fs::read(place.simulate("alone.ccsds", &[])).unwrap();
    let file = place.path("same.ccsds");
    for round in 0..3 {
        let children = [0, 1].map(|_| start(&["simulate", &place.pipeline, "--out", &file]));
        let outputs = children.map(output);
        let succeeded = outputs.iter().filter(|output| output.status.success()).count();
        // If one has ended before the other begins, both write.
        assert!(succeeded >= 1, "round {round}: {outputs:?}");
        for output in outputs.iter().filter(|output| !output.status.success()) {
            let said = String::from_utf8_lossy(&output.stderr);
            assert!(
                said.contains("same.ccsds: ") && said.contains("another process is writing it"),
                "{said}"
            );
        }
        assert!(std::fs::read(&file).unwrap() == alone, "round {round}");
        assert!(hidden(Path::new(&file).parent().unwrap()).is_empty());
        std::fs::remove_file(&file).unwrap();
    }
}

#[test]
fn a_folder_of_products_has_one_writer() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("small.ccsds", &[]);
    let pipe = place.path("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let out = place.path("out");
    // The first one waits for more from a pipe.
    let mut first = start(&["replay", &pipe, "--map", &place.pipeline, "--out", &out]);
    let mut feed = File::options().write(true).open(&pipe).unwrap();
    feed.write_all(&std::fs::read(&file).unwrap()).unwrap();
    wait_until("its lock", || Path::new(&out).join(".lock").exists());
    for args in [
        &["replay", &file, "--map", &place.pipeline, "--out", &out][..],
        &["run", &place.pipeline, "--out", &out],
    ] {
        let said = fail(args);
        assert!(said.contains(&out) && said.contains("in use by another process"), "{said}");
    }
    drop(feed);
    assert!(end(&mut first).0.success());
    // As if nothing had been.
    let (kept, alone) = (files(Path::new(&out)), place.path("alone"));
    succeed(&["replay", &file, "--map", &place.pipeline, "--out", &alone]);
    assert!(kept == files(Path::new(&alone)));
    succeed(&["replay", &file, "--map", &place.pipeline, "--out", &out]);
}

#[test]
fn a_planted_link_is_not_followed() {
    let place = Workplace::new(SMALL);
    let victim = place.file("victim", b"precious");
    std::os::unix::fs::symlink(&victim, place.path("small.ccsds.partial")).unwrap();
    place.simulate("small.ccsds", &[]);
    assert_eq!(std::fs::read(&victim).unwrap(), b"precious");
}

#[test]
fn what_a_kill_leaves_is_removed_by_the_next() {
    let place = Workplace::new(SMALL);
    let (folder, pipeline) = (place.path("new"), &place.pipeline);
    let file = format!("{folder}/small.ccsds");
    let long = ["--set", "spacecraft.every_nth_window=1", "--set", "sky.nside=64"];
    let mut child = start(&[&["simulate", pipeline, "--out", &file][..], &long].concat());
    wait_until("a file", || !hidden(Path::new(&folder)).is_empty());
    signal(&child, "KILL");
    end(&mut child);
    // It may have been the first look at the folder, which leaves nothing.
    assert!(hidden(Path::new(&folder)).len() <= 1);
    succeed(&["simulate", pipeline, "--out", &file]);
    assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
}
