//! The MPI job that a process is a rank of.

use super::{Ranks, RanksError};

/// The MPI job that this process is a rank of. It ends in order when this is dropped, once all ranks have come so far.
pub struct RankJob {
    /// Ranks on this machine.
    here: usize,
    #[cfg(feature = "mpi")]
    _universe: mpi::environment::Universe,
}

impl RankJob {
    /// Joins the job that the process was started in: by `mpirun` or `srun`, or alone.
    ///
    /// # Errors
    /// MPI that was started before, or that does not work with threads.
    #[cfg(feature = "mpi")]
    pub fn start() -> Result<(Self, Ranks), RanksError> {
        let super::world::MpiJob { universe, ranks, here } = super::world::join()?;
        Ok((Self { here, _universe: universe }, ranks))
    }

    /// Refuses: this program was built without MPI.
    ///
    /// # Errors
    /// [`RanksError::NotBuilt`].
    #[cfg(not(feature = "mpi"))]
    pub fn start() -> Result<(Self, Ranks), RanksError> {
        Err(RanksError::NotBuilt)
    }

    /// Ranks on this machine.
    #[must_use]
    pub fn ranks_here(&self) -> usize {
        self.here
    }

    /// Ends all ranks at once, this one with the exit code.
    pub fn abort(&self, code: u8) -> ! {
        #[cfg(feature = "mpi")]
        super::world::abort(code);
        #[cfg(not(feature = "mpi"))]
        std::process::exit(i32::from(code))
    }
}

impl Drop for RankJob {
    fn drop(&mut self) {
        // To end in order would be to wait for the others, which wait for this rank.
        if std::thread::panicking() {
            self.abort(101);
        }
    }
}
