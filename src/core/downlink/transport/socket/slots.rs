//! Connection slots, and which connection is evicted when all are in use.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::Instant;

/// Time that a new connection has to deliver its first new packet before it can be evicted.
const GRACE: Duration = Duration::from_millis(500);

/// Time after its last new packet for which a connection counts as active.
const ACTIVE: Duration = Duration::from_secs(2);

#[derive(Debug)]
struct Slot {
    /// The sender's address, see [`quota_key`].
    address: IpAddr,
    opened: Instant,
    /// When the connection last delivered a packet that no connection had delivered before.
    last_new_packet: Option<Instant>,
    /// When the connection began to wait for the ground; `None` if it does not wait.
    blocked_since: Option<Instant>,
    eviction_requested: bool,
    evicted: Arc<Notify>,
}

impl Slot {
    fn is_active(&self, now: Instant) -> bool {
        self.blocked_since.is_some()
            || self.last_new_packet.is_some_and(|instant| now.duration_since(instant) < ACTIVE)
    }

    fn has_grace(&self, now: Instant) -> bool {
        self.last_new_packet.is_none() && now.duration_since(self.opened) < GRACE
    }
}

/// Whether a slot will be free for a new connection when all are in use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Vacancy {
    /// A connection is being evicted, or may be evicted soon.
    Expected,
    /// No connection may be evicted.
    Unavailable,
}

/// The slots of all open connections.
///
/// An active connection may be evicted only if its address has at least second slots more than the address of the new
/// connection. An inactive connection may be evicted only if its address has more slots than the address of the new
/// connection, or is the same. Of these, inactive connections are evicted before active ones, then connections that never
/// delivered a new packet before others, then those whose address has the most slots, then those that have been idle
/// longest.
#[derive(Debug, Default)]
pub(super) struct ConnectionSlots {
    slots: Mutex<BTreeMap<u64, Slot>>,
}

impl ConnectionSlots {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<u64, Slot>> {
        self.slots.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a slot; returns its number, and the notification of an eviction.
    pub(super) fn take(&self, address: IpAddr, now: Instant) -> (u64, Arc<Notify>) {
        let mut slots = self.lock();
        let number = slots.last_key_value().map_or(0, |(last, _)| last + 1);
        let evicted = Arc::new(Notify::new());
        let slot = Slot {
            address: quota_key(address),
            opened: now,
            last_new_packet: None,
            blocked_since: None,
            eviction_requested: false,
            evicted: Arc::clone(&evicted),
        };
        slots.insert(number, slot);
        (number, evicted)
    }

    pub(super) fn release(&self, number: u64) {
        self.lock().remove(&number);
    }

    pub(super) fn record_new_packet(&self, number: u64, now: Instant) {
        if let Some(slot) = self.lock().get_mut(&number) {
            slot.last_new_packet = Some(now);
        }
    }

    /// Records whether a connection waits for the ground. This time does not count as idle.
    pub(super) fn set_blocked(&self, number: u64, is_blocked: bool, now: Instant) {
        if let Some(slot) = self.lock().get_mut(&number) {
            let blocked = slot.blocked_since.take().map_or(Duration::ZERO, |since| now.duration_since(since));
            slot.last_new_packet = slot.last_new_packet.map(|instant| instant + blocked);
            slot.blocked_since = is_blocked.then_some(now);
        }
    }

    /// Requests the eviction of a connection in favour of a new first from `address`.
    pub(super) fn request_eviction(&self, address: IpAddr, now: Instant) -> Vacancy {
        let mut slots = self.lock();
        if slots.values().any(|slot| slot.eviction_requested) {
            return Vacancy::Expected;
        }
        let address = quota_key(address);
        let mut counts: BTreeMap<IpAddr, usize> = BTreeMap::new();
        slots.values().for_each(|slot| *counts.entry(slot.address).or_default() += 1);
        let slots_of = |address: &IpAddr| counts.get(address).copied().unwrap_or(0);
        let own_slots = slots_of(&address);
        let may_be_evicted = |slot: &Slot| match slot.is_active(now) {
            true => slots_of(&slot.address) > own_slots + 1 && slot.blocked_since.is_none(),
            false => slot.address == address || slots_of(&slot.address) > own_slots,
        };
        let rank = |slot: &Slot| {
            let idle_since = slot.last_new_packet.unwrap_or(slot.opened);
            let has_delivered = slot.last_new_packet.is_some();
            (slot.is_active(now), has_delivered, Reverse(slots_of(&slot.address)), idle_since)
        };
        let lowest = slots.values_mut().filter(|slot| may_be_evicted(slot)).min_by_key(|slot| rank(slot));
        match lowest {
            None => Vacancy::Unavailable,
            // Waiting for the end of its grace period is better than evicting a connection of higher rank.
            Some(slot) if slot.has_grace(now) => Vacancy::Expected,
            Some(slot) => {
                slot.eviction_requested = true;
                slot.evicted.notify_one();
                Vacancy::Expected
            }
        }
    }
}

/// The unit among which slots are shared: an IPv4 address or an IPv6 network of 64 bits, since first sender controls all
/// addresses of such a network.
fn quota_key(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(address) => {
            let [a, b, c, d, ..] = address.segments();
            Ipv6Addr::new(a, b, c, d, 0, 0, 0, 0).into()
        }
        address => address,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Table {
        slots: ConnectionSlots,
        start: Instant,
    }

    impl Table {
        fn new() -> Self {
            Self { slots: ConnectionSlots::default(), start: Instant::now() }
        }

        fn at(&self, s: f64) -> Instant {
            self.start + Duration::from_secs_f64(s)
        }

        fn take(&self, host: u8, s: f64) -> u64 {
            self.slots.take(IpAddr::from([127, 0, 0, host]), self.at(s)).0
        }

        /// The slots that are evicted for a new connection.
        fn evicted(&self, host: u8, s: f64) -> (Vacancy, Vec<u64>) {
            let vacancy = self.slots.request_eviction(IpAddr::from([127, 0, 0, host]), self.at(s));
            let mut slots = self.slots.lock();
            let evicted = slots.iter().filter(|(_, slot)| slot.eviction_requested);
            let numbers = evicted.map(|(number, _)| *number).collect();
            slots.values_mut().for_each(|slot| slot.eviction_requested = false);
            (vacancy, numbers)
        }
    }

    #[test]
    fn connections_without_packets_are_evicted_first_and_oldest_first() {
        let table = Table::new();
        let [silent, good, later] = [table.take(1, 0.0), table.take(1, 1.0), table.take(1, 2.0)];
        table.slots.record_new_packet(good, table.at(1.1));
        assert_eq!(table.evicted(1, 10.0), (Vacancy::Expected, vec![silent]));
        table.slots.release(silent);
        assert_eq!(table.evicted(1, 10.0), (Vacancy::Expected, vec![later]));
        table.slots.release(later);
        // Idle for longer than it counts as active.
        assert_eq!(table.evicted(1, 10.0), (Vacancy::Expected, vec![good]));
    }

    #[test]
    fn new_connections_have_a_grace_period_and_active_ones_stay() {
        let table = Table::new();
        let [first, second] = [table.take(1, 0.0), table.take(1, 0.4)];
        assert_eq!(table.evicted(1, 0.45), (Vacancy::Expected, vec![]));
        table.slots.record_new_packet(first, table.at(0.5));
        assert_eq!(table.evicted(1, 0.6), (Vacancy::Expected, vec![]));
        table.slots.record_new_packet(second, table.at(0.7));
        assert_eq!(table.evicted(1, 0.8), (Vacancy::Unavailable, vec![]));
        // The first waits for the ground for a long time; the second has nothing new.
        table.slots.set_blocked(first, true, table.at(0.9));
        assert_eq!(table.evicted(1, 90.0), (Vacancy::Expected, vec![second]));
        table.slots.set_blocked(first, false, table.at(91.0));
        table.slots.record_new_packet(second, table.at(91.0));
        assert_eq!(table.evicted(1, 91.5), (Vacancy::Unavailable, vec![]));
    }

    #[test]
    fn slots_are_shared_among_addresses() {
        let table = Table::new();
        let many: Vec<u64> = (0..4).map(|k| table.take(1, 0.1 * f64::from(k))).collect();
        many.iter().for_each(|number| table.slots.record_new_packet(*number, table.at(9.0)));
        // All connections of the first address deliver; the second address has none.
        assert_eq!(table.evicted(1, 9.1), (Vacancy::Unavailable, vec![]));
        assert_eq!(table.evicted(2, 9.1).1.len(), 1);
        let second: Vec<u64> = (0..3).map(|_| table.take(2, 5.0)).collect();
        // A new connection of the first address evicts none of the second, even inactive ones.
        assert_eq!(table.evicted(1, 9.1), (Vacancy::Unavailable, vec![]));
        assert_eq!(table.evicted(2, 9.1), (Vacancy::Expected, vec![second[0]]));
        assert_eq!(table.evicted(3, 9.1), (Vacancy::Expected, vec![second[0]]));
    }

    #[test]
    fn an_ipv6_network_has_one_quota() {
        let key = |text: &str| quota_key(text.parse().unwrap());
        assert_eq!(key("2001:db8:1:2:3::4"), key("2001:db8:1:2:ffff::9"));
        assert_ne!(key("2001:db8:1:2::"), key("2001:db8:1:3::"));
        assert_eq!(key("::ffff:127.0.0.1"), key("127.0.0.1"));
    }
}
