"""Orbits about an oblate Moon as CCSDS OEM files, by numerical integration that shares nothing with the product.

usage: oem_orbits.py FOLDER DAYS

Three satellites of eccentric orbits under the Moon's mass and J2 (its axis taken as the pole of the ecliptic), by Runge and
Kutta's fourth-order method with steps of 2 s. Writes FOLDER/sat1.oem .. sat3.oem, states each minute on the axes of EME2000 in
two segments, and FOLDER/truth: f64, time in s, then x, y, z in m of each satellite on ecliptic axes, at times between the
states.
"""

import sys

import numpy as np

folder, days = sys.argv[1], float(sys.argv[2])
GM, J2, RADIUS = 4.902800118e12, 2.0330530e-4, 1738.0e3
STEP = 2.0
EVERY = 30


def acceleration(r):
    square = np.sum(r * r, axis=1, keepdims=True)
    oblate = 1.5 * J2 * RADIUS**2 / square
    up = 5 * r[:, 2:] ** 2 / square
    shape = np.concatenate([1 - oblate * (up - 1)] * 2 + [1 - oblate * (up - 3)], axis=1)
    return -GM * r / square**1.5 * shape


def derivative(state):
    return np.concatenate([state[:, 3:], acceleration(state[:, :3])], axis=1)


def start(axis, eccentricity, inclination, node, anomaly):
    """A state at the periapsis' argument 90 deg and a small true anomaly, deg."""
    node, inclination, angle = np.radians([node, inclination, 90 + anomaly])
    true = np.radians(anomaly)
    radius = axis * (1 - eccentricity**2) / (1 + eccentricity * np.cos(true))
    speed = np.sqrt(GM / (axis * (1 - eccentricity**2)))
    along = np.array([np.cos(node), np.sin(node), 0])
    beside = np.array([-np.sin(node) * np.cos(inclination), np.cos(node) * np.cos(inclination), np.sin(inclination)])
    up = np.cos(angle) * along + np.sin(angle) * beside
    ahead = -np.sin(angle) * along + np.cos(angle) * beside
    velocity = speed * (eccentricity * np.sin(true) * up + (1 + eccentricity * np.cos(true)) * ahead)
    return np.concatenate([radius * up, velocity])


state = np.array(
    [
        start(2037.1e3, 0.010, 60.00, 0.0, 0.000),
        start(2037.1e3, 0.012, 60.02, 0.0, 0.015),
        start(2037.1e3, 0.010, 60.00, 0.02, 0.005),
    ]
)
steps = int(days * 86400 / STEP) // (2 * EVERY) * 2 * EVERY
states, truth = [], []
for step in range(steps + 1):
    if step % EVERY == 0:
        states.append(state.copy())
    if step % 997 == 500:
        truth.append(np.concatenate([[step * STEP], state[:, :3].ravel()]))
    a = derivative(state)
    b = derivative(state + 0.5 * STEP * a)
    c = derivative(state + 0.5 * STEP * b)
    d = derivative(state + STEP * c)
    state = state + STEP / 6 * (a + 2 * b + 2 * c + d)
states = np.array(states)
np.array(truth).tofile(f"{folder}/truth")

tilt = np.radians(84381.448 / 3600)
turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
epochs = np.datetime64("2030-12-31T00:00:00.000") + (np.arange(len(states)) * int(STEP * EVERY * 1000)).astype(
    "timedelta64[ms]"
)
half = len(states) // 2
for satellite in range(3):
    with open(f"{folder}/sat{satellite + 1}.oem", "w") as out:
        out.write("CCSDS_OEM_VERS = 2.0\nCREATION_DATE = 2026-01-01T00:00:00\nORIGINATOR = TEST\n\n")
        for part in (slice(0, half + 1), slice(half, None)):
            when = epochs[part]
            out.write("META_START\n")
            for key, value in (
                ("OBJECT_NAME", f"SAT {satellite + 1}"),
                ("OBJECT_ID", f"2030-001{'ABC'[satellite]}"),
                ("CENTER_NAME", "MOON"),
                ("REF_FRAME", "EME2000"),
                ("TIME_SYSTEM", "TAI"),
                ("START_TIME", when[0]),
                ("STOP_TIME", when[-1]),
                ("INTERPOLATION", "HERMITE"),
                ("INTERPOLATION_DEGREE", "7"),
            ):
                out.write(f"{key:<20} = {value}\n")
            out.write("META_STOP\nCOMMENT states each minute\n")
            for time, one in zip(when, states[part, satellite]):
                numbers = np.concatenate([turn @ one[:3], turn @ one[3:]]) / 1e3
                out.write(f"{time} " + " ".join(f"{number:.12f}" for number in numbers) + "\n")
            out.write("\nCOVARIANCE_START\nEPOCH = 2030-12-31T00:00:00\n1.0\n0.0 1.0\nCOVARIANCE_STOP\n\n")
