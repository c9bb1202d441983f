"""Orbits of a year in the Moon's field as CCSDS OEM files, by numerical integration that shares nothing with the product.

usage: propagate.py FOLDER DAYS          needs numpy

Eight satellites that follow each other along one orbit 300 km above the Moon, with nobody to control them. Forces: the Moon's
field to degree and order 3 (GRAIL, Konopliv et al. 2013, J. Geophys. Res. Planets 118, 1415, rounded to five digits), its axis
taken as the pole of the ecliptic, and the Earth on a circle. Adams, Bashforth and Moulton's method of eighth order with steps of
60 s: 137 an orbit, each to some 1e-13. Writes FOLDER/sat1.oem .. sat8.oem: a state every two minutes on the axes of EME2000.
"""

import os
import sys

import numpy as np

GM, RADIUS = 4.902800118e12, 1738.0e3
EARTH_GM, EARTH_DISTANCE, MONTH = 3.986004418e14, 384.4e6, 27.321661 * 86400
# Normalised coefficients, and what takes them to Legendre functions without norm.
NORM = {"20": 5**0.5, "22": (10 / 24) ** 0.5, "30": 7**0.5, "31": (28 / 24) ** 0.5, "32": (14 / 120) ** 0.5, "33": (14 / 720) ** 0.5}
COS = {"20": -9.0880e-5, "22": 3.4674e-5, "30": -3.1973e-6, "31": 2.6368e-5, "32": 1.4171e-5, "33": 1.2275e-5}
SIN = {"31": 5.4545e-6, "32": 4.8780e-6, "33": -1.7744e-6}
C20, C22, C30, C31, C32, C33 = (COS[k] * NORM[k] for k in ("20", "22", "30", "31", "32", "33"))
S31, S32, S33 = (SIN[k] * NORM[k] for k in ("31", "32", "33"))

STEP = 60.0
EVERY = 2
AXIS, INCLINATION = 2037.1e3, np.radians(30)
# Arcs behind the first, m, so that pairs of many lengths are there though nothing breathes; each plane is inclined by 2 % of its arc.
ARCS = np.array([0, 100.0, 240.0, 480.0, 900.0, 1600.0, 2800.0, 5000.0])


def field(r):
    """Acceleration in axes that turn with the Moon, from harmonic polynomials: those of degree 2 and 3."""
    x, y, z = r.T
    square = np.sum(r * r, axis=1)
    flat = x * x + y * y
    two = C20 * (z * z - flat / 2) + 3 * C22 * (x * x - y * y)
    of_two = np.stack([-C20 * x + 6 * C22 * x, -C20 * y - 6 * C22 * y, 2 * C20 * z], axis=1)
    high = 4 * z * z - flat
    three = (
        C30 * z * (z * z - 1.5 * flat)
        + 1.5 * (C31 * x + S31 * y) * high
        + 15 * C32 * z * (x * x - y * y)
        + 30 * S32 * x * y * z
        + 15 * C33 * x * (x * x - 3 * y * y)
        + 15 * S33 * y * (3 * x * x - y * y)
    )
    linear = 1.5 * (C31 * x + S31 * y)
    of_three = np.stack(
        [
            -3 * C30 * x * z + 1.5 * C31 * high - 2 * x * linear + 30 * C32 * x * z + 30 * S32 * y * z
            + 45 * C33 * (x * x - y * y) + 90 * S33 * x * y,
            -3 * C30 * y * z + 1.5 * S31 * high - 2 * y * linear - 30 * C32 * y * z + 30 * S32 * x * z
            - 90 * C33 * x * y + 45 * S33 * (x * x - y * y),
            C30 * (3 * z * z - 1.5 * flat) + 8 * z * linear + 15 * C32 * (x * x - y * y) + 30 * S32 * x * y,
        ],
        axis=1,
    )
    out = -r / square[:, None] ** 1.5
    for degree, value, slope in ((2, two, of_two), (3, three, of_three)):
        fall = RADIUS**degree / square ** (degree + 0.5)
        out = out + fall[:, None] * (slope - (2 * degree + 1) * (value / square)[:, None] * r)
    return GM * out


def derivative(t, state):
    r = state[:, :3]
    angle = 2 * np.pi * t / MONTH
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    moon = field(r @ turn) @ turn.T
    earth = EARTH_DISTANCE * np.array([c, s, 0])
    away = earth - r
    pull = EARTH_GM * (away / np.sum(away**2, axis=1, keepdims=True) ** 1.5 - earth / EARTH_DISTANCE**3)
    return np.concatenate([state[:, 3:], moon + pull], axis=1)


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
    powers = np.vander(nodes, increasing=True).T
    return np.linalg.solve(powers, 1 / np.arange(1, len(nodes) + 1))


def start():
    """The state of each at the epoch: that of one orbit, as long before as its arc says."""
    speed = np.sqrt(GM / AXIS)
    early = -ARCS[-1] / speed - 1
    states = []
    for arc in ARCS:
        tilt = INCLINATION + 0.02 * arc / AXIS
        first = np.array([[AXIS, 0, 0, 0, speed * np.cos(tilt), speed * np.sin(tilt)]])
        states.append(runge_kutta(early, first, -arc / speed - early, 200)[0])
    return np.array(states)


def trajectory(days):
    """Times, s, and states: [time][satellite][x, y, z, and their rates]."""
    forth, back = weights(np.arange(-7.0, 1)), weights(np.arange(-6.0, 2))
    steps = int(days * 86400 / STEP) // EVERY * EVERY
    state = start()
    slopes = [derivative(0.0, state)]
    kept = [state]
    for step in range(steps):
        t = STEP * step
        if len(slopes) < 8:
            state = runge_kutta(t, state, STEP, 400)
        else:
            guess = state + STEP * np.tensordot(forth, slopes, 1)
            after = slopes[1:] + [derivative(t + STEP, guess)]
            state = state + STEP * np.tensordot(back, after, 1)
        slopes = slopes[-7:] + [derivative(t + STEP, state)]
        if (step + 1) % EVERY == 0:
            kept.append(state)
        if (step + 1) % 72000 == 0:
            height = np.linalg.norm(state[:, :3], axis=1) - RADIUS
            print(f"day {(step + 1) * STEP / 86400:.0f}: {height.min() / 1e3:.1f} to {height.max() / 1e3:.1f} km high", flush=True)
    return STEP * EVERY * np.arange(len(kept)), np.array(kept)


def write(folder, times, states):
    obliquity = np.radians(84381.448 / 3600)
    c, s = np.cos(obliquity), np.sin(obliquity)
    turn = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    epochs = np.datetime64("2030-12-31T00:00:00") + times.astype("timedelta64[s]")
    for n in range(states.shape[1]):
        km = np.concatenate([states[:, n, :3] @ turn.T, states[:, n, 3:] @ turn.T], axis=1) / 1e3
        with open(os.path.join(folder, f"sat{n + 1}.oem"), "w") as file:
            file.write(
                "CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 2026-01-01T00:00:00\nORIGINATOR = PROPAGATE\n\n"
                f"META_START\nOBJECT_NAME = SAT {n + 1}\nOBJECT_ID = 2030-001{chr(65 + n)}\nCENTER_NAME = MOON\n"
                "REF_FRAME = EME2000\nTIME_SYSTEM = TDB\n"
                f"START_TIME = {epochs[0]}\nSTOP_TIME = {epochs[-1]}\n"
                "INTERPOLATION = HERMITE\nINTERPOLATION_DEGREE = 7\nMETA_STOP\n"
            )
            file.writelines(f"{t} {' '.join(f'{x:.9f}' for x in row)}\n" for t, row in zip(epochs, km))


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    folder, days = sys.argv[1], float(sys.argv[2])
    os.makedirs(folder, exist_ok=True)
    times, states = trajectory(days)
    write(folder, times, states)


if __name__ == "__main__":
    main()
