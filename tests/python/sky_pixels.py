"""Numbers of pixels by healpy.

usage: sky_pixels.py FOLDER NSIDE...
For each NSIDE, files of raw little-endian int64 in FOLDER: nested_NSIDE, the NESTED number of every RING pixel, and pixels_NSIDE,
the RING pixel of each of the directions of raw float64 in directions_NSIDE, of which every fourth lies close to a pole.
"""

import sys
from pathlib import Path

import healpy as hp
import numpy as np


def main(folder, nsides):
    rng = np.random.default_rng(3)
    for nside in nsides:
        hp.ring2nest(nside, np.arange(12 * nside**2)).astype("<i8").tofile(folder / f"nested_{nside}")
        directions = rng.uniform(-1, 1, (20000, 3))
        directions[::4, :2] *= 1e-4
        directions.astype("<f8").tofile(folder / f"directions_{nside}")
        hp.vec2pix(nside, *directions.T).astype("<i8").tofile(folder / f"pixels_{nside}")


main(Path(sys.argv[1]), [int(nside) for nside in sys.argv[2:]])
