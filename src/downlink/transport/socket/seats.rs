//! The places of open connections, and who gives way when all of them are taken.

use std::cmp::Reverse;
use std::collections::BTreeMap;
use std::net::{IpAddr, Ipv6Addr};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::Notify;
use tokio::time::Instant;

/// Time in which a connection can deliver its first new packet before it may have to give way.
const GRACE: Duration = Duration::from_millis(500);

/// Time after its last new packet for which a connection is useful.
const USEFUL: Duration = Duration::from_secs(2);

/// The place of an open connection.
#[derive(Debug)]
struct Seat {
    /// Address of its sender; of IPv6 the network.
    address: IpAddr,
    opened: Instant,
    /// When it last delivered a packet that no connection had delivered before.
    newest: Option<Instant>,
    /// Since when it waits for the ground, not for its sender.
    waits: Option<Instant>,
    /// Whether it was asked to leave.
    leaves: bool,
    leave: Arc<Notify>,
}

impl Seat {
    fn is_useful(&self, now: Instant) -> bool {
        self.waits.is_some() || self.newest.is_some_and(|newest| now.duration_since(newest) < USEFUL)
    }

    fn has_grace(&self, now: Instant) -> bool {
        self.newest.is_none() && now.duration_since(self.opened) < GRACE
    }
}

/// What a newcomer finds when all places are taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Room {
    /// A connection is leaving, or may have to.
    Soon,
    /// All connections are useful.
    None,
}

/// The places of all open connections.
///
/// The least useful connection gives way to a newcomer: one that never delivered a new packet before one that did, then
/// the one whose address has most places, then the one that has been idle longest. A connection with new packets stays,
/// unless its address has more places than the newcomer's would then have; and no newcomer takes a place from an
/// address that has no more places than its own.
#[derive(Debug, Default)]
pub(super) struct Seats {
    open: Mutex<BTreeMap<u64, Seat>>,
}

impl Seats {
    fn open(&self) -> MutexGuard<'_, BTreeMap<u64, Seat>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a place; returns its number, and what tells the connection to leave.
    pub(super) fn take(&self, address: IpAddr, now: Instant) -> (u64, Arc<Notify>) {
        let mut open = self.open();
        let number = open.last_key_value().map_or(0, |(last, _)| last + 1);
        let leave = Arc::new(Notify::new());
        let (address, opened) = (network(address), now);
        let seat =
            Seat { address, opened, newest: None, waits: None, leaves: false, leave: Arc::clone(&leave) };
        open.insert(number, seat);
        (number, leave)
    }

    /// Gives a place back.
    pub(super) fn release(&self, number: u64) {
        self.open().remove(&number);
    }

    /// Notes that a connection has delivered a new packet.
    pub(super) fn note_new(&self, number: u64, now: Instant) {
        if let Some(seat) = self.open().get_mut(&number) {
            seat.newest = Some(now);
        }
    }

    /// Notes whether a connection waits for the ground. That time is no idleness.
    pub(super) fn note_wait(&self, number: u64, waits: bool, now: Instant) {
        if let Some(seat) = self.open().get_mut(&number) {
            let waited = seat.waits.take().map_or(Duration::ZERO, |since| now.duration_since(since));
            seat.newest = seat.newest.map(|newest| newest + waited);
            seat.waits = waits.then_some(now);
        }
    }

    /// Asks the least useful connection to leave for a newcomer from `address`.
    pub(super) fn make_room(&self, address: IpAddr, now: Instant) -> Room {
        let mut open = self.open();
        if open.values().any(|seat| seat.leaves) {
            return Room::Soon;
        }
        let address = network(address);
        let mut places: BTreeMap<IpAddr, usize> = BTreeMap::new();
        open.values().for_each(|seat| *places.entry(seat.address).or_default() += 1);
        let of = |address: &IpAddr| places.get(address).copied().unwrap_or(0);
        let ours = of(&address);
        let may_go = |seat: &Seat| match seat.is_useful(now) {
            true => of(&seat.address) > ours + 1 && seat.waits.is_none(),
            false => seat.address == address || of(&seat.address) > ours,
        };
        let rank = |seat: &Seat| {
            let idle_since = seat.newest.unwrap_or(seat.opened);
            (seat.is_useful(now), seat.newest.is_some(), Reverse(of(&seat.address)), idle_since)
        };
        let leaving = open.values_mut().filter(|seat| may_go(seat)).min_by_key(|seat| rank(seat));
        match leaving {
            None => Room::None,
            // Those of higher rank stay while this one still has its time.
            Some(seat) if seat.has_grace(now) => Room::Soon,
            Some(seat) => {
                seat.leaves = true;
                seat.leave.notify_one();
                Room::Soon
            }
        }
    }
}

/// What shares the places: an address, or of IPv6 the network of 64 bits, all of whose addresses a sender has.
fn network(address: IpAddr) -> IpAddr {
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

    /// Times and addresses of a table of places.
    struct Table {
        seats: Seats,
        start: Instant,
    }

    impl Table {
        fn new() -> Self {
            Self { seats: Seats::default(), start: Instant::now() }
        }

        fn at(&self, s: f64) -> Instant {
            self.start + Duration::from_secs_f64(s)
        }

        fn sit(&self, host: u8, s: f64) -> u64 {
            self.seats.take(IpAddr::from([127, 0, 0, host]), self.at(s)).0
        }

        /// Which places are asked to leave for a newcomer.
        fn leaving(&self, host: u8, s: f64) -> (Room, Vec<u64>) {
            let room = self.seats.make_room(IpAddr::from([127, 0, 0, host]), self.at(s));
            let mut open = self.seats.open();
            let left = open.iter().filter(|(_, seat)| seat.leaves).map(|(number, _)| *number).collect();
            open.values_mut().for_each(|seat| seat.leaves = false);
            (room, left)
        }
    }

    #[test]
    fn the_one_that_never_delivered_anything_goes_first_and_the_oldest_of_these() {
        let table = Table::new();
        let [silent, good, later] = [table.sit(1, 0.0), table.sit(1, 1.0), table.sit(1, 2.0)];
        table.seats.note_new(good, table.at(1.1));
        assert_eq!(table.leaving(1, 10.0), (Room::Soon, vec![silent]));
        table.seats.release(silent);
        assert_eq!(table.leaving(1, 10.0), (Room::Soon, vec![later]));
        table.seats.release(later);
        // Idle for longer than it is useful.
        assert_eq!(table.leaving(1, 10.0), (Room::Soon, vec![good]));
    }

    #[test]
    fn everyone_has_time_for_a_first_packet_and_who_delivers_stays() {
        let table = Table::new();
        let [one, two] = [table.sit(1, 0.0), table.sit(1, 0.4)];
        assert_eq!(table.leaving(1, 0.45), (Room::Soon, vec![]));
        table.seats.note_new(one, table.at(0.5));
        assert_eq!(table.leaving(1, 0.6), (Room::Soon, vec![]));
        table.seats.note_new(two, table.at(0.7));
        assert_eq!(table.leaving(1, 0.8), (Room::None, vec![]));
        // One waits for the ground, for any time; the other has nothing new.
        table.seats.note_wait(one, true, table.at(0.9));
        assert_eq!(table.leaving(1, 90.0), (Room::Soon, vec![two]));
        table.seats.note_wait(one, false, table.at(91.0));
        table.seats.note_new(two, table.at(91.0));
        assert_eq!(table.leaving(1, 91.5), (Room::None, vec![]));
    }

    #[test]
    fn an_address_has_its_share_and_no_more() {
        let table = Table::new();
        let many: Vec<u64> = (0..4).map(|k| table.sit(1, 0.1 * f64::from(k))).collect();
        many.iter().for_each(|number| table.seats.note_new(*number, table.at(9.0)));
        // All of the first address deliver; the second has none.
        assert_eq!(table.leaving(1, 9.1), (Room::None, vec![]));
        assert_eq!(table.leaving(2, 9.1).1.len(), 1);
        let two: Vec<u64> = (0..3).map(|_| table.sit(2, 5.0)).collect();
        // Another of the first address takes no place of the second, however useless that is.
        assert_eq!(table.leaving(1, 9.1), (Room::None, vec![]));
        assert_eq!(table.leaving(2, 9.1), (Room::Soon, vec![two[0]]));
        assert_eq!(table.leaving(3, 9.1), (Room::Soon, vec![two[0]]));
    }

    #[test]
    fn a_network_of_addresses_is_one() {
        let of = |text: &str| network(text.parse().unwrap());
        assert_eq!(of("2001:db8:1:2:3::4"), of("2001:db8:1:2:ffff::9"));
        assert_ne!(of("2001:db8:1:2::"), of("2001:db8:1:3::"));
        assert_eq!(of("::ffff:127.0.0.1"), of("127.0.0.1"));
    }
}
