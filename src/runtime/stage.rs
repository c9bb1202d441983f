//! What a pipeline is made of.

use std::error::Error;

use super::outlet::Outlet;

/// Whether a source has more to give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// Ask again.
    Continue,
    /// Nothing more will come; `finish` is next.
    Done,
}

/// What a stage has dealt with so far, in a unit of its own (visibilities, bytes), for throughput.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Units {
    /// How many since the start.
    pub count: u64,
    /// Name of the unit in the plural; empty if the stage counts none.
    pub name: &'static str,
}

impl Units {
    /// `count` units called `name`.
    #[must_use]
    pub fn of(count: u64, name: &'static str) -> Self {
        Self { count, name }
    }
}

/// Turns inputs into any number of outputs each, in order.
///
/// A stage never spawns threads, logs in its loop or reads clocks: that is the runner's business.
pub trait Stage: Send {
    /// What it takes.
    type In: Send;
    /// What it gives.
    type Out: Send;
    /// Why it may fail.
    type Error: Error + Send + Sync + 'static;

    /// Works on one input, pushing what comes of it.
    ///
    /// # Errors
    /// An error ends the whole run: data that is merely bad is counted and dropped instead.
    fn step(&mut self, input: Self::In, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error>;

    /// Called once after the last input of a run that did not fail, cancelled or not; flushes.
    ///
    /// # Errors
    /// As [`Stage::step`].
    fn finish(&mut self, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error> {
        let _ = out;
        Ok(())
    }

    /// What was dealt with so far; the unit's name must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}

/// Where data comes from.
pub trait Source: Send {
    /// What it gives.
    type Out: Send;
    /// Why it may fail.
    type Error: Error + Send + Sync + 'static;

    /// Pushes the next items, any number of them. Should return often: cancellation and failure
    /// elsewhere are looked for between calls.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn next(&mut self, out: &mut Outlet<Self::Out>) -> Result<Flow, Self::Error>;

    /// Called once after [`Flow::Done`] or cancellation.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn finish(&mut self, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error> {
        let _ = out;
        Ok(())
    }

    /// What was given so far; the unit's name must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}

/// Where data ends.
pub trait Sink: Send {
    /// What it takes.
    type In: Send;
    /// Why it may fail.
    type Error: Error + Send + Sync + 'static;

    /// Takes one input.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn take(&mut self, input: Self::In) -> Result<(), Self::Error>;

    /// Called once after the last input of a run that did not fail, cancelled or not.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn finish(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }

    /// What was taken so far; the unit's name must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}
