//! Files as other programs write them, each with what is right: `fixtures/foreign`.

use crate::common;

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use common::workplace::{Workplace, fail, json, lunarray};

/// Few visibilities of an array that any map serves.
const PIPELINE: &str = r#"
name = "foreign"
[spacecraft]
channels_hz = [10.0e6]
every_nth_window = 300
baseline_wavelengths_max = 16.0
[products]
pictures = false
"#;

const BESIDE: [&str; 4] = ["make.py", "mate_2.oem", "mate_3.oem", "verdicts.csv"];

/// What is right of a file: a line of the table.
struct Verdict<'a> {
    file: &'a str,
    kind: &'a str,
    /// Whether the map states its frequency, from which it is scaled.
    is_scaled: bool,
    is_read: bool,
    says: &'a str,
}

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/foreign")
}

fn verdicts(table: &str) -> Vec<Verdict<'_>> {
    table
        .lines()
        .skip(1)
        .map(|line| {
            let [file, kind, frequency, verdict, says, by] = line.split(',').collect::<Vec<_>>()[..] else {
                panic!("{line}: expected six cells")
            };
            assert!(["read", "refused"].contains(&verdict) && !says.is_empty() && !by.is_empty(), "{line}");
            Verdict { file, kind, is_scaled: frequency == "scaled", is_read: verdict == "read", says }
        })
        .collect()
}

/// A FITS file of cards, one a line, and of `VALUES` of big-endian floats.
fn fits_of(cards: &str) -> Vec<u8> {
    let mut bytes = Vec::new();
    let is_double = cards.contains("'1D ");
    for line in cards.lines() {
        match line.strip_prefix("VALUES") {
            Some(values) => values.split_whitespace().for_each(|value| match is_double {
                true => bytes.extend(value.parse::<f64>().unwrap().to_be_bytes()),
                false => bytes.extend(value.parse::<f32>().unwrap().to_be_bytes()),
            }),
            None => bytes.extend(format!("{line:80}").bytes()),
        }
        if line == "END" {
            bytes.resize(bytes.len().next_multiple_of(2880), b' ');
        }
    }
    bytes.resize(bytes.len().next_multiple_of(2880), 0);
    bytes
}

/// The orbit is at its place five minutes after its beginning, whatever axes and times its file has.
fn check_orbit(verdict: &Verdict<'_>, path: &str) {
    let mates = ["mate_2.oem", "mate_3.oem"].map(|mate| folder().join(mate));
    let oem = format!("array.oem=['{path}', '{}', '{}']", mates[0].display(), mates[1].display());
    let arguments = [
        "geometry",
        "--at",
        "2027-03-01T00:05:00Z",
        "--set",
        "array.satellites=3",
        "--set",
        &oem,
        "--set",
        "spacecraft.duration_s=300",
    ];
    if !verdict.is_read {
        return check_words(verdict, &fail(&arguments));
    }
    let found = json(&arguments);
    for (k, expected) in verdict.says.split(' ').enumerate() {
        let difference_m = found["satellites_m"][0][k].as_f64().unwrap() - expected.parse::<f64>().unwrap();
        // The table has decimetres; the files have millimetres, and times of a millisecond or better, 1.6 m: exact here.
        assert!(difference_m.abs() < 0.1, "{}: {difference_m} m in coordinate {k}", verdict.file);
    }
}

fn check_words(verdict: &Verdict<'_>, told: &str) {
    for words in verdict.says.split(" | ") {
        assert!(told.contains(words), "{}: `{words}` is not in: {told}", verdict.file);
    }
}

/// What a command tells of a file that it reads or refuses.
fn check_command(verdict: &Verdict<'_>, arguments: &[&str]) {
    let output = lunarray(arguments);
    let told = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).concat();
    assert_eq!(output.status.success(), verdict.is_read, "{}: {told}", verdict.file);
    check_words(verdict, &told);
}

#[test]
fn files_of_others_are_read_or_refused_as_is_right() {
    let table = fs::read_to_string(folder().join("verdicts.csv")).unwrap();
    let verdicts = verdicts(&table);
    let place = Workplace::new(PIPELINE);
    let sky = place.file("sky.fits", &fits_of(&fs::read_to_string(folder().join("map_ulsa.cards")).unwrap()));
    for verdict in &verdicts {
        let path = folder().join(verdict.file);
        assert!(path.exists(), "{} is missing", verdict.file);
        let path = path.to_str().unwrap();
        match verdict.kind {
            "orbit" => check_orbit(verdict, path),
            "map" => {
                let map = place.file("map.fits", &fits_of(&fs::read_to_string(path).unwrap()));
                let file = format!("sky.file='{map}'");
                let scaled = ["--set", "sky.frequency={ spectral_index = -2.5 }"];
                let sets = if verdict.is_scaled { &scaled[..] } else { &[] };
                check_command(verdict, &[&["check", &place.pipeline, "--set", &file][..], sets].concat());
            }
            "catalogue" => {
                let (file, added) =
                    (format!("sky.file='{sky}'"), format!("sky.added={{ catalogue = '{path}' }}"));
                let sets = ["--set", &file, "--set", &added, "--set", "sky.nside=4"];
                check_command(verdict, &[&["check", &place.pipeline][..], &sets].concat());
            }
            "stream" => check_command(verdict, &["inspect", path]),
            kind => panic!("{}: no such kind: {kind}", verdict.file),
        }
    }
    let listed: BTreeSet<String> = verdicts.iter().map(|verdict| verdict.file.to_owned()).collect();
    assert_eq!(listed.len(), verdicts.len(), "a file is there twice");
    let found =
        fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let found: BTreeSet<String> = found.filter(|name| !BESIDE.contains(&name.as_str())).collect();
    assert_eq!(found, listed, "each file has a verdict");
}

#[test]
fn points_are_described_as_they_are_understood() {
    let place = Workplace::new(PIPELINE);
    let points = place.file("points.csv", b"name,ra,dec,S74,alpha\nA,10,20,3,0.7\nB,11,21,4,0.8\n");
    let set = format!("sky.points='{points}'");
    let output = lunarray(&["check", &place.pipeline, "--set", &set]);
    let told = [output.stdout, output.stderr].map(|bytes| String::from_utf8(bytes).unwrap()).concat();
    for part in [
        "sky.points: ",
        "2 sources, equatorial positions, flux `S74` (Jy) at 74 MHz, 7.0000e0 Jy together",
        "2 of 2 spectral indices `alpha` are above 0",
    ] {
        assert!(told.contains(part), "{part}: {told}");
    }
}
