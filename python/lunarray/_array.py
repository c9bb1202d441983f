"""Where satellites are."""

from __future__ import annotations

import os
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._settings import Settings, overrides
from ._values import hertz, number, numbers, seconds
from ._write import writing

#: Mean radius of the Moon, m.
MOON_RADIUS_M = 1_737_100.0


#: Date of time 0 of positions that say no other, UTC.
EPOCH = "2027-01-01T00:00:00"

_OEM = """CCSDS_OEM_VERS = 2.0
CREATION_DATE = {created}
ORIGINATOR = LUNARRAY

META_START
OBJECT_NAME = SATELLITE {number}
OBJECT_ID = 2027-001{name}
CENTER_NAME = MOON
REF_FRAME = ECLIPJ2000
TIME_SYSTEM = UTC
START_TIME = {start}
STOP_TIME = {stop}
INTERPOLATION = LAGRANGE
INTERPOLATION_DEGREE = 7
META_STOP
"""


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
        self._known_s: NDArray[np.float64] | None = None

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
        array._known_s = times
        return array

    @property
    def satellites(self) -> int:
        """Number of satellites."""
        return self._native.satellites

    @property
    def known_s(self) -> tuple[float, float]:
        """First and last time of given positions, s; those of a pipeline are always known."""
        if self._known_s is None:
            return -np.inf, np.inf
        return float(self._known_s[0]), float(self._known_s[-1])

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """All pairs, satellites from 1, in the order 1-2, 1-3, .., 2-3, .."""
        return [(i, j) for i in range(1, self.satellites + 1) for j in range(i + 1, self.satellites + 1)]

    def positions(self, t: ArrayLike) -> NDArray[np.float64]:
        """Positions at a time or times, s: shape ``t.shape + (satellites, 3)``, m. A time at which they are not known is an error."""
        times = seconds(t, self.epoch_tai_s)
        return self._native.positions(times.ravel()).reshape(*times.shape, self.satellites, 3)

    def write_oem(self, folder: str | PathLike[str], epoch: str | np.datetime64 = EPOCH) -> list[str]:
        """Writes an array of given positions as CCSDS OEM files (``folder/sat1.oem``, ..; km, ecliptic axes of J2000, centre MOON), and
        returns their paths. ``epoch`` is the date of time 0, UTC, from 2017 on. A pipeline's orbits: ``lunarray export orbits``."""
        if self._known_s is None:
            raise _native.Error("the array is a pipeline's: expected one of given positions; lunarray export orbits writes others")
        start = np.datetime64(epoch, "ns")
        if not start >= np.datetime64("2017-01-01"):
            raise _native.Error(f"epoch {epoch}: expected a date from 2017-01-01 on, after the last leap second")
        dates = [str(start + np.timedelta64(round(t * 1e9), "ns")) for t in self._known_s]
        times = self._known_s
        positions, velocity = self.positions(times), np.empty((len(times), self.satellites, 3))
        velocity[1:-1] = (self.positions(times[1:-1] + 1.0) - self.positions(times[1:-1] - 1.0)) / 2.0
        for end, step in ((0, 1.0), (-1, -1.0)):
            at = self.positions(times[end] + step * np.arange(3))
            velocity[end] = (-3.0 * at[0] + 4.0 * at[1] - at[2]) / (2.0 * step)
        states = np.concatenate([positions, velocity], axis=2) / 1e3
        os.makedirs(folder, exist_ok=True)
        paths = [os.path.join(os.fspath(folder), f"sat{n + 1}.oem") for n in range(self.satellites)]
        for n, path in enumerate(paths):
            lines = [f"{date} " + " ".join(f"{x:.12f}" for x in state) for date, state in zip(dates, states[:, n])]
            head = _OEM.format(created=dates[0], number=n + 1, name=chr(65 + n % 26), start=dates[0], stop=dates[-1])
            with writing(path, os.devnull, b"CCSDS_OEM", "OEM") as unfinished, open(unfinished, "w") as file:
                file.write(head + "\n".join(lines) + "\n")
        return paths

    def _time(self, t: ArrayLike) -> NDArray[np.float64]:
        times = seconds(t, self.epoch_tai_s)
        if times.ndim != 0:
            raise _native.Error(f"t has shape {times.shape}: expected one time")
        return times

    def geometry(self, t: float, frequency_hz: float | str = 10e6) -> dict[str, Any]:
        """Everything at a time, s, as ``lunarray geometry --json`` prints it: positions, baselines r_i - r_j by pair and their
        lengths, m; and for an array of a pipeline whether it observes (the Moon hides the Earth), the direction of the Earth and of
        the Sun (None where the mission's Earth is an idealised one, without dates), and the integration time of each pair at a
        frequency, s."""
        time_s = float(self._time(t))
        places = self.positions(time_s)
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
            observing, earth, sun = self._native.earth(time_s)
            found["observing"], found["earth_hat"] = observing, np.array(earth)
            found["sun_hat"] = None if sun is None else np.array(sun)
            found["dt_s"] = np.array(
                [self._native.integration_s(time_s, i - 1, j - 1, hertz(frequency_hz)) for i, j in self.pairs]
            )
        return found
