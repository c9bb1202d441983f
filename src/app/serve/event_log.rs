//! The log of events that the page shows.

use std::collections::VecDeque;
use std::sync::{Mutex, PoisonError};

use serde::Serialize;

use super::status::unix_s;

const EVENTS_MAX: usize = 256;

/// An event of a run.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Event {
    pub(super) id: u64,
    /// Seconds since 1970-01-01 UTC.
    unix_s: f64,
    /// Whether it needs attention.
    is_bad: bool,
    text: String,
}

/// Log of the last events.
#[derive(Debug, Default)]
pub(super) struct EventLog(Mutex<EventQueue>);

#[derive(Debug, Default)]
struct EventQueue {
    last: u64,
    events: VecDeque<Event>,
}

impl EventLog {
    pub(super) fn push(&self, is_bad: bool, text: String) {
        let unix_s = unix_s();
        let mut queue = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        queue.last += 1;
        let id = queue.last;
        if queue.events.len() == EVENTS_MAX {
            queue.events.pop_front();
        }
        queue.events.push_back(Event { id, unix_s, is_bad, text });
    }

    /// The kept events with numbers above `id`.
    pub(super) fn after(&self, id: u64) -> Vec<Event> {
        let queue = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        queue.events.iter().filter(|event| event.id > id).cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_events_are_kept() {
        let log = EventLog::default();
        for number in 1..=1000 {
            log.push(false, number.to_string());
        }
        let all = log.after(0);
        assert_eq!((all.len(), all[0].id, all[EVENTS_MAX - 1].id), (EVENTS_MAX, 745, 1000));
        assert_eq!(
            log.after(998).iter().map(|event| event.text.as_str()).collect::<Vec<_>>(),
            ["999", "1000"]
        );
    }
}
