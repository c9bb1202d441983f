//! Errors of ranks.

use thiserror::Error;

/// Why ranks cannot work together.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[non_exhaustive]
pub enum RanksError {
    /// The program was built without MPI.
    #[error(
        "--mpi: this lunarray was built without MPI; expected one built with `cargo build --release --features mpi`, which needs \
         an MPI library and libclang (on Debian: apt install libopenmpi-dev openmpi-bin libclang-14-dev); see docs/cluster.md"
    )]
    NotBuilt,
    /// MPI was already started in this process.
    #[error("--mpi: MPI was started before in this process; expected to start it once")]
    AlreadyStarted,
    /// The MPI library does not support calls from several threads.
    #[error(
        "--mpi: the MPI library allows {found}; expected at least MPI_THREAD_SERIALIZED: maps are solved on a thread of their own"
    )]
    Threads {
        /// The thread support that the library offers.
        found: String,
    },
}
