"""Noise and measured modes by degree of visibilities, from dense equations over harmonics.

usage: sensitivity.py VISIBILITIES.csv SKY.fits FREQUENCY_HZ MOON_RADIUS_M L_MAX          needs healpy, scipy

Prints JSON: measured, noise_k2 and sky_k2 by degree from l = 0. Rows of B are integrals over pixels of nside 64 of fringe, horizon and real
harmonics; R is the inverse power of the sky.
"""

import json
import sys

import healpy
import numpy as np
from scipy.special import sph_harm_y

table, sky, frequency_hz, radius_m, l_max = sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5])
rows = np.genfromtxt(table, delimiter=",", names=True)
power = healpy.anafast(healpy.read_map(sky), lmax=l_max, iter=10)
nside = 64
area_sr = healpy.nside2pixarea(nside)
theta, phi = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
towards = np.array(healpy.ang2vec(theta, phi))

harmonics, degrees = [], []
for l in range(l_max + 1):
    for m in range(l + 1):
        value = sph_harm_y(l, m, theta, phi)
        parts = [value.real] if m == 0 else [np.sqrt(2) * value.real, np.sqrt(2) * value.imag]
        harmonics.extend(parts)
        degrees.extend([l] * len(parts))
harmonics, degrees = np.array(harmonics), np.array(degrees)


def seen(place_m):
    """Directions that the body does not hide: those above the horizon, which dips below the plane of the place."""
    distance_m = np.linalg.norm(place_m)
    return towards @ (place_m / distance_m) > -np.sqrt(1 - (radius_m / distance_m) ** 2)


def response(row):
    """Real and imaginary part at the pixels, times the root of the weight."""
    first, second = (np.array([row[f"{axis}_{end}_m"] for axis in "xyz"]) for end in "ij")
    turns = towards @ (second - first) * frequency_hz / 299792458.0
    value = np.where(seen(first) & seen(second), np.exp(2j * np.pi * turns), 0) * area_sr * np.sqrt(row["weight"])
    return [value.real, value.imag]


matrix = np.zeros((len(degrees), len(degrees)))
for some in np.array_split(rows, len(rows) // 50 + 1):
    b = harmonics @ np.array([part for row in some for part in response(row)]).T
    matrix += b @ b.T

r = np.diag(1 / power[degrees])
inverse = np.linalg.inv(matrix + r)
kept = matrix @ inverse
noise = inverse @ matrix @ inverse
of_degree = [degrees == l for l in range(l_max + 1)]
print(json.dumps({
    "measured": [np.diag(kept)[at].sum() for at in of_degree],
    "noise_k2": [np.diag(noise)[at].mean() for at in of_degree],
    "sky_k2": power.tolist(),
}))
