//! What people type first: standard input and output, files of another kind, values with units.

use std::process::Output;

use assert_cmd::Command;
use serde_json::Value;

use super::common::workplace::{SMALL, Workplace, fail, lunarray, succeed};

/// A command with something on its standard input.
fn with_input(args: &[&str], input: &[u8]) -> Output {
    Command::cargo_bin("lunarray").unwrap().args(args).write_stdin(input).output().unwrap()
}

#[test]
fn a_dash_is_standard_input_and_output() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("sent.ccsds", &[]);
    let bytes = std::fs::read(&file).unwrap();

    let of_file: Value = serde_json::from_str(&succeed(&["inspect", &file, "--json"])).unwrap();
    let piped = with_input(&["inspect", "-", "--json"], &bytes);
    let mut of_pipe: Value = serde_json::from_slice(&piped.stdout).unwrap();
    of_pipe["file"] = of_file["file"].clone();
    assert_eq!(of_pipe, of_file);
    assert!(with_input(&["check", "-"], SMALL.as_bytes()).status.success());

    let table = place.path("table.csv");
    succeed(&["export", "visibilities", &file, "--channel", "1", "--out", &table]);
    let table = std::fs::read(table).unwrap();
    assert!(table.len() > 1000);
    let piped = with_input(&["export", "visibilities", "-", "--channel", "1", "--out", "-"], &bytes);
    assert!(piped.stdout == table, "{}", String::from_utf8_lossy(&piped.stderr));
}

#[test]
fn what_has_no_name_is_not_written_to_a_file_named_dash() {
    let place = Workplace::new(SMALL);
    let file = place.simulate("sent.ccsds", &[]);
    for args in [
        vec!["run", &place.pipeline, "--out", "-"],
        vec!["replay", &file, "--out", "-"],
        vec!["corrupt", &file, "--out", "-"],
        vec!["export", "visibilities", &file, "--out", "-", "--json"],
        vec!["export", "alm", "map.fits", "--out", "-"],
    ] {
        let said = fail(&args);
        assert!(said.contains("./-") || said.contains("--json with --out -"), "{args:?}: {said}");
    }
    // Only a downlink goes to standard output, with the bytes of the file.
    let said = lunarray(&["simulate", &place.pipeline, "--out", "-"]);
    assert!(said.status.success() && said.stdout == std::fs::read(&file).unwrap());
    assert!(!std::path::Path::new("-").exists());
}

#[test]
fn a_file_of_another_kind_is_told_with_the_command_that_takes_it() {
    let place = Workplace::new(SMALL);
    let downlink = place.simulate("sent.ccsds", &[]);
    let study = place.file("study.toml", b"[[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4]\n");
    for command in ["run", "check"] {
        let said = fail(&[command, &downlink]);
        assert!(said.contains("not text in UTF-8; expected a pipeline file") && said.contains("inspect"), "{said}");
        let said = fail(&[command, &study]);
        assert!(said.contains("a study, with [[axis]]") && said.contains("lunarray study"), "{said}");
    }
    // Studies without axes too.
    for name in ["noise/realisations.toml", "calibration/known-sky.toml"] {
        let study = format!("{}/pipelines/{name}", env!("CARGO_MANIFEST_DIR"));
        let said = fail(&["check", &study]);
        assert!(said.contains(&format!("{name}: a study, with ")), "{said}");
        assert!(said.contains("lunarray study") && !said.contains("no such key"), "{said}");
    }
    let said = fail(&["study", &place.pipeline]);
    assert!(said.contains("a pipeline; expected a study") && said.contains("lunarray run"), "{said}");
    // A mistake in a study is shown as such.
    let study = place.file("study.toml", b"[[axis]]\nkey = \"map.epsilon\"\nvaluse = [1e-4]\n");
    let said = fail(&["study", &study]);
    assert!(said.contains("valuse") && !said.contains("\n;"), "{said}");
}

#[test]
fn frequencies_and_lengths_are_told_with_units() {
    let said = fail(&["geometry", "--at", "0", "--freq-hz", "300MHz"]);
    assert!(said.contains("--freq-hz 300 MHz: expected 100 kHz to 30 MHz"), "{said}");
    let said = fail(&["check", "--set", "spacecraft.channels_hz=45MHz"]);
    assert!(said.contains("expected 100 kHz to 30 MHz"), "{said}");
    // 300 where 300km was meant.
    let noted = lunarray(&["check", "--set", "array.altitude_m=300"]);
    let noted = String::from_utf8(noted.stderr).unwrap();
    assert!(noted.contains("an orbit 300 m above the Moon"), "{noted}");
    // Lengths that no orbit of the Moon, or no formation on it, has.
    for (set, part) in [
        ("array.altitude_m=1e300", "array.altitude_m = 1e300: expected above 0 and at most 1e8 m"),
        (
            "array.breathing.span_m_max=7000km",
            "array.breathing.span_m_max = 7000000: expected m, above 0 and up to half",
        ),
    ] {
        let said = fail(&["check", "--set", set]);
        assert!(said.contains(part) && said.lines().all(|line| line.len() < 200), "{said}");
    }
    let said = fail(&["check", "--memory-max", "1kB"]);
    assert!(said.contains("but 1000 bytes are available"), "{said}");
}

#[test]
fn keys_are_found_by_what_is_said_of_them() {
    let found = succeed(&["explain", "Remazeilles"]);
    assert!(found.starts_with("sky.generated.small_scale_amplitude"), "{found}");
}

/// A device on which every write fails for want of room.
#[cfg(target_os = "linux")]
#[test]
fn a_full_standard_output_is_named() {
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let program = assert_cmd::cargo::cargo_bin("lunarray");
    for args in [&["geometry", "--at", "0"][..], &["explain", "map", "--json"], &["config"]] {
        let mut command = std::process::Command::new(&program);
        let output = command.args(args).stdout(full.try_clone().unwrap()).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(said.contains("standard output: cannot write: No space left"), "{args:?}: {said}");
    }
}
