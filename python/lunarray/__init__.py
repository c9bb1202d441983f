"""The open data chain of a lunar-orbit radio interferometer, from Python.

Everything is plain numpy: maps are arrays in HEALPix RING order, K, ecliptic coordinates, as healpy takes them; times are
seconds since the mission's epoch (and ``datetime64`` in tables); positions and baselines are metres in Moon-centred ecliptic
axes (x to ecliptic longitude 0, z to the north ecliptic pole). Satellites are counted from 1, channels from 0.

    V_ij = sum over pixels of T A S_i S_j exp(-2 pi i (nu / c) n . (r_i - r_j)) dOmega    (K sr)

Quantities of astropy are converted to these units, its ``Time`` to seconds since the epoch; masked values, complex skies and ``datetime64``, which
does not say whether it is UTC or TAI, are refused.

Settings are those of pipeline files (``pipelines/reference.toml`` has all); ``set={"map.nside": 8}`` replaces some of them.
Work that takes time releases the interpreter's lock and ends in order on Ctrl-C.
"""

from __future__ import annotations

from os import PathLike as _PathLike
from typing import Any as _Any

from ._array import Array
from ._chain import Ground, Replay, Run, State, replay, run
from ._downlink import Downlink, open
from ._joint import Joint, JointMap, joint
from ._map import Map, read_map
from ._native import VERSION as __version__
from ._native import ConfigurationError, Error
from ._native import inspect as _inspect
from ._predict import predict
from ._table import from_table
from ._uvdata import from_uvdata

__all__ = [
    "Array",
    "ConfigurationError",
    "Downlink",
    "Error",
    "Ground",
    "Joint",
    "JointMap",
    "Map",
    "Replay",
    "Run",
    "State",
    "from_table",
    "from_uvdata",
    "inspect",
    "joint",
    "open",
    "predict",
    "read_map",
    "replay",
    "run",
]


def inspect(path: str | _PathLike[str]) -> dict[str, _Any]:
    """What a downlink file holds, and its defects: what ``lunarray inspect --json`` prints, as a dictionary."""
    import json

    return json.loads(_inspect(path))
