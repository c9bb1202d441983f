//! Frames that the code finds nothing wrong with.
#![no_main]

use libfuzzer_sys::fuzz_target;
use lunarray::downlink::PacketReceiver;
use lunarray::downlink::receive::cadu::CaduReceiver;
use lunarray::downlink::wire::cadu::{DATA_BYTES, ReedSolomon, SYNC_MARKER, randomize};

fuzz_target!(|data: &[u8]| {
    let code = ReedSolomon::new(1).expect("depth 1");
    let (mut frames, mut packets) = (CaduReceiver::new(), Vec::new());
    let mut sent = 0;
    for part in data.chunks(DATA_BYTES) {
        let mut block = part.to_vec();
        block.resize(code.block_bytes(), 0);
        // Version 01: others go no further.
        block[0] = block[0] & 0x3F | 0x40;
        code.encode(&mut block);
        randomize(&mut block);
        let mut cadu = SYNC_MARKER.to_be_bytes().to_vec();
        cadu.extend(block);
        frames.push(&cadu, &mut packets);
        sent += 1;
    }
    frames.finish(&mut packets);
    let account = frames.counters();
    assert_eq!(account.frames, sent);
    let zones = sent * (DATA_BYTES as u64 - 8);
    assert!(packets.len() as u64 + account.bytes_idle_packets + account.bytes_fragments <= 2 * zones);
    let mut receiver = PacketReceiver::new();
    receiver.push(&packets);
    receiver.finish();
    while receiver.next_event().is_some() {}
});
