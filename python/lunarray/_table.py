"""Visibilities of CSV and Parquet files as a downlink; see ``from_table``."""

from __future__ import annotations

import csv
import json
import os
import warnings
from os import PathLike
from typing import Any

import numpy as np

from ._array import MOON_RADIUS_M
from ._baselines import of_baselines, with_baselines
from ._downlink import Downlink
from ._import import Instrument, Part, epoch_of, galactic_noise_k_sr, jansky_per_k_sr, write_downlink
from ._native import Error
from ._tracks import Track, require_above_ground
from ._values import hertz, number
from ._write import needed

POSITIONS = tuple(f"{axis}_{end}_m" for end in "ij" for axis in "xyz")
BASELINES = ("u_m", "v_m", "w_m")
NEEDED = ("dt_s", "i", "j")
OTHERS = ("tai_s", "time_s", "re_k_sr", "im_k_sr", "re_jy", "im_jy", "weight", "flag", "frequency_hz", *POSITIONS, *BASELINES)


def from_table(
    table: str | PathLike[str],
    out: str | PathLike[str],
    frequency_hz: float | str | None = None,
    width_hz: float | str | None = None,
    epoch_tai_s: float | None = None,
    moon_radius_m: float | None = None,
) -> Downlink:
    """Writes visibilities of a CSV or Parquet file as a downlink file ``out``, of which :func:`replay` makes maps.

    Columns are those of ``lunarray export visibilities`` and ``Downlink.write_parquet``, in any order; others are ignored: ``tai_s`` (or
    ``time_s`` and ``epoch_tai_s``), middle of the integration, and its length ``dt_s``; ``i`` and ``j``, antennas from 1, at most 64;
    ``x_i_m`` .. ``z_j_m``, m in Moon-centred ecliptic axes, or ``u_m``, ``v_m``, ``w_m``, r_i - r_j on these axes with nothing hidden by
    the Moon; ``re_k_sr`` and ``im_k_sr``, or ``re_jy`` and ``im_jy``, of V = sum of T exp(-2 pi i (nu / c) n . (r_i - r_j)). Optional:
    ``weight``, (K sr)^-2 (else that of a sky of 180 K (nu / 180 MHz)^-2.6), ``flag`` (0: good), ``frequency_hz`` (else the argument;
    Parquet of ``write_parquet`` says it). Rows whose positions are not finite are left out, with a warning.

    ``width_hz`` is that of channels, 8 kHz if nothing says another, ``moon_radius_m`` by default 1,737,100. What the file says itself is
    no argument. Parquet needs pyarrow (``pip install lunarray[parquet]``).
    """
    path = os.fspath(table)
    columns, about = _columns(path)
    said = {"frequency_hz": frequency_hz, "width_hz": width_hz, "epoch_tai_s": epoch_tai_s, "moon_radius_m": moon_radius_m}
    _require_unsaid(path, columns, about, said)
    missing = [name for name in NEEDED if name not in columns]
    units = [unit for unit in ("k_sr", "jy") if {f"re_{unit}", f"im_{unit}"} <= set(columns)]
    if missing or not units:
        wanted = ", ".join(missing) or "re_k_sr and im_k_sr, or re_jy and im_jy"
        raise Error(f"{path}: found the columns {', '.join(sorted(columns))}; expected {wanted}, too")
    columns = _with_places(path, columns)
    count = len(columns["dt_s"])
    given = about.get("epoch_tai_s", None) if epoch_tai_s is None else number(epoch_tai_s, "s", "epoch_tai_s")
    given, time_s = _times(path, columns, given)
    each_hz = columns.get("frequency_hz")
    if each_hz is None:
        said = about.get("frequency_hz") if frequency_hz is None else hertz(frequency_hz)
        if said is None:
            raise Error(f"{path}: nothing says the frequency: expected frequency_hz = .., or a column of this name")
        each_hz = np.full(count, said)
    width = hertz(width_hz) if width_hz is not None else about.get("width_hz", 8e3)
    antennas = np.stack([columns["i"], columns["j"]])
    if (antennas != np.rint(antennas)).any() or antennas.min() < 1 or antennas.max() > 255:
        raise Error(f"{path}: antennas from {antennas.min():g} to {antennas.max():g}: expected whole numbers from 1")
    first, second = antennas.astype(int) - 1
    value = _values(path, columns, units, jansky_per_k_sr(each_hz))
    weight = columns["weight"] if "weight" in columns else galactic_noise_k_sr(each_hz, width, columns["dt_s"]) ** -2.0
    flagged = columns["flag"] != 0 if "flag" in columns else np.zeros(count, bool)
    bad = ~flagged & ~(np.isfinite(value) & np.isfinite(weight) & (weight > 0))
    if bad.any():
        warnings.warn(f"{path}: {bad.sum()} of {count} rows have no finite value or no positive weight, and are flagged", stacklevel=2)
    baseline_m = -np.stack([columns[name] for name in BASELINES], axis=1) if set(BASELINES) <= set(columns) else None
    parts = []
    for channel_hz in np.unique(each_hz):
        rows = each_hz == channel_hz
        tables = (value[rows, None], weight[rows, None], flagged[rows, None], None if baseline_m is None else baseline_m[rows])
        times = (given, time_s[rows], columns["dt_s"][rows])
        parts.append(Part(np.array([channel_hz]), np.array([width]), first[rows], second[rows], *times, *tables))
    size = max(int(antennas.max()), int(about.get("satellites", 0)))
    if set(POSITIONS) <= set(columns):
        radius_m = about.get("moon_radius_m", MOON_RADIUS_M) if moon_radius_m is None else number(moon_radius_m, "m", "moon_radius_m")
        places = np.stack([columns[name] for name in POSITIONS], axis=1)
        places = places.reshape(-1, 2, 3).swapaxes(0, 1).reshape(-1, 3)
        require_above_ground(places, radius_m)
        track = Track(np.tile(time_s, 2), np.concatenate([first, second]), places, size)
    else:
        parts = with_baselines(parts)
        track, radius_m = of_baselines(parts, size)
    name = str(about.get("name", os.path.splitext(os.path.basename(path))[0]))
    instrument = Instrument(name, size, float(radius_m), str(about.get("antenna", "Isotropic")), bool(about.get("noiseless", False)))
    return write_downlink(out, instrument, parts, track)


def _require_unsaid(path, columns, about, arguments):
    """Refuses arguments that the file makes superfluous, or contradicts."""
    known = {*about, *columns}
    if {"tai_s", "time_s"} <= set(columns):
        known.add("epoch_tai_s")
    if not set(POSITIONS) <= set(columns):
        # Baselines alone: the Moon hides nothing.
        known.add("moon_radius_m")
    for name, value in arguments.items():
        if value is not None and name in known:
            raise Error(f"{path}: {name} = {value!r} would change nothing, as the file says it: expected no such argument")


def _with_places(path, columns):
    """The columns without rows that have no positions."""
    names = next((names for names in (POSITIONS, BASELINES) if set(names) <= set(columns)), None)
    if names is None:
        raise Error(f"{path}: expected positions in {', '.join(POSITIONS)}, or baselines in {', '.join(BASELINES)}")
    known = np.all([np.isfinite(columns[name]) for name in names], axis=0)
    if not known.any():
        raise Error(f"{path}: expected at least one row with finite {', '.join(names)}")
    if not known.all():
        lost = np.count_nonzero(~known)
        warnings.warn(f"{path}: {lost} of {len(known)} rows have no finite {', '.join(names)}, and are left out", stacklevel=3)
    return {name: column[known] for name, column in columns.items()}


def _values(path, columns, units, jansky_per_k_sr):
    """Visibilities, K sr; where they are in Jy, too, both have to agree."""
    found = {unit: columns[f"re_{unit}"] + 1j * columns[f"im_{unit}"] for unit in units}
    if "jy" in found:
        found["jy"] = found["jy"] / jansky_per_k_sr
    if len(found) == 2:
        value, other = found["k_sr"], found["jy"]
        # Single precision, and the constants of other programs.
        differs = np.abs(value - other) > 1e-4 * np.maximum(np.abs(value), np.abs(other))
        if differs.any():
            k = int(np.argmax(differs))
            raise Error(
                f"{path}: row {k + 1} with finite positions has {value[k]:.6g} K sr and {other[k]:.6g} K sr in Jy: expected equal visibilities "
                "in re_k_sr, im_k_sr and re_jy, im_jy, or one of the two pairs of columns"
            )
    return found[units[0]]


def _times(path, columns, epoch_tai_s):
    """The epoch, and middles of integrations after it, s."""
    if "time_s" in columns and (epoch_tai_s is not None or "tai_s" in columns):
        if epoch_tai_s is None:
            # To the microsecond to which the columns have it.
            epoch_tai_s = float(np.round(np.median(columns["tai_s"] - columns["time_s"]), 6))
        return epoch_tai_s, columns["time_s"]
    if "tai_s" not in columns:
        raise Error(f"{path}: expected a column tai_s (s since 1958-01-01, TAI), or time_s and the argument epoch_tai_s")
    epoch_tai_s = epoch_of((columns["tai_s"] - columns["dt_s"] / 2).min()) if epoch_tai_s is None else epoch_tai_s
    return epoch_tai_s, columns["tai_s"] - epoch_tai_s


def _columns(path):
    """Columns of numbers by name, and what the file says of itself."""
    try:
        with open(path, "rb") as file:
            magic = file.read(4)
    except OSError as error:
        raise Error(f"{path}: {error.strerror}") from error
    wanted = {*NEEDED, *OTHERS}
    if magic == b"PAR1":
        return _parquet(path, wanted)
    with open(path, newline="", encoding="utf-8-sig", errors="replace") as file:
        names = [name.strip() for name in next(csv.reader(file), [])]
    used = [k for k, name in enumerate(names) if name in wanted]
    if len(set(names)) != len(names) or not used:
        raise Error(f"{path}: its first line is {','.join(names)[:100]!r}: expected the names of columns, each once")
    try:
        numbers = np.loadtxt(path, delimiter=",", skiprows=1, usecols=used, ndmin=2, encoding="utf-8", quotechar='"')
    except ValueError as error:
        raise Error(f"{path}: {error}; expected numbers in every row") from error
    return {names[k]: np.ascontiguousarray(numbers[:, n]) for n, k in enumerate(used)}, {}


def _parquet(path, wanted):
    pa = needed("pyarrow", "parquet")
    parquet = needed("pyarrow.parquet", "parquet")
    try:
        file = parquet.ParquetFile(path)
        found = file.read(columns=[name for name in file.schema_arrow.names if name in wanted])
    except (pa.ArrowException, OSError) as error:
        raise Error(f"{path}: pyarrow cannot read it: {error}") from error
    columns: dict[str, Any] = {}
    for name in found.column_names:
        try:
            columns[name] = np.asarray(found[name].to_numpy(), float)
        except (TypeError, ValueError) as error:
            raise Error(f"{path}: the column {name} is of type {found[name].type}: expected numbers") from error
    said = {key.decode(): value.decode() for key, value in (file.schema_arrow.metadata or {}).items() if key.startswith(b"lunarray.")}
    about: dict[str, Any] = json.loads(said["lunarray.instrument"]) if "lunarray.instrument" in said else {}
    if "lunarray.frequency_hz" in said:
        about["frequency_hz"] = float(said["lunarray.frequency_hz"])
        about["width_hz"] = about["widths_hz"][int(said["lunarray.channel"])] if "widths_hz" in about else 8e3
    return columns, about
