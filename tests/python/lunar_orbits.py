"""Orbits in the Moon's field and with the Earth's pull, by numerical integration that shares nothing with the product but the table
of coefficients.

usage: lunar_orbits.py TABLE DEGREE DAYS OUT          needs numpy

TABLE is src/core/array/propagate/grgm900c.rs, of which the numbers are read. Three satellites from Kepler elements. The pull is the gradient of the
potential in spherical coordinates, by Legendre functions of full norm; Adams, Bashforth and Moulton's method of eighth order with
steps of 30 s. OUT gets f64: time in s, then x, y, z in m of each satellite on ecliptic axes, at every 23rd step.
"""

import re
import sys

import numpy as np

table, degree, days, out = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
GM, RADIUS = 4.90279996708864e12, 1738.0e3
EARTH_GM, EARTH_DISTANCE, MONTH, EARTH_LONGITUDE = 3.986004355e14, 384.4e6, 27.321661 * 86400, np.radians(25)
STEP = 30.0

pairs = iter(re.findall(r"^    \[(\S+), (\S+)\],$", open(table).read(), re.M))
COS, SIN = np.zeros((2, degree + 1, degree + 2))
for n in range(2, degree + 1):
    for m in range(n + 1):
        COS[n, m], SIN[n, m] = map(float, next(pairs))


def legendre(sine, cosine):
    """Functions of full norm by degree and order; one order more than there is, which is 0."""
    p = np.zeros((degree + 1, degree + 2))
    p[0, 0] = 1
    for n in range(1, degree + 1):
        p[n, n] = cosine * (3**0.5 if n == 1 else ((2 * n + 1) / (2 * n)) ** 0.5) * p[n - 1, n - 1]
        m = np.arange(n)
        a = ((2 * n - 1) * (2 * n + 1) / ((n - m) * (n + m))) ** 0.5
        p[n, :n] = a * sine * p[n - 1, :n]
        if n > 1:
            b = ((2 * n + 1) * (n + m - 1) * np.maximum(n - m - 1, 0) / ((n - m) * (n + m) * (2 * n - 3))) ** 0.5
            p[n, :n] -= b * p[n - 2, :n]
    return p


N = np.arange(degree + 1)[:, None]
M = np.arange(degree + 1)[None, :]
RAISE = np.sqrt(np.maximum((N - M) * (N + M + 1), 0)) * np.where(M == 0, 0.5**0.5, 1)


def field(r):
    """Acceleration at a place on axes that turn with the Moon."""
    radius, flat = np.linalg.norm(r), np.hypot(r[0], r[1])
    sine, cosine = r[2] / radius, flat / radius
    longitude = np.arctan2(r[1], r[0])
    p = legendre(sine, cosine)
    functions = p[:, :-1]
    slopes = RAISE * p[:, 1:] - M * (sine / cosine) * functions
    c, s = np.cos(M * longitude), np.sin(M * longitude)
    waves = COS[:, :-1] * c + SIN[:, :-1] * s
    turned = M * (SIN[:, :-1] * c - COS[:, :-1] * s)
    fall = (RADIUS / radius) ** N
    outward = -GM / radius**2 * (1 + np.sum((N + 1) * fall * functions * waves))
    north = GM / radius**2 * np.sum(fall * slopes * waves)
    east = GM / radius**2 * np.sum(fall * functions * turned) / cosine
    cos, sin = np.cos(longitude), np.sin(longitude)
    return (
        outward * np.array([cosine * cos, cosine * sin, sine])
        + north * np.array([-sine * cos, -sine * sin, cosine])
        + east * np.array([-sin, cos, 0])
    )


def derivative(t, state):
    angle = EARTH_LONGITUDE + 2 * np.pi * t / MONTH
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    earth = EARTH_DISTANCE * np.array([c, s, 0])
    rows = []
    for r, v in state.reshape(-1, 2, 3):
        away = earth - r
        pull = EARTH_GM * (away / np.linalg.norm(away) ** 3 - earth / EARTH_DISTANCE**3)
        rows.append([v, turn @ field(turn.T @ r) + pull])
    return np.array(rows).reshape(-1, 6)


def runge_kutta(t, state, span, steps):
    h = span / steps
    for _ in range(steps):
        k1 = derivative(t, state)
        k2 = derivative(t + h / 2, state + h / 2 * k1)
        k3 = derivative(t + h / 2, state + h / 2 * k2)
        k4 = derivative(t + h, state + h * k3)
        state, t = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), t + h
    return state


def weights(nodes):
    """Integrals from 0 to 1 of the polynomials that are 1 at one of the nodes and 0 at the others."""
    return np.linalg.solve(np.vander(nodes, increasing=True).T, 1 / np.arange(1, len(nodes) + 1))


def elements(axis, e, inclination, node, periapsis, mean):
    i, o, w, mean = np.radians([inclination, node, periapsis, mean])
    anomaly = mean
    for _ in range(50):
        anomaly = mean + e * np.sin(anomaly)
    rate = np.sqrt(GM / axis**3) / (1 - e * np.cos(anomaly))
    b = axis * np.sqrt(1 - e * e)
    x, y = axis * (np.cos(anomaly) - e), b * np.sin(anomaly)
    vx, vy = -axis * rate * np.sin(anomaly), b * rate * np.cos(anomaly)

    def about(k, angle):
        c, s = np.cos(angle), np.sin(angle)
        return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]] if k == "z" else [[1, 0, 0], [0, c, -s], [0, s, c]])

    space = about("z", o) @ about("x", i) @ about("z", w)
    return np.concatenate([space @ [x, y, 0], space @ [vx, vy, 0]])


state = np.array(
    [
        elements(2037.1e3, 0.001, 30.0, 0.0, 0.0, 0.0),
        elements(2037.1e3, 0.05, 60.0, 110.0, 40.0, 200.0),
        elements(1900.0e3, 0.01, 85.0, 250.0, 300.0, 100.0),
    ]
)
forth, back = weights(np.arange(-7.0, 1)), weights(np.arange(-6.0, 2))
slopes = [derivative(0.0, state)]
rows = []
for step in range(int(days * 86400 / STEP)):
    t = STEP * step
    if step % 23 == 5:
        rows.append(np.concatenate([[t], state[:, :3].ravel()]))
    if len(slopes) < 8:
        state = runge_kutta(t, state, STEP, 20)
    else:
        guess = state + STEP * np.tensordot(forth, slopes, 1)
        after = slopes[1:] + [derivative(t + STEP, guess)]
        state = state + STEP * np.tensordot(back, after, 1)
    slopes = slopes[-7:] + [derivative(t + STEP, state)]
np.array(rows).tofile(out)
