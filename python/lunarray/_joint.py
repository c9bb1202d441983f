"""Maps of several channels together."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from os import PathLike
from typing import Any, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._chain import State
from ._settings import Settings, overrides
from ._values import hertz, numbers


@dataclass(frozen=True)
class JointMap:
    """A map at one frequency from all channels: ``pixels`` and their standard deviations ``sigma``, K, in HEALPix RING order, ecliptic
    coordinates; ``mean_sigma`` is that of the mean, K. ``agreement`` has the reduced chi-square of the channel's data with its own map
    and with this one, and the strain between both (None between channels); ``powers`` the rows, passes and reduced chi-square of
    total powers (None without)."""

    frequency_hz: float
    pixels: NDArray[np.float64]
    sigma: NDArray[np.float64]
    mean_sigma: float
    agreement: dict[str, float] | None
    powers: dict[str, float] | None


@dataclass(frozen=True)
class Joint:
    """Maps at all frequencies in increasing order, and the spectrum of every pixel at the resolution of the coarsest channel:
    ``T = T_0 (nu / reference_hz)^(index + curvature / 2 ln(nu / reference_hz))``, not a number where a map is negative; empty for one
    channel alone (``curvature`` for two). ``likeness`` is the correlation between channels by degree, ``converged`` whether the iteration
    reached ``map.residual_max``."""

    maps: list[JointMap]
    likeness: list[dict[str, float]]
    converged: bool
    iterations: int
    residual: float
    reference_hz: float
    index: NDArray[np.float64]
    index_sigma: NDArray[np.float64]
    curvature: NDArray[np.float64]
    curvature_sigma: NDArray[np.float64]


def joint(
    states: State | str | PathLike[str] | Sequence[State | str | PathLike[str]],
    at: Any = (),
    samples: int = 16,
    powers: bool = True,
    power_priors: Sequence[float] = (0.1, 0.01, 0.01),
    power_constant_k_sr: float | Iterable[float] = 0.0,
    map: str | PathLike[str] | None = None,
    set: Settings = None,
    scratch: str | PathLike[str] = ".",
) -> Joint:
    """Maps of all channels of one state or several together, as ``lunarray joint`` makes them; the states stay as they are.

    ``at`` are further frequencies between the channels (Hz, or text such as ``"6MHz"``), ``samples`` the posterior samples for the
    errors of means and spectra. Total powers take part if the states have any and ``powers``; gain, offset and slope of each are free in
    every pass of a daughter within the standard deviations ``power_priors`` (of the power). Sums that memory does not hold are kept in the
    folder ``scratch`` while the call lasts.
    """
    if isinstance(states, (State, str, PathLike)):
        states = [states]
    folders = [os.fspath(one.path if isinstance(one, State) else State(one).path) for one in states]
    if not 2 <= samples <= 1000:
        raise _native.Error(f"samples = {samples}: expected 2 to 1000")
    frequencies = [at] if isinstance(at, str) or np.ndim(at) == 0 else list(at)
    at_hz = [hertz(one) for one in frequencies]
    priors = numbers(power_priors, "", "power_priors").ravel().tolist()
    if len(priors) != 3 or not all(0 <= prior <= 10 for prior in priors):
        raise _native.Error(f"power_priors = {priors}: expected three values of 0 to 10, of gain, offset and slope")
    constant = numbers(power_constant_k_sr, "K sr", "power_constant_k_sr").ravel().tolist()
    chosen = (tuple(priors), constant) if powers else None
    text, arrays, spectra = _native.joint(folders, scratch, (map, overrides(set)), at_hz, samples, chosen)
    told = json.loads(text)
    maps = [JointMap(pixels=pixels, sigma=sigma, **one) for one, (pixels, sigma) in zip(told.pop("maps"), arrays)]
    none = np.empty(0)
    reference_hz, found = spectra or (maps[0].frequency_hz, dict.fromkeys(("index", "index_sigma", "curvature", "curvature_sigma"), none))
    return Joint(maps=maps, reference_hz=reference_hz, **found, **told)
