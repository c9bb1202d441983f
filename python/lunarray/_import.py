"""Visibilities that other programs made, written as a downlink, which the ground makes maps of."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np

from ._downlink import Downlink
from ._native import Error, NativeWriter
from ._tracks import Track, interpolated
from ._values import numbers
from ._write import writing

SPEED_OF_LIGHT_M_S = 299_792_458.0

#: Maximum number of antennas, and the longest integration that is told, s: those of the format. Maps take the middle.
ANTENNAS_MAX = 64
INTEGRATION_S_MAX = 4294.0

#: Disagreement of baselines with positions that is an error, wavelengths, after a turn of all of a phase centre in a day, rad: aberration
#: turns those that pyuvdata phases by up to 2e-4.
MISMATCH_WAVELENGTHS, TURN_RAD = 0.1, 3e-4

#: Misfit of the file's polynomials to positions at the times of data, wavelengths: 0.004 degrees of phase.
TOLERANCE_WAVELENGTHS = 1e-5

#: The flag of what was flagged: the format's bit of interference.
FLAGGED = 1


def jansky_per_k_sr(frequency_hz):
    """2 k nu^2 / c^2: from K sr to Jy, for both polarisations."""
    return 2 * 1.380649e-23 * (np.asarray(frequency_hz) / SPEED_OF_LIGHT_M_S) ** 2 * 1e26


def galactic_noise_k_sr(frequency_hz, width_hz, time_s):
    """Standard deviation of the real part of a visibility of antennas that see all of a sky of 180 K (nu / 180 MHz)^-2.6: the
    radiometer equation."""
    power_k_sr = 4 * np.pi * 180.0 * (frequency_hz / 180e6) ** -2.6
    return power_k_sr / np.sqrt(2 * width_hz * time_s)


@dataclass
class Part:
    """Visibilities of some channels at some times: arrays of a row an integration of a pair; values a column a channel.

    ``first`` and ``second`` are antennas, from 0, of the visibility <E_first conj(E_second)>. ``weight`` is the inverse variance of the
    real part, (K sr)^-2; ``baseline_m`` is r_second - r_first as the data have it, which positions have to meet, by the axes of the phase
    centre of number ``centre``."""

    frequency_hz: np.ndarray
    width_hz: np.ndarray
    first: np.ndarray
    second: np.ndarray
    epoch_tai_s: float
    time_s: np.ndarray
    duration_s: np.ndarray
    value_k_sr: np.ndarray
    weight: np.ndarray
    flagged: np.ndarray
    baseline_m: np.ndarray | None = None
    centre: np.ndarray | None = None

    def __post_init__(self):
        for name in ("frequency_hz", "width_hz", "epoch_tai_s", "time_s", "duration_s"):
            if not np.isfinite(getattr(self, name)).all():
                raise Error(f"{name}: found {getattr(self, name)}; expected finite numbers")
        self.flagged = self.flagged | ~np.isfinite(self.value_k_sr) | ~(self.weight > 0) | ~np.isfinite(self.weight)

    def good_pairs(self):
        """Rows of two antennas with a good channel."""
        return (self.first != self.second) & ~self.flagged.all(axis=1)


@dataclass
class Instrument:
    """What the file says of itself."""

    name: str
    antennas: int
    moon_radius_m: float
    antenna: str = "Isotropic"
    noiseless: bool = False


def write_downlink(path: str | PathLike[str], instrument: Instrument, parts: list[Part], track: Track) -> Downlink:
    """Writes the parts, with the positions of ``track`` (times from the epoch of the first part)."""
    if not 2 <= instrument.antennas <= ANTENNAS_MAX:
        raise Error(
            f"{instrument.antennas} antennas: expected 2 to {ANTENNAS_MAX}, the limit of the downlink's format; of a UVData object "
            "select(antenna_nums=..) leaves some"
        )
    epoch_tai_s = parts[0].epoch_tai_s
    channels = np.unique(np.concatenate([np.stack([p.frequency_hz, p.width_hz], axis=1) for p in parts]), axis=0)
    rows = _joined([_rows(part, channels, epoch_tai_s) for part in parts])
    if len(rows["time"]) == 0:
        raise Error("found no cross-correlation: expected visibilities of two antennas")
    tolerance_m = TOLERANCE_WAVELENGTHS * SPEED_OF_LIGHT_M_S / channels[:, 0].max()
    segments = list(track.segments(tolerance_m, rows["duration"].max() * 1e-6))
    starts = np.array([start for start, _, _ in segments])
    if (np.diff(starts) <= 0).any():
        raise Error("positions at times less than 2 us apart do not agree: expected those of one motion")
    # The ground takes the latest segment that begins before the middle.
    middle = rows["time"] + rows["duration"] // 2
    segment = np.searchsorted(starts, middle, side="right") - 1
    ends = np.array([start + step * (len(places) - 1) for start, step, places in segments])
    uncovered = (segment < 0) | (middle > ends[segment])
    if uncovered.any():
        raise Error(f"no positions at t = {middle[uncovered].min() * 1e-6} s: expected positions at all times of data")
    for part in parts:
        _require_baselines(part, part.time_s + (part.epoch_tai_s - epoch_tai_s), segments, starts)
    order = np.lexsort((rows["time"], rows["j"], rows["i"], rows["channel"], segment))
    rows = {name: np.ascontiguousarray(column[order]) for name, column in rows.items()}
    _require_once(rows, channels)
    edges = np.searchsorted(segment[order], np.arange(len(segments) + 1))
    description = json.dumps(
        {
            "name": instrument.name[:100],
            "epoch_tai_s": epoch_tai_s,
            "moon_radius_m": instrument.moon_radius_m,
            "satellites": instrument.antennas,
            "channels_hz": channels[:, 0].tolist(),
            "widths_hz": channels[:, 1].tolist(),
            "antenna": instrument.antenna,
            "noiseless": instrument.noiseless,
        }
    )
    columns = ("channel", "i", "j", "time", "duration", "value", "weight", "flag")
    with writing(path, "", b"\x09\x01", "downlink") as unfinished:
        writer = NativeWriter(unfinished, description)
        for (start, step, places), low, high in zip(segments, edges[:-1], edges[1:]):
            writer.write(start, step, places, *(rows[name][low:high] for name in columns))
        writer.finish()
    return Downlink(path)


def _require_once(rows, channels):
    """Requires that no visibility is there twice, and that integrations do not overlap, of rows in the order of the file."""
    same = np.all([np.diff(rows[name]) == 0 for name in ("channel", "i", "j")], axis=0)
    # In half ticks. Julian dates tell times to 40 us.
    middle = 2 * rows["time"] + rows["duration"]
    twice = np.flatnonzero(same & (np.diff(middle) < np.minimum(2000, rows["duration"][1:])))
    if len(twice):
        k = twice[0]
        raise Error(
            f"the visibility of antennas {rows['i'][k] + 1} and {rows['j'][k] + 1} (in the order of their numbers) at t = "
            f"{middle[k] * 5e-7} s and {channels[rows['channel'][k], 0]} Hz is there twice: expected each once; UVData.__add__ joins "
            "polarisations of two files in one object"
        )
    # Some may overlap; most do if times and integration times have different units.
    apart, long = np.diff(middle)[same], 2.0 * rows["duration"][1:][same]
    if len(apart) and np.median(long / apart) > 2:
        raise Error(
            f"integrations of {np.median(long) * 5e-7:g} s begin every {np.median(apart) * 5e-7:g} s: expected integrations of a pair that "
            "do not overlap, and integration times and times both in seconds"
        )


def _require_baselines(part, time_s, segments, starts):
    """Requires that baselines are those of the positions, but for one small turn of all of a phase centre in a day."""
    if part.baseline_m is None:
        return
    rows = np.flatnonzero(part.good_pairs() & np.isfinite(part.baseline_m).all(axis=1))
    if len(rows) == 0:
        return
    t_s, i, j, found_m = time_s[rows], part.first[rows], part.second[rows], part.baseline_m[rows]
    segment = np.searchsorted(starts, t_s * 1e6, side="right") - 1
    expected_m = np.empty((len(rows), 3))
    order = np.argsort(segment, kind="stable")
    for mine in np.split(order, np.flatnonzero(np.diff(segment[order])) + 1):
        one, at_s = segments[segment[mine[0]]], t_s[mine]
        expected_m[mine] = interpolated(one, at_s, j[mine]) - interpolated(one, at_s, i[mine])
    centre = np.zeros(len(rows)) if part.centre is None else part.centre[rows]
    off_m = _without_turns(found_m - expected_m, expected_m, np.stack([centre, np.floor(t_s / 86400)], axis=1))
    off = np.linalg.norm(off_m, axis=1) * part.frequency_hz.max() / SPEED_OF_LIGHT_M_S
    worst = np.argmax(off)
    if not off[worst] <= MISMATCH_WAVELENGTHS:
        raise Error(
            f"the baseline r_2 - r_1 of antennas {i[worst] + 1} and {j[worst] + 1} (in the order of their numbers) at t = {t_s[worst]} s "
            f"is {off[worst]:.3g} wavelengths from that of the positions, {np.linalg.norm(expected_m[worst]):.6g} m long, more than any "
            f"other: expected less than {MISMATCH_WAVELENGTHS}, or one turn of all by less than {TURN_RAD} rad; check times and axes of "
            "the positions"
        )


def _without_turns(off_m, baseline_m, groups):
    """Differences of baselines without the turn, if it is small, that explains most of them in each group of rows."""
    _, group = np.unique(groups, axis=0, return_inverse=True)
    group = group.ravel()
    e = baseline_m.T
    squares = np.array([[np.bincount(group, e[a] * e[b]) for a in range(3)] for b in range(3)]).transpose(2, 0, 1)
    matrix = np.trace(squares, axis1=1, axis2=2)[:, None, None] * np.eye(3) - squares
    side = np.stack([np.bincount(group, component) for component in np.cross(baseline_m, off_m).T], axis=1)
    turn = np.einsum("gab,gb->ga", np.linalg.pinv(matrix, rcond=1e-9, hermitian=True), side)
    turn[~(np.linalg.norm(turn, axis=1) <= TURN_RAD)] = 0.0
    return off_m - np.cross(turn[group], baseline_m)


def _rows(part, channels, epoch_tai_s):
    """Cross-correlations as the format holds them: a row a visibility, the lower antenna first."""
    cross = part.first != part.second
    first, second = part.first[cross], part.second[cross]
    duration_s = part.duration_s[cross]
    if not (duration_s > 0).all():
        raise Error(f"an integration of {duration_s.min()} s: expected positive times")
    count = len(part.frequency_hz)
    value = part.value_k_sr[cross].copy()
    swapped = first > second
    value[swapped] = value[swapped].conj()
    bad = part.flagged[cross]
    value[bad] = 0
    weight = np.where(bad, 1.0, part.weight[cross])
    # The middle, which decides, to half a tick.
    duration = np.rint(np.minimum(duration_s, INTEGRATION_S_MAX) * 1e6).astype(np.int64)
    middle = np.rint((part.time_s[cross] + (part.epoch_tai_s - epoch_tai_s)) * 2e6).astype(np.int64)
    duration += (middle - duration) % 2
    known = {tuple(channel): k for k, channel in enumerate(channels)}
    index = np.array([known[channel] for channel in zip(part.frequency_hz, part.width_hz)], dtype=np.uint16)
    return {
        "channel": np.tile(index, len(first)),
        "i": np.repeat(np.minimum(first, second).astype(np.uint8), count),
        "j": np.repeat(np.maximum(first, second).astype(np.uint8), count),
        "time": np.repeat((middle - duration) // 2, count),
        "duration": np.repeat(duration.astype(np.uint32), count),
        "value": value.astype(np.complex64).ravel(),
        "weight": weight.astype(np.float32).ravel(),
        "flag": np.where(bad, FLAGGED, 0).astype(np.uint8).ravel(),
    }


def _joined(tables):
    return {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}


def epoch_of(start_tai_s: float) -> float:
    """The epoch of data that have none: the last whole second before they begin."""
    if not math.isfinite(start_tai_s):
        raise Error(f"data begin at {start_tai_s}: expected finite numbers as times and integration times")
    return float(math.floor(start_tai_s))


def noise_of(noise_jy: Any, frequency_hz: np.ndarray) -> np.ndarray | None:
    """The stated standard deviation, K sr, by channel."""
    if noise_jy is None:
        return None
    found = numbers(noise_jy, "Jy", "noise_jy")
    if found.ndim > 1 or found.size not in (1, len(frequency_hz)):
        raise Error(f"noise_jy of shape {found.shape}: expected one number, or one for each of {len(frequency_hz)} channels")
    if not (found > 0).all():
        raise Error(f"noise_jy = {noise_jy}: expected positive Jy, one number or one for each channel")
    return found / jansky_per_k_sr(frequency_hz)
