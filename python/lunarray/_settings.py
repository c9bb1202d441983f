"""Settings given as ``set=``: a dictionary by key, or texts as after ``--set``."""

from __future__ import annotations

import os
from typing import Any, Iterable, Mapping, Union

import numpy as np

from ._values import key_unit, numbers

#: A dictionary by key, or texts `key=value`.
Settings = Union[Mapping[str, Any], str, Iterable[str], None]


def toml(value: Any, key: str = "") -> str:
    """A value as TOML; quantities in the unit at the end of the key's name."""
    if hasattr(value, "to_value"):
        value = numbers(value, key_unit(key), key).tolist()
    if isinstance(value, (bool, np.bool_)):
        return "true" if value else "false"
    if isinstance(value, (int, np.integer)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{name} = {toml(part, name)}" for name, part in value.items()) + " }"
    if isinstance(value, np.ndarray):
        value = (numbers(value, "", key) if value.dtype.kind not in "iubUO" else value).tolist()
        return toml(value, key)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml(part, key) for part in value) + "]"
    if isinstance(value, (str, os.PathLike)):
        text = os.fsdecode(value)
        escapes = {'"': '\\"', "\\": "\\\\"}
        return '"' + "".join(escapes.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in text) + '"'
    raise TypeError(f"a setting is {value!r}; expected a number, text, truth value, list or dictionary")


def overrides(settings: Settings, **more: Any) -> list[str]:
    """The list of ``key=value`` of ``set=``, and of further keys that are not None."""
    if settings is None:
        found = []
    elif isinstance(settings, str):
        found = [settings]
    elif isinstance(settings, (bytes, bytearray)):
        raise TypeError(f"set = {settings!r}: expected a dictionary, or texts such as \"map.nside=8\"")
    elif isinstance(settings, Mapping):
        found = [f"{key}={toml(value, key)}" for key, value in settings.items()]
    else:
        found = [str(text) for text in settings]
    return found + [f"{key.replace('__', '.')}={toml(value, key)}" for key, value in more.items() if value is not None]
