"""The chain, its ground alone, and their maps."""

import functools
import os
import signal
import subprocess
import sys
import threading
import time

import healpy
import numpy as np
import pytest
from conftest import SMALL

import lunarray


def test_maps_are_those_of_the_files_and_healpy_reads_them(small):
    assert [found.frequency_hz for found in small.maps] == [1e6, 3e6]
    for found in small.maps:
        path = os.path.join(small.out, f"{found.frequency_hz / 1e6:.3f}MHz", "map.fits")
        pixels = healpy.read_map(path, dtype=None)
        # Files are in single precision if they are not in double.
        np.testing.assert_allclose(found.pixels, pixels, rtol=1e-6)
        assert healpy.get_nside(found.pixels) == found.nside == 4 and found.is_final
        alm = healpy.map2alm(found.pixels, lmax=11, iter=3)
        # The same iteration, from other recurrences.
        np.testing.assert_allclose(found.alm, alm, atol=1e-8 * np.abs(alm).max())
        assert np.nanmax(found.rho_l) <= 1.0 and found.rho_l[0] > 0.9


def test_rho_is_that_of_healpy(small):
    found = small.maps[1]
    truth = healpy.alm2map(healpy.map2alm(found.pixels, lmax=8), 4) + 10.0 * found.noise
    compared = found.compare(truth)
    ours, theirs = (healpy.map2alm(pixels, lmax=11, iter=3) for pixels in (found.pixels, truth))
    cross, one, other = healpy.alm2cl(ours, theirs), healpy.alm2cl(ours), healpy.alm2cl(theirs)
    np.testing.assert_allclose(compared["rho"], cross / np.sqrt(one * other), atol=1e-6)
    assert found.rho_l is compared["rho"]


def test_replay_makes_the_same_maps_bit_by_bit(small):
    again = list(lunarray.replay(small.downlink, set={"map.nside": 4, "map.epsilon": 1e-4}))
    assert [(found.channel, found.is_final) for found in again] == [(0, True), (1, True)]
    for ours, theirs in zip(again, small.maps):
        assert (ours.pixels == theirs.pixels).all() and (ours.noise == theirs.noise).all()


def test_replay_gives_snapshots_while_it_runs(small):
    settings = {"map.nside": 4, "map.epsilon": 1e-4}
    maps = lunarray.replay([small.downlink], every=20 * 86400.0, set=settings, truth=np.ones(192))
    assert maps.summary is None
    found = list(maps)
    assert len(found) > 4 and sum(one.is_final for one in found) == 2
    assert all(one.span_s[1] > 0 and one.rho_l is not None for one in found)
    assert [c["visibilities"] for c in maps.summary["channels"]] == [m.visibilities for m in found if m.is_final]
    with lunarray.replay([small.downlink], every=20 * 86400.0, set=settings) as maps:
        next(maps)
    assert list(maps) == []


def test_a_ground_takes_bytes_in_pieces(small):
    ground = lunarray.Ground(set={"map.nside": 4, "map.epsilon": 1e-4}, every=20 * 86400.0)
    with open(small.downlink, "rb") as file:
        pieces = [ground.feed(piece) for piece in iter(lambda: file.read(70_001), b"")]
    assert sum(map(len, pieces)) > 2
    # The ledger is closed by the end alone.
    assert ground.ledger["accumulated"] > 0
    for ours, theirs in zip(ground.finish(), small.maps):
        assert (ours.pixels == theirs.pixels).all()
    with pytest.raises(lunarray.Error, match="finished"):
        ground.feed(b"")


def test_a_state_is_solved_without_new_data_or_settings(small, tmp_path):
    state = tmp_path / "state"
    list(lunarray.replay(small.downlink, set={"map.nside": 4, "map.epsilon": 1e-4, "map.companion_seed": 5}, state=state))
    before = {path.name: path.read_bytes() for path in state.iterdir()}
    found = lunarray.State(state).solve(epsilon=[1e-4, 1e-2])
    assert [(one.channel, one.epsilon) for one in found] == [(0, 1e-4), (1, 1e-4), (0, 1e-2), (1, 1e-2)]
    assert {path.name: path.read_bytes() for path in state.iterdir()} == before
    for epsilon, maps in ((1e-4, found[:2]), (1e-2, found[2:])):
        settings = {"map.nside": 4, "map.epsilon": epsilon, "map.companion_seed": 5}
        for ours, theirs in zip(maps, lunarray.replay(small.downlink, set=settings)):
            assert (ours.pixels == theirs.pixels).all() and (ours.noise == theirs.noise).all()
    # It can be continued without them, too; settings that it was not made with are refused.
    assert [one.nside for one in lunarray.replay(small.downlink, state=state)] == [4, 4]
    with pytest.raises(lunarray.Error, match="map.nside"):
        lunarray.State(state).solve(set={"map.nside": 8})
    with pytest.raises(lunarray.Error, match="no checkpoint"):
        lunarray.State(tmp_path).solve()
    with pytest.raises(lunarray.Error, match="no state in .*nix: expected a folder"):
        lunarray.State(tmp_path / "nix")


@pytest.fixture(scope="module")
def harmonic_state(tmp_path_factory):
    """A state of two channels over harmonics, with total powers."""
    folder = tmp_path_factory.mktemp("joint")
    settings = {
        "spacecraft.channels_hz": [5e6, 10e6],
        # Enough windows that coverage is even, which standard deviations assume.
        "spacecraft.every_nth_window": 60,
        "spacecraft.baseline_wavelengths_max": 8.0,
        "spacecraft.auto_powers": True,
        "map.engine": "harmonic",
        "map.nside": 4,
        "products.pictures": False,
    }
    made = lunarray.run(set=settings, out=folder / "out", progress=None)
    list(lunarray.replay(made.downlink, set={"map.engine": "harmonic", "map.nside": 4}, state=folder / "state"))
    return str(folder / "state")


def test_maps_have_errors_and_samples(harmonic_state, small):
    drawn = lunarray.State(harmonic_state).solve(samples=40)
    for found in drawn:
        assert found.samples.shape == (40, 192) and found.sigma.shape == found.resolution_deg.shape == (192,)
        # 40 samples: their standard deviation is right to 1 / sqrt(80) of itself, of the median pixel to less.
        scatter = (found.samples - found.pixels).std(axis=0) / found.sigma
        assert 0.75 < np.median(scatter) < 1.25
        # The scatter of means has the same accuracy: four of its standard deviations.
        assert abs((found.samples.mean(axis=1) - found.pixels.mean()).std() / found.mean_sigma - 1) < 4 / np.sqrt(80)
    assert lunarray.State(harmonic_state).solve()[0].samples.shape == (0, 192)
    # The identity has no errors.
    assert small.maps[0].sigma is None and small.maps[0].mean_sigma is None
    with pytest.raises(lunarray.Error, match="samples need R from the data"):
        lunarray.State(harmonic_state).solve(samples=2, set={"map.regulariser": "identity"})
    with pytest.raises(lunarray.Error, match="expected 0 to 10000"):
        lunarray.State(harmonic_state).solve(samples=-1)
    with pytest.raises(lunarray.Error, match="expected one of the two"):
        lunarray.State(harmonic_state).solve(samples=2, epsilon=1e-4)


def test_channels_are_mapped_together(harmonic_state, tmp_path):
    state = lunarray.State(harmonic_state)
    found = lunarray.joint(state, at="7MHz", samples=4)
    assert [one.frequency_hz for one in found.maps] == [5e6, 7e6, 10e6] and found.converged
    command = ["joint", harmonic_state, "--at", "7MHz", "--count", "4", "--out", str(tmp_path / "joint")]
    assert lunarray._native.run_command(["lunarray", *command]) == 0
    for one in found.maps:
        pixels, _ = lunarray.read_map(tmp_path / "joint" / f"{one.frequency_hz / 1e6:.3f}MHz" / "map.fits")
        # Files have single precision.
        assert (pixels == one.pixels.astype(np.float32)).all() and (one.sigma > 0).all() and one.mean_sigma > 0
    # Between channels there are no data to agree with.
    assert [one.agreement is None for one in found.maps] == [False, True, False]
    assert found.maps[0].powers["rows"] > 0 and found.index.shape == (192,) and found.curvature.size == 0
    assert found.reference_hz == pytest.approx(np.sqrt(5e6 * 10e6))
    without = lunarray.joint([harmonic_state], samples=2, powers=False)
    assert without.maps[0].powers is None
    for wrong, message in (
        ({"at": 12e6}, "between 5.000 and 10.000 MHz"),
        ({"samples": 1}, "expected 2 to 1000"),
        ({"power_priors": [0.1]}, "expected three"),
        ({"power_priors": [0.1, -1.0, 0.0]}, "expected three"),
        ({"power_constant_k_sr": [1.0, 2.0, 3.0]}, "3 constants of the total powers"),
    ):
        with pytest.raises(lunarray.Error, match=message):
            lunarray.joint(state, **wrong)


def test_settings_that_are_wrong_are_told_together():
    with pytest.raises(lunarray.ConfigurationError) as raised:
        lunarray.run(set={"map.nside": 7, "map.epsilom": 1, "sky.file": "a \"b\" \\ c.fits"})
    text = str(raised.value)
    for part in ("map.nside = 7: expected a power of two", "map.epsilom: no such key"):
        assert part in text, text
    assert isinstance(raised.value, lunarray.Error)
    with pytest.raises(TypeError, match="a setting is"):
        lunarray.run(set={"map.nside": object()})
    with pytest.raises(lunarray.Error, match="nowhere.toml"):
        lunarray.run("nowhere.toml")


def test_settings_are_written_as_toml():
    from lunarray._settings import overrides

    given = {"a": 1, "b": 1e-4, "c": True, "d": [1.0, np.float64(2)], "e": "x\"\\\n", "f": {"spectral_index": -2.5}}
    expected = ["a=1", "b=0.0001", "c=true", "d=[1.0, 2.0]", 'e="x\\"\\\\\\U0000000a"', "f={ spectral_index = -2.5 }"]
    assert overrides(given) == expected
    assert overrides("a=1") == ["a=1"] and overrides(None) == []


def test_other_threads_run_meanwhile(tmp_path):
    work = threading.Thread(target=lunarray.run, kwargs={"set": SMALL, "out": tmp_path})
    work.start()
    turns = 0
    while work.is_alive():
        time.sleep(0.001)
        turns += 1
    # With the lock held, this thread would run again only at the end.
    assert turns > 5


def test_progress_is_told_and_can_end_a_run(tmp_path):
    seen = []

    def progress(stages):
        seen.append(stages)
        if stages["integrate"][0] > 0:
            raise LookupError("enough")

    with pytest.raises(LookupError, match="enough"):
        settings = {"products.pictures": False, "spacecraft.every_nth_window": 1}
        lunarray.run(set=settings, out=tmp_path, progress=progress)
    assert seen and (tmp_path / "summary.json").exists()


LONG = """
import lunarray, sys
def progress(stages):
    print("at work", flush=True)
settings = {"products.pictures": False, "map.nside": 8, "spacecraft.every_nth_window": 1}
lunarray.run(set=settings, out=sys.argv[1], progress=progress)
"""


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_ends_a_run_in_order(tmp_path):
    command = [sys.executable, "-c", LONG, tmp_path]
    # A shell's background jobs ignore the signal, and what they start does, too, unless told otherwise.
    heed = functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, preexec_fn=heed) as process:
        assert process.stdout.readline() == "at work\n"
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=300)
    assert "KeyboardInterrupt" in told, told
    assert (tmp_path / "summary.json").exists()
