//! Ranks of an MPI job that share the sums of a map. `LUNARRAY_MPI` names a program built with `--features mpi`, and `LUNARRAY_MPIRUN`
//! what launches its jobs: `mpirun`, if it is not set.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::common::mpi_program;
use crate::common::workplace::{Workplace, fail, files, succeed};

/// Sums over 56 alphas in four blocks, and of data over 28 in two; snapshots on the way; and a channel at 30 MHz, which has no
/// baseline that is short enough.
const SHARED: &str = r#"
name = "shared"
seed = 7
[sky]
nside = 4
[spacecraft]
channels_hz = [3.0e6, 10.0e6, 30.0e6]
every_nth_window = 400
every_nth_integration = 4
baseline_wavelengths_max = 8.0
[map]
nside = 4
engine = "harmonic"
l_max = 6
baseline_bp_max = 1.5
epsilon = 1e-3
residual_max = 1e-2
snapshot_every_s = 2.0e7
[products]
pictures = false
[runtime]
threads = 1
"#;

/// How soon a job has to end once one of its ranks has.
const SOON: Duration = Duration::from_secs(10);

/// A command as a job of so many ranks.
fn job(program: &Path, ranks: usize, words: &[&str]) -> Command {
    let mut command = Command::new(std::env::var_os("LUNARRAY_MPIRUN").unwrap_or("mpirun".into()));
    command
        .args(["-n", &ranks.to_string()])
        .arg(program)
        .args(words)
        // Of OpenMPI: gates have few cores, and may run as root.
        .env("OMPI_ALLOW_RUN_AS_ROOT", "1")
        .env("OMPI_ALLOW_RUN_AS_ROOT_CONFIRM", "1")
        .env("OMPI_MCA_rmaps_base_oversubscribe", "1")
        .env("OMPI_MCA_btl", "self,vader")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn succeeded(output: Output) -> Output {
    assert!(output.status.success(), "{}", text(&output.stderr));
    output
}

/// What a folder of products holds: its files, and what the summary says but for times.
fn products(out: &str) -> (std::collections::BTreeMap<PathBuf, Vec<u8>>, [Value; 4]) {
    let summary = std::fs::read(Path::new(out).join("summary.json")).unwrap();
    let summary: Value = serde_json::from_slice(&summary).unwrap();
    let said = ["channels", "ledger", "reception", "completeness"].map(|key| summary[key].clone());
    (files(out.as_ref()), said)
}

fn assert_equal(found: &str, expected: &str) {
    let ((found_files, found_said), (files, said)) = (products(found), products(expected));
    assert!(found_files.keys().eq(files.keys()), "{found}: {:?}", found_files.keys());
    for (path, bytes) in &files {
        assert!(found_files[path] == *bytes, "{found}: {} differs", path.display());
    }
    assert_eq!(found_said, said, "{found}");
}

#[test]
#[ignore = "needs LUNARRAY_MPI"]
fn mpi_ranks_leave_the_bytes_of_one_process() {
    let program = mpi_program();
    let place = Workplace::new(SHARED);
    let downlink = place.simulate("x.ccsds", &[]);
    let replay = |out: &str, more: &[&str]| -> Vec<String> {
        let words = ["replay", &downlink, "--map", &place.pipeline, "--out", out];
        words.iter().chain(more).map(|word| (*word).to_owned()).collect()
    };
    let of_ranks = |ranks: usize, words: &[&str]| {
        let output = succeeded(job(&program, ranks, words).output().unwrap());
        // The first rank alone talks.
        assert_eq!(text(&output.stdout).matches("Products are in").count(), 1);
    };
    // By the program without MPI.
    let alone = place.path("alone");
    succeed(&borrowed(&replay(&alone, &[])));
    let (files, said) = products(&alone);
    let maps = |name: &str| files.keys().filter(|path| path.file_name().unwrap() == name).count();
    assert_eq!(maps("map.fits"), 2);
    assert!(said[0][0]["snapshots"].as_array().unwrap().len() > 1);
    // Without mpirun.
    let one = place.path("one");
    succeeded(Command::new(&program).args(replay(&one, &["--mpi"])).output().unwrap());
    assert_equal(&one, &alone);
    // Seven ranks are more than there are blocks, so that some hold nothing.
    for ranks in [1, 2, 3, 4, 7] {
        let out = place.path(&format!("of-{ranks}"));
        of_ranks(ranks, &borrowed(&replay(&out, &["--mpi"])));
        assert_equal(&out, &alone);
    }
    // The whole chain, whose downlink the first rank writes.
    let run = |out: &str| ["run", &place.pipeline, "--out", out].map(str::to_owned);
    let (whole, shared) = (place.path("whole"), place.path("shared"));
    succeed(&borrowed(&run(&whole)));
    of_ranks(2, &[&borrowed(&run(&shared))[..], &["--mpi"]].concat());
    assert_equal(&shared, &whole);
}

fn borrowed(words: &[String]) -> Vec<&str> {
    words.iter().map(String::as_str).collect()
}

#[test]
fn what_ranks_cannot_share_is_refused_by_name() {
    let place = Workplace::new(SHARED);
    let out = place.path("out");
    let replay = ["replay", "x.ccsds", "--out", &out, "--mpi"];
    for other in [["--groups", "2"], ["--speed", "2"], ["--events", "x"]] {
        let said = fail(&[&replay[..], &other].concat());
        assert!(said.contains("--mpi") && said.contains(other[0]), "{said}");
    }
    // The program that tests come with knows no MPI.
    let said = fail(&["run", &place.pipeline, "--out", &out, "--mpi"]);
    assert!(said.contains("--features mpi") && said.contains("docs/cluster.md"), "{said}");
}

#[test]
#[ignore = "needs LUNARRAY_MPI"]
fn mpi_what_ranks_cannot_share_is_refused_by_the_ranks() {
    let program = mpi_program();
    let place = Workplace::new(SHARED);
    let out = place.path("out");
    let overrides = [
        ("map.engine=\"pixel\"", "expected \"harmonic\""),
        ("map.refine={passes_max=2}", "map.refine.passes_max"),
        ("downlink.link={duplicate=0.1}", "replay --mpi"),
    ];
    for (set, expected) in overrides {
        // Without the keys that have no effect with the other engine, or none with refinement.
        let usual = ["map.snapshot_every_s=0", "map.l_max=0", "map.residual_max=1e-4", set];
        let sets = usual.into_iter().flat_map(|set| ["--set", set]);
        let words: Vec<&str> =
            ["run", &place.pipeline, "--out", &out, "--mpi"].into_iter().chain(sets).collect();
        let output = job(&program, 2, &words).output().unwrap();
        let said = text(&output.stderr);
        assert!(!output.status.success() && said.contains(expected), "{said}");
    }
}

#[test]
#[ignore = "needs LUNARRAY_MPI"]
fn mpi_ranks_that_hold_different_data_make_no_map() {
    let program = mpi_program();
    let place = Workplace::new(SHARED);
    let whole = place.simulate("whole.ccsds", &[]);
    let bytes = std::fs::read(&whole).unwrap();
    let part = place.file("part.ccsds", &bytes[..bytes.len() / 2]);
    let out = place.path("out");
    // Each rank by a shell that gives the second one another file, as a folder that is not shared would.
    let script = format!(
        "if [ \"${{OMPI_COMM_WORLD_RANK:-$PMI_RANK}}\" = 1 ]; then file={part}; else file={whole}; fi\n\
         exec {} replay \"$file\" --map {} --out {out} --mpi",
        program.display(),
        place.pipeline
    );
    let output = job(Path::new("sh"), 2, &["-c", &script]).output().unwrap();
    assert!(!output.status.success());
    assert!(text(&output.stderr).contains("sums of different data"), "{}", text(&output.stderr));
}

/// The processes of a program that descend from this one.
fn ranks_of(child: &Child, program: &Path) -> Vec<i32> {
    let children = |of: &str| {
        std::fs::read_to_string(format!("/proc/{of}/task/{of}/children"))
            .unwrap_or_default()
            .split_whitespace()
            .map(str::to_owned)
            .collect::<Vec<_>>()
    };
    let mut open = children(&child.id().to_string());
    let mut found = Vec::new();
    while let Some(next) = open.pop() {
        if std::fs::read_link(format!("/proc/{next}/exe")).is_ok_and(|exe| exe == program) {
            found.push(next.parse().unwrap());
        }
        open.extend(children(&next));
    }
    found.sort_unstable();
    found
}

/// Whether a folder holds a part of a downlink, whose name is another until it is whole.
fn has_downlink(folder: &str) -> bool {
    let is_downlink = |file: std::fs::DirEntry| {
        file.file_name().to_string_lossy().contains("downlink.ccsds")
            && file.metadata().is_ok_and(|file| file.len() > 0)
    };
    std::fs::read_dir(folder).is_ok_and(|files| files.flatten().any(is_downlink))
}

#[test]
#[ignore = "needs LUNARRAY_MPI"]
fn mpi_a_job_ends_soon_after_one_of_its_ranks() {
    let program = mpi_program();
    let program = program.canonicalize().unwrap();
    let place = Workplace::new(SHARED);
    // Every window and integration, and all degrees: longer than any gate.
    let long =
        ["spacecraft.every_nth_window=1", "spacecraft.every_nth_integration=1", "map.snapshot_every_s=0"];
    // A rank that is killed, and one that a signal tells to end.
    for (signal, rank) in [("KILL", 1), ("INT", 2), ("INT", 0), ("TERM", 1)] {
        let out = place.path(&format!("{signal}-{rank}"));
        let sets = long.iter().flat_map(|set| ["--set", set]);
        let words: Vec<&str> =
            ["run", &place.pipeline, "--out", &out, "--mpi"].into_iter().chain(sets).collect();
        let mut command = job(&program, 3, &words);
        let mut running = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let since = Instant::now();
        // Its ranks are at work once there is something on the way down.
        while !has_downlink(&out) {
            assert!(running.try_wait().unwrap().is_none(), "it ended before it began");
            assert!(since.elapsed() < Duration::from_secs(120), "it does not begin");
            std::thread::sleep(Duration::from_millis(100));
        }
        end_one(&mut running, &program, 3, rank, signal);
        assert!(!Path::new(&out).join("summary.json").exists());
    }
}

/// Sends a signal to one rank of a job, which then ends soon, and not well.
fn end_one(running: &mut Child, program: &Path, count: usize, rank: usize, signal: &str) {
    let ranks = ranks_of(running, program);
    assert_eq!(ranks.len(), count);
    let told = Command::new("kill").args([&format!("-{signal}"), &ranks[rank].to_string()]).status();
    assert!(told.unwrap().success());
    let since = Instant::now();
    let status = loop {
        if let Some(status) = running.try_wait().unwrap() {
            break status;
        }
        assert!(since.elapsed() < SOON, "{signal} {rank}: the job goes on");
        std::thread::sleep(Duration::from_millis(50));
    };
    assert!(!status.success(), "{signal} {rank}");
}

/// Files of checkpoints in a folder, in their order.
fn checkpoints(state: &str) -> Vec<String> {
    let entries = std::fs::read_dir(state).into_iter().flatten().flatten();
    let names = entries.map(|entry| entry.file_name().into_string().unwrap());
    let mut names: Vec<String> =
        names.filter(|name| name.starts_with("checkpoint-") && name.ends_with(".lunarray")).collect();
    names.sort();
    names
}

#[test]
#[ignore = "needs LUNARRAY_MPI"]
fn mpi_a_state_of_ranks_goes_on_with_another_number_of_them() {
    let program = mpi_program();
    let program = program.canonicalize().unwrap();
    let place = Workplace::new(SHARED);
    // So many data that no job comes to its end before it is told to.
    let more = ["spacecraft.every_nth_window=10", "spacecraft.every_nth_integration=1"];
    let sets: Vec<&str> = more.iter().flat_map(|set| ["--set", set]).collect();
    let downlink = place.simulate("x.ccsds", &sets);
    let state = place.path("state");
    let words = |out: &str, more: &[&str]| -> Vec<String> {
        let replay = ["replay", &downlink, "--map", &place.pipeline, "--out", out];
        let usual = ["--set", "map.snapshot_every_s=0"];
        replay.iter().chain(&usual).chain(more).map(|word| (*word).to_owned()).collect()
    };
    let alone = place.path("alone");
    succeed(&borrowed(&words(&alone, &[])));
    let kept = ["--mpi", "--state", &state, "--checkpoint-every", "500"];
    // Jobs of several sizes, one of whose ranks is killed, or told to end, after the first checkpoint that all of them have.
    for (signal, rank, count) in [("KILL", 1, 3), ("INT", 0, 2), ("KILL", 0, 4), ("TERM", 1, 2)] {
        let out = place.path(&format!("{signal}-{rank}"));
        let (before, mut command) =
            (checkpoints(&state), job(&program, count, &borrowed(&words(&out, &kept))));
        let mut running = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let since = Instant::now();
        let is_new = |name: &String| !before.contains(name);
        while checkpoints(&state).iter().filter(|name| is_new(name)).count() < count {
            assert!(running.try_wait().unwrap().is_none(), "it ended before it was told to");
            assert!(since.elapsed() < Duration::from_secs(120), "it does not begin");
            std::thread::sleep(Duration::from_millis(10));
        }
        end_one(&mut running, &program, count, rank, signal);
        assert!(!Path::new(&out).join("summary.json").exists());
    }
    // To its end, and once more without ranks, of which none is needed.
    let (shared, again) = (place.path("shared"), place.path("again"));
    succeeded(job(&program, 3, &borrowed(&words(&shared, &kept))).output().unwrap());
    let of_maps = |out: &str| {
        let mut maps = files(out.as_ref());
        maps.retain(|path, _| path.extension().is_some_and(|extension| extension == "fits"));
        maps
    };
    let expected = of_maps(&alone);
    assert!(!expected.is_empty() && of_maps(&shared) == expected);
    succeed(&borrowed(&words(&again, &["--state", &state])));
    assert!(of_maps(&again) == expected);
    let ledger = |out: &str| products(out).1[1].clone();
    assert_eq!([ledger(&shared), ledger(&again)], [ledger(&alone), ledger(&alone)]);
}

/// A map that begins with another snapshot's ends with other bits: those on the way are not made again by a job that goes on.
const NO_SNAPSHOTS: &str = "map.snapshot_every_s=0";

#[test]
#[ignore = "needs LUNARRAY_MPI"]
fn mpi_a_full_disk_of_one_rank_ends_the_job() {
    let program = mpi_program();
    let place = Workplace::new(SHARED);
    let downlink = place.simulate("x.ccsds", &[]);
    let (state, out, alone) = (place.path("state"), place.path("out"), place.path("alone"));
    let library = place.path("fault.so");
    let mut compiler = Command::new("cc");
    compiler.args(["-O1", "-shared", "-fPIC", "-o", &library]);
    compiler.args([concat!(env!("CARGO_MANIFEST_DIR"), "/tests/ground_state/fault.c"), "-ldl"]);
    assert!(compiler.status().unwrap().success());
    // The second rank's disk is full after some writes to the state.
    let script = format!(
        "if [ \"${{OMPI_COMM_WORLD_RANK:-$PMI_RANK}}\" = 1 ]; then\n\
             export LD_PRELOAD={library} FAULT_BELOW={state} FAULT_KIND=ENOSPC FAULT_AT=20 FAULT_ON=1 FAULT_LOG={library}.log\n\
         fi\n\
         exec {} replay {downlink} --map {} --out {out} --mpi --state {state} --checkpoint-every 100 --set {NO_SNAPSHOTS}",
        program.display(),
        place.pipeline
    );
    let mut command = job(Path::new("sh"), 2, &["-c", &script]);
    let output = command.output().unwrap();
    let said = text(&output.stderr);
    assert!(!output.status.success() && said.contains("No space left on device"), "{said}");
    assert!(!Path::new(&out).join("summary.json").exists());
    assert!(!checkpoints(&state).is_empty());
    // A job with a disk goes on.
    let replay = |out: &str| {
        ["replay", &downlink, "--map", &place.pipeline, "--out", out, "--set", NO_SNAPSHOTS]
            .map(str::to_owned)
    };
    let shared = replay(&out);
    let shared = [&borrowed(&shared)[..], &["--mpi", "--state", &state]].concat();
    succeeded(job(&program, 2, &shared).output().unwrap());
    succeed(&borrowed(&replay(&alone)));
    let maps = |out: &str| {
        let mut maps = files(out.as_ref());
        maps.retain(|path, _| path.ends_with("map.fits") || path.ends_with("noise.fits"));
        maps
    };
    assert!(!maps(&alone).is_empty() && maps(&out) == maps(&alone));
}
