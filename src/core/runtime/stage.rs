//! The traits of the three parts of a chain: sources, stages and sinks.

use std::error::Error;
use std::time::Duration;

use super::metrics::Units;
use super::outlet::Outlet;

/// Whether a source has more items.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// There may be more; call `next` again.
    Continue,
    /// The input has ended; call `finish`.
    Done,
}

/// Turns each input into any number of outputs, in order.
///
/// A stage never spawns threads, logs in its loop or reads clocks; the runtime does that.
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
    /// Type of the inputs.
    type In: Send;
    /// Type of the outputs.
    type Out: Send;
    /// Type of the errors.
    type Error: Error + Send + Sync + 'static;

    /// Processes one input and pushes the outputs.
    ///
    /// # Errors
    /// An error ends the whole run. Bad data are not an error; they are counted and dropped.
    fn step(&mut self, input: Self::In, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error>;

    /// Flushes the stage. Called once after the last input, unless the run has failed.
    ///
    /// # Errors
    /// Errors of [`Stage::step`].
    fn finish(&mut self, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error> {
        let _ = out;
        Ok(())
    }

    /// Called after a step if no further input waits, so that a stage can update its displayed state then and not in every step.
    #[doc(hidden)]
    fn idle(&mut self) {}

    /// Units processed so far. The name of the unit must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}

/// The start of a chain.
pub trait Source: Send {
    /// Type of the outputs.
    type Out: Send;
    /// Type of the errors.
    type Error: Error + Send + Sync + 'static;

    /// Pushes any number of items. It should return often, as cancellation and failures of other stages are checked
    /// between calls.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn next(&mut self, out: &mut Outlet<Self::Out>) -> Result<Flow, Self::Error>;

    /// Flushes the source. Called once after [`Flow::Done`] or cancellation.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn finish(&mut self, out: &mut Outlet<Self::Out>) -> Result<(), Self::Error> {
        let _ = out;
        Ok(())
    }

    /// Units produced so far. The name of the unit must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}

/// The end of a chain.
pub trait Sink: Send {
    /// Type of the inputs.
    type In: Send;
    /// Type of the errors.
    type Error: Error + Send + Sync + 'static;

    /// Takes one input.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn take(&mut self, input: Self::In) -> Result<(), Self::Error>;

    /// Flushes the sink. Called once after the last input, unless the run has failed.
    ///
    /// # Errors
    /// An error ends the whole run.
    fn finish(&mut self) -> Result<(), Self::Error> {
        Ok(())
    }

    /// Time without input after which [`Sink::retry`] is called; `None` if nothing has to be retried.
    #[doc(hidden)]
    fn retry_after(&self) -> Option<Duration> {
        None
    }

    /// Retries work on earlier inputs that failed.
    #[doc(hidden)]
    fn retry(&mut self) {}

    /// Units consumed so far. The name of the unit must not change.
    fn units(&self) -> Units {
        Units::default()
    }
}
