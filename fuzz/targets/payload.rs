//! Payloads in sound packets. Decoded frames must meet the invariants the ground relies on.
#![no_main]

use libfuzzer_sys::fuzz_target;
use lunarray::downlink::{
    CucTime, Decoder, FORMAT_VERSION, HEADER_BYTES, PacketKind, PacketHeader, PacketReceiver, PacketSegment,
    Packetizer, TRAILER_BYTES,
};
use lunarray::frames::{AntennaResponse, Channel, GroundFrame, Instrument};

fn packet(kind: PacketKind, count: u64, payload: &[u8]) -> Vec<u8> {
    let bytes = HEADER_BYTES + payload.len() + TRAILER_BYTES;
    let header = PacketHeader {
        kind,
        segment: PacketSegment::Whole,
        count,
        time: CucTime(1 << 50),
        version: FORMAT_VERSION,
        bytes,
    };
    let mut packet = header.to_bytes().to_vec();
    packet.extend(payload);
    packet.extend(crc_fast::crc32_iscsi(&packet).to_be_bytes());
    packet
}

fuzz_target!(|data: &[u8]| {
    let mut stream = Vec::new();
    let channels = vec![Channel { frequency_hz: 1e7, width_hz: 8e3 }; 2];
    let instrument = GroundFrame::Instrument(Instrument {
        name: "fuzz".to_owned(),
        epoch_tai_s: 2.5e9,
        moon_radius_m: 1.7371e6,
        satellites: 8,
        channels,
        response: AntennaResponse::Isotropic,
        seed: 1,
        configuration_hash: 2,
        spectrometer: None,
        noiseless: false,
    });
    let mut packetizer = Packetizer::new(&Default::default()).expect("default");
    packetizer.encode(&instrument, &mut stream).expect("sound");
    let Some((&which, payload)) = data.split_first() else { return };
    let kind = PacketKind::ALL[usize::from(which) % PacketKind::ALL.len()];
    stream.extend(packet(kind, 1, &payload[..payload.len().min(60_000)]));
    let (mut receiver, mut decoder) = (PacketReceiver::new(), Decoder::new());
    receiver.push(&stream);
    receiver.finish();
    while let Some(event) = receiver.next_event() {
        match decoder.accept(&event) {
            Some(GroundFrame::Visibilities(block)) => {
                assert!(block.pair.i <= block.pair.j && block.pair.j < 8 && block.channel.0 < 2);
                assert!(block.weight.iter().all(|w| *w > 0.0 && w.is_finite()));
                assert!(block.value_k_sr.iter().all(|v| v.is_finite()));
                assert!((1..block.len()).all(|k| block.middle_s(k - 1) < block.middle_s(k)));
            }
            Some(GroundFrame::Ephemeris(segment)) => {
                assert!(segment.positions_m.iter().flatten().all(|x| x.is_finite()));
                assert_eq!(segment.positions_m.len() % 8, 0);
            }
            _ => {}
        }
    }
});
