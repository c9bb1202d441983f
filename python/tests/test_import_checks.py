"""What imports of visibilities refuse, and what they make good: satellites on circles, whose places are known at all times."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import EarthLocation, SkyCoord
from astropy.time import Time

import lunarray

pytestmark = pytest.mark.filterwarnings("ignore")
SPEED_OF_LIGHT = 299_792_458.0
START = Time(2462502.5, format="jd", scale="utc")
RADIUS_M, RATE = 1.838e6, 8.9e-4


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Sidereal times of dates beyond the table of the Earth's rotation; nothing is fetched."""
    from astropy.utils import iers

    for name, value in {"auto_download": False, "auto_max_age": None, "iers_degraded_accuracy": "ignore"}.items():
        monkeypatch.setattr(iers.conf, name, value)


def orbit(t_s, apart_m=5e4):
    """Three satellites in a low orbit, up to 2.2 times ``apart_m`` apart: shape (times, 3, 3), m."""
    phase = RATE * np.asarray(t_s, float)[..., None] + np.array([0, 1, 2.2]) * apart_m / RADIUS_M
    tilt = np.array([0.0, 0.002, -0.003])
    return RADIUS_M * np.stack([np.cos(phase), np.sin(phase) * np.cos(tilt), np.sin(phase) * np.sin(tilt)], axis=-1)


def times_of(t_s):
    return START + np.asarray(t_s) * units.s


def satellites(t_s, frequency_hz=30e6, numbers=(1, 2, 3), pols=("pI",), **orbits):
    """Visibilities of 1 Jy towards a phase centre, whose axes are astropy's."""
    from pyuvdata import Telescope, UVData

    numbers = np.array(numbers)
    telescope = Telescope.new(
        name="satellites",
        location=EarthLocation.from_geodetic(0, 0, 0),
        antenna_positions=orbit(0.0, **orbits) - orbit(0.0, **orbits).mean(axis=0),
        antenna_names=[str(number) for number in numbers],
        antenna_numbers=numbers,
        instrument="satellites",
        mount_type="orbiting",
        update_from_known=False,
    )
    first, second = np.array([0, 0, 1]), np.array([1, 2, 2])
    data = UVData.new(
        freq_array=np.array([frequency_hz]),
        polarization_array=list(pols),
        times=np.repeat(times_of(t_s).jd, 3),
        antpairs=np.tile(np.stack([numbers[first], numbers[second]], axis=1), (len(t_s), 1)),
        do_blt_outer=False,
        integration_time=10.0,
        channel_width=8e3,
        telescope=telescope,
        update_telescope_from_known=False,
        phase_center_catalog={
            0: {"cat_name": "c", "cat_type": "sidereal", "cat_lon": 1.7, "cat_lat": 0.5, "cat_frame": "icrs", "cat_epoch": 2000.0}
        },
        vis_units="Jy",
        empty=True,
        astrometry_library="astropy",
    )
    # East, north and centre.
    axes = SkyCoord([1.7 + np.pi / 2, 1.7 + np.pi, 1.7], [0.0, np.pi / 2 - 0.5, 0.5], unit="rad").barycentricmeanecliptic.cartesian.xyz.value.T
    places = orbit(t_s, **orbits)
    data.uvw_array = ((places[:, second] - places[:, first]) @ axes.T).reshape(-1, 3)
    data.data_array[:], data.nsample_array[:], data.flag_array[:] = 1.0, 1.0, False
    return data


def off_wavelengths(downlink, t_s, **orbits):
    """The largest difference of a baseline from that of the circles."""
    rows = downlink.visibilities(0)
    rows = rows[np.lexsort((rows["j"], rows["i"], rows["time_s"]))]
    places = orbit(t_s, **orbits)
    expected = np.stack([places[:, 0] - places[:, 1], places[:, 0] - places[:, 2], places[:, 1] - places[:, 2]], axis=1)
    return np.linalg.norm(rows["uvw_m"] - expected.reshape(-1, 3), axis=1).max() * downlink.channels_hz[0] / SPEED_OF_LIGHT


def test_positions_that_are_off_in_time_are_refused_and_a_small_turn_is_not(tmp_path):
    t_s, table_s = 20.0 * np.arange(400), np.arange(-1200, 9260, 60.0)
    data = satellites(t_s)
    with pytest.raises(lunarray.Error, match="wavelengths from that of the positions"):
        # Baselines turn by 8.9e-4 rad, 10 of 11,000 wavelengths.
        lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), orbit(table_s + 1.0)))
    # 2e-4 rad about the pole of the ecliptic, as aberration may do: 2 wavelengths, the same for all.
    c, s = np.cos(2e-4), np.sin(2e-4)
    turned = orbit(table_s) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), turned))
    # One row of 1,200, by half a wavelength.
    data.uvw_array[601] += [5.0, 0, 0]
    with pytest.raises(lunarray.Error, match=r"is 0\.5.* wavelengths from that of the positions"):
        lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), turned))


def test_positions_are_interpolated_from_a_table_or_said_to_be_too_far_apart(tmp_path):
    t_s = 20.0 * np.arange(100) + 7
    data = satellites(t_s)
    # Polynomials through eight positions are off by 2e-5 wavelengths of 240 s, and by 0.05 of 600 s.
    for step_s in (60, 120, 240):
        table_s = np.arange(-1200, 3200 + step_s, float(step_s))
        made = lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), orbit(table_s)))
        assert off_wavelengths(made, t_s) < 1e-3
    for step_s, metres in [(600, 0), (60, 1)]:
        table_s = np.arange(-1200, 3200 + step_s, float(step_s))
        places = orbit(table_s)
        places = np.round(places / metres) * metres if metres else places
        with pytest.raises(lunarray.Error, match="expected closer times"):
            lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), places))


def test_a_gap_of_positions_under_data_is_filled_or_refused(tmp_path):
    t_s, near = 20.0 * np.arange(60), {"apart_m": 50.0}
    data = satellites(t_s, 10e6, **near)
    table_s = np.concatenate([np.arange(-600, 400, 20.0), np.arange(800, 1900, 20.0)])
    made = lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), orbit(table_s, **near)))
    assert off_wavelengths(made, t_s, **near) < 1e-3
    table_s = np.concatenate([np.arange(-6000, 400, 20.0), np.arange(4000, 6000, 20.0)])
    with pytest.raises(lunarray.Error, match=r"positions every 3\d\d\d\.?\d* s"):
        lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), orbit(table_s, **near)))


def test_no_row_is_written_without_positions(tmp_path):
    from lunarray._import import Instrument, Part, write_downlink
    from lunarray._tracks import Track

    t_s, ones = 20.0 * np.arange(60), np.ones((60, 1))
    part = Part(np.array([1e7]), np.array([8e3]), np.zeros(60, int), np.ones(60, int), 2e9, t_s, 10 * ones[:, 0], ones + 0j, ones, ones < 0)
    known = np.concatenate([t_s[:20], t_s[40:]])
    with pytest.raises(lunarray.Error, match="no positions at t = 400.0 s"):
        write_downlink(tmp_path / "v", Instrument("gap", 2, 1_737_100.0), [part], Track.of_all(known, orbit(known)[:, :2]))
