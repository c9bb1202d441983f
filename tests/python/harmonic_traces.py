"""Eigenvalues of BtN^-1B over harmonics, from rows of B one by one in float64.

Reads a JSON object from standard input: `l_max`, `frequency_hz`, and `visibilities` as [i, j, time_s, weight] with
daughters from 0. Writes the eigenvalues over the orthonormal harmonics up to l_max, rising, as a list.

Shares nothing with the program: positions from the orbit's equations, patterns by quadrature with exact edges, rotations
by the eigenvectors of J_y.
"""

import json
import sys
from math import asin, cos, pi, sin, sqrt

import numpy as np

MOON, ALTITUDE = 1737.1e3, 300e3
RADIUS = MOON + ALTITUDE
INCLINATION = np.radians(30.0)
ORBIT_S, PRECESSION_S = 8248.68, 1.3 * 365.25 * 86400
BREATH_S = 14 * 86400.0
LIGHT = 299792458.0
RATIOS = [1.0, 6.0] + 6 * [3.0]


def arcs():
    """Arcs at the epoch: s_2 = 600 m, s_3 - s_2 = 1500 m, s_8 = 100 km, a geometric series from s_2 on."""
    low, high = 1.0 + 1e-9, 10.0
    # a0 (q - 1) = 1500, a0 (q^6 - 1) = 100e3 - 600.
    for _ in range(200):
        q = 0.5 * (low + high)
        low, high = (q, high) if (q**6 - 1) / (q - 1) < 99400.0 / 1500.0 else (low, q)
    scale = 1500.0 / (q - 1)
    return [0.0] + [600.0 - scale + scale * q**n for n in range(7)]


ARCS = arcs()


def phase(n, t):
    x = 2.0 * (t % BREATH_S) / BREATH_S
    x = x if x <= 1 else 2 - x
    arc = ARCS[n] * (1.0 + (1.0 / RATIOS[n] - 1.0) * x)
    return 2 * pi * t / ORBIT_S - arc / RADIUS


def legendre(l_max, theta):
    """Orthonormal Y_lmu(theta, 0) as [l][mu >= 0][theta]."""
    x, s = np.cos(theta), np.sin(theta)
    y = np.zeros((l_max + 1, l_max + 1, len(theta)))
    y[0, 0] = sqrt(1 / (4 * pi))
    for m in range(1, l_max + 1):
        y[m, m] = -sqrt((2 * m + 1) / (2 * m)) * s * y[m - 1, m - 1]
    for m in range(l_max + 1):
        for l in range(m + 1, l_max + 1):
            a = sqrt((4 * l * l - 1) / (l * l - m * m))
            before = y[l - 2, m] * sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) if l > m + 1 else 0.0
            y[l, m] = a * (x * y[l - 1, m] - before)
    return y


def patterns(l_max, u, wavelength):
    """f_lmu(u) as [l][mu + l_max]: the integral of S_i S_j exp(-2 pi i u n_y) conj(Y_lmu)."""
    nodes = 60 + int(9 * u)
    half = asin(0.5 * u * wavelength / RADIUS)
    cosa = sqrt(1 - (MOON / RADIUS) ** 2)
    t, w = np.polynomial.legendre.leggauss(nodes)
    # Each daughter sees |phi -+ half| < acos(-cosa / sin(theta)): everything up to sin(theta) = cosa, where the range begins
    # to shrink as a root. Up to cosa / cos(half) a sliver behind is left between the two ranges that are hidden.
    edge, sliver = asin(cosa), asin(cosa / cos(half))
    roots = [0.0, sqrt(sliver - edge), sqrt(0.5 * pi - edge)]
    pieces = [(0.5 * edge * (t + 1), 0.5 * edge * w, 0.0, lambda limb: np.full_like(limb, pi))]
    for low, high in zip(roots, roots[1:]):
        r = low + 0.5 * (high - low) * (t + 1)
        pieces.append((edge + r * r, (high - low) * r * w, 0.0, lambda limb: limb - half))
        if low == 0.0:
            pieces.append((edge + r * r, (high - low) * r * w, pi, lambda limb: limb + half - pi))
    f = np.zeros((l_max + 1, 2 * l_max + 1))
    for theta, weight, middle, width in pieces:
        s = np.sin(theta)
        most = width(np.arccos(np.clip(-cosa / s, -1, 1)))
        phi = middle + most[:, None] * t[None, :]
        area = weight[:, None] * s[:, None] * most[:, None] * w[None, :]
        wave = 2 * pi * u * s[:, None] * np.sin(phi)
        y = legendre(l_max, theta)
        for mu in range(l_max + 1):
            # S is even in phi, and the whole even under n_z -> -n_z: both hemispheres, cosines and real values alone.
            plus = (np.cos(wave + mu * phi) * area).sum(1)
            minus = (np.cos(wave - mu * phi) * area).sum(1)
            for l in range(mu, l_max + 1, 2):
                f[l, l_max + mu] += 2 * (y[l, mu] * plus).sum()
                if mu > 0:
                    f[l, l_max - mu] += 2 * (-1) ** mu * (y[l, mu] * minus).sum()
    return f


def wigner(l, beta):
    """d^l_{m mu}(beta) for m, mu = -l .. l: exp(-i beta J_y)."""
    m = np.arange(-l, l)
    up = np.sqrt(l * (l + 1) - m * (m + 1.0))
    j_y = np.zeros((2 * l + 1, 2 * l + 1), complex)
    for k, a in enumerate(up):
        j_y[k + 1, k] = a / 2j
        j_y[k, k + 1] = -a / 2j
    values, vectors = np.linalg.eigh(j_y)
    return ((vectors * np.exp(-1j * beta * values)) @ vectors.conj().T).real


def normal_matrix(l_max, frequency, visibilities):
    wavelength = LIGHT / frequency
    states = []
    for i, j, t, weight in visibilities:
        phi_i, phi_j = phase(i, t), phase(j, t)
        b = 2 * RADIUS * sin(0.5 * (phi_i - phi_j))
        node = -2 * pi * t / PRECESSION_S
        states.append((b / wavelength, 0.5 * (phi_i + phi_j) + pi / 2, node - pi / 2, weight))
    u = np.array([s[0] for s in states])
    gamma = np.array([s[1] for s in states])
    alpha = np.array([s[2] for s in states])
    weight = np.array([s[3] for s in states])
    # Entire functions of u: Chebyshev interpolation converges beyond half a node a radian of 2 pi u.
    low, high = 0.99 * u.min(), 1.01 * u.max()
    count = int(4 * pi * (high - low) / 2) + 60
    at = np.cos(pi * (np.arange(count) + 0.5) / count)
    table = np.array([patterns(l_max, 0.5 * (low + high) + 0.5 * (high - low) * x, wavelength) for x in at])
    flat = table.reshape(count, -1)
    chebyshev = np.cos(np.outer(np.arccos((2 * u - low - high) / (high - low)), np.arange(count)))
    at_nodes = np.cos(np.outer(np.arccos(at), np.arange(count)))
    f = (chebyshev @ np.linalg.solve(at_nodes, flat)).reshape(len(u), l_max + 1, 2 * l_max + 1)
    # Coefficients of conj(T_lm): c_lm = exp(-i m alpha) sum_mu d^l_{m mu} exp(-i mu gamma) f_lmu.
    orders = np.arange(-l_max, l_max + 1)
    spin = np.exp(-1j * np.outer(gamma, orders))
    rows = np.zeros((len(u), (l_max + 1) ** 2), complex)
    at = 0
    for l in range(l_max + 1):
        own = slice(l_max - l, l_max + l + 1)
        c = (f[:, l, own] * spin[:, own]) @ wigner(l, INCLINATION).T
        c = c * np.exp(-1j * np.outer(alpha, np.arange(-l, l + 1)))
        rows[:, at] = c[:, l]
        for m in range(1, l + 1):
            plus, minus = c[:, l + m], (-1) ** m * c[:, l - m]
            # x conj(c T) of T = (a + i b) / sqrt 2, with T_l-m = (-1)^m conj(T_lm).
            rows[:, at + 2 * m - 1] = (plus + minus) / sqrt(2)
            rows[:, at + 2 * m] = -1j * (plus - minus) / sqrt(2)
        at += 2 * l + 1
    scaled = np.sqrt(weight)[:, None] * rows
    both = np.concatenate([scaled.real, scaled.imag])
    return both


def main():
    asked = json.load(sys.stdin)
    b = normal_matrix(asked["l_max"], asked["frequency_hz"], asked["visibilities"])
    w = np.zeros(b.shape[1])
    # Squares of singular values: small ones keep their digits.
    found = np.linalg.svd(b, compute_uv=False) ** 2
    w[: len(found)] = found
    json.dump(sorted(w.tolist()), sys.stdout)


if __name__ == "__main__":
    main()
