"""Earth and Sun as astropy has them.

usage: bodies.py FILE

Writes, for dates of 2020 to 2040: f64, TAI since 1958-01-01 in s, then unit vectors from the Moon's centre to the Earth and to the
Sun, geometric, on the axes of the ecliptic of J2000.
"""

import sys

import numpy as np
from astropy.coordinates import get_body_barycentric
from astropy.time import Time, TimeDelta

times = Time("2020-01-01", scale="utc") + TimeDelta(np.arange(0.0, 7671.0, 6.37), format="jd", scale="tai")
moon, earth, sun = (get_body_barycentric(body, times).xyz.to_value("m") for body in ("moon", "earth", "sun"))
tilt = np.radians(84381.448 / 3600)
turn = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
towards = [turn @ (body - moon) / np.linalg.norm(body - moon, axis=0) for body in (earth, sun)]
seconds = (times - Time("1958-01-01", scale="tai")).to_value("s")
np.concatenate([seconds[None], *towards]).T.astype("<f8").tofile(sys.argv[1])
