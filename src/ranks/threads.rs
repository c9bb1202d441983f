//! Ranks that are threads of one process, for tests without MPI.

use std::sync::{Arc, Barrier, Mutex, PoisonError};
use std::thread;

use super::{RankExchange, RankShare, Ranks};

#[derive(Debug)]
struct ThreadExchange {
    barrier: Barrier,
    /// What the threads that have come so far say together.
    said: Mutex<Option<Vec<i64>>>,
}

impl ThreadExchange {
    fn reduce(&self, values: &mut [i64], join: impl Fn(i64, i64) -> i64) {
        let said = || self.said.lock().unwrap_or_else(PoisonError::into_inner);
        {
            let mut said = said();
            let together = said.get_or_insert_with(|| vec![0; values.len()]);
            assert_eq!(together.len(), values.len(), "ranks ask different questions");
            together.iter_mut().zip(values.iter()).for_each(|(a, b)| *a = join(*a, *b));
        }
        self.barrier.wait();
        values.copy_from_slice(said().as_deref().unwrap_or_default());
        if self.barrier.wait().is_leader() {
            *said() = None;
        }
        self.barrier.wait();
    }
}

impl RankExchange for ThreadExchange {
    fn sum(&self, values: &mut [i64]) {
        self.reduce(values, |a, b| a + b);
    }

    fn greatest(&self, values: &mut [i64]) {
        // From zero up: from the least number instead.
        values.iter_mut().for_each(|value| *value = value.wrapping_sub(i64::MIN));
        let order = |value: i64| value as u64;
        self.reduce(values, |a, b| if order(a) >= order(b) { a } else { b });
        values.iter_mut().for_each(|value| *value = value.wrapping_add(i64::MIN));
    }
}

/// Ranks for so many threads.
fn ranks_of_threads(count: usize) -> Vec<Ranks> {
    let exchange = Arc::new(ThreadExchange { barrier: Barrier::new(count), said: Mutex::new(None) });
    let ranks = |rank| Ranks::new(RankShare { rank, count }, exchange.clone());
    (0..count).map(ranks).collect()
}

/// Results of `work` on each of `count` threads, in order.
pub(crate) fn on_threads<T: Send>(count: usize, work: impl Fn(&Ranks) -> T + Sync) -> Vec<T> {
    let work = &work;
    thread::scope(|scope| {
        let threads: Vec<_> =
            ranks_of_threads(count).into_iter().map(|ranks| scope.spawn(move || work(&ranks))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    })
}
