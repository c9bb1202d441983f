//! Configuration of a listening ground: limits for senders.

use crate::units::{Checks, InvalidValue, keys};

keys! {
    /// The `[downlink.listen]` section: limits for senders. Memory for all of them stays below `connections_max` times
    /// (`memory_bytes_max` + 128 KiB), plus `backlog_bytes_max`.
    pub struct ListenConfig {
        /// Maximum number of connections. A further one replaces the least useful, or is refused if all deliver.
        expert connections_max: usize = 16;
        /// Maximum time from connecting to the first valid packet or frame; 0 for no limit.
        expert first_packet_s_max: f64 = 30.0;
        /// Maximum time between valid packets or frames, whatever other bytes arrive; 0 for no limit.
        expert idle_s_max: f64 = 600.0;
        /// Maximum rate at which a connection is read; 0 for no limit. TCP slows the sender accordingly.
        expert bytes_per_s_max: f64 = 1e8;
        /// Maximum number of bytes between valid packets or frames.
        expert garbage_bytes_max: u64 = 4 << 20;
        /// Maximum memory for a connection's incomplete data.
        expert memory_bytes_max: u64 = 32 << 20;
        /// Maximum backlog of packets of all connections together.
        expert backlog_bytes_max: u64 = 8 << 20;
        /// Minimum time between checkpoints that are written because senders wait for one.
        expert held_every_s: f64 = 10.0;
    }
}

impl ListenConfig {
    /// The invalid limits; empty for a valid configuration.
    #[must_use]
    pub fn problems(&self) -> Vec<InvalidValue> {
        let mut checks = Checks::new("downlink.listen");
        let Self { connections_max: connections, bytes_per_s_max: rate, .. } = *self;
        checks.require("connections_max", connections, (1..=1024).contains(&connections), "1 to 1024");
        for (key, value) in [
            ("first_packet_s_max", self.first_packet_s_max),
            ("idle_s_max", self.idle_s_max),
            ("held_every_s", self.held_every_s),
        ] {
            checks.require(key, value, (0.0..=1e9).contains(&value), "0 s to 1e9 s");
        }
        let is_valid = rate == 0.0 || (1e3..=1e12).contains(&rate);
        checks.require("bytes_per_s_max", rate, is_valid, "1e3 to 1e12 bytes per second, or 0 for no limit");
        for (key, value, minimum, expected) in [
            ("garbage_bytes_max", self.garbage_bytes_max, 1 << 16, "65536 to 2^40 bytes"),
            ("memory_bytes_max", self.memory_bytes_max, 1 << 21, "2097152 to 2^40 bytes"),
            ("backlog_bytes_max", self.backlog_bytes_max, 1 << 17, "131072 to 2^30 bytes"),
        ] {
            let maximum = if key == "backlog_bytes_max" { 1 << 30 } else { 1 << 40 };
            checks.require(key, value, (minimum..=maximum).contains(&value), expected);
        }
        checks.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_limit_is_checked() {
        assert!(ListenConfig::default().problems().is_empty());
        let bad = ListenConfig {
            connections_max: 0,
            first_packet_s_max: -1.0,
            idle_s_max: f64::NAN,
            bytes_per_s_max: 5.0,
            garbage_bytes_max: 0,
            memory_bytes_max: 0,
            backlog_bytes_max: u64::MAX,
            held_every_s: -1.0,
        };
        assert_eq!(bad.problems().len(), 8);
        let open = ListenConfig { first_packet_s_max: 0.0, idle_s_max: 0.0, bytes_per_s_max: 0.0, ..bad };
        assert_eq!(open.problems().len(), 5);
    }
}
