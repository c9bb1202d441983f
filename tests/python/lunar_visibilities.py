"""Visibilities by stations on the Moon, as pyuvsim simulates them.

usage: lunar_visibilities.py OUT          needs pyuvsim with mpi4py, lunarsky, astropy-healpix

Three simulations: pyuvsim's reference 1.8 (149 sources, 128 stations at Tranquility, 100 MHz), a HEALPix sky with a horizon, and short
dipoles to the north. OUT is JSON, a list of simulations: frequency_hz; dipoles; directions and fluxes, Jy, of sources; moon_radius_m,
the radius of the highest station; visibilities: a list of [six coordinates of both stations, m; real and imaginary part of the total
intensity, Jy] by time and pair. Directions and positions are on ecliptic axes; the Moon's axes are those of lunarsky. The first has the
telescope's place, time and zenith as well.
"""

import json
import sys
import tempfile
import warnings
from pathlib import Path

import numpy as np
import pyuvsim
import yaml
from astropy import units
from astropy.coordinates import ICRS, CartesianRepresentation
from astropy.time import Time
from astropy_healpix import HEALPix
from lunarsky import MCMF, LunarTopo, MoonLocation, SkyCoord
from pyradiosky import SkyModel
from pyuvsim.data import DATA_PATH

warnings.filterwarnings("ignore")
OBLIQUITY = np.radians(84381.448 / 3600)
TO_ECLIPTIC = np.array([[1, 0, 0], [0, np.cos(OBLIQUITY), np.sin(OBLIQUITY)], [0, -np.sin(OBLIQUITY), np.cos(OBLIQUITY)]])
# Altitudes so close to the horizon are on either side of it for stations that see other zeniths.
MARGIN_RAD = 5e-4


def directions(ra, dec):
    """Unit vectors on ecliptic axes."""
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1) @ TO_ECLIPTIC.T


def positions(uv, jd):
    """Positions of all stations at a time, m, ecliptic axes, by number of the antenna."""
    place = uv.telescope.location
    fixed = np.array([getattr(place, axis).to_value("m") for axis in "xyz"]) + uv.telescope.antenna_positions
    time = Time(jd, format="jd", scale="utc")
    axes = [MCMF(CartesianRepresentation(*axis), obstime=time).transform_to(ICRS()).cartesian.xyz.value.ravel() for axis in np.eye(3)]
    return dict(zip(uv.telescope.antenna_numbers.tolist(), fixed @ np.array(axes) @ TO_ECLIPTIC.T))


def simulation(uv, ra, dec, flux, polarisation=(-5, -6)):
    used = [uv.polarization_array.tolist().index(number) for number in polarisation]
    # Of unpolarised sources each has half of the total intensity.
    value = uv.data_array[:, 0, used].mean(axis=1) * 2
    found, highest = [], 0.0
    for jd in np.unique(uv.time_array):
        places = positions(uv, jd)
        highest = max(highest, *(np.linalg.norm(place) for place in places.values()))
        for row in np.flatnonzero(uv.time_array == jd):
            ends = [*places[int(uv.ant_1_array[row])], *places[int(uv.ant_2_array[row])]]
            found.append([*ends, value[row].real, value[row].imag])
    return {
        "frequency_hz": float(uv.freq_array[0]),
        "dipoles": len(polarisation) == 1,
        "directions": directions(ra, dec).tolist(),
        "flux_jy": np.asarray(flux, float).tolist(),
        "moon_radius_m": highest,
        "visibilities": found,
    }


def reference():
    uv = pyuvsim.run_uvsim(f"{DATA_PATH}/test_config/obsparam_ref_1.8_lunar.yaml", return_uv=True, quiet=True)
    table = np.genfromtxt(f"{DATA_PATH}/test_catalogs/MOON.txt", skip_header=1, usecols=(1, 2, 3))
    found = simulation(uv, *np.radians(table[:, :2].T), table[:, 2])
    place = uv.telescope.location
    time = Time(uv.time_array[0], format="jd", scale="utc")
    zenith = SkyCoord(alt=90 * units.deg, az=0 * units.deg, frame=LunarTopo(location=place, obstime=time)).icrs
    found["place"] = {
        "longitude_deg": place.lon.deg,
        "latitude_deg": place.lat.deg,
        "utc": time.isot,
        "zenith": directions(np.atleast_1d(zenith.ra.rad), np.atleast_1d(zenith.dec.rad))[0].tolist(),
    }
    return found


def own(folder, beam, layout, polarisation):
    """A sky of an own, at the times of ten at which no pixel is at the horizon."""
    grid = HEALPix(nside=8, order="ring", frame=ICRS())
    centres = grid.healpix_to_skycoord(np.arange(grid.npix))
    ra, dec = centres.ra.rad, centres.dec.rad
    kelvin = 1e5 * (2 + np.random.default_rng(4).standard_normal(grid.npix))
    zero = 0 * kelvin
    model = SkyModel(
        component_type="healpix",
        nside=8,
        hpx_order="ring",
        frame="icrs",
        hpx_inds=np.arange(grid.npix),
        stokes=np.stack([kelvin, zero, zero, zero])[:, None, :] * units.K,
        spectral_type="full",
        freq_array=np.array([10e6]) * units.Hz,
    )
    model.write_skyh5(folder / "sky.skyh5", clobber=True)
    lines = ["Name Number BeamID E N U", *(f"S{n} {n} 0 {e} {h} 0" for n, (e, h) in enumerate(layout))]
    (folder / "layout.csv").write_text("\n".join(lines) + "\n")
    telescope = f"beam_paths:\n    0: !AnalyticBeam\n        class: {beam}\ntelescope_location: (0.0, 170.0, 0)\nworld: moon\n"
    (folder / "telescope.yaml").write_text(f"{telescope}telescope_name: far side\n")
    place = MoonLocation.from_selenodetic(170.0, 0.0, 0.0)
    visibilities, found = [], None
    for jd in 2462502.5 + 2.7 * np.arange(10):
        frame = LunarTopo(location=place, obstime=Time(jd, format="jd", scale="utc"))
        if np.abs(SkyCoord(centres).transform_to(frame).alt.rad).min() < MARGIN_RAD:
            continue
        settings = {
            "filing": {"outdir": str(folder), "outfile_name": "own"},
            "freq": {"freq_array": [10e6], "channel_width": 8e3},
            "sources": {"catalog": str(folder / "sky.skyh5")},
            "telescope": {"array_layout": str(folder / "layout.csv"), "telescope_config_name": str(folder / "telescope.yaml")},
            "time": {"Ntimes": 1, "integration_time": 10.0, "start_time": float(jd)},
            "select": {"ant_str": "cross"},
        }
        (folder / "settings.yaml").write_text(yaml.safe_dump(settings))
        uv = pyuvsim.run_uvsim(str(folder / "settings.yaml"), return_uv=True, quiet=True)
        flux = kelvin * grid.pixel_area.to_value("sr") * 2 * 1.380649e-23 * (10e6 / 299792458) ** 2 * 1e26
        found = simulation(uv, ra, dec, flux, polarisation)
        visibilities += found["visibilities"]
    return {**found, "visibilities": visibilities}


with tempfile.TemporaryDirectory() as made:
    scattered = np.random.default_rng(1).uniform(-200, 200, (8, 2))
    along = np.stack([np.array([-190.0, -100.0, 30.0, 170.0]), np.zeros(4)], axis=1)
    simulations = [
        reference(),
        own(Path(made), "UniformBeam", scattered, (-5, -6)),
        own(Path(made), "ShortDipoleBeam", along, (-6,)),
    ]
Path(sys.argv[1]).write_text(json.dumps(simulations))
