"""Values with units, masks, dates and other types: converted, or refused; never taken for something else."""

import datetime

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import Angle
from astropy.time import Time, TimeDelta
from astropy.utils.masked import Masked

import lunarray

SKY = 1e5 * (2 + np.random.default_rng(5).standard_normal(48))


def predicted(sky=SKY, freq=3e6, t=600.0, pairs=((1, 2), (3, 8)), **more):
    return lunarray.predict(sky, freq, t, list(pairs), **more)


@pytest.mark.parametrize(
    "given",
    [
        {"sky": (1e3 * SKY) * u.mK},
        {"sky": SKY.tolist() * u.K},
        {"sky": np.ma.masked_array(SKY, mask=False)},
        {"sky": Masked(SKY * u.K, mask=False)},
        {"freq": 3 * u.MHz},
        {"freq": np.float32(3e6)},
        {"t": 10 * u.min},
        {"t": (1 / 6) * u.hour},
        {"t": np.timedelta64(10, "m")},
        {"t": datetime.timedelta(minutes=10)},
        {"t": TimeDelta(600.0, format="sec", scale="tai")},
        {"t": np.int64(600)},
        {"pairs": np.array([[1, 2], [3, 8]], np.uint64)},
        {"pairs": np.array([[1, 2], [3, 8]], np.uint8)},
    ],
)
def test_units_are_converted(given):
    # The last digit, by which a product of units may differ, in each of the pixels that cancel and times some turns of phase.
    np.testing.assert_allclose(predicted(**given), predicted(), rtol=1e-10)


def test_times_of_astropy_are_since_the_epoch():
    array = lunarray.Array()
    epoch = Time("1958-01-01", scale="tai") + TimeDelta(array.epoch_tai_s, format="sec")
    times = epoch + [0.0, 12345.678] * u.s
    for given in (times, times.utc, times.tdb, list(times.utc)):
        # A satellite flies 1.6 km/s; days in two doubles hold some nanoseconds.
        np.testing.assert_allclose(array.positions(given), array.positions([0.0, 12345.678]), atol=1e-3, rtol=0)
    assert array.geometry(times[1].utc)["t_s"] == pytest.approx(12345.678, abs=1e-6)
    places = array.positions(60.0 * np.arange(9)) / 1e3 * u.km
    given = lunarray.Array.from_positions(np.arange(9) * u.min, places, moon_radius_m=1737.1 * u.km)
    np.testing.assert_allclose(given.positions(90 * u.s), array.positions(90.0), atol=1e-2, rtol=0)
    assert given.moon_radius_m == pytest.approx(1_737_100.0)
    for scale in ("local", "ut1"):
        with pytest.raises(lunarray.Error, match=f"scale '{scale}'"):
            array.positions(Time("2027-01-02", scale=scale))
    with pytest.raises(lunarray.Error, match="without an epoch"):
        given.positions(times[0])
    with pytest.raises(lunarray.Error, match="expected a time at which positions are known"):
        given.geometry(1e6)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"sky": SKY * u.MJy / u.sr}, "the sky in MJy / sr: expected numbers of K"),
        ({"sky": SKY * u.K * u.km / u.s}, "the sky in"),
        ({"sky": np.ma.masked_array(SKY, mask=np.arange(48) < 5)}, "the sky: 5 values are masked"),
        ({"sky": Masked(SKY * u.K, mask=np.arange(48) < 5)}, "the sky: 5 values are masked"),
        ({"sky": SKY * (1 + 1j)}, "found complex numbers; expected numbers of K"),
        ({"sky": SKY > 0}, "found truth values"),
        ({"sky": SKY.astype(str)}, "found text"),
        ({"sky": b"sky.fits"}, "found bytes"),
        ({"sky": SKY.reshape(4, 12)}, "the sky has shape .4, 12."),
        ({"sky": [[1.0], [1.0, 2.0]]}, "the sky: expected numbers of K"),
        ({"freq": 3 * u.m}, "the frequency in m: expected numbers of Hz"),
        ({"freq": [3e6, 4e6]}, "the frequency has shape .2,."),
        ({"freq": 3e6 + 1j}, "found complex numbers"),
        ({"freq": True}, "found truth values"),
        ({"t": 3 * u.m}, "t in m: expected numbers of s"),
        ({"t": 3j}, "found complex numbers"),
        ({"t": np.datetime64("2027-01-01T00:00:10")}, "whether it is UTC or TAI"),
        ({"t": np.array(["2027-01-01"], "M8[ms]")}, "whether it is UTC or TAI"),
        ({"t": [np.datetime64("2027-01-01", "us")]}, "whether it is UTC or TAI"),
        ({"t": datetime.datetime(2027, 1, 1)}, "whether it is UTC or TAI"),
        ({"t": "2027-01-01"}, "found text"),
        ({"t": np.ma.masked_array([1.0, 2.0], mask=[False, True])}, "t: 1 values are masked"),
        ({"pairs": [(2**64 + 1, 2)]}, "pair 18446744073709551617-2: expected two of the array's 8"),
        ({"pairs": np.array([[2**32 + 1, 2]])}, "pair 4294967297-2: expected"),
        ({"pairs": [(-1, 2)]}, "pair -1-2: expected"),
        ({"pairs": (1, 2)}, "pairs: found 1; expected two numbers"),
        ({"pairs": [(1.0, 2.0)]}, "expected two numbers of satellites"),
        ({"pairs": ["1-2"]}, "expected two numbers of satellites"),
    ],
)
def test_others_are_refused(given, text):
    with pytest.raises(lunarray.Error, match=text):
        predicted(**given)


def test_settings_have_the_units_of_their_keys():
    from lunarray._settings import overrides

    given = {
        "spacecraft.channels_hz": [1, 3] * u.MHz,
        "map.snapshot_every_s": 2 * u.day,
        "array.inclination_deg": Angle("30d"),
        "array.altitude_m": 300 * u.km,
        "array": {"phase_deg": 0.5 * np.pi * u.rad},
        "map.epsilon": np.float64(1e-4) * u.one,
        "spacecraft.baseline_wavelengths_max": np.array([16, 17])[0],
    }
    expected = [
        "spacecraft.channels_hz=[1000000.0, 3000000.0]",
        "map.snapshot_every_s=172800.0",
        "array.inclination_deg=30.0",
        "array.altitude_m=300000.0",
        "array={ phase_deg = 90.0 }",
        "map.epsilon=0.0001",
        "spacecraft.baseline_wavelengths_max=16",
    ]
    assert overrides(given) == expected
    with pytest.raises(lunarray.Error, match="array.altitude_m in s: expected numbers of m"):
        overrides({"array.altitude_m": 300 * u.s})
    with pytest.raises(lunarray.Error, match="map.nside in m: expected plain numbers"):
        overrides({"map.nside": 8 * u.m})
    with pytest.raises(TypeError, match="a setting is"):
        overrides({"map.nside": np.datetime64("2027-01-01")})
    with pytest.raises(TypeError, match="expected a dictionary"):
        overrides(b"map.nside=8")


def test_a_ground_takes_bytes_alone(small):
    ground = lunarray.Ground(set={"map.nside": 4})
    # bytes(5) would be five zeros.
    for wrong in (5, "text", [1, 2], np.zeros(4), None):
        with pytest.raises(TypeError, match="expected bytes"):
            ground.feed(wrong)
    with open(small.downlink, "rb") as file:
        data = file.read()
    for piece in (data[:999], bytearray(data[999:2000]), memoryview(data)[2000:9000], np.frombuffer(data[9000:], np.uint8)):
        ground.feed(piece)
    assert [one.channel for one in ground.finish()] == [0, 1]
    ground = lunarray.Ground(set={"map.nside": 4})
    ground.feed(b"\x00garbage" * 1000)
    with pytest.raises(lunarray.Error, match="8000 bytes were fed and no packet was among them"):
        ground.finish()


def test_errors_have_one_name_and_are_sent_between_processes():
    import pickle

    with pytest.raises(lunarray.Error) as raised:
        predicted(freq=1e12)
    assert type(raised.value).__module__ == "lunarray" and type(raised.value).__name__ == "Error"
    again = pickle.loads(pickle.dumps(raised.value))
    assert type(again) is lunarray.Error and str(again) == str(raised.value)
    assert not hasattr(lunarray, "LunarrayError") and not hasattr(lunarray._native, "LunarrayError")
