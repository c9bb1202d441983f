"""Antennas on the Moon, by lunarsky."""

import warnings

import numpy as np

from ._import import SPEED_OF_LIGHT_M_S
from ._native import Error
from ._tracks import Track
from ._uvh5 import ECLIPTIC_TO_ICRS
from ._write import needed


def unprojected(data, k):
    """A copy of the data without phases of a centre; baselines are those of the antennas, or it is an error."""
    if type(data.telescope.location).__name__ != "MoonLocation":
        raise Error(
            f"data set {k + 1}: its telescope is not on the Moon: expected positions = an Array, (t, xyz), or \"uvw\" for antennas that "
            "move"
        )
    needed("lunarsky", "moon")
    places = dict(zip(np.asarray(data.telescope.antenna_numbers).tolist(), data.telescope.antenna_positions))
    baseline_m = np.array([places[j] - places[i] for i, j in zip(data.ant_1_array, data.ant_2_array)])
    # Lengths do not depend on axes.
    off_m = np.abs(np.linalg.norm(baseline_m, axis=1) - np.linalg.norm(data.uvw_array, axis=1))
    off_m[data.flag_array.all(axis=(1, 2)) | ~np.isfinite(off_m)] = 0.0
    limit_m = 0.1 * SPEED_OF_LIGHT_M_S / np.max(data.freq_array)
    if off_m.max() > limit_m:
        raise Error(
            f"data set {k + 1}: baselines of uvw and of antenna positions differ by {off_m.max():.3g} m: expected less than "
            f"{limit_m:.3g} m, or positions for antennas that move"
        )
    if all(data.phase_center_catalog[n]["cat_type"] == "unprojected" for n in np.unique(data.phase_center_id_array)):
        return data
    found = data.copy()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found.unproject_phase()
    return found


def moon_track(data, wanted, times_s):
    """The track of antennas that stand on the Moon, and the distance of the highest from its centre, above whose flat horizon each sees
    the sky."""
    import lunarsky
    from astropy.coordinates import ICRS, CartesianRepresentation
    from astropy.time import Time

    fixed = {}
    for one in data:
        location = one.telescope.location
        centre = np.array([getattr(location, axis).to_value("m") for axis in "xyz"])
        for number, place in zip(np.asarray(one.telescope.antenna_numbers).tolist(), one.telescope.antenna_positions):
            if np.linalg.norm(fixed.setdefault(number, centre + place) - (centre + place)) > 1e-3:
                raise Error(f"antenna {number} stands at two places: expected data of one array")
    fixed_m = np.array([fixed[number] for number in wanted.tolist()])
    unique_s, at = np.unique(np.concatenate(times_s), return_index=True)
    times = Time(np.concatenate([one.time_array for one in data])[at], format="jd", scale="utc")
    # Each axis of the Moon in ICRS, at each time.
    ones, zeros = np.ones(len(at)), np.zeros(len(at))
    columns = [
        lunarsky.MCMF(CartesianRepresentation(x, y, z), obstime=times).transform_to(ICRS()).cartesian.xyz.value.T
        for x, y, z in ((ones, zeros, zeros), (zeros, ones, zeros), (zeros, zeros, ones))
    ]
    moon_to_ecliptic = ECLIPTIC_TO_ICRS.T @ np.stack(columns, axis=2)
    places = np.einsum("tab,nb->tna", moon_to_ecliptic, fixed_m)
    return Track.of_all(unique_s, places), float(np.linalg.norm(fixed_m, axis=1).max())
