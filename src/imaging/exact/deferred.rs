//! Sums into which a batch may be on its way, while others read and place the next.

use std::any::Any;
use std::mem::replace;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use crossbeam_channel::{Receiver, TryRecvError, bounded};

/// A value that is here, or being changed in the pool of threads.
pub(in crate::imaging) enum Deferred<T> {
    /// It is here.
    Here(T),
    /// It comes back over this; or what made the change panic.
    Away(Receiver<Result<T, Box<dyn Any + Send>>>),
}

impl<T: Send + 'static> Deferred<T> {
    /// Starts a change, once the one before has been made.
    pub(in crate::imaging) fn change(&mut self, change: impl FnOnce(&mut T) + Send + 'static) {
        let (home, away) = bounded(1);
        let mut value = replace(self, Self::Away(away)).here();
        rayon::spawn(move || {
            let changed = catch_unwind(AssertUnwindSafe(|| change(&mut value)));
            // Nobody waits for it if the engine is gone.
            let _ = home.send(changed.map(|()| value));
        });
    }

    /// The value, with all changes.
    pub(in crate::imaging) fn get(&mut self) -> &mut T {
        if let Self::Away(away) = self {
            *self = Self::Here(back(away));
        }
        match self {
            Self::Here(value) => value,
            Self::Away(_) => unreachable!("it is back"),
        }
    }

    /// The value, with all changes.
    pub(in crate::imaging) fn here(self) -> T {
        match self {
            Self::Here(value) => value,
            Self::Away(away) => back(&away),
        }
    }
}

/// Waits for a value. A thread of the pool works meanwhile, as nobody else may be there to make the change.
fn back<T>(away: &Receiver<Result<T, Box<dyn Any + Send>>>) -> T {
    let found = loop {
        if rayon::current_thread_index().is_none() {
            break away.recv().ok();
        }
        match away.try_recv() {
            Ok(found) => break Some(found),
            Err(TryRecvError::Disconnected) => break None,
            Err(TryRecvError::Empty) => {
                rayon::yield_now();
            }
        }
    };
    match found {
        Some(Ok(value)) => value,
        Some(Err(panic)) => resume_unwind(panic),
        None => unreachable!("a change sends what it has changed, or its panic"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_made_in_their_order() {
        let mut list = Deferred::Here(Vec::new());
        for k in 0..100 {
            list.change(move |list| list.push(k));
            if k % 30 == 7 {
                assert_eq!(list.get().last(), Some(&k));
            }
        }
        assert_eq!(list.here(), (0..100).collect::<Vec<_>>());
    }

    #[test]
    fn a_pool_of_one_thread_does_not_wait_for_itself() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let sum = pool.install(|| {
            let mut sum = Deferred::Here(0);
            for k in 0..10 {
                sum.change(move |sum| *sum += k);
            }
            sum.here()
        });
        assert_eq!(sum, 45);
    }

    #[test]
    fn a_panic_is_that_of_who_asks_for_the_value() {
        let mut value = Deferred::Here(1);
        value.change(|_| panic!("five is right out"));
        let said = catch_unwind(AssertUnwindSafe(|| *value.get())).unwrap_err();
        assert_eq!(said.downcast_ref::<&str>(), Some(&"five is right out"));
    }
}
