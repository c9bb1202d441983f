//! The MPI job that this process belongs to.

use super::{Ranks, RanksError};

/// The MPI job that this process is a rank of. Dropping it waits for all ranks and finalises MPI.
pub struct RankJob {
    /// Number of ranks on this machine.
    ranks_here: usize,
    #[cfg(feature = "mpi")]
    _universe: mpi::environment::Universe,
}

impl RankJob {
    /// Joins the job that `mpirun` or `srun` started this process in; a process started alone is a job of one rank.
    ///
    /// # Errors
    /// MPI was started before, or does not support threads.
    #[cfg(feature = "mpi")]
    pub fn start() -> Result<(Self, Ranks), RanksError> {
        let super::world::MpiJob { universe, ranks, ranks_here } = super::world::join()?;
        Ok((Self { ranks_here, _universe: universe }, ranks))
    }

    /// Always fails, because this program was built without MPI.
    ///
    /// # Errors
    /// [`RanksError::NotBuilt`].
    #[cfg(not(feature = "mpi"))]
    pub fn start() -> Result<(Self, Ranks), RanksError> {
        Err(RanksError::NotBuilt)
    }

    /// Number of ranks on this machine.
    #[must_use]
    pub fn ranks_here(&self) -> usize {
        self.ranks_here
    }

    /// Aborts all ranks of the job; this process ends with the exit code.
    pub fn abort(&self, code: u8) -> ! {
        #[cfg(feature = "mpi")]
        super::world::abort(code);
        #[cfg(not(feature = "mpi"))]
        std::process::exit(i32::from(code))
    }
}

impl Drop for RankJob {
    fn drop(&mut self) {
        // Finalising MPI would wait for the other ranks, which wait for this one.
        if std::thread::panicking() {
            self.abort(101);
        }
    }
}
