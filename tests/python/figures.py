"""A row of the beam matrix, and visibilities of a waterfall, by dense float64 sums that share nothing with the product.

usage: figures.py rows NUMBERS.json TABLE.csv
       figures.py waterfall SKY.fits PAIRS.csv NSIDE

`rows` compares a table of `lunarray figure rows` with fringes at healpy's pixel centres, and with their means over the 256
children of each pixel. `waterfall` reads lines `frequency_hz,x_i,y_i,z_i,x_j,y_j,z_j,6 values` and compares the visibilities
(K sr): of the sky itself, of the sky averaged to NSIDE by averaged rows, and by rows at centres. Prints the greatest
difference of each, and its rms, relative to the largest value.
"""

import csv
import json
import sys

import healpy as hp
import numpy as np

LIGHT, MOON, CHILDREN = 299792458.0, 1737.1e3, 16


def fringes(n, r_i, r_j, frequency):
    """Seen by both, times the fringe. n: (.., 3)."""
    def sees(r):
        return n @ r >= -np.sqrt(r @ r - MOON**2)

    return (sees(r_i) & sees(r_j)) * np.exp(-2j * np.pi * frequency / LIGHT * (n @ (r_i - r_j)))


def centres(nside, nest=False):
    return np.array(hp.pix2vec(nside, np.arange(hp.nside2npix(nside)), nest=nest)).T


def averaged(fine):
    """Means over the children of each pixel, both in NESTED order, in which children follow each other."""
    return fine.reshape(-1, CHILDREN**2).mean(axis=1)


def report(name, found, expected):
    scale, difference = np.abs(expected).max(), np.abs(found - expected)
    print(name, difference.max() / scale, np.sqrt((difference**2).mean()) / scale)


if sys.argv[1] == "rows":
    numbers = json.load(open(sys.argv[2]))
    table = np.loadtxt(sys.argv[3], delimiter=",", skiprows=1)
    nside = numbers["nside"]
    geometry = np.array(numbers["r_i_m"]), np.array(numbers["r_j_m"]), numbers["frequency_hz"]
    report("centre", table[:, 1] + 1j * table[:, 2], fringes(centres(nside), *geometry))
    mean = averaged(fringes(centres(CHILDREN * nside, nest=True), *geometry))
    report("average", table[:, 3] + 1j * table[:, 4], mean[hp.ring2nest(nside, np.arange(len(mean)))])
else:
    sky = hp.read_map(sys.argv[2], dtype=np.float64)
    nside, fine = int(sys.argv[4]), hp.get_nside(sky)
    assert fine == CHILDREN * nside
    coarse = hp.ud_grade(sky, nside)
    sky, coarse_nested = (hp.reorder(pixels, r2n=True) for pixels in (sky, coarse))
    directions, coarse_directions = centres(fine, nest=True), centres(nside)
    found, expected = [], []
    for row in csv.reader(open(sys.argv[3])):
        values = np.array(row, float)
        geometry = values[1:4], values[4:7], values[0]
        found.append(values[7::2] + 1j * values[8::2])
        seen = fringes(directions, *geometry)
        expected.append([
            hp.nside2pixarea(fine) * seen @ sky,
            hp.nside2pixarea(nside) * averaged(seen) @ coarse_nested,
            hp.nside2pixarea(nside) * fringes(coarse_directions, *geometry) @ coarse,
        ])
    for name, f, e in zip(("fine", "average", "centre"), np.array(found).T, np.array(expected).T):
        report(name, f, e)
