"""Positions whose differences are given baselines."""

from dataclasses import replace

import numpy as np

from ._import import MISMATCH_WAVELENGTHS, SPEED_OF_LIGHT_M_S
from ._native import Error
from ._tracks import Track


def with_baselines(parts):
    """The parts without what is flagged in all channels or has no baseline, which need not be those of any positions, and with one time,
    of the format's half ticks, for integrations that are not a microsecond apart."""
    offsets_s = [part.epoch_tai_s - parts[0].epoch_tai_s for part in parts]
    times_s = np.unique(np.concatenate([part.time_s + offset_s for part, offset_s in zip(parts, offsets_s)]))
    firsts_s = times_s[np.diff(times_s, prepend=-np.inf) > 1e-6]
    found = []
    for part, offset_s in zip(parts, offsets_s):
        together_s = firsts_s[np.searchsorted(firsts_s, part.time_s + offset_s, side="right") - 1]
        part = replace(part, time_s=np.rint(together_s * 2e6) / 2e6 - offset_s)
        rows = part.good_pairs() & np.isfinite(part.baseline_m).all(axis=1)
        names = ("first", "second", "time_s", "duration_s", "value_k_sr", "weight", "flagged", "baseline_m")
        centre = None if part.centre is None else part.centre[rows]
        if rows.any():
            found.append(replace(part, **{name: getattr(part, name)[rows] for name in names}, centre=centre))
    if not found:
        raise Error("no visibility of two antennas with finite uvw that is not flagged: expected at least one")
    return found


def of_baselines(parts, antennas):
    """The track of positions whose differences are the baselines, about a place from which the Moon is small, and its radius."""
    time_s = np.concatenate([part.time_s + (part.epoch_tai_s - parts[0].epoch_tai_s) for part in parts])
    time_s = np.rint(time_s * 2e6) / 2e6
    first, second = (np.concatenate([getattr(part, name) for part in parts]) for name in ("first", "second"))
    baseline_m = np.concatenate([part.baseline_m for part in parts])
    order = np.lexsort((second, first, time_s))
    time_s, first, second, baseline_m = time_s[order], first[order], second[order], baseline_m[order]
    unique_s, starts = np.unique(time_s, return_index=True)
    patterns = {}
    for k, (low, high) in enumerate(zip(starts, [*starts[1:], len(time_s)])):
        patterns.setdefault((first[low:high].tobytes(), second[low:high].tobytes()), []).append((k, low, high))
    wavelength_m = SPEED_OF_LIGHT_M_S / max(part.frequency_hz.max() for part in parts)
    known = []
    for times in patterns.values():
        _, low, high = times[0]
        i, j = first[low:high], second[low:high]
        incidence = np.zeros((high - low, antennas))
        np.add.at(incidence, (np.arange(high - low), j), 1.0)
        np.add.at(incidence, (np.arange(high - low), i), -1.0)
        sides = np.concatenate([baseline_m[low:high] for _, low, high in times], axis=1)
        places = np.linalg.lstsq(incidence, sides, rcond=None)[0]
        open_m = np.abs(incidence @ places - sides).max()
        if open_m > MISMATCH_WAVELENGTHS * wavelength_m:
            raise Error(f"uvw at t = {unique_s[times[0][0]]} s do not close: they are {open_m:.3g} m from differences of any positions")
        present = np.unique([i, j])
        places = places.reshape(antennas, len(times), 3)[present].swapaxes(0, 1)
        known.append((np.repeat(unique_s[[k for k, *_ in times]], len(present)), np.tile(present, len(times)), places.reshape(-1, 3)))
    time_s, antenna, place_m = (np.concatenate(column) for column in zip(*known))
    # So far away that the Moon hides 6e-8 of the sky, and so large that it hides one region for both of a pair.
    radius_m = max(1e3, 2 * np.abs(place_m).max())
    place_m = place_m + np.array([min(2000 * radius_m, 9e8), 0.0, 0.0])
    return Track(time_s, antenna, place_m, antennas), radius_m
