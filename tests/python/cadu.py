"""Reads a coded downlink with other people's decoders, and makes one of its own.

usage: cadu.py CODED PACKETS MADE

CODED is taken apart to packets, which must be those of the file PACKETS, octet for octet; then the same packets are
put into frames here, damaged as much as the code allows, and written to MADE. Reed-Solomon is that of
reed_solomon_ccsds, packets are told apart by ccsdspy and spacepackets; frames, randomizer and marker follow the
standards bit by bit. Nothing of lunarray is used. Prints one line; any difference is an exception.
"""

import random
import sys

from ccsdspy import utils
from reed_solomon_ccsds import decode, encode
from spacepackets.ccsds.spacepacket import SpacePacketHeader

MARKER = bytes.fromhex("1acffc1d")
INTERLEAVE = 5
DATA, BLOCK = 223 * INTERLEAVE, 255 * INTERLEAVE
SPACECRAFT, SCIENCE, HOUSEKEEPING, IDLE = 0x4C, 1, 2, 63


def pseudo_random(octets):
    """x^8 + x^7 + x^5 + x^3 + 1 from all ones: each bit is the sum of those 8, 5, 3 and 1 before it."""
    bits = [1] * 8
    while len(bits) < 8 * octets:
        bits.append(bits[-8] ^ bits[-5] ^ bits[-3] ^ bits[-1])
    return bytes(int("".join(map(str, bits[k : k + 8])), 2) for k in range(0, 8 * octets, 8))


SEQUENCE = pseudo_random(BLOCK)
assert SEQUENCE.startswith(bytes.fromhex("ff480ec09a0d70bc"))


def randomized(block):
    return bytes(a ^ b for a, b in zip(block, SEQUENCE))


def frames_of(stream):
    """Header fields and data field of each frame; every block must be a codeword as it is."""
    assert len(stream) % (4 + BLOCK) == 0
    for at in range(0, len(stream), 4 + BLOCK):
        assert stream[at : at + 4] == MARKER
        block = randomized(stream[at + 4 : at + 4 + BLOCK])
        corrected, frame = decode(block, dual_basis=True, interleaving=INTERLEAVE)
        assert frame == block[:DATA] and not any(corrected), at
        if at % 7 == 0:  # it takes a tenth of a second
            assert bytes(encode(block[:DATA], dual_basis=True, interleaving=INTERLEAVE)) == block
        bits = int.from_bytes(frame[:6], "big")
        version, spacecraft, channel = bits >> 46, bits >> 38 & 0xFF, bits >> 32 & 0x3F
        replay, usage, spare, cycle = bits >> 7 & 1, bits >> 6 & 1, bits >> 4 & 3, bits & 15
        assert (version, spacecraft, replay, usage, spare) == (1, SPACECRAFT, 0, 1, 0)
        yield channel, cycle << 24 | bits >> 8 & 0xFFFFFF, bytes(frame[6:])


def packets_of(frames):
    """Packets by virtual channel, put together by the zones alone; pointers must agree. Counts of frames."""
    streams, starts, counts = {}, {}, {}
    for channel, count, field in frames:
        assert count == counts.get(channel, 0)
        counts[channel] = count + 1
        if channel == IDLE:
            continue
        pointer, zone = int.from_bytes(field[:2], "big"), field[2:]
        assert pointer < 0x800
        stream = streams.setdefault(channel, bytearray())
        starts.setdefault(channel, []).append((len(stream), None if pointer == 0x7FF else len(stream) + pointer))
        stream.extend(zone)
    found = {}
    for channel, stream in streams.items():
        at, begins = 0, set()
        while at < len(stream):
            begins.add(at)
            length = SpacePacketHeader.unpack(bytes(stream[at : at + 6])).packet_len
            found.setdefault(channel, []).append(bytes(stream[at : at + length]))
            at += length
        assert at == len(stream), "the last packet is cut off"
        for start, pointed in starts[channel]:
            inside = [b for b in begins if start <= b < start + DATA - 8]
            assert (min(inside) if inside else None) == pointed
    return found, counts


def is_idle(packet):
    return SpacePacketHeader.unpack(packet[:6]).apid == 0x7FF


def check(coded, packets):
    found, counts = packets_of(frames_of(coded))
    for channel, sent in packets.items():
        assert [p for p in found[channel] if not is_idle(p)] == sent, channel
    assert set(counts) == {SCIENCE, HOUSEKEEPING, IDLE}
    return counts


def frame(channel, count, pointer, zone):
    identification = 1 << 14 | SPACECRAFT << 6 | channel
    head = identification.to_bytes(2, "big") + (count & 0xFFFFFF).to_bytes(3, "big") + bytes([0])
    return head + pointer.to_bytes(2, "big") + zone


def make(packets, noise):
    """All packets on one virtual channel; 24-bit counts that wrap, and up to 16 wrong octets a codeword."""
    stream, begins = bytearray(), set()
    for packet in packets:
        begins.add(len(stream))
        stream.extend(packet)
    zone = DATA - 8
    begins.add(len(stream))
    fill = -len(stream) % zone
    fill += zone if 0 < fill < 7 else 0
    stream.extend(bytes.fromhex("07ffc000") + (fill - 7).to_bytes(2, "big") + bytes(fill - 6) if fill else b"")
    made = bytearray()
    for k in range(0, len(stream), zone):
        inside = [b - k for b in begins if k <= b < k + zone]
        pointer = min(inside) if inside else 0x7FF
        count = (0xFFFFF0 + k // zone) & 0xFFFFFF
        data = frame(SCIENCE, count, pointer, bytes(stream[k : k + zone]))
        block = bytearray(randomized(encode(data, dual_basis=True, interleaving=INTERLEAVE)))
        for codeword in range(INTERLEAVE):
            for place in noise.sample(range(255), noise.choice([0, 1, 5, 16])):
                block[place * INTERLEAVE + codeword] ^= noise.randrange(1, 256)
        made.extend(MARKER + block)
    return made


def main(coded_path, packets_path, made_path):
    channel = {True: HOUSEKEEPING, False: SCIENCE}
    packets, everything = {}, []
    for packet in map(bytes, utils.iter_packet_bytes(packets_path)):
        packets.setdefault(channel[SpacePacketHeader.unpack(packet[:6]).apid == 0x105], []).append(packet)
        everything.append(packet)
    with open(coded_path, "rb") as file:
        counts = check(file.read(), packets)
    with open(made_path, "wb") as file:
        file.write(make(everything, random.Random(7)))
    print(f"{len(everything)} packets in {sum(counts.values())} frames: the same")


if __name__ == "__main__":
    main(*sys.argv[1:])
