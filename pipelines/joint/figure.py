"""What total powers and neighbouring channels bring: rho_l at 10 MHz of four maps, and what is left to 1. Needs matplotlib.

    lunarray simulate bring.toml --out bring.ccsds
    lunarray replay bring.ccsds --map bring.toml --state all --out alone
    lunarray replay bring.ccsds --map bring.toml --channels 3 --state one --out one-map
    lunarray joint one --count 8 --out powers
    lunarray joint all --no-powers --count 8 --out channels
    lunarray joint all --count 8 --out both
    lunarray sky bring.toml --freq-hz 1e7 --nside 128 --out sky.fits
    python figure.py lunarray sky.fits bring.png {alone,powers,channels,both}/10.000MHz/map.fits
"""

import json
import subprocess
import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

program, sky, out, *maps = sys.argv[1:]
NAMES = ["R from the data alone", "with total powers", "with channels", "with both"]
figure, (upper, lower) = plt.subplots(2, 1, figsize=(8, 7), sharex=True)
for name, style, path in zip(NAMES, ["k-", "C0--", "C1-.", "C3-"], maps, strict=True):
    found = json.loads(subprocess.run([program, "compare", path, sky, "--json"], check=True, capture_output=True, text=True).stdout)
    rho = np.array(found["rho"][2:41], dtype=float)
    degrees = np.arange(2, 41)
    upper.plot(degrees, rho, style, label=name)
    lower.semilogy(degrees, 1 - rho, style, label=name)
    shown = (2, 4, 6, 8, 12, 16, 20, 30, 40)
    print(name, *(f"{l}: {rho[l - 2]:.3f}" for l in shown), f"least to 20: {rho[:19].min():.3f}", sep="  ")
upper.set_ylabel(r"$\rho_l$, noise included")
lower.set_ylabel(r"$1 - \rho_l$")
lower.set_xlabel("degree l")
upper.axhline(0.98, color="grey", lw=0.5)
upper.legend(loc="lower left")
upper.set_title("10 MHz, nside 16")
figure.tight_layout()
figure.savefig(out, dpi=100)
