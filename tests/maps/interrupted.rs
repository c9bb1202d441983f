//! Solutions that an interrupt cuts off: their maps say so, and replace no other.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::sync::{Arc, Mutex};

use lunarray::frames::PlacedVisibilities;
use lunarray::imaging::{MapConfig, Snapshot, Solution, SolveWatch, Solver, SolverSetup, StoppingRule};
use lunarray::products::{ChannelSummary, ProductsConfig, Provenance, Publisher, Truth, WrittenProducts};
use lunarray::runtime::{Cancel, Outlet, Sink, Stage};
use lunarray::units::ChannelId;

use crate::engines::harmonic_sums;
use crate::forged::{block, instrument, solver_setup};

/// Forty visibilities of the shortest pair, one a block.
fn visibilities() -> Vec<PlacedVisibilities> {
    let all = block(1e-6);
    let one = |k: usize| PlacedVisibilities {
        frequency_hz: all.frequency_hz,
        pair: all.pair,
        time_s: vec![all.time_s[k]],
        r_i_m: vec![all.r_i_m[k]],
        r_j_m: vec![all.r_j_m[k]],
        value_k_sr: vec![all.value_k_sr[k]],
        weight: vec![all.weight[k]],
        ..PlacedVisibilities::default()
    };
    (0..all.len()).map(one).collect()
}

/// A map of few data, iterated to this residual.
fn solve(residual_max: f64, watch: SolveWatch) -> Option<Solution> {
    let snapshot = Snapshot {
        instrument: Arc::new(instrument()),
        channel: ChannelId(0),
        number: 1,
        is_final: true,
        span_s: [0.0, 1.0],
        nside: 4,
        data: Box::new(harmonic_sums(&visibilities(), 6, 3_000.0)),
    };
    let rule = StoppingRule { residual_max, iterations_max: 300 };
    let mut maps = Outlet::collect();
    Solver::new(SolverSetup { rule, ..solver_setup(watch) }).step(snapshot, &mut maps).unwrap();
    maps.into_vec().pop()
}

/// A watch that is cancelled, without a time limit: twelve iterations.
fn cancelled() -> SolveWatch {
    let cancel = Cancel::new();
    cancel.cancel();
    SolveWatch::new(cancel)
}

fn publish(solution: Solution, folder: &Path) -> (ChannelSummary, BTreeMap<String, Vec<u8>>) {
    let written = Arc::new(Mutex::new(WrittenProducts::default()));
    let provenance = Provenance { ground_hash: 0, map: MapConfig::default() };
    let config = ProductsConfig { pictures: false, ..ProductsConfig::default() };
    let mut publisher =
        Publisher::new(config, folder, Truth::unknown(), provenance, Arc::clone(&written)).unwrap();
    publisher.take(solution).unwrap();
    publisher.finish().unwrap();
    let files = fs::read_dir(folder.join("3.000MHz")).unwrap().map(|entry| entry.unwrap().path());
    let name = |path: &Path| path.file_name().unwrap().to_string_lossy().into_owned();
    let files = files.map(|path| (name(&path), fs::read(path).unwrap())).collect();
    let summary = written.lock().unwrap().channels.pop().unwrap();
    (summary, files)
}

#[test]
fn an_interrupted_map_says_so_and_replaces_none() {
    // Rounding leaves no residual of 1e-14 after twelve iterations; of 0.5, one does.
    let cut = || solve(1e-14, cancelled()).unwrap();
    assert!(cut().is_interrupted && !cut().is_final_map() && cut().uncertainty.is_none());
    let whole = solve(0.5, cancelled()).unwrap();
    assert!(!whole.is_interrupted && whole.is_final_map());

    let folder = tempfile::tempdir().unwrap();
    let (summary, files) = publish(cut(), folder.path());
    let names: Vec<&str> = files.keys().map(String::as_str).collect();
    assert_eq!(names, ["latest.fits", "map.fits"]);
    for (name, bytes) in &files {
        let header = String::from_utf8_lossy(bytes);
        assert!(header.contains("CONVERGD=                    F"), "{name}");
        assert!(header.contains("WARNING = 'not converged: interrupted after 12 iterations'"), "{name}");
    }
    let said = summary.to_string();
    assert!(
        said.contains("not converged: interrupted after 12 iterations") && !said.contains("noise"),
        "{said}"
    );

    let folder = tempfile::tempdir().unwrap();
    let (summary, before) = publish(whole, folder.path());
    assert!(before.contains_key("noise.fits") && summary.interrupted.is_none());
    let (summary, after) = publish(cut(), folder.path());
    assert!(after == before && summary.files.is_empty());
    assert!(summary.to_string().contains("the earlier map was kept"), "{summary}");
}

#[test]
fn a_final_solution_has_the_time_limit_to_end() {
    let cancel = Cancel::new();
    cancel.cancel();
    let hour = std::time::Duration::from_secs(3600);
    let in_time = solve(1e-6, SolveWatch::new(cancel.clone()).with_grace(hour)).unwrap();
    assert_eq!(in_time.map_k, solve(1e-6, SolveWatch::default()).unwrap().map_k);
    assert!(!in_time.is_interrupted);
    // After it, none begins.
    assert!(solve(1e-6, SolveWatch::new(cancel).with_grace(std::time::Duration::ZERO)).is_none());
}
