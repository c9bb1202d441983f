//! The native module of the Python package `lunarray`: what the library does, with arrays at its doors.
//!
//! Everything that takes time runs on a thread of its own without the interpreter's lock, while the caller looks for Ctrl-C
//! ([`wait`]). Names, defaults and documentation for users are in `lunarray/__init__.py`.

mod array;
mod chain;
mod downlink;
mod error;
mod ground;
mod joint;
mod maps;
mod wait;
mod writer;

use std::ffi::OsString;

use pyo3::prelude::*;

/// Runs a command line and returns its exit code; `words` begins with the program's name.
#[pyfunction]
fn run_command(py: Python<'_>, words: Vec<OsString>) -> u8 {
    py.detach(|| lunarray::cli::run_command(words))
}

/// Hz from a frequency such as `3MHz`.
#[pyfunction]
fn frequency_hz(text: &str) -> PyResult<f64> {
    let wrong = |expected| error::refused(format!("a frequency is {text:?}: {expected}"));
    lunarray::units::Dimension::Frequency.parse(text).map_err(wrong)
}

/// Native part of the package.
#[pymodule]
#[pyo3(name = "_native")]
mod native {
    #[pymodule_export]
    use super::array::{NativeArray, NativeEphemeris, predict};
    #[pymodule_export]
    use super::chain::{NativeReplay, run, solve_state};
    #[pymodule_export]
    use super::downlink::{NativeDownlink, inspect};
    #[pymodule_export]
    use super::error::{ConfigurationError, Error};
    #[pymodule_export]
    use super::ground::NativeGround;
    #[pymodule_export]
    use super::joint::joint;
    #[pymodule_export]
    use super::maps::{analysis, compare, read_map};
    #[pymodule_export]
    use super::writer::NativeWriter;
    #[pymodule_export]
    use super::{frequency_hz, run_command};

    #[pymodule_export]
    const VERSION: &str = env!("CARGO_PKG_VERSION");
}
