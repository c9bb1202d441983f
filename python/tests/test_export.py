"""Exports, read by other people's software."""

import csv
import os
import shutil
import subprocess
import sys

import healpy
import numpy as np
import pytest
from conftest import SMALL

import lunarray

SPEED_OF_LIGHT, MOON_RADIUS_M = 299_792_458.0, 1_737_100.0


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    """A run without thermal noise and smearing of a sky that is a file."""
    folder = tmp_path_factory.mktemp("exact")
    pixels = 1e5 * (2 + np.random.default_rng(3).standard_normal(12 * 8**2))
    healpy.write_map(folder / "sky.fits", pixels, coord="E", dtype=np.float64, column_units="K", extra_header=[("FREQ", 3e6)])
    settings = {
        **{key: value for key, value in SMALL.items() if key != "sky.nside"},
        "sky.file": folder / "sky.fits",
        "spacecraft.channels_hz": [3e6],
        "spacecraft.thermal_noise": False,
        "spacecraft.smear_integrations": False,
        "spacecraft.model": "direct",
    }
    return pixels, lunarray.run(set=settings, out=folder / "out")


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Sidereal times of an epoch beyond the table of the Earth's rotation; nothing is fetched."""
    from astropy.utils import iers

    for name, value in {"auto_download": False, "auto_max_age": None, "iers_degraded_accuracy": "ignore"}.items():
        monkeypatch.setattr(iers.conf, name, value)


@pytest.mark.filterwarnings("ignore")
def test_uvh5_has_the_sign_frame_and_phase_of_pyuvdata(exact, tmp_path):
    """Exported phased to one centre and phased to another by pyuvdata, it is what is exported phased to that."""
    from pyuvdata import UVData

    _, run = exact
    first, second = (187.7, 12.4), (300.0, -40.0)
    downlink = lunarray.open(run.downlink)
    count = downlink.write_uvh5(tmp_path / "first.uvh5", 0, first)
    downlink.write_uvh5(tmp_path / "second.uvh5", 0, second)
    turned, expected = (UVData.from_file(tmp_path / f"{name}.uvh5") for name in ("first", "second"))
    assert turned.check() and turned.Nblts == count > 1000
    turned.phase(lon=np.radians(second[0]), lat=np.radians(second[1]), cat_name="second", phase_frame="icrs", use_ant_pos=False)
    # Aberration turns directions by up to 1e-4 rad, which pyuvdata applies and a telescope in space has no use for.
    longest = np.linalg.norm(expected.uvw_array, axis=1).max()
    np.testing.assert_allclose(turned.uvw_array, expected.uvw_array, atol=4e-4 * longest)
    most = 2 * np.pi * 3e6 / SPEED_OF_LIGHT * 4e-4 * longest
    assert most < 0.1
    phases = np.angle(turned.data_array / expected.data_array)
    assert np.abs(phases).max() < most
    # It would not have been so for another sign: phases differ by turns from one centre to the other.
    unturned = UVData.from_file(tmp_path / "first.uvh5", run_check=False)
    assert np.abs(np.angle(unturned.data_array / expected.data_array)).max() > 3


@pytest.mark.filterwarnings("ignore")
def test_a_sky_predicted_from_the_exported_baselines_is_what_was_exported(exact, tmp_path):
    """V = sum of T exp(+2 pi i (nu / c) (n - s) . b), b = r_2 - r_1, of directions that the Moon hides from neither."""
    import h5py
    from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord
    from pyuvdata import UVData

    pixels, run = exact
    lunarray.open(run.downlink).write_uvh5(tmp_path / "sky.uvh5", 0, (187.7, 12.4))
    data = UVData.from_file(tmp_path / "sky.uvh5", run_check=False)
    with h5py.File(tmp_path / "sky.uvh5") as file:
        places = [file["lunarray"][f"position_{n}_m"][:] for n in (1, 2)]
    # Directions of pixels in the exported frame, by astropy: ecliptic to ICRS, then east, north, towards the centre.
    lon, lat = healpy.pix2ang(8, np.arange(len(pixels)), lonlat=True)
    ecliptic = SkyCoord(lon, lat, unit="deg", frame=BarycentricMeanEcliptic(equinox="J2000"))
    n = ecliptic.icrs.cartesian.xyz.value.T
    ra, dec = np.radians(187.7), np.radians(12.4)
    centre = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    n = np.stack([n @ east, n @ np.cross(centre, east), n @ centre], axis=1)
    moonward = np.array(healpy.pix2vec(8, np.arange(len(pixels)))).T
    jansky = 2 * 1.380649e-23 * (3e6 / SPEED_OF_LIGHT) ** 2 * 1e26
    scale = np.abs(data.data_array).max()
    for k in range(0, data.Nblts, data.Nblts // 60):
        seen = np.ones(len(pixels), bool)
        for r in (places[0][k], places[1][k]):
            along = moonward @ r
            seen &= ~((along < 0) & (r @ r - along**2 < MOON_RADIUS_M**2))
        phase = np.exp(2j * np.pi * 3e6 / SPEED_OF_LIGHT * ((n - [0, 0, 1]) @ data.uvw_array[k]))
        expected = jansky * np.sum(pixels * seen * phase) * healpy.nside2pixarea(8)
        # The simulation evaluates fringes to 1e-6; a pixel at the Moon's limb may be seen in one and not in the other.
        limb = jansky * np.abs(pixels).max() * healpy.nside2pixarea(8)
        assert abs(data.data_array[k, 0, 0] - expected) < 1e-4 * scale + 0.01 * limb, k


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["uvfits", "ms"])
def test_uvfits_and_measurement_sets_have_the_visibilities_of_uvh5(exact, tmp_path, kind):
    """As pyuvdata reads them back, and as an import takes them: positions and weights are those of the downlink."""
    from pyuvdata import UVData

    if kind == "ms":
        pytest.importorskip("casacore")
    downlink = lunarray.open(exact[1].downlink)
    downlink.write_uvh5(tmp_path / "a.uvh5", 0)
    path = tmp_path / f"a.{kind}"
    count = getattr(downlink, f"write_{kind}")(path, 0)
    expected, found = (
        UVData.from_file(str(name), ignore_single_chan=False, run_check_acceptability=False) for name in (tmp_path / "a.uvh5", path)
    )
    assert found.Nblts == count == expected.Nblts > 1000
    assert (found.get_pols(), found.vis_units) == ((["xx", "yy"] if kind == "ms" else ["pI"]), "Jy")
    # UVFITS holds single precision of values, and seconds of light in uvw: 2^-24 of the largest.
    for values in (found.data_array[:, :, k] for k in range(found.Npols)):
        np.testing.assert_allclose(values, expected.data_array[:, :, 0], atol=1e-6 * np.abs(expected.data_array).max())
    np.testing.assert_allclose(found.uvw_array, expected.uvw_array, atol=1e-6 * np.abs(expected.uvw_array).max())
    again = lunarray.from_uvdata(path, tmp_path / "again.ccsds")
    before, after = (np.sort(v[v["flag"] == 0], order=["time_s", "i", "j"]) for v in (downlink.visibilities(0), again.visibilities(0)))
    for name in ("time_s", "dt_s", "i", "j"):
        np.testing.assert_array_equal(after[name], before[name])
    np.testing.assert_allclose(after["weight"], before["weight"], rtol=1e-6)
    # 1e-5 wavelengths of 100 m, the tolerance that imports state.
    np.testing.assert_allclose(after["r_i_m"], before["r_i_m"], atol=1.5e-3)
    np.testing.assert_allclose(after["value_k_sr"], before["value_k_sr"], atol=1e-6 * np.abs(before["value_k_sr"]).max())
    other = tmp_path / f"other.{kind}"
    other.write_text("mine")
    with pytest.raises(lunarray.Error, match="is there"):
        getattr(downlink, f"write_{kind}")(other, 0)
    assert other.read_text() == "mine"


@pytest.mark.filterwarnings("ignore")
def test_uvh5_has_the_weights(small, tmp_path):
    """nsample_array times integration_time is in proportion to the inverse variance, as the format defines both."""
    from pyuvdata import UVData

    downlink = lunarray.open(small.downlink)
    downlink.write_uvh5(tmp_path / "v.uvh5", 0)
    data = UVData.from_file(tmp_path / "v.uvh5", run_check=False)
    rows = downlink.visibilities(0)
    rows = rows[(rows["flag"] == 0) & np.isfinite(rows["uvw_m"][:, 0])]
    rows = rows[np.argsort(rows["time_s"], kind="stable")]
    ratio = data.nsample_array[:, 0, 0] * data.integration_time / rows["weight"]
    # Single precision, twice.
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-6)
    assert data.nsample_array.max() == 1.0 and data.nsample_array.min() < 0.999


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", ["uvh5", "parquet"])
def test_files_of_others_are_not_replaced(small, tmp_path, kind):
    downlink = lunarray.open(shutil.copy(small.downlink, tmp_path / "in.ccsds"))
    before = (tmp_path / "in.ccsds").read_bytes()
    precious = tmp_path / "precious"
    precious.write_text("precious")
    (tmp_path / "link").symlink_to(precious)
    (tmp_path / "dangling").symlink_to(tmp_path / "elsewhere")
    os.link(tmp_path / "in.ccsds", tmp_path / "hard")
    os.mkfifo(tmp_path / "pipe")

    def write(name):
        return getattr(downlink, f"write_{kind}")(tmp_path / name, 0)

    for name, text in [
        ("link", "link is a link, to "),
        ("dangling", "dangling is a link, to "),
        ("precious", "precious is there and is no "),
        ("in.ccsds", "is the downlink that is exported"),
        ("hard", "is the downlink that is exported"),
        ("pipe", "pipe is no file"),
        (".", "is no file"),
        ("nowhere/v", "nowhere is none"),
    ]:
        with pytest.raises(lunarray.Error, match=text):
            write(name)
    assert precious.read_text() == "precious" and not (tmp_path / "elsewhere").exists()
    assert (tmp_path / "in.ccsds").read_bytes() == before
    # One of its kind is replaced, by a whole one, and nothing else is left.
    count = write("v")
    (tmp_path / "v").write_bytes((tmp_path / "v").read_bytes()[:100])
    assert write("v") == count and (tmp_path / "v").stat().st_size > 10_000
    assert {path.name for path in tmp_path.iterdir()} == {"in.ccsds", "precious", "link", "dangling", "hard", "pipe", "v"}


@pytest.mark.parametrize(
    ("package", "extra", "write"),
    [("h5py", "uvh5", "write_uvh5"), ("pyuvdata", "uvh5", "write_uvh5"), ("pyarrow", "parquet", "write_parquet")],
)
def test_a_missing_package_names_the_extra(small, tmp_path, monkeypatch, package, extra, write):
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    # What Python makes of a package that is not installed.
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=rf"pip install 'lunarray\[{extra}\]' brings {package}"):
        getattr(lunarray.open(small.downlink), write)(tmp_path / "v", 0)
    assert not (tmp_path / "v").exists()


def export(*words):
    return subprocess.run([sys.executable, "-m", "lunarray", "export", *map(str, words)], capture_output=True, text=True)


def test_csv_has_the_same_visibilities(small, tmp_path):
    told = export("visibilities", small.downlink, "--channel", 1, "--out", tmp_path / "v.csv")
    assert told.returncode == 0, told.stderr
    downlink = lunarray.open(small.downlink)
    expected = downlink.visibilities(1)
    with open(tmp_path / "v.csv") as file:
        found = list(csv.DictReader(file))
    assert len(found) == len(expected) and f"{len(found)} visibilities are in" in told.stdout

    def column(name):
        return np.array([float(row[name]) for row in found])

    for name, values in [
        ("time_s", expected["time_s"]),
        ("dt_s", expected["dt_s"]),
        ("i", expected["i"]),
        ("flag", expected["flag"]),
        ("u_m", expected["uvw_m"][:, 0]),
        ("w_m", expected["uvw_m"][:, 2]),
        ("z_j_m", expected["r_j_m"][:, 2]),
        ("im_jy", expected["value_jy"].imag),
    ]:
        # Written with all digits that tell numbers apart, times to half a microsecond.
        np.testing.assert_allclose(column(name), values, rtol=1e-15, atol=1e-8 if name == "time_s" else 0)
    assert (column("re_k_sr").astype(np.float32) == expected["value_k_sr"].real).all()
    assert (column("weight").astype(np.float32) == expected["weight"]).all()
    tai = (expected["tai"] - np.datetime64("1958-01-01", "ns")).astype(float) * 1e-9
    # Doubles of 2e9 s are half a microsecond apart.
    np.testing.assert_allclose(column("tai_s"), tai, atol=1e-6, rtol=0)
    wrong = export("visibilities", small.downlink, "--channel", 2, "--out", tmp_path / "w.csv")
    assert wrong.returncode == 1 and "expected one of the file's 2 channels, from 0" in wrong.stderr


def test_spectra_and_coefficients_are_exported(small, tmp_path):
    assert export("spectra", small.out, "--out", tmp_path / "s.csv").returncode == 0
    with open(tmp_path / "s.csv") as file:
        rows = [row for row in csv.DictReader(file) if float(row["frequency_hz"]) == 3e6]
    rho = np.array([float(row["rho"]) for row in rows])
    np.testing.assert_allclose(rho, small.summary["channels"][1]["rho"], rtol=1e-12)
    path = f"{small.out}/3.000MHz/map.fits"
    told = export("alm", path, "--l-max", 9, "--out", tmp_path / "alm.fits")
    assert told.returncode == 0, told.stderr
    found, mmax = healpy.read_alm(tmp_path / "alm.fits", return_mmax=True)
    expected = healpy.map2alm(healpy.read_map(path, dtype=None), lmax=9, iter=3)
    assert mmax == 9
    np.testing.assert_allclose(found, expected, atol=1e-8 * np.abs(expected).max())


def test_the_packet_definition_in_xtce_describes_every_packet(small):
    from collections import Counter

    from conftest import REPOSITORY
    from space_packet_parser.generators import ccsds_generator
    from space_packet_parser.xtce.definitions import XtcePacketDefinition

    definition = XtcePacketDefinition.from_xtce(REPOSITORY / "docs/packets.xtce.xml")
    kinds, values = Counter(), {0: [], 1: []}
    with open(small.downlink, "rb") as file:
        for octets in ccsds_generator(file):
            packet = definition.parse_bytes(octets)
            # Whole and nothing left: the last field is the checksum at the end of the packet.
            assert packet["PACKET_CHECK"] == int.from_bytes(octets[-4:], "big")
            assert (packet["MAGIC"], packet["P_FIELD"]) == (0x4C, 0x1F)
            kinds[packet["PKT_APID"]] += 1
            if packet["PKT_APID"] == 259 and packet["I"] != packet["J"]:
                count = packet["COUNT"]
                values[packet["CHANNEL"]].append(np.frombuffer(packet["ARRAYS"], "<c8", count, 8 * count))
    for channel, found in values.items():
        assert (np.concatenate(found) == lunarray.open(small.downlink).visibilities(channel)["value_k_sr"]).all()
    counted = {entry["kind"]: entry["packets"] for entry in lunarray.inspect(small.downlink)["packets"]}
    names = {257: "instrument", 258: "ephemeris", 259: "visibilities", 261: "housekeeping"}
    assert {names[apid]: number for apid, number in kinds.items()} == {k: n for k, n in counted.items() if n}


def test_parquet_has_the_same_visibilities(small, tmp_path):
    import json

    import pyarrow as pa
    import pyarrow.parquet as parquet

    downlink = lunarray.open(small.downlink)
    expected = downlink.visibilities(1)
    assert downlink.write_parquet(tmp_path / "v.parquet", 1) == len(expected) > 1000
    found = parquet.read_table(tmp_path / "v.parquet")
    assert export("visibilities", small.downlink, "--channel", 1, "--out", tmp_path / "v.csv").returncode == 0
    with open(tmp_path / "v.csv") as file:
        names = set(next(csv.reader(file)))
    # Times are whole numbers of nanoseconds instead of doubles, and UTC is there, too.
    assert set(found.column_names) == names - {"tai_s"} | {"tai", "utc"}

    def column(name):
        return found[name].to_numpy()

    for name in ("time_s", "dt_s", "i", "j", "weight", "flag", "tai", "utc"):
        np.testing.assert_array_equal(column(name), expected[name], err_msg=name)
    for names, values in [("uvw", "uvw_m"), (("x_i", "y_i", "z_i"), "r_i_m"), (("x_j", "y_j", "z_j"), "r_j_m")]:
        for axis, name in enumerate(names):
            np.testing.assert_array_equal(column(f"{name}_m"), expected[values][:, axis], err_msg=name)
    for unit in ("k_sr", "jy"):
        np.testing.assert_array_equal(column(f"re_{unit}") + 1j * column(f"im_{unit}"), expected[f"value_{unit}"])
    # Precision is that of the arrays.
    assert (found.schema.field("re_k_sr").type, found.schema.field("re_jy").type) == (pa.float32(), pa.float64())
    assert found.schema.field("utc").type == pa.timestamp("ns")
    assert all(field.metadata[b"unit"] for field in found.schema)
    about = found.schema.metadata
    assert float(about[b"lunarray.frequency_hz"]) == 3e6
    assert json.loads(about[b"lunarray.instrument"]) == downlink.instrument
    wrong = export("visibilities", small.downlink, "--out", tmp_path / "w.parquet")
    assert wrong.returncode == 1 and "write_parquet(..) of the Python package" in wrong.stderr


def nested_in_rows(count):
    """NESTED numbers of the pixels of a HiPS tile of ``count`` levels, row by row from the top, as the standard divides tiles:
    the first of four is above left, the second below it, the third to its right, the fourth below right."""
    if count == 0:
        return np.zeros((1, 1), int)
    inner, each = nested_in_rows(count - 1), 4 ** (count - 1)
    return np.block([[inner, inner + 2 * each], [inner + each, inner + 3 * each]])


@pytest.mark.parametrize("frame", ["ecliptic", "galactic"])
def test_hips_tiles_have_the_values_of_the_map(tmp_path, frame):
    """At every pixel of tiles, with healpy's directions and frames; and the tiles above, the preview and the PNG follow."""
    from astropy.io import fits
    from PIL import Image

    rng = np.random.default_rng(8)
    pixels = np.exp(rng.standard_normal(12 * 16**2)).astype(np.float32)
    pixels[100] = healpy.UNSEEN
    healpy.write_map(tmp_path / "map.fits", pixels, coord="E", column_units="K", extra_header=[("FREQ", 3e6)])
    told = export("hips", tmp_path / "map.fits", "--hips-frame", frame, "--out", tmp_path / "hips")
    assert told.returncode == 0, told.stderr
    lines = (tmp_path / "hips/properties").read_text().splitlines()
    properties = {key.strip(): value.strip() for key, value in (line.split("=", 1) for line in lines)}
    # What the standard requires.
    required = {"creator_did", "obs_title", "dataproduct_type", "hips_version", "hips_release_date", "hips_status"}
    required |= {"hips_frame", "hips_order", "hips_tile_format"}
    assert required <= set(properties)
    assert (properties["hips_frame"], properties["hips_order"], properties["hips_tile_width"]) == (frame, "3", "64")
    low, high = map(float, properties["hips_pixel_cut"].split())
    assert pixels[pixels > 0].min() < low < high < pixels.max()

    def tile(order, number, kind="fits"):
        return tmp_path / f"hips/Norder{order}/Dir0/Npix{number}.{kind}"

    inside = nested_in_rows(6)
    turn = healpy.Rotator(coord=[frame[0].upper(), "E"])
    values = np.where(pixels == healpy.UNSEEN, np.nan, pixels)
    preview = fits.getdata(tmp_path / "hips/Norder3/Allsky.fits")[::-1]
    finest = np.empty(12 * 512**2, np.float32)
    wrong = 0
    for number in range(768):
        data, header = fits.getdata(tile(3, number), header=True)
        assert (header["BITPIX"], header["ORDER"], header["NPIX"]) == (-32, 3, number)
        # FITS stores rows from the bottom up.
        data = data[::-1]
        directions = turn(np.array(healpy.pix2vec(512, number * 64**2 + inside.ravel(), nest=True)))
        expected = values[healpy.vec2pix(16, *directions)].reshape(64, 64)
        wrong += (~((data == expected) | (np.isnan(data) & np.isnan(expected)))).sum()
        row, column = divmod(number, 27)
        np.testing.assert_array_equal(preview[64 * row : 64 * row + 64, 64 * column : 64 * column + 64], data)
        finest[number * 64**2 + inside.ravel()] = data.ravel()
    # Centres of tiles' pixels on edges of the map's, where rounding decides; none if both are of one grid.
    assert wrong <= (0 if frame == "ecliptic" else 12 * 512**2 * 1e-6), wrong
    assert len(list((tmp_path / "hips").rglob("Npix*.fits"))) == 768 + 192 + 48 + 12

    # Above: means of the pixels below that have a value.
    above = np.nanmean(finest.astype(float).reshape(-1, 4), axis=1)
    found = np.empty(12 * 256**2)
    for number in range(192):
        found[number * 64**2 + inside.ravel()] = fits.getdata(tile(2, number))[::-1].ravel()
    np.testing.assert_allclose(found, above, rtol=1e-6)

    picture = np.array(Image.open(tile(3, 5, "png")))
    data = fits.getdata(tile(3, 5))[::-1]
    assert picture.shape == (64, 64, 4) and (picture[..., 3] == 255 * ~np.isnan(data)).all()
    # Brighter is lighter.
    bright = data > np.nanmedian(data)
    assert picture[bright][:, :3].mean() > picture[~bright & ~np.isnan(data)][:, :3].mean() + 20
    again = export("hips", tmp_path / "map.fits", "--out", tmp_path / "hips")
    assert again.returncode == 1 and "expected a new or empty folder" in again.stderr


@pytest.mark.filterwarnings("ignore")
def test_calh5_has_the_gains_times_and_flags_of_solutions(tmp_path):
    """What pyuvdata reads is what the table says, by daughter, channel and solution."""
    from types import SimpleNamespace

    import h5py
    from pyuvdata import UVCal

    from lunarray._calh5 import write_calh5

    header = (
        "pass,from_s,until_s,daughter,frequency_hz,amplitude,ln_amplitude_sigma,phase_deg,phase_sigma_deg,visibilities,outliers,"
        "chi_square,state,phase_scatter_deg,unexplained,reference"
    )
    gains = {}
    lines = [header]
    for time, (from_s, until_s) in enumerate([(100.0, 2800.0), (8358.0, 9000.0), (9000.0, 11000.0)]):
        for daughter in (1, 2, 3):
            for channel, hz in enumerate((3000000.0, 10000000.0)):
                amplitude, phase_deg = 1 + 0.1 * daughter + 0.01 * time, 20.0 * daughter * (channel + 1) - 30 * time
                state = "dead" if (daughter, time) == (3, 1) else "good"
                gains[daughter, channel, time] = amplitude * np.exp(1j * np.radians(phase_deg)), state
                lines.append(f"{time},{from_s},{until_s},{daughter},{hz},{amplitude},0.01,{phase_deg},0.5,9,0,1.02,{state},0.3,0.04,1")
    (tmp_path / "solutions.csv").write_text("\n".join(lines) + "\n")
    downlink = SimpleNamespace(
        path="small.ccsds",
        channels_hz=[3e6, 10e6],
        satellites=3,
        instrument={"name": "small", "epoch_tai_s": 2.3e9, "widths_hz": [8e3, 8e3]},
        ephemeris=lambda _: 1e6 * np.eye(3),
    )
    assert write_calh5(downlink, tmp_path / "gains.calh5", tmp_path / "solutions.csv") == 3
    found = UVCal.from_file(tmp_path / "gains.calh5")
    assert found.check() and found.gain_convention == "divide" and found.ref_antenna_name == "1"
    assert found.gain_array.shape == (3, 2, 3, 1)
    for (daughter, channel, time), (gain, state) in gains.items():
        assert abs(found.gain_array[daughter - 1, channel, time, 0] - gain) < 1e-12
        assert found.flag_array[daughter - 1, channel, time, 0] == (state != "good")
    # Julian days have a resolution of 40 us.
    np.testing.assert_allclose(np.diff(found.time_range, axis=1)[:, 0] * 86400, [2700, 642, 2000], atol=1e-3)
    with h5py.File(tmp_path / "gains.calh5") as file:
        np.testing.assert_allclose(file["lunarray/phase_sigma_deg"], 0.5)
        assert file["lunarray/state"][2, 0, 1] == b"dead"
    (tmp_path / "solutions.csv").write_text("\n".join(lines[:-1]) + "\n")
    with pytest.raises(lunarray.Error, match="a line for each solution"):
        write_calh5(downlink, tmp_path / "gains.calh5", tmp_path / "solutions.csv")
