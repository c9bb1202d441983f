//! Many short runs with random shapes and random events. A deadlock shows as a run that does not end.

use std::sync::mpsc;
use std::thread;

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::parts::{Count, Each, Into, PATIENCE, TestError};
use crate::runtime::{Cancel, Graph, Outlet, Report, RuntimeError};

/// The event of a run, at a stage and an item.
#[derive(Clone, Copy, Debug)]
enum RunEvent {
    Nothing,
    Error { stage: u64, item: u64 },
    Panic { stage: u64, item: u64 },
    Cancel { stage: u64, item: u64 },
}

const ITEMS: u64 = 40;

fn run(stages: u64, event: RunEvent, random: &mut ChaCha8Rng) -> Result<Report, RuntimeError> {
    let cancel = Cancel::new();
    let mut graph = Graph::new();
    let mut link = graph.source("source", random.random_range(1..4), Count::to(ITEMS));
    for index in 0..stages {
        let trigger = cancel.clone();
        let step = move |n: u64, out: &mut Outlet<u64>| {
            match event {
                RunEvent::Error { stage, item } if (stage, item) == (index, n) => return Err(TestError(n)),
                // Unwinds without the hook, which would print every panic.
                RunEvent::Panic { stage, item } if (stage, item) == (index, n) => {
                    std::panic::resume_unwind(Box::new("wanted"))
                }
                RunEvent::Cancel { stage, item } if (stage, item) == (index, n) => trigger.cancel(),
                _ => {}
            }
            out.push(n);
            Ok(())
        };
        link = graph.stage(&format!("stage {index}"), random.random_range(1..4), link, Each::new(step));
    }
    graph.sink("sink", link, Into::new(|_: u64| Ok(())));
    graph.run(&cancel, PATIENCE)
}

fn check(stages: u64, event: RunEvent, result: Result<Report, RuntimeError>) {
    match (event, result) {
        (RunEvent::Nothing, Ok(report)) => {
            assert_eq!(report.stage("sink").map(|sink| sink.items_in), Some(ITEMS));
        }
        (RunEvent::Error { stage, .. }, Err(RuntimeError::Failed { stage: name, unfinished, .. }))
        | (RunEvent::Panic { stage, .. }, Err(RuntimeError::Panicked { stage: name, unfinished, .. })) => {
            assert_eq!(name, format!("stage {stage}"));
            assert!(unfinished.stages.is_empty(), "{unfinished}");
        }
        (RunEvent::Cancel { .. }, Ok(report)) => {
            let given = report.stage("source").map(|source| source.items_out);
            assert_eq!(report.stage("sink").map(|sink| sink.items_in), given);
            assert!(report.cancelled || given == Some(ITEMS));
        }
        (event, result) => panic!("{stages} stages, {event:?}: {result:?}"),
    }
}

#[test]
fn no_run_hangs() {
    let (done, ended) = mpsc::channel();
    let runs = thread::spawn(move || {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        for _ in 0..600 {
            let stages = random.random_range(1..5);
            let (stage, item) = (random.random_range(0..stages), random.random_range(0..ITEMS));
            let event = match random.random_range(0..4) {
                0 => RunEvent::Nothing,
                1 => RunEvent::Error { stage, item },
                2 => RunEvent::Panic { stage, item },
                _ => RunEvent::Cancel { stage, item },
            };
            check(stages, event, run(stages, event, &mut random));
        }
        let _ = done.send(());
    });
    // A failed check drops `done` and shows as the panic that `join` returns.
    if let Err(mpsc::RecvTimeoutError::Timeout) = ended.recv_timeout(4 * PATIENCE) {
        panic!("a run did not end");
    }
    if let Err(payload) = runs.join() {
        std::panic::resume_unwind(payload);
    }
}
