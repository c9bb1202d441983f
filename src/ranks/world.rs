//! All ranks of an MPI job, by way of the MPI library.

use std::sync::Arc;
use std::thread;
use std::time::Duration;

use mpi::Threading;
use mpi::collective::SystemOperation;
use mpi::environment::Universe;
use mpi::topology::SimpleCommunicator;
use mpi::traits::{Communicator, CommunicatorCollectives};

use super::{RankExchange, RankShare, Ranks, RanksError};

/// Time that MPI has to end a job, before this process ends without it.
const ABORT: Duration = Duration::from_secs(3);

/// What joining a job yields.
pub(super) struct MpiJob {
    /// Finalises MPI when it is dropped.
    pub(super) universe: Universe,
    pub(super) ranks: Ranks,
    /// Ranks on this machine.
    pub(super) here: usize,
}

/// Joins the job that the process was started in, which may be the process alone.
pub(super) fn join() -> Result<MpiJob, RanksError> {
    let (universe, threading) =
        mpi::initialize_with_threading(Threading::Serialized).ok_or(RanksError::AlreadyStarted)?;
    if threading < Threading::Serialized {
        return Err(RanksError::Threads { found: format!("{threading:?}") });
    }
    let world = universe.world();
    let number = |of_c: i32| usize::try_from(of_c).unwrap_or(0);
    let share = RankShare { rank: number(world.rank()), count: number(world.size()).max(1) };
    let here = number(world.split_shared(world.rank()).size()).max(1);
    Ok(MpiJob { universe, ranks: Ranks::new(share, Arc::new(World)), here })
}

/// Ends all ranks at once.
pub(super) fn abort(code: u8) -> ! {
    // MPI may be waiting for the others on another thread. A process that dies takes the job with it, too.
    thread::spawn(|| {
        thread::sleep(ABORT);
        std::process::abort();
    });
    SimpleCommunicator::world().abort(i32::from(code))
}

#[derive(Debug)]
struct World;

impl RankExchange for World {
    fn sum(&self, values: &mut [i64]) {
        let own = values.to_vec();
        SimpleCommunicator::world().all_reduce_into(&own[..], values, SystemOperation::sum());
    }

    fn greatest(&self, values: &mut [i64]) {
        let own = values.to_vec();
        SimpleCommunicator::world().all_reduce_into(&own[..], values, SystemOperation::max());
    }
}
