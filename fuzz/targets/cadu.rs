//! Streams of bits between two sound passes, which must survive unless the bits imitate frames.
#![no_main]

use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use lunarray::downlink::wire::cadu::{CaduEncoder, ReedSolomon};
use lunarray::downlink::{Decoder, DownlinkReceiver, Event};

static PASS: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let mut encoder = CaduEncoder::new(ReedSolomon::new(1).expect("depth 1"), 1, 2);
    let mut stream = Vec::new();
    let packet = [0x09, 0x03, 0xC0, 0x00, 0x00, 0x63].into_iter().chain([7; 100]).collect::<Vec<u8>>();
    for _ in 0..3 {
        encoder.encode(&packet, &mut stream);
    }
    encoder.flush(&mut stream);
    stream
});

fuzz_target!(|data: &[u8]| {
    let Some((&how, data)) = data.split_first() else { return };
    let (mut receiver, mut decoder) = (DownlinkReceiver::new(), Decoder::new());
    let sound: &[u8] = if how & 1 == 0 { &PASS } else { &[] };
    let chunk = 1 + usize::from(how >> 1) * 40;
    let mut bytes = 0;
    let mut drain = |receiver: &mut DownlinkReceiver| {
        while let Some(event) = receiver.next_event() {
            bytes += match &event {
                Event::Packet(packet) => packet.header.bytes as u64,
                Event::Duplicate { header, .. } => header.bytes as u64,
                Event::Damaged { bytes, .. }
                | Event::Garbage { bytes, .. }
                | Event::Truncated { bytes, .. } => *bytes,
                _ => 0,
            };
            decoder.accept(&event);
        }
    };
    for part in [sound, data, sound].concat().chunks(chunk) {
        receiver.push(part);
        drain(&mut receiver);
    }
    receiver.finish();
    drain(&mut receiver);
    let counters = decoder.counters();
    assert_eq!(counters.bytes, bytes);
    if let Some(frames) = receiver.frames() {
        assert_eq!(frames.bytes, receiver.bytes());
        assert!(frames.frames + frames.frames_uncorrectable <= receiver.bytes() / 255 + 1);
    }
});
