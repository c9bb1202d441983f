"""Visibilities and maps of satellites at any positions, by dense matrices that share nothing with the product.

usage: general_rows.py FOLDER L_MAX WAVELENGTH_M MOON_RADIUS_M REGULARISATION

Reads FOLDER/positions (6 f64 a row: r_i, r_j in m) and FOLDER/weights (f64, (K sr)^-2). Each row of B is an integral over the
directions that both satellites see, in polar coordinates about their common zenith: Gauss-Legendre from the zenith to the
limb, whose angle is solved for at each azimuth, and equal steps in azimuth. Harmonics are evaluated at the directions on
ecliptic axes, by recurrence.

Writes FOLDER/sky (the unknowns of a random sky), FOLDER/visibilities (re, im of B sky) and FOLDER/map (the solution of
(Bt W B + R) x = Bt W V). Unknowns: m after m, T_l0, then sqrt(2) Re T_lm and sqrt(2) Im T_lm of l = m, m + 1, ..
"""

import sys

import numpy as np

folder, l_max = sys.argv[1], int(sys.argv[2])
wavelength, moon, regularisation = (float(text) for text in sys.argv[3:6])
positions = np.fromfile(f"{folder}/positions").reshape(-1, 2, 3)
weights = np.fromfile(f"{folder}/weights")
unknowns = (l_max + 1) ** 2


def harmonics(n, values):
    """sum over directions of values times the real harmonics: the row of unknowns."""
    x, y, z = n
    row = np.empty(unknowns, complex)
    sectoral = np.full(z.shape, np.sqrt(1 / (4 * np.pi)), complex)
    place = 0
    for m in range(l_max + 1):
        if m > 0:
            # Condon-Shortley: Y_mm = -sqrt((2m+1)/(2m)) sin(theta) exp(i phi) Y_{m-1,m-1}
            sectoral = -np.sqrt((2 * m + 1) / (2 * m)) * (x + 1j * y) * sectoral
        before, now = np.zeros_like(sectoral), sectoral
        for l in range(m, l_max + 1):
            if l > m:
                a = np.sqrt((4 * l * l - 1) / (l * l - m * m))
                b = np.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))
                before, now = now, a * (z * now - b * before)
            if m == 0:
                row[place] = np.dot(values, now.real)
                place += 1
            else:
                row[place] = np.sqrt(2) * np.dot(values, now.real)
                row[place + 1] = -np.sqrt(2) * np.dot(values, now.imag)
                place += 2
    return row


def row(r_i, r_j):
    baseline = (r_i - r_j) / wavelength
    waves = l_max + 2 * np.pi * np.linalg.norm(baseline)
    up = r_i / np.linalg.norm(r_i) + r_j / np.linalg.norm(r_j)
    up /= np.linalg.norm(up)
    e1 = np.cross(up, [0.36, 0.48, 0.8])
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(up, e1)
    azimuths = int(waves * 1.1 + 6 * np.cbrt(waves) + 20)
    phi = 2 * np.pi * (np.arange(azimuths) + 0.5) / azimuths
    sideways = np.outer(np.cos(phi), e1) + np.outer(np.sin(phi), e2)
    edge = np.full(azimuths, np.pi)
    for r in (r_i, r_j):
        along, beside = r @ up, sideways @ r
        limb = -np.sqrt(r @ r - moon * moon)
        edge = np.minimum(edge, np.arctan2(beside, along) + np.arccos(limb / np.hypot(along, beside)))
    t, w = np.polynomial.legendre.leggauss(int(waves * 0.6 + 6 * np.cbrt(waves) + 20))
    zenith = 0.5 * np.outer(edge, t + 1)
    area = 0.5 * np.outer(edge, w) * np.sin(zenith) * (2 * np.pi / azimuths)
    n = np.cos(zenith)[None] * up[:, None, None] + np.sin(zenith)[None] * sideways.T[:, :, None]
    n = n.reshape(3, -1)
    fringe = np.exp(-2j * np.pi * (baseline @ n))
    return harmonics(n, area.ravel() * fringe)


b = np.array([row(r_i, r_j) for r_i, r_j in positions])
random = np.random.default_rng(7)
degree = np.concatenate(
    [np.arange(l_max + 1)] + [np.repeat(np.arange(m, l_max + 1), 2) for m in range(1, l_max + 1)]
)
sky = random.standard_normal(unknowns) * 1e5 / (degree + 1.0) ** 1.35
sky[0] = 1e6
visibilities = b @ sky
matrix = (b.conj().T @ (weights[:, None] * b)).real + regularisation * np.eye(unknowns)
right = (b.conj().T @ (weights * visibilities)).real
solution = np.linalg.solve(matrix, right)
sky.tofile(f"{folder}/sky")
visibilities.tofile(f"{folder}/visibilities")
solution.tofile(f"{folder}/map")
print(np.linalg.eigvalsh(matrix)[-1] - regularisation)
