"""Visibilities of a sky."""

from __future__ import annotations

from os import PathLike
from typing import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._array import Array
from ._map import Map, sky_of
from ._values import hertz, pairs_of, seconds


def predict(
    sky: str | PathLike[str] | Map | ArrayLike,
    freq: float | str,
    t: ArrayLike,
    pairs: Iterable[tuple[int, int]] | None = None,
    array: Array | None = None,
    frame: str | None = None,
) -> NDArray[np.complex128]:
    """Visibilities of a sky by a direct sum over its pixel centres, in double precision, K sr.

    ``sky`` is a HEALPix map in K (or a quantity of temperature) of the frequency ``freq``: a file, a :class:`Map`, or pixels in RING order (``frame`` E, G or C; ecliptic if not said).
    ``freq`` in Hz or with its unit (``"3MHz"``), ``t`` in s since the epoch (or a quantity, or ``astropy.time.Time``), ``pairs`` of satellites from 1 (all if not given), ``array`` an :class:`Array` (the
    paper's if not given). Returns shape ``t.shape + (pairs,)``. Directions that the Moon hides from either satellite count
    nothing.
    """
    array = Array() if array is None else array
    indices = pairs_of(array.pairs if pairs is None else pairs, array.satellites)
    frequency_hz = hertz(freq)
    pixels, letter = sky_of(sky, frame, frequency_hz)
    times = seconds(t, array.epoch_tai_s)
    places = array.positions(times.ravel()).reshape(times.size, -1)
    found = _native.predict(pixels, letter, frequency_hz, places, indices, array.moon_radius_m, array.dipoles)
    return found.reshape(*times.shape, len(indices))
