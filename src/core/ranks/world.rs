//! Exchange between the ranks of an MPI job through the MPI library.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use mpi::Threading;
use mpi::collective::SystemOperation;
use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator, CommunicatorCollectives};

use super::{RankExchange, RankShare, Ranks, RanksError};

/// Time after which this process aborts by itself if MPI has not ended the job.
const ABORT_TIMEOUT: Duration = Duration::from_secs(3);

/// An MPI job that was joined.
pub(super) struct MpiJob {
    /// Finalises MPI when it is dropped.
    pub(super) universe: Universe,
    pub(super) ranks: Ranks,
    /// Number of ranks on this machine.
    pub(super) ranks_here: usize,
}

/// Joins the job that this process was started in.
pub(super) fn join() -> Result<MpiJob, RanksError> {
    let (universe, threading) =
        mpi::initialize_with_threading(Threading::Serialized).ok_or(RanksError::AlreadyStarted)?;
    if threading < Threading::Serialized {
        return Err(RanksError::Threads { found: format!("{threading:?}") });
    }
    let world = universe.world();
    let to_usize = |of_c: i32| usize::try_from(of_c).unwrap_or(0);
    let share = RankShare { rank: to_usize(world.rank()), count: to_usize(world.size()).max(1) };
    let ranks_here = to_usize(world.split_shared(world.rank()).size()).max(1);
    Ok(MpiJob { universe, ranks: Ranks::new(share, Arc::new(World)), ranks_here })
}

/// Aborts all ranks of the job.
pub(super) fn abort(code: u8) -> ! {
    // MPI may be waiting for the other ranks on another thread. The job also ends when a process dies.
    thread::spawn(|| {
        thread::sleep(ABORT_TIMEOUT);
        std::process::abort();
    });
    SimpleCommunicator::world().abort(i32::from(code))
}

#[derive(Debug)]
struct World;

impl RankExchange for World {
    fn sum(&self, values: &mut [i64]) {
        let sent = values.to_vec();
        SimpleCommunicator::world().all_reduce_into(&sent[..], values, SystemOperation::sum());
    }

    fn max(&self, values: &mut [i64]) {
        let sent = values.to_vec();
        SimpleCommunicator::world().all_reduce_into(&sent[..], values, SystemOperation::max());
    }
}
