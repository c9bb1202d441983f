"""The native module; `lunarray` is its face."""

from os import PathLike
from typing import Any, Callable, Final, Optional, Sequence, Union

import numpy as np
from numpy.typing import NDArray

_Path = Union[str, PathLike[str]]
_Floats = NDArray[np.float64]
# Called with stages, and with windows that are done and all of them.
_Progress = Callable[[dict[str, tuple[int, str]], tuple[int, int]], object]

VERSION: Final[str]

class Error(Exception): ...
class ConfigurationError(Error): ...

def run_command(words: Sequence[str]) -> int: ...
def frequency_hz(text: str) -> float: ...
def inspect(path: _Path) -> str: ...
def read_map(
    path: _Path, frame_if_missing: Optional[str] = None, frequency_hz: Optional[float] = None
) -> tuple[_Floats, str]: ...
def analysis(pixels: _Floats, l_max: int) -> NDArray[np.complex128]: ...
def compare(
    pixels: _Floats,
    truth: _Floats,
    truth_frame: str,
    noise: Optional[_Floats] = None,
    l_max: Optional[int] = None,
) -> str: ...
def predict(
    sky: _Floats,
    frame: str,
    frequency_hz: float,
    positions_m: _Floats,
    pairs: Sequence[tuple[int, int]],
    moon_radius_m: float,
    dipoles: bool,
) -> NDArray[np.complex128]: ...
def run(
    pipeline: Optional[_Path] = None,
    overrides: Sequence[str] = ...,
    seed: Optional[int] = None,
    out: Optional[_Path] = None,
    progress: Optional[_Progress] = None,
) -> tuple[str, list[dict[str, Any]], str]: ...
def solve_state(
    folder: _Path,
    map: Optional[_Path] = None,
    overrides: Sequence[str] = ...,
    epsilons: Sequence[float] = ...,
    samples: int = 0,
) -> list[dict[str, Any]]: ...
def joint(
    folders: Sequence[_Path],
    scratch: _Path,
    settings: tuple[Optional[_Path], Sequence[str]],
    at_hz: Sequence[float],
    samples: int,
    priors: Optional[tuple[tuple[float, float, float], Sequence[float]]],
) -> tuple[str, list[tuple[_Floats, _Floats]], Optional[tuple[float, dict[str, _Floats]]]]: ...

class NativeDownlink:
    def __init__(self, path: _Path) -> None: ...
    def instrument(self) -> str: ...
    def visibilities(self, channel: int) -> NDArray[np.uint8]: ...
    def autos(self) -> tuple[NDArray[np.uint8], _Floats]: ...
    def positions(self, times_s: _Floats) -> _Floats: ...

class NativeWriter:
    def __init__(self, path: _Path, description: str) -> None: ...
    def write(
        self,
        start_ticks: int,
        step_ticks: int,
        positions_m: _Floats,
        channel: NDArray[np.uint16],
        i: NDArray[np.uint8],
        j: NDArray[np.uint8],
        time_ticks: NDArray[np.int64],
        duration_ticks: NDArray[np.uint32],
        value_k_sr: NDArray[np.complex64],
        weight: NDArray[np.float32],
        flags: NDArray[np.uint8],
    ) -> None: ...
    def finish(self) -> None: ...

class NativeArray:
    def __init__(self, pipeline: Optional[_Path] = None, overrides: Sequence[str] = ...) -> None: ...
    @property
    def satellites(self) -> int: ...
    @property
    def epoch_tai_s(self) -> float: ...
    @property
    def moon_radius_m(self) -> float: ...
    @property
    def dipoles(self) -> bool: ...
    def positions(self, times_s: _Floats) -> _Floats: ...
    def earth(self, t_s: float) -> tuple[bool, list[float], Optional[list[float]]]: ...
    def integration_s(self, t_s: float, i: int, j: int, frequency_hz: float) -> float: ...

class NativeEphemeris:
    def __init__(self, times_s: _Floats, positions_m: _Floats, moon_radius_m: float) -> None: ...
    @property
    def satellites(self) -> int: ...
    def positions(self, times_s: _Floats) -> _Floats: ...

class NativeReplay:
    def __init__(
        self,
        files: Sequence[_Path],
        out: _Path,
        map: Optional[_Path] = None,
        overrides: Sequence[str] = ...,
        state: Optional[_Path] = None,
        progress: Optional[_Progress] = None,
    ) -> None: ...
    def next_map(self) -> Optional[dict[str, Any]]: ...
    def close(self) -> None: ...
    def summary(self) -> Optional[str]: ...

class NativeGround:
    def __init__(
        self, map: Optional[_Path] = None, overrides: Sequence[str] = ..., state: Optional[_Path] = None
    ) -> None: ...
    def feed(self, bytes: bytes) -> list[dict[str, Any]]: ...
    def finish(self) -> list[dict[str, Any]]: ...
    def ledger(self) -> str: ...
