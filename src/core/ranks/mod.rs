//! The ranks of an MPI job (`--mpi`, feature `mpi`): processes that share the sums of a map.
//!
//! Each rank runs the whole chain and holds a part of the sums. Ranks exchange integers only, because sums of floats would depend on the
//! number of ranks. All ranks make the same exchanges in the same order, from one thread at a time, and each exchange waits for all
//! ranks. A rank that fails therefore aborts the job ([`RankJob::abort`]), or the others would wait forever.

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

/// Exchanges numbers between ranks (all-reduce). All ranks call the same functions in the same order, with the same number of values.
pub trait RankExchange: fmt::Debug + Send + Sync {
    /// Replaces each value by its sum over all ranks, which must fit 64 bits.
    fn sum(&self, values: &mut [i64]);

    /// Replaces each value by its maximum over all ranks.
    fn max(&self, values: &mut [i64]);
}

/// This process as one of several ranks, which share the sums of a map.
#[derive(Clone, Debug)]
pub struct Ranks {
    share: RankShare,
    /// `None` for a single process.
    exchange: Option<Arc<dyn RankExchange>>,
}

/// The blocks of the sums that a rank holds: every `count`-th from number `rank` on, so that data of any time span are shared evenly.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RankShare {
    /// Number of this rank, from 0.
    pub rank: usize,
    /// Number of ranks.
    pub count: usize,
}

impl RankShare {
    /// The share of a single process: all blocks.
    pub const WHOLE: Self = Self { rank: 0, count: 1 };

    /// Whether the rank holds a block.
    #[inline(always)]
    #[must_use]
    pub fn holds(self, block: usize) -> bool {
        block % self.count == self.rank
    }

    /// The number of blocks that the rank holds out of `blocks`.
    #[must_use]
    pub fn block_count(self, blocks: usize) -> usize {
        (blocks + self.count - 1 - self.rank) / self.count
    }
}

impl Ranks {
    /// A single process that holds everything.
    #[must_use]
    pub fn single() -> Self {
        Self { share: RankShare::WHOLE, exchange: None }
    }

    /// A single process that holds one share at a time and exchanges nothing.
    #[must_use]
    pub fn single_with_share(share: RankShare) -> Self {
        Self { share, exchange: None }
    }

    /// One rank of several.
    #[must_use]
    pub fn new(share: RankShare, exchange: Arc<dyn RankExchange>) -> Self {
        Self { share, exchange: Some(exchange) }
    }

    /// The share of the blocks that this rank holds.
    #[must_use]
    pub fn share(&self) -> RankShare {
        self.share
    }

    /// Whether this rank writes products and messages.
    #[must_use]
    pub fn is_first(&self) -> bool {
        self.share.rank == 0
    }

    /// Whether the sums are divided: among several ranks, or held one share at a time.
    #[must_use]
    pub fn is_distributed(&self) -> bool {
        self.share.count > 1
    }

    /// Replaces each value by its sum over all ranks, which must fit 64 bits.
    pub fn sum(&self, values: &mut [i64]) {
        if let Some(exchange) = &self.exchange {
            exchange.sum(values);
        }
    }

    /// Replaces each value by its maximum over all ranks.
    pub fn max(&self, values: &mut [i64]) {
        if let Some(exchange) = &self.exchange {
            exchange.max(values);
        }
    }

    /// Whether `condition` is true on all ranks.
    #[must_use]
    pub fn all(&self, condition: bool) -> bool {
        let mut fails = [i64::from(!condition)];
        self.max(&mut fails);
        fails == [0]
    }

    /// Whether all ranks have equal values.
    #[must_use]
    pub fn have_equal(&self, values: &[i64]) -> bool {
        // The bitwise complement reverses the order without overflow, so its maximum is the minimum.
        let mut both: Vec<i64> = values.iter().flat_map(|value| [*value, !value]).collect();
        self.max(&mut both);
        both.as_chunks::<2>().0.iter().all(|[max, not_min]| *max == !not_min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_block_is_held_once() {
        for count in 1..6 {
            for blocks in 0..12 {
                let shares = (0..count).map(|rank| RankShare { rank, count });
                let held: usize = shares.clone().map(|share| share.block_count(blocks)).sum();
                assert_eq!(held, blocks, "{count} ranks");
                for share in shares {
                    assert_eq!(
                        (0..blocks).filter(|block| share.holds(*block)).count(),
                        share.block_count(blocks)
                    );
                }
            }
        }
    }

    #[test]
    fn ranks_exchange_numbers() {
        let found = threads::on_threads(3, |ranks| {
            let rank = ranks.share().rank as i64;
            let (mut sum, mut max) = ([rank, 10 * rank], [-rank, rank]);
            ranks.sum(&mut sum);
            ranks.max(&mut max);
            let votes = [ranks.all(true), ranks.all(rank != 1)];
            let agreements = [ranks.have_equal(&[i64::MIN, 5]), ranks.have_equal(&[5, rank])];
            (sum, max, votes, agreements)
        });
        assert_eq!(found, [([3, 30], [0, 2], [true, false], [true, false]); 3]);
        assert!(Ranks::single().all(true) && !Ranks::single().all(false) && Ranks::single().have_equal(&[1]));
    }
}
