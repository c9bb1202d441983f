"""Pieces of a map by the projectors behind healpy's gnomview and cartview (which need matplotlib to draw).

usage: cutouts.py MAP.fits TABLE.csv PROJECTION LON LAT SIZE_DEG PIXELS

The map and the centre are Galactic. Prints the share of pixels in which the table's last column differs.
"""

import sys

import healpy as hp
import numpy as np
from healpy.projector import CartesianProj, GnomonicProj

path, table, projection = sys.argv[1:4]
lon, lat, size = (float(text) for text in sys.argv[4:7])
pixels = int(sys.argv[7])
sky = hp.read_map(path, dtype=np.float64)
if projection == "gnomonic":
    projector = GnomonicProj(rot=(lon, lat), xsize=pixels, ysize=pixels, reso=60 * size / pixels)
else:
    half = 0.5 * size * (1 - 1 / pixels)
    projector = CartesianProj(rot=(lon, lat), xsize=pixels, ysize=pixels, lonra=[-half, half], latra=[-half, half])
expected = projector.projmap(sky, lambda x, y, z: hp.vec2pix(hp.get_nside(sky), x, y, z))
found = np.loadtxt(table, delimiter=",", skiprows=1)[:, -1].reshape(pixels, pixels)
# Nine digits are written.
print((np.abs(found - np.asarray(expected)) > 1e-8 * np.abs(sky).max()).mean())
