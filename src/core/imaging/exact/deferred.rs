//! A value that the thread pool changes in the background while its owner prepares the next change.

use std::any::Any;
use std::mem::replace;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use crossbeam_channel::{Receiver, TryRecvError, bounded};

/// A value that is ready, or being changed in the thread pool.
pub(in crate::imaging) enum Deferred<T> {
    /// The value is ready.
    Ready(T),
    /// The channel that returns the changed value, or the panic of the change.
    Pending(Receiver<Result<T, Box<dyn Any + Send>>>),
}

impl<T: Send + 'static> Deferred<T> {
    /// Starts a change after the previous one has ended.
    pub(in crate::imaging) fn change(&mut self, change: impl FnOnce(&mut T) + Send + 'static) {
        let (sender, receiver) = bounded(1);
        let mut value = replace(self, Self::Pending(receiver)).into_value();
        rayon::spawn(move || {
            let changed = catch_unwind(AssertUnwindSafe(|| change(&mut value)));
            // Fails if the owner was dropped.
            let _ = sender.send(changed.map(|()| value));
        });
    }

    /// The value after all changes.
    pub(in crate::imaging) fn get(&mut self) -> &mut T {
        if let Self::Pending(receiver) = self {
            *self = Self::Ready(wait(receiver));
        }
        match self {
            Self::Ready(value) => value,
            Self::Pending(_) => unreachable!("set to ready above"),
        }
    }

    /// The value after all changes.
    pub(in crate::imaging) fn into_value(self) -> T {
        match self {
            Self::Ready(value) => value,
            Self::Pending(receiver) => wait(&receiver),
        }
    }
}

/// Waits for a value. A thread of the pool executes other work meanwhile, because no other thread may be free to make the change.
fn wait<T>(receiver: &Receiver<Result<T, Box<dyn Any + Send>>>) -> T {
    let found = loop {
        if rayon::current_thread_index().is_none() {
            break receiver.recv().ok();
        }
        match receiver.try_recv() {
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
        None => unreachable!("a change sends the value or its panic"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_are_made_in_their_order() {
        let mut list = Deferred::Ready(Vec::new());
        for k in 0..100 {
            list.change(move |list| list.push(k));
            if k % 30 == 7 {
                assert_eq!(list.get().last(), Some(&k));
            }
        }
        assert_eq!(list.into_value(), (0..100).collect::<Vec<_>>());
    }

    #[test]
    fn a_pool_of_one_thread_does_not_wait_for_itself() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let sum = pool.install(|| {
            let mut sum = Deferred::Ready(0);
            for k in 0..10 {
                sum.change(move |sum| *sum += k);
            }
            sum.into_value()
        });
        assert_eq!(sum, 45);
    }

    #[test]
    fn a_panic_is_passed_on_to_the_reader() {
        let mut value = Deferred::Ready(1);
        value.change(|_| panic!("five is right out"));
        let panic = catch_unwind(AssertUnwindSafe(|| *value.get())).unwrap_err();
        assert_eq!(panic.downcast_ref::<&str>(), Some(&"five is right out"));
    }
}
