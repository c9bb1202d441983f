"""Errors of a map with R from the data, by dense matrices over harmonics: rows of B summed over the pixels of a fine map.

Reads a JSON object from standard input: `visibilities` (a table of `lunarray export visibilities`), `channel` (of summary.json), `folder` (of
the channel's products), `l_max`, `moon_radius_m`, `samples` (folder of
`lunarray sample`), `fine` (nside of the pixels over which rows are summed) and `beyond` (whether pixels have more degrees than the map); or `given`, an R by degree (epsilon with an exponent or C_l), of which the map alone is compared. Writes for each product the value of the program over that of the matrices, or their difference.
Nothing but C_l and the factor of the noise is taken from the program.
"""

import json
import sys

import healpy
import numpy as np

LIGHT = 299792458.0
asked = json.load(sys.stdin)
FINE = asked["fine"]
channel, l_max = asked["channel"], asked["l_max"]
rows = np.genfromtxt(asked["visibilities"], delimiter=",", names=True)
rows = rows[rows["flag"] == 0]
wavelength = LIGHT / channel["frequency_hz"]


def harmonics(nside):
    """Real orthonormal harmonics at the pixels: columns, with the degree of each."""
    columns, degrees = [], []
    for l in range(l_max + 1):
        for m in range(l + 1):
            for value in [1.0] if m == 0 else [np.sqrt(0.5), np.sqrt(0.5) * 1j]:
                alm = np.zeros(healpy.Alm.getsize(l_max), complex)
                alm[healpy.Alm.getidx(l_max, l, m)] = value
                columns.append(healpy.alm2map(alm, nside, lmax=l_max))
                degrees.append(l)
    return np.array(columns).T, np.array(degrees)


directions = np.array(healpy.pix2vec(FINE, np.arange(healpy.nside2npix(FINE)))).T
area = healpy.nside2pixarea(FINE)
fine, degree = harmonics(FINE)
normal, right = np.zeros((len(degree), len(degree))), np.zeros(len(degree))
for part in np.array_split(rows, max(1, len(rows) // 400)):
    r_i, r_j = (np.array([part[f"{axis}_{which}_m"] for axis in "xyz"]).T for which in "ij")
    b = np.exp(-2j * np.pi / wavelength * ((r_i - r_j) @ directions.T)) * area
    for r in (r_i, r_j):
        radius = np.linalg.norm(r, axis=1, keepdims=True)
        limit = -np.sqrt(1.0 - (asked["moon_radius_m"] / radius) ** 2)
        b[(r / radius) @ directions.T < limit] = 0.0
    b = b @ fine
    weight = part["weight"]
    normal += (b.conj().T @ (weight[:, None] * b)).real
    right += (b.conj().T @ (weight * (part["re_k_sr"] + 1j * part["im_k_sr"]))).real

given = asked.get("given")
if given:
    # R by degree, as set: the product's map alone.
    r = given["epsilon"] / np.array(given["power_k2"])[degree] if "power_k2" in given else None
    if r is None:
        r = given["epsilon"] * np.linalg.eigvalsh(normal)[-1] * (degree + 1.0) ** given["exponent"]
    expected = harmonics(channel["nside"])[0] @ np.linalg.solve(normal + np.diag(r), right)
    found = healpy.read_map(f"{asked['folder']}/map.fits", dtype=float)
    print(json.dumps({"map": (np.std(found - expected) / np.std(expected)).item()}))
    sys.exit()

power, factor = np.array(channel["sky_power"]["power_k2"]), channel["sky_power"]["noise_factor"]
r = (factor**2 / power)[degree]
inverse = np.linalg.inv(normal + np.diag(r))
nside = channel["nside"]
y = harmonics(nside)[0]
sigma = factor * np.sqrt(np.einsum("pi,ij,pj->p", y, inverse, y, optimize=True))
own = sigma
if asked["beyond"]:
    # A power law through the last two degrees, averaged over discs of a pixel's area.
    slope = np.log(power[l_max] / power[l_max - 1]) / np.log((l_max + 1) / l_max)
    further = np.arange(l_max + 1, 8 * nside + 1)
    x = 2 * further / np.sqrt(12) / nside
    turn = np.linspace(0, np.pi, 4001)[:, None]
    j1 = np.trapezoid(np.cos(turn - x * np.sin(turn)), turn, axis=0) / np.pi
    more = power[l_max] * ((further + 1) / (l_max + 1)) ** slope * (2 * j1 / x) ** 2
    sigma = np.sqrt(sigma**2 + ((2 * further + 1) * more).sum() / (4 * np.pi))
root = y * np.sqrt(r)
density = (l_max + 1) ** 2 / (4 * np.pi) - np.einsum("pi,ij,pj->p", root, inverse, root, optimize=True)
resolution = np.degrees(1 / np.sqrt(density))
every = np.arange(2, l_max + 1)
expected = ((2 * every + 1) * power[2 : l_max + 1]).sum() / (4 * np.pi)
# Mean, and 3 / 4 pi times the integral of T n.
moments = np.vstack([np.ones(len(directions)), 3 * directions.T]) @ fine * area / (4 * np.pi)
spread = factor * np.sqrt(np.diag(moments @ inverse @ moments.T))
solved = inverse @ right


def read(name):
    return healpy.read_map(f"{asked['folder']}/{name}.fits", dtype=float)


found = read("map")
sampled = healpy.read_map(f"{asked['samples']}/sigma.fits", dtype=float)
monopole, dipole = healpy.fit_dipole(found)
print(
    json.dumps(
        {
            "map": (np.std(found - y @ solved) / sigma.mean()).item(),
            "sigma": (read("sigma") / sigma).tolist(),
            "sampled": ((sampled / own) ** 2).tolist(),
            "resolution": (read("resolution") / resolution).tolist(),
            "mask": (read("mask") == (sigma**2 < 0.5 * expected)).mean().item(),
            "measured": (sigma**2 < 0.5 * expected).mean().item(),
            "moments_sigma": (np.array([channel["mean_sigma_k"], *channel["dipole_sigma_k"]]) / spread).tolist(),
            "dipole": ((np.array(channel["dipole_k"]) - dipole) / spread[1:]).tolist(),
        }
    )
)
