#!/usr/bin/env python3
"""Cramer-Rao bounds of the phases of daughters in one pass and channel with a known sky, in numpy and healpy: shares no code with
lunarray.

    python3 pipelines/calibration/bound.py ULSA_FOLDER [ARCSEC] # a table of six cases, deg against daughter 1, with drawn
                                                                # sources of a diameter (15)
    python3 pipelines/calibration/bound.py --points MHZ FOLDER  # writes FOLDER/points.fits, and bounds for that sky alone

The sky is ULSA (Cong et al. 2021; nside 64, on baselines up to 32 wavelengths), the 3,100 brightest sources of the GLEAM counts
(Franzen et al. 2019, index -0.8), and the brightest named sources with rounded fluxes and sizes, all blurred by scattering in
the Galaxy, 30' (nu / MHz)^-2.2 (Jester & Falcke 2009). --points leaves sources alone, at the centres of pixels of nside 32, with
the mean power of the diffuse sky as receiver noise: a sky that a chain with direct sums can have as its known map.

Noise of a visibility is sqrt(P_i P_j / 2 dnu t) in either part. The information on phases is that of resistors between daughters with
conductances sum |V|^2 / sigma^2; a variance against daughter 1 is the resistance from it, here from the spectrum of the Laplacian.
"""

import sys

import healpy as hp
import numpy as np

LIGHT, BOLTZMANN, WIDTH = 299792458.0, 1.380649e-23, 8e3
MOON, ALTITUDE, PERIOD, INCLINATION = 1737.1e3, 300e3, 8248.68, np.radians(30)
PRECESSION, MONTH, HALF_BREATH = 1.3 * 365.25 * 86400, 27.321661 * 86400, 7 * 86400
ARCS = np.array([0.0, *(-863.717 + 1463.717 * 2.02478845 ** np.arange(7))])
RATIOS = np.array([1, 6] + 6 * [3])
radius = MOON + ALTITUDE
dip = np.sqrt(radius**2 - MOON**2)
# Right ascension, declination (deg), Jy at 38 MHz, index, diameter (arcsec).
NAMED = [
    (350.85, 58.81, 25000, -0.6, 240),  # Cassiopeia A
    (299.87, 40.73, 22000, -0.4, 60),  # Cygnus A
    (187.71, 12.39, 4000, -0.8, 90),  # Virgo A
    (83.63, 22.01, 2400, -0.5, 300),  # Taurus A
    (201.37, -43.02, 4000, -0.7, 400),  # Centaurus A, inner lobes
    (252.78, 4.99, 1600, -1.0, 100),  # Hercules A
    (139.52, -12.10, 1300, -0.9, 40),  # Hydra A
    (79.96, -45.78, 1200, -0.8, 250),  # Pictor A
    (69.27, 29.67, 570, -0.7, 20),  # 3C 123
]


def positions(t):
    into = t % (2 * HALF_BREATH)
    arcs = ARCS * (1 - (1 - 1 / RATIOS) * min(into, 2 * HALF_BREATH - into) / HALF_BREATH)
    f, node = 2 * np.pi * t / PERIOD - arcs / radius, -2 * np.pi * t / PRECESSION
    x, y = np.cos(f), np.sin(f) * np.cos(INCLINATION)
    return radius * np.stack(
        [np.cos(node) * x - np.sin(node) * y, np.sin(node) * x + np.cos(node) * y, np.sin(f) * np.sin(INCLINATION)], 1
    )


def window(after):
    """Start and end of the first time after `after` for which the Earth is hidden from daughter 1."""
    t = np.arange(after, after + 2 * PERIOD, 1.0)
    earth = np.stack([np.cos(2 * np.pi * t / MONTH), np.sin(2 * np.pi * t / MONTH), 0 * t], 1)
    hidden = np.array([-(positions(one)[0] @ e) > dip for one, e in zip(t, earth)])
    rises = np.flatnonzero(~hidden[:-1] & hidden[1:])[0] + 1
    return t[rises], t[rises + np.argmin(hidden[rises:])]


def sources(nu, arcsec=15.0):
    """Directions, K sr, and diameters (rad) with scattering at nu (Hz)."""
    rng = np.random.default_rng(5)
    log_flux = np.linspace(0, 3, 3001)
    a = [3.52, 0.307, -0.388, -0.0404, 0.0351, 0.00600]
    counts = 10 ** (sum(c * log_flux**k for k, c in enumerate(a)) - 2.5 * log_flux)  # dN/dS at 154 MHz, per Jy and sr
    flux = 10**log_flux
    above = 4 * np.pi * np.array([np.trapezoid(counts[k:], flux[k:]) for k in range(len(flux))])
    drawn = np.interp(-rng.uniform(0, 3100, 3100), -above, flux)
    z, longitude = rng.uniform(-1, 1, 3100), rng.uniform(0, 2 * np.pi, 3100)
    across = np.sqrt(1 - z * z)
    where = np.stack([across * np.cos(longitude), across * np.sin(longitude), z], 1)
    jansky, size = drawn * (nu / 154e6) ** -0.8, np.full(3100, arcsec)
    turn = hp.Rotator(coord="CE")
    named = np.array([turn(hp.ang2vec(ra, dec, lonlat=True)) for ra, dec, *_ in NAMED])
    table = np.array(NAMED)
    where = np.concatenate([where, named])
    jansky = np.concatenate([jansky, table[:, 2] * (nu / 38e6) ** table[:, 3]])
    size = np.radians(np.concatenate([size, table[:, 4]]) / 3600)
    scattering = np.radians(30 / 60 * (nu / 1e6) ** -2.2)
    return where, 1e-26 * jansky * (LIGHT / nu) ** 2 / (2 * BOLTZMANN), np.hypot(size, scattering)


def diffuse(folder, nu):
    """ULSA on ecliptic axes, K."""
    read = lambda name: hp.read_map(f"{folder}/ulsa_{name}_galactic_nside64.fits", dtype=float)
    mhz = round(nu / 1e6)
    sky = read(f"{mhz}mhz") if mhz in (1, 3, 10) else read("10mhz") * (nu / 1e7) ** -np.abs(read("spectral_index"))
    return hp.Rotator(coord="GE").rotate_map_pixel(sky)


def bounds(nu, after, point, extended=None, power=0.0, instants=300):
    """Bounds (deg) by daughter, 2 to 8, for sources and a diffuse sky (directions, K sr) or a constant power (K sr)."""
    where, strength, size = point
    start, end = window(after)
    laplacian, wavelength = np.zeros((8, 8)), LIGHT / nu
    step = (end - start) / instants
    for t in start + step * (np.arange(instants) + 0.5):
        r = positions(t)
        seen = where @ r.T >= -dip
        powers = power + seen.T @ strength
        if extended is not None:
            seen_far = extended[0] @ r.T >= -dip
            powers = powers + seen_far.T @ extended[1]
        for i in range(8):
            for j in range(i + 1, 8):
                u = (r[i] - r[j]) / wavelength
                length = np.linalg.norm(u)
                blur = np.exp(-((np.pi * size * length) ** 2) / (4 * np.log(2)))
                both = seen[:, i] & seen[:, j]
                value = (strength * blur * both) @ np.exp(-2j * np.pi * (where @ u))
                if extended is not None and length < 32:
                    both = seen_far[:, i] & seen_far[:, j]
                    value += (extended[1] * both) @ np.exp(-2j * np.pi * (extended[0] @ u))
                weight = abs(value) ** 2 * 2 * WIDTH * step / (powers[i] * powers[j])
                laplacian[[i, j], [i, j]] += weight
                laplacian[[i, j], [j, i]] -= weight
    spectrum, modes = np.linalg.eigh(laplacian)
    # All but the common phase.
    resistance = [np.sum((modes[0, 1:] - modes[n, 1:]) ** 2 / spectrum[1:]) for n in range(1, 8)]
    return np.degrees(np.sqrt(resistance)), end - start


def told(label, values):
    print(label, *(f"{value:7.2f}" for value in values))


if sys.argv[1] == "--points":
    nu, folder = 1e6 * float(sys.argv[2]), sys.argv[3]
    where, strength, _ = sources(nu)
    pixels = hp.vec2pix(32, *where.T)
    sky = np.bincount(pixels, strength, hp.nside2npix(32)) / hp.nside2pixarea(32)
    hp.write_map(f"{folder}/points.fits", sky, coord="E", column_units="K", dtype=np.float64, overwrite=True,
                 extra_header=[("FREQ", nu)])
    power = {3: 3.6e7, 10: 2.4e6, 30: 1.5e5}[round(nu / 1e6)]
    used = np.flatnonzero(sky)
    point = np.array(hp.pix2vec(32, used)).T, sky[used] * hp.nside2pixarea(32), np.zeros(len(used))
    for label, after in [("widest", 0.0), ("narrowest", HALF_BREATH - 0.5 * PERIOD)]:
        found, length = bounds(nu, after, point, power=power, instants=2000)
        told(f"{nu / 1e6:.0f} MHz {label} ({length:.0f} s, {power:.3g} K sr):", found)
else:
    for mhz in (3, 10, 30):
        nu = 1e6 * mhz
        sky = diffuse(sys.argv[1], nu)
        extended = np.array(hp.pix2vec(64, np.arange(len(sky)))).T, sky * hp.nside2pixarea(64)
        for label, after in [("widest", 0.0), ("narrowest", HALF_BREATH - 0.5 * PERIOD)]:
            arcsec = float(sys.argv[2]) if len(sys.argv) > 2 else 15.0
            found, length = bounds(nu, after, sources(nu, arcsec), extended)
            told(f"{mhz:2d} MHz {label:9s}:", found)
