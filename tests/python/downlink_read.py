"""Reads a downlink file with other people's decoders and compares it with what was sent.

usage: downlink_read.py FILE EXPECTED.json

ccsdspy splits the file into packets and decodes headers and visibility payloads; spacepackets decodes the
primary headers a second time. Nothing of lunarray is used. Prints one line; any difference is an exception.
"""

import json
import struct
import sys
from collections import defaultdict

import ccsdspy
import numpy as np
from ccsdspy import PacketArray, PacketField, VariableLength, utils
from spacepackets.ccsds.spacepacket import PacketType, SequenceFlags, SpacePacketHeader

INSTRUMENT, EPHEMERIS, VISIBILITIES, HOUSEKEEPING = 0x101, 0x102, 0x103, 0x105


def crc(data, polynomial, width, start, reflected):
    """Bit by bit, as the standard writes it."""
    register = start
    top = 1 << (width - 1)
    for byte in data:
        if reflected:
            register ^= byte
            for _ in range(8):
                register = (register >> 1) ^ polynomial if register & 1 else register >> 1
        else:
            register ^= byte << (width - 8)
            for _ in range(8):
                register = (register << 1) ^ polynomial if register & top else register << 1
            register &= (1 << width) - 1
    return register


def crc16_ccsds(data):
    return crc(data, 0x1021, 16, 0xFFFF, False)


def crc32c(data):
    return crc(data, 0x82F63B78, 32, 0xFFFFFFFF, True) ^ 0xFFFFFFFF


def check_headers(packets):
    """Primary headers by spacepackets: fields, lengths, counts that run on, segments that make sense."""
    counts = defaultdict(int)
    open_segment = defaultdict(bool)
    for k, packet in enumerate(packets):
        header = SpacePacketHeader.unpack(packet)
        assert header.ccsds_version == 0 and header.packet_type == PacketType.TM and header.sec_header_flag
        assert header.packet_len == len(packet), (header, len(packet))
        assert header.seq_count == counts[header.apid] % 16384, header
        (high,) = struct.unpack_from(">I", packet, 16)
        assert high << 14 | header.seq_count == counts[header.apid]
        counts[header.apid] += 1
        begins = header.seq_flags in (SequenceFlags.FIRST_SEGMENT, SequenceFlags.UNSEGMENTED)
        assert begins != open_segment[header.apid], header
        open_segment[header.apid] = header.seq_flags in (
            SequenceFlags.FIRST_SEGMENT,
            SequenceFlags.CONTINUATION_SEGMENT,
        )
        assert packet[14] == 0x4C and packet[15] == 1
        if k % 7 == 0:  # bit by bit is slow
            assert struct.unpack_from(">H", packet, 20) == (crc16_ccsds(packet[:20]),)
            assert struct.unpack(">I", packet[-4:]) == (crc32c(packet[:-4]),)
    assert not any(open_segment.values())
    return counts


def payloads(packets, apid):
    """Payloads of a kind, segments put together."""
    whole = b""
    for packet in packets:
        header = SpacePacketHeader.unpack(packet)
        if header.apid == apid:
            whole += packet[22:-4]
            if header.seq_flags in (SequenceFlags.LAST_SEGMENT, SequenceFlags.UNSEGMENTED):
                yield whole
                whole = b""


def load_visibilities(stream):
    """Headers, times and visibility records by ccsdspy; arrays by numpy."""
    fields = [
        PacketField("p_field", "uint", 8),
        PacketField("coarse_s", "uint", 32),
        PacketField("fine", "uint", 24),
        PacketField("magic", "uint", 8),
        PacketField("version", "uint", 8),
        PacketField("count_high", "uint", 32),
        PacketField("header_check", "uint", 16),
        PacketField("channel", "uint", 16, byte_order="little"),
        PacketField("i", "uint", 8),
        PacketField("j", "uint", 8),
        PacketField("start_ticks", "int", 64, byte_order="little"),
        PacketField("count", "uint", 32, byte_order="little"),
        PacketArray(name="arrays", data_type="uint", bit_length=8, array_shape="expand"),
        PacketField("check", "uint", 32),
    ]
    return VariableLength(fields).load(stream, include_primary_header=True)


def check_visibilities(stream, expected, epoch_tai_s):
    table = load_visibilities(stream)
    assert (table["CCSDS_SECONDARY_FLAG"] == 1).all() and (table["p_field"] == 0x1F).all()
    counts = np.arange(len(table["i"]))
    assert (table["CCSDS_SEQUENCE_COUNT"] == counts % 16384).all()
    found = defaultdict(lambda: [np.empty(0)] * 5)
    newest_s = 0.0
    for k, arrays in enumerate(table["arrays"]):
        n = int(table["count"][k])
        octets = arrays.astype(np.uint8).tobytes()
        assert len(octets) == 21 * n
        offset = np.frombuffer(octets, "<u4", n)
        duration = np.frombuffer(octets, "<u4", n, 4 * n)
        value = np.frombuffer(octets, "<c8", n, 8 * n)
        weight = np.frombuffer(octets, "<f4", n, 16 * n)
        flags = np.frombuffer(octets, "u1", n, 20 * n)
        names = ("channel", "i", "j", "start_ticks")
        key = tuple(int(table[name][k]) for name in names)
        found[key] = [np.concatenate(pair) for pair in zip(found[key], (offset, duration, value, weight, flags))]
        # A packet is made when its last integration ends, and times never go back.
        end_s = (key[3] + int(offset[-1]) + int(duration[-1])) * 1e-6
        newest_s = max(newest_s, end_s)
        time_s = int(table["coarse_s"][k]) + int(table["fine"][k]) / 2**24
        # Half a unit of the time code, 2^-25 s, and the rounding of 2.5e9 s in double precision, 2^-22 s.
        assert abs(time_s - (epoch_tai_s + newest_s)) < 2**-25 + 2**-21, (time_s, newest_s)
    for block in expected:
        key = (block["channel"], block["i"], block["j"], block["start_ticks"])
        offset, duration, value, weight, flags = found.pop(key)
        assert (offset == block["offset_ticks"]).all()
        assert (duration == block["duration_ticks"]).all()
        assert (value.real == np.float32(block["re"])).all() and (value.imag == np.float32(block["im"])).all()
        assert (weight == np.float32(block["weight"])).all()
        assert (flags == block["flags"]).all()
    assert not found
    return int(table["count"].sum())


def check_ephemeris(packets, expected):
    found = list(payloads(packets, EPHEMERIS))
    assert len(found) == len(expected)
    for octets, segment in zip(found, expected):
        start, step, satellites, nodes = struct.unpack_from("<qIBI", octets)
        assert (start, step, satellites) == (segment["start_ticks"], segment["step_ticks"], segment["satellites"])
        positions = np.frombuffer(octets, "<f8", offset=17).reshape(nodes, satellites, 3)
        assert (positions == np.array(segment["positions_m"]).reshape(positions.shape)).all()


def check_instrument(packets, expected):
    for octets in payloads(packets, INSTRUMENT):
        (length,) = struct.unpack_from("<Q", octets)
        assert octets[8 : 8 + length].decode() == expected["name"]
        epoch, moon, satellites, response, seed, digest, channels = struct.unpack_from("<ddBBQQH", octets, 8 + length)
        assert (epoch, moon, satellites) == tuple(expected[k] for k in ("epoch_tai_s", "moon_radius_m", "satellites"))
        assert (response, seed, digest) == (0, expected["seed"], expected["configuration_hash"])
        table = np.frombuffer(octets, "<f8", offset=8 + length + 36).reshape(channels, 2)
        assert (table == np.array(expected["channels"])).all()


def main(path, expected_path):
    with open(expected_path) as file:
        expected = json.load(file)
    packets = list(utils.iter_packet_bytes(path))
    counts = check_headers(packets)
    check_instrument(packets, expected["instrument"])
    check_ephemeris(packets, expected["ephemeris"])
    with open(path, "rb") as file:
        streams = utils.split_by_apid(file)
    epoch_tai_s = expected["instrument"]["epoch_tai_s"]
    visibilities = check_visibilities(streams[VISIBILITIES], expected["visibilities"], epoch_tai_s)
    found = [struct.unpack("<qQQ", octets) for octets in payloads(packets, HOUSEKEEPING)]
    assert found == [tuple(counts) for counts in expected["housekeeping"]]
    print(f"ccsdspy {ccsdspy.__version__}: {len(packets)} packets, {visibilities} visibilities, APIDs {dict(counts)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
