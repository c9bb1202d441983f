"""Writes fixtures/downlink_v1.ccsds: a small downlink of format version 1, by other code than ours.

usage: downlink_make.py fixtures/downlink_v1.ccsds

Primary headers by spacepackets (PyPI), everything else by struct from the tables in src/core/downlink. The Rust test
that reads it knows the formulas below.
"""

import struct
import sys

from spacepackets.ccsds.spacepacket import SequenceFlags, SpacePacketHeader

from downlink_read import crc16_ccsds, crc32c

EPOCH_TAI_S = 2_000_000_000.5


def packet(apid, count, time_s, payload, flags=SequenceFlags.UNSEGMENTED):
    header = SpacePacketHeader.tm(
        apid, count % 16384, data_len=16 + len(payload) + 4 - 1, sec_header_flag=True, seq_flags=flags
    )
    units = round((EPOCH_TAI_S + time_s) * 2**24)
    head = header.pack() + b"\x1f" + units.to_bytes(7, "big") + b"\x4c\x01" + struct.pack(">I", count >> 14)
    body = head + struct.pack(">H", crc16_ccsds(head)) + payload
    return body + struct.pack(">I", crc32c(body))


def main(path):
    name = "made elsewhere".encode()
    instrument = struct.pack("<Q", len(name)) + name
    instrument += struct.pack("<ddBBQQH", EPOCH_TAI_S, 1_737_100.0, 3, 1, 11, 12, 2)
    instrument += struct.pack("<4d", 1e6, 8e3, 2e6, 4e3)
    positions = [(1e6 + 1000 * node + satellite, -node, 0.5) for node in range(8) for satellite in range(3)]
    ephemeris = struct.pack("<qIBI", -1_000_000, 1_000_000, 3, 8)
    ephemeris += b"".join(struct.pack("<3d", *position) for position in positions)
    n = 4
    visibilities = struct.pack("<HBBqI", 1, 0, 2, 500_000, n)
    visibilities += struct.pack(f"<{n}I", *(250_000 * k for k in range(n)))
    visibilities += struct.pack(f"<{n}I", *(200_000 + k for k in range(n)))
    visibilities += struct.pack(f"<{2 * n}f", *(x for k in range(n) for x in (k + 0.25, -k)))
    visibilities += struct.pack(f"<{n}f", *(2.0**k for k in range(n)))
    visibilities += bytes([0, 1, 2, 0])
    housekeeping = struct.pack("<qQQ", 2_000_000, 5, 1)
    half = len(ephemeris) // 2
    with open(path, "wb") as file:
        file.write(packet(0x101, 0, 0.0, instrument))
        file.write(packet(0x102, 16383, 0.0, ephemeris[:half], SequenceFlags.FIRST_SEGMENT))
        file.write(packet(0x102, 16384, 0.0, ephemeris[half:], SequenceFlags.LAST_SEGMENT))
        file.write(packet(0x103, 3 << 14, 1.450003, visibilities))
        file.write(packet(0x104, 0, 1.5, b"reserved"))
        file.write(packet(0x105, 0, 2.0, housekeeping))


if __name__ == "__main__":
    main(*sys.argv[1:])
