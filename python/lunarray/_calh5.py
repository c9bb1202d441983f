"""Gains as calh5, by pyuvdata.

``solutions.csv`` has the gains g_i of V'_ij = g_i conj(g_j) V_ij: pyuvdata's gain convention "divide". The phases of a solution are
against the reference daughter of its lines, clocks included.
"""

import csv
from contextlib import ExitStack

import numpy as np

from ._native import Error
from ._uvh5 import ECLIPTIC_TO_ICRS
from ._write import needed

#: Columns that are written beside the gains, with their units.
BESIDE = {
    "ln_amplitude_sigma": "standard deviation of the natural logarithm of the amplitude",
    "phase_sigma_deg": "standard deviation of the phase, deg",
    "phase_scatter_deg": "root mean square change of the phase within the interval, deg",
    "unexplained": "part of the daughter's signal that the solution leaves",
}


def read_solutions(path):
    """Lines of ``solutions.csv`` by solution (start and end, s), daughter and frequency; and these three in order."""
    with open(path, newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    missing = {"from_s", "until_s", "daughter", "frequency_hz", "phase_deg", "reference", *BESIDE} - set(rows[0] if rows else ())
    if missing:
        raise Error(f"{path}: no columns {sorted(missing)}: expected solutions.csv of `lunarray calibrate`, with solutions")
    lines = {}
    for row in rows:
        span = (float(row["from_s"]), float(row["until_s"]))
        lines[span, int(row["daughter"]), float(row["frequency_hz"])] = row
    spans, daughters, frequencies = (sorted({key[axis] for key in lines}) for axis in range(3))
    if len(lines) != len(spans) * len(daughters) * len(frequencies):
        raise Error(f"{path}: expected a line for each solution, daughter and channel")
    return lines, spans, daughters, frequencies


def to_uvcal(downlink, solutions):
    """Solutions as a ``pyuvdata.UVCal``, and their lines by daughter, channel and time."""
    from astropy.coordinates import EarthLocation
    from astropy.time import Time
    from astropy.utils import iers
    from pyuvdata import Telescope, UVCal

    lines, spans, daughters, frequencies = read_solutions(solutions)
    widths = dict(zip(downlink.channels_hz, downlink.instrument["widths_hz"], strict=True))
    if set(frequencies) != set(widths) or daughters != list(range(1, downlink.satellites + 1)):
        raise Error(f"{solutions}: expected the daughters and channels of {downlink.path}")
    table = [[[lines[span, n, hz] for span in spans] for hz in frequencies] for n in daughters]

    def values(name):
        return np.array([[[float(row[name]) for row in of] for of in channel] for channel in table])[..., np.newaxis]

    gains = values("amplitude") * np.exp(1j * np.radians(values("phase_deg")))
    flags = np.array([[[row["state"] != "good" for row in of] for of in channel] for channel in table])[..., np.newaxis]
    start = Time("1958-01-01", scale="tai")
    days = (downlink.instrument["epoch_tai_s"] + np.array(spans)) / 86400.0
    time_range = Time(start.jd1, start.jd2 + days, format="jd", scale="tai").utc.jd
    middle_s = 0.5 * (spans[0][0] + spans[0][1])
    places = downlink.ephemeris(middle_s) @ ECLIPTIC_TO_ICRS.T
    # Positions of antennas have no meaning for gains; without any they are all at the telescope's place.
    places = np.nan_to_num(places - places.mean(axis=0))
    references = {row["reference"] for of in lines.values() for row in [of]}
    offline = {"auto_download": False, "auto_max_age": None, "iers_degraded_accuracy": "ignore"}
    with ExitStack() as stack:
        for name, value in offline.items():
            stack.enter_context(iers.conf.set_temp(name, value))
        telescope = Telescope.new(
            name="lunarray",
            # calh5 has telescopes on the Earth: a place on its equator stands for the Moon's orbit.
            location=EarthLocation.from_geodetic(0.0, 0.0, 0.0),
            antenna_positions=places,
            antenna_names=[str(n) for n in daughters],
            antenna_numbers=np.array(daughters),
            instrument=downlink.instrument["name"] or "lunarray",
            mount_type="orbiting",
            feeds=["x"],
            x_orientation="east",
            update_from_known=False,
        )
        made = UVCal.new(
            cal_style="sky",
            gain_convention="divide",
            jones_array=np.array([-5]),
            telescope=telescope,
            update_telescope_from_known=False,
            time_range=time_range,
            freq_array=np.array(frequencies),
            channel_width=np.array([widths[hz] for hz in frequencies]),
            ant_array=np.array(daughters),
            # Where it is not the same in all solutions the file's group lunarray says which.
            ref_antenna_name=references.pop() if len(references) == 1 else "various",
            sky_catalog="the maps of lunarray calibrate",
            data={"gain_array": gains, "flag_array": flags, "quality_array": values("chi_square")},
            history="Made by lunarray, from solutions.csv.",
            astrometry_library="astropy",
        )
        made.check()
    return made, table


def write_calh5(downlink, path, solutions):
    """Writes a file; see ``Downlink.write_calh5``."""
    h5py = needed("h5py", "uvh5")
    made, table = to_uvcal(downlink, solutions)
    made.write_calh5(path, clobber=True, run_check=False)
    with h5py.File(path, "a") as file:
        beside = file.create_group("lunarray")
        beside.attrs["about"] = "By daughter, channel and solution, as the file's gains"
        for name, unit in BESIDE.items():
            beside[name] = np.array([[[float(row[name]) for row in of] for of in channel] for channel in table])
            beside[name].attrs["unit"] = unit
        for name in ("state", "reference"):
            beside[name] = [[[row[name] for row in of] for of in channel] for channel in table]
    return int(made.Ntimes)
