"""lunarray in several processes: what threads have worked in is not forked."""

import multiprocessing
import os
import subprocess
import sys

import pytest
from conftest import SMALL

import lunarray

#: Long enough for a process to start and to import numpy, and no measure of anything: what hangs, hangs for ever.
PATIENCE_S = 120


def predicted(_=None):
    return lunarray.predict([1.0] * 768, 3e6, 0.0).shape


def ran(folder):
    return lunarray.run(set={**SMALL, "spacecraft.every_nth_window": 600}, out=folder).maps[0].pixels.tolist()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("work", [predicted, ran])
def test_a_fork_of_a_process_that_has_worked_says_what_to_do(work, tmp_path):
    predicted()
    with multiprocessing.get_context("fork").Pool(1) as pool:
        with pytest.raises(lunarray.Error, match=r'is a fork of process \d+, .* multiprocessing.get_context\("spawn"\)'):
            pool.map_async(work, [tmp_path / "fork"]).get(timeout=PATIENCE_S)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_replay_is_not_taken_into_a_fork(small):
    replay = lunarray.replay(small.downlink, set={"map.nside": 4, "map.epsilon": 1e-4})
    child = os.fork()
    if child == 0:
        try:
            replay.close()
            next(replay)
        except lunarray.Error as error:
            os._exit(17 if "spawn" in str(error) else 1)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 17
    assert len(list(replay)) == 2


def test_a_process_of_its_own_works(tmp_path):
    predicted()
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        assert pool.map_async(predicted, [1, 2]).get(timeout=PATIENCE_S) == [(28,), (28,)]
        one, two = pool.map_async(ran, [tmp_path / "a", tmp_path / "b"]).get(timeout=PATIENCE_S)
    assert one == two


FORKED = """
import multiprocessing, sys, lunarray
def predicted(_):
    return lunarray.predict([1.0] * 768, 3e6, 0.0).shape
# Reading takes no threads but its own.
downlink = lunarray.open(sys.argv[1])
with multiprocessing.get_context("fork").Pool(2) as pool:
    print(pool.map_async(predicted, [1, 2]).get(timeout=100), downlink.satellites)
    print(predicted(0))
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
def test_forks_of_a_process_that_has_not_worked_work(small):
    command = [sys.executable, "-W", "ignore", "-c", FORKED, small.downlink]
    told = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert told.returncode == 0 and told.stdout == "[(28,), (28,)] 8\n(28,)\n", told.stdout + told.stderr
