//! Studies: one simulation, many solutions.

use std::path::Path;

use lunarray::pipeline::Study;
use serde_json::Value;

use super::common::workplace::{SMALL, Workplace, fail, json, succeed};

/// Two epsilons and two limits of the baselines, each in cases of its own.
const STUDY: &str = r#"
name = "both"
pipeline = "pipeline.toml"
set = ["map.trace_probes=4"]
[[axis]]
cases = [
    { label = "b < b_p", set = ["map.baseline_bp_max=1.0"] },
    { label = "b < 2 b_p", set = ["map.baseline_bp_max=2.0"] },
]
[[axis]]
key = "map.epsilon"
values = [1e-6, 1e-2]
"#;

fn bytes(path: impl AsRef<Path>) -> Vec<u8> {
    std::fs::read(path.as_ref()).unwrap()
}

/// Settings of `STUDY`, and the folders of its cases.
const CASES: [[&str; 3]; 4] = [
    ["1.0", "1e-6", "case-b-b_p-epsilon-0.000001"],
    ["1.0", "1e-2", "case-b-b_p-epsilon-0.01"],
    ["2.0", "1e-6", "case-b-2-b_p-epsilon-0.000001"],
    ["2.0", "1e-2", "case-b-2-b_p-epsilon-0.01"],
];

#[test]
fn a_study_gives_the_maps_of_separate_runs() {
    let place = Workplace::new(SMALL);
    let (study, out) = (place.file("study.toml", STUDY.as_bytes()), place.path("study"));
    let summary = json(&["study", &study, "--out", &out]);
    assert_eq!((summary["name"].as_str(), summary["cancelled"].as_bool()), (Some("both"), Some(false)));
    let cases = summary["cases"].as_array().unwrap();
    assert_eq!(cases.len(), 4);
    for (number, [limit, epsilon, folder]) in CASES.into_iter().enumerate() {
        let alone = place.path(&format!("alone-{number}"));
        let sets = [format!("map.baseline_bp_max={limit}"), format!("map.epsilon={epsilon}")];
        let more = ["--set", &sets[0], "--set", &sets[1], "--set", "map.trace_probes=4"];
        let run = json(&[&["run", &place.pipeline, "--out", &alone], &more[..]].concat());
        assert_eq!(cases[number]["folder"].as_str(), Some(folder));
        let folder = format!("{out}/{folder}");
        for map in ["3.000MHz/map.fits", "3.000MHz/noise.fits", "10.000MHz/map.fits", "10.000MHz/input.fits"]
        {
            // Headers too: they say what the maps are of.
            assert!(bytes(format!("{folder}/{map}")) == bytes(format!("{alone}/{map}")), "{folder}/{map}");
        }
        let figures = &cases[number]["figures"];
        for (found, expected) in
            figures["channels"].as_array().unwrap().iter().zip(run["channels"].as_array().unwrap())
        {
            for key in ["visibilities", "mean_k", "rho", "snr", "power"] {
                assert_eq!(found[key], expected[key], "{key}");
            }
            assert_eq!(
                found["diagnostics"]["traces"]["sigma_s"],
                expected["diagnostics"]["traces"]["sigma_s"]
            );
        }
    }
    // What cases shared is gone, the tables are there.
    let mut left: Vec<String> = std::fs::read_dir(&out)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .filter(|name| !name.starts_with("case-"))
        .collect();
    left.sort_unstable();
    assert_eq!(left, ["spectra.csv", "study.csv", "study.json", "study.png"]);
    let table = String::from_utf8(bytes(format!("{out}/study.csv"))).unwrap();
    assert_eq!(table.lines().count(), 1 + 4 * 2);
    assert!(table.contains("\"b < 2 b_p, epsilon = 0.01\",10000000,4,"), "{table}");
    let crossings: Vec<&Value> = summary["crossings"].as_array().unwrap().iter().collect();
    // One for each limit and channel.
    assert_eq!(crossings.len(), 4);

    // Nothing is made again, and of more cases only the new ones.
    let made = || {
        CASES.map(|case| {
            std::fs::metadata(format!("{out}/{}/case.json", case[2])).unwrap().modified().unwrap()
        })
    };
    let before = made();
    let longer = STUDY.replace("[1e-6, 1e-2]", "[1e-6, 1e-1, 1e-2]");
    let longer = place.file("longer.toml", longer.as_bytes());
    assert_eq!(json(&["study", &study, "--out", &out]), summary);
    assert_eq!(json(&["study", &longer, "--out", &out])["cases"].as_array().unwrap().len(), 6);
    assert_eq!(made(), before);
    // Finished runs can be put side by side.
    let [first, second] = [CASES[0][2], CASES[3][2]].map(|name| format!("{out}/{name}"));
    let plot = place.path("curves.png");
    let table = succeed(&["compare", &first, &second, "--plot", &plot]);
    assert_eq!(table.lines().count(), 1 + 2 * 2 + 1, "{table}");
    assert!(bytes(&plot).starts_with(b"\x89PNG"));
}

#[test]
fn every_case_has_its_snapshots() {
    let place = Workplace::new(SMALL);
    let text = "pipeline = \"pipeline.toml\"\nset = [\"map.snapshot_every_s=1.5e7\"]\n\
                [[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4, 1e-2]\n";
    let (study, out) = (place.file("study.toml", text.as_bytes()), place.path("study"));
    succeed(&["study", &study, "--out", &out]);
    let snapshots = |case: &str| -> usize {
        let summary: Value = serde_json::from_slice(&bytes(format!("{out}/{case}/summary.json"))).unwrap();
        summary["channels"][0]["snapshots"].as_array().unwrap().len()
    };
    // In 4.1e7 s: after 1.5e7 and 3e7, and the final map.
    assert_eq!(["case-epsilon-0.0001", "case-epsilon-0.01"].map(snapshots), [3, 3]);
}

#[test]
fn studies_that_cannot_be_made_say_why() {
    let place = Workplace::new(SMALL);
    for (text, part) in [
        ("axes = 3", "unknown field `axes`"),
        ("[[axis]]\nkey = \"map.epsilon\"", "axis 1; expected key with values"),
        ("[[axis]]\nkey = \"map.epsilon\"\nvalues = []", "axis 1; expected key with values"),
        ("[[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4, -1.0]", "case epsilon = -1.0: "),
        ("[[axis]]\nkey = \"map.epsilons\"\nvalues = [1e-4]", "map.epsilons: no such key"),
        ("pipeline = \"none.toml\"", "none.toml"),
        ("[[axis]]\nkey = \"seed\"\nvalues = [1, 1]", "two cases with products in case-seed-1"),
    ] {
        let study = place.file("study.toml", text.as_bytes());
        let said = fail(&["study", &study, "--out", &place.path("out")]);
        assert!(said.contains(part), "{text}: {said}");
    }
    let long = format!("[[axis]]\nkey = \"seed\"\nvalues = {:?}", (0..1001).collect::<Vec<_>>());
    let study = place.file("study.toml", long.as_bytes());
    assert!(fail(&["study", &study, "--out", &place.path("out")]).contains("more than 1000 combinations"));
    assert!(!Path::new(&place.path("out")).exists());
    let said = fail(&["compare", &place.path("a"), &place.path("b"), &place.path("c")]);
    assert!(said.contains("expected the folder of a finished run"), "{said}");
}

#[test]
fn studies_of_the_paper_are_good() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines/paper");
    let mut count = 0;
    let paths = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    for path in paths.filter(|path| path.extension().is_some_and(|extension| extension == "toml")) {
        let study = Study::read(&path, &[]).unwrap();
        assert!(study.cases.len() >= 2, "{}", study.name);
        count += 1;
    }
    assert!(count >= 1);
}
