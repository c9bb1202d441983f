"""Downlink files as arrays."""

from __future__ import annotations

import json
import operator
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._rows import AUTO, VISIBILITY
from ._values import seconds


def open(path: str | PathLike[str]) -> Downlink:
    """Reads a downlink file (packets or CADUs) into memory, 21 bytes a visibility."""
    return Downlink(path)


class Downlink:
    """A downlink file, as it came down: nothing is calibrated.

    ``instrument`` has its name, epoch (TAI seconds since 1958), channels, number of satellites and what else it says of itself.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = path
        self._native = _native.NativeDownlink(path)
        self.instrument: dict[str, Any] = json.loads(self._native.instrument())

    def __repr__(self):
        channels = ", ".join(f"{hz / 1e6:g}" for hz in self.channels_hz)
        return f"<lunarray.Downlink {str(self.path)!r}: {self.satellites} satellites, {channels} MHz>"

    @property
    def channels_hz(self) -> NDArray[np.float64]:
        """Centre frequencies of the channels, Hz."""
        return np.array(self.instrument["channels_hz"])

    @property
    def satellites(self) -> int:
        """Number of satellites that are correlated."""
        return self.instrument["satellites"]

    @property
    def epoch(self) -> np.datetime64:
        """The mission's epoch, TAI as ``datetime64``."""
        return np.datetime64("1958-01-01", "ns") + np.timedelta64(round(self.instrument["epoch_tai_s"] * 1e9), "ns")

    def visibilities(self, channel: int = 0) -> NDArray[np.void]:
        """The visibilities of a channel, a structured array in the order of the file.

        ``time_s`` is the middle of an integration, s since the epoch, ``tai`` and ``utc`` the same as ``datetime64``, ``dt_s`` its
        length; ``i`` and ``j`` the satellites, from 1; ``uvw_m`` the baseline r_i - r_j and ``r_i_m``, ``r_j_m`` the positions, m in
        Moon-centred ecliptic axes, NaN where the file has none; ``value_k_sr`` the visibility and ``value_jy`` the same times
        2 k nu^2 / c^2; ``weight`` the inverse variance of the real part, (K sr)^-2; ``flag`` is 0 for a good one. ``utc`` has
        leap seconds; during one it is the next midnight, as ``datetime64`` has no second 60.
        """
        # The native function counts in 16 bits, and Python would say no more than that another number does not fit.
        number, count = operator.index(channel), len(self.channels_hz)
        if not 0 <= number < count:
            raise _native.Error(f"channel {number}: expected one of the file's {count} channels, from 0")
        return self._native.visibilities(number).view(VISIBILITY)

    def autos(self) -> NDArray[np.void]:
        """The auto-correlations of all channels, a structured array with the frequency of each; power in K sr."""
        rows, frequencies_hz = self._native.autos()
        rows = rows.view(VISIBILITY)
        found = np.empty(len(rows), AUTO)
        for name in ("time_s", "tai", "utc", "dt_s", "weight", "flag"):
            found[name] = rows[name]
        found["satellite"], found["power_k_sr"] = rows["i"], rows["value_k_sr"].real
        found["frequency_hz"] = frequencies_hz
        return found

    def ephemeris(self, t: ArrayLike) -> NDArray[np.float64]:
        """Positions of the satellites at a time or times, s since the epoch (or ``astropy.time.Time``): shape ``t.shape + (satellites, 3)``, m, Moon-centred
        ecliptic axes; NaN where the file has none."""
        times = seconds(t, self.instrument["epoch_tai_s"])
        return self._native.positions(times.ravel()).reshape(*times.shape, self.satellites, 3)

    def write_uvh5(
        self,
        path: str | PathLike[str],
        channel: int = 0,
        phase_centre: tuple[float, float] = (266.405, -28.936),
    ) -> int:
        """Writes the good visibilities of a channel as UVH5, for pyuvdata and what reads its files; returns their number.

        Values are in Jy, phased to a centre (right ascension and declination, degrees or quantities of angle, ICRS; that of the Galaxy if
        not given). They are those of pyuvdata's baselines r_j - r_i: V = sum of T exp(+2 pi i (nu / c) (n - s) . (r_j - r_i)), with the
        centre s. ``nsample_array`` times ``integration_time`` is proportional to the weights (inverse variances), the largest
        ``nsample`` is 1. UVH5 holds one position an antenna; the true ones, and the weights, are in the file's group ``lunarray``:
        ``UVData.phase`` needs ``use_ant_pos=False``. Replaces a UVH5 file, and nothing else. Needs h5py and pyuvdata
        (``pip install lunarray[uvh5]``).
        """
        from ._uvh5 import write_uvh5

        return write_uvh5(self, path, channel, phase_centre)

    def write_uvfits(
        self, path: str | PathLike[str], channel: int = 0, phase_centre: tuple[float, float] = (266.405, -28.936)
    ) -> int:
        """Writes the good visibilities of a channel as UVFITS; returns their number.

        Values, baselines and samples are those of :meth:`write_uvh5`; what that has in its group is in the extension LUNARRAY, of which
        :func:`from_uvdata` takes positions and weights. Replaces a FITS file, and nothing else. Needs pyuvdata
        (``pip install lunarray[uvh5]``).
        """
        from ._uvfits import write_uvfits

        return write_uvfits(self, path, channel, phase_centre)

    def write_ms(
        self, path: str | PathLike[str], channel: int = 0, phase_centre: tuple[float, float] = (266.405, -28.936)
    ) -> int:
        """Writes the good visibilities of a channel as a measurement set (version 2), a new folder; returns their number.

        As :meth:`write_uvfits`, with a subtable LUNARRAY. Measurement sets of pyuvdata have no Stokes I: XX and YY are both it, by
        I = (XX + YY) / 2 (``pol_convention = "avg"``). Needs pyuvdata (``pip install lunarray[uvh5]``) and python-casacore.
        """
        from ._uvfits import write_ms

        return write_ms(self, path, channel, phase_centre)

    def write_calh5(self, path: str | PathLike[str], solutions: str | PathLike[str]) -> int:
        """Writes gains of ``solutions.csv`` as calh5, which pyuvdata's ``UVCal`` reads; returns the number of solutions.

        The downlink is the one that was calibrated. Gains that are not good are flagged; stated deviations and states are in the
        file's group ``lunarray``. Needs h5py and pyuvdata (``pip install lunarray[uvh5]``).
        """
        from ._calh5 import write_calh5

        return write_calh5(self, path, solutions)

    def write_parquet(self, path: str | PathLike[str], channel: int = 0) -> int:
        """Writes the visibilities of a channel as Parquet, flagged ones too; returns their number.

        The columns are those of ``lunarray export visibilities``, numbers as they are in the downlink; their units and the
        description of the instrument are in the file's metadata. Replaces a Parquet file, and nothing else. Needs pyarrow (``pip install lunarray[parquet]``).
        """
        from ._parquet import write_parquet

        return write_parquet(self, path, channel)

    def inspect(self) -> dict[str, Any]:
        """What the file holds, and its defects: what ``lunarray inspect --json`` prints."""
        return json.loads(_native.inspect(self.path))
