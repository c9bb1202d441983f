"""The tutorials' code runs, and so do the notebooks."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from itertools import groupby
from pathlib import Path

import pytest
from conftest import REPOSITORY

#: For machines without it.
CURL = """command -v curl > /dev/null || curl() {
    python -c 'import sys, urllib.request as u; print(u.urlopen(sys.argv[-1]).read().decode())' "$@"
}
"""


def blocks(page):
    """The blocks of code that a page shows to be run, with their languages and the numbers of their first lines."""
    text = (REPOSITORY / "docs" / page).read_text()
    found = re.finditer(r"^```(python|sh)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    return [(match[1], match[2], text[: match.start(2)].count("\n")) for match in found]


def run_python(page, block, line, names):
    # Lines are those of the page, in a traceback too.
    exec(compile("\n" * line + block, f"docs/{page}", "exec"), names)


def run_shell(script):
    """What a shell prints that runs a script, whose ports are free ones; fails with it."""
    with socket.socket() as one, socket.socket() as other:
        for port, free in (("4711", one), ("8080", other)):
            free.bind(("127.0.0.1", 0))
            script = script.replace(port, str(free.getsockname()[1]))
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    # A file, and no pipe: what is left in the background would hold a pipe open.
    with tempfile.TemporaryFile("w+") as said:
        shell = subprocess.Popen(
            ["bash", "-euo", "pipefail", "-c", CURL + script],
            env={**os.environ, "PATH": path},
            stdout=said,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = shell.wait(timeout=300)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(shell.pid, signal.SIGKILL)
        said.seek(0)
        text = said.read()
    assert code == 0, text
    return text


def run_page(page):
    """Runs all blocks of a page in order; returns what its shells print."""
    names, said = {}, ""
    for kind, group in groupby(blocks(page), lambda block: block[0]):
        if kind == "sh":
            said += run_shell("".join(block for _, block, _ in group))
        else:
            for _, block, line in group:
                run_python(page, block, line, names)
    return said


def test_the_page_of_the_package_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    python = [(block, line) for kind, block, line in blocks("python.md") if kind == "python"]
    assert len(python) > 6
    names = {}
    for block, line in python:
        run_python("python.md", block, line, names)
    said = capsys.readouterr().out
    assert "final map at 3 MHz" in said
    assert (tmp_path / "channel1.uvh5").exists()


@pytest.mark.filterwarnings("ignore")
def test_the_tutorial_for_cosmologists_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    said = run_page("tutorials/cosmologist.md")
    assert "mine.toml: no problems" in said and "rho_l (noise power subtracted)" in said
    printed = capsys.readouterr().out
    assert "l = 12: rho " in printed and "epsilon 0.01: noise" in printed
    for name in ("made.png", "spectra.csv", "alm.fits", "hips/properties"):
        assert (tmp_path / name).stat().st_size > 100


def test_the_tutorial_for_ground_engineers_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = run_page("tutorials/ground-engineer.md")
    assert "A checkpoint of tcp://127.0.0.1" in said and "No packets are missing between those received." in said
    assert 'lunarray_run_phase{phase="running"} 1' in said and "lunarray_state_unsaved 0" in said
    # After being killed and told everything again: every visibility once.
    summary = json.loads((tmp_path / "maps/summary.json").read_text())
    ledger = summary["ledger"]
    assert ledger["sampled"] == ledger["accumulated"] + sum(ledger["flagged"].values()) and ledger["lost"] == []
    assert summary["completeness"]["complete"]


def test_the_tutorial_for_array_designers_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = run_page("tutorials/array-designer.md")
    assert "six.toml: no problems" in said and "daughter 6" in said and "daughter 7" not in said
    assert {"spacing.png", "coverage.csv", "pair-time.json"} <= {path.name for path in (tmp_path / "figures").iterdir()}
    # Three inclinations by two epsilons, and a head.
    assert len((tmp_path / "inclinations/study.csv").read_text().splitlines()) == 7


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["own-sky", "own-array"])
def test_notebooks_run(name, tmp_path, monkeypatch, capsys):
    """Their code cells in order, as a kernel would; their outputs are kept in the files."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    path = REPOSITORY / f"docs/notebooks/{name}.ipynb"
    notebook = json.loads(path.read_text())
    assert notebook["nbformat"] == 4 and len(notebook["cells"]) > 8
    names, counts = {}, []
    for number, cell in enumerate(notebook["cells"]):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), names)
            counts.append(cell["execution_count"])
            assert not any(output["output_type"] == "error" for output in cell["outputs"])
    # They were kept as they were run, once and in order.
    assert counts == list(range(1, len(counts) + 1))
    # What is kept is what it prints now; numbers to the digits that are printed.
    kept = [
        "".join(output["text"])
        for cell in notebook["cells"]
        for output in cell.get("outputs", [])
        if output["output_type"] == "stream"
    ]
    assert capsys.readouterr().out == "".join(kept)


#: A ground of a page runs on while the page goes on; the next one takes its port. `nc -N HOST PORT` for machines without it.
GROUNDS = """
lunarray() {
    case " $* " in
    *" --listen "*)
        if [ -n "${ground:-}" ]; then kill "$ground"; wait "$ground"; fi
        command lunarray "$@" & ground=$!
        for _ in $(seq 600); do
            if (exec 3<> /dev/tcp/127.0.0.1/4711) 2> /dev/null; then break; fi
            kill -0 "$ground"
            sleep 0.1
        done
        if [ -e stations ]; then cp stations malargue.token; fi ;;
    *) command lunarray "$@" ;;
    esac
}
nc() {
    python -c '
import shutil, socket, sys
with socket.create_connection((sys.argv[1], int(sys.argv[2]))) as there:
    with there.makefile("wb") as out:
        shutil.copyfileobj(sys.stdin.buffer, out)
    there.shutdown(socket.SHUT_WR)
    shutil.copyfileobj(there.makefile("rb"), sys.stdout.buffer)' "$2" "$3"
}
lunarray simulate pipelines/quicklook.toml --format cadu --out pass-0042.cadu
"""

SMALL_PIPELINE = """
[sky]
nside = 8
[spacecraft]
channels_hz = ["3MHz"]
thin = 2000
baseline_wavelengths_max = 16.0
[map]
nside = 4
[products]
pictures = false
"""


def test_the_page_of_a_live_ground_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pipelines").mkdir()
    (tmp_path / "pipelines/quicklook.toml").write_text(SMALL_PIPELINE)
    script = GROUNDS
    for kind, block, _ in blocks("live.md"):
        assert kind == "sh"
        script += block
    said = run_shell(script + 'kill "$ground"\nwait "$ground"\n')
    # What is sent by `simulate` and by `send`.
    assert said.count(" confirmed all ") == script.count(" --send ") + script.count("lunarray send ") >= 3


def test_the_first_screen_runs(tmp_path, monkeypatch, capsys):
    """README's commands on the quicklook, thinned ten times as much (the gate runs it whole), and its Python."""
    monkeypatch.chdir(tmp_path)
    shown = blocks("../README.md")
    assert [kind for kind, _, _ in shown] == ["sh", "python"]
    thinner = "--set map.nside=8 --set spacecraft.every_nth_window=410 --set products.pictures=false"
    cargo = 'cargo() { test "$1 $2 $3" = "run --release --"; shift 3; lunarray "$@" ' + thinner + "; }\n"
    said = run_shell(cargo + shown[0][1])
    assert "serving on http://" in said and (tmp_path / "out/quicklook/summary.json").exists()
    run_python("../README.md", shown[1][1], shown[1][2], {})
    assert "visibilities" in capsys.readouterr().out
