//! Order, back pressure and counters, and graphs that cannot run.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, mpsc};
use std::time::{Duration, Instant};

use super::parts::{Count, Each, Into, Keep, PATIENCE, TestError};
use crate::runtime::{Cancel, Flow, Graph, Outlet, RuntimeError, Source, Stage};

/// A stage that emits each number twice, and -1 at the end.
fn twice() -> impl Stage<In = u64, Out = i64, Error = TestError> {
    Each::with_finish(
        |n: u64, out: &mut Outlet<i64>| {
            out.push(n as i64);
            out.push(n as i64);
            Ok(())
        },
        |out: &mut Outlet<i64>| {
            out.push(-1);
            Ok(())
        },
    )
}

#[test]
fn a_stage_runs_alone() {
    let mut out = Outlet::collect();
    let mut stage = twice();
    stage.step(3, &mut out).unwrap();
    stage.finish(&mut out).unwrap();
    assert_eq!(out.into_vec(), [3, 3, -1]);
}

#[test]
fn order_is_kept_whatever_the_capacities() {
    let expected: Vec<i64> = (0..500).flat_map(|n| [n, n]).chain([-1]).collect();
    for capacity in 1..=64 {
        let mut graph = Graph::new();
        let numbers = graph.source("count", capacity, Count::to(500));
        let doubled = graph.stage("twice", 65 - capacity, numbers, twice());
        let (sink, kept) = Keep::new();
        graph.sink("keep", doubled, sink);
        let report = graph.run(&Cancel::new(), PATIENCE).unwrap();
        assert!(!report.cancelled);
        let kept = kept.lock().unwrap();
        assert!(kept.finished);
        assert_eq!(kept.items, expected, "capacity {capacity}");
    }
}

#[test]
fn the_report_counts_what_passed() {
    let mut graph = Graph::new();
    let metrics = graph.metrics();
    let numbers = graph.source("count", 4, Count::to(100));
    let doubled = graph.stage("twice", 8, numbers, twice());
    graph.sink("drop", doubled, Into::new(|_| Ok(())));
    let report = graph.run(&Cancel::new(), PATIENCE).unwrap();

    let names: Vec<&str> = report.stages.iter().map(|stage| stage.name.as_str()).collect();
    assert_eq!(names, ["count", "twice", "drop"]);
    let flows: Vec<(u64, u64)> = report.stages.iter().map(|s| (s.items_in, s.items_out)).collect();
    assert_eq!(flows, [(0, 100), (100, 201), (201, 0)]);
    assert_eq!((report.stages[0].units, report.stages[0].unit), (100, "numbers"));
    assert_eq!(report.stages[0].queue, None);
    for (stage, capacity) in report.stages[1..].iter().zip([4, 8]) {
        let queue = stage.queue.unwrap();
        assert_eq!(queue.capacity, capacity);
        assert!((1..=capacity).contains(&queue.depth_max), "{queue:?}");
        assert_eq!(stage.since_source.count, stage.items_in);
        // One entry per input and one for the end.
        assert_eq!(stage.waiting_in.count, stage.items_in + 1);
        assert_eq!(stage.working.count, stage.items_in + 1);
    }
    for (live, stage) in metrics.snapshot().iter().zip(&report.stages) {
        assert!(live.ended);
        assert_eq!((live.items_in, live.items_out), (stage.items_in, stage.items_out));
    }
    let table = report.to_string();
    assert_eq!(table.lines().count(), 5, "{table}");
    assert!(names.iter().all(|name| table.contains(name)), "{table}");
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["stages"][2]["items_in"], 201);
}

#[test]
fn latency_counts_from_the_arrival_at_the_source() {
    /// A source with one number that has waited and one that has not.
    struct Late(Option<Instant>);
    impl Source for Late {
        type Out = u64;
        type Error = TestError;
        fn next(&mut self, out: &mut Outlet<u64>) -> Result<Flow, TestError> {
            if let Some(since) = self.0.take() {
                out.push_since(1, since);
                return Ok(Flow::Continue);
            }
            out.push(2);
            Ok(Flow::Done)
        }
    }
    let waited = Duration::from_secs(1);
    let since = Instant::now();
    std::thread::sleep(waited);
    let mut graph = Graph::new();
    let numbers = graph.source("late", 2, Late(Some(since)));
    let passed = Each::new(|n: u64, out: &mut Outlet<u64>| {
        out.push(n);
        Ok(())
    });
    let numbers = graph.stage("pass", 2, numbers, passed);
    let (sink, kept) = Keep::new();
    graph.sink("keep", numbers, sink);
    let report = graph.run(&Cancel::new(), PATIENCE).unwrap();
    assert_eq!(kept.lock().unwrap().items, [1, 2]);
    for stage in &report.stages[1..] {
        let found = stage.since_source;
        assert!(found.max_s >= waited.as_secs_f64(), "{found:?}");
        // The second number is new, so the sum is below twice the maximum.
        assert!(found.count == 2 && found.total_s < 2.0 * found.max_s, "{found:?}");
    }
}

/// An item that counts how many of its kind exist.
struct Tracked(Arc<AtomicUsize>);

impl Drop for Tracked {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

#[test]
fn a_slow_sink_bounds_what_is_in_flight() {
    const CAPACITIES: [usize; 2] = [3, 5];
    const STAGES: usize = 3;
    let alive = Arc::new(AtomicUsize::new(0));
    let alive_max = Arc::new(AtomicUsize::new(0));
    let (alive_in_stage, alive_max_in_stage) = (Arc::clone(&alive), Arc::clone(&alive_max));

    let mut graph = Graph::new();
    let numbers = graph.source("count", 1, Count::to(200));
    let make = Each::new(move |_: u64, out: &mut Outlet<Tracked>| {
        let now = alive_in_stage.fetch_add(1, Ordering::SeqCst) + 1;
        alive_max_in_stage.fetch_max(now, Ordering::SeqCst);
        out.push(Tracked(Arc::clone(&alive_in_stage)));
        Ok(())
    });
    let made = graph.stage("make", CAPACITIES[0], numbers, make);
    let pass = Each::new(|item: Tracked, out: &mut Outlet<Tracked>| {
        out.push(item);
        Ok(())
    });
    let passed = graph.stage("pass", CAPACITIES[1], made, pass);
    let slow = Into::new(|_: Tracked| {
        std::thread::sleep(Duration::from_micros(200));
        Ok(())
    });
    graph.sink("slow", passed, slow);
    graph.run(&Cancel::new(), PATIENCE).unwrap();

    assert_eq!(alive.load(Ordering::SeqCst), 0);
    let alive_max = alive_max.load(Ordering::SeqCst);
    let bound = CAPACITIES.iter().sum::<usize>() + STAGES;
    assert!(alive_max <= bound, "{alive_max} in flight, expected at most {bound}");
    // The queues were full, as the source is faster.
    assert!(alive_max > CAPACITIES[1], "{alive_max}");
}

#[test]
fn several_chains_run_side_by_side() {
    let mut graph = Graph::new();
    let (first, kept_first) = Keep::new();
    let (second, kept_second) = Keep::new();
    let one = graph.source("one", 1, Count::to(10));
    let other = graph.source("other", 1, Count::to(20));
    graph.sink("first", one, first);
    graph.sink("second", other, second);
    graph.run(&Cancel::new(), PATIENCE).unwrap();
    assert_eq!(kept_first.lock().unwrap().items.len(), 10);
    assert_eq!(kept_second.lock().unwrap().items.len(), 20);
}

#[test]
fn an_empty_graph_ends_at_once() {
    let report = Graph::new().run(&Cancel::new(), PATIENCE).unwrap();
    assert!(report.stages.is_empty());
    assert_eq!(report.to_string().lines().count(), 2);
}

#[test]
fn graphs_that_cannot_run_are_refused() {
    let run = |graph: Graph| graph.run(&Cancel::new(), PATIENCE).unwrap_err();
    let ignore = || Into::new(|_: u64| Ok(()));

    let mut graph = Graph::new();
    let link = graph.source("count", 0, Count::to(1));
    graph.sink("end", link, ignore());
    assert!(matches!(run(graph), RuntimeError::Capacity { stage } if stage == "count"));

    let mut graph = Graph::new();
    let link = graph.source("same", 1, Count::to(1));
    graph.sink("same", link, ignore());
    assert!(matches!(run(graph), RuntimeError::Name { stage } if stage == "same"));

    for name in ["", "nul\0"] {
        let mut graph = Graph::new();
        let link = graph.source(name, 1, Count::to(1));
        graph.sink("end", link, ignore());
        assert!(matches!(run(graph), RuntimeError::Name { .. }));
    }

    let mut graph = Graph::new();
    let link = graph.source("count", 1, Count::to(1));
    drop(link);
    assert!(matches!(run(graph), RuntimeError::OpenEnd { stage } if stage == "count"));

    let mut graph = Graph::new();
    let mut other = Graph::new();
    let link = other.source("count", 1, Count::to(1));
    graph.sink("end", link, ignore());
    assert!(matches!(run(graph), RuntimeError::ForeignLink { stage } if stage == "end"));
}

#[test]
fn idle_is_called_after_the_last_waiting_item() {
    /// A source of three numbers, which then waits until the stage was idle after the third.
    struct Pausing(mpsc::Receiver<u64>, bool);
    impl Source for Pausing {
        type Out = u64;
        type Error = TestError;
        fn next(&mut self, out: &mut Outlet<u64>) -> Result<Flow, TestError> {
            if !std::mem::replace(&mut self.1, true) {
                (1..=3).for_each(|n| out.push(n));
                return Ok(Flow::Continue);
            }
            while self.0.recv_timeout(PATIENCE).map_err(|_| TestError(0))? < 3 {}
            Ok(Flow::Done)
        }
    }
    struct Shown(mpsc::Sender<u64>, u64);
    impl Stage for Shown {
        type In = u64;
        type Out = u64;
        type Error = TestError;
        fn step(&mut self, n: u64, out: &mut Outlet<u64>) -> Result<(), TestError> {
            self.1 = n;
            out.push(n);
            Ok(())
        }
        fn idle(&mut self) {
            let _ = self.0.send(self.1);
        }
    }
    let (show, shown) = mpsc::channel();
    let mut graph = Graph::new();
    let numbers = graph.source("pausing", 8, Pausing(shown, false));
    let numbers = graph.stage("shown", 8, numbers, Shown(show, 0));
    let (sink, kept) = Keep::new();
    graph.sink("keep", numbers, sink);
    graph.run(&Cancel::new(), PATIENCE).unwrap();
    assert_eq!(kept.lock().unwrap().items, [1, 2, 3]);
}
