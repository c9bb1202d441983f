//! The ranks of an MPI job (`--mpi`, feature `mpi`): processes that share the sums of a map, and what they exchange.
//!
//! Each rank runs the whole chain and holds a part of the sums. Ranks exchange integers alone, never floats, whose sums would
//! depend on the number of ranks. All make the same collective calls in the same order, from one thread at a time. The others
//! would wait for ever for a rank that leaves early: it ends the job ([`RankJob::abort`]).

mod error;
mod job;
#[cfg(test)]
mod threads;
#[cfg(feature = "mpi")]
mod world;

use std::fmt;
use std::sync::Arc;

pub use error::RanksError;
pub use job::RankJob;
#[cfg(test)]
pub(crate) use threads::on_threads;

/// How ranks exchange numbers. Every rank calls the same functions in the same order, with as many values.
pub trait RankExchange: fmt::Debug + Send + Sync {
    /// Replaces each value by the sum over all ranks; it must not leave 64 bits.
    fn sum(&self, values: &mut [i64]);

    /// Replaces each value by the greatest of all ranks.
    fn greatest(&self, values: &mut [i64]);
}

/// A process's place among those that share the sums of a map.
#[derive(Clone, Debug)]
pub struct Ranks {
    share: RankShare,
    /// `None` for a process alone.
    exchange: Option<Arc<dyn RankExchange>>,
}

/// Which blocks of something a rank holds: every `count`-th from `rank` on, so that data of any span in time are shared evenly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RankShare {
    /// Number of this rank, from 0.
    pub rank: usize,
    /// Number of ranks.
    pub count: usize,
}

impl RankShare {
    /// Everything.
    pub const WHOLE: Self = Self { rank: 0, count: 1 };

    /// Whether this rank holds a block.
    #[inline(always)]
    #[must_use]
    pub fn holds(self, block: usize) -> bool {
        block % self.count == self.rank
    }

    /// Blocks that this rank holds of `blocks`.
    #[must_use]
    pub fn of(self, blocks: usize) -> usize {
        (blocks + self.count - 1 - self.rank) / self.count
    }
}

impl Ranks {
    /// A process alone.
    #[must_use]
    pub fn one() -> Self {
        Self { share: RankShare::WHOLE, exchange: None }
    }

    /// A process alone that holds a part at a time, and never asks the others.
    #[must_use]
    pub fn part(share: RankShare) -> Self {
        Self { share, exchange: None }
    }

    /// One rank of several.
    #[must_use]
    pub fn new(share: RankShare, exchange: Arc<dyn RankExchange>) -> Self {
        Self { share, exchange: Some(exchange) }
    }

    /// What this rank holds.
    #[must_use]
    pub fn share(&self) -> RankShare {
        self.share
    }

    /// Whether this rank writes products and talks to people.
    #[must_use]
    pub fn is_first(&self) -> bool {
        self.share.rank == 0
    }

    /// Whether there are others.
    #[must_use]
    pub fn are_many(&self) -> bool {
        self.share.count > 1
    }

    /// Replaces each value by the sum over all ranks; it must not leave 64 bits.
    pub fn sum(&self, values: &mut [i64]) {
        if let Some(exchange) = &self.exchange {
            exchange.sum(values);
        }
    }

    /// Replaces each value by the greatest of all ranks.
    pub fn greatest(&self, values: &mut [i64]) {
        if let Some(exchange) = &self.exchange {
            exchange.greatest(values);
        }
    }

    /// Whether all ranks say yes.
    #[must_use]
    pub fn all(&self, yes: bool) -> bool {
        let mut no = [i64::from(!yes)];
        self.greatest(&mut no);
        no == [0]
    }

    /// Whether all ranks have the same values.
    #[must_use]
    pub fn agree(&self, values: &[i64]) -> bool {
        // The complement turns the order round without overflow.
        let mut both: Vec<i64> = values.iter().flat_map(|value| [*value, !value]).collect();
        self.greatest(&mut both);
        both.as_chunks::<2>().0.iter().all(|[greatest, least]| *greatest == !least)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_all_blocks_once() {
        for count in 1..6 {
            for blocks in 0..12 {
                let shares = (0..count).map(|rank| RankShare { rank, count });
                let held: usize = shares.clone().map(|share| share.of(blocks)).sum();
                assert_eq!(held, blocks, "{count} ranks");
                for share in shares {
                    assert_eq!((0..blocks).filter(|block| share.holds(*block)).count(), share.of(blocks));
                }
            }
        }
    }

    #[test]
    fn ranks_tell_one_another_numbers() {
        let found = threads::on_threads(3, |ranks| {
            let rank = ranks.share().rank as i64;
            let (mut sum, mut greatest) = ([rank, 10 * rank], [-rank, rank]);
            ranks.sum(&mut sum);
            ranks.greatest(&mut greatest);
            let votes = [ranks.all(true), ranks.all(rank != 1)];
            let agreements = [ranks.agree(&[i64::MIN, 5]), ranks.agree(&[5, rank])];
            (sum, greatest, votes, agreements)
        });
        assert_eq!(found, [([3, 30], [0, 2], [true, false], [true, false]); 3]);
        assert!(Ranks::one().all(true) && !Ranks::one().all(false) && Ranks::one().agree(&[1]));
    }
}
