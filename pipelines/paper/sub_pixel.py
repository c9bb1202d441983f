#!/usr/bin/env python3
"""The appendix's N_b and Sigma_b by its formulas, N_b = sum over l, m of conj(Delta b) Delta b' C_l, in numpy and healpy.

    python3 pipelines/paper/sub_pixel.py matrix 8 SKY.fits
    python3 pipelines/paper/sub_pixel.py map 8 SKY.fits [BASELINES]

report.py makes the sky. Delta b is a fringe over pixels of nside 128 less the model's row, by pixel centres and averaged; C_l is the sky's
own. `matrix` takes 800 instants of one window of the pair whose length is nearest b_p there, and draws the matrices, each on its own scale,
as out/sub-pixel-matrix.png; `map` takes random instants of all pairs with b < 2 b_p, and R = 1e-4 W_max I. Beside the formulas stand the
residuals V - B T of the sky itself.
"""

import struct
import sys
import zlib
from pathlib import Path

import healpy as hp
import numpy as np

from dense import HALF_BREATH, LIGHT, fine_directions, fine_row, observes, positions, sampled_pairs, weight

MHZ, FINE, INSTANTS, EPSILON = 10.0, 128, 800, 1e-4
METHODS = ("centre", "average")
WAVELENGTH = LIGHT / (1e6 * MHZ)
# Pixels whose variance `map` sums: each takes one map of the fine pixels.
PIXELS_MAX = 192


class Sky:
    """A map on the fine pixels, NESTED, with its own C_l."""

    def __init__(self, nside, path):
        self.nside, self.fine = nside, FINE
        ring = hp.ud_grade(hp.read_map(path, dtype=np.float64), self.fine)
        self.l_max = 2 * self.fine
        self.cl = hp.anafast(ring, lmax=self.l_max)
        self.values = hp.reorder(ring, r2n=True).astype(np.float32)
        self.area = hp.nside2pixarea(self.fine)
        self.directions = fine_directions(self.fine)
        self.centres = fine_directions(nside)
        self.nested = hp.ring2nest(self.fine, np.arange(hp.nside2npix(self.fine)))
        l, m = hp.Alm.getlm(self.l_max)
        self.root = np.sqrt(self.cl[l] * np.where(m > 0, 2, 1)).astype(np.float32)

    def rows(self, pair):
        """Both parts of the fringe over the fine pixels, and of the models: at centres and averaged."""
        parts = [part.reshape(-1, (self.fine // self.nside) ** 2) for part in fine_row(self.directions, *pair, WAVELENGTH)]
        return parts, (fine_row(self.centres, *pair, WAVELENGTH), [part.mean(1) for part in parts])

    def weighted_alm(self, field):
        """Real vector whose products are sums over l and m of conj(a) b C_l."""
        alm = hp.map2alm(field.ravel()[self.nested], lmax=self.l_max, iter=0).astype(np.complex64) * self.root
        return np.concatenate([alm.real, alm.imag])


def write_png(path, values):
    """Values of -1 to 1: blue through white to red."""
    size = np.clip(np.abs(values), 0, 1)[..., None]
    ends = np.where(values[..., None] > 0, [178, 24, 43], [33, 102, 172])
    rgb = (255 * (1 - size) + ends * size).astype(np.uint8)
    raw = b"".join(b"\0" + row.tobytes() for row in rgb)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", rgb.shape[1], rgb.shape[0], 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw, 9)) + chunk(b"IEND", b"")
    Path(path).write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def near_bp(bp):
    """The window of the first breathing with the pair nearest b_p in its middle: pair, start and end."""
    seen = [t for t in np.arange(0, HALF_BREATH, 60.0) if observes(t)]
    breaks = [0, *[k for k in range(1, len(seen)) if seen[k] - seen[k - 1] > 60], len(seen)]
    windows = [(seen[a], seen[b - 1]) for a, b in zip(breaks, breaks[1:])]

    def distance(i, j, window):
        where = positions(sum(window) / 2)
        return abs(np.linalg.norm(where[i] - where[j]) / bp - 1)

    found = [(distance(i, j, w), i, j, w) for w in windows for i in range(8) for j in range(i + 1, 8)]
    return min(found)[1:]


def matrix(sky):
    bp = WAVELENGTH / np.sqrt(4 * np.pi / hp.nside2npix(sky.nside))
    i, j, (start, end) = near_bp(bp)
    instants = start + (np.arange(INSTANTS) + 0.5) / INSTANTS * (end - start)
    pairs = [(positions(t)[i], positions(t)[j]) for t in instants]
    length = np.linalg.norm(pairs[INSTANTS // 2][0] - pairs[INSTANTS // 2][1])
    vectors, residual = np.empty((2, 2 * INSTANTS, 2 * sky.root.size), np.float32), np.empty((2, 2, INSTANTS))
    visibilities = np.empty((2, INSTANTS))
    for k, pair in enumerate(pairs):
        parts, models = sky.rows(pair)
        for part in range(2):
            visibilities[part, k] = sky.area * (parts[part].ravel() @ sky.values)
            for method in range(2):
                deviation = parts[part] - models[method][part][:, None]
                vectors[method, part * INSTANTS + k] = sky.weighted_alm(deviation)
                residual[method, part, k] = sky.area * (deviation.ravel() @ sky.values)
    power = (visibilities**2).mean()
    print(f"pair {i + 1}-{j + 1}, {length / bp:.3f} b_p, {INSTANTS} instants of {(end - start) / 60:.0f} min; |V| {np.sqrt(2 * power):.3e} K sr rms")
    print("| rows | sqrt(N_b / V) | the same of residuals | correlation at lags 1, 4, 16, 64 by N_b | of residuals | mean abs(correlation) |\n|---|---|---|---|---|---|")
    panels, lags = [], (1, 4, 16, 64)
    for method, name in enumerate(METHODS):
        n_b = vectors[method] @ vectors[method].T
        diagonal, found = np.diag(n_b), residual[method]
        same = [n_b[:INSTANTS, :INSTANTS], n_b[INSTANTS:, INSTANTS:]]
        formula = [sum(np.diag(part, lag).mean() for part in same) / (2 * diagonal.mean()) for lag in lags]
        simulated = [(found[:, lag:] * found[:, :-lag]).mean() / (found**2).mean() for lag in lags]
        correlation = n_b / np.sqrt(np.outer(diagonal, diagonal))
        text = [", ".join(f"{x:.2f}" for x in values) for values in (formula, simulated)]
        amplitudes = [np.sqrt(x / power) for x in (diagonal.mean(), (found**2).mean())]
        print(f"| {name} | {amplitudes[0]:.3f} | {amplitudes[1]:.3f} | {text[0]} | {text[1]} | {np.abs(np.tril(correlation, -1)).sum() / (INSTANTS * (2 * INSTANTS - 1)):.3f} |")
        panels.append(n_b.reshape(400, 4, 400, 4).mean((1, 3)))
    # Each on its own scale: averaged rows err too little to be seen on that of centres.
    panels = [panel / np.abs(panel).max() for panel in panels]
    write_png("out/sub-pixel-matrix.png", np.hstack([panels[0], np.zeros((400, 8)), panels[1]]))


def error_map(sky, wanted):
    limit = 2 * WAVELENGTH / np.sqrt(4 * np.pi / hp.nside2npix(sky.nside))
    pairs, pair_time = sampled_pairs(limit, wanted)
    pixels = hp.nside2npix(sky.nside)
    shown = np.unique(np.linspace(0, pixels - 1, PIXELS_MAX).astype(int))
    models = [sky.rows(pair)[1] for pair in pairs]
    scale = weight(MHZ, pair_time, len(pairs))
    print("| nside | rows | visibilities | Sigma_b, K rms | error by the sky's residuals, K rms |\n|---|---|---|---|---|")
    for method, name in enumerate(METHODS):
        rows = np.array([part for model in models for part in model[method]]) * hp.nside2pixarea(sky.nside)
        normal = (rows.T @ rows).astype(float) * scale
        regularised = normal + EPSILON * np.linalg.eigvalsh(normal)[-1] * np.eye(pixels)
        a = np.linalg.solve(regularised, rows.T.astype(float) * scale)
        chosen, fields = a[shown].astype(np.float32), np.zeros((len(shown), sky.values.size), np.float32)
        residual = []
        for first in range(0, len(pairs), 50):
            batch = [sky.rows(pair) for pair in pairs[first : first + 50]]
            deviations = np.array([(part - model[:, None]).ravel() for p, m in batch for part, model in zip(p, m[method])])
            fields += chosen[:, 2 * first : 2 * first + len(deviations)] @ deviations.astype(np.float32)
            residual += list(sky.area * (deviations @ sky.values))
        variance = [(sky.weighted_alm(field).astype(float) ** 2).sum() for field in fields]
        error = a @ np.array(residual)
        print(f"| {sky.nside} | {name} | {len(pairs):,} | {np.sqrt(np.mean(variance)):.2e} | {np.sqrt((error**2).mean()):.2e} |")


if __name__ == "__main__":
    task, sky = sys.argv[1], Sky(int(sys.argv[2]), sys.argv[3])
    matrix(sky) if task == "matrix" else error_map(sky, int(sys.argv[4]) if len(sys.argv) > 4 else 3000)
