"""usage: sky_harmonics_time.py NSIDE L_MAX: least times of healpy's alm2map and map2alm (no iterations), s"""

import sys
import time

import healpy as hp
import numpy as np

nside, l_max = map(int, sys.argv[1:])
size = hp.Alm.getsize(l_max)
rng = np.random.default_rng(3)
alm = rng.normal(size=size) + 1j * rng.normal(size=size)


def best(run):
    times = []
    for _ in range(max(3, min(20, 1024 // nside))):
        start = time.perf_counter()
        result = run()
        times.append(time.perf_counter() - start)
    return min(times), result


seconds, values = best(lambda: hp.alm2map(alm, nside, lmax=l_max))
print(seconds, best(lambda: hp.map2alm(values, lmax=l_max, iter=0))[0])
