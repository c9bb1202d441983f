//! Files that several processes want to write.
#![cfg(unix)]

use std::fs::File;
use std::io::Write;
use std::path::Path;
use std::process::Command;

use super::common::process::{end, hidden, output, signal, start, wait_until};
use super::common::workplace::{SMALL, Workplace, fail, files, lunarray, succeed};

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
        assert_eq!(said.matches("expected").count(), 1, "{said}");
    }
    // No new state is left behind where there can be no products, nor where nothing can be heard.
    let state = place.path("state");
    let with_state = ["replay", "--map", &place.pipeline, "--state", &state, "--out"];
    assert!(fail(&[&with_state[..], &[&out, &file]].concat()).contains("in use"));
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("tcp://{}", taken.local_addr().unwrap());
    let other = place.path("other");
    assert!(fail(&[&with_state[..], &[&other, "--listen", &url]].concat()).contains("cannot listen"));
    assert!(!Path::new(&state).exists() && !Path::new(&other).exists());
    // What is no folder is said to be none, and is a configuration that cannot be used.
    let link = place.path("link");
    std::os::unix::fs::symlink(place.path("nothing"), &link).unwrap();
    let plain = place.file("plain", b"");
    for (name, what) in [(&plain, "not a folder"), (&link, "a link to nothing")] {
        let refused = lunarray(&[&with_state[..], &[name, &file]].concat());
        let said = String::from_utf8(refused.stderr).unwrap();
        assert!(refused.status.code() == Some(2) && said.contains(what) && said.contains(name), "{said}");
    }
    assert!(!Path::new(&state).exists());
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

/// That a command is refused with these words and leaves a file as it was.
fn spares(file: &str, args: &[&str], words: &str) {
    let before = std::fs::read(file).unwrap();
    let said = fail(args);
    assert!(said.contains(words), "{args:?}: {said}");
    assert!(std::fs::read(file).unwrap() == before, "{args:?}");
}

#[test]
fn outputs_never_replace_inputs() {
    let place = Workplace::new(SMALL);
    let (pipeline, out) = (place.pipeline.clone(), place.path("out"));
    let file = place.simulate("small.ccsds", &[]);
    let second = place.path("second-name.ccsds");
    std::fs::hard_link(&file, &second).unwrap();
    let map = place.path("map.fits");
    succeed(&["sky", &pipeline, "--freq-hz", "3e6", "--nside", "8", "--out", &map, "--no-picture"]);
    let words = "read as an input";
    let [picture, drawn] = ["of-file.png", "of-map.png"].map(|name| place.path(name));
    std::fs::hard_link(&file, &picture).unwrap();
    std::fs::hard_link(&map, &drawn).unwrap();
    spares(&file, &["gaps", &file, "--picture", &picture], words);
    for name in [&file, &second] {
        spares(&file, &["export", "visibilities", &file, "--out", name], words);
        spares(&file, &["replay", &file, "--map", &pipeline, "--out", &out, "--events", name], words);
    }
    spares(&file, &["corrupt", &file, "--out", &second, "--frame-loss", "0.1"], words);
    spares(&pipeline, &["simulate", &pipeline, "--out", &pipeline], words);
    spares(&pipeline, &["run", &pipeline, "--out", &out, "--events", &pipeline], words);
    spares(&map, &["export", "alm", &map, "--out", &map], words);
    spares(&map, &["cutout", &map, "--centre", "0,0", "--out", &drawn], words);
    spares(&file, &["corrupt", &file, "--out", &file, "--frame-loss", "0.1"], words);
    let ranges = place.file("ranges.txt", b"0x103 0 5\n");
    spares(&ranges, &["extract", &file, "--ranges", &ranges, "--out", &ranges], words);
    // Files that keys name.
    let gains = place.file("gains.json", b"{}");
    let sky = ["sky", &pipeline, "--freq-hz", "3e6", "--nside", "8", "--out"];
    let named =
        ["--set", "calibration.hook=antenna-gains", "--set", &format!("calibration.gains_file={gains:?}")];
    spares(&gains, &[&sky[..], &[&gains, "--no-picture"], &named].concat(), words);
    let other = place.path("other.fits");
    spares(&gains, &[&sky[..], &[&other, "--no-picture", "--sources", &gains], &named].concat(), words);
    // A sky that is read is none that is generated.
    let read = format!("sky.file={map:?}");
    spares(&map, &[&sky[..], &[&map, "--set", &read]].concat(), "this command generates the sky");
    spares(&map, &["sky", "--like", &map, "--correlation", "0.5", "--out", &map], words);
    // The user's own file in the folder of the products: before anything is computed.
    let folder = place.path("");
    spares(&pipeline, &["run", &pipeline, "--out", &folder], words);
    // What a run has left repeats it in its place.
    succeed(&["run", &pipeline, "--out", &out]);
    let left = format!("{out}/pipeline.toml");
    let before = std::fs::read(&left).unwrap();
    succeed(&["run", &left, "--out", &out]);
    assert!(std::fs::read(&left).unwrap() == before);
    spares(&left, &["run", &left, "--out", &out, "--set", "seed=8"], words);
    // A map of the folder as a prior: refused before it is replaced.
    let prior = format!("{out}/3.000MHz/map.fits");
    let set = format!("map.prior_files=[{prior:?}, {:?}]", format!("{out}/10.000MHz/map.fits"));
    spares(&prior, &["replay", &file, "--map", &pipeline, "--out", &out, "--set", &set], "would replace it");
}

#[test]
fn nothing_is_written_into_the_folder_of_a_state() {
    let place = Workplace::new(SMALL);
    let (pipeline, state, out) = (place.pipeline.clone(), place.path("state"), place.path("out"));
    let file = place.simulate("small.ccsds", &[]);
    let replay = ["replay", &file, "--map", &pipeline, "--state", &state, "--out"];
    // A folder of this name alone makes no state.
    std::fs::create_dir(place.path("archive")).unwrap();
    // Before there is a state.
    let [inside, events] = ["o", "events"].map(|name| format!("{state}/{name}"));
    assert!(fail(&[&replay[..], &[&inside]].concat()).contains("expected other folders"));
    assert!(fail(&[&replay[..], &[&out, "--events", &events]].concat()).contains("expected other folders"));
    assert!(!Path::new(&state).exists());
    succeed(&[&replay[..], &[&out]].concat());
    let before = files(Path::new(&state));
    let checkpoint = before.keys().find(|name| name.to_str().unwrap().contains("checkpoint-")).unwrap();
    let checkpoint = Path::new(&state).join(checkpoint).to_str().unwrap().to_owned();
    let picture = format!("{state}/x.png");
    for args in [
        &["replay", &file, "--map", &pipeline, "--state", &state, "--out", &out, "--events", &checkpoint][..],
        &["simulate", &pipeline, "--out", &checkpoint],
        &["export", "visibilities", &file, "--out", &checkpoint],
        &["corrupt", &file, "--out", &checkpoint],
        &["run", &pipeline, "--out", &inside],
        &["gaps", &state, "--picture", &picture],
        &["run", &pipeline, "--out", &state],
        &["sky", &pipeline, "--freq-hz", "3e6", "--out", &checkpoint],
    ] {
        let said = fail(args);
        assert!(said.contains("is the folder of a state; expected a name outside it"), "{args:?}: {said}");
    }
    assert!(files(Path::new(&state)) == before);
}

#[test]
fn a_link_in_the_folder_of_outputs_is_not_followed() {
    let place = Workplace::new(SMALL);
    let elsewhere = place.path("elsewhere");
    std::fs::create_dir_all(place.path("out")).unwrap();
    std::fs::create_dir(&elsewhere).unwrap();
    std::os::unix::fs::symlink(&elsewhere, place.path("out/small")).unwrap();
    let study =
        "name = \"small\"\npipeline = \"pipeline.toml\"\n[[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4]\n";
    let study = place.file("study.toml", study.as_bytes());
    for args in [&["study", &study][..], &["run", &place.pipeline]] {
        let mut command = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
        let ended = command.args(args).current_dir(place.path("")).output().unwrap();
        let said = String::from_utf8(ended.stderr).unwrap();
        assert!(!ended.status.success() && said.contains("out/small: it is a link to"), "{said}");
        assert_eq!(std::fs::read_dir(&elsewhere).unwrap().count(), 0, "{args:?}");
    }
}

#[test]
fn a_refused_name_is_wrong_usage() {
    let place = Workplace::new(SMALL);
    let (pipeline, out) = (place.pipeline.clone(), place.path("out"));
    let file = place.simulate("small.ccsds", &[]);
    let second = place.path("second.ccsds");
    std::fs::hard_link(&file, &second).unwrap();
    for args in [
        &["corrupt", &file, "--out", &file][..],
        &["corrupt", &file, "--out", &second],
        &["export", "visibilities", &file, "--out", &file],
        &["replay", &file, "--map", &pipeline, "--out", &out, "--events", &file],
        &["simulate", &pipeline, "--out", &pipeline],
    ] {
        let ended = output(start(args));
        let said = String::from_utf8(ended.stderr).unwrap();
        assert_eq!(ended.status.code(), Some(2), "{args:?}: {said}");
        assert_eq!(said.matches("; expected").count(), 1, "{said}");
    }
    // A folder that the system cannot make is a failure of the system, whatever was to be written.
    let below = format!("{file}/below");
    for args in [
        &["export", "visibilities", &file, "--out", &below][..],
        &["export", "orbits", "--set", "spacecraft.duration_s=100", "--out", &below],
        &["man", "--out", &below],
    ] {
        let ended = output(start(args));
        assert_eq!(ended.status.code(), Some(3), "{args:?}: {}", String::from_utf8_lossy(&ended.stderr));
    }
}

#[test]
fn a_signal_leaves_no_file_that_was_being_written() {
    let place = Workplace::new(SMALL);
    let (ranges, out) = (place.file("ranges.txt", b"0x103 0 5\n"), place.path("again.ccsds"));
    // It waits for its input, which does not end.
    let mut command = Command::new(assert_cmd::cargo::cargo_bin("lunarray"));
    command.args(["extract", "-", "--ranges", &ranges, "--out", &out]);
    let mut child = command.stdin(std::process::Stdio::piped()).spawn().unwrap();
    let folder = place.path("");
    wait_until("the beginning of a file", || !hidden(Path::new(&folder)).is_empty());
    signal(&child, "INT");
    assert_eq!(std::os::unix::process::ExitStatusExt::signal(&end(&mut child).0), Some(2));
    assert!(hidden(Path::new(&folder)).is_empty() && !Path::new(&out).exists());
}

#[test]
fn pictures_have_the_names_of_pictures() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("small.ccsds", &[]);
    let pipeline = place.pipeline.clone();
    spares(&pipeline, &["gaps", &file, "--picture", &pipeline], ".png or .svg");
    let map = place.path("map.fits");
    let sky = ["sky", &pipeline, "--freq-hz", "3e6", "--nside", "8", "--out"];
    succeed(&[&sky[..], &[&map, "--no-picture"]].concat());
    let text = place.path("m.txt");
    assert!(fail(&["cutout", &map, "--centre", "0,0", "--out", &text]).contains(".png or .svg"));
    assert!(fail(&["compare", &map, &map, "--plot", &text]).contains(".png or .svg"));
    assert!(!Path::new(&text).exists());
    // A map under the name of its picture, and a table under that of the map.
    let (picture, table) = (place.path("sky.png"), place.path("sky.fits"));
    assert!(fail(&[&sky[..], &[&picture]].concat()).contains("different names"));
    assert!(fail(&[&sky[..], &[&table, "--sources", &table]].concat()).contains("different names"));
    assert!(!Path::new(&picture).exists() && !Path::new(&table).exists());
}

#[test]
fn no_output_takes_the_place_of_another() {
    let place = Workplace::new(SMALL);
    let (pipeline, out, sent) = (place.pipeline.clone(), place.path("out"), place.path("sent.ccsds"));
    std::fs::create_dir(&out).unwrap();
    let summary = place.file("out/summary.json", b"of an earlier run");
    for name in ["summary.json", "downlink.ccsds", "pipeline.toml"] {
        let run = ["run", &pipeline, "--out", &out, "--events", &format!("{out}/../out/{name}")];
        assert!(fail(&run).contains("another output"), "{name}");
    }
    assert_eq!(std::fs::read(summary).unwrap(), b"of an earlier run");
    assert!(fail(&["simulate", &pipeline, "--out", &sent, "--events", &sent]).contains("another output"));
    assert!(!Path::new(&sent).exists());
    // Of a name that the command finds out later.
    let truth = format!("{sent}.truth.json");
    let set = ["--set", "downlink.link.frame_loss=0.1"];
    let said = fail(&[&["simulate", &pipeline, "--out", &sent, "--events", &truth], &set[..]].concat());
    assert!(said.contains("another output") && said.contains("truth.json"), "{said}");
    assert!(std::fs::read_to_string(truth).unwrap().contains("\"failed\""));
}

#[test]
fn events_take_the_place_of_an_older_file_and_follow_no_link() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("small.ccsds", &[]);
    let (victim, events, out) = (place.file("victim", b"precious"), place.path("events"), place.path("out"));
    std::os::unix::fs::symlink(&victim, &events).unwrap();
    let replay = ["replay", file.as_str(), "--map", &place.pipeline, "--out", &out, "--events", &events];
    spares(&victim, &replay, "is a link to");
    std::fs::remove_file(&events).unwrap();
    std::fs::hard_link(&victim, &events).unwrap();
    succeed(&replay);
    assert_eq!(std::fs::read(&victim).unwrap(), b"precious");
    let told = std::fs::read_to_string(&events).unwrap();
    assert!(told.lines().last().unwrap().contains("\"complete\""), "{told}");
    assert!(hidden(Path::new(&place.path(""))).is_empty());
}

#[test]
fn the_name_of_a_study_stays_in_the_folder_of_outputs() {
    let place = Workplace::new(SMALL);
    for name in ["../../evil", "/tmp/evil", "..", "a/b", ""] {
        let study = format!(
            "name = {name:?}\npipeline = \"pipeline.toml\"\n[[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4]\n"
        );
        let study = place.file("study.toml", study.as_bytes());
        let said = fail(&["study", &study]);
        assert!(said.contains("without slashes"), "{name}: {said}");
    }
}
