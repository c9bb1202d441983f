"""Visibilities as UVH5, by pyuvdata.

pyuvdata's convention: baselines are r_j - r_i for the visibility <E_i conj(E_j)>, so that ours is
V = sum of T exp(+2 pi i (nu / c) n . (r_j - r_i)), with the same value. Data are phased to one direction s, by
exp(-2 pi i (nu / c) s . (r_j - r_i)); u points east, v north, w to s, in ICRS.
"""

import warnings
from contextlib import ExitStack, contextmanager

import numpy as np

from ._native import Error
from ._values import number
from ._write import needed, writing

#: Mean obliquity of the ecliptic at J2000, rad (IAU 1976, which HEALPix uses).
OBLIQUITY = np.radians(23.4392911)

SPEED_OF_LIGHT_M_S = 299_792_458.0

#: Rotation from ecliptic to equatorial axes, J2000. ICRS differs by 0.02 arcseconds.
ECLIPTIC_TO_ICRS = np.array(
    [
        [1.0, 0.0, 0.0],
        [0.0, np.cos(OBLIQUITY), -np.sin(OBLIQUITY)],
        [0.0, np.sin(OBLIQUITY), np.cos(OBLIQUITY)],
    ]
)


@contextmanager
def offline():
    """Nothing is fetched: what the Earth's rotation is predicted to be serves for sidereal times, which have no meaning here. Of dates
    beyond known leap seconds nothing is said."""
    from astropy.utils import iers

    with ExitStack() as stack:
        for name, value in {"auto_download": False, "auto_max_age": None, "iers_degraded_accuracy": "ignore"}.items():
            stack.enter_context(iers.conf.set_temp(name, value))
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", message='ERFA function .* yielded .*"dubious year')
        yield


def axes(phase_centre):
    """Directions of u (east), v (north) and w (the centre) in ICRS, rows of a matrix."""
    ra, dec = np.radians(phase_centre)
    east = [-np.sin(ra), np.cos(ra), 0.0]
    north = [-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)]
    centre = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    return np.array([east, north, centre])


def centre_of(phase_centre):
    """Right ascension and declination, degrees, of two numbers or angles."""
    try:
        ra, dec = phase_centre
    except (TypeError, ValueError) as error:
        raise Error(f"phase_centre = {phase_centre!r}: expected right ascension and declination, degrees") from error
    return number(ra, "deg", "the right ascension"), number(dec, "deg", "the declination")


def samples(rows):
    """The part of its integration time that would give each visibility its weight, if the best one had all its time.

    The format defines ``nsample_array`` times ``integration_time`` as the time that went into a visibility."""
    each = rows["weight"].astype(float) / rows["dt_s"]
    best = each.max()
    return (each / best if best > 0 else each).astype(np.float32)


def to_uvdata(downlink, channel, phase_centre, polarisations=("pI",)):
    """The good visibilities of a channel as a ``pyuvdata.UVData``, and the rows that they are, in order. Each polarisation is the
    total intensity: of an unpolarised sky XX and YY both are, by I = (XX + YY) / 2."""
    pyuvdata = needed("pyuvdata", "uvh5")
    from astropy.coordinates import EarthLocation
    from astropy.time import Time

    phase_centre = centre_of(phase_centre)
    ra_deg, dec_deg = phase_centre
    if not (-360 <= ra_deg <= 360 and -90 <= dec_deg <= 90):
        raise Error(f"phase_centre = {phase_centre}: expected right ascension and declination, degrees")
    rows = downlink.visibilities(channel)
    rows = rows[(rows["flag"] == 0) & np.isfinite(rows["uvw_m"][:, 0])]
    rows = rows[np.argsort(rows["time_s"], kind="stable")]
    if len(rows) == 0:
        raise Error(f"{downlink.path}: no good visibility of channel {channel} with positions")
    frequency_hz = downlink.channels_hz[channel]
    frame = axes(phase_centre) @ ECLIPTIC_TO_ICRS
    uvw = -(rows["uvw_m"] @ frame.T)
    data = rows["value_jy"] * np.exp(-2j * np.pi * frequency_hz / SPEED_OF_LIGHT_M_S * uvw[:, 2])
    # One position an antenna: that of the first time, about their middle.
    places = downlink.ephemeris(rows["time_s"][0]) @ ECLIPTIC_TO_ICRS.T
    places = places - places.mean(axis=0)
    numbers = np.arange(1, downlink.satellites + 1)
    from_1958_days = (downlink.instrument["epoch_tai_s"] + rows["time_s"]) / 86400.0
    start = Time("1958-01-01", scale="tai")
    times = Time(start.jd1, start.jd2 + from_1958_days, format="jd", scale="tai").utc.jd

    def of_each(values):
        return np.repeat(values.reshape(-1, 1, 1), len(polarisations), axis=2)

    with offline():
        telescope = pyuvdata.Telescope.new(
            name="lunarray",
            # UVH5 has telescopes on the Earth: a place on its equator stands for the Moon's orbit.
            location=EarthLocation.from_geodetic(0.0, 0.0, 0.0),
            antenna_positions=places,
            antenna_names=[str(number) for number in numbers],
            antenna_numbers=numbers,
            instrument=downlink.instrument["name"] or "lunarray",
            mount_type="orbiting",
            update_from_known=False,
        )
        ra, dec = np.radians(phase_centre)
        made = pyuvdata.UVData.new(
            freq_array=np.array([frequency_hz]),
            polarization_array=list(polarisations),
            times=times,
            antpairs=np.stack([rows["i"], rows["j"]], axis=1).astype(int),
            do_blt_outer=False,
            integration_time=rows["dt_s"].copy(),
            channel_width=np.array([downlink.instrument["widths_hz"][channel]]),
            telescope=telescope,
            update_telescope_from_known=False,
            data_array=of_each(data),
            flag_array=np.zeros((len(rows), 1, len(polarisations)), bool),
            nsample_array=of_each(samples(rows)),
            **({} if polarisations == ("pI",) else {"pol_convention": "avg"}),
            phase_center_catalog={
                0: {
                    "cat_name": "centre",
                    "cat_type": "sidereal",
                    "cat_lon": ra,
                    "cat_lat": dec,
                    "cat_frame": "icrs",
                    "cat_epoch": 2000.0,
                }
            },
            vis_units="Jy",
            history="Made by lunarray, from a downlink without calibration.",
            astrometry_library="astropy",
        )
        made.uvw_array = uvw
        made.check()
    return made, rows


def write_uvh5(downlink, path, channel, phase_centre):
    """Writes a file; see ``Downlink.write_uvh5``."""
    h5py = needed("h5py", "uvh5")
    with writing(path, downlink.path, b"\x89HDF", "UVH5") as unfinished:
        made, rows = to_uvdata(downlink, channel, phase_centre)
        made.write_uvh5(unfinished, run_check=False)
        add_truth(h5py, unfinished, rows, downlink.instrument)
    return len(rows)


#: What stands beside the visibilities.
TRUTH_ABOUT = (
    "In the order of the file's visibilities: positions of antennas 1 and 2, m, Moon-centred ecliptic axes; middle of each integration, s "
    "since the mission's epoch; inverse variance of the real part, (K sr)^-2"
)


def truth_of(rows, instrument):
    """Columns and attributes of what the formats have no place for."""
    names = {"position_1_m": "r_i_m", "position_2_m": "r_j_m", "time_s": "time_s", "weight": "weight"}
    attributes = {name: instrument[name] for name in ("name", "epoch_tai_s", "moon_radius_m", "antenna", "noiseless")}
    return {name: rows[field] for name, field in names.items()}, attributes


def add_truth(h5py, path, rows, instrument):
    """Adds what UVH5 has no place for."""
    columns, attributes = truth_of(rows, instrument)
    with h5py.File(path, "a") as file:
        beside = file.create_group("lunarray")
        beside.attrs["about"] = TRUTH_ABOUT
        for name, value in attributes.items():
            beside.attrs[name] = value
        for name, values in columns.items():
            beside[name] = values
