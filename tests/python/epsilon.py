"""Residuals, influence traces, scores and Wiener maps by dense matrices in float64.

Reads a JSON object from standard input: `frequency_hz`, `visibilities` as [i, j, time_s, weight, re, im] with daughters from 0;
`nside` for a map of pixels with rows at their centres, or `l_max` for one of harmonics; `epsilons`; for harmonics also
`r_of_degree`, an R by degree. Writes for each epsilon the residual |V - B x|^2 of rows one by one, the square of the solution, the
trace of the influence matrix, generalised cross-validation and C_L, and for `r_of_degree` the solution of each unknown, m after m.

Shares nothing with the program: positions from the orbit's equations (harmonic_traces.py), pixel centres from healpy, solutions from
singular values of the rows, never from normal equations.
"""

import json
import sys

import healpy as hp
import numpy as np

from harmonic_traces import INCLINATION, LIGHT, MOON, PRECESSION_S, RADIUS, normal_matrix, phase


def position(n, t):
    f, node = phase(n, t), -2 * np.pi * t / PRECESSION_S
    x, y, z = np.cos(f), np.sin(f) * np.cos(INCLINATION), np.sin(f) * np.sin(INCLINATION)
    return RADIUS * np.array([np.cos(node) * x - np.sin(node) * y, np.sin(node) * x + np.cos(node) * y, z])


def pixel_rows(nside, frequency, visibilities):
    directions = np.array(hp.pix2vec(nside, np.arange(hp.nside2npix(nside))))
    dip = np.sqrt(RADIUS**2 - MOON**2)
    rows = []
    for i, j, t, weight in visibilities:
        r_i, r_j = position(i, t), position(j, t)
        seen = (r_i @ directions >= -dip) & (r_j @ directions >= -dip)
        wave = np.exp(-2j * np.pi * frequency / LIGHT * ((r_i - r_j) @ directions))
        rows.append(np.sqrt(weight) * seen * wave * hp.nside2pixarea(nside))
    rows = np.array(rows)
    return np.concatenate([rows.real, rows.imag])


def m_after_m(l_max):
    """Of each unknown in the program's order its place in the order of normal_matrix: l after l."""
    places = []
    for m in range(l_max + 1):
        for l in range(m, l_max + 1):
            places += [l * l] if m == 0 else [l * l + 2 * m - 1, l * l + 2 * m]
    return places


def main():
    asked = json.load(sys.stdin)
    frequency, seen = asked["frequency_hz"], np.array(asked["visibilities"])
    where = [(int(i), int(j), t, w) for i, j, t, w in seen[:, :4]]
    if "nside" in asked:
        b, area = pixel_rows(asked["nside"], frequency, where), 1.0
    else:
        b, area = normal_matrix(asked["l_max"], frequency, where), hp.nside2pixarea(asked["map_nside"])
    v = np.sqrt(seen[:, 3]) * (seen[:, 4] + 1j * seen[:, 5])
    v = np.concatenate([v.real, v.imag])
    u, s, vt = np.linalg.svd(b, full_matrices=False)
    n, answer = len(v), []
    for epsilon in asked["epsilons"]:
        eps = epsilon * s[0] ** 2
        x = vt.T @ (s / (s**2 + eps) * (u.T @ v))
        residual, trace = ((v - b @ x) ** 2).sum(), (s**2 / (s**2 + eps)).sum()
        answer.append({
            "residual": residual,
            "solution_k2": x @ x / area,
            "measured": trace,
            "cross_validation": n * residual / (n - trace) ** 2,
            "risk": residual + 2 * trace - n,
        })
    out = {"numbers": n, "data_power": v @ v, "epsilons": answer}
    if "r_of_degree" in asked:
        l_max = asked["l_max"]
        r = np.concatenate([np.full(2 * l + 1, asked["r_of_degree"][l]) for l in range(l_max + 1)])
        # The least squares of data and of R x = 0 together.
        x = np.linalg.lstsq(np.concatenate([b, np.diag(np.sqrt(r))]), np.concatenate([v, np.zeros(len(r))]), rcond=None)[0]
        out["unknowns"] = x[m_after_m(l_max)].tolist()
    json.dump(out, sys.stdout)


if __name__ == "__main__":
    main()
