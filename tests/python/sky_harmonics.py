"""Spherical harmonics by healpy.

usage: sky_harmonics.py FOLDER CASE...   with cases NSIDE:L_MAX
For each case, files of raw little-endian float64 in FOLDER: alm_CASE (real, imaginary, healpy's order), map_CASE (its
synthesis), cl_CASE (their spectrum), smooth_CASE (the synthesis with a beam of FWHM 0.1 rad), smoothing_CASE (the map
smoothed to that FWHM), rotated_CASE (the map turned from Galactic to ecliptic axes by interpolation), and up to
l_max = 3 nside - 1 noise_CASE (a map of white noise) and jacobi_CASE (its coefficients with iter=3).
"""

import sys
from pathlib import Path

import healpy as hp
import numpy as np


def main(folder, cases):
    rng = np.random.default_rng(2)
    for case in cases:
        nside, l_max = map(int, case.split(":"))
        name = case.replace(":", "_")

        def save(kind, values):
            values = np.ascontiguousarray(values)
            (values.view("<f8") if values.dtype == complex else values.astype("<f8")).tofile(folder / f"{kind}_{name}")

        size = hp.Alm.getsize(l_max)
        alm = rng.normal(size=size) + 1j * rng.normal(size=size)
        alm[: l_max + 1] = alm[: l_max + 1].real
        save("alm", alm)
        synthesis = hp.alm2map(alm, nside, lmax=l_max)
        save("map", synthesis)
        if l_max <= 3 * nside - 1:
            noise = rng.normal(size=12 * nside**2)
            save("noise", noise)
            save("jacobi", hp.map2alm(noise, lmax=l_max, iter=3))
        save("smooth", hp.alm2map(hp.smoothalm(alm, fwhm=0.1, inplace=False), nside, lmax=l_max))
        if nside <= 64:
            save("smoothing", hp.smoothing(synthesis, fwhm=0.1))
        save("rotated", hp.Rotator(coord=["G", "E"]).rotate_map_pixel(synthesis))
        save("cl", hp.alm2cl(alm))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
