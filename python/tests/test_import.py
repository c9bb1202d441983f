"""Visibilities that other programs made: values, directions and maps, by pyuvsim, lunarsky and healpy."""

import os
import subprocess
import sys
from pathlib import Path

import healpy
import mpi4py
import numpy as np
import pytest
import yaml
from astropy import units
from astropy.coordinates import EarthLocation, SkyCoord
from astropy.time import Time
from conftest import REPOSITORY, SMALL

import lunarray

pytestmark = pytest.mark.filterwarnings("ignore")
SPEED_OF_LIGHT = 299_792_458.0
FREQUENCY_HZ, SKY_NSIDE = 10e6, 16
JANSKY = 2 * 1.380649e-23 * (FREQUENCY_HZ / SPEED_OF_LIGHT) ** 2 * 1e26


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Sidereal times of dates beyond the table of the Earth's rotation; nothing is fetched."""
    from astropy.utils import iers

    for name, value in {"auto_download": False, "auto_max_age": None, "iers_degraded_accuracy": "ignore"}.items():
        monkeypatch.setattr(iers.conf, name, value)


@pytest.fixture(scope="module")
def sky():
    """A sky of degrees up to 8, K, in ICRS."""
    np.random.seed(3)
    pixels = healpy.synfast(1.0 / (1 + np.arange(9)) ** 2.5, SKY_NSIDE, lmax=8)
    return 2e5 * (3 + pixels / pixels.std())


def simulated(folder, catalogue, times, span_days):
    """pyuvsim's visibilities by ten stations within 300 m at 170 degrees east on the equator, in a process of its own (MPI)."""
    places = np.random.default_rng(1).uniform(-150, 150, (10, 2))
    lines = ["Name Number BeamID E N U", *(f"S{n} {n + 5} 0 {e} {h} 0" for n, (e, h) in enumerate(places))]
    (folder / "layout.csv").write_text("\n".join(lines) + "\n")
    beam = "beam_paths:\n    0: !AnalyticBeam\n        class: UniformBeam\n"
    (folder / "telescope.yaml").write_text(f"{beam}telescope_location: (0.0, 170.0, 0)\nworld: moon\ntelescope_name: far side\n")
    settings = {
        "filing": {"outdir": str(folder), "outfile_name": "far", "output_format": "uvh5"},
        "freq": {"freq_array": [FREQUENCY_HZ], "channel_width": 8e3},
        "sources": {"catalog": str(catalogue)},
        "telescope": {"array_layout": str(folder / "layout.csv"), "telescope_config_name": str(folder / "telescope.yaml")},
        "time": {"Ntimes": times, "start_time": 2462502.5, "end_time": 2462502.5 + span_days},
        "ordering": {"conjugation_convention": "ant1<ant2", "blt_order": ["time", "baseline"]},
        "select": {"ant_str": "cross"},
    }
    (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
    code = "import pyuvsim, sys; pyuvsim.run_uvsim(sys.argv[1])"
    # mpi4py looks for the library of the package mpich beside the interpreter, which may see other environments' packages.
    libmpi = Path(mpi4py.__file__).parents[3] / "libmpi.so.12"
    environment = {**os.environ, **({"MPI4PY_LIBMPI": str(libmpi)} if libmpi.exists() else {})}
    words = [sys.executable, "-W", "ignore", "-c", code, folder / "settings.yaml"]
    ran = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert (folder / "far.uvh5").exists(), ran.stderr
    return folder / "far.uvh5"


@pytest.fixture(scope="module")
def far(sky, tmp_path_factory):
    """UVH5 of a month of the sky."""
    from pyradiosky import SkyModel

    folder = tmp_path_factory.mktemp("far")
    model = SkyModel(
        component_type="healpix",
        nside=SKY_NSIDE,
        hpx_order="ring",
        frame="icrs",
        hpx_inds=np.arange(len(sky)),
        stokes=np.stack([sky, 0 * sky, 0 * sky, 0 * sky])[:, None, :] * units.K,
        spectral_type="full",
        freq_array=np.array([FREQUENCY_HZ]) * units.Hz,
    )
    model.write_skyh5(folder / "sky.skyh5")
    return simulated(folder, folder / "sky.skyh5", 160, 27.3)


def ecliptic(ra_deg, dec_deg):
    """Directions in ecliptic axes, by astropy."""
    found = SkyCoord(ra_deg, dec_deg, unit="deg", frame="icrs").transform_to("barycentricmeanecliptic")
    return found.cartesian.xyz.value.T


def sorted_rows(rows):
    return rows[np.lexsort((rows["j"], rows["i"], rows["time_s"]))]


def test_a_source_of_pyuvsim_is_at_its_direction(tmp_path):
    """V = S exp(-2 pi i (nu / c) n . (r_i - r_j)), and the zenith is lunarsky's."""
    from lunarsky import LunarTopo, MoonLocation
    from lunarsky import SkyCoord as LunarSkyCoord
    from lunarsky import Time as LunarTime

    place = MoonLocation.from_selenodetic(170.0, 0.0, 0.0)
    time = LunarTime(2462502.5, format="jd", scale="utc", location=place)
    zenith = LunarSkyCoord(alt=90 * units.deg, az=0 * units.deg, frame=LunarTopo(location=place, obstime=time)).icrs
    ra, dec = float(zenith.ra.deg) + 20, float(zenith.dec.deg) - 30
    header = "SOURCE_ID\tRA_ICRS [deg]\tDec_ICRS [deg]\tFlux [Jy]\tFrequency [Hz]\n"
    (tmp_path / "source.txt").write_text(f"{header}one\t{ra}\t{dec}\t1000\t{FREQUENCY_HZ}\n")
    path = simulated(tmp_path, tmp_path / "source.txt", 2, 0.01)
    found = lunarray.from_uvdata(path, tmp_path / "v.ccsds", pol_convention="sum")
    rows = found.visibilities(0)
    rows = rows[rows["time_s"] == rows["time_s"].min()]
    assert len(rows) == 45 and not rows["flag"].any()
    expected = 1000 / JANSKY * np.exp(-2j * np.pi * FREQUENCY_HZ / SPEED_OF_LIGHT * (rows["uvw_m"] @ ecliptic(ra, dec)))
    # Axes of the ecliptic of IAU 1976 and 2006 differ by 0.04 arcseconds: 2e-7 rad over 2 pi 14 wavelengths.
    np.testing.assert_allclose(rows["value_k_sr"], expected, rtol=2e-5)
    # The other sign, and the other order of antennas, are elsewhere.
    assert np.abs(rows["value_k_sr"] - expected.conj()).max() > 1000 / JANSKY
    np.testing.assert_allclose(rows["r_i_m"] / 1_737_100.0, np.tile(ecliptic(zenith.ra.deg, zenith.dec.deg), (45, 1)), atol=2e-4)
    assert (found.satellites, found.channels_hz.tolist()) == (10, [FREQUENCY_HZ])
    assert abs((rows["utc"][0] - np.datetime64("2030-01-01T00:00:00")) / np.timedelta64(1, "us")) < 50


def test_a_map_of_what_pyuvsim_saw_is_the_sky(far, sky, tmp_path):
    settings = {"map.nside": 8, "products.pictures": False}
    correlation = {}
    for conjugate in (False, True):
        lunarray.from_uvdata(far, tmp_path / "v.ccsds", pol_convention="sum", conjugate=conjugate)
        (made,) = lunarray.replay(tmp_path / "v.ccsds", set=settings, progress=False)
        alm = [healpy.map2alm(pixels, lmax=8, iter=5) for pixels in (sky, made.pixels)]
        alm[0] = healpy.Rotator(coord=["C", "E"]).rotate_alm(alm[0])
        cross = healpy.alm2cl(*alm)
        correlation[conjugate] = cross / np.sqrt(healpy.alm2cl(alm[0]) * healpy.alm2cl(alm[1]))
        if not conjugate:
            # The horizon cuts pixels of the simulated sky, which are a few per cent of it and change from time to time.
            assert abs(made.pixels.mean() / sky.mean() - 1) < 0.01
    assert correlation[False].min() > 0.98, correlation
    # The same data taken with the other sign.
    assert correlation[True].min() < 0.8, correlation


def test_phases_formats_and_signs_of_pyuvdata_come_to_the_same(far, tmp_path):
    """Phased to a direction by pyuvdata, as UVH5, UVFITS and a measurement set."""
    from pyuvdata import UVData

    data = UVData.from_file(far)
    data.select(times=np.unique(data.time_array)[:20])
    expected = sorted_rows(lunarray.from_uvdata(data, tmp_path / "v.ccsds", pol_convention="sum").visibilities(0))
    assert len(expected) == 20 * 45
    data.phase(lon=1.0, lat=-0.3, cat_name="elsewhere", phase_frame="icrs")
    data.write_uvh5(tmp_path / "v.uvh5")
    data.write_uvfits(tmp_path / "v.uvfits")
    data.write_ms(str(tmp_path / "v.ms"))
    other = data.copy()
    other.data_array = other.data_array.conj()
    backwards = data.copy()
    backwards.conjugate_bls("ant2<ant1")
    for uv, conjugate in [(data, False), ("v.uvh5", False), ("v.uvfits", False), ("v.ms", False), (other, True), (backwards, False)]:
        uv = tmp_path / uv if isinstance(uv, str) else uv
        found = sorted_rows(lunarray.from_uvdata(uv, tmp_path / "v.ccsds", pol_convention="sum", conjugate=conjugate).visibilities(0))
        for name in ("time_s", "i", "j", "dt_s"):
            np.testing.assert_array_equal(found[name], expected[name])
        np.testing.assert_allclose(found["weight"], expected["weight"], rtol=1e-6)
        # Measurement sets have single precision; 1e-8 m is the rounding of 1e6 m.
        scale = np.abs(expected["value_k_sr"]).max()
        np.testing.assert_allclose(found["value_k_sr"], expected["value_k_sr"], rtol=0, atol=1e-6 * scale)
        np.testing.assert_allclose(found["uvw_m"], expected["uvw_m"], atol=1e-8)


def test_weights_flags_and_units(far, tmp_path):
    from pyuvdata import UVData

    data = UVData.from_file(far)
    data.select(times=np.unique(data.time_array)[:3])
    data.nsample_array[:] = np.arange(1, data.Nblts + 1)[:, None, None]
    data.flag_array[7, 0, 1] = True
    data.data_array[9] = np.nan
    rows = lunarray.from_uvdata(data, tmp_path / "v.ccsds", pol_convention="sum", noise_jy=2e5).visibilities(0)
    order = np.lexsort((data.ant_2_array, data.ant_1_array, data.time_array))
    rows = sorted_rows(rows)
    assert np.flatnonzero(rows["flag"]).tolist() == sorted(np.flatnonzero((order == 7) | (order == 9)).tolist())
    good = rows["flag"] == 0
    np.testing.assert_allclose(rows["weight"][good], ((order + 1) * (JANSKY / 2e5) ** 2)[good], rtol=1e-6)
    jansky = (data.data_array[:, 0, 0] + data.data_array[:, 0, 1])[order]
    np.testing.assert_allclose(rows["value_jy"][good], jansky[good], rtol=1e-6)
    half = lunarray.from_uvdata(data, tmp_path / "v.ccsds", pol_convention="avg").visibilities(0)
    np.testing.assert_allclose(sorted_rows(half)["value_k_sr"][good], rows["value_k_sr"][good] / 2, rtol=1e-6)
    # The radiometer equation of 180 K (10 / 180)^-2.6 over the sphere, 8 kHz and the file's integration time.
    noise = 4 * np.pi * 180 * 18**2.6 / np.sqrt(2 * 8e3 * data.integration_time[0])
    np.testing.assert_allclose(sorted_rows(half)["weight"][good], ((order + 1) / noise**2)[good], rtol=1e-6)
    data.data_array *= 1 / JANSKY
    data.vis_units = "K str"
    kelvin = sorted_rows(lunarray.from_uvdata(data, tmp_path / "v.ccsds", pol_convention="sum").visibilities(0))
    np.testing.assert_allclose(kelvin["value_k_sr"][good], rows["value_k_sr"][good], rtol=1e-6)


def test_what_is_exported_comes_back_with_the_same_maps(small, tmp_path):
    downlink = lunarray.open(small.downlink)
    for channel in (0, 1):
        downlink.write_uvh5(tmp_path / f"{channel}.uvh5", channel)
    again = lunarray.from_uvdata([tmp_path / "1.uvh5", tmp_path / "0.uvh5"], tmp_path / "again.ccsds")
    assert {**again.instrument, "seed": 0} == {**downlink.instrument, "seed": 0}
    for channel in (0, 1):
        expected, found = (d.visibilities(channel) for d in (downlink, again))
        expected, found = sorted_rows(expected[expected["flag"] == 0]), sorted_rows(found)
        assert len(found) == len(expected) > 1000
        for name in ("time_s", "dt_s", "i", "j", "weight", "flag"):
            np.testing.assert_array_equal(found[name], expected[name])
        # Doubles of Jy and phases, rounded to singles again: the last digit of a small part of a large value.
        np.testing.assert_allclose(found["value_k_sr"], expected["value_k_sr"], rtol=1e-6)
        # Positions are fitted to 1e-5 wavelengths.
        np.testing.assert_allclose(found["uvw_m"], expected["uvw_m"], atol=2e-5 * SPEED_OF_LIGHT / 1e6)
    settings = {key: value for key, value in SMALL.items() if key.startswith(("map.", "products."))}
    maps = sorted(lunarray.replay(tmp_path / "again.ccsds", set=settings, progress=False), key=lambda found: found.channel)
    for found, expected in zip(maps, small.maps, strict=True):
        # Phases differ by up to 2 pi 2e-5.
        np.testing.assert_allclose(found.pixels, expected.pixels, atol=2e-4 * np.abs(expected.pixels).max())


def test_positions_beside_the_data_serve_formats_without(small, tmp_path):
    """UVFITS of satellites, with the array, with a table, and with uvw alone."""
    from pyuvdata import UVData

    downlink = lunarray.open(small.downlink)
    downlink.write_uvh5(tmp_path / "v.uvh5", 0)
    UVData.from_file(tmp_path / "v.uvh5", run_check=False).write_uvfits(tmp_path / "v.uvfits")
    expected = downlink.visibilities(0)
    expected = expected[expected["flag"] == 0]
    array = lunarray.Array(set={key: value for key, value in SMALL.items() if key.startswith("spacecraft")})
    first_s = expected["time_s"].min()
    t = np.arange(first_s - 300, first_s + 3000, 30.0)
    start = Time("1958-01-01", scale="tai") + (downlink.instrument["epoch_tai_s"] + t) * units.s
    early = UVData.from_file(tmp_path / "v.uvfits", run_check=False)
    early.select(times=np.unique(early.time_array[early.time_array < early.time_array.min() + 2600 / 86400]))
    table = start, array.positions(t)
    for uv, positions in [(tmp_path / "v.uvfits", array), (early, table), (tmp_path / "v.uvfits", "uvw")]:
        found = lunarray.from_uvdata(uv, tmp_path / "v.ccsds", positions=positions).visibilities(0)
        # Times come back to 40 us, the resolution of Julian dates, far less than what is between two of a pair.
        same = expected if uv is not early else expected[expected["time_s"] < first_s + 2600]
        same, rows = (v[np.lexsort((v["tai"], v["j"], v["i"]))] for v in (same, found))
        assert len(rows) == len(same) > 100
        np.testing.assert_array_equal(np.stack([rows["i"], rows["j"]]), np.stack([same["i"], same["j"]]))
        assert np.abs((rows["tai"] - same["tai"]) / np.timedelta64(1, "us")).max() < 50
        # Baselines turn by 1e-3 rad a second: 40 us of 100 km are 4 mm.
        np.testing.assert_allclose(rows["uvw_m"], same["uvw_m"], atol=0.01)
        np.testing.assert_allclose(rows["value_k_sr"], same["value_k_sr"], rtol=2e-6)
        if not isinstance(positions, str):
            # 1.6 km/s.
            np.testing.assert_allclose(rows["r_i_m"], same["r_i_m"], atol=0.1)
    with pytest.raises(lunarray.Error, match="its telescope is not on the Moon"):
        lunarray.from_uvdata(early, tmp_path / "v.ccsds")
    with pytest.raises(lunarray.Error, match="from that of the positions"):
        lunarray.from_uvdata(early, tmp_path / "v.ccsds", positions=(start, array.positions(t)[:, ::-1]))
    with pytest.raises(lunarray.Error, match="expected positions at all times of data"):
        lunarray.from_uvdata(tmp_path / "v.uvfits", tmp_path / "v.ccsds", positions=table)


def test_a_map_by_antennas_in_free_space_of_uvw_alone_is_the_sky(tmp_path):
    """numpy's sum over a sky of degrees up to 6, which the Moon hides nowhere."""
    from pyuvdata import Telescope, UVData

    rng = np.random.default_rng(2)
    np.random.seed(5)
    fine = healpy.synfast(np.full(7, 1e10), 32, lmax=6) + 1e6
    n = np.array(healpy.pix2vec(32, np.arange(len(fine))))
    times, antennas = 80, 5
    t = 900.0 * np.arange(times)[:, None, None]
    size, rate, phase = (rng.uniform(low, high, (antennas, 3)) for low, high in [(-60, 60), (1e-5, 4e-5), (0, 6)])
    places = size * np.cos(rate * t + phase)
    pairs = [(i, j) for i in range(antennas) for j in range(i + 1, antennas)]
    baseline = np.array([place[j] - place[i] for place in places for i, j in pairs])
    waves = 2j * np.pi * FREQUENCY_HZ / SPEED_OF_LIGHT
    ra, dec = np.radians(100.0), np.radians(30.0)
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    uvw = baseline @ np.stack([east, np.cross(centre, east), centre], axis=1)
    value = np.exp(waves * (baseline @ n)) @ fine * healpy.nside2pixarea(32) * np.exp(-waves * uvw[:, 2])
    telescope = Telescope.new(
        name="free",
        location=EarthLocation.from_geodetic(0, 0, 0),
        antenna_positions=places[0],
        antenna_names=[str(k) for k in range(antennas)],
        antenna_numbers=np.arange(antennas),
        instrument="free",
        mount_type="orbiting",
        update_from_known=False,
    )
    data = UVData.new(
        freq_array=np.array([FREQUENCY_HZ]),
        polarization_array=["pI"],
        times=np.repeat(2462502.5 + t.ravel() / 86400, len(pairs)),
        antpairs=np.tile(pairs, (times, 1)),
        do_blt_outer=False,
        integration_time=60.0,
        channel_width=8e3,
        telescope=telescope,
        update_telescope_from_known=False,
        data_array=value.reshape(-1, 1, 1),
        flag_array=np.zeros((len(value), 1, 1), bool),
        nsample_array=np.ones((len(value), 1, 1)),
        phase_center_catalog={
            0: {"cat_name": "c", "cat_type": "sidereal", "cat_lon": ra, "cat_lat": dec, "cat_frame": "icrs", "cat_epoch": 2000.0}
        },
        vis_units="K str",
        astrometry_library="astropy",
    )
    data.uvw_array = uvw
    lunarray.from_uvdata(data, tmp_path / "v.ccsds", positions="uvw")
    (made,) = lunarray.replay(tmp_path / "v.ccsds", set={"map.nside": 4, "products.pictures": False}, progress=False)
    alm = [healpy.map2alm(pixels, lmax=6, iter=5) for pixels in (fine, made.pixels)]
    alm[0] = healpy.Rotator(coord=["C", "E"]).rotate_alm(alm[0])
    correlation = healpy.alm2cl(*alm) / np.sqrt(healpy.alm2cl(alm[0]) * healpy.alm2cl(alm[1]))
    # Noise of 1 % of the sky is assumed, and there is none.
    assert correlation.min() > 0.99, correlation
    data.uvw_array = uvw + np.random.default_rng(1).normal(0, 20, uvw.shape)
    with pytest.raises(lunarray.Error, match="do not close"):
        lunarray.from_uvdata(data, tmp_path / "v.ccsds", positions="uvw")


@pytest.mark.parametrize("kind", ["csv", "parquet", "csv of uvw"])
def test_tables_that_are_exported_come_back(small, tmp_path, kind):
    downlink = lunarray.open(small.downlink)
    if kind == "parquet":
        downlink.write_parquet(tmp_path / "v", 1)
        found = lunarray.from_table(tmp_path / "v", tmp_path / "v.ccsds")
        assert {**found.instrument, "seed": 0} == {**downlink.instrument, "seed": 0, "channels_hz": [3e6], "widths_hz": [8e3]}
    else:
        words = ["export", "visibilities", small.downlink, "--channel", "1", "--out", tmp_path / "v"]
        assert subprocess.run([sys.executable, "-m", "lunarray", *map(str, words)], capture_output=True).returncode == 0
        if "uvw" in kind:
            lines = [line.split(",") for line in (tmp_path / "v").read_text().splitlines()]
            kept = [k for k, name in enumerate(lines[0]) if name[0] not in "xyz"]
            (tmp_path / "v").write_text("\n".join(",".join(line[k] for k in kept) for line in lines))
        found = lunarray.from_table(tmp_path / "v", tmp_path / "v.ccsds", frequency_hz="3MHz")
    expected, rows = sorted_rows(downlink.visibilities(1)), sorted_rows(found.visibilities(0))
    assert expected["flag"].any()
    if "uvw" in kind:
        # What is flagged has no baselines that count.
        expected = expected[expected["flag"] == 0]
    for name in ("time_s", "dt_s", "i", "j"):
        np.testing.assert_array_equal(rows[name], expected[name])
    good = expected["flag"] == 0
    np.testing.assert_array_equal(rows["flag"] == 0, good)
    for name in ("value_k_sr", "weight"):
        np.testing.assert_array_equal(rows[name][good], expected[name][good])
    # Positions are fitted to 1e-5 wavelengths.
    np.testing.assert_allclose(rows["uvw_m"], expected["uvw_m"], atol=2e-5 * SPEED_OF_LIGHT / 3e6)
    with pytest.raises(lunarray.Error, match="found the columns"):
        (tmp_path / "w").write_text("time_s,i,j\n1,1,2\n")
        lunarray.from_table(tmp_path / "w", tmp_path / "v.ccsds")


def test_what_cannot_be_taken_is_told(far, tmp_path):
    from pyuvdata import UVData

    data = UVData.from_file(far)
    data.select(times=np.unique(data.time_array)[:2])
    with pytest.raises(lunarray.Error, match="pol_convention = None, which the data do not say"):
        lunarray.from_uvdata(data, tmp_path / "v.ccsds")
    uncalibrated = data.copy()
    uncalibrated.vis_units = "uncalib"
    with pytest.raises(lunarray.Error, match='expected calibrated data, "Jy" or "K str"'):
        lunarray.from_uvdata(uncalibrated, tmp_path / "v.ccsds", pol_convention="sum")
    high = data.copy()
    high.freq_array = high.freq_array * 4
    with pytest.raises(lunarray.Error, match="frequency_hz"):
        lunarray.from_uvdata(high, tmp_path / "v.ccsds", pol_convention="sum")
    with pytest.raises(lunarray.Error, match="expected data phased to directions"):
        lunarray.from_uvdata(data, tmp_path / "v.ccsds", pol_convention="sum", positions=lunarray.Array())
    timeless = data.copy()
    timeless.integration_time = timeless.integration_time * np.nan
    with pytest.raises(lunarray.Error, match="expected finite numbers"):
        lunarray.from_uvdata(timeless, tmp_path / "v.ccsds", pol_convention="sum")
    moved = data.copy()
    moved.uvw_array = 1.1 * moved.uvw_array
    with pytest.raises(lunarray.Error, match="baselines of uvw and of antenna positions differ"):
        lunarray.from_uvdata(moved, tmp_path / "v.ccsds", pol_convention="sum")
    # Of what is flagged they do not matter.
    moved.flag_array[:] = True
    assert lunarray.from_uvdata(moved, tmp_path / "flagged.ccsds", pol_convention="sum").visibilities(0)["flag"].all()
    with pytest.raises(lunarray.Error, match="expected a file or folder that is there"):
        lunarray.from_uvdata(tmp_path / "none", tmp_path / "v.ccsds")
    with pytest.raises(lunarray.Error, match="pyuvdata cannot read it"):
        lunarray.from_uvdata(REPOSITORY / "README.md", tmp_path / "v.ccsds")
    assert not (tmp_path / "v.ccsds").exists()
    # A data set is no downlink to replace.
    before = far.read_bytes()
    with pytest.raises(lunarray.Error, match="is no downlink file"):
        lunarray.from_uvdata(far, far, pol_convention="sum")
    assert far.read_bytes() == before
