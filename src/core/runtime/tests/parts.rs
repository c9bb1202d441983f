//! Sources, stages and sinks made from functions.

use std::marker::PhantomData;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use thiserror::Error;

use crate::runtime::{Flow, Outlet, Sink, Source, Stage, Units};

/// Time limit of test runs, which only a deadlock reaches.
pub const PATIENCE: Duration = Duration::from_secs(60);

#[derive(Debug, Error, PartialEq, Eq)]
#[error("refused {0}")]
pub struct TestError(pub u64);

/// A source of the numbers `0..count`, one per call.
pub struct Count {
    pub next: u64,
    pub count: u64,
}

impl Count {
    pub fn to(count: u64) -> Self {
        Self { next: 0, count }
    }
}

impl Source for Count {
    type Out = u64;
    type Error = TestError;

    fn next(&mut self, out: &mut Outlet<u64>) -> Result<Flow, TestError> {
        if self.next == self.count {
            return Ok(Flow::Done);
        }
        out.push(self.next);
        self.next += 1;
        Ok(Flow::Continue)
    }

    fn units(&self) -> Units {
        Units::of(self.next, "numbers")
    }
}

/// A stage made from a function for steps and one for the end.
pub struct Each<I, O, F, G> {
    step: F,
    finish: G,
    kind: PhantomData<fn(I) -> O>,
}

impl<I, O, F> Each<I, O, F, fn(&mut Outlet<O>) -> Result<(), TestError>>
where
    F: FnMut(I, &mut Outlet<O>) -> Result<(), TestError>,
{
    pub fn new(step: F) -> Self {
        Self { step, finish: |_| Ok(()), kind: PhantomData }
    }
}

impl<I, O, F, G> Each<I, O, F, G>
where
    F: FnMut(I, &mut Outlet<O>) -> Result<(), TestError>,
    G: FnMut(&mut Outlet<O>) -> Result<(), TestError>,
{
    pub fn with_finish(step: F, finish: G) -> Self {
        Self { step, finish, kind: PhantomData }
    }
}

impl<I, O, F, G> Stage for Each<I, O, F, G>
where
    I: Send,
    O: Send,
    F: FnMut(I, &mut Outlet<O>) -> Result<(), TestError> + Send,
    G: FnMut(&mut Outlet<O>) -> Result<(), TestError> + Send,
{
    type In = I;
    type Out = O;
    type Error = TestError;

    fn step(&mut self, input: I, out: &mut Outlet<O>) -> Result<(), TestError> {
        (self.step)(input, out)
    }

    fn finish(&mut self, out: &mut Outlet<O>) -> Result<(), TestError> {
        (self.finish)(out)
    }
}

/// The items that a [`Keep`] has taken, and whether it finished.
#[derive(Debug)]
pub struct Kept<T> {
    pub items: Vec<T>,
    pub finished: bool,
}

/// A sink that keeps all items for the test.
pub struct Keep<T>(Arc<Mutex<Kept<T>>>);

impl<T> Keep<T> {
    pub fn new() -> (Self, Arc<Mutex<Kept<T>>>) {
        let kept = Arc::new(Mutex::new(Kept { items: Vec::new(), finished: false }));
        (Self(Arc::clone(&kept)), kept)
    }
}

impl<T: Send> Sink for Keep<T> {
    type In = T;
    type Error = TestError;

    fn take(&mut self, input: T) -> Result<(), TestError> {
        self.0.lock().unwrap().items.push(input);
        Ok(())
    }

    fn finish(&mut self) -> Result<(), TestError> {
        self.0.lock().unwrap().finished = true;
        Ok(())
    }
}

/// A sink made from a function.
pub struct Into<I, F> {
    take: F,
    kind: PhantomData<fn(I)>,
}

impl<I, F: FnMut(I) -> Result<(), TestError>> Into<I, F> {
    pub fn new(take: F) -> Self {
        Self { take, kind: PhantomData }
    }
}

impl<I: Send, F: FnMut(I) -> Result<(), TestError> + Send> Sink for Into<I, F> {
    type In = I;
    type Error = TestError;

    fn take(&mut self, input: I) -> Result<(), TestError> {
        (self.take)(input)
    }
}
