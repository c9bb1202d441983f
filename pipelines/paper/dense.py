#!/usr/bin/env python3
"""The paper's traces, map noise and its scatter by dense matrices over pixels, in numpy and healpy: shares no code with lunarray.

    python3 pipelines/paper/dense.py NSIDE MHZ [BASELINES]

Instants are random over 1.3 years while the Earth is hidden from daughter 1; every pair with b < 2 b_p gives a row of B,
averaged over pixels, with the weight of its time, 2 dnu t / T_sys^2. T_sys is the mean sky of Cane (1979) over the sky in sight.
"""

import sys

import healpy as hp
import numpy as np

LIGHT, BOLTZMANN = 299792458.0, 1.380649e-23
MOON, ALTITUDE, PERIOD, INCLINATION = 1737.1e3, 300e3, 8248.68, np.radians(30)
PRECESSION, MONTH, HALF_BREATH = 1.3 * 365.25 * 86400, 27.321661 * 86400, 7 * 86400
ARCS = np.array([0.0, *(-863.717 + 1463.717 * 2.02478845 ** np.arange(7))])
RATIOS = np.array([1, 6] + 6 * [3])
RADIUS = MOON + ALTITUDE
DIP = np.sqrt(RADIUS**2 - MOON**2)


def positions(t):
    into = t % (2 * HALF_BREATH)
    arcs = ARCS * (1 - (1 - 1 / RATIOS) * min(into, 2 * HALF_BREATH - into) / HALF_BREATH)
    f, node = 2 * np.pi * t / PERIOD - arcs / RADIUS, -2 * np.pi * t / PRECESSION
    x, y = np.cos(f), np.sin(f) * np.cos(INCLINATION)
    return RADIUS * np.stack(
        [np.cos(node) * x - np.sin(node) * y, np.sin(node) * x + np.cos(node) * y, np.sin(f) * np.sin(INCLINATION)], 1
    )


def observes(t):
    """Whether the Earth is hidden from daughter 1."""
    earth = np.array([np.cos(2 * np.pi * t / MONTH), np.sin(2 * np.pi * t / MONTH), 0])
    return -(positions(t)[0] @ earth) > DIP


def mean_sky(mhz):
    tau = 5 * mhz**-2.1
    brightness = 2.48e-20 * mhz**-0.52 * (1 - np.exp(-tau)) / tau + 1.06e-20 * mhz**-0.80 * np.exp(-tau)
    return brightness * LIGHT**2 / (2 * BOLTZMANN * (1e6 * mhz) ** 2)


def fine_directions(fine):
    """Pixel centres in NESTED order: the children of a pixel follow each other."""
    return np.array(hp.pix2vec(fine, np.arange(hp.nside2npix(fine)), nest=True)).T.copy()


def fine_row(directions, one, other, wavelength):
    """Real and imaginary part of the fringe of two daughters over the sky that both see."""
    turns = directions @ ((one - other) / wavelength)
    phase = (-2 * np.pi * (turns - np.round(turns))).astype(np.float32)
    seen = (directions @ one >= -DIP) & (directions @ other >= -DIP)
    return seen * np.cos(phase), seen * np.sin(phase)


def sampled_pairs(limit, wanted):
    """Positions of pairs closer than a limit at random instants, and the time of all such pairs in 1.3 years."""
    rng, pairs, tried = np.random.default_rng(1), [], 0
    while len(pairs) < wanted:
        t = rng.uniform(0, PRECESSION)
        tried += 1
        if observes(t):
            where = positions(t)
            near = [(where[i], where[j]) for i in range(8) for j in range(i + 1, 8)]
            pairs += [pair for pair in near if np.linalg.norm(pair[0] - pair[1]) < limit]
    return pairs, PRECESSION * len(pairs) / tried


def weight(mhz, pair_time, pairs):
    """1 / sigma^2 of each part of a visibility that stands for its share of the time."""
    t_sys = mean_sky(mhz) * 4 * np.pi * 0.5 * (1 + DIP / RADIUS)
    return pair_time / pairs * 2 * 8000 / t_sys**2


def main():
    nside, mhz = int(sys.argv[1]), float(sys.argv[2])
    wanted = int(sys.argv[3]) if len(sys.argv) > 3 else {8: 1200}.get(nside, 3600)
    wavelength, pixels = LIGHT / (1e6 * mhz), hp.nside2npix(nside)
    directions = fine_directions(max(64, 8 * nside))
    limit = 2 * wavelength / np.sqrt(4 * np.pi / pixels)
    pairs, pair_time = sampled_pairs(limit, wanted)
    parts = (part for pair in pairs for part in fine_row(directions, *pair, wavelength))
    b = np.array([part.reshape(pixels, -1).mean(1, dtype=np.float32) for part in parts]) * np.float32(4 * np.pi / pixels)
    mean, per_part = mean_sky(mhz), weight(mhz, pair_time, len(pairs))
    w, modes = np.linalg.eigh((b.T @ b).astype(float) * per_part)
    w = np.clip(w, 0, None)
    jansky = 5 * 2 * BOLTZMANN * (1e6 * mhz / LIGHT) ** 2 / 1e-26
    print(f"nside {nside}, {mhz:g} MHz, b < {limit:.0f} m, {pair_time / 3600:.0f} pair hours, mean {mean:.3e} K")
    print(f"radiometer, 5 sigma: {jansky / np.sqrt(per_part * len(pairs)):.1f} Jy")
    print("epsilon  Tr Sigma_n/K2  Tr Sigma_s  T2 Tr Sigma_s/K2  T of equality/K  5 sigma, Jy a pixel  scatter of sigma, %")
    for epsilon in (1e-4, 3e-4, 1e-3, 2e-3, 3e-3, 1e-2, 3e-2, 1e-1):
        eps = epsilon * w[-1]
        sigma = np.sqrt(modes**2 @ (w / (w + eps) ** 2))
        n, s = (sigma**2).sum(), ((eps / (w + eps)) ** 2).sum()
        noise, scatter = jansky * np.sqrt(n / pixels) * 4 * np.pi / pixels, 100 * sigma.std() / sigma.mean()
        print(f"{epsilon:.0e}  {n:.3e}  {s:.3e}  {mean**2 * s:.3e}  {np.sqrt(n / s):.3e}  {noise:.1f}  {scatter:.1f}")


if __name__ == "__main__":
    main()
