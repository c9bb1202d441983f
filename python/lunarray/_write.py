"""Files that exports write: there whole or not at all, and never in place of something else."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import contextmanager
from importlib import import_module
from os import PathLike
from typing import Any, Iterator

from ._native import Error


def needed(module: str, extra: str) -> Any:
    """A package that an extra of this one brings along."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"{error}: pip install 'lunarray[{extra}]' brings {module.split('.')[0]}", name=module) from error


@contextmanager
def writing(path: str | PathLike[str], source: str | PathLike[str], magic: bytes, kind: str) -> Iterator[str]:
    """The name of a new file, which takes the name ``path`` once it is finished.

    What is at ``path`` may be a file of this kind, which begins with ``magic``, and no more: not a link, not the file that is
    exported, not anything else.
    """
    path = os.fsdecode(path)
    _require_free(path, source, magic, kind)
    folder, name = os.path.split(os.path.abspath(path))
    if not os.path.isdir(folder):
        raise Error(f"{path}: expected a file in a folder that is there; {folder} is none")
    with tempfile.TemporaryDirectory(prefix=f".{name}.", suffix=".partial", dir=folder) as beside:
        unfinished = os.path.join(beside, name)
        yield unfinished
        with open(unfinished, "rb") as file:
            os.fsync(file.fileno())
        # Whatever has come there meanwhile.
        _require_free(path, source, magic, kind)
        os.replace(unfinished, path)


def _require_free(path: str, source: str | PathLike[str], magic: bytes, kind: str) -> None:
    try:
        found = os.lstat(path)
    except FileNotFoundError:
        return
    if stat.S_ISLNK(found.st_mode):
        raise Error(f"{path} is a link, to {os.readlink(path)}: expected a new name, or a {kind} file to replace")
    if not stat.S_ISREG(found.st_mode):
        raise Error(f"{path} is no file: expected a new name, or a {kind} file to replace")
    if os.path.exists(source) and os.path.samestat(found, os.stat(source)):
        raise Error(f"{path} is the downlink that is exported: expected another name")
    with open(path, "rb") as file:
        if file.read(len(magic)) not in (magic, b""):
            raise Error(f"{path} is there and is no {kind} file: expected a new name, or a {kind} file to replace")
