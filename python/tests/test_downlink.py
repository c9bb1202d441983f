"""Downlink files as arrays, against readers that share nothing with lunarray."""

import json
import struct
import subprocess
import sys

import numpy as np
import pytest
from ccsdspy import utils
from downlink_read import EPHEMERIS, VISIBILITIES, load_visibilities, payloads

import lunarray

SPEED_OF_LIGHT, BOLTZMANN = 299_792_458.0, 1.380649e-23


def by_ccsdspy(path, channel):
    """The visibilities of a channel by ccsdspy and numpy, a dictionary of arrays in the order of the file."""
    with open(path, "rb") as file:
        table = load_visibilities(utils.split_by_apid(file)[VISIBILITIES])
    found = {name: [] for name in ("time_s", "dt_s", "i", "j", "value", "weight", "flag")}
    for k, arrays in enumerate(table["arrays"]):
        if table["channel"][k] != channel or table["i"][k] == table["j"][k]:
            continue
        n, octets = int(table["count"][k]), arrays.astype(np.uint8).tobytes()
        offset, duration = (np.frombuffer(octets, "<u4", n, 4 * n * part).astype(np.int64) for part in (0, 1))
        middle = 2 * (int(table["start_ticks"][k]) + offset) + duration
        found["time_s"].append(middle * 0.5e-6)
        found["dt_s"].append(duration * 1e-6)
        found["i"].append(np.full(n, table["i"][k] + 1))
        found["j"].append(np.full(n, table["j"][k] + 1))
        found["value"].append(np.frombuffer(octets, "<c8", n, 8 * n))
        found["weight"].append(np.frombuffer(octets, "<f4", n, 16 * n))
        found["flag"].append(np.frombuffer(octets, "u1", n, 20 * n))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def segments(path):
    """Segments of positions: start and step, s, and positions of shape (nodes, satellites, 3)."""
    for octets in payloads(list(utils.iter_packet_bytes(path)), EPHEMERIS):
        start, step, satellites, nodes = struct.unpack_from("<qIBI", octets)
        places = np.frombuffer(octets, "<f8", offset=17).reshape(nodes, satellites, 3)
        yield start * 1e-6, step * 1e-6, places


def lagrange(start, step, places, time):
    """The polynomial through the eight nodes about a time."""
    at = (time - start) / step
    first = int(np.clip(np.floor(at) - 3, 0, len(places) - 8))
    nodes = np.arange(first, first + 8)
    factors = [np.prod([(at - m) / (n - m) for m in nodes if m != n]) for n in nodes]
    return np.tensordot(factors, places[nodes], 1)


@pytest.mark.parametrize("channel", [0, 1])
def test_visibilities_are_those_that_ccsdspy_reads(small, channel):
    expected = by_ccsdspy(small.downlink, channel)
    found = lunarray.open(small.downlink).visibilities(channel)
    assert len(found) == len(expected["time_s"]) > 1000
    for name in ("time_s", "dt_s", "i", "j", "weight", "flag"):
        assert (found[name] == expected[name]).all(), name
    assert (found["value_k_sr"] == expected["value"]).all()
    frequency = lunarray.open(small.downlink).channels_hz[channel]
    jansky = expected["value"].astype(complex) * 2 * BOLTZMANN * frequency**2 / SPEED_OF_LIGHT**2 * 1e26
    # Products of a few doubles.
    np.testing.assert_allclose(found["value_jy"], jansky, rtol=1e-14)


def test_positions_are_interpolated_between_the_nodes_sent(small):
    downlink = lunarray.open(small.downlink)
    tables = list(segments(small.downlink))
    found = downlink.visibilities(1)
    checked = 0
    for row in found[:: len(found) // 97]:
        holding = [t for t in tables if t[0] <= row["time_s"] <= t[0] + t[1] * (len(t[2]) - 1)]
        places = lagrange(*max(holding, key=lambda table: table[0]), row["time_s"])
        # Times of 4e7 s are doubles 7e-9 s apart, in which a satellite moves 1.1e-5 m.
        np.testing.assert_allclose(row["r_i_m"], places[row["i"] - 1], atol=1.1e-5, rtol=0)
        np.testing.assert_allclose(row["r_j_m"], places[row["j"] - 1], atol=1.1e-5, rtol=0)
        np.testing.assert_allclose(row["uvw_m"], row["r_i_m"] - row["r_j_m"], atol=0, rtol=0)
        np.testing.assert_allclose(downlink.ephemeris(row["time_s"]), places, atol=1.1e-5, rtol=0)
        checked += 1
    assert checked > 90
    start, step, nodes = tables[0]
    times = start + step * np.arange(len(nodes))
    np.testing.assert_allclose(downlink.ephemeris(times[:8]), nodes[:8], atol=1.1e-5, rtol=0)
    assert np.isnan(downlink.ephemeris([start - 1e6])).all()


def test_times_are_those_of_astropy(small):
    from astropy.time import Time

    downlink = lunarray.open(small.downlink)
    rows = downlink.visibilities(0)[::211]
    # 1958-01-01 in TAI is what CCSDS counts from.
    tai = Time("1958-01-01", scale="tai").datetime64 + np.timedelta64(round(downlink.instrument["epoch_tai_s"]), "s")
    assert downlink.epoch == tai
    # Middles are whole halves of microseconds; as doubles, 4e7 s are 7e-9 s apart.
    since = (rows["tai"] - tai).astype(np.int64)
    assert (since % 500 == 0).all() and (np.abs(since * 1e-9 - rows["time_s"]) < 1.5e-8).all()
    utc = Time(rows["tai"].astype("M8[us]").astype(str), scale="tai").utc
    # Both are cut to microseconds.
    assert (np.abs(utc.datetime64 - rows["utc"]) <= np.timedelta64(1, "us")).all()


def test_what_a_file_holds_is_what_the_command_prints(small):
    command = [sys.executable, "-m", "lunarray", "inspect", small.downlink, "--json"]
    printed = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    found = lunarray.inspect(small.downlink)
    assert found == printed == lunarray.open(small.downlink).inspect()
    counted = sum(len(lunarray.open(small.downlink).visibilities(channel)) for channel in (0, 1))
    assert found["visibilities"]["count"] == counted


def test_autos_are_apart_from_visibilities(tmp_path):
    settings = [
        "spacecraft.fidelity=samples",
        "spacecraft.duration_s=9000.0",
        "spacecraft.every_nth_window=1",
        "spacecraft.window_s_max=2.0",
        "spacecraft.channels_hz=[10e6]",
        "daughters.bits=32",
        "sky.nside=8",
        "map.epsilon=1e-4",
    ]
    words = [word for setting in settings for word in ("--set", setting)]
    path = tmp_path / "samples.ccsds"
    subprocess.run([sys.executable, "-m", "lunarray", "simulate", "--out", path, *words], check=True)
    downlink = lunarray.open(path)
    found = downlink.autos()
    assert set(found["satellite"]) == set(range(1, 9)) and set(found["frequency_hz"]) == {10e6}
    assert (found["power_k_sr"] > 0).all()
    rows = downlink.visibilities(0)
    assert len(rows) > 0 and (rows["i"] < rows["j"]).all()


def test_files_that_are_none_are_refused(small, tmp_path):
    with pytest.raises(lunarray.Error, match="nowhere.ccsds"):
        lunarray.open(tmp_path / "nowhere.ccsds")
    empty = tmp_path / "empty.ccsds"
    empty.write_bytes(b"")
    with pytest.raises(lunarray.Error, match="empty.ccsds"):
        lunarray.open(empty)
    with pytest.raises(lunarray.Error, match="channel 2: expected one of the file's 2 channels, from 0"):
        lunarray.open(small.downlink).visibilities(2)
    for beyond in (-1, 65536):
        with pytest.raises(lunarray.Error, match=f"channel {beyond}: expected one of the file's 2 channels, from 0"):
            lunarray.open(small.downlink).visibilities(beyond)
    for nowhere in ((0, 95), (0, float("nan")), (1e3, 0)):
        with pytest.raises(lunarray.Error, match="expected right ascension and declination"):
            lunarray.open(small.downlink).write_uvh5(tmp_path / "x.uvh5", phase_centre=nowhere)
    with pytest.raises(lunarray.Error, match="-1e9 to 1e9"):
        lunarray.open(small.downlink).ephemeris(float("nan"))
