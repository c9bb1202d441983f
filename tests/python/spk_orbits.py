"""SPK kernels of satellites about the Moon, written and read by NAIF's toolkit (spiceypy).

usage: spk_orbits.py FOLDER

Three satellites on ellipses, half a day. Writes FOLDER/NAME.bsp and FOLDER/NAME.truth for segments of the types 2, 3, 8, 9, 12 and 13,
for two segments that overlap, and for the axes of the equator: f64, time in s (TT) after the beginning, then x, y, z in m of each
satellite on ecliptic axes, as `spkgps` gives them.
"""

import sys
from pathlib import Path

import numpy as np
import spiceypy as spice

folder = Path(sys.argv[1])
GM = 4902.800118
BEGIN, SPAN = 978_264_000.0, 43_200.0
END = BEGIN + SPAN
OBJECTS = [-1001, -1002, -1003]
# TDB of the toolkit, as in naif0012.tls.
spice.pdpool("DELTET/DELTA_T_A", [32.184])
spice.pdpool("DELTET/K", [1.657e-3])
spice.pdpool("DELTET/EB", [1.671e-2])
spice.pdpool("DELTET/M", [6.239996, 1.99096871e-7])
spice.pdpool("DELTET/DELTA_AT", [37.0, 536_500_800.0])


def states(k, times):
    """States of an ellipse at times, km and km/s; `conics` has the elements."""
    elements = [2010.0 + 5 * k, 0.012, 1.1 + 1e-3 * k, 0.3, 0.5, 1e-3 * k, BEGIN, GM]
    return np.array([spice.conics(elements, et) for et in times])


def chebyshev(k, columns, step, terms):
    """Coefficients for stretches of `step`: (stretches, columns, terms)."""
    nodes = np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    found = []
    for n in range(int(SPAN / step)):
        values = states(k, BEGIN + step * (n + 0.5 + nodes / 2))[:, :columns]
        found.append(np.polynomial.chebyshev.chebfit(nodes, values, terms - 1).T)
    return np.array(found)


def write(name, segments, frame="ECLIPJ2000"):
    path = str(folder / f"{name}.bsp")
    handle = spice.spkopn(path, name, 4096)
    for kind, k, begin, end in segments:
        fixed = [OBJECTS[k], 301, frame, begin, end, f"type {kind}"]
        times = np.arange(BEGIN, BEGIN + SPAN + 1, 60.0)
        if kind in (2, 3):
            step, terms = 600.0, 14
            found = chebyshev(k, 3 if kind == 2 else 6, step, terms)
            writer = spice.spkw02 if kind == 2 else spice.spkw03
            writer(handle, *fixed, step, len(found), terms - 1, found.ravel(), BEGIN)
        elif kind in (8, 12):
            writer = spice.spkw08 if kind == 8 else spice.spkw12
            writer(handle, *fixed, 9 if kind == 8 else 7, len(times), states(k, times), BEGIN, 60.0)
        else:
            # Uneven steps.
            steps = np.random.default_rng(k).uniform(30, 90, 900)
            times = np.concatenate([[BEGIN], BEGIN + SPAN / steps.sum() * np.cumsum(steps)])
            times[-1] = END
            writer = spice.spkw09 if kind == 9 else spice.spkw13
            writer(handle, *fixed, 9 if kind == 9 else 7, len(times), states(k, times), times)
    spice.spkcls(handle)
    spice.furnsh(path)
    truth = []
    for et in BEGIN + np.random.default_rng(5).uniform(0, SPAN, 150):
        t = spice.unitim(et, "ET", "TDT") - spice.unitim(BEGIN, "ET", "TDT")
        places = [1e3 * np.array(spice.spkgps(one, et, "ECLIPJ2000", 301)[0]) for one in OBJECTS]
        truth.append(np.concatenate([[t], *places]))
    np.array(truth).tofile(folder / f"{name}.truth")
    spice.unload(path)


for kind in (2, 3, 8, 9, 12, 13):
    write(f"type{kind}", [(kind, k, BEGIN, END) for k in range(3)])
write("equator", [(13, k, BEGIN, END) for k in range(3)], frame="J2000")
overlap = [(9, k, BEGIN, END) for k in range(3)] + [(12, 1, BEGIN + 9000, BEGIN + 20_000), (8, 1, BEGIN + 15_000, END)]
write("overlap", overlap)
