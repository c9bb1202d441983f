"""Numbers as they are given: with their units converted, or refused; never taken for something else."""

from __future__ import annotations

import datetime
import operator
from typing import Any, Iterable

import numpy as np
from numpy.typing import NDArray

from ._native import Error, frequency_hz

#: From 1958-01-01, where the epochs of missions are counted from, to 1970-01-01, s.
FROM_1958_S = 4383 * 86_400

#: Units at the end of a setting's name, as astropy knows them; longer ones before those that they end with.
KEY_UNITS = {
    "_km_s": "km/s",
    "_m_s2": "m/s2",
    "_m_s": "m/s",
    "_k_sr": "K sr",
    "_hz": "Hz",
    "_ns": "ns",
    "_days": "d",
    "_s": "s",
    "_km": "km",
    "_m": "m",
    "_deg": "deg",
    "_rad": "rad",
    "_jy": "Jy",
    "_k": "K",
}


def numbers(values: Any, unit: str, what: str) -> NDArray[np.float64]:
    """Real numbers in ``unit``: quantities of astropy are converted; masks, complex numbers, texts, dates and truth values are refused."""
    if hasattr(values, "to_value"):
        return _plain(_converted(values, unit, what), unit, what)
    if isinstance(values, (list, tuple)) and any(hasattr(value, "to_value") for value in values):
        # numpy would strip the units off.
        return np.array([numbers(value, unit, what) for value in values])
    return _plain(values, unit, what)


def number(value: Any, unit: str, what: str) -> float:
    """One real number in ``unit``; see :func:`numbers`."""
    found = numbers(value, unit, what)
    if found.ndim != 0:
        raise Error(f"{what} has shape {found.shape}: expected one number, {unit}")
    return float(found)


def _converted(quantity: Any, unit: str, what: str) -> Any:
    if _is_time(quantity):
        raise Error(f"{what} is a time of astropy: expected {_expected(unit)}")
    try:
        return quantity.to_value(unit)
    except (TypeError, ValueError) as error:
        # Of astropy's errors that of units is a UnitTypeError or UnitConversionError, which are these two.
        raise Error(f"{what} in {getattr(quantity, 'unit', 'another unit')}: expected {_expected(unit)}") from error


def _expected(unit: str) -> str:
    return "plain numbers" if unit == "" else f"numbers of {unit}, or what astropy converts to it"


def _plain(values: Any, unit: str, what: str) -> NDArray[np.float64]:
    masked = getattr(values, "mask", None)
    if isinstance(values, np.ma.MaskedArray) or isinstance(masked, (bool, np.bool_, np.ndarray)):
        count = int(np.count_nonzero(masked))
        if count:
            raise Error(f"{what}: {count} values are masked: expected values for all, such as filled(..) gives")
        values = getattr(values, "unmasked", values)
        values = np.ma.getdata(values) if isinstance(values, np.ma.MaskedArray) else values
    try:
        found = np.asarray(values)
    except (TypeError, ValueError) as error:
        raise Error(f"{what}: expected {_expected(unit)}, an array of them: {error}") from error
    if found.dtype.kind == "m" and unit == "s":
        return found / np.timedelta64(1, "s")
    if found.dtype.kind == "O" and unit == "s" and all(isinstance(v, datetime.timedelta) for v in found.flat):
        return np.array([v.total_seconds() for v in found.flat], dtype=float).reshape(found.shape)
    if found.dtype.kind == "O" and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in found.flat):
        # Integers beyond 64 bits.
        found = found.astype(float)
    if found.dtype.kind not in "iuf":
        kinds = {"c": "complex numbers", "b": "truth values", "U": "text", "S": "bytes", "M": "dates", "m": "time differences"}
        found_kind = kinds.get(found.dtype.kind, f"of type {found.dtype}")
        raise Error(f"{what}: found {found_kind}; expected {_expected(unit)}")
    return np.ascontiguousarray(found, dtype=float).reshape(found.shape)


def seconds(t: Any, epoch_tai_s: float | None, what: str = "t") -> NDArray[np.float64]:
    """Seconds since the mission's epoch: numbers, quantities of time, ``timedelta64``; and astropy's ``Time`` where the epoch is known.

    A ``datetime64`` does not say whether it is UTC or TAI, 37 s apart, and is refused.
    """
    if _is_time(t):
        return _since(t, epoch_tai_s, what)
    if isinstance(t, (list, tuple)) and t and all(map(_is_time, t)):
        return np.array([_since(one, epoch_tai_s, what) for one in t])
    given = t if isinstance(t, (list, tuple)) else [t]
    if any(isinstance(v, datetime.date) or getattr(getattr(v, "dtype", None), "kind", "") == "M" for v in given):
        raise Error(
            f"{what} is a date that does not say whether it is UTC or TAI: expected astropy.time.Time(.., scale=\"utc\"), or seconds "
            "since the mission's epoch"
        )
    return numbers(t, "s", what)


def _is_time(value: Any) -> bool:
    """Whether it is an ``astropy.time.Time``, and no difference of two."""
    return any(c.__name__ == "Time" and c.__module__.startswith("astropy.") for c in type(value).__mro__)


def _since(time: Any, epoch_tai_s: float | None, what: str) -> NDArray[np.float64]:
    if epoch_tai_s is None:
        raise Error(f"{what} is a date, and these positions are given without an epoch: expected seconds of their times")
    if time.scale in ("local", "ut1"):
        raise Error(f"{what} is a time of scale {time.scale!r}, which the tables here do not tie to TAI: expected utc, tai, tt, tdb, tcb or tcg")
    tai = time.tai
    if np.any(getattr(tai, "mask", False)):
        raise Error(f"{what}: times are masked: expected values for all")
    # Of 1958-01-01 the Julian date is 2436204.5: two parts, so that nothing is lost but nanoseconds.
    days = (np.asarray(tai.jd1) - 2436204.5) + np.asarray(tai.jd2)
    whole = np.floor(days)
    rest = (np.asarray(tai.jd1) - 2436204.5 - whole) + np.asarray(tai.jd2)
    return np.asarray((whole * 86_400.0 - epoch_tai_s) + rest * 86_400.0, dtype=float)


def hertz(frequency: Any) -> float:
    """A frequency in Hz: a number of Hz, a text such as ``"3MHz"``, or a quantity of astropy."""
    return frequency_hz(frequency) if isinstance(frequency, str) else number(frequency, "Hz", "the frequency")


def pairs_of(pairs: Iterable[Iterable[int]], satellites: int) -> list[tuple[int, int]]:
    """Pairs of satellites, from 1, as indices from 0."""
    if isinstance(pairs, (str, bytes)):
        raise Error(f"pairs = {pairs!r}: expected pairs of numbers, such as [(1, 2)]")
    found = []
    for pair in pairs:
        try:
            i, j = (operator.index(number) for number in pair)
        except (TypeError, ValueError) as error:
            raise Error(f"pairs: found {pair!r}; expected two numbers of satellites, such as [(1, 2)]") from error
        if not (1 <= i <= satellites and 1 <= j <= satellites and i != j):
            raise Error(f"pair {i}-{j}: expected two of the array's {satellites} satellites, from 1")
        found.append((i - 1, j - 1))
    return found


def octets(data: Any) -> bytes:
    """Bytes of ``bytes``, ``bytearray``, ``memoryview`` or an array of octets. ``bytes(5)`` would be five zeros."""
    try:
        view = memoryview(data)
    except TypeError as error:
        raise TypeError(f"found {type(data).__name__}; expected bytes") from error
    if view.itemsize != 1 or view.format not in ("B", "b", "c"):
        raise TypeError(f"found {type(data).__name__} of elements {view.format!r}; expected bytes")
    return view.tobytes()


def key_unit(key: str) -> str:
    """The unit at the end of a setting's name, as astropy knows it; empty if it has none."""
    name = key.rsplit(".", 1)[-1]
    for end in ("_max", "_min"):
        name = name.removesuffix(end)
    return next((unit for end, unit in KEY_UNITS.items() if name.endswith(end)), "")
