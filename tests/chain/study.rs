//! Studies: one simulation, many solutions.

use std::io::{BufRead, BufReader};
use std::path::Path;

use lunarray::pipeline::Study;
use lunarray::sky::fits::{Card, ReadOptions, WriteOptions, read_map_file, read_whole_map, write_map};
use lunarray::sky::{Frame, SkyMap};
use serde_json::Value;

use super::common::process::{signal, start};
use super::common::workplace::{SMALL, Workplace, fail, json, lunarray, succeed};

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
    assert_eq!(left, ["spectra.csv", "study.csv", "study.json", "study.png", "study.svg"]);
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
    let longer = json(&["study", &longer, "--out", &out]);
    assert_eq!(longer["cases"].as_array().unwrap().len(), 6);
    // Of three epsilons one can be chosen, for each limit and channel.
    assert!(summary.get("epsilons").is_none());
    let choices = longer["epsilons"].as_array().unwrap();
    assert_eq!(choices.len(), 4);
    for choice in choices {
        assert_eq!(choice["points"].as_array().unwrap().len(), 3);
        for rule in ["crossing", "cross_validation", "risk", "l_curve"] {
            // One of them, or why not.
            assert!(choice[rule]["epsilon"].is_f64() || choice[rule]["note"].is_string(), "{choice}");
        }
    }
    assert_eq!(String::from_utf8(bytes(format!("{out}/epsilons.csv"))).unwrap().lines().count(), 1 + 4 * 3);
    assert!(bytes(format!("{out}/epsilons.png")).starts_with(b"\x89PNG"));
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
        ("pipeline = \"none.toml\"\nrealisations = 2", "none.toml"),
        ("", "study.toml: nothing that makes cases; expected [[axis]] with key and values"),
        ("pipeline = \"pipeline.toml\"\nset = [\"seed=1\"]", "study.toml: nothing that makes cases"),
        ("[[axis]]\nkey = \"seed\"\nvalues = [1, 1]", "two cases with products in case-seed-1"),
        // The last would hold, under the labels of both.
        (
            "[[axis]]\nkey = \"seed\"\nvalues = [1, 2]\n[[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4, 1e-3]\n\
             [[axis]]\ncases = [{ label = \"a\", set = [] }, { label = \"b\", set = [\"map.epsilon = 1e-2\"] }]",
            "study.toml: map.epsilon is set by axis 2 and by axis 3; expected each key on one axis alone",
        ),
        (
            "[[axis]]\nkey = \"map.limits\"\nvalues = [{ altitude_m_max = 1.0 }]\n\
             [[axis]]\nkey = \"map.limits.altitude_m_max\"\nvalues = [2.0]",
            "map.limits is set by axis 1 and by axis 2",
        ),
    ] {
        let study = place.file("study.toml", text.as_bytes());
        let said = fail(&["study", &study, "--out", &place.path("out")]);
        assert!(said.contains(part), "{text}: {said}");
    }
    let study = place.file("study.toml", b"[[axis]]\nkey = \"map.epsilon\"\nvalues = [1e-4, 1e-3]");
    let said = fail(&["study", &study, "--out", &place.path("out"), "--set", "map.epsilon=1e-2"]);
    assert!(said.contains("map.epsilon is set by axis 1 and by --set"), "{said}");
    let long = format!("[[axis]]\nkey = \"seed\"\nvalues = {:?}", (0..1001).collect::<Vec<_>>());
    let study = place.file("study.toml", long.as_bytes());
    assert!(fail(&["study", &study, "--out", &place.path("out")]).contains("more than 1000 combinations"));
    assert!(!Path::new(&place.path("out")).exists());
    let said = fail(&["compare", &place.path("a"), &place.path("b"), &place.path("c")]);
    assert!(said.contains("expected the folder of a finished run"), "{said}");
}

/// A study of the repository whose model is made before it, as its first lines say: with a map in its place.
fn with_its_model(path: &Path) -> Study {
    let folder = tempfile::tempdir().unwrap();
    let beside = folder.path().join("calibration");
    std::fs::create_dir(&beside).unwrap();
    let pipeline = path.parent().unwrap().with_file_name("paper-10mhz.toml");
    std::fs::copy(pipeline, folder.path().join("paper-10mhz.toml")).unwrap();
    let map = SkyMap::new(Frame::Ecliptic, vec![1e5; 192]).unwrap();
    let cards = vec![Card::real("FREQ", 10e6, "Hz")];
    let options = WriteOptions { cards, ..WriteOptions::default() };
    write_map(&beside.join("sky-10.fits"), &map, &options).unwrap();
    let study = beside.join(path.file_name().unwrap());
    std::fs::copy(path, &study).unwrap();
    Study::read(&study, &[]).unwrap()
}

#[test]
fn studies_of_the_repository_are_good() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines");
    for name in ["paper", "calibration", "noise"] {
        let paths = std::fs::read_dir(folder.join(name)).unwrap().map(|entry| entry.unwrap().path());
        let mut count = 0;
        for path in paths.filter(|path| path.extension().is_some_and(|extension| extension == "toml")) {
            // Pipelines of their own.
            if path.ends_with("mission-10mhz.toml") || path.ends_with("wrong-sky.toml") {
                continue;
            }
            let study = match path.ends_with("known-sky.toml") {
                true => with_its_model(&path),
                false => Study::read(&path, &[]).unwrap(),
            };
            // Realisations may share all but their noise, as one case.
            assert!(study.cases.len() >= 2 || study.realisations >= 2, "{}", study.name);
            count += 1;
        }
        assert!(count >= 1, "{name}");
    }
}

#[test]
fn realisations_scatter_by_the_noise_that_the_matrix_tells() {
    let place = Workplace::new(SMALL);
    let study = r#"
name = "many"
pipeline = "pipeline.toml"
set = ["map.trace_probes=1", "products.pictures=false", "spacecraft.channels_hz=[3e6]", "map.snapshot_every_s=0"]
realisations = 60
covariance_at_deg = [[45.0, 85.0], [315.0, -85.0]]
"#;
    let (study, out) = (place.file("many.toml", study.as_bytes()), place.path("many"));
    let summary = json(&["study", &study, "--out", &out]);
    assert_eq!(summary["cases"].as_array().unwrap().len(), 60);
    let spread = &summary["spreads"][0];
    assert_eq!(spread["count"], 60);
    // N_pix times the mean variance of a pixel is the trace of Sigma_n, which comes from eigenvalues. The sum of N_pix variances of 60
    // realisations scatters by sqrt(2 / 60 / modes), and a few modes hold most of it: at most 18 % if it is one.
    let figures = &summary["cases"][0]["figures"]["channels"][0];
    let pixels = 12.0 * figures["nside"].as_f64().unwrap().powi(2);
    let trace_k2 = figures["diagnostics"]["traces"]["sigma_n_k2"]["value"].as_f64().unwrap();
    let found_k2 = pixels * spread["sigma_rms_k"].as_f64().unwrap().powi(2);
    assert!((found_k2 / trace_k2 - 1.0).abs() < 0.36, "{found_k2:e} {trace_k2:e}");
    // The same by degrees: sum of (2 l + 1) C_l is 4 pi times the mean variance, up to the pixels' own aliasing.
    let power = spread["noise"]["mean_k2"].as_array().unwrap();
    let variance: f64 =
        power.iter().enumerate().map(|(l, c)| (2 * l + 1) as f64 * c.as_f64().unwrap()).sum::<f64>()
            / (4.0 * std::f64::consts::PI);
    assert!((variance * pixels / found_k2 - 1.0).abs() < 0.2, "{variance:e} {found_k2:e}");
    let files: Vec<&str> =
        spread["files"].as_array().unwrap().iter().map(|file| file.as_str().unwrap()).collect();
    assert_eq!(
        files,
        [
            "sigma-1-3.000MHz.fits",
            "covariance-at-45.000_85.000-1-3.000MHz.fits",
            "covariance-at-315.000_-85.000-1-3.000MHz.fits",
            "covariance-noise-1-3.000MHz.csv",
            "covariance-map-1-3.000MHz.csv"
        ]
    );
    let map = |path: String| {
        let file = read_map_file(Path::new(&path), &ReadOptions::default()).unwrap();
        file.map.values().to_vec()
    };
    let sigma_k = map(format!("{out}/{}", files[0]));
    let noises: Vec<Vec<f64>> = summary["cases"]
        .as_array()
        .unwrap()
        .iter()
        .map(|case| map(format!("{out}/{}/3.000MHz/noise.fits", case["folder"].as_str().unwrap())))
        .collect();
    // The first pixel lies at 45 deg beside the north pole, the last one at 315 deg beside the south pole.
    for (name, pixel) in [(files[1], 0), (files[2], sigma_k.len() - 1)] {
        let found_k2 = map(format!("{out}/{name}"));
        assert_eq!(
            read_map_file(Path::new(&format!("{out}/{name}")), &ReadOptions::default()).unwrap().unit,
            "K^2"
        );
        for (other, found_k2) in found_k2.iter().enumerate() {
            let expected_k2 = noises.iter().map(|noise| noise[pixel] * noise[other]).sum::<f64>() / 60.0;
            // Files in 32 or 64 bits.
            assert!(
                (found_k2 - expected_k2).abs() < 1e-6 * sigma_k[pixel] * sigma_k[other],
                "{pixel} {other}"
            );
        }
    }
    let covariance = String::from_utf8(bytes(format!("{out}/{}", files[3]))).unwrap();
    let rows: Vec<Vec<f64>> =
        covariance.lines().map(|line| line.split(',').map(|x| x.parse().unwrap()).collect()).collect();
    assert!(rows.len() == power.len() && rows.iter().all(|row| row.len() == rows.len()));
    for (a, row) in rows.iter().enumerate() {
        let deviation = spread["noise"]["deviation_k2"][a].as_f64().unwrap();
        assert!((row[a].sqrt() - deviation).abs() <= 1e-12 * deviation);
        // Symmetric, and no correlation beyond one.
        assert!(
            row.iter().enumerate().all(|(b, c)| *c == rows[b][a] && c * c <= 1.0001 * row[a] * rows[b][b])
        );
    }
    assert!(bytes(format!("{out}/realisations.csv")).starts_with(b"case,frequency_hz,realisations,l,"));
}

#[test]
fn realisations_that_share_their_weights_are_those_of_runs_of_their_own() {
    let place = Workplace::new(SMALL);
    let set = ["map.engine=\"harmonic\"", "map.l_max=8", "map.residual_max=1e-3", "map.snapshot_every_s=0"];
    let study = format!("name = \"many\"\npipeline = \"pipeline.toml\"\nset = {set:?}\nrealisations = 4\n");
    let (study, out) = (place.file("many.toml", study.as_bytes()), place.path("many"));
    let summary = json(&["study", &study, "--out", &out]);
    let cases = summary["cases"].as_array().unwrap();
    assert_eq!((cases.len(), &cases[0]["realisations"]), (1, &4.into()));
    let spreads = summary["spreads"].as_array().unwrap();
    assert_eq!(spreads.len(), 2);
    // Their maps are one.
    assert!(spreads.iter().all(|spread| spread["count"] == 4 && spread.get("map").is_none()));
    let values = |path: String| {
        let map = read_whole_map(Path::new(&path), &ReadOptions::default()).unwrap();
        map.values().iter().map(|value| value.to_bits()).collect::<Vec<u64>>()
    };
    let folder = format!("{out}/{}", cases[0]["folder"].as_str().unwrap());
    let mut seen = Vec::new();
    for number in 1..=4 {
        let own = place.path(&format!("own-{number}"));
        let seed = format!("map.companion_seed={}", 1 + number);
        let sets = set.iter().copied().chain([seed.as_str()]).flat_map(|set| ["--set", set]);
        let words = ["run", &place.pipeline, "--out", &own];
        succeed(&words.into_iter().chain(sets).collect::<Vec<_>>());
        for mhz in ["3.000MHz", "10.000MHz"] {
            let expected = values(format!("{own}/{mhz}/noise.fits"));
            let found = match number {
                1 => values(format!("{folder}/{mhz}/noise.fits")),
                _ => values(format!("{folder}/{mhz}/realisations/noise-{number:04}.fits")),
            };
            assert!(found == expected, "realisation {number}, {mhz}");
            assert!(!seen.contains(&found));
            seen.push(found);
        }
        assert_eq!(values(format!("{own}/3.000MHz/map.fits")), values(format!("{folder}/3.000MHz/map.fits")));
    }
}

#[test]
fn the_first_signal_ends_a_study_in_order() {
    let place = Workplace::new(SMALL);
    let values: Vec<String> = (0..60).map(|k| format!("{}e-5", 1 + k)).collect();
    let study = format!(
        "name = \"many\"\npipeline = \"pipeline.toml\"\n[[axis]]\nkey = \"map.epsilon\"\nvalues = [{}]\n",
        values.join(", ")
    );
    let (study, out) = (place.file("many.toml", study.as_bytes()), place.path("many"));
    let mut child = start(&["study", &study, "--out", &out]);
    // The third run of this command: the simulation, and a case before.
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    while !lines.next().unwrap().unwrap().contains("case 2 of 60: mapping") {}
    signal(&child, "INT");
    let rest: Vec<String> = lines.map(|line| line.unwrap()).collect();
    assert_eq!(child.wait().unwrap().code(), Some(130), "{rest:?}");
    assert!(rest.iter().any(|line| line.contains("repeat the command to go on")), "{rest:?}");
    let summary: Value = serde_json::from_slice(&bytes(format!("{out}/study.json"))).unwrap();
    assert!(summary["cancelled"] == true && !summary["cases"].as_array().unwrap().is_empty());
}

/// Two seeds, each with a downlink of its own, and two solutions that share the sums.
const TWO_DOWNLINKS: &str = r#"
pipeline = "pipeline.toml"
set = ["products.pictures=false"]
[[axis]]
key = "seed"
values = [1, 2]
[[axis]]
key = "map.epsilon"
values = [1e-6, 1e-2]
"#;

#[test]
fn what_is_kept_is_used_only_if_it_is_whole_and_of_the_same_downlink() {
    let place = Workplace::new(SMALL);
    let study = place.file("study.toml", TWO_DOWNLINKS.as_bytes());
    let maps = |out: &str| {
        let folders = ["1-epsilon-0.000001", "1-epsilon-0.01", "2-epsilon-0.000001", "2-epsilon-0.01"];
        folders.map(|folder| bytes(format!("{out}/case-seed-{folder}/3.000MHz/map.fits")))
    };
    let [plain, kept] = ["plain", "kept"].map(|name| place.path(name));
    succeed(&["study", &study, "--out", &plain]);
    let expected = maps(&plain);
    succeed(&["study", &study, "--out", &kept, "--keep"]);
    assert!(maps(&kept) == expected, "each downlink has a state of its own");
    // Only downlinks stay, and they are cut as by a process that was killed.
    let mut cut = 0;
    for entry in std::fs::read_dir(&kept).unwrap().map(|entry| entry.unwrap()) {
        if entry.file_type().unwrap().is_dir() {
            std::fs::remove_dir_all(entry.path()).unwrap();
        } else if entry.path().extension().is_some_and(|ending| ending == "ccsds") {
            let file = std::fs::OpenOptions::new().write(true).open(entry.path()).unwrap();
            file.set_len(file.metadata().unwrap().len() / 2).unwrap();
            cut += 1;
        }
    }
    assert_eq!(cut, 2);
    succeed(&["study", &study, "--out", &kept, "--keep"]);
    assert!(maps(&kept) == expected, "a downlink that was cut is simulated again");
    // Whole ones are not.
    let whole = |name: &str| bytes(format!("{kept}/case-seed-{name}/case.json"));
    std::fs::remove_file(format!("{kept}/case-seed-1-epsilon-0.01/case.json")).unwrap();
    let output = lunarray(&["study", &study, "--out", &kept, "--keep"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("mapping") && !said.contains("simulating"), "{said}");
    assert!(!whole("1-epsilon-0.01").is_empty() && maps(&kept) == expected);
}
