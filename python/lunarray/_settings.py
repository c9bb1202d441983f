"""Settings given as ``set=``: a dictionary by key, or texts as after ``--set``."""

from __future__ import annotations

import os
from typing import Any, Iterable, Mapping, Union

import numpy as np

from . import _native

#: A dictionary by key, or texts `key=value`.
Settings = Union[Mapping[str, Any], str, Iterable[str], None]


def toml(value: Any) -> str:
    """A value as TOML."""
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(part)}" for key, part in value.items()) + " }"
    if isinstance(value, (list, tuple, np.ndarray)):
        return "[" + ", ".join(toml(part) for part in value) + "]"
    if isinstance(value, (str, os.PathLike)):
        text = os.fspath(value)
        escapes = {'"': '\\"', "\\": "\\\\"}
        return '"' + "".join(escapes.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in text) + '"'
    raise TypeError(f"a setting is {value!r}; expected a number, text, truth value, list or dictionary")


def overrides(settings: Settings, **more: Any) -> list[str]:
    """The list of ``key=value`` of ``set=``, and of further keys that are not None."""
    if settings is None:
        found = []
    elif isinstance(settings, str):
        found = [settings]
    elif isinstance(settings, Mapping):
        found = [f"{key}={toml(value)}" for key, value in settings.items()]
    else:
        found = [str(text) for text in settings]
    return found + [f"{key.replace('__', '.')}={toml(value)}" for key, value in more.items() if value is not None]


def hertz(frequency: Any) -> float:
    """A frequency in Hz: a number of Hz, a text such as ``"3MHz"``, or a quantity of astropy."""
    if isinstance(frequency, str):
        return _native.frequency_hz(frequency)
    if hasattr(frequency, "to_value"):
        return float(frequency.to_value("Hz"))
    return float(frequency)
