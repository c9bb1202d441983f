//! Ends of runs: errors, panics, cancellation and stuck stages.

use std::error::Error;
use std::sync::mpsc;
use std::time::Duration;

use super::parts::{Count, Each, Into, Keep, PATIENCE, TestError};
use crate::runtime::{Cancel, Flow, Graph, Moment, Outlet, RuntimeError, Sink, Source, Stage};

/// Runs numbers through `stage` into a sink that keeps them. Returns the error, and whether the sink ran its `finish`.
fn fail_with<S>(stage: S) -> (RuntimeError, bool)
where
    S: Stage<In = u64, Out = u64, Error = TestError> + 'static,
{
    let mut graph = Graph::new();
    let numbers = graph.source("count", 2, Count::to(100));
    let passed = graph.stage("middle", 2, numbers, stage);
    let (sink, kept) = Keep::new();
    graph.sink("keep", passed, sink);
    let error = graph.run(&Cancel::new(), PATIENCE).unwrap_err();
    let finished = kept.lock().unwrap().finished;
    (error, finished)
}

fn pass(n: u64, out: &mut Outlet<u64>) {
    out.push(n);
}

/// Runs numbers through a kept stage, which saves them, and a stage that hangs on one of them until `release`.
fn cut_run(grace: Duration, release: mpsc::Receiver<()>) -> (crate::runtime::Report, Vec<u64>, bool) {
    let cancel = Cancel::new();
    let saved = std::sync::Arc::new(std::sync::Mutex::new((Vec::new(), false)));
    let (steps, ends, token) = (std::sync::Arc::clone(&saved), std::sync::Arc::clone(&saved), cancel.clone());
    let mut graph = Graph::new();
    let numbers = graph.source("count", 1, Count::to(u64::MAX));
    let save = move |n: u64, out: &mut Outlet<u64>| {
        steps.lock().unwrap().0.push(n);
        out.push(n);
        if n == 20 {
            token.cancel();
        }
        Ok(())
    };
    let finish = move |_: &mut Outlet<u64>| {
        ends.lock().unwrap().1 = true;
        Ok(())
    };
    let passed = graph.stage("save", 2, numbers, Each::with_finish(save, finish));
    let mut stuck = false;
    let long = graph.stage(
        "long",
        1,
        passed,
        Each::new(move |n, out: &mut Outlet<u64>| {
            if n == 19 && !std::mem::replace(&mut stuck, true) {
                let _ = release.recv();
            }
            pass(n, out);
            Ok(())
        }),
    );
    let (sink, _) = Keep::new();
    graph.sink("keep", long, sink);
    graph.cut_after(grace, &["save"]);
    let report = graph.run(&cancel, PATIENCE).unwrap();
    let (numbers, finished) = std::mem::take(&mut *saved.lock().unwrap());
    (report, numbers, finished)
}

#[test]
fn a_cancelled_run_abandons_a_long_step_but_not_kept_stages() {
    let (release, held) = mpsc::channel();
    let (report, numbers, finished) = cut_run(Duration::from_millis(100), held);
    assert!(report.cancelled && finished);
    // All items of the source were saved.
    assert_eq!(numbers, (0..report.stage("count").unwrap().items_out).collect::<Vec<_>>());
    assert!(report.cut.contains(&"long".to_owned()) && !report.cut.contains(&"save".to_owned()), "{report}");
    assert!(report.to_string().contains("cut short: long"), "{report}");
    drop(release);
}

#[test]
fn a_cancelled_run_that_ends_in_time_is_complete() {
    let (release, held) = mpsc::channel();
    drop(release);
    let (report, _, finished) = cut_run(PATIENCE, held);
    assert!(report.cancelled && finished && report.cut.is_empty());
    assert_eq!(report.stage("keep").unwrap().items_in, report.stage("count").unwrap().items_out);
}

#[test]
fn a_source_that_waits_for_something_else_does_not_hold_a_cancelled_run() {
    /// A source that hangs until it is released.
    struct Silent(mpsc::Receiver<()>);
    impl Source for Silent {
        type Out = u64;
        type Error = TestError;
        fn next(&mut self, _: &mut Outlet<u64>) -> Result<Flow, TestError> {
            let _ = self.0.recv();
            Ok(Flow::Continue)
        }
    }
    let (release, held) = mpsc::channel();
    let (cancel, mut graph) = (Cancel::new(), Graph::new());
    let numbers = graph.source("silent", 1, Silent(held));
    let (sink, kept) = Keep::new();
    graph.sink("keep", numbers, sink);
    graph.cut_after(Duration::ZERO, &["keep"]);
    cancel.cancel();
    // The source may notice the flag before it waits.
    let report = graph.run(&cancel, PATIENCE).unwrap();
    assert!(report.cancelled && kept.lock().unwrap().finished);
    drop(release);
}

#[test]
fn an_error_in_the_middle_has_stage_position_and_cause() {
    let (error, finished) = fail_with(Each::new(|n, out: &mut Outlet<u64>| {
        pass(n, out);
        if n == 41 { Err(TestError(n)) } else { Ok(()) }
    }));
    assert!(!finished, "a failed run must not look complete to its sink");
    assert_eq!(error.to_string(), "stage `middle` failed at item 41");
    let cause = error.source().and_then(|cause| cause.downcast_ref::<TestError>());
    assert_eq!(cause, Some(&TestError(41)));
}

#[test]
fn an_error_in_finish_is_distinguished() {
    let step = |n, out: &mut Outlet<u64>| {
        pass(n, out);
        Ok(())
    };
    let (error, finished) = fail_with(Each::with_finish(step, |_: &mut Outlet<u64>| Err(TestError(7))));
    assert!(!finished);
    assert!(matches!(error, RuntimeError::Failed { at: Moment::Finish(100), .. }), "{error:?}");
    assert_eq!(error.to_string(), "stage `middle` failed in finish, after 100 items");
}

#[test]
fn a_panic_in_a_stage_is_an_error() {
    let (error, finished) = fail_with(Each::new(|n, out: &mut Outlet<u64>| {
        assert!(n != 5, "five is right out");
        pass(n, out);
        Ok(())
    }));
    assert!(!finished);
    assert_eq!(error.to_string(), "stage `middle` panicked at item 5: five is right out");
}

#[test]
fn a_panic_while_a_stage_is_dropped_is_an_error() {
    struct Bomb;
    impl Drop for Bomb {
        fn drop(&mut self) {
            panic!("dropped");
        }
    }
    let bomb = Bomb;
    let (error, finished) = fail_with(Each::new(move |n, out: &mut Outlet<u64>| {
        let _ = &bomb;
        pass(n, out);
        Ok(())
    }));
    assert!(!finished);
    assert_eq!(error.to_string(), "stage `middle` panicked in finish, after 100 items: dropped");
}

#[test]
fn a_panic_in_a_sink_is_an_error() {
    let mut graph = Graph::new();
    let numbers = graph.source("count", 2, Count::to(u64::MAX));
    let number: u64 = 3;
    graph.sink(
        "end",
        numbers,
        Into::new(move |n: u64| if n == number { panic!("sink {n}") } else { Ok(()) }),
    );
    let error = graph.run(&Cancel::new(), PATIENCE).unwrap_err();
    assert_eq!(error.to_string(), "stage `end` panicked at item 3: sink 3");
}

/// A source that fails after three numbers.
struct Failing(u64);

impl Source for Failing {
    type Out = u64;
    type Error = TestError;

    fn next(&mut self, out: &mut Outlet<u64>) -> Result<Flow, TestError> {
        if self.0 == 3 {
            return Err(TestError(self.0));
        }
        out.push(self.0);
        self.0 += 1;
        Ok(Flow::Continue)
    }
}

/// A sink that fails in `finish`.
struct FailingSink;

impl Sink for FailingSink {
    type In = u64;
    type Error = TestError;

    fn take(&mut self, _: u64) -> Result<(), TestError> {
        Ok(())
    }

    fn finish(&mut self) -> Result<(), TestError> {
        Err(TestError(0))
    }
}

#[test]
fn errors_of_sources_and_sinks_have_their_position() {
    let mut graph = Graph::new();
    let numbers = graph.source("start", 2, Failing(0));
    let (sink, kept) = Keep::new();
    graph.sink("keep", numbers, sink);
    let error = graph.run(&Cancel::new(), PATIENCE).unwrap_err();
    assert_eq!(error.to_string(), "stage `start` failed at item 3");
    assert!(!kept.lock().unwrap().finished);

    let mut graph = Graph::new();
    let numbers = graph.source("count", 2, Count::to(4));
    graph.sink("end", numbers, FailingSink);
    let error = graph.run(&Cancel::new(), PATIENCE).unwrap_err();
    assert_eq!(error.to_string(), "stage `end` failed in finish, after 4 items");
}

#[test]
fn a_stage_that_stalls_ends_the_run_with_its_name() {
    let (release, held) = mpsc::channel::<()>();
    let mut graph = Graph::new();
    let numbers = graph.source("count", 2, Count::to(u64::MAX));
    let step = move |n, out: &mut Outlet<u64>| {
        if n == 9 {
            // Until the test drops the sender.
            held.recv().ok();
        }
        pass(n, out);
        Ok(())
    };
    let passed = graph.stage("middle", 2, numbers, Each::new(step));
    let (sink, kept) = Keep::new();
    graph.sink("keep", passed, sink);
    graph.fail_after_stall(Duration::from_secs(1));
    let error = graph.run(&Cancel::new(), Duration::from_millis(10)).unwrap_err();
    drop(release);
    let RuntimeError::Stalled { stages, unfinished, .. } = &error else { panic!("{error:?}") };
    assert!(stages.contains(&"middle".to_owned()) && unfinished.stages.contains(&"middle".to_owned()));
    assert!(error.to_string().contains("`middle`"), "{error}");
    let kept = kept.lock().unwrap();
    assert!(!kept.finished && kept.items == (0..9).collect::<Vec<_>>());
}

#[test]
fn cancellation_drains_and_finishes() {
    let cancel = Cancel::new();
    let trigger = cancel.clone();
    let mut graph = Graph::new();
    let numbers = graph.source("count", 7, Count::to(u64::MAX));
    let step = move |n, out: &mut Outlet<u64>| {
        if n == 50 {
            trigger.cancel();
        }
        pass(n, out);
        Ok(())
    };
    let flush = |out: &mut Outlet<u64>| {
        out.push(u64::MAX);
        Ok(())
    };
    let passed = graph.stage("middle", 3, numbers, Each::with_finish(step, flush));
    let (sink, kept) = Keep::new();
    graph.sink("keep", passed, sink);
    let report = graph.run(&cancel, PATIENCE).unwrap();

    assert!(report.cancelled);
    let kept = kept.lock().unwrap();
    assert!(kept.finished);
    let given = report.stage("count").unwrap().items_out;
    let expected: Vec<u64> = (0..given).chain([u64::MAX]).collect();
    assert_eq!(kept.items, expected);
}

#[test]
fn cancelling_a_run_that_is_complete_changes_nothing() {
    let cancel = Cancel::new();
    let trigger = cancel.clone();
    let mut graph = Graph::new();
    // The queues hold all numbers, so that the source ends without waiting.
    let numbers = graph.source("count", 16, Count::to(8));
    let (told, ended) = mpsc::channel();
    let wait = Each::with_finish(
        |n, out: &mut Outlet<u64>| {
            pass(n, out);
            Ok(())
        },
        move |_: &mut Outlet<u64>| {
            // Runs after the source has ended.
            trigger.cancel();
            told.send(()).map_err(|_| TestError(0))
        },
    );
    let passed = graph.stage("middle", 16, numbers, wait);
    let (sink, kept) = Keep::new();
    graph.sink("keep", passed, sink);
    let report = graph.run(&cancel, PATIENCE).unwrap();
    assert!(ended.recv().is_ok());
    assert!(!report.cancelled);
    assert_eq!(kept.lock().unwrap().items.len(), 8);
}

#[test]
fn a_stuck_stage_is_named() {
    let (release, stuck) = mpsc::channel::<()>();
    let mut graph = Graph::new();
    let numbers = graph.source("count", 1, Count::to(u64::MAX));
    let hang = Each::new(move |n: u64, out: &mut Outlet<u64>| {
        pass(n, out);
        if n == 2 {
            // Until the test drops the sender.
            let _ = stuck.recv();
        }
        Ok(())
    });
    let held = graph.stage("hang", 1, numbers, hang);
    let fail = Into::new(|n: u64| if n == 2 { Err(TestError(n)) } else { Ok(()) });
    graph.sink("fail", held, fail);
    let metrics = graph.metrics();
    let error = graph.run(&Cancel::new(), Duration::from_millis(300)).unwrap_err();

    let RuntimeError::Failed { stage, at, unfinished, .. } = &error else { panic!("{error:?}") };
    assert_eq!((stage.as_str(), *at), ("fail", Moment::Item(2)));
    assert_eq!(unfinished.stages, ["hang"]);
    assert!(error.to_string().contains("`hang`"), "{error}");
    drop(release);
    // The stage ends by itself once it no longer hangs.
    while !metrics.snapshot().iter().all(|stage| stage.ended) {
        std::thread::yield_now();
    }
}

#[test]
fn a_failure_wakes_a_chain_that_waits_for_its_source() {
    let (release, stuck) = mpsc::channel::<()>();
    /// A source that hangs until it is released.
    struct Silent(mpsc::Receiver<()>);
    impl Source for Silent {
        type Out = u64;
        type Error = TestError;
        fn next(&mut self, _: &mut Outlet<u64>) -> Result<Flow, TestError> {
            let _ = self.0.recv();
            Ok(Flow::Done)
        }
    }
    let mut graph = Graph::new();
    let nothing = graph.source("silent", 1, Silent(stuck));
    graph.sink("waiting", nothing, Into::new(|_: u64| Ok(())));
    let numbers = graph.source("count", 1, Count::to(u64::MAX));
    graph.sink("fail", numbers, Into::new(|n: u64| if n == 9 { Err(TestError(n)) } else { Ok(()) }));
    let error = graph.run(&Cancel::new(), Duration::from_secs(2)).unwrap_err();
    let RuntimeError::Failed { stage, unfinished, .. } = &error else { panic!("{error:?}") };
    assert_eq!(stage, "fail");
    // Not `waiting`, which was woken although its source was silent.
    assert_eq!(unfinished.stages, ["silent"]);
    drop(release);
}
