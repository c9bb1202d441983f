//! Decodes the packets of a file, whatever their order.

use std::collections::BTreeMap;

use crate::downlink::error::PayloadFault;
use crate::downlink::receive::{
    Decoder, Event, HeldPacket, HoldBuffer, Packet, ReceptionCounters, SendingKey,
};
use crate::downlink::wire::{PacketHeader, PacketKind, PacketSegment};
use crate::frames::GroundFrame;

/// A frame, or the offset of a packet whose payload was refused, with the reason.
pub(super) type DecodeResult = Result<GroundFrame, (u64, PayloadFault)>;

/// A decoder that holds packets until the description of the instrument arrives, and segments until their payload is complete, in the
/// bounded memory of a [`HoldBuffer`], as the ground does.
#[derive(Debug, Default)]
pub(super) struct AnyOrderDecoder {
    decoder: Decoder,
    held: HoldBuffer,
    /// Offset of each held packet, and whether it was late.
    origins: BTreeMap<(PacketKind, SendingKey), (u64, bool)>,
}

impl AnyOrderDecoder {
    /// Counts an event, and passes what it makes decodable to `take`.
    pub(super) fn accept(&mut self, event: &Event<'_>, take: &mut dyn FnMut(DecodeResult)) {
        let Event::Packet(packet) = *event else {
            self.decoder.accept(event);
            return;
        };
        let PacketHeader { kind, segment, .. } = packet.header;
        let was_known = self.decoder.instrument().is_some();
        let is_readable = was_known || kind == PacketKind::Instrument;
        if is_readable && (segment == PacketSegment::Whole || kind == PacketKind::Visibilities) {
            self.decode(packet, false, take);
        } else {
            self.origins.insert(origin_key(&packet.header), (packet.offset, packet.late));
            self.held.insert(HeldPacket::new(&packet));
            if is_readable {
                self.decode_payload(&packet.header, take);
            }
        }
        let is_known = self.decoder.instrument().is_some();
        if is_known && !was_known {
            let headers: Vec<PacketHeader> = self.held.packets().map(|packet| packet.header).collect();
            headers.iter().for_each(|header| self.decode_payload(header, take));
        }
        while let Some(packet) =
            if is_known { self.held.pop_excess_segment() } else { self.held.pop_before_instrument() }
        {
            self.decode_held(&packet, true, take);
        }
    }

    /// Ends the file: decodes what is still held, as far as possible.
    pub(super) fn finish(&mut self, take: &mut dyn FnMut(DecodeResult)) {
        while let Some(packet) = self.held.pop_visibilities().or_else(|| self.held.pop_other()) {
            self.decode_held(&packet, true, take);
        }
    }

    pub(super) fn counters(&self) -> &ReceptionCounters {
        self.decoder.counters()
    }

    /// Decodes the payload that a held packet belongs to, if it is complete.
    fn decode_payload(&mut self, header: &PacketHeader, take: &mut dyn FnMut(DecodeResult)) {
        let packets = match header.kind {
            PacketKind::Visibilities => self.held.remove(header).map(|packet| vec![packet]),
            _ => self.held.take_payload(header),
        };
        for packet in packets.into_iter().flatten() {
            self.decode_held(&packet, false, take);
        }
    }

    fn decode_held(&mut self, held: &HeldPacket, is_last: bool, take: &mut dyn FnMut(DecodeResult)) {
        let (offset, late) = self.origins.remove(&origin_key(&held.header)).unwrap_or_default();
        self.decode(Packet { offset, late, ..held.packet() }, is_last, take);
    }

    fn decode(&mut self, packet: Packet<'_>, is_last: bool, take: &mut dyn FnMut(DecodeResult)) {
        if let (Some(frame), _) = self.decoder.decode(packet, is_last) {
            take(Ok(frame));
        }
        if let Some(fault) = self.decoder.take_fault() {
            take(Err(fault));
        }
    }
}

fn origin_key(header: &PacketHeader) -> (PacketKind, SendingKey) {
    (header.kind, (header.time, header.count))
}
