//! Errors as exceptions, with the text that the command line prints.

use std::error::Error as StdError;

use lunarray::pipeline::{ConfigError, PipelineError};
use pyo3::create_exception;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

create_exception!(lunarray, Error, PyException, "What the library refuses or cannot do.");
create_exception!(lunarray, ConfigurationError, Error, "Settings that are wrong: all problems together.");

/// An error of the library that has crossed a thread.
pub(crate) type Failure = Box<dyn StdError + Send + Sync>;

/// The exception of an error: its text, and the causes that this does not quote.
pub(crate) fn exception(error: impl Into<Failure>) -> PyErr {
    let error = error.into();
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        let more = error.to_string();
        if !text.contains(&more) {
            text = format!("{text}\n  because: {more}");
        }
        cause = error.source();
    }
    let of_settings = error.is::<ConfigError>()
        || matches!(error.downcast_ref::<PipelineError>(), Some(PipelineError::Config(_)));
    if of_settings { ConfigurationError::new_err(text) } else { Error::new_err(text) }
}

/// The exception of a value that is wrong.
pub(crate) fn refused(text: String) -> PyErr {
    Error::new_err(text)
}
