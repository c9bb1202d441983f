"""What imports of visibilities refuse, and what they make good: satellites on circles, whose places are known at all times."""

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


def satellites(t_s, frequency_hz=30e6, numbers=(1, 2, 3), pols=(1,), **orbits):
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
        polarization_array=np.array(pols),
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
    axes = SkyCoord([1.7 + np.pi / 2, 1.7 + np.pi, 1.7], [0.0, np.pi / 2 - 0.5, 0.5], unit="rad").transform_to("barycentricmeanecliptic")
    axes = axes.cartesian.xyz.value.T
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
    # Pyuvdata's, to another centre: 2 wavelengths.
    phased = data.copy()
    phased.phase(lon=5.0, lat=0.1, cat_name="elsewhere", phase_frame="icrs", use_ant_pos=False)
    lunarray.from_uvdata(phased, tmp_path / "v", positions=(times_of(table_s), orbit(table_s)))
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


def test_a_visibility_that_is_there_twice_is_refused(tmp_path):
    t_s = 20.0 * np.arange(10)
    data = satellites(t_s, pols=(-5, -6))
    other = data.select(times=np.unique(data.time_array)[3:5], inplace=False)
    backwards = other.copy()
    backwards.conjugate_bls("ant2<ant1")
    # Another rounding of Julian dates.
    later = other.copy()
    later.time_array = later.time_array + 5e-10
    one, two = (data.select(polarizations=[pol], inplace=False) for pol in (-5, -6))
    for uv in ([data, data], [data, other], [data, backwards], [data, later], [one, two]):
        with pytest.raises(lunarray.Error, match=r"visibility of antennas 1 and 2 .* is there twice"):
            lunarray.from_uvdata(uv, tmp_path / "v", positions="uvw", pol_convention="sum")
    lunarray.from_uvdata(one + two, tmp_path / "v", positions="uvw", pol_convention="sum")


def test_half_of_an_intensity_is_flagged(tmp_path):
    data = satellites(20.0 * np.arange(10), pols=(-5, -6))
    data.nsample_array[0, 0, 0] = data.data_array[0, 0, 0] = 0
    rows = lunarray.from_uvdata(data, tmp_path / "v", positions="uvw", pol_convention="sum").visibilities(0)
    assert len(rows) == 29 and not rows["flag"].any()
    np.testing.assert_allclose(np.abs(rows["value_jy"]), 2, rtol=1e-6)
    # With positions it is there, flagged.
    table_s = np.arange(-600, 900, 60.0)
    rows = lunarray.from_uvdata(data, tmp_path / "v", positions=(times_of(table_s), orbit(table_s)), pol_convention="sum").visibilities(0)
    assert (len(rows), np.count_nonzero(rows["flag"])) == (30, 1)
    # One polarisation is taken as that of an unpolarised sky.
    data.select(polarizations=[-6])
    rows = lunarray.from_uvdata(data, tmp_path / "v", positions="uvw", pol_convention="sum").visibilities(0)
    np.testing.assert_allclose(np.abs(rows["value_jy"]), 2, rtol=1e-6)


@pytest.mark.parametrize("uvw", [0.0, np.nan])
def test_baselines_of_what_is_flagged_do_not_matter(tmp_path, uvw):
    t_s, table_s = 20.0 * np.arange(10), np.arange(-600, 900, 60.0)
    data = satellites(t_s)
    data.uvw_array[4], data.flag_array[4] = uvw, True
    made = lunarray.from_uvdata(data, tmp_path / "v", positions="uvw")
    assert len(made.visibilities(0)) == 29
    made = lunarray.from_uvdata(data, tmp_path / "w", positions=(times_of(table_s), orbit(table_s)))
    assert np.flatnonzero(made.visibilities(0)["flag"]).size == 1
    data.flag_array[:] = True
    with pytest.raises(lunarray.Error, match="not flagged: expected at least one"):
        lunarray.from_uvdata(data, tmp_path / "v", positions="uvw")


def test_measurement_sets_of_other_programs_are_taken_once_their_unit_is_said(tmp_path):
    from pyuvdata import UVData

    tables = pytest.importorskip("casacore.tables")
    satellites(20.0 * np.arange(10), pols=(-5, -6)).write_ms(str(tmp_path / "v.ms"))
    with tables.table(str(tmp_path / "v.ms"), readonly=False, ack=False) as table:
        table.removecolkeyword("DATA", "QuantumUnits")
        described = table.getcoldesc("DATA")
        described["name"] = "CORRECTED_DATA"
        table.addcols(described)
        table.putcol("CORRECTED_DATA", 3 * table.getcol("DATA"))
    with pytest.raises(lunarray.Error, match='data_column="CORRECTED_DATA".*, then data.vis_units = "Jy"'):
        lunarray.from_uvdata(tmp_path / "v.ms", tmp_path / "v", positions="uvw", pol_convention="avg")
    # As the message has it. An axis of frequency that falls has widths below zero.
    data = UVData.from_file(str(tmp_path / "v.ms"), data_column="CORRECTED_DATA", ignore_single_chan=False)
    data.vis_units = "Jy"
    data.channel_width = -data.channel_width
    made = lunarray.from_uvdata(data, tmp_path / "v", positions="uvw", pol_convention="avg")
    np.testing.assert_allclose(np.abs(made.visibilities(0)["value_jy"]), 3, rtol=1e-6)
    assert made.instrument["widths_hz"] == [8e3]


def test_arguments_that_change_nothing_are_refused(tmp_path):
    t_s = 20.0 * np.arange(10)
    made = lunarray.from_uvdata(satellites(t_s), tmp_path / "v", positions="uvw")
    made.write_uvh5(tmp_path / "own.uvh5", 0)
    lunarray.from_uvdata(tmp_path / "own.uvh5", tmp_path / "w")
    for name, value in {"conjugate": True, "noise_jy": 1.0, "pol_convention": "sum"}.items():
        with pytest.raises(lunarray.Error, match=f"{name}: a file of write_uvh5 says this itself"):
            lunarray.from_uvdata(tmp_path / "own.uvh5", tmp_path / "w", **{name: value})


def test_data_of_other_shapes_and_axes_are_refused(tmp_path):
    t_s = 20.0 * np.arange(10)
    data = satellites(t_s)
    for noise in ([1.0, 2.0, 3.0], [[1.0]]):
        with pytest.raises(lunarray.Error, match="noise_jy of shape"):
            lunarray.from_uvdata(data, tmp_path / "v", positions="uvw", noise_jy=noise)
    with pytest.raises(lunarray.Error, match="a UVData of metadata alone"):
        lunarray.from_uvdata(data.copy(metadata_only=True), tmp_path / "v", positions="uvw")
    # Antennas 1, 2, 3 and then 1, 2, 9: positions are of four.
    other = satellites(t_s + 400, numbers=(1, 2, 9))
    table_s = np.arange(-600, 1260, 60.0)
    places = orbit(table_s)
    with pytest.raises(lunarray.Error, match="positions of 3 antennas: expected those of 4"):
        lunarray.from_uvdata([data, other], tmp_path / "v", positions=(times_of(table_s), places))
    lunarray.from_uvdata([data, other], tmp_path / "v", positions=(times_of(table_s), places[:, [0, 1, 2, 2]]))
    data.phase_center_catalog[0].update(cat_frame="fk5", cat_epoch=2030.0)
    with pytest.raises(lunarray.Error, match="expected data phased to directions"):
        lunarray.from_uvdata(data, tmp_path / "v", positions="uvw")
    data.phase_center_catalog[0].update(cat_epoch=2000.0)
    lunarray.from_uvdata(data, tmp_path / "v", positions="uvw")


def test_uvw_of_antennas_on_the_moon_are_not_taken_as_they_are(tmp_path):
    from lunarsky import MoonLocation

    data = satellites(20.0 * np.arange(10))
    data.telescope.location = MoonLocation.from_selenodetic(170, 0, 0)
    with pytest.raises(lunarray.Error, match="a telescope is on the Moon; expected none"):
        lunarray.from_uvdata(data, tmp_path / "v", positions="uvw")


def test_dates_to_come_are_no_warning(tmp_path):
    data = satellites(86_400.0 * np.arange(10) + 5e8)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        lunarray.from_uvdata(data, tmp_path / "v", positions="uvw")


COLUMNS = ("tai_s", "dt_s", "i", "j", "x_i_m", "y_i_m", "z_i_m", "x_j_m", "y_j_m", "z_j_m", "re_k_sr", "im_k_sr", "flag")


def rows_of(t_s):
    """Rows of a table of the satellites, without noise."""
    places = orbit(t_s)
    return np.array(
        [[2.2e9 + t, 10, i + 1, j + 1, *place[i], *place[j], 1, 0, 0] for t, place in zip(t_s, places) for i, j in [(0, 1), (0, 2), (1, 2)]]
    )


def write_csv(path, rows, columns=COLUMNS, before="", text=""):
    lines = [",".join([*map(repr, map(float, row)), *([text] if text else [])]) for row in rows]
    path.write_text(before + "\n".join([",".join([*columns, *(["note"] if text else [])]), *lines]) + "\n", encoding="utf-8")


def test_rows_without_positions_are_left_out(tmp_path):
    rows = rows_of(20.0 * np.arange(10))
    rows[5, 4:10], rows[5, 12] = np.nan, 1
    rows[8, 4] = np.nan
    write_csv(tmp_path / "t.csv", rows)
    with pytest.warns(UserWarning, match="2 of 30 rows"):
        made = lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7)
    assert len(made.visibilities(0)) == 28 and np.isfinite(made.visibilities(0)["uvw_m"]).all()
    rows[:, 4] = np.nan
    write_csv(tmp_path / "t.csv", rows)
    with pytest.raises(lunarray.Error, match="expected at least one row with finite x_i_m"):
        lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7)


def test_tables_with_a_mark_or_text_are_read_and_kilometres_and_repetitions_refused(tmp_path):
    rows = rows_of(20.0 * np.arange(10))
    expected = None
    for words in ({}, {"before": "\ufeff"}, {"text": '"one, two"'}):
        write_csv(tmp_path / "t.csv", rows, **words)
        found = lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7).visibilities(0)
        expected = found if expected is None else expected
        np.testing.assert_array_equal(found, expected)
    write_csv(tmp_path / "t.csv", [*rows, rows[7]])
    with pytest.raises(lunarray.Error, match="antennas 1 and 3 .* is there twice"):
        lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7)
    rows[:, 4:10] /= 1e3
    write_csv(tmp_path / "t.csv", rows)
    with pytest.raises(lunarray.Error, match="1.838 km from the Moon's centre: expected metres"):
        lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7)


def test_values_in_two_units_agree_weights_are_positive_and_integrations_do_not_overlap(tmp_path):
    rows = rows_of(20.0 * np.arange(10))
    # 2 k nu^2 / c^2 at 10 MHz, Jy by K sr.
    jansky = 2 * 1.380649e-23 * (1e7 / 299792458) ** 2 / 1e-26
    columns = (*COLUMNS, "re_jy", "im_jy", "weight")
    table = np.concatenate([rows, rows[:, 10:12] * jansky, np.ones((len(rows), 1))], axis=1)

    def read():
        write_csv(tmp_path / "t.csv", table, columns)
        return lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7).visibilities(0)

    assert not read()["flag"].any()
    table[3, -1], table[4, -1], table[5, 10] = np.nan, -1, np.inf
    with pytest.warns(UserWarning, match="3 of 30 rows have no finite value or no positive weight, and are flagged"):
        assert np.count_nonzero(read()["flag"]) == 3
    table[3:6] = table[6]
    table[3:6, :4] = rows[3:6, :4]
    table[3:6, 4:10] = rows[3:6, 4:10]
    table[7, 13] *= 1.01
    with pytest.raises(lunarray.Error, match="row 8 with finite positions has 1.* K sr and 1.01.* K sr in Jy"):
        read()
    table[7, 13] /= 1.01
    table[:, 1] *= 1e3
    with pytest.raises(lunarray.Error, match="integrations of 4294 s begin every 20 s"):
        read()


def test_baselines_of_one_integration_belong_together_to_a_microsecond(tmp_path):
    """Alone, each pair's baseline would be that of antennas as far on both sides of the middle."""
    rows = rows_of(20.0 * np.arange(100))
    columns = ("time_s", "dt_s", "i", "j", "u_m", "v_m", "w_m", "re_k_sr", "im_k_sr")
    table = np.concatenate([rows[:, :4], rows[:, 4:7] - rows[:, 7:10], rows[:, 10:12]], axis=1)
    table[:, 0] += np.random.default_rng(0).uniform(-4e-7, 4e-7, len(table)) - 2.2e9
    write_csv(tmp_path / "t.csv", table, columns)
    made = lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7, epoch_tai_s=2.2e9)
    found = made.visibilities(0)
    found = found[np.lexsort((found["j"], found["i"], found["time_s"]))]
    np.testing.assert_allclose(found["uvw_m"], table[:, 4:7], atol=1e-3)
    with pytest.raises(lunarray.Error, match="moon_radius_m = 1.0 would change nothing"):
        lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7, epoch_tai_s=2.2e9, moon_radius_m=1.0)


def test_tables_of_parquet_with_text_or_superfluous_arguments_are_refused(tmp_path):
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    rows = rows_of(20.0 * np.arange(10))
    write_csv(tmp_path / "t.csv", rows)
    made = lunarray.from_table(tmp_path / "t.csv", tmp_path / "v", frequency_hz=1e7)
    made.write_parquet(tmp_path / "own", 0)
    lunarray.from_table(tmp_path / "own", tmp_path / "w")
    for name in ("frequency_hz", "width_hz", "epoch_tai_s", "moon_radius_m"):
        with pytest.raises(lunarray.Error, match=f"{name} = 1000000.0 would change nothing, as the file says it"):
            lunarray.from_table(tmp_path / "own", tmp_path / "w", **{name: 1e6})
    for k, text in [(2, "A1"), (12, "good")]:
        table = pa.table({name: rows[:, n] for n, name in enumerate(COLUMNS)}).set_column(k, COLUMNS[k], pa.array([text] * len(rows)))
        parquet.write_table(table, tmp_path / "text")
        with pytest.raises(lunarray.Error, match=f"the column {COLUMNS[k]} is of type string: expected numbers"):
            lunarray.from_table(tmp_path / "text", tmp_path / "w", frequency_hz=1e7)
