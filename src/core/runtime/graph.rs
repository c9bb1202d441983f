//! Builds and runs graphs of stages with typed links.

use std::sync::Arc;
use std::time::Duration;

use crossbeam_channel::{Receiver, bounded};

use super::cancel::{Cancel, Halt};
use super::error::RuntimeError;
use super::metrics::{Counters, Metrics};
use super::outlet::{Outlet, Queue, StampedItem};
use super::report::Report;
use super::stage::{Sink, Source, Stage};
use super::supervisor;
use super::supervisor::Limits;
use super::worker::{Inlet, SinkWorker, SourceWorker, StageNode, StageWorker, Worker};

/// The output of a source or stage, not yet connected.
#[must_use = "this output is not connected: end the chain with a sink"]
pub struct Link<T> {
    receiver: Receiver<StampedItem<T>>,
    capacity: usize,
    from: usize,
    /// Identifies the graph to which the link belongs.
    halt: Arc<Halt>,
}

/// A graph of sources, stages and sinks, each of which runs on its own thread.
///
/// ```
/// use std::convert::Infallible;
/// use std::time::Duration;
///
/// use lunarray::runtime::{Cancel, Flow, Graph, Outlet, Sink, Source, Stage};
///
/// struct Numbers(std::ops::Range<u32>);
/// impl Source for Numbers {
///     type Out = u32;
///     type Error = Infallible;
///     fn next(&mut self, out: &mut Outlet<u32>) -> Result<Flow, Infallible> {
///         let Some(number) = self.0.next() else { return Ok(Flow::Done) };
///         out.push(number);
///         Ok(Flow::Continue)
///     }
/// }
///
/// struct Squares;
/// impl Stage for Squares {
///     type In = u32;
///     type Out = u32;
///     type Error = Infallible;
///     fn step(&mut self, number: u32, out: &mut Outlet<u32>) -> Result<(), Infallible> {
///         out.push(number * number);
///         Ok(())
///     }
/// }
///
/// struct Print;
/// impl Sink for Print {
///     type In = u32;
///     type Error = Infallible;
///     fn take(&mut self, square: u32) -> Result<(), Infallible> {
///         println!("{square}");
///         Ok(())
///     }
/// }
///
/// let mut graph = Graph::new();
/// let numbers = graph.source("numbers", 8, Numbers(0..100));
/// let squares = graph.stage("squares", 8, numbers, Squares);
/// graph.sink("print", squares, Print);
/// let report = graph.run(&Cancel::new(), Duration::from_secs(1))?;
/// assert_eq!(report.stages[1].items_out, 100);
/// # Ok::<(), lunarray::runtime::RuntimeError>(())
/// ```
pub struct Graph {
    nodes: Vec<StageNode>,
    metrics: Arc<Metrics>,
    halt: Arc<Halt>,
    /// Maximum time without progress before the run fails; `None` for no limit.
    stall: Option<Duration>,
    /// Time that a cancelled run waits for stages that are not kept; `None` for no limit.
    grace: Option<Duration>,
    build_error: Option<RuntimeError>,
}

impl Default for Graph {
    fn default() -> Self {
        Self::new()
    }
}

impl Graph {
    /// A graph without stages.
    #[must_use]
    pub fn new() -> Self {
        Self {
            nodes: Vec::new(),
            metrics: Arc::default(),
            halt: Arc::new(Halt::new()),
            stall: None,
            grace: None,
            build_error: None,
        }
    }

    /// Adds a source whose output queue holds `capacity` items.
    ///
    /// An error (a name in use, capacity 0) is reported by [`Graph::run`].
    pub fn source<S>(&mut self, name: &str, capacity: usize, source: S) -> Link<S::Out>
    where
        S: Source<Out: 'static> + 'static,
    {
        let counters = self.counters(name, None, source.units().name);
        let (out, link) = self.link(capacity, &counters);
        self.add(counters, Box::new(SourceWorker { source, out }), false);
        link
    }

    /// Adds a stage that reads `input`; its output queue holds `capacity` items.
    ///
    /// An error (a name in use, capacity 0, a link of another graph) is reported by [`Graph::run`].
    pub fn stage<S>(&mut self, name: &str, capacity: usize, input: Link<S::In>, stage: S) -> Link<S::Out>
    where
        S: Stage<In: 'static, Out: 'static> + 'static,
    {
        let counters = self.counters(name, Some(input.capacity), stage.units().name);
        let inlet = self.inlet(name, input);
        let (out, link) = self.link(capacity, &counters);
        self.add(counters, Box::new(StageWorker { stage, inlet, out }), false);
        link
    }

    /// Adds a sink that reads `input`.
    ///
    /// An error (a name in use, a link of another graph) is reported by [`Graph::run`].
    pub fn sink<S>(&mut self, name: &str, input: Link<S::In>, sink: S)
    where
        S: Sink<In: 'static> + 'static,
    {
        let counters = self.counters(name, Some(input.capacity), sink.units().name);
        let inlet = self.inlet(name, input);
        self.add(counters, Box::new(SinkWorker { sink, inlet }), true);
    }

    /// Makes the run fail after this time without progress, in which no step ended and no item was received or sent. It must
    /// exceed the longest step.
    #[doc(hidden)]
    pub fn fail_after_stall(&mut self, stall: Duration) {
        self.stall = Some(stall);
    }

    /// Limits the time that a cancelled run waits for its stages, except those named in `kept`.
    ///
    /// Kept stages are those that save data. After three tenths of `grace`, a stage before the first of them that is in a
    /// long step is abandoned: the stages after it take the items in their queues and run `finish`. After all of `grace`,
    /// the other stages end and their outputs are discarded; those in a long step are abandoned as well. Abandoned stages
    /// keep running, so the process should end. Kept stages, and sources that are flushing, may take longer.
    #[doc(hidden)]
    pub fn cut_after(&mut self, grace: Duration, kept: &[&str]) {
        self.grace = Some(grace);
        for node in &mut self.nodes {
            node.must_finish = kept.contains(&node.counters.name.as_str());
        }
    }

    /// Counters that can be read while the graph runs.
    #[must_use]
    pub fn metrics(&self) -> Arc<Metrics> {
        Arc::clone(&self.metrics)
    }

    /// Runs every stage on its own thread until all have ended.
    ///
    /// After `cancel` the sources stop and the other stages drain, without a time limit unless [`Graph::cut_after`] has set
    /// one. After a failure the stages have `deadline` to end. The error names those that have not ended; they keep running,
    /// as a thread cannot be stopped from outside, so the process should end.
    ///
    /// # Errors
    /// [`RuntimeError`]: an error in the graph, or the first failure of a stage.
    pub fn run(mut self, cancel: &Cancel, deadline: Duration) -> Result<Report, RuntimeError> {
        if let Some(build_error) = self.build_error.take() {
            return Err(build_error);
        }
        if let Some(open) = self.nodes.iter().find(|node| !node.is_connected) {
            return Err(RuntimeError::OpenEnd { stage: open.counters.name.clone() });
        }
        let limits = Limits { grace: self.grace, deadline, stall: self.stall };
        supervisor::run(self.nodes, &self.halt, cancel, limits)
    }

    fn counters(&mut self, name: &str, queue: Option<usize>, unit: &'static str) -> Arc<Counters> {
        if name.is_empty() || name.contains('\0') || self.metrics.knows(name) {
            self.note_build_error(RuntimeError::Name { stage: name.to_owned() });
        }
        let counters = Arc::new(Counters::new(name, queue, unit));
        self.metrics.add(Arc::clone(&counters));
        counters
    }

    fn link<T>(&mut self, capacity: usize, counters: &Arc<Counters>) -> (Outlet<T>, Link<T>) {
        if capacity == 0 {
            self.note_build_error(RuntimeError::Capacity { stage: counters.name.clone() });
        }
        let (sender, receiver) = bounded(capacity);
        let queue = Queue::new(sender, Arc::clone(&self.halt), Arc::clone(counters));
        let link = Link { receiver, capacity, from: self.nodes.len(), halt: Arc::clone(&self.halt) };
        (Outlet::queue(queue), link)
    }

    fn inlet<T>(&mut self, name: &str, link: Link<T>) -> Inlet<T> {
        if !Arc::ptr_eq(&link.halt, &self.halt) {
            self.note_build_error(RuntimeError::ForeignLink { stage: name.to_owned() });
        } else if let Some(from) = self.nodes.get_mut(link.from) {
            from.is_connected = true;
        }
        Inlet::new(link.receiver)
    }

    fn add(&mut self, counters: Arc<Counters>, worker: Box<dyn Worker>, is_connected: bool) {
        self.nodes.push(StageNode { counters, worker, is_connected, must_finish: false });
    }

    fn note_build_error(&mut self, build_error: RuntimeError) {
        self.build_error.get_or_insert(build_error);
    }
}
