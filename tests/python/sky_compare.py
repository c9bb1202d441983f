"""Spectra of maps by healpy, each of its own pixels.

sky_compare.py MAP TRUTH L_MAX [NOISE]: prints a JSON object with rho, and snr with a noise map, as lists by degree.
sky_compare.py --process MAP SPLIT FWHM_DEG: prints the map with split pixels, smoothed, as a list in RING order.
"""

import json
import sys

import healpy
import numpy as np


def read(path):
    return healpy.read_map(path, dtype=np.float64)


def main():
    if sys.argv[1] == "--process":
        path, split, fwhm = sys.argv[2], int(sys.argv[3]), float(sys.argv[4])
        m = read(path)
        fine = healpy.ud_grade(m, split * healpy.get_nside(m))
        print(json.dumps(healpy.smoothing(fine, fwhm=np.radians(fwhm)).tolist()))
        return
    l_max = int(sys.argv[3])
    alms = [healpy.map2alm(read(path), lmax=l_max, iter=3) for path in [*sys.argv[1:3], *sys.argv[4:]]]
    cross = healpy.alm2cl(alms[0], alms[1])
    own = [healpy.alm2cl(alm) for alm in alms]
    found = {"rho": (cross / np.sqrt(own[0] * own[1])).tolist()}
    if len(alms) > 2:
        found["snr"] = (cross / np.sqrt(own[1] * own[2])).tolist()
    print(json.dumps(found))


if __name__ == "__main__":
    main()
