//! Overhead of the runtime: items per second through chains of stages that do nothing, and the ratio to
//! bare threads around the same channels in the same run.
//!
//! `cargo bench --bench runtime`. Runtime and bare threads alternate, and the best of each counts, so that other
//! load on the machine affects both alike.

use std::convert::Infallible;
use std::error::Error;
use std::hint::black_box;
use std::thread;
use std::time::{Duration, Instant};

use crossbeam_channel::bounded;
use lunarray::runtime::{Cancel, Flow, Graph, Outlet, Sink, Source, Stage};

struct Count {
    next: u64,
    count: u64,
}

impl Source for Count {
    type Out = u64;
    type Error = Infallible;

    fn next(&mut self, out: &mut Outlet<u64>) -> Result<Flow, Infallible> {
        out.push(self.next);
        self.next += 1;
        Ok(if self.next < self.count { Flow::Continue } else { Flow::Done })
    }
}

struct Pass;

impl Stage for Pass {
    type In = u64;
    type Out = u64;
    type Error = Infallible;

    fn step(&mut self, input: u64, out: &mut Outlet<u64>) -> Result<(), Infallible> {
        out.push(black_box(input));
        Ok(())
    }
}

struct Ignore;

impl Sink for Ignore {
    type In = u64;
    type Error = Infallible;

    fn take(&mut self, input: u64) -> Result<(), Infallible> {
        black_box(input);
        Ok(())
    }
}

/// Time for `count` items through `hops` queues of `capacity`, with the runtime.
fn graph(count: u64, hops: usize, capacity: usize) -> Result<Duration, Box<dyn Error>> {
    let since = Instant::now();
    let mut graph = Graph::new();
    let mut link = graph.source("source", capacity, Count { next: 0, count });
    for hop in 1..hops {
        link = graph.stage(&format!("stage {hop}"), capacity, link, Pass);
    }
    graph.sink("sink", link, Ignore);
    let report = graph.run(&Cancel::new(), Duration::from_secs(10))?;
    assert_eq!(report.stage("sink").map(|sink| sink.items_in), Some(count));
    Ok(since.elapsed())
}

/// As [`graph`], with bare threads.
fn bare(count: u64, hops: usize, capacity: usize) -> Result<Duration, Box<dyn Error>> {
    let since = Instant::now();
    let received = thread::scope(|scope| {
        let (sender, mut receiver) = bounded(capacity);
        scope.spawn(move || (0..count).try_for_each(|n| sender.send(n)));
        for _ in 1..hops {
            let (next_sender, next_receiver) = bounded(capacity);
            let input = std::mem::replace(&mut receiver, next_receiver);
            scope.spawn(move || input.iter().try_for_each(|n| next_sender.send(black_box(n))));
        }
        receiver.iter().map(black_box).count()
    });
    assert_eq!(received as u64, count);
    Ok(since.elapsed())
}

fn main() -> Result<(), Box<dyn Error>> {
    const ITEMS: u64 = 200_000;
    const ROUNDS: usize = 5;
    println!("hops  capacity  graph M items/s/hop   bare M items/s/hop  ratio  added ns per item, hop");
    for (hops, capacity) in [(1, 16), (1, 1024), (3, 16), (3, 1024), (7, 64)] {
        let (mut with, mut without) = (Duration::MAX, Duration::MAX);
        for _ in 0..ROUNDS {
            with = with.min(graph(ITEMS, hops, capacity)?);
            without = without.min(bare(ITEMS, hops, capacity)?);
        }
        let passed = ITEMS as f64 * hops as f64;
        let rate = |time: Duration| passed / time.as_secs_f64() * 1e-6;
        println!(
            "{hops:>4}  {capacity:>8}  {:>20.2}  {:>18.2}  {:>5.2}  {:>23.0}",
            rate(with),
            rate(without),
            rate(with) / rate(without),
            (with.as_secs_f64() - without.as_secs_f64()) / passed * 1e9,
        );
    }
    Ok(())
}
