//! Where tests find what is not in the repository.
#![allow(dead_code)] // Each test file uses its part.

pub mod downlink;
pub mod process;
pub mod schema;
pub mod workplace;

use std::path::PathBuf;

/// A file of the independent reference values and sky maps, below the folder that `LUNARRAY_SHARED`
/// names; `None`, said aloud, when the variable is not set.
pub fn shared(file: &str) -> Option<PathBuf> {
    find("LUNARRAY_SHARED", file)
}

/// The Python interpreter that has healpy and friends, from `LUNARRAY_PYTHON`; `None`, said aloud, when it
/// is not set.
pub fn python() -> Option<PathBuf> {
    find("LUNARRAY_PYTHON", "")
}

/// A program with MPI, from `LUNARRAY_MPI`; `None`, said aloud, when it is not set: only `.ci/run mpi` builds it.
pub fn mpi_program() -> Option<PathBuf> {
    if std::env::var_os("LUNARRAY_MPI").is_none() {
        eprintln!("without MPI: LUNARRAY_MPI is not set");
        return None;
    }
    find("LUNARRAY_MPI", "")
}

fn find(variable: &str, file: &str) -> Option<PathBuf> {
    let Some(base) = std::env::var_os(variable) else {
        eprintln!("skipped: {variable} is not set");
        return None;
    };
    let path = if file.is_empty() { PathBuf::from(base) } else { PathBuf::from(base).join(file) };
    assert!(path.exists(), "{variable} is set, but there is no {}", path.display());
    Some(path)
}
