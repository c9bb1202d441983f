"""Sources for patches.toml, and how those that `lunarray zoom` found compare with them."""

import argparse
import csv
import json

import numpy as np

PATCHES = {"pole": (270.0, 66.5), "equator": (150.0, 0.0), "plane": (86.4, 28.9)}  # RA, Dec (J2000), degrees


def draw(args):
    """Sources in each patch, with fluxes of 2 to 200 times the noise, alike in their logarithm."""
    random = np.random.default_rng(5)
    with open(args.file, "w") as file:
        file.write(f"name,ra,dec,flux_{args.mhz}mhz_jy,spectral_index\n")
        for name, (ra, dec) in PATCHES.items():
            for k in range(args.count):
                rho, angle = args.radius_deg * np.sqrt(random.random()), 2 * np.pi * random.random()
                flux = args.sigma_jy * 2 * 100 ** random.random()
                l, m = np.sin(np.radians(rho)) * np.array([np.cos(angle), np.sin(angle)])
                n, d = np.sqrt(1 - l * l - m * m), np.radians(dec)
                source_dec = np.degrees(np.arcsin(m * np.cos(d) + n * np.sin(d)))
                source_ra = ra + np.degrees(np.arctan2(l, n * np.cos(d) - m * np.sin(d)))
                file.write(f"{name}-{k},{source_ra:.8f},{source_dec:.8f},{flux:.6f},0\n")


def compare(args):
    with open(args.file) as file:
        lines = list(csv.DictReader(file))
    key = next(key for key in lines[0] if key.startswith("flux"))
    flux_of = {line["name"]: float(line[key]) for line in lines}
    for path in args.summaries:
        with open(path) as file:
            found = json.load(file)
        sources, sigma = found["sources"], found["noise"]["thermal_jy"]
        ra, dec = found["centre_deg"]
        patch = min(PATCHES, key=lambda name: np.hypot(PATCHES[name][0] - ra, PATCHES[name][1] - dec))
        truth = {name: flux for name, flux in flux_of.items() if name.startswith(patch)}
        known = [one for one in sources if one["known_name"] in truth]
        ratio = np.array([one["flux_jy"] / one["known_flux_jy"] for one in known])
        error = np.array([one["flux_error_jy"] / one["known_flux_jy"] for one in known])
        weight = error**-2
        scale, scale_error = (weight * ratio).sum() / weight.sum(), weight.sum() ** -0.5
        beam = 60 * np.sqrt(found["beam"]["fwhm_major_arcmin"] * found["beam"]["fwhm_minor_arcmin"])
        apart = np.array([one["known_distance_arcsec"] for one in known])
        errors = np.array([np.hypot(one["east_error_arcsec"], one["north_error_arcsec"]) for one in known])
        ledger = found["ledger"]
        print(f"{path}: {ledger['sampled']} visibilities, {ledger['accumulated']} in {found['rows']} averages")
        print(f"  beam {found['beam']['fwhm_major_arcmin']:.2f}' x {found['beam']['fwhm_minor_arcmin']:.2f}', noise "
              f"{sigma:.2f} Jy by weights, {found['noise']['measured_jy']:.2f} in the image, threshold {found['threshold']:.2f}")
        print(f"  {len(sources)} sources, {len(known)} of {len(truth)} put in, {len(sources) - len(known)} false")
        print(f"  flux scale {scale:.4f} +- {scale_error:.4f}; chi^2 of fluxes {np.mean(((ratio - 1) / error) ** 2):.2f}")
        print(f"  distances: rms {np.sqrt(np.mean(apart**2)):.2f}\" = {np.sqrt(np.mean(apart**2)) / beam:.3f} beams, median "
              f"{np.median(apart) / beam:.3f}; over errors, rms {np.sqrt(np.mean((apart / errors) ** 2)):.2f}")
        names = {one["known_name"] for one in known}
        for low, high in [(2, 4), (4, 5), (5, 6), (6, 8), (8, 16), (16, 1000)]:
            these = [name for name, flux in truth.items() if low <= flux / sigma < high]
            if these:
                print(f"  {low} to {high} sigma: {sum(name in names for name in these)} of {len(these)} found")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("draw")
    one.add_argument("file")
    one.add_argument("--sigma-jy", type=float, default=55.0)
    one.add_argument("--mhz", type=int, default=10)
    one.add_argument("--radius-deg", type=float, default=4.95)
    one.add_argument("--count", type=int, default=40)
    one.set_defaults(run=draw)
    two = commands.add_parser("compare")
    two.add_argument("file")
    two.add_argument("summaries", nargs="+")
    two.set_defaults(run=compare)
    args = parser.parse_args()
    args.run(args)


main()
