"""How far a run is: a line in terminals, a text in notebooks."""

from __future__ import annotations

import shutil
import sys
import time
from typing import Any, Callable, Optional, Union

#: What a user gives: a function, True or False, or None for what suits.
Progress = Union[Callable[[dict], object], bool, None]

#: Between two texts, s.
EVERY_S = 0.2


def is_notebook() -> bool:
    """Whether this runs in a kernel of Jupyter."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")


def text_of(stages: dict[str, tuple[int, str]], windows: tuple[int, int], since_s: float) -> str:
    """What is shown: time, windows, and what every stage has done."""
    done, total = windows
    parts = [f"{since_s:.0f} s"]
    if total > 0:
        parts.append(f"{min(done, total)}/{total} windows")
    parts += [f"{name} {count:,} {unit}" for name, (count, unit) in stages.items() if count > 0 and unit]
    return ", ".join(parts)


class Shown:
    """Progress that is shown: called with stages and windows, some times a second; ``close`` ends it."""

    def __init__(self, show: Callable[[str], None], end: Callable[[], None]) -> None:
        self._show, self._end = show, end
        self._since = time.monotonic()
        self._last = self._since

    def __call__(self, stages: dict[str, tuple[int, str]], windows: tuple[int, int]) -> None:
        now = time.monotonic()
        if now - self._last >= EVERY_S:
            self._last = now
            self._show(text_of(stages, windows, now - self._since))

    def close(self) -> None:
        """Takes a line away; a notebook keeps the last text."""
        self._end()


class Told:
    """Progress that a function is told."""

    def __init__(self, function: Callable[[dict], object]) -> None:
        self._function = function

    def __call__(self, stages: dict[str, tuple[int, str]], windows: tuple[int, int]) -> None:
        self._function(stages)

    def close(self) -> None:
        """Nothing is left to be done."""


def _line() -> Shown:
    stream = sys.stderr

    def write(text: str) -> None:
        stream.write(text)
        stream.flush()

    def show(text: str) -> None:
        # A line that wraps would not be overwritten.
        write(f"\r\x1b[K{text[: shutil.get_terminal_size().columns - 1]}")

    return Shown(show, lambda: write("\r\x1b[K"))


def _notebook() -> Shown:
    from IPython.display import display

    handles: list[Any] = []

    def show(text: str) -> None:
        output = {"text/plain": text}
        if handles:
            handles[0].update(output, raw=True)
        else:
            handles.append(display(output, raw=True, display_id=True))

    return Shown(show, lambda: None)


def progress_of(progress: Progress) -> Optional[Union[Shown, Told]]:
    """What shows or tells progress: the function if one is given; what suits a notebook or a terminal if nothing is said."""
    if callable(progress):
        return Told(progress)
    if progress is False:
        return None
    if is_notebook():
        return _notebook()
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    return _line() if is_terminal or progress is True else None
