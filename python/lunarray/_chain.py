"""Running the chain, and its ground alone."""

from __future__ import annotations

import json
import os
import tempfile
from os import PathLike
from typing import Any, Iterable, Iterator

import numpy as np

from . import _native
from ._array import EPOCH, MOON_RADIUS_M, Array
from ._map import Map
from ._progress import Progress, progress_of
from ._settings import Settings, overrides
from ._values import number, numbers, octets


class Run:
    """What a run of the whole chain leaves: ``summary`` (as in summary.json), the final ``maps`` by channel, the folder ``out`` of
    its products, and its ``downlink`` file."""

    def __init__(self, summary: str, maps: list[dict[str, Any]], out: str | PathLike[str]) -> None:
        self.summary: dict[str, Any] = json.loads(summary)
        self.maps = sorted((Map(**found) for found in maps), key=lambda found: found.channel)
        self.out = os.fspath(out)

    @property
    def downlink(self) -> str:
        """The downlink file."""
        names = ("downlink.ccsds", "downlink.cadu")
        return next(path for path in (os.path.join(self.out, name) for name in names) if os.path.exists(path))

    def __repr__(self):
        return f"<lunarray.Run {self.summary['name']!r}: {len(self.maps)} maps in {self.out!r}>"


def run(
    pipeline: str | PathLike[str] | None = None,
    set: Settings = None,
    seed: int | None = None,
    out: str | PathLike[str] | None = None,
    progress: Progress = None,
    array: Array | None = None,
    epoch: str | np.datetime64 = EPOCH,
) -> Run:
    """Runs the whole chain: sky, spacecraft, downlink, ground, maps. As ``lunarray run``.

    ``pipeline`` is a file (the quicklook if not given), ``set`` replaces some of its settings, ``out`` is the folder of the products
    (out/NAME if not given). An ``array`` of given positions takes the place of the pipeline's, for as long as they are known, from
    ``epoch`` (their time 0, UTC) on; its OEM files stay in ``out``/orbits.

    Terminals and notebooks show how far it is, unless ``progress=False``. A function as ``progress`` is called some times a second
    with what each stage has done so far; an exception in it ends the run, as Ctrl-C does: in order, with products of the data so far.
    """
    settings = overrides(set)
    if array is not None:
        if out is None:
            raise _native.Error("out is not given: expected the folder of the products, in which the array's orbits are kept, too")
        settings = [*orbits_of(array, epoch, os.path.join(os.fspath(out), "orbits")), *settings]
    shown = progress_of(progress)
    try:
        return Run(*_native.run(pipeline, settings, seed, out, shown))
    finally:
        if shown is not None:
            shown.close()


def orbits_of(array: Array, epoch: str | np.datetime64, folder: str) -> list[str]:
    """Settings of a mission of an array of given positions, which it writes as OEM files."""
    paths = array.write_oem(folder, epoch)
    first_s, last_s = array.known_s
    if first_s > 0.0:
        raise _native.Error(f"the array's positions begin at {first_s} s: expected time 0, when the mission begins, among them")
    if array.moon_radius_m != MOON_RADIUS_M:
        raise _native.Error(f"the array's Moon has a radius of {array.moon_radius_m} m: expected {MOON_RADIUS_M} m in a mission")
    settings = {
        "array.oem": [os.path.abspath(path) for path in paths],
        "array.satellites": array.satellites,
        "array.oem_epoch": f"{np.datetime64(epoch, 's')}Z",
        "spacecraft.duration_s": last_s,
    }
    return overrides(settings)


class Replay:
    """The maps of a ground segment that takes downlink files, one by one as they are made; see :func:`replay`.

    ``summary`` is there once all maps have been taken. ``close()`` ends it early, as does the end of a ``with`` block.
    """

    def __init__(self, native: _native.NativeReplay, truth: Any, folder: Any, shown: Any) -> None:
        self._native, self._truth, self._folder, self._shown = native, truth, folder, shown

    def __iter__(self) -> Replay:
        return self

    def __next__(self) -> Map:
        try:
            found = self._native.next_map()
        finally:
            # Between maps others may write.
            if self._shown is not None:
                self._shown.close()
        if found is None:
            raise StopIteration
        made = Map(**found)
        if self._truth is not None:
            made.compare(*self._truth[made.channel] if isinstance(self._truth, list) else self._truth)
        return made

    def __enter__(self) -> Replay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends it; what was received is saved if there is a state."""
        self._native.close()

    @property
    def summary(self) -> dict[str, Any] | None:
        """The summary, as in summary.json; None before the last map was taken."""
        text = self._native.summary()
        return None if text is None else json.loads(text)


def replay(
    files: str | PathLike[str] | Iterable[str | PathLike[str]],
    map: str | PathLike[str] | None = None,
    every: float | None = None,
    set: Settings = None,
    state: str | PathLike[str] | None = None,
    out: str | PathLike[str] | None = None,
    truth: Any = None,
    progress: Progress = None,
) -> Replay:
    """Runs the ground segment on downlink files; iterate over what it returns to get its maps. As ``lunarray replay``.

    ``map`` is a map file (a pipeline file is one). Without one the settings of the maps are those of the state, if it has any; of the
    run that made the downlink, if its ``pipeline.toml`` lies beside the first file or it was the quicklook; then the defaults.
    ``every`` is the mission time between two snapshots, s or a quantity (none if not given), ``state`` a folder that keeps everything received, ``out`` a folder for products (none are kept if not given). ``truth`` is the true sky:
    a file or pixels, or ``[(sky, frame), ..]`` by channel; then maps have ``rho_l``. The next map is made while one is looked at, and
    no more than that. ``progress`` is that of :func:`run`.
    """
    files = [files] if isinstance(files, (str, os.PathLike)) else list(files)
    folder = None
    more = {}
    if out is None:
        folder = tempfile.TemporaryDirectory(prefix="lunarray-", ignore_cleanup_errors=True)
        out = folder.name
        more = {"products__pictures": False}
    if every is not None or map is None:
        more["map__snapshot_every_s"] = duration_s(every) or 0.0
    settings = overrides(None, **more) + overrides(set)
    if truth is not None and not isinstance(truth, list):
        truth = (truth,)
    shown = progress_of(progress)
    return Replay(_native.NativeReplay(files, out, map, settings, state, shown), truth, folder, shown)


def duration_s(every: Any) -> float | None:
    """The time between snapshots."""
    return None if every is None else number(every, "s", "every")


class State:
    """The state folder of a ground (``replay(state=..)``): everything that it has received. It has to be there."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = os.fspath(path)
        if not os.path.isdir(self.path):
            raise _native.Error(f"no state in {self.path}: expected a folder that replay(state=..) or lunarray replay --state has made")

    def solve(
        self,
        epsilon: float | Iterable[float] | None = None,
        map: str | PathLike[str] | None = None,
        set: Settings = None,
        samples: int = 0,
    ) -> list[Map]:
        """Maps of the sums, without new data; the state stays as it is.

        ``epsilon`` is one regularisation or a list of them, each for all channels; that of the settings if not given. Settings on
        which the sums depend are those of the state; ``map`` and ``set`` give others, such as ``map.prior_k``. Each map has as many
        posterior ``samples`` as asked for, with R from the data (no ``epsilon``).
        """
        if not 0 <= samples <= 10_000:
            raise _native.Error(f"samples = {samples}: expected 0 to 10000")
        if samples and epsilon is not None:
            raise _native.Error("samples need R from the data, which has no epsilon: expected one of the two")
        if isinstance(epsilon, Iterator):
            epsilon = list(epsilon)
        values = [] if epsilon is None else numbers(epsilon, "", "epsilon").ravel().tolist()
        found = _native.solve_state(self.path, map, overrides(set), values, samples)
        return [Map(**one) for one in found]


class Ground:
    """A ground that is fed with bytes as they arrive: every packet counts once.

    ``map``, ``set``, ``every`` and ``state`` are those of :func:`replay`.
    """

    def __init__(
        self,
        map: str | PathLike[str] | None = None,
        set: Settings = None,
        every: float | None = None,
        state: str | PathLike[str] | None = None,
    ) -> None:
        settings = overrides(None, map__snapshot_every_s=duration_s(every)) + overrides(set)
        self._native = _native.NativeGround(map, settings, state)

    def feed(self, data: bytes | bytearray | memoryview) -> list[Map]:
        """Takes bytes of the downlink, in pieces of any size; returns the snapshots that became due (with ``every``)."""
        return [Map(**found) for found in self._native.feed(octets(data))]

    def finish(self) -> list[Map]:
        """Ends the downlink, saves the state if there is one, and returns the final maps. Bytes without any packet are refused."""
        return [Map(**found) for found in self._native.finish()]

    @property
    def ledger(self) -> dict[str, Any]:
        """What became of every visibility so far."""
        return json.loads(self._native.ledger())
