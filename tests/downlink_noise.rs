//! A gigabyte of noise, and a tenth of it after a sound pass: no panic, bounded memory, bounded time. In a process of
//! its own, because it measures the process's peak memory.
#![allow(clippy::unwrap_used)] // Also in the helpers.

mod common;

use std::io::Read;

use common::downlink::{mission, packets_of, transmit};
use lunarray::downlink::{Decoder, DownlinkConfig, DownlinkReceiver, Format};
use lunarray::units::{StreamKind, random_stream};
use rand::Rng;

/// A stream of unknown format is searched for both.
const NOISE_BYTES: u64 = 1_000_000_000;
/// After a sound pass, which reveals the format.
const NOISE_BYTES_BEHIND: u64 = 100_000_000;

/// Peak memory of this process, bytes, if the system reports it.
fn memory_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    let kilobytes: u64 = line.split_whitespace().nth(1)?.parse().ok()?;
    Some(1024 * kilobytes)
}

/// An endless source of random bytes.
struct Noise(rand_chacha::ChaCha8Rng);

impl Read for Noise {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        self.0.fill_bytes(bytes);
        Ok(bytes.len())
    }
}

/// Packets found in noise after `sound` bytes, and the format detected.
fn receive(sound: &[u8], seed: u64) -> (u64, Option<Format>) {
    let bytes = if sound.is_empty() { NOISE_BYTES } else { NOISE_BYTES_BEHIND };
    let noise = Noise(random_stream(seed, StreamKind::Probe, [0, 0])).take(bytes);
    let mut stream = sound.chain(noise);
    let (mut receiver, mut decoder) = (DownlinkReceiver::new(), Decoder::new());
    loop {
        let read = receiver.fill_from(&mut stream).unwrap();
        if read == 0 {
            receiver.finish();
        }
        while let Some(event) = receiver.next_event() {
            decoder.accept(&event);
        }
        if read == 0 {
            break;
        }
    }
    assert_eq!(receiver.bytes(), sound.len() as u64 + bytes);
    (decoder.counters().packets(), receiver.format())
}

#[test]
fn a_gigabyte_of_noise_ends_in_bounded_memory() {
    let mission = mission(1, 100);
    let packets_sent = packets_of(&transmit(&mission, &DownlinkConfig::default())).len() as u64;
    for (seed, format) in [(1, None), (2, Some(Format::Packets)), (3, Some(Format::Cadu))] {
        let config = DownlinkConfig { format: format.unwrap_or_default(), ..DownlinkConfig::default() };
        let sound = if format.is_some() { transmit(&mission, &config) } else { Vec::new() };
        let before = memory_bytes();
        let (packets, found) = receive(&sound, seed);
        // Noise holds no packet and no frame: each is checked by more bits than there are places.
        let expected = if format.is_some() { packets_sent } else { 0 };
        assert_eq!((packets, found), (expected, format));
        // The longest packet, a few chunks of 256 KiB and frames: a few MiB. Noise that piled up would exceed this at once.
        if let Some((before, after)) = before.zip(memory_bytes()) {
            assert!(after - before < 32 << 20, "{} MiB", (after - before) >> 20);
        }
    }
}
