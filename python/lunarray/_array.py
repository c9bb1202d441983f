"""Where satellites are."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._settings import Settings, overrides
from ._values import hertz, number, numbers, seconds

#: Mean radius of the Moon, m.
MOON_RADIUS_M = 1_737_100.0


class Array:
    """An array of satellites: the paper's, that of a pipeline file, or one of given positions.

    ``Array()``, ``Array("pipeline.toml", set={"array.inclination_deg": 60})``, ``Array.from_positions(t, xyz)``. Times are seconds since
    the mission's epoch, quantities of time, or ``astropy.time.Time`` where positions are a pipeline's.
    """

    def __init__(self, pipeline: str | PathLike[str] | None = None, set: Settings = None) -> None:
        self._native = _native.NativeArray(pipeline, overrides(set))
        self.moon_radius_m = self._native.moon_radius_m
        self.dipoles = self._native.dipoles
        self.epoch_tai_s: float | None = self._native.epoch_tai_s

    @classmethod
    def from_positions(cls, t: ArrayLike, xyz: ArrayLike, moon_radius_m: float = MOON_RADIUS_M) -> Array:
        """Satellites at given positions: ``t`` in s at equal steps, at least 8; ``xyz`` of shape (times, satellites, 3), m in
        Moon-centred ecliptic axes, above the surface and at least 1 m apart. Between times they are interpolated as the ground does
        (eight nodes)."""
        times, places = seconds(t, None, "times"), numbers(xyz, "m", "positions")
        radius_m = number(moon_radius_m, "m", "moon_radius_m")
        if times.ndim != 1 or places.ndim != 3 or places.shape[2] != 3:
            raise _native.Error(
                f"times of shape {times.shape} and positions of shape {places.shape}; expected (times,) and "
                "(times, satellites, 3)"
            )
        array = cls.__new__(cls)
        array._native = _native.NativeEphemeris(times, places.reshape(len(places), -1), radius_m)
        array.moon_radius_m, array.dipoles, array.epoch_tai_s = radius_m, False, None
        return array

    @property
    def satellites(self) -> int:
        """Number of satellites."""
        return self._native.satellites

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """All pairs, satellites from 1, in the order 1-2, 1-3, .., 2-3, .."""
        return [(i, j) for i in range(1, self.satellites + 1) for j in range(i + 1, self.satellites + 1)]

    def positions(self, t: ArrayLike) -> NDArray[np.float64]:
        """Positions at a time or times, s: shape ``t.shape + (satellites, 3)``, m; NaN where unknown."""
        times = seconds(t, self.epoch_tai_s)
        return self._native.positions(times.ravel()).reshape(*times.shape, self.satellites, 3)

    def _time(self, t: ArrayLike) -> NDArray[np.float64]:
        times = seconds(t, self.epoch_tai_s)
        if times.ndim != 0:
            raise _native.Error(f"t has shape {times.shape}: expected one time")
        return times

    def geometry(self, t: float, frequency_hz: float | str = 10e6) -> dict[str, Any]:
        """Everything at a time, s, as ``lunarray geometry --json`` prints it: positions, baselines r_i - r_j by pair and their
        lengths, m; and for an array of a pipeline whether it observes (the Moon hides the Earth), the direction of the Earth, and
        the integration time of each pair at a frequency, s."""
        time_s = float(self._time(t))
        places = self.positions(time_s)
        if not np.isfinite(places).all():
            raise _native.Error(f"t = {time_s} s: expected a time at which positions are known")
        first, second = (np.array(part) - 1 for part in zip(*self.pairs))
        baselines = places[first] - places[second]
        found = {
            "t_s": time_s,
            "satellites_m": places,
            "pairs": self.pairs,
            "baselines_m": baselines,
            "lengths_m": np.linalg.norm(baselines, axis=1),
        }
        if isinstance(self._native, _native.NativeArray):
            observing, earth = self._native.earth(time_s)
            found["observing"], found["earth_hat"] = observing, np.array(earth)
            found["dt_s"] = np.array(
                [self._native.integration_s(time_s, i - 1, j - 1, hertz(frequency_hz)) for i, j in self.pairs]
            )
        return found
