//! The three parts of a chain: sources, stages and sinks.

use std::error::Error;
use std::time::Duration;

use super::metrics::Units;
use super::outlet::Outlet;

/// Whether a source has more to give.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// Call `next` again.
    Continue,
    /// The input has ended; call `finish`.
    Done,
}

/// Turns each input into any number of outputs, in order.
///
/// A stage never spawns threads, logs in its loop or reads clocks: the runner does that.
///
/// ```
/// use lunarray::prelude::*;
///
/// /// Doubles numbers, and leaves out odd ones.
/// struct Doubled;
///
/// impl Stage for Doubled {
///     type In = u32;
///     type Out = u32;
///     type Error = std::convert::Infallible;
///
///     fn step(&mut self, number: u32, out: &mut Outlet<u32>) -> Result<(), Self::Error> {
///         if number % 2 == 0 {
///             out.push(2 * number);
///         }
///         Ok(())
///     }
/// }
///
/// // Alone, as in tests; `Graph::stage` puts it on a thread between bounded queues.
/// let mut out = Outlet::collect();
/// for number in 0..4 {
///     Doubled.step(number, &mut out)?;
/// }
/// assert_eq!(out.into_vec(), [0, 4]);
/// # Ok::<(), std::convert::Infallible>(())
/// ```
pub trait Stage: Send {
    /// Type of its inputs.
    type In: Send;
    /// Type of its outputs.
    type Out: Send;
    /// Its error.
    type Error: Error + Send + Sync + 'static;

    /// Processes one input and pushes the outputs.
    ///
    /// # Errors
    /// An error ends the whole run. Bad data is not an error: it is counted and dropped.
    fn step(&mut self, input: Self::In, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error>;

    /// Flushes; called once after the last input of a run that did not fail, cancelled or not.
    ///
    /// # Errors
    /// As [`Stage::step`].
    fn finish(&mut self, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error> {
        let _ = out;
        Ok(())
    }

    /// Called after a step when no further input waits, so that what it shows of itself need not be shown in every step to be the
    /// newest while nothing comes.
    #[doc(hidden)]
    fn rest(&mut self) {}

    /// Units processed so far; the name of the unit must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}

/// The start of a chain.
pub trait Source: Send {
    /// Type of its outputs.
    type Out: Send;
    /// Its error.
    type Error: Error + Send + Sync + 'static;

    /// Pushes the next items, any number of them. Should return often: the runner looks for cancellation and failures
    /// of other stages between calls.
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

    /// Units produced so far; the name of the unit must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}

/// The end of a chain.
pub trait Sink: Send {
    /// Type of its inputs.
    type In: Send;
    /// Its error.
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

    /// After which time without input [`Sink::try_again`] is due, if it has something left to do.
    #[doc(hidden)]
    fn tries_again_after(&self) -> Option<Duration> {
        None
    }

    /// Tries again what it could not do with an input.
    #[doc(hidden)]
    fn try_again(&mut self) {}

    /// Units consumed so far; the name of the unit must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}
