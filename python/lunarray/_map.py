"""Maps."""

from __future__ import annotations

import json
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._values import numbers


def read_map(path: str | PathLike[str], frame: str | None = None) -> tuple[NDArray[np.float64], str]:
    """Reads a HEALPix map of temperatures (FITS) into K, RING order: ``(pixels, frame)`` with frame E (ecliptic), G (Galactic) or C
    (equatorial). ``frame`` is that of a file without COORDSYS, which is refused otherwise."""
    return _native.read_map(path, frame)


def sky_of(
    sky: Any, frame: str | None, frequency_hz: float | None = None
) -> tuple[NDArray[np.float64], str]:
    """Pixels and frame of a sky that is a file, a :class:`Map`, or an array of pixels; of a frequency, if one is given."""
    if isinstance(sky, Map):
        if frequency_hz is not None and not np.isclose(sky.frequency_hz, frequency_hz, rtol=1e-6, atol=0.0):
            found, wanted = sky.frequency_hz / 1e6, frequency_hz / 1e6
            raise _native.Error(f"the map is of {found:g} MHz: expected {wanted:g} MHz, the frequency of the visibilities")
        return sky.pixels, "E"
    if isinstance(sky, str) or hasattr(sky, "__fspath__"):
        return _native.read_map(sky, frame, frequency_hz)
    pixels = numbers(sky, "K", "the sky")
    if pixels.ndim != 1:
        raise _native.Error(f"the sky has shape {pixels.shape}: expected its pixels one after the other, in RING order")
    return pixels, frame or "E"


class Map:
    """A map of the sky, made from visibilities.

    ``pixels`` and ``noise`` (a map of noise alone) are K in HEALPix RING order, ecliptic coordinates. ``rho_l`` is the correlation
    with the true sky by degree where that is known, else None. ``diagnostics`` has the regularisation and how the solution
    converged, ``span_s`` first and last time of the data.

    Where R is from the data, ``sigma`` is the standard deviation of every pixel (K), ``mean_sigma`` that of the map's mean (K), and
    ``resolution_deg`` by pixel the root of the solid angle that the data tell apart; else they are None. ``samples`` are maps
    drawn from the posterior (sample, pixel), if they were asked for.
    """

    def __init__(
        self,
        *,
        channel: int,
        frequency_hz: float,
        number: int,
        is_final: bool,
        span_s: tuple[float, float],
        visibilities: int,
        nside: int,
        pixels: NDArray[np.float64],
        noise: NDArray[np.float64],
        diagnostics: str,
        rho_l: NDArray[np.float64] | None,
        errors: dict[str, Any] | None = None,
    ) -> None:
        self.channel = channel
        self.frequency_hz = frequency_hz
        self.number = number
        self.is_final = is_final
        self.span_s = span_s
        self.visibilities = visibilities
        self.nside = nside
        self.pixels = pixels
        self.noise = noise
        self.diagnostics: dict[str, Any] = json.loads(diagnostics)
        self.rho_l = rho_l
        known = errors or {}
        self.sigma: NDArray[np.float64] | None = known.get("sigma")
        self.mean_sigma: float | None = known.get("mean_sigma")
        self.resolution_deg: NDArray[np.float64] | None = known.get("resolution_deg")
        self.samples: NDArray[np.float64] = np.reshape(known.get("samples", []), (-1, pixels.size))

    def __repr__(self):
        what = "final map" if self.is_final else f"snapshot {self.number}"
        return (
            f"<lunarray.Map: {what} at {self.frequency_hz / 1e6:g} MHz, nside {self.nside}, {self.visibilities} visibilities>"
        )

    @property
    def epsilon(self) -> float | None:
        """Regularisation of R = epsilon W_max I; None where R is from the data."""
        return self.diagnostics.get("epsilon")

    @property
    def alm(self) -> NDArray[np.complex128]:
        """Harmonic coefficients of the pixels in healpy's order, K: up to the degree of a harmonic map, else 3 nside - 1."""
        l_max = self.diagnostics.get("l_max") or 3 * self.nside - 1
        return _native.analysis(self.pixels, min(l_max, 3 * self.nside - 1))

    def compare(
        self, truth: str | PathLike[str] | Map | ArrayLike, frame: str | None = None
    ) -> dict[str, Any]:
        """Compares with the true sky (a file, or pixels with their frame; ecliptic if not said): ``l``, ``rho``, ``snr``, spectra and
        errors, as ``lunarray compare --json`` prints them. Sets ``rho_l``."""
        pixels, letter = sky_of(truth, frame)
        found = json.loads(_native.compare(self.pixels, pixels, letter, self.noise))
        for name, values in found.items():
            if isinstance(values, list):
                # Null is not a number.
                found[name] = np.array(values, dtype=float) if name != "l" else np.array(values)
        self.rho_l = found["rho"]
        return found
