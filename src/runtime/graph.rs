//! Graphs of stages with typed links.

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
    /// Which graph it belongs to.
    halt: Arc<Halt>,
}

/// Sources, stages and sinks, each to run on a thread of its own.
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
    /// Longest time without progress before the run fails; `None` for no limit.
    stall: Option<Duration>,
    /// How long a cancelled run waits for stages that are not kept; `None` for no limit.
    grace: Option<Duration>,
    /// First mistake in the calls that built the graph.
    mistake: Option<RuntimeError>,
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
            mistake: None,
        }
    }

    /// Adds a source whose output queue holds `capacity` items.
    ///
    /// A mistake (a name in use, capacity 0) is reported by [`Graph::run`].
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
    /// A mistake (a name in use, capacity 0, a link of another graph) is reported by [`Graph::run`].
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
    /// A mistake (a name in use, a link of another graph) is reported by [`Graph::run`].
    pub fn sink<S>(&mut self, name: &str, input: Link<S::In>, sink: S)
    where
        S: Sink<In: 'static> + 'static,
    {
        let counters = self.counters(name, Some(input.capacity), sink.units().name);
        let inlet = self.inlet(name, input);
        self.add(counters, Box::new(SinkWorker { sink, inlet }), true);
    }

    /// Makes the run fail after this time without progress: no step of any stage has ended, no item was received or
    /// sent. Must exceed the longest step.
    #[doc(hidden)]
    pub fn fail_after_stall(&mut self, stall: Duration) {
        self.stall = Some(stall);
    }

    /// Limits how long a cancelled run waits for its stages, except those named in `kept`.
    ///
    /// Kept stages are those that save data. After three tenths of `grace` a stage before the first of them that is in a
    /// long step is left behind: what follows it takes what is in the queues, and runs `finish`. When all of `grace` is
    /// over, everything else ends, and its outputs are discarded; stages in a long step are left behind, too. They keep
    /// running, as after a failure, so the process should end. Sources that hand over what they have, and kept stages, may
    /// take longer.
    #[doc(hidden)]
    pub fn cut_after(&mut self, grace: Duration, kept: &[&str]) {
        self.grace = Some(grace);
        for node in &mut self.nodes {
            node.kept = kept.contains(&node.counters.name.as_str());
        }
    }

    /// Counters that may be read while the graph runs.
    #[must_use]
    pub fn metrics(&self) -> Arc<Metrics> {
        Arc::clone(&self.metrics)
    }

    /// Runs every stage on its own thread until all have ended.
    ///
    /// After `cancel` the sources stop and the other stages drain, without a deadline unless [`Graph::cut_after`] has set
    /// one. After a failure the stages have
    /// `deadline` to end; the error names those that do not, which keep running. A thread cannot be ended from outside, so
    /// the process should be.
    ///
    /// # Errors
    /// [`RuntimeError`]: a mistake in the graph, or the first failure of a stage.
    pub fn run(mut self, cancel: &Cancel, deadline: Duration) -> Result<Report, RuntimeError> {
        if let Some(mistake) = self.mistake.take() {
            return Err(mistake);
        }
        if let Some(open) = self.nodes.iter().find(|node| !node.taken) {
            return Err(RuntimeError::OpenEnd { stage: open.counters.name.clone() });
        }
        let limits = Limits { grace: self.grace, deadline, stall: self.stall };
        supervisor::run(self.nodes, &self.halt, cancel, limits)
    }

    fn counters(&mut self, name: &str, queue: Option<usize>, unit: &'static str) -> Arc<Counters> {
        if name.is_empty() || name.contains('\0') || self.metrics.knows(name) {
            self.note(RuntimeError::Name { stage: name.to_owned() });
        }
        let counters = Arc::new(Counters::new(name, queue, unit));
        self.metrics.add(Arc::clone(&counters));
        counters
    }

    fn link<T>(&mut self, capacity: usize, counters: &Arc<Counters>) -> (Outlet<T>, Link<T>) {
        if capacity == 0 {
            self.note(RuntimeError::Capacity { stage: counters.name.clone() });
        }
        let (sender, receiver) = bounded(capacity);
        let queue = Queue::new(sender, Arc::clone(&self.halt), Arc::clone(counters));
        let link = Link { receiver, capacity, from: self.nodes.len(), halt: Arc::clone(&self.halt) };
        (Outlet::queue(queue), link)
    }

    fn inlet<T>(&mut self, name: &str, link: Link<T>) -> Inlet<T> {
        if !Arc::ptr_eq(&link.halt, &self.halt) {
            self.note(RuntimeError::ForeignLink { stage: name.to_owned() });
        } else if let Some(from) = self.nodes.get_mut(link.from) {
            from.taken = true;
        }
        Inlet::new(link.receiver)
    }

    fn add(&mut self, counters: Arc<Counters>, worker: Box<dyn Worker>, taken: bool) {
        self.nodes.push(StageNode { counters, worker, taken, kept: false });
    }

    fn note(&mut self, mistake: RuntimeError) {
        self.mistake.get_or_insert(mistake);
    }
}
