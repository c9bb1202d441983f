"""How far a run is, in terminals and notebooks."""

import os
import subprocess
import sys

import pytest
from conftest import SMALL

import lunarray
from lunarray._progress import progress_of, text_of

#: All windows of a month, so that there is something to be shown.
LONGER = {**SMALL, "spacecraft.every_nth_window": 4, "spacecraft.every_nth_integration": 1, "spacecraft.duration_s": 30 * 86400.0}

RUN = f"""
import sys, lunarray
lunarray.run(set={LONGER!r}, out=sys.argv[1], progress={{}})
"""


def shown_in_a_terminal(folder, progress):
    """What a run writes to a terminal that is its standard error."""
    import pty

    ours, theirs = pty.openpty()
    command = [sys.executable, "-W", "ignore", "-c", RUN.format(progress), folder]
    with subprocess.Popen(command, stderr=theirs, stdout=subprocess.DEVNULL) as process:
        os.close(theirs)
        shown = b""
        while True:
            try:
                piece = os.read(ours, 4096)
            except OSError:
                # Nobody holds the other end any more.
                piece = b""
            if not piece:
                break
            shown += piece
    os.close(ours)
    assert process.returncode == 0, shown
    return shown.decode()


@pytest.mark.skipif(os.name != "posix", reason="terminals")
def test_a_terminal_shows_a_line_and_takes_it_away(tmp_path):
    shown = shown_in_a_terminal(tmp_path / "shown", None)
    lines = shown.split("\r\x1b[K")
    assert len(lines) > 2 and " windows" in lines[1] and "integrate " in shown and lines[-1] == ""
    assert max(map(len, lines)) <= 80
    assert shown_in_a_terminal(tmp_path / "not", False) == ""


def test_what_is_no_terminal_is_shown_nothing(tmp_path):
    command = [sys.executable, "-W", "ignore", "-c", RUN.format(None), tmp_path]
    told = subprocess.run(command, capture_output=True, text=True)
    assert (told.returncode, told.stdout, told.stderr) == (0, "", "")


def test_a_notebook_shows_one_text_that_changes(tmp_path, monkeypatch):
    """A kernel's shell and its display, as IPython has them."""
    import types

    shown = []

    class Handle:
        def update(self, data, raw):
            assert raw
            shown.append(data["text/plain"])

    def display(data, raw, display_id):
        assert raw and display_id
        shown.append(data["text/plain"])
        return Handle()

    ipython, displays = types.ModuleType("IPython"), types.ModuleType("IPython.display")
    ipython.get_ipython = lambda: types.SimpleNamespace(kernel=object())
    displays.display = display
    ipython.display = displays
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", displays)
    lunarray.run(set=LONGER, out=tmp_path)
    assert len(shown) > 1 and all(" windows" in text for text in shown)


def test_a_text_says_what_every_stage_has_done():
    stages = {"observe": (3, "windows"), "integrate": (1234, "visibilities"), "ground": (0, "visibilities"), "solve": (0, "")}
    assert text_of(stages, (2, 9), 12.4) == "12 s, 2/9 windows, observe 3 windows, integrate 1,234 visibilities"
    assert text_of({}, (0, 0), 1.0) == "1 s"
    assert progress_of(False) is None
