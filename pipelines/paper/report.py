#!/usr/bin/env python3
"""Makes what docs/paper.md shows, sheet by sheet: runs commands, prints tables and times, draws pictures. Its words are by hand.

From the top of the checkout, with `lunarray` in PATH and Python with Pillow and healpy:

    python3 pipelines/paper/report.py               # tables and pictures of what is in out/
    python3 pipelines/paper/report.py --make        # runs what is not there yet, for many hours
    python3 pipelines/paper/report.py --make 15 19  # only the sheets of these figures
    python3 pipelines/paper/report.py --make --ulsa maps

ULSA's absorbed maps, ulsa_3mhz.fits and ulsa_10mhz.fits (HEALPix with COORDSYS, K), are looked for in the folder of --ulsa, or the working
directory; without them the sky is generated. Times of commands are kept in out/times.json. Pictures go into docs/, in 128 colours and at
most 1,200 pixels wide.
"""

import argparse
import json
import math
import re
import resource
import shutil
import subprocess
import time
from pathlib import Path

OUT = Path("out")
TIMES = OUT / "times.json"
BOLTZMANN = 1.380649e-23
LIGHT = 299792458.0


def load(name):
    path = OUT / name
    return json.loads(path.read_text()) if path.exists() else None


def table(head, rows):
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows]) + "\n"


def at(values, l):
    return "-" if not values or l >= len(values) or values[l] is None else f"{values[l]:.3f}"


def show(x, form="{:.2e}"):
    return "-" if x is None else form.format(x)


def picture(path, name, what):
    if not (OUT / path).exists():
        return ""
    from PIL import Image

    image = Image.open(OUT / path).convert("RGB")
    image.thumbnail((1200, 1200), Image.Resampling.LANCZOS)
    few = image.quantize(128, method=Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE)
    few.save(Path("docs") / name, optimize=True)
    return f"\n![{what}]({name})\n"


def figure(name, text, what=""):
    return text(load(f"figures/{name}.json")) + picture(f"figures/{name}.png", f"paper-{name}.png", what or name)


def full_sky():
    return picture("full-sky/10.000MHz/input.png", "paper-sky.png", "the sky at 10 MHz")


def counts():
    fluxes = {}
    for mhz in (3, 10, 30):
        lines = (OUT / f"sources-{mhz}mhz.csv").read_text().splitlines()[1:]
        fluxes[mhz] = [float(line.split(",")[3]) for line in lines]
    # Franzen et al. 2019: log10(S^2.5 dN/dS) = sum a_k (log10 S)^k, integrated in ln S by the midpoint rule.
    a = [3.52, 0.307, -0.388, -0.0404, 0.0351, 0.00600]

    def expected(low, high=75.0, steps=4000):
        total, step = 0.0, math.log(high / low) / steps
        for k in range(steps):
            s = low * math.exp((k + 0.5) * step)
            x = math.log10(s)
            total += s * 10 ** (sum(c * x**n for n, c in enumerate(a)) - 2.5 * x) * step
        return 4 * math.pi * total

    rows = []
    for s in (4.36, 10, 20, 40):
        limits = {mhz: s * (154 / mhz) ** 0.8 for mhz in fluxes}
        # The sources are the same at all frequencies; more than one number would be a finding.
        counts = {f"{sum(flux > limits[mhz] for flux in found):,}" for mhz, found in fluxes.items()}
        which = ", ".join(f"{limit:,.0f}" for limit in limits.values())
        rows.append([f"{s:g}", which, f"{expected(s):,.0f}", " or ".join(sorted(counts))])
    head = ["S at 154 MHz, Jy", "which is, at 3, 10, 30 MHz", "N(>S), Franzen et al. (2019)", "ours"]
    return table(head, rows) + picture("patch.png", "paper-patch.png", "the diffuse sky of 20 x 20 degrees")


def spacing(n):
    curves = n["curves"]
    rows = [
        [str(r), *[show(curve["q0"][curve["ratio"].index(r)], "{:.4f}") for curve in curves]] for r in (2, 3, 4, 6, 10)
    ]
    head = ["R", *[f"R_2 = {curve['first_ratio']:g}" for curve in curves]]
    return table(head, rows) + f"\nq0 = {n['q0']:.5f} for R = 3, R_2 = 6.\n"


def breathings(n):
    """Pair hours per metre between lengths, for several breathings."""
    edges, rows = [bin["from_m"] for bin in n["bins"]], []
    ends = [min(range(len(edges)), key=lambda k: abs(edges[k] - m)) for m in (100, 315, 500, 1000, 3000, 10000, 30000)]
    for low, high in zip(ends, ends[1:]):
        width_h = 3600 * (edges[high] - edges[low])
        rows.append([f"{edges[low]:,.0f} to {edges[high]:,.0f}",
                     *[f"{sum(b['pair_s'][low:high]) / width_h:.2f}" for b in n["breathings"]]])
    return table(["length, m", *[f"R_2 = {b['first_ratio']:g}, R = {b['ratio']:g}" for b in n["breathings"]]], rows)


def pair_time(n):
    channel = n["channels"][0]
    text = (
        f"{n['windows']:,} windows, {n['observed_s'] / 3600:,.0f} h; {n['pair_s'] / 3600:,.0f} pair hours, lengths from "
        f"{n['shortest_m']:.0f} m to {n['longest_m'] / 1e3:.1f} km.\n\n"
    )
    rows = [
        ["visibilities, all baselines", f"{channel['visibilities_all']:.3e}", "1.9e9 (independent, for a third of the time in place of 31 %)"],
        [f"b < {channel['limit_m']:.0f} m = 2 b_p", f"{channel['visibilities']:.3e}, {channel['pairs']} pairs", "2.60e7, 9 pairs (independent)"],
        ["time in which lambda / 8 cuts integrations", f"{100 * channel['cut_by_motion']:.1f} %", "99.3 % (independent); > 99 % (Sect. 3.3)"],
    ]
    return text + table(["10 MHz, nside 64", "ours", "by others"], rows) + "\nPair hours per metre:\n\n" + breathings(n)


def uvw(n):
    return table(
        ["", "ours", "by geometry"],
        [
            ["greatest abs(w) / b", f"{n['w_share_max']:.4f}", "sin 30 deg = 0.5"],
            ["mean of (w / b)^2", f"{n['w_share_square_mean']:.4f}", "sin^2 30 deg / 2 = 0.125"],
            ["filled share of the plane u, v", f"{n['filled'][0]:.3f}", "1"],
            ["of u, w and v, w", f"{n['filled'][1]:.3f}, {n['filled'][2]:.3f}", "0.609"],
        ],
    )


def coverage():
    n = load("figures/coverage.json")
    rows = [
        [f"{band['latitude_deg'][0]:g} to {band['latitude_deg'][1]:g}", f"{band['pair_h']:,.0f}",
         f"{band['shortest_wavelengths']:.2f}", f"{band['uv_filled']:.2f}"]
        for band in n["channels"][0]["bands"]
    ]
    head = ["degrees from the ecliptic", "pair hours at 10 MHz", "shortest projected, wavelengths", "share of uv cells filled"]
    least, mean, most = (1 / share for share in reversed(n["first_over_channel"][1]))
    return table(head, rows) + f"\nMeans over directions. Hours at 3 MHz over those at 10: {mean:.2f} ({least:.2f} to {most:.2f}).\n"


def beam_row(n):
    return (
        f"Pair {n['pair']}, {n['length_m']:.0f} m = {n['length_bp']:.2f} b_p at {n['frequency_hz'] / 1e6:g} MHz, nside "
        f"{n['nside']}: the Moon leaves {100 * n['seen']:.1f} % of the pixels; mean square of the row there "
        f"{n['centre_power']:.3f} at centres, {n['average_power']:.3f} averaged.\n"
    )


def waterfall(n):
    (low, high), (short, long) = ((x / 1e6 for x in n["band_hz"]), n["length_bp"])
    return (
        f"Pair {n['pair']}, a window, {low:g} to {high:g} MHz, {short:.2f} to {long:.2f} b_p: errors, rms over the rms visibility of "
        f"the sky at nside {n['nside_fine']}, are {n['centre']:.3f} at centres of nside {n['nside']} and {n['average']:.3f} averaged.\n"
    )


def sub_pixel(n):
    rows = []
    for case in n["cases"]:
        by = {c["to_bp"]: c for c in case["classes"]}
        rows.append([
            str(case["nside"]), case["rows"], f"{case['visibilities']:,}",
            *[show(by[to]["of_visibility"] if to in by else None, "{:.3f}") for to in (0.5, 1.0, 1.5, 2.0)],
            f"{case['sigma_b_k']:.2e}", f"{case['tr_sigma_b_k2']:.2e}",
        ])
    head = ["nside", "rows", "visibilities", *[f"sqrt(N_b / V), {to - 0.25:g} to {to:g} b_p" for to in (0.5, 1.0, 1.5, 2.0)], "Sigma_b, K rms",
            "Tr Sigma_b, K²"]
    return table(head, rows)


def powers():
    """Auto-correlations with a Moon that reflects, over those without."""
    means = {}
    for case in ("no-reflection", "flat-mirror", "sphere"):
        found = load(f"fig6-power/case-{case}/autos.json")
        means[case] = sum(auto["mean_k_sr"] for auto in found) / len(found)
    return "".join(f"{case}: {100 * (mean / means['no-reflection'] - 1):+.2f} %\n" for case, mean in means.items()) + "\n"


def latitudes(name):
    study = load(f"{name}/study.json")
    rows, head = [], []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        bands = channel.get("latitudes") or []
        head = [f"{band['from_deg']:g} to {band['to_deg']:g} deg" for band in bands]
        rows.append([case["figures"]["name"], show(channel["mean_k"], "{:.3e}"),
                     *[f"{100 * band['mean']:+.1f}, {100 * band['rms']:.1f}" for band in bands]])
    return table(["case", "mean, K", *head], rows)


# Studies at full size, and their cases of the paper's epsilon with post-processing.
FULL = {10: "fig9-18-10mhz", 3: "fig10-14-3mhz"}
SMOOTHED = {10: "1e-4 smoothed", 3: "1e-6 smoothed"}


def case_of(mhz, name):
    """Folder of a case at full size."""
    return OUT / FULL[mhz] / next(
        case["folder"] for case in load(f"{FULL[mhz]}/study.json")["cases"] if case["figures"]["name"] == name)


# Ecliptic longitude and latitude of the paper's patches.
PATCHES = ("120,0", "120,30", "120,60")


def patches():
    """Input, map without noise and with the noise-only map added, all smoothed, less scales above 5 degrees."""
    import healpy
    from PIL import Image

    rows, shown = [], ""
    for mhz in (10, 3):
        folder = case_of(mhz, SMOOTHED[mhz]) / f"{mhz:.3f}MHz"
        clean, noise = (healpy.read_map(folder / f"{name}-smooth.fits", dtype=float) for name in ("map", "noise"))
        healpy.write_map(folder / "with-noise.fits", clean + noise, dtype=float, coord="E", column_units="K", overwrite=True)
        # Panels are titled with the names of their files.
        panels = [OUT / name for name in ("input", "map without noise", "map with noise")]
        for panel, name in zip(panels, ("input-smooth", "map-smooth", "with-noise")):
            shutil.copy(folder / f"{name}.fits", panel)
        strips = []
        for k, centre in enumerate(PATCHES):
            out = OUT / f"patch-{mhz:g}-{k + 1}.png"
            command = ["lunarray", "cutout", *panels, "--frame", "ecliptic", "--centre", centre, "--subtract-fwhm", "5", "--json"]
            found = subprocess.run([*command, "--out", out], check=True, capture_output=True).stdout
            truth, *ours = json.loads(found)["pieces"]
            rows.append([f"{mhz:g}", centre, *[show(piece["rms_k"]) for piece in (truth, *ours)],
                         *[f"{piece['correlation']:.3f}" for piece in ours]])
            strips.append(Image.open(out).convert("RGB"))
        whole = Image.new("RGB", (strips[0].width, sum(strip.height for strip in strips)))
        for k, strip in enumerate(strips):
            whole.paste(strip, (0, k * strip.height))
        whole.save(OUT / f"patches-{mhz:g}.png")
        shown += picture(f"patches-{mhz:g}.png", f"paper-patches-{mhz:g}mhz.png", f"{mhz:g} MHz")
    head = ["MHz", "centre, ecliptic deg", "rms of the input, K", "of the map", "with noise", "correlation", "with noise"]
    return table(head, rows) + shown


def maps():
    """The maps at full size: noise, share of negative pixels, errors by latitude, rho_l without noise, SNR_l by the noise-only map. Errors
    are mean and rms of map - input over the mean of the input in the band, as ULSA is near zero in the Gum nebula."""
    import healpy
    import numpy as np

    edges, text, rows = range(0, 91, 15), "", []
    for mhz, name in FULL.items():
        for case in load(f"{name}/study.json")["cases"]:
            channel, folder = case["figures"]["channels"][0], OUT / name / case["folder"] / f"{mhz:.3f}MHz"
            ours, truth = (healpy.read_map(folder / f"{which}.fits", dtype=float) for which in ("map", "input"))
            sine = np.abs(healpy.pix2vec(healpy.get_nside(ours), np.arange(ours.size))[2])
            bands = [(sine >= math.sin(math.radians(low))) & (sine < math.sin(math.radians(low + 15))) for low in edges[:-1]]
            errors = [(ours - truth)[inside] / truth[inside].mean() for inside in bands]
            rows.append([f"{mhz}, {case['figures']['name']}", f"{channel['visibilities']:,}", show(channel["mean_k"], "{:.3e}"),
                         show(channel["noise_rms_k"]), f"{100 * (ours < 0).mean():.1f}",
                         *[f"{100 * e.mean():+.1f}, {100 * (e**2).mean() ** 0.5:.1f}" for e in errors]])
        ls = (2, 4, 8, 12, 16, 20, 32, 64, 96, 128)
        text += "".join("\n" + correlation(name, ls, f"{mhz} MHz, case", key) for key in ("rho", "snr"))
    head = ["MHz, case", "visibilities", "mean, K", "noise, K rms", "negative, %", *[f"{low} to {low + 15} deg" for low in edges[:-1]]]
    return table(head, rows) + text


def uniformity():
    maps = sorted((OUT / "realisations").glob("case-*/10.000MHz/realisations/noise-*.fits"))
    maps += (OUT / "realisations").glob("case-*/10.000MHz/noise.fits")
    import healpy
    import numpy as np

    noises = [healpy.map2alm(healpy.read_map(path), iter=1) for path in maps]
    l_max = healpy.Alm.getlmax(len(noises[0]))
    nside = (l_max + 1) // 3
    degrees = healpy.Alm.getlm(l_max)[0]
    latitude_deg = np.abs(90 - np.degrees(healpy.pix2ang(nside, np.arange(12 * nside**2))[0]))
    bands = [(0, 20), (20, 40), (40, 60), (60, 75), (75, 90)]
    rows = []
    for least in (0, 18, 24):
        variance = sum(healpy.alm2map(np.where(degrees < least, 0, alm), nside) ** 2 for alm in noises) / len(noises)
        scatter = np.sqrt(variance).std() / np.sqrt(variance).mean()
        # A standard deviation of N numbers scatters by 1 / sqrt(2 N) of itself.
        own = np.sqrt(max(scatter**2 - 1 / (2 * len(noises)), 0))
        inside = [variance[(latitude_deg >= low) & (latitude_deg < high)].mean() / variance.mean() for low, high in bands]
        rows.append([f"l >= {least}", f"{np.sqrt(variance.mean()):.2e}", f"{100 * scatter:.1f}", f"{100 * own:.1f}",
                     *[f"{np.sqrt(x):.3f}" for x in inside]])
    head = ["noise at", "rms, K", "scatter, %", "its own, %", *[f"{low} to {high} deg" for low, high in bands]]
    return table(head, rows)


def crossing(points, scale):
    """epsilon at which Tr Sigma_n = scale Tr Sigma_s, on a straight line between logarithms of points (epsilon, n, s)."""
    for (e, n, s), (e2, n2, s2) in zip(points, points[1:]):
        if n > scale * s > 0 and 0 < n2 < scale * s2:
            above, above2 = math.log(n / (scale * s)), math.log(n2 / (scale * s2))
            return e * (e2 / e) ** (above / (above - above2))
    return None


def pixel_traces():
    """Traces by pixels, Tr Sigma_n scaled from every 4th integration to all data by the number of visibilities."""
    rows = []
    for name, nside, whole in (("fig15-nside8", 8, 566_823), ("fig15-pixels", 16, 2_034_350)):
        groups = {}
        for case in load(f"{name}/study.json")["cases"]:
            channel = case["figures"]["channels"][0]
            mean = math.sqrt(channel["power"]["input_k2"][0] / (4 * math.pi))
            traces, count = channel["diagnostics"]["traces"], channel["visibilities"]
            n, s = traces["sigma_n_k2"]["value"] * count / whole, traces["sigma_s"]["value"]
            groups.setdefault((count, mean), []).append((channel["diagnostics"]["epsilon"], n, s))
        for (count, mean), points in groups.items():
            crossings = [show(crossing(points, mean**power)) for power in (2, 1)]
            rows += [[f"{nside}, {count:,}", f"{e:.0e}", show(n), f"{s:.4g}", show(mean**2 * s), *crossings] for e, n, s in points]
    head = ["nside, visibilities", "epsilon", "Tr Sigma_n, K²", "Tr Sigma_s", "T² Tr Sigma_s, K²", "crossing with T²", "with T"]
    return table(head, rows)


def traces(name):
    study = load(f"{name}/study.json")
    rows = []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        mean = math.sqrt(channel["power"]["input_k2"][0] / (4 * math.pi))
        found = channel["diagnostics"]["traces"]
        n, s = (None, None) if found is None else (found["sigma_n_k2"]["value"], found["sigma_s"]["value"])
        epsilon = f"{channel['diagnostics']['epsilon']:.0e}"
        # Every decade, and the paper's.
        if epsilon.startswith("1e") or epsilon == "2e-03":
            rows.append([epsilon, show(n), show(s), show(None if s is None else mean**2 * s)])
    text = table(["epsilon", "Tr Sigma_n, K²", "Tr Sigma_s", "T² Tr Sigma_s, K²"], rows)
    for crossing in study["crossings"]:
        for key, what in (("epsilon", "T²"), ("epsilon_first_power", "T")):
            where = "nowhere in this range" if crossing[key] is None else f"at epsilon {crossing[key]:.2e}"
            text += f"\nTr Sigma_n = {what} Tr Sigma_s {where}.\n"
    return text


def point_beams(name):
    study = load(f"{name}/study.json")
    rows, head = [], []

    def told(widths):
        if not widths:
            return "-"
        major, minor = widths["fwhm_major_deg"], widths["fwhm_minor_deg"]
        return f"{math.sqrt(major * minor):.2f} ({major:.2f} x {minor:.2f})"

    for case in study["cases"]:
        path = OUT / name / case["folder"] / "summary.json"
        beams = json.loads(path.read_text())["channels"][0]["point_beams"]
        head = ["case, epsilon", *[f"latitude {beam['latitude_deg']:.1f}" for beam in beams]]
        rows.append([case["figures"]["name"], *[f"{told(b.get('solved'))}; {told(b.get('processed'))}" for b in beams]])
    return table(head, rows)


def correlation(name, ls, head, key="rho"):
    study = load(f"{name}/study.json")
    rows = []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        rows.append([case["figures"]["name"], f"{channel['visibilities']:,}", *[at(channel[key], l) for l in ls]])
    name = {"rho": "rho", "snr": "SNR"}[key]
    return table([head, "visibilities", *[f"{name}_{l}" for l in ls]], rows)


def rows_of_b(key, wanted):
    study = load("fig16-17-rows/study.json")
    ls = (4, 8, 12, 16, 24, 32)
    rows = []
    for case in study["cases"]:
        label = case["figures"]["name"]
        if not label.startswith(wanted):
            continue
        channel = case["figures"]["channels"][0]
        rows.append([label.removeprefix(wanted + ", "), f"{channel['visibilities']:,}",
                     *[at(channel[key], l) for l in ls]])
    name = {"rho": "rho", "snr": "SNR"}[key]
    return table(["rows, limit", "visibilities", *[f"{name}_{l}" for l in ls]], rows)


# Degrees of the tables of Fig. 16 and 17 by harmonics.
HARMONIC_LS = (4, 8, 12, 16, 24, 32, 64, 96, 128, 150)


def five_sigma(folder, removed_deg, thin=1):
    """A row of Fig. 19: the noise map after post-processing, less scales above `removed_deg`, of one visibility in `thin`; last at the
    degrees alone that the shortest projected baseline, 100 m cos 30 deg, reaches at the poles."""
    import healpy
    import numpy as np

    channel = json.loads((folder / "summary.json").read_text())["channels"][0]
    mhz, beam = channel["frequency_hz"] / 1e6, channel["beam"]
    noise = healpy.read_map(folder / f"{mhz:.3f}MHz/noise-smooth.fits", dtype=float)
    small = noise - healpy.smoothing(noise, fwhm=math.radians(removed_deg), iter=1)
    sine = healpy.pix2vec(healpy.get_nside(noise), np.arange(noise.size))[2]
    alm = healpy.map2alm(noise, iter=1)
    least = 2 * math.pi * 100 * math.cos(math.radians(30)) * channel["frequency_hz"] / LIGHT
    reached = healpy.alm2map(np.where(healpy.Alm.getlm(healpy.Alm.getlmax(alm.size))[0] < int(least), 0, alm), healpy.get_nside(noise))
    # Noise falls as the root of the number of visibilities.
    jansky = 5 * 2 * BOLTZMANN * (channel["frequency_hz"] / LIGHT) ** 2 / 1e-26 * beam["area_sr"] / math.sqrt(thin)
    return [f"{mhz:g}", show(small.std() / math.sqrt(thin)), f"{beam['fwhm_deg']:.2f}",
            *[f"{jansky * x.std():.0f}" for x in (small, small[np.abs(sine) < 0.5], noise, reached)]]


def sensitivity(cases, *how):
    """Fig. 19 of some cases."""
    rows = sorted((five_sigma(case, *how) for case in cases), key=lambda row: float(row[0]))
    head = ["MHz", "noise, K rms", "beam, deg", "5 sigma, Jy a beam", "within 30 deg of the ecliptic", "with large scales",
            "at degrees reached"]
    return table(head, rows)


PIPELINE = "pipelines/paper-10mhz.toml"
# Channels of Fig. 19 at nside 64.
FIG19_MHZ = (1, 5, 20, 30)


def study(name, rest="", folder="pipelines/paper"):
    return {f"{name}/study.json": f"lunarray study {folder}/{name}.toml{rest}"}


def drawn(name, rest=""):
    return {f"figures/{name}.json": f"lunarray figure {name} {PIPELINE}{rest}"}


def sky(mhz, nside=256, rest=""):
    return f"lunarray sky {PIPELINE} --freq-hz {mhz}e6 --nside {nside}{rest}"


def sub_pixel_of(task, nside, instants=""):
    """Command for the appendix's formulas under the sky of out/sub-pixel; its table appears when it is whole."""
    name = {"matrix": "sub-pixel-matrix", "map": f"sigma-b-{nside}"}[task]
    made = f"python3 pipelines/paper/sub_pixel.py {task} {nside} out/sub-pixel/10.000MHz/input.fits {instants}".strip()
    return f"{made} > out/{name}.part && mv out/{name}.part out/{name}.txt"


def sheets(ulsa):
    """Title, what each command makes, and what is printed of it."""
    def under(mhz, sources="true", generated=""):
        path = ulsa / f"ulsa_{mhz}mhz.fits"
        return f" --set sky.file={path} --set 'sky.added={{small_scales=true,sources={sources}}}'" if path.exists() else generated

    short = f"lunarray run {PIPELINE} --set spacecraft.duration_s=30000"
    full_sky_run = {
        "full-sky/summary.json": f"{short} --set products.frame=ecliptic --set products.smooth_fwhm_deg=1.3{under(10)} --out out/full-sky"}
    priors = full_sky_run | {
        "right-prior.fits": "cp out/full-sky/10.000MHz/input.fits out/right-prior.fits",
        "wrong-prior.fits": "lunarray sky --like out/right-prior.fits --correlation 0.8 --out out/wrong-prior.fits"}
    full = priors | study(FULL[10], under(10)) | study(FULL[3], under(3))
    # A map of no use, for its input, which is the sky itself with pixels as the engine.
    useless = f"{short} --set map.engine=pixel --set map.matrix=free --set map.iterations_max=1"
    diffuse = (f"{useless} --set products.frame=ecliptic "
               f"--set products.smooth_fwhm_deg=0.25{under(10, 'false', ' --set sky.generated.point_sources=false')} --out out/diffuse")
    return [
        ("Fig. 1: a patch, and N(>S)",
         {f"sources-{mhz}mhz.csv": sky(mhz, 256, f" --out out/sky-{mhz}mhz.fits --sources out/sources-{mhz}mhz.csv") for mhz in (3, 10, 30)}
         | {"diffuse/summary.json": diffuse,
            # The title of a cutout is the name of its file.
            "diffuse sky at 10 MHz": "cp out/diffuse/10.000MHz/input-smooth.fits 'out/diffuse sky at 10 MHz'",
            "patch.png": "lunarray cutout 'out/diffuse sky at 10 MHz' --frame ecliptic --centre 120,0 --out out/patch.png"}, counts),
        ("Fig. 2: the full sky", full_sky_run, full_sky),
        ("Fig. 3: q0 against R and R_2", drawn("spacing"), lambda: figure("spacing", spacing)),
        ("Fig. 4: time by baseline length", drawn("pair-time"), lambda: figure("pair-time", pair_time)),
        ("Fig. 4: time by direction (Sect. 4.4)", drawn("coverage", " --set spacecraft.channels_hz=[10e6,3e6]"), coverage),
        ("Fig. 5: density of u, v, w", drawn("uvw"), lambda: figure("uvw", uvw)),
        ("Fig. 6: the sky reflected by the Moon",
         study("fig6-power") | study("fig6-reflection"),
         lambda: powers() + latitudes("fig6-reflection")),
        ("Fig. 7: a row of B", drawn("rows", " --pair 5-6 --at 4.1736d"), lambda: figure("rows", beam_row)),
        ("Fig. 8: waterfalls of one pair", drawn("waterfall", f" --pair 1-4 --at 6.65d --set sky.nside=1024{under(10)}"),
         lambda: figure("waterfall", waterfall)),
        ("Fig. 9, 10, 11, 12 and 18: the maps at 10 and 3 MHz, full size", full, maps),
        ("Fig. 9: by basis and R", study("fig9-basis"), lambda: latitudes("fig9-basis")),
        ("Fig. 9: is the noise uniform?", study("realisations", folder="pipelines/noise"), uniformity),
        ("Fig. 13 and 14: patches of 20 x 20 degrees, large scales subtracted", full, patches),
        ("Fig. 15: traces against epsilon",
         study("fig15-nside8") | study("fig15-pixels") | study("fig15-traces"),
         lambda: pixel_traces() + "\n" + traces("fig15-traces")
         + picture("fig15-pixels/study.png", "paper-fig15.png", "rho, SNR, power and traces against epsilon")),
        ("Fig. 16: rows at centres and averaged, rho_l without noise", study("fig16-17-rows"), lambda: rows_of_b("rho", "no noise")),
        ("Fig. 16: what thinning does", study("fig16-thinning", under(10)) | study("fig16-centres", under(10)),
         lambda: "\n".join(correlation(name, (8, 16, 20, 24, 28), "case") for name in ("fig16-thinning", "fig16-centres"))),
        ("Fig. 16: at nside 32", study("fig16-nside32"),
         lambda: correlation("fig16-nside32", (8, 16, 20, 24, 32, 48, 64), "limit, rows")),
        ("Fig. 16: at nside 64", study("fig16-nside64"),
         lambda: correlation("fig16-nside64", (8, 16, 24, 32, 64, 80, 96, 128), "limit, rows")),
        ("Fig. 17: the same, SNR_l with thermal noise", study("fig16-17-rows"), lambda: rows_of_b("snr", "thermal noise")),
        ("Fig. 16 and 17: by harmonics at nside 64", study("fig16-17-harmonics"),
         lambda: correlation("fig16-17-harmonics", HARMONIC_LS, "limit")
         + "\n" + correlation("fig16-17-harmonics", HARMONIC_LS, "limit", "snr")),
        ("Fig. 19: sensitivity against frequency", study("fig19-sensitivity"),
         lambda: sensitivity(
             [OUT / "fig19-sensitivity" / case["folder"] for case in load("fig19-sensitivity/study.json")["cases"]], 10, 16)),
        ("Fig. 19: all data at nside 64", full,
         lambda: sensitivity([case_of(10, "1e-3 smoothed"), case_of(3, SMOOTHED[3])], 5)),
        ("Fig. 19: at nside 64",
         {f"fig19-{mhz}mhz/summary.json": f"lunarray run {PIPELINE} --set spacecraft.channels_hz=[{mhz}e6] --set map.epsilon=1e-3 "
          "--set spacecraft.thermal_noise=false --set products.smooth_fwhm_deg=1 --set products.pictures=false --set sky.nside=128 "
          f"--set sky.l_max=256 --set spacecraft.thin=8 --out out/fig19-{mhz}mhz" for mhz in FIG19_MHZ},
         lambda: sensitivity([OUT / f"fig19-{mhz}mhz" for mhz in FIG19_MHZ], 5, 8)),
        ("FWHM after post-processing", study("beams"), lambda: point_beams("beams")),
        ("FWHM at nside 64", study("beams-nside64"), lambda: point_beams("beams-nside64")),
        ("Fig. 20: N_b and Sigma_b",
         drawn("sub-pixel") | {
             "sub-pixel/summary.json": f"{useless} --set map.nside=256 --set spacecraft.every_nth_integration=1000 "
             f"--set products.pictures=false{under(10)} --out out/sub-pixel",
             "sub-pixel-matrix.txt": sub_pixel_of("matrix", 8), "sigma-b-8.txt": sub_pixel_of("map", 8, 2000),
             "sigma-b-16.txt": sub_pixel_of("map", 16, 8000)},
         lambda: figure("sub-pixel", sub_pixel) + picture("sub-pixel-matrix.png", "paper-sub-pixel-matrix.png", "N_b")
         + "\n".join((OUT / f"{name}.txt").read_text() for name in ("sub-pixel-matrix", "sigma-b-8", "sigma-b-16"))),
        ("R from the data: limits of Fig. 16 and 17", study("limits-data"),
         lambda: correlation("limits-data", (4, 8, 16, 32, 48, 64, 80), "R, limit")),
    ]


def machine():
    """Processor and number of cores."""
    text = Path("/proc/cpuinfo").read_text()
    names = re.findall("model name\\s*: (.*)", text) or ["an unknown processor"]
    return f"{len(names)} cores of {names[0]}" + (" with AVX-512" if "avx512f" in text else "")


def make(product, command, times):
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
    subprocess.run(command, shell=True, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    times[product] = {"command": command, "processor_s": used, "elapsed_s": time.monotonic() - start, "machine": machine()}
    TIMES.write_text(json.dumps(times, indent=1))


def told(made):
    """Minutes of processor time and elapsed, and the sky, if it is ULSA's."""
    used, elapsed = (sum(one[key] for one in made) / 60 for key in ("processor_s", "elapsed_s"))
    return f"{used:.1f} ({elapsed:.1f} elapsed)" + (", ULSA" if any("sky.file" in one["command"] for one in made) else "")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("figures", nargs="*", help="numbers of figures; all, if there are none")
    parser.add_argument("--make", action="store_true", help="run commands whose products are not there")
    parser.add_argument("--ulsa", type=Path, default=Path("."), metavar="DIR", help="folder of ulsa_3mhz.fits and ulsa_10mhz.fits")
    args = parser.parse_args()
    OUT.mkdir(exist_ok=True)
    times, timed = json.loads(TIMES.read_text()) if TIMES.exists() else {}, {}
    for title, commands, text in sheets(args.ulsa):
        if args.figures and not set(args.figures) & set(re.findall(r"\d+", title.split(":")[0])):
            continue
        print(f"## {title}\n\n" + "\n".join(f"`{command}`" for command in commands.values()) + "\n", flush=True)
        for product, command in commands.items():
            if args.make and not (OUT / product).exists():
                make(product, command, times)
        known = [times[product] for product in commands if product in times]
        if len(known) == len(commands):
            timed.setdefault("; ".join(sorted({one["machine"] for one in known})), []).append(f"{title}: {told(known)}")
            print(f"Minutes of processor time: {told(known)}", flush=True)
        absent = [product for product in commands if not (OUT / product).exists()]
        print("\n" + ("not made here yet: " + ", ".join(absent) + "\n" if absent else text()), flush=True)
    print("## Times\n\nMinutes of processor time (and elapsed):\n")
    for name, sheets_of in timed.items():
        print(f"{name}: " + "; ".join(sheets_of) + ".\n")


if __name__ == "__main__":
    main()
