"""Orbits that lunarray wrote, as the package `oem` reads and interpolates them.

usage: oem_judge.py FOLDER

Reads FOLDER/sat1.oem .. sat3.oem and writes FOLDER/truth: f64, time in s after the first state, then x, y, z in m of each satellite on
ecliptic axes; and FOLDER/sat1.xml .. sat3.xml, the same messages as that package writes them.
"""

import sys
from pathlib import Path

import numpy as np
from astropy.time import TimeDelta
from oem import OrbitEphemerisMessage

folder = Path(sys.argv[1])
# Of ECLIPJ2000, as NAIF has it.
tilt = np.radians(84381.448 / 3600)
turn = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])

messages = [OrbitEphemerisMessage.open(str(folder / f"sat{n}.oem")) for n in (1, 2, 3)]
for n, message in enumerate(messages):
    message.save_as(str(folder / f"sat{n + 1}.xml"), file_format="xml")
start, stop = messages[0].span
rows = []
for t in np.random.default_rng(7).uniform(0, (stop - start).to_value("s"), 60):
    time = start + TimeDelta(t, format="sec")
    rows.append(np.concatenate([[t]] + [1e3 * turn @ message(time).position for message in messages]))
np.array(rows).tofile(folder / "truth")
print(start.utc.isot, len(list(messages[0].segments)))
