//! Where tests find what is not in the repository.
#![allow(clippy::panic)] // A test fails by panicking.
#![allow(dead_code)] // Each test file uses its part.

pub mod downlink;
pub mod process;
pub mod schema;
pub mod workplace;

use std::path::PathBuf;

/// A file of the independent reference values and sky maps, below the folder that `LUNARRAY_SHARED` names.
///
/// Tests that ask for it are ignored by name, and fail without it when somebody asks for ignored ones.
pub fn shared(file: &str) -> PathBuf {
    find("LUNARRAY_SHARED", file)
}

/// The Python interpreter that has healpy and friends, from `LUNARRAY_PYTHON`.
pub fn python() -> PathBuf {
    find("LUNARRAY_PYTHON", "")
}

/// A program with MPI, from `LUNARRAY_MPI`: only `.ci/run mpi` builds it, and runs the tests whose names begin with `mpi_`.
pub fn mpi_program() -> PathBuf {
    find("LUNARRAY_MPI", "")
}

fn find(variable: &str, file: &str) -> PathBuf {
    let base = std::env::var_os(variable)
        .unwrap_or_else(|| panic!("{variable} is not set; CONTRIBUTING.md says what it names"));
    let path = if file.is_empty() { PathBuf::from(base) } else { PathBuf::from(base).join(file) };
    assert!(path.exists(), "{variable} is set, but there is no {}", path.display());
    path
}
