"""Positions, and visibilities of a sky against a dense sum by numpy."""

import astropy.units
import healpy
import numpy as np
import pytest

import lunarray

SPEED_OF_LIGHT, MOON_RADIUS_M = 299_792_458.0, 1_737_100.0


def dense(pixels, frequency, r_i, r_j, rotation=np.eye(3)):
    """The sum over all pixels that neither satellite finds behind the Moon."""
    nside = healpy.get_nside(pixels)
    n = np.array(healpy.pix2vec(nside, np.arange(len(pixels)))).T @ rotation.T
    seen = np.ones(len(pixels), bool)
    for r in (r_i, r_j):
        along = n @ r
        seen &= ~((along < 0) & (r @ r - along**2 < MOON_RADIUS_M**2))
    phase = np.exp(-2j * np.pi * frequency / SPEED_OF_LIGHT * (n @ (r_i - r_j)))
    return np.sum(pixels * seen * phase) * healpy.nside2pixarea(nside)


def sky(nside=16):
    return 1e5 * (2 + np.random.default_rng(7).standard_normal(12 * nside**2))


def test_predictions_are_dense_sums():
    array, pixels = lunarray.Array(), sky()
    times, pairs = np.array([0.0, 4321.5, 7e5]), [(1, 2), (3, 8)]
    found = lunarray.predict(pixels, 3e6, times, pairs)
    assert found.shape == (3, 2)
    for a, time in enumerate(times):
        places = array.positions(time)
        for b, (i, j) in enumerate(pairs):
            expected = dense(pixels, 3e6, places[i - 1], places[j - 1])
            # Rounding of 3072 terms and of phases of some hundred turns.
            assert abs(found[a, b] - expected) < 1e-9 * np.abs(pixels).sum() * healpy.nside2pixarea(16)
    assert lunarray.predict(pixels, 3e6, 0.0).shape == (28,)
    for frequency in ["3MHz", "3000 kHz", astropy.units.Quantity(3, "MHz")]:
        assert (lunarray.predict(pixels, frequency, times, pairs) == found).all()


def test_a_galactic_sky_is_turned_as_healpy_turns_it():
    pixels = sky(8)
    places = lunarray.Array().positions(100.0)
    rotation = healpy.Rotator(coord=["G", "E"]).mat
    expected = dense(pixels, 1e6, places[0], places[1], rotation)
    found = lunarray.predict(pixels, 1e6, 100.0, [(1, 2)], frame="G")[0]
    # The frames are defined to some milliarcseconds: 1e-8 rad, of some turns.
    assert abs(found - expected) < 1e-6 * abs(expected)


def test_given_positions_are_an_array():
    paper = lunarray.Array()
    t = 60.0 * np.arange(40)
    array = lunarray.Array.from_positions(t, paper.positions(t))
    between = np.array([333.3, 1234.567])
    # As the ground interpolates: about a micrometre for nodes a minute apart.
    np.testing.assert_allclose(array.positions(between), paper.positions(between), atol=1e-4, rtol=0)
    ours = lunarray.predict(sky(8), 3e6, between, [(1, 8)], array=array)
    theirs = lunarray.predict(sky(8), 3e6, between, [(1, 8)])
    # A tenth of a millimetre is 6e-6 rad at 3 MHz.
    np.testing.assert_allclose(ours, theirs, rtol=1e-4)
    geometry = array.geometry(333.3)
    assert geometry["baselines_m"].shape == (28, 3) and "observing" not in geometry
    with pytest.raises(lunarray.Error, match="t = 1000000 s: expected a time at which positions are known, 0 s to 2340 s"):
        lunarray.predict(sky(8), 3e6, [1e6], array=array)


def test_geometry_is_what_the_command_prints():
    import json
    import subprocess
    import sys

    command = [sys.executable, "-m", "lunarray", "geometry", "--at", "7d", "--freq-hz", "3e6", "--json"]
    printed = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    found = lunarray.Array().geometry(7 * 86400.0, frequency_hz=3e6)
    assert found["observing"] == printed["observing"]
    np.testing.assert_array_equal(found["satellites_m"], printed["satellites_m"])
    np.testing.assert_array_equal(found["baselines_m"], [pair["baseline_m"] for pair in printed["pairs"]])
    np.testing.assert_array_equal(found["dt_s"], [pair["dt_s"] for pair in printed["pairs"]])
    assert [f"{i}-{j}" for i, j in found["pairs"]] == [pair["pair"] for pair in printed["pairs"]]
    tilted = lunarray.Array(set={"array.inclination_deg": 60}).positions(0.0)
    assert np.abs(tilted - found["satellites_m"]).max() > 1e4


def test_what_cannot_be_is_refused():
    refusals = [
        (dict(pairs=[(1, 9)]), "pair 1-9: expected two of the array's 8 satellites"),
        (dict(pairs=[(0, 1)]), "pair 0-1: expected two of the array's 8 satellites"),
        (dict(freq="3 feet"), "frequency is .3 feet.: expected a number of Hz, or one with"),
        (dict(freq=1e12), "frequency 1000000000000 Hz: expected"),
        (dict(sky=np.ones(13)), "13"),
        (dict(sky=np.full(12, np.nan)), "NaN"),
        (dict(frame="X"), "expected E .ecliptic."),
    ]
    for changed, text in refusals:
        arguments = {"sky": sky(1), "freq": 3e6, "t": 0.0, **changed}
        with pytest.raises(lunarray.Error, match=text):
            lunarray.predict(**arguments)


def test_a_map_of_another_frequency_is_refused(tmp_path, small):
    header = [("FREQ", 3e6)]
    healpy.write_map(tmp_path / "sky.fits", sky(8), coord="E", column_units="K", dtype=np.float64, extra_header=header)
    for given in [tmp_path / "sky.fits", small.maps[-1]]:
        assert lunarray.predict(given, "3 MHz", 0.0).shape == (28,)
        with pytest.raises(lunarray.Error, match="3(.000)? MHz[;:] expected 10(.000)? MHz"):
            lunarray.predict(given, "10 MHz", 0.0)


def test_odd_tables_of_positions_are_refused():
    t = 60.0 * np.arange(9)
    places = np.ones((9, 2, 3)) * 2e6
    places[:, 1] += 500.0

    def changed(value, k=4):
        odd = places.copy()
        odd[k, 1] = value
        return odd

    for times, positions, text in [
        (t[:5], places[:5], "at least 8 times"),
        (t**2, places, "expected equal steps"),
        # A gap, an overlap, times that run back, none.
        (np.where(t > 200, t + 60, t), places, "step after time 3 is 120 s"),
        (np.where(t > 200, t - 60, t), places, "step after time 3 is 0 s"),
        (np.where(t > 450, t + 60, t), places, "step after time 7 is 120 s"),
        (t[::-1], places, "the first -60 s; expected equal steps"),
        (t * np.nan, places, "t = NaN"),
        (t, changed(np.nan), "a position is NaN"),
        (t, changed(1e6 / 3**0.5), "satellite 2 at t = 240 s is 1000.000 km from the Moon's centre: expected above its surface"),
        (t, changed(1e9), "satellite 2 at t = 240 s .* within 1e6 km"),
        (t, changed(places[4, 0]), "satellites 1 and 2 at t = 240 s are at one place"),
        (t, places[:, 0], "expected .times,. and"),
        (t, places * np.inf, "a position is inf"),
    ]:
        with pytest.raises(lunarray.Error, match=text):
            lunarray.Array.from_positions(times, positions)


def test_a_mission_of_given_positions_flies_them(tmp_path):
    # Three satellites on planes of their own, which no setting of the formation makes.
    t = np.arange(-1200.0, 86400.0 + 1201.0, 60.0)
    phase = 7.7e-4 * t[:, None] + np.array([0.0, 6e-5, 1.4e-4])
    tilt = np.radians([30.0, 30.0005, 30.001])
    xyz = 2.037e6 * np.stack([np.cos(phase), np.sin(phase) * np.cos(tilt), np.sin(phase) * np.sin(tilt)], axis=-1)
    mine = lunarray.Array.from_positions(t, xyz)
    settings = {
        "spacecraft.channels_hz": [3e6],
        "spacecraft.every_nth_integration": [1],
        "spacecraft.every_nth_window": 1,
        "map.nside": 2,
        "map.engine": "pixel",
        "products.pictures": False,
    }
    made = lunarray.run(set=settings, out=tmp_path / "mission", array=mine, epoch="2030-06-01T12:00:00", progress=False)
    sent = lunarray.open(made.downlink)
    seen = sent.visibilities(0)
    assert sent.satellites == 3 and len(seen) > 0 and (seen["time_s"] < 86400).all()
    # UTC is 37 s behind TAI.
    assert sent.epoch == np.datetime64("2030-06-01T12:00:37")
    # Files have micrometres, and packets parts of a millimetre.
    assert np.abs(sent.ephemeris(seen["time_s"]) - mine.positions(seen["time_s"])).max() < 1e-3
    # Angular velocity times radius, by the formula.
    with open(tmp_path / "mission" / "orbits" / "sat2.oem") as file:
        state = np.array(file.readlines()[-1].split()[1:], dtype=float)
    assert np.linalg.norm(state[3:]) == pytest.approx(7.7e-4 * 2.037e3, rel=1e-5)
    for wrong, message in (
        ({"out": None}, "out is not given"),
        ({"array": lunarray.Array.from_positions(t[30:], xyz[30:])}, "begin at 600.0 s: expected time 0"),
        ({"array": lunarray.Array()}, "the array is a pipeline's"),
        ({"array": lunarray.Array.from_positions(t, xyz, 1.7e6)}, "radius of 1700000.0 m"),
        ({"epoch": "2016-06-01"}, "after the last leap second"),
    ):
        with pytest.raises(lunarray.Error, match=message):
            lunarray.run(**{"set": settings, "out": tmp_path / "wrong", "array": mine, "progress": False, **wrong})
