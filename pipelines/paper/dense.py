#!/usr/bin/env python3
"""The paper's traces and map noise by dense matrices over pixels, in numpy and healpy: shares no code with lunarray.

    python3 pipelines/paper/dense.py NSIDE MHZ [BASELINES]

Instants are random over 1.3 years while the Earth is hidden from daughter 1; every pair with b < 2 b_p gives a row of B,
averaged over pixels, with the weight of its time, 2 dnu t / T_sys^2. T_sys is the mean sky of Cane (1979) over the sky in sight.
"""

import sys

import healpy as hp
import numpy as np

nside, frequency = int(sys.argv[1]), 1e6 * float(sys.argv[2])
wanted = int(sys.argv[3]) if len(sys.argv) > 3 else {8: 1200}.get(nside, 3600)
LIGHT, BOLTZMANN = 299792458.0, 1.380649e-23
MOON, ALTITUDE, PERIOD, INCLINATION = 1737.1e3, 300e3, 8248.68, np.radians(30)
PRECESSION, MONTH, HALF_BREATH = 1.3 * 365.25 * 86400, 27.321661 * 86400, 7 * 86400
ARCS = np.array([0.0, *(-863.717 + 1463.717 * 2.02478845 ** np.arange(7))])
RATIOS = np.array([1, 6] + 6 * [3])
radius, wavelength = MOON + ALTITUDE, LIGHT / frequency
rng = np.random.default_rng(1)


def positions(t):
    into = t % (2 * HALF_BREATH)
    arcs = ARCS * (1 - (1 - 1 / RATIOS) * min(into, 2 * HALF_BREATH - into) / HALF_BREATH)
    f, node = 2 * np.pi * t / PERIOD - arcs / radius, -2 * np.pi * t / PRECESSION
    x, y = np.cos(f), np.sin(f) * np.cos(INCLINATION)
    return radius * np.stack(
        [np.cos(node) * x - np.sin(node) * y, np.sin(node) * x + np.cos(node) * y, np.sin(f) * np.sin(INCLINATION)], 1
    )


def sky(nu):
    tau = 5 * nu**-2.1
    brightness = 2.48e-20 * nu**-0.52 * (1 - np.exp(-tau)) / tau + 1.06e-20 * nu**-0.80 * np.exp(-tau)
    return brightness * LIGHT**2 / (2 * BOLTZMANN * (1e6 * nu) ** 2)


fine, pixels = max(64, 4 * nside), hp.nside2npix(nside)
directions = np.array(hp.pix2vec(fine, np.arange(hp.nside2npix(fine)), nest=True)).T.copy()
dip = np.sqrt(radius**2 - MOON**2)
limit = 2 * wavelength / np.sqrt(4 * np.pi / pixels)
rows, tried = [], 0
while len(rows) < 2 * wanted:
    t = rng.uniform(0, PRECESSION)
    tried += 1
    where = positions(t)
    earth = np.array([np.cos(2 * np.pi * t / MONTH), np.sin(2 * np.pi * t / MONTH), 0])
    if -(where[0] @ earth) <= dip:
        continue
    for i in range(8):
        for j in range(i + 1, 8):
            baseline = where[i] - where[j]
            if np.linalg.norm(baseline) < limit:
                turns = directions @ (baseline / wavelength)
                phase = (-2 * np.pi * (turns - np.round(turns))).astype(np.float32)
                seen = (directions @ where[i] >= -dip) & (directions @ where[j] >= -dip)
                for part in (np.cos(phase), np.sin(phase)):
                    rows.append((seen * part).reshape(pixels, -1).mean(1, dtype=np.float32))
b = np.array(rows) * np.float32(4 * np.pi / pixels)
pair_time = PRECESSION * len(rows) / 2 / tried
mean = sky(frequency / 1e6)
seen_share = 0.5 * (1 + dip / radius)
t_sys = mean * 4 * np.pi * seen_share
normal = (b.T @ b).astype(float) * pair_time / (len(rows) / 2) * 2 * 8000 / t_sys**2
w = np.clip(np.linalg.eigvalsh(normal)[::-1], 0, None)
jansky = 5 * 2 * BOLTZMANN * (frequency / LIGHT) ** 2 / 1e-26
print(f"nside {nside}, {frequency / 1e6:g} MHz, b < {limit:.0f} m, {pair_time / 3600:.0f} pair hours, mean {mean:.3e} K")
print(f"radiometer, 5 sigma: {jansky * t_sys / np.sqrt(2 * 8000 * pair_time):.1f} Jy")
print("epsilon  Tr Sigma_n/K2  Tr Sigma_s  T2 Tr Sigma_s/K2  T of equality/K  5 sigma, Jy a pixel")
for epsilon in (1e-4, 3e-4, 1e-3, 2e-3, 3e-3, 1e-2, 3e-2, 1e-1):
    eps = epsilon * w[0]
    n, s = (w / (w + eps) ** 2).sum(), ((eps / (w + eps)) ** 2).sum()
    noise = jansky * np.sqrt(n / pixels) * 4 * np.pi / pixels
    print(f"{epsilon:.0e}  {n:.3e}  {s:.3e}  {mean**2 * s:.3e}  {np.sqrt(n / s):.3e}  {noise:.1f}")
