#!/usr/bin/env python3
"""Writes docs/paper.md from the results of the studies of this folder.

Run from the top of the checkout after the runs and studies that the page names; needs Python, and healpy for the uniformity of noise:

    python3 pipelines/paper/report.py "2 cores of an Intel Xeon" > docs/paper.md

Pictures that the page shows are copied beside it, into docs/.
"""

import json
import math
import shutil
import sys
from pathlib import Path

OUT = Path("out")
BOLTZMANN = 1.380649e-23
LIGHT = 299792458.0
# Larger pictures stay where they are.
PICTURE_BYTES_MAX = 700_000


def notes():
    """By sheet: what the paper says, in our words, and where we differ."""
    parts = (Path(__file__).parent / "notes.md").read_text().split("## ")[1:]
    return {title.strip(): text.strip() for title, _, text in (part.partition("\n") for part in parts)}


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
    if (OUT / path).stat().st_size > PICTURE_BYTES_MAX:
        return f"\n(Its picture is `out/{path}`.)\n"
    shutil.copyfile(OUT / path, Path("docs") / name)
    return f"\n![{what}]({name})\n"


def missing(command):
    return f"Not made here yet: `{command}`.\n"



FIGURE = "lunarray figure {} pipelines/paper-10mhz.toml"


def figure(name, text, command=None, what=""):
    numbers = load(f"figures/{name}.json")
    if numbers is None:
        return missing(command or FIGURE.format(name))
    return text(numbers) + picture(f"figures/{name}.png", f"paper-{name}.png", what or name)


def full_sky():
    return (
        "The generated sky with small scales and sources, Galactic coordinates, logarithmic.\n"
        + picture("sky-10mhz.png", "paper-sky.png", "the sky at 10 MHz")
        if (OUT / "sky-10mhz.png").exists()
        else missing(SKY)
    )


SKY = "lunarray sky pipelines/paper-10mhz.toml --freq-hz 10e6 --nside 256 --out out/sky-10mhz.fits --sources out/sources.csv"
CUTOUT = "lunarray cutout out/sky-10mhz.fits --centre 30,40 --subtract-fwhm 5 --out out/patch.png"


def counts():
    path = OUT / "sources.csv"
    if not path.exists():
        return missing(SKY)
    fluxes = [float(line.split(",")[2]) for line in path.read_text().splitlines()[1:]]
    # Franzen et al. 2019: log10(S^2.5 dN/dS) = sum a_k (log10 S)^k, integrated in ln S by the midpoint rule.
    a = [3.52, 0.307, -0.388, -0.0404, 0.0351, 0.00600]

    def expected(low, high=75.0, steps=4000):
        total, step = 0.0, math.log(high / low) / steps
        for k in range(steps):
            s = low * math.exp((k + 0.5) * step)
            x = math.log10(s)
            total += s * 10 ** (sum(c * x**n for n, c in enumerate(a)) - 2.5 * x) * step
        return 4 * math.pi * total

    rows = [
        [f"{s:g}", f"{sum(flux > s for flux in fluxes):,}", f"{expected(s):,.0f}"] for s in (4.36, 6, 10, 20, 40)
    ]
    return table(["S at 154 MHz, Jy", "N(>S) of the sky", "of the counts of Franzen et al. (2019)"], rows) + picture(
        "patch.png", "paper-patch.png", "a patch of 20 x 20 degrees with scales above 5 degrees subtracted"
    )


def spacing(n):
    rows = []
    for r in (2, 3, 4, 6, 10):
        row = [str(r)]
        for curve in n["curves"]:
            row.append(show(curve["q0"][curve["ratio"].index(r)], "{:.4f}"))
        rows.append(row)
    head = ["R", *[f"R_2 = {curve['first_ratio']:g}" for curve in n["curves"]]]
    return table(head, rows) + f"\nq0 = {n['q0']:.5f} for R = 3, R_2 = 6; independent code has 2.02479.\n"


def pair_time(n):
    channel = n["channels"][0]
    text = (
        f"{n['windows']:,} windows, {n['observed_s'] / 3600:,.0f} h; {n['pair_s'] / 3600:,.0f} pair hours, lengths from "
        f"{n['shortest_m']:.0f} m to {n['longest_m'] / 1e3:.1f} km.\n\n"
    )
    rows = [
        ["visibilities, all baselines", f"{channel['visibilities_all']:.3e}", "1.9e9 (independent, for a third of the time; windows are 31 %: 1.75e9, less what sees the Earth)"],
        [f"b < {channel['limit_m']:.0f} m = 2 b_p", f"{channel['visibilities']:.3e}", "2.60e7 (independent)"],
        ["pairs within it", str(channel["pairs"]), "9 (independent)"],
        ["pair hours within it", f"{channel['pair_s'] / 3600:,.0f}", "-"],
        ["time in which lambda / 8 cuts integrations", f"{100 * channel['cut_by_motion']:.1f} %", "99.3 % (independent); > 99 %"],
    ]
    return text + table(["10 MHz, nside 64", "ours", "by others"], rows)


def uvw(n):
    return table(
        ["", "ours", "by geometry"],
        [
            ["greatest abs(w) / b", f"{n['w_share_max']:.4f}", "sin 30 deg = 0.5"],
            ["mean of (w / b)^2", f"{n['w_share_square_mean']:.4f}", "sin^2 30 deg / 2 = 0.125"],
            ["filled share of the plane u, v", f"{n['filled'][0]:.3f}", "1"],
            ["of u, w and v, w", f"{n['filled'][1]:.3f}, {n['filled'][2]:.3f}", "-"],
        ],
    )


def coverage():
    n = load("figures/coverage.json")
    command = "lunarray figure coverage pipelines/paper-10mhz.toml --set spacecraft.channels_hz=[10e6,3e6]"
    if n is None:
        return missing(command)
    ten, three = n["channels"]
    rows = []
    for a, b in zip(ten["bands"], three["bands"]):
        rows.append([
            f"{a['latitude_deg'][0]:g} to {a['latitude_deg'][1]:g}", f"{a['pair_h']:,.0f}", f"{b['pair_h']:,.0f}",
            f"{b['pair_h'] / a['pair_h']:.2f}", f"{a['shortest_wavelengths']:.2f}", f"{b['shortest_wavelengths']:.2f}",
            f"{a['uv_filled']:.2f}", f"{b['uv_filled']:.2f}",
        ])
    head = ["degrees from the ecliptic", "pair hours, 10 MHz", "3 MHz", "3 over 10 MHz", "shortest projected, wavelengths",
            "3 MHz", "uv filled", "3 MHz"]
    return f"`{command}`\n\n" + table(head, rows) + (
        "\nThe paper (Sect. 4.4) has 3.3 times as much time a direction at 3 MHz as at 10, for baselines below 2 b_p of each; ours is "
        "2.17, so we differ. At the "
        "poles the shortest projected baseline is 100 m cos 30 deg = 2.9 wavelengths at 10 MHz, so scales above l = 18 are "
        "missing there.\n"
    ) + picture("figures/coverage.png", "paper-coverage.png", "coverage by direction")


def beam_row(n):
    return (
        f"Pair {n['pair']}, {n['length_m']:.0f} m = {n['length_bp']:.2f} b_p at {n['frequency_hz'] / 1e6:g} MHz, nside "
        f"{n['nside']}: the Moon leaves {100 * n['seen']:.1f} % of the pixels; mean square of the row there "
        f"{n['centre_power']:.3f} at centres, {n['average_power']:.3f} averaged. Where the fringe is narrower than a pixel, the "
        "average is small, and the centre aliases.\n"
    )


def waterfall(n):
    rows = []
    for c in n["classes"]:
        end = "" if c["to_bp"] is None else f"{c['to_bp']:g}"
        rows.append([f"{c['from_bp']:g} to {end}", f"{c['count']:,}", f"{c['centre']:.3f}", f"{c['average']:.3f}"])
    return (
        f"Pair {n['pair']}, a window, {n['band_hz'][0] / 1e6:g} to {n['band_hz'][1] / 1e6:g} MHz, the sky of 10 MHz at nside "
        f"{n['nside_fine']}, averaged to {n['nside']}.\n\n"
        + table(["baseline, b_p", "visibilities", "error at centres", "averaged"], rows)
        + "\nErrors are rms, over the rms visibility of the fine sky.\n"
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
    head = ["nside", "rows", "visibilities", *[f"N_b, b < {to} b_p" for to in (0.5, 1.0, 1.5, 2.0)], "Sigma_b, K rms",
            "Tr Sigma_b, K²"]
    return table(head, rows) + (
        f"\nN_b is the covariance of V - B T over {n['skies']} skies, T the means over pixels; shown is the root of its diagonal over "
        "the rms visibility, in the class of lengths that ends there. Sigma_b is that of the map, epsilon "
        f"{n['epsilon']:g}, from a sample of the mission's integrations.\n"
    ) + picture("figures/sub-pixel-maps.png", "paper-sub-pixel-maps.png", "root of the diagonal of Sigma_b")


def latitudes(name, command, said):
    study = load(f"{name}/study.json")
    if study is None:
        return missing(command)
    rows, head = [], []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        bands = channel.get("latitudes") or []
        head = [f"{band['from_deg']:g} to {band['to_deg']:g} deg" for band in bands]
        rows.append([case["figures"]["name"], show(channel["mean_k"], "{:.3e}"),
                     *[f"{100 * band['mean']:+.1f}, {100 * band['rms']:.1f}" for band in bands]])
    return table(["case", "mean, K", *head], rows) + (
        f"\nMean and rms of (map - input) / input, %, by distance from the ecliptic. {said}\n"
    )


def basis():
    """Why the traces of the study do not cross: measured once, by three independent ways at nside 8."""
    rows = [
        ["numpy, dense, pixels, mean of Cane (1979)", "2.81e+09", "0.0146", "1.24e+09", "2.02e+09", "1.82", "1.55e+11", "1.6e-4"],
        ["our pixel engine, every 40th window", "6.11e+09", "0.0410", "5.93e+09", "3.97e+09", "3.69", "5.34e+11", "1.0e-4"],
        ["our harmonic engine, the same data", "2.00e+10", "16.9", "2.44e+12", "2.38e+09", "32.2", "4.66e+12", "none above 1e-4"],
    ]
    head = ["nside 8, 10 MHz", "Tr Sigma_n, K², at 1e-4", "Tr Sigma_s", "T² Tr Sigma_s, K²", "at 2e-3", "Tr Sigma_s",
            "T² Tr Sigma_s, K²", "crossing"]
    return (
        "\n**Why they do not cross here.** Traces depend on the basis. A harmonic of l < 18 that no baseline reaches "
         "stays unmeasured, so Tr Sigma_s falls slowly (to 10 at 1e-4). A mode of pixels is a step function with power "
         "at high l, which baselines up to 2 b_p measure; no such mode is lost, and Tr Sigma_s falls as epsilon². The "
         "paper solves for pixels. At nside 8, by `pipelines/paper/dense.py 8 10 6000` in numpy, and by both engines from the same "
        "downlink (scaled to all windows; T = 3.80e5 K):\n\n" + table(head, rows)
        + "\nWith the paper's basis they cross in our range, at 1e-4 for T². The crossing moves with the noise and with "
         "the thinning, which decides which modes are measured: at nside 8 and epsilon 1e-4 Tr Sigma_s is 0.0410 from every "
        "40th window, 0.0204 from every 40th integration and 0.0120 from every 10th. Units require T²; with the first power, as the paper writes it, numbers of K² and K are compared, which do "
         "not cross below 0.1.\n"
    )


# Galactic longitude and latitude of the centres of three patches: near the pole, at middle latitudes, near the plane's anticentre.
PATCHES = ("30,60", "100,-40", "200,20")


def patch_command(mhz, k):
    folder = f"out/paper-{mhz}mhz/{mhz}.000MHz"
    return (f"lunarray cutout {folder}/input-smooth.fits {folder}/map-smooth.fits --centre {PATCHES[k]} --subtract-fwhm 5 "
            f"--out out/patch-{mhz}-{k + 1}.png --json > out/patch-{mhz}-{k + 1}.json")


def patches():
    rows, shown = [], ""
    for mhz in ("10", "3"):
        for k, centre in enumerate(PATCHES):
            found = load(f"patch-{mhz}-{k + 1}.json")
            if found is None:
                continue
            truth, ours = found["pieces"]
            rows.append([mhz, centre, show(truth["rms_k"]), show(ours["rms_k"]), f"{ours['correlation']:.4f}"])
            shown += picture(f"patch-{mhz}-{k + 1}.png", f"paper-patch-{mhz}-{k + 1}.png",
                             f"input and map at {mhz} MHz around {centre} degrees, scales above 5 degrees subtracted")
    if not rows:
        return missing(patch_command("10", 0))
    head = ["MHz", "centre, Galactic degrees", "rms of the input, K", "of the map, K", "correlation"]
    return table(head, rows) + shown


def maps():
    rows = []
    for name, noise in (("paper-10mhz", "10"), ("paper-3mhz", "3")):
        summary = load(f"{name}/summary.json")
        if summary is None:
            continue
        channel = summary["channels"][0]
        rho = channel["rho_noise_subtracted"] or channel["rho"]
        rows.append(
            [noise, f"{channel['visibilities']:,}", *[at(rho, l) for l in (8, 16, 32, 64, 96, 128)],
             f"{channel['noise_rms_k']:.2e}", f"{summary['report']['elapsed_s'] / 60:.1f}"]
        )
    if not rows:
        return "Not made here yet.\n"
    head = ["MHz", "visibilities", *[f"rho_{l}" for l in (8, 16, 32, 64, 96, 128)], "noise, K rms", "minutes"]
    return table(head, rows) + (
        "\nrho_l with the noise's power subtracted; `regulariser identity`.\n"
    )


def uniformity():
    command = "lunarray study pipelines/noise/realisations.toml"
    maps = sorted((OUT / "realisations").glob("case-*/10.000MHz/realisations/noise-*.fits"))
    maps += (OUT / "realisations").glob("case-*/10.000MHz/noise.fits")
    if not maps:
        return missing(command)
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
    return f"`{command}`\n\n" + table(head, rows) + (
        f"\nThe standard deviation of each pixel over {len(noises)} realisations at 10 MHz, nside {nside}, every 10th window: its "
        "scatter over the sphere, the part of this that is not due to so few realisations, and its rms by distance from the ecliptic over "
        "that of all. The paper (Sect. 5.4) finds fluctuations of some 10 %, for an epsilon that it does not give: at nside 16 they are "
        "38, 19 and 13 % at epsilon 1e-4, 1e-3 and 2e-3. At 1e-4 noise is uniform where the array measures; beyond 60 degrees from the "
        "ecliptic the scales that no baseline reaches (l < 18) add as much again.\n"
    )


def traces(name="fig15-traces"):
    study = load(f"{name}/study.json")
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
    rows = []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        mean = math.sqrt(channel["power"]["input_k2"][0] / (4 * math.pi))
        found = channel["diagnostics"]["traces"]
        n, s = (None, None) if found is None else (found["sigma_n_k2"]["value"], found["sigma_s"]["value"])
        rows.append([
            f"{channel['diagnostics']['epsilon']:.0e}", show(n), show(s),
            show(None if s is None else mean * s), show(None if s is None else mean**2 * s),
        ])
    text = table(["epsilon", "Tr Sigma_n, K²", "Tr Sigma_s", "T Tr Sigma_s, K", "T² Tr Sigma_s, K²"], rows)
    for crossing in study["crossings"]:
        where = [
            "nowhere in this range" if crossing[key] is None else f"at epsilon {crossing[key]:.2e}"
            for key in ("epsilon", "epsilon_first_power")
        ]
        text += (
            f"\nTr Sigma_n = T² Tr Sigma_s {where[0]}, T the mean of the input; the number of K² equals that of K in "
            f"T Tr Sigma_s {where[1]}.\n"
        )
    return text


def epsilon_rules(*names):
    """What the rules choose, of each study that was made with traces."""
    rows = []
    for name in names:
        study = load(f"{name}/study.json")
        for found in (study or {}).get("epsilons", []):
            def told(rule):
                choice = found[rule]
                if choice["epsilon"] is None:
                    return "none: " + choice["note"]
                low, high = choice["open"] or (choice["epsilon"],) * 2
                return f"{choice['epsilon']:.1e}" + (f" ({low:.0e} to {high:.0e} open)" if low < high else "")
            rows.append([f"`{name}`", f"{found['numbers']:,}", f"{found['power_a_number']:.3g}",
                         *[told(rule) for rule in ("crossing", "cross_validation", "risk", "l_curve")]])
    if not rows:
        return ""
    head = ["study", "n", "V'N^-1V / n", "crossing for T²", "generalised cross-validation", "predictive risk", "L-curve"]
    return "\n### epsilon by four rules\n\n" + table(head, rows) + (
        "\n[What each rule is](engines.md#choosing-epsilon).\n"
    )


def point_beams(name, said):
    study = load(f"{name}/study.json")
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
    rows = []
    for case in study["cases"]:
        path = OUT / name / case["folder"] / "summary.json"
        for beam in json.loads(path.read_text())["channels"][0]["point_beams"]:
            def told(widths):
                if not widths:
                    return ["-", "-"]
                major, minor = widths["fwhm_major_deg"], widths["fwhm_minor_deg"]
                return [f"{math.sqrt(major * minor):.2f}", f"{major:.2f} x {minor:.2f}"]
            rows.append([case["figures"]["name"], f"{beam['latitude_deg']:.1f}", *told(beam.get("solved")), *told(beam.get("processed"))])
    head = ["case", "ecliptic latitude, deg", "FWHM, deg", "axes", "after post-processing", "axes"]
    return table(head, rows) + f"\n{said}\n"


def thinned_crossing():
    return (
        "\nFrom every 40th window. This crossing lies near the paper's only by its thinning: both traces fall when data are added. A crossing "
         "from all data at this nside has not been measured.\n"
    )


def correlation(name, key, ls, head, said):
    study = load(f"{name}/study.json")
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
    rows = []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        values = channel[key]
        rows.append([case["figures"]["name"], f"{channel['visibilities']:,}", *[at(values, l) for l in ls]])
    return table([head, "visibilities", *[f"{'rho' if key == 'rho' else 'SNR'}_{l}" for l in ls]], rows) + f"\n{said}\n"


def rows_of_b(key, wanted, said):
    study = load("fig16-17-rows/study.json")
    if study is None:
        return missing("lunarray study pipelines/paper/fig16-17-rows.toml")
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
    return table(["rows, limit", "visibilities", *[f"{name}_{l}" for l in ls]], rows) + f"\n{said}\n"


def sensitivity(name="fig19-sensitivity", nside=16):
    study = load(f"{name}/study.json")
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
    rows = []
    # Pixels as beams, where the beam is not known.
    pixel = 4 * math.pi / (12 * nside * nside)
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        frequency, noise = channel["frequency_hz"], channel["noise_rms_k"]
        beam = channel.get("beam") or {}
        jansky = 5 * 2 * BOLTZMANN * noise * (frequency / LIGHT) ** 2 / 1e-26
        rows.append([
            f"{frequency / 1e6:g}", f"{channel['visibilities']:,}", show(noise), show(jansky * pixel),
            show(beam.get("fwhm_deg"), "{:.2f}"),
            show(None if beam.get("area_sr") is None else jansky * beam["area_sr"]),
        ])
    head = ["MHz", "visibilities", "noise, K rms", "5 sigma, Jy a pixel", "beam, deg", "5 sigma, Jy a beam"]
    return table(head, rows) + (
        ""
    )


def flatness():
    """How the sensitivity of a pixel changes from 5 to 10 MHz in both studies, and which channels the larger one lacks."""
    rise, missing_mhz = {}, []
    for name in ("fig19-sensitivity", "fig19-nside64"):
        study = load(f"{name}/study.json")
        if study is None:
            return ""
        channels = [case["figures"]["channels"][0] for case in study["cases"]]
        of = {round(channel["frequency_hz"] / 1e6): channel["noise_rms_k"] * channel["frequency_hz"] ** 2 for channel in channels}
        rise[name] = of[10] / of[5]
        missing_mhz = [str(mhz) for mhz in (2, 3, 5, 10, 20, 30) if mhz not in of]
    text = (f"\nFrom 5 to 10 MHz sensitivity rises by {rise['fig19-nside64']:.2f}, at nside 16 by {rise['fig19-sensitivity']:.2f}: the larger the "
            "map, the flatter.\n")
    return text + (f"Not made here yet: {' and '.join(missing_mhz)} MHz.\n" if missing_mhz else "")


def pair_sensitivity():
    """Fig. 19 from the radiometer equation alone: 2 k T_sys nu^2 / c^2 / sqrt(2 dnu t), t the pair-time within 2 b_p.

    From `lunarray figure pair-time pipelines/paper-10mhz.toml` with the study's channels, every 4th window, into
    out/figures-nside16 and -nside64, with map.nside and spacecraft.baseline_wavelengths_max 31.3 and 125.1.
    """
    found = [load(f"figures-nside{nside}/pair-time.json") for nside in (16, 64)]
    if None in found:
        return ""
    rows = []
    small, large = ({c["frequency_hz"]: c for c in n["channels"]} for n in found)
    # Mean sky of Cane (1979), seen by 76 % of the sphere.
    def sky(f):
        tau = 5 * (f / 1e6) ** -2.1
        i = 2.48e-20 * (f / 1e6) ** -0.52 * (1 - math.exp(-tau)) / tau + 1.06e-20 * (f / 1e6) ** -0.80 * math.exp(-tau)
        return i * LIGHT**2 / (2 * BOLTZMANN * f**2)
    for f in sorted(small):
        if round(f / 1e6) not in (1, 3, 5, 10, 20, 30):
            continue
        power = sky(f) * 4 * math.pi * 0.761
        def sigma(c):
            # Every fourth window.
            return 5 * 2 * BOLTZMANN * power * (f / LIGHT) ** 2 / math.sqrt(2 * 8000 * 4 * c["pair_s"]) / 1e-26
        rows.append([f"{f / 1e6:g}", f"{4 * small[f]['pair_s'] / 3600:,.0f}", f"{4 * large[f]['pair_s'] / 3600:,.0f}",
                     show(sigma(small[f]), "{:.1f}"), show(sigma(large[f]), "{:.1f}")])
    head = ["MHz", "pair hours, nside 16", "nside 64", "5 sigma, Jy, nside 16", "nside 64"]
    # Independent: the paper's formula in numpy, rows averaged over pixels of nside 8, epsilon 1e-3, b < 2 b_p.
    dense = {"5": (299, 106.1), "10": (433, 111.5), "30": (1126, 155.1)}
    return (
        "\n**Why it rises here.** By the radiometer equation alone, 2 k T_sys nu² / c² over sqrt(2 dnu t), with the mean sky of Cane "
        "(1979) and t the time of all pairs within 2 b_p (`lunarray figure pair-time` with these channels), sensitivity is as the "
        "paper says, flat above 5 MHz and better below; the more so at nside 64, where more pairs are within 2 b_p:\n\n"
        + table(head, rows)
        + "\nThe noise of a map is the trace of Q W (W + eps)^-2 Qt, which counts every mode alike. A dense calculation of that formula "
        "in numpy, at nside 8, epsilon 1e-3, which shares no code with this program (`pipelines/paper/dense.py 8 MHZ 6000`):\n\n"
        + table(
            ["MHz", "5 sigma, Jy a pixel", "radiometer, Jy", "ratio"],
            [[f, f"{jy:,}", f"{rad:g}", f"{jy / rad:.1f}"] for f, (jy, rad) in dense.items()],
        )
        + "\nIt rises by 3.8 from 5 to 30 MHz, the study by 3.2: at a fixed nside the few pairs that are left at high "
         "frequencies measure modes less evenly, and the worst of them dominate the noise. T_sys is not the cause. At "
         "nside 64 the radiometer alone falls by a fifth from 5 to 30 MHz.\n"
    )


def main():
    machine = sys.argv[1] if len(sys.argv) > 1 else "an unnamed machine"
    parts = [
        ("Fig. 1: a patch, and N(>S)", f"`{SKY}`, `{CUTOUT}`", counts()),
        ("Fig. 2: the full sky", "By the same command.", full_sky()),
        ("Fig. 3: q0 against R and R_2", f"`{FIGURE.format('spacing')}`", figure("spacing", spacing)),
        ("Fig. 4: time by baseline length", f"`{FIGURE.format('pair-time')}`",
         figure("pair-time", pair_time) + "\n### Time by direction (Sect. 4.4)\n\n" + coverage()),
        ("Fig. 5: density of u, v, w", f"`{FIGURE.format('uvw')}`", figure("uvw", uvw)),
        ("Fig. 6: the sky reflected by the Moon", "`lunarray study pipelines/paper/fig6-reflection.toml`",
         latitudes("fig6-reflection", "lunarray study pipelines/paper/fig6-reflection.toml",
                   "The table is of a flat mirror, which does not show the band between the horizontal and the limb, 31.5 degrees "
                   "lower.")),
        ("Fig. 7: a row of B", f"`{FIGURE.format('rows')}`", figure("rows", beam_row)),
        ("Fig. 8: waterfalls of one pair",
         f"`{FIGURE.format('waterfall')}`, here with `--set map.nside=8 --set spacecraft.baseline_wavelengths_max=15.7`", figure("waterfall", waterfall)),
        ("Fig. 9 and 10: the maps at 10 and 3 MHz, full size", "`lunarray run pipelines/paper-10mhz.toml`, "
         "`lunarray run pipelines/paper-3mhz.toml`", maps() + "\n### Is the noise uniform?\n\n" + uniformity()),
        ("Fig. 11: a prior of 5 degrees", "`lunarray study pipelines/paper/fig11-prior.toml`",
         correlation("fig11-prior", "rho", (2, 4, 8, 12, 16, 32, 64, 128), "case",
                     "")),
        ("Fig. 12: a wrong prior", "`lunarray study pipelines/paper/fig12-wrong-prior.toml` (its head says how the priors are made)",
         latitudes("fig12-wrong-prior", "lunarray study pipelines/paper/fig12-wrong-prior.toml",
                   "")),
        ("Fig. 13 and 14: patches of 20 x 20 degrees, large scales subtracted",
         "After `lunarray run pipelines/paper-10mhz.toml --set products.smooth_fwhm_deg=1 --out out/paper-10mhz` (3 MHz alike): "
         f"`{patch_command('10', 0)}` and so on", patches()),
        ("Fig. 15: traces against epsilon", "`lunarray study pipelines/paper/fig15-traces.toml`",
         traces() + "\n![rho, SNR, power and traces against epsilon](paper-fig15.png)\n" + basis()
         + "\n### In pixels, nside 16\n\n`lunarray study pipelines/paper/fig15-pixels.toml`\n\n" + traces("fig15-pixels") + thinned_crossing()
         + epsilon_rules("fig15-traces", "fig15-pixels")
         + "\nCross-validation and risk know only the noise and what pixels leave of the sky: for data that are 24 times brighter than their noise they "
           "ask for as little regularisation as the study has.\n"),
        ("Fig. 16: rows at centres and averaged, rho_l without noise",
         "`lunarray study pipelines/paper/fig16-17-rows.toml`",
         rows_of_b("rho", "no noise", "Ours agrees at nside 16. Many windows matter more than many integrations of each: every 4th is half a "
         "wavelength from the last.")
         + "\n### At nside 32\n\n`lunarray study pipelines/paper/fig16-nside32.toml` (`map.matrix = \"free\"`)\n\n"
         + correlation("fig16-nside32", "rho", (8, 16, 20, 24, 32, 48, 64), "limit, rows",
                       "At this size, too, averaged rows are the same whatever the limit: 0.99 or more from l = 20 to 48 at b_p over "
                       "2, b_p and 2 b_p. Rows at centres are nearly as good below b_p over 2 up to l = 32, lose a tenth at b_p, half at 2 "
                       "b_p, and most at 4 b_p. Iterations end at a residual of 1e-4, averaged ones of b_p over 2 after 300 products at "
                       "5e-4. Averaged rows of 2 b_p took 3,392 s on one of two cores beside other work; those of 4 b_p were left "
                       "after 42 products.")
         + "\n### At nside 64\n\n`lunarray study pipelines/paper/fig16-nside64.toml` (`map.matrix = \"free\"`)\n\n"
         + correlation("fig16-nside64", "rho", (8, 16, 24, 32, 64, 80, 96, 128), "limit, rows",
                       "At the paper's size, too, averaged rows keep 0.98 and more from l = 24 to 80 below b_p over 2, where rows at centres end at "
                       "0.93; at b_p these lose 6 to 8 % at l = 24 to 48, a sixth at 64 and half at 128.")),
        ("Fig. 17: the same, SNR_l with thermal noise", "`lunarray study pipelines/paper/fig16-17-rows.toml`",
         rows_of_b("snr", "thermal noise", "Averaged rows gain with baselines up to 2 b_p and keep it up to 4 b_p (2.5, 3.2, 3.4 at l = 24); rows at "
         "centres lose from b_p on (2.8, 1.5, 1.1). These take long baselines for better measured than they are, so "
         "that single degrees of a wrong map have a high SNR_l (15.9 at l = 8).")),
        ("Fig. 18: rho_l without noise for epsilon from 1e-9 to 1", "`lunarray study pipelines/paper/fig18-epsilon.toml`",
         correlation("fig18-epsilon", "rho", (8, 16, 32, 64, 96, 128), "epsilon",
                     "")),
        ("Fig. 19: sensitivity against frequency", "`lunarray study pipelines/paper/fig19-sensitivity.toml`",
         sensitivity() + pair_sensitivity()
         + "\n### At nside 64\n\n`lunarray study pipelines/paper/fig19-nside64.toml`, from every 40th window\n\n"
         + sensitivity("fig19-nside64", 64) + flatness()),
        ("FWHM after post-processing", "`lunarray study pipelines/paper/beams.toml`",
         point_beams("beams", "At nside 16 and smoothed to 4 degrees, where the paper's 1.3 at nside 64 and 1 degree would be 5.2. In pixels it is "
                     "4.5 to 5.0 in all directions; harmonics of equal weight to l = 40 have 5.4 to 6.5.")
         + "\n### At nside 64\n\n`lunarray study pipelines/paper/beams-nside64.toml`\n\n"
         + point_beams("beams-nside64", "In harmonics to l = 160, from every tenth window: the same width in all directions, 1.58 degrees by theory for a "
                       "beam that keeps all degrees up to 160.")),
        ("Fig. 20 and the appendix: N_b and Sigma_b", f"`{FIGURE.format('sub-pixel')}`", figure("sub-pixel", sub_pixel)),
    ]
    print("# The paper, figure by figure\n")
    print("What arXiv:2511.18494 says (in our words, with its section), the command, our numbers, and where and why they differ. All "
          "maps are with R = epsilon W_max I (`regulariser identity`), as the paper's. Written by "
          f"`pipelines/paper/report.py` from results on {machine}; Fig. 19 at full size was added by hand. Sizes are in "
          "the study files, which say where they are smaller than the paper's; each study draws `study.png`. The sky is generated, with the paper's "
          "small scales and sources; the paper's is ULSA.\n")
    said = notes()
    for title, command, text in parts:
        print(f"## {title}\n\n{said.pop(title)}\n\n{command}\n\n{text}")
    if said:
        sys.exit(f"error: notes on no sheet: {list(said)}")


if __name__ == "__main__":
    main()
