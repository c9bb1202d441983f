//! Ranks as threads of one process, for tests without MPI.

use std::sync::{Arc, Barrier, Mutex, PoisonError};
use std::thread;

use super::{RankExchange, RankShare, Ranks};

#[derive(Debug)]
struct ThreadExchange {
    barrier: Barrier,
    /// The reduction of the values of all threads so far.
    reduced: Mutex<Option<Vec<i64>>>,
}

impl ThreadExchange {
    fn reduce(&self, values: &mut [i64], combine: impl Fn(i64, i64) -> i64) {
        let lock = || self.reduced.lock().unwrap_or_else(PoisonError::into_inner);
        {
            let mut reduced = lock();
            let reduced = reduced.get_or_insert_with(|| vec![0; values.len()]);
            assert_eq!(reduced.len(), values.len(), "ranks exchange different numbers of values");
            reduced.iter_mut().zip(values.iter()).for_each(|(a, b)| *a = combine(*a, *b));
        }
        self.barrier.wait();
        values.copy_from_slice(lock().as_deref().unwrap_or_default());
        if self.barrier.wait().is_leader() {
            *lock() = None;
        }
        self.barrier.wait();
    }
}

impl RankExchange for ThreadExchange {
    fn sum(&self, values: &mut [i64]) {
        self.reduce(values, |a, b| a + b);
    }

    fn max(&self, values: &mut [i64]) {
        // The reduction starts from zero, so values are shifted to start at i64::MIN.
        values.iter_mut().for_each(|value| *value = value.wrapping_sub(i64::MIN));
        let order = |value: i64| value as u64;
        self.reduce(values, |a, b| if order(a) >= order(b) { a } else { b });
        values.iter_mut().for_each(|value| *value = value.wrapping_add(i64::MIN));
    }
}

/// Creates one rank for each of `count` threads.
fn ranks_of_threads(count: usize) -> Vec<Ranks> {
    let exchange = Arc::new(ThreadExchange { barrier: Barrier::new(count), reduced: Mutex::new(None) });
    let ranks = |rank| Ranks::new(RankShare { rank, count }, exchange.clone());
    (0..count).map(ranks).collect()
}

/// Runs `work` as each of `count` ranks and returns the results by rank.
pub(crate) fn on_threads<T: Send>(count: usize, work: impl Fn(&Ranks) -> T + Sync) -> Vec<T> {
    let work = &work;
    thread::scope(|scope| {
        let threads: Vec<_> =
            ranks_of_threads(count).into_iter().map(|ranks| scope.spawn(move || work(&ranks))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}
