//! Streams of packets. Checksums are corrected, so that the fuzzer need not guess them.
#![no_main]

use crc_fast::{CrcAlgorithm, checksum};
use libfuzzer_sys::fuzz_target;
use lunarray::downlink::{Decoder, HEADER_BYTES, PacketHeader, PacketKind, PacketReceiver};

fuzz_target!(|data: &[u8]| {
    let mut stream = data.to_vec();
    let mut at = 0;
    while let Some(head) = stream.get_mut(at..at + HEADER_BYTES) {
        let check = checksum(CrcAlgorithm::Crc16Ibm3740, &head[..HEADER_BYTES - 2]) as u16;
        head[HEADER_BYTES - 2..].copy_from_slice(&check.to_be_bytes());
        let Some(header) = PacketHeader::parse(head) else { break };
        let Some(packet) = stream.get_mut(at..at + header.bytes) else { break };
        // Every fourth stays damaged.
        if header.count % 4 != 3 {
            let (body, check) = packet.split_at_mut(header.bytes - 4);
            check.copy_from_slice(&crc_fast::crc32_iscsi(body).to_be_bytes());
        }
        at += header.bytes;
    }
    let (mut receiver, mut decoder) = (PacketReceiver::new(), Decoder::new());
    for part in stream.chunks(97) {
        receiver.push(part);
        while let Some(event) = receiver.next_event() {
            decoder.accept(&event);
        }
    }
    receiver.finish();
    while let Some(event) = receiver.next_event() {
        decoder.accept(&event);
    }
    decoder.finish();
    let counters = decoder.counters();
    let packets: u64 = PacketKind::ALL.iter().map(|kind| counters.kind(*kind).bytes).sum();
    let others =
        counters.bytes_garbage + counters.bytes_truncated + counters.bytes_damaged + counters.bytes_duplicate;
    assert_eq!((counters.bytes, packets + others), (stream.len() as u64, stream.len() as u64));
});
