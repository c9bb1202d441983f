"""Visibilities of pyuvdata as a downlink; see ``from_uvdata``."""

from __future__ import annotations

import os
import warnings
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ._array import MOON_RADIUS_M, Array
from ._baselines import of_baselines, with_baselines
from ._downlink import Downlink
from ._import import (
    SPEED_OF_LIGHT_M_S,
    Instrument,
    Part,
    epoch_of,
    galactic_noise_k_sr,
    noise_of,
    write_downlink,
)
from ._native import Error
from ._stokes import in_k_sr, total_intensity
from ._tracks import Track, between, require_above_ground
from ._uvh5 import ECLIPTIC_TO_ICRS, axes, offline
from ._values import numbers, seconds
from ._write import needed

#: Uncertainty of interpolated positions that is an error, wavelengths.
INTERPOLATION_WAVELENGTHS = 0.01


def from_uvdata(
    uv: Any,
    out: str | PathLike[str],
    positions: Array | str | tuple[Any, ArrayLike] | None = None,
    noise_jy: Any = None,
    pol_convention: str | None = None,
    conjugate: bool = False,
) -> Downlink:
    """Writes visibilities that other programs made as a downlink file ``out``, of which :func:`replay` makes maps.

    ``uv`` is a file that pyuvdata reads (UVH5, UVFITS, a measurement set), a ``UVData``, or a list of these, with one array. Values are in
    Jy or K str, by pyuvdata's convention V = sum of T exp(+2 pi i (nu / c) n . (r_2 - r_1)); ``conjugate`` for the opposite. The total
    intensity is taken, of XX and YY or RR and LL by ``pol_convention``: "sum" (I = XX + YY, as pyuvsim has it) or "avg"
    (I = (XX + YY) / 2), if the data do not say which; one of the two alone is taken as half of an unpolarised sky. Antennas, at most 64,
    are numbered in the order of theirs. Each visibility may be there once. Files of a list are in memory together.

    ``positions``: by default those of antennas on the Moon (needs lunarsky), or those in a file that ``Downlink.write_uvh5`` made. Of
    antennas that move: an :class:`Array` of a pipeline, or ``(t, xyz)``, ``t`` an ``astropy.time.Time`` and ``xyz`` of shape (times,
    antennas, 3), m in Moon-centred ecliptic axes, interpolated by eight samples; times too far apart for 0.01 wavelengths are refused.
    Data are then phased to a direction (ICRS), and their uvw have to be those of the positions to 0.1 wavelengths, beside one turn of all
    of a day by up to 3e-4 rad (aberration). ``"uvw"`` takes baselines of what is not flagged as they are, with nothing hidden by the Moon.

    Weights are ``nsample_array`` times the inverse variance of ``noise_jy``, the standard deviation of the real part of the total intensity
    for one sample (one number, or one by channel); if not given, that of antennas that see all of a sky of 180 K (nu / 180 MHz)^-2.6. What
    is flagged, or of which a polarisation has no samples, is flagged. Maps take antennas as isotropic. Needs pyuvdata, and h5py or
    python-casacore by the format (``pip install lunarray[moon]``).
    """
    needed("pyuvdata", "moon")
    given = uv if isinstance(uv, (list, tuple)) else [uv]
    if not given:
        raise Error("no data: expected files or UVData objects")
    with offline():
        return _made(given, out, positions, noise_jy, pol_convention, conjugate)


def _made(given, out, positions, noise_jy, pol_convention, conjugate):
    read = [_read(one) for one in given]
    own = [truth for _, truth in read]
    if positions is None and all(truth is not None for truth in own):
        from ._own import of_own

        said = {"conjugate": conjugate or None, "noise_jy": noise_jy, "pol_convention": pol_convention}
        if any(value is not None for value in said.values()):
            names = ", ".join(name for name, value in said.items() if value is not None)
            raise Error(f"{names}: a file of write_uvh5 says this itself: expected no such argument")
        parts, track, instrument = of_own([data for data, _ in read], own)
        return write_downlink(out, instrument, parts, track)
    data = [_conjugated(one) if conjugate else one for one, _ in read]
    wanted = np.unique(np.concatenate([np.concatenate([one.ant_1_array, one.ant_2_array]) for one in data]))
    on_moon = positions is None
    if isinstance(positions, str) and any(type(one.telescope.location).__name__ == "MoonLocation" for one in data):
        # Pyuvdata turns their uvw about w, by up to 5e-3 rad.
        raise Error(f"positions = {positions!r}: a telescope is on the Moon; expected none, for the positions of its antennas")
    if on_moon:
        from ._moon import unprojected

        data = [unprojected(one, k) for k, one in enumerate(data)]
    epochs = [epoch_of(_start_tai_s(one)) for one in data]
    parts = [_part(one, wanted, epoch, noise_jy, pol_convention, on_moon) for one, epoch in zip(data, epochs)]
    times_s = [part.time_s + (part.epoch_tai_s - epochs[0]) for part in parts]
    if on_moon:
        from ._moon import moon_track

        track, radius_m = moon_track(data, wanted, times_s)
    elif isinstance(positions, str):
        if positions != "uvw":
            raise Error(f'positions = {positions!r}: expected "uvw", an Array, or times and positions')
        parts = with_baselines(parts)
        track, radius_m = of_baselines(parts, len(wanted))
    else:
        all_antennas = np.unique(np.concatenate([np.asarray(one.telescope.antenna_numbers) for one in data]))
        highest_hz = max(part.frequency_hz.max() for part in parts)
        track, radius_m = _given(positions, np.unique(np.concatenate(times_s)), epochs[0], wanted, all_antennas, highest_hz)
    name = str(getattr(data[0].telescope, "name", "") or "imported")
    return write_downlink(out, Instrument(name, len(wanted), radius_m), parts, track)


def _read(uv):
    """A ``UVData``, and the truth beside it if the file is one of ``Downlink.write_uvh5``."""
    from pyuvdata import UVData

    if isinstance(uv, UVData):
        if uv.data_array is None or uv.flag_array is None or uv.nsample_array is None:
            raise Error("a UVData of metadata alone: expected one with visibilities, flags and samples")
        return uv, None
    path = os.fspath(uv)
    if not os.path.exists(path):
        raise Error(f"{path}: expected a file or folder that is there")
    with warnings.catch_warnings():
        # That uvw do not match one position an antenna: positions are compared with them below.
        warnings.simplefilter("ignore", UserWarning)
        try:
            data = UVData.from_file(path, ignore_single_chan=False)
        except (ValueError, OSError, KeyError) as error:
            raise Error(f"{path}: pyuvdata cannot read it: {error}") from error
    return data, _beside(path)


def _beside(path):
    """What a file of ``Downlink.write_uvh5``, ``write_uvfits`` or ``write_ms`` has beside the format; None if it is of another program."""
    from ._uvfits import ms_truth, uvfits_truth

    if os.path.isdir(path):
        return ms_truth(path)
    import h5py

    if not h5py.is_hdf5(path):
        with open(path, "rb") as file:
            return uvfits_truth(path) if file.read(9) == b"SIMPLE  =" else None
    with h5py.File(path) as file:
        if "lunarray" not in file:
            return None
        beside = file["lunarray"]
        truth = {name: beside[name][()] for name in ("position_1_m", "position_2_m", "time_s", "weight")}
        return {**truth, **beside.attrs}


def _start_tai_s(data):
    from astropy.time import Time

    first = np.argmin(data.time_array)
    time = Time(data.time_array[first], format="jd", scale="utc")
    return float(seconds(time, 0.0)) - 0.5 * float(np.max(data.integration_time))


def _part(data, wanted, epoch_tai_s, noise_jy, pol_convention, on_moon):
    from astropy.time import Time

    frequency_hz = np.asarray(data.freq_array, float)
    width_hz = np.broadcast_to(np.abs(np.asarray(data.channel_width, float)), frequency_hz.shape)
    values, flagged, samples = total_intensity(data, pol_convention)
    values = in_k_sr(values, data, frequency_hz)
    if not on_moon:
        _require_phased(data)
        values = values * np.exp(2j * np.pi * data.uvw_array[:, 2:3] * frequency_hz / SPEED_OF_LIGHT_M_S)
    duration_s = np.asarray(data.integration_time, float)
    noise = noise_of(noise_jy, frequency_hz)
    if noise is None:
        noise = galactic_noise_k_sr(frequency_hz, width_hz, duration_s[:, None])
    times = Time(data.time_array, format="jd", scale="utc")
    return Part(
        frequency_hz,
        width_hz,
        np.searchsorted(wanted, data.ant_1_array),
        np.searchsorted(wanted, data.ant_2_array),
        epoch_tai_s,
        seconds(times, epoch_tai_s),
        duration_s,
        values,
        samples / noise**2,
        flagged,
        None if on_moon else _baselines_m(data),
        np.asarray(data.phase_center_id_array),
    )


def _conjugated(data):
    found = data.copy()
    found.data_array = found.data_array.conj()
    return found


def _require_phased(data):
    used = set(np.unique(data.phase_center_id_array).tolist())
    for number in used:
        centre = data.phase_center_catalog[number]
        frame, epoch = centre["cat_frame"], centre.get("cat_epoch")
        if centre["cat_type"] != "sidereal" or not (frame == "icrs" or (frame == "fk5" and epoch in (None, 2000.0))):
            raise Error(
                f"phase centre {centre['cat_name']!r} is of type {centre['cat_type']!r} in the frame {frame!r} of {epoch}: expected "
                'data phased to directions, UVData.phase(.., phase_frame="icrs"), so that baselines have known axes'
            )


def _baselines_m(data):
    """r_2 - r_1 in ecliptic axes, of the axes of each row's phase centre."""
    found = np.empty((data.Nblts, 3))
    for number in np.unique(data.phase_center_id_array):
        centre = data.phase_center_catalog[number]
        degrees = np.degrees([centre["cat_lon"], centre["cat_lat"]])
        rows = data.phase_center_id_array == number
        found[rows] = data.uvw_array[rows] @ (axes(degrees) @ ECLIPTIC_TO_ICRS)
    return found


def _given(positions, unique_s, epoch_tai_s, wanted, all_antennas, highest_hz):
    """The track of positions that a caller gives, and the Moon's radius."""
    if isinstance(positions, Array):
        if positions.epoch_tai_s is None:
            raise Error("an array without an epoch: expected (t, xyz) with astropy.time.Time, or an array of a pipeline")
        places = positions.positions(unique_s + (epoch_tai_s - positions.epoch_tai_s))
        radius_m = positions.moon_radius_m
    else:
        places = _of_table(positions, unique_s, epoch_tai_s, highest_hz)
        radius_m = MOON_RADIUS_M
    count = places.shape[1]
    if count == len(all_antennas):
        places = places[:, np.searchsorted(all_antennas, wanted)]
    elif count != len(wanted):
        raise Error(
            f"positions of {count} antennas: expected those of {len(all_antennas)}, all of the data's telescope, or of {len(wanted)}, "
            "those with data"
        )
    require_above_ground(places, radius_m)
    return Track.of_all(unique_s, places), radius_m


def _of_table(positions, unique_s, epoch_tai_s, highest_hz):
    """Positions at times of data, s, by a pair (t, xyz)."""
    try:
        t, xyz = positions
    except (TypeError, ValueError) as error:
        raise Error(f'positions = {positions!r}: expected "uvw", an Array, or times and positions') from error
    times_s, places = seconds(t, epoch_tai_s, "times"), numbers(xyz, "m", "positions")
    fit = times_s.ndim == 1 and places.ndim == 3 and (len(places), places.shape[2]) == (len(times_s), 3) and len(times_s) > 0
    if not fit or (np.diff(times_s) <= 0).any():
        raise Error(
            f"times of shape {times_s.shape} and positions of shape {places.shape}: expected increasing times, and positions of shape "
            "(times, antennas, 3)"
        )
    if not times_s[0] <= unique_s[0] <= unique_s[-1] <= times_s[-1]:
        raise Error(
            f"data from t = {unique_s[0]} s to {unique_s[-1]} s, positions from {times_s[0]} s to {times_s[-1]} s: expected positions at "
            "all times of data"
        )
    found, unsure_m = between(times_s, places, unique_s)
    worst = np.argmax(unsure_m)
    unsure = unsure_m[worst] * highest_hz / SPEED_OF_LIGHT_M_S
    if unsure > INTERPOLATION_WAVELENGTHS:
        after = np.clip(np.searchsorted(times_s, unique_s[worst]), 1, len(times_s) - 1)
        raise Error(
            f"positions every {times_s[after] - times_s[after - 1]:.6g} s are too far apart, or rounded: interpolated at t = "
            f"{unique_s[worst]} s, baselines are uncertain by {unsure:.2g} wavelengths; expected closer times or more digits, for less "
            f"than {INTERPOLATION_WAVELENGTHS}"
        )
    return found
