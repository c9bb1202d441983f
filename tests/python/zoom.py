"""Images of `lunarray zoom` by astropy: sources of the table lie where the image's coordinates say, with their fluxes at their maxima."""

import csv
import sys

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.io.votable import parse_single_table
from astropy.wcs import WCS

folder, catalogue = sys.argv[1:]
with fits.open(f"{folder}/image.fits") as opened:
    image, header = opened[0].data, opened[0].header
wcs = WCS(header)
assert header["BUNIT"] == "Jy/beam" and header["BMAJ"] >= header["BMIN"] > 0
table = parse_single_table(f"{folder}/sources.vot").to_table()
with open(f"{folder}/sources.csv") as file:
    lines = list(csv.DictReader(file))
assert len(lines) == len(table) == 6, (len(lines), len(table))
with open(catalogue) as file:
    known = {line["name"]: line for line in csv.DictReader(file)}
sigma = fits.getdata(f"{folder}/sigma.fits")
for row, line in zip(table, lines):
    assert abs(row["ra_deg"] - float(line["ra_deg"])) < 1e-6
    truth = known[row["known_name"]]
    at = SkyCoord(float(truth["ra"]), float(truth["dec"]), unit="deg", frame="fk5")
    x, y = (float(value) for value in wcs.world_to_pixel(at))
    i, j = round(x), round(y)
    near = image[j - 1 : j + 2, i - 1 : i + 2]
    peak = np.unravel_index(np.nanargmax(near), near.shape)
    # The maximum is in the pixel of the source, or next to it if that is near its side.
    assert abs(i + peak[1] - 1 - x) < 1 and abs(j + peak[0] - 1 - y) < 1, (row["known_name"], x, y, peak)
    # A beam is two pixels or more: half a pixel of each axis beside the peak are 0.7 of it.
    flux = float(truth["flux_10mhz_jy"])
    noise = 5 * sigma[j, i]
    assert 0.6 * flux - noise < near.max() < flux + noise, (row["known_name"], near.max(), flux)
    # By the table: separation as astropy's.
    found = SkyCoord(row["ra_deg"], row["dec_deg"], unit="deg", frame="fk5")
    # l and m are not quite angles: 1 - cos 1 deg of the separation.
    apart = found.separation(at).arcsec
    assert abs(apart - row["known_distance_arcsec"]) < 1e-3 * apart + 1e-3
beam = fits.getdata(f"{folder}/beam.fits")
centre = tuple(int(header[key]) - 1 for key in ("CRPIX2", "CRPIX1"))
assert abs(beam[centre] - 1) < 1e-4 and np.nanmax(beam) == beam[centre]
