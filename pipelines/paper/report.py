#!/usr/bin/env python3
"""Prints the tables of docs/paper.md from the results of the studies of this folder; the words of that page are written by hand.

Run from the top of the checkout after the runs and studies that the page names; needs Python with Pillow, and healpy for noise maps:

    python3 pipelines/paper/report.py

Pictures that the page shows go beside it, into docs/, in 128 colours and at most 1,200 pixels wide.
"""

import json
import math
from pathlib import Path

OUT = Path("out")
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


def missing(command):
    return f"Not made here yet: `{command}`.\n"



FIGURE = "lunarray figure {} pipelines/paper-10mhz.toml"


def figure(name, text, command=None, what=""):
    numbers = load(f"figures/{name}.json")
    if numbers is None:
        return missing(command or FIGURE.format(name))
    return text(numbers) + picture(f"figures/{name}.png", f"paper-{name}.png", what or name)


SKY = "lunarray sky pipelines/paper-10mhz.toml --freq-hz 10e6 --nside 256 --out out/sky-10mhz.fits --sources out/sources-10mhz.csv"
DIFFUSE = ("lunarray sky pipelines/paper-10mhz.toml --set sky.generated.point_sources=false --freq-hz 10e6 --nside 256 "
           "--out out/diffuse-10mhz.fits")
CUTOUT = "lunarray cutout out/diffuse-10mhz.fits --frame ecliptic --centre 120,0 --out out/patch.png"
FULL_SKY = ("lunarray run pipelines/paper-10mhz.toml --set spacecraft.duration_s=30000 --set products.frame=ecliptic "
            "--set products.smooth_fwhm_deg=1.3 --out out/full-sky")


def full_sky():
    return picture("full-sky/10.000MHz/input.png", "paper-sky.png", "the sky at 10 MHz") or missing(FULL_SKY)


def counts():
    fluxes = {}
    for mhz in (3, 10, 30):
        path = OUT / f"sources-{mhz}mhz.csv"
        if not path.exists():
            return missing(SKY.replace("10mhz", f"{mhz}mhz").replace("10e6", f"{mhz}e6"))
        fluxes[mhz] = [float(line.split(",")[3]) for line in path.read_text().splitlines()[1:]]
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
            ["of u, w and v, w", f"{n['filled'][1]:.3f}, {n['filled'][2]:.3f}", "-"],
        ],
    )


def coverage():
    n = load("figures/coverage.json")
    command = "lunarray figure coverage pipelines/paper-10mhz.toml --set spacecraft.channels_hz=[10e6,3e6]"
    if n is None:
        return missing(command)
    rows = [
        [f"{band['latitude_deg'][0]:g} to {band['latitude_deg'][1]:g}", f"{band['pair_h']:,.0f}",
         f"{band['shortest_wavelengths']:.2f}", f"{band['uv_filled']:.2f}"]
        for band in n["channels"][0]["bands"]
    ]
    head = ["degrees from the ecliptic", "pair hours at 10 MHz", "shortest projected, wavelengths", "uv filled"]
    least, mean, most = (1 / share for share in reversed(n["first_over_channel"][1]))
    return f"`{command}`\n\n" + table(head, rows) + f"\nHours at 3 MHz over those at 10: {mean:.2f} ({least:.2f} to {most:.2f}).\n"


def beam_row(n):
    return (
        f"Pair {n['pair']}, {n['length_m']:.0f} m = {n['length_bp']:.2f} b_p at {n['frequency_hz'] / 1e6:g} MHz, nside "
        f"{n['nside']}: the Moon leaves {100 * n['seen']:.1f} % of the pixels; mean square of the row there "
        f"{n['centre_power']:.3f} at centres, {n['average_power']:.3f} averaged.\n"
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
        if found is None:
            return missing("lunarray study pipelines/paper/fig6-power.toml")
        means[case] = sum(auto["mean_k_sr"] for auto in found) / len(found)
    return "".join(f"{case}: {100 * (mean / means['no-reflection'] - 1):+.2f} %\n" for case, mean in means.items()) + "\n"


def latitudes(name):
    study = load(f"{name}/study.json")
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
    rows, head = [], []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        bands = channel.get("latitudes") or []
        head = [f"{band['from_deg']:g} to {band['to_deg']:g} deg" for band in bands]
        rows.append([case["figures"]["name"], show(channel["mean_k"], "{:.3e}"),
                     *[f"{100 * band['mean']:+.1f}, {100 * band['rms']:.1f}" for band in bands]])
    return table(["case", "mean, K", *head], rows)


def thinned(name, nside, visibilities_all):
    """Rows of traces by thinning, Tr Sigma_n scaled to all data; the crossing is on straight lines in logarithms."""
    study, found, rows = load(f"{name}/study.json"), {}, []
    for case in (study or {}).get("cases", []):
        channel = case["figures"]["channels"][0]
        thin = int(case["figures"]["name"].split("thin = ")[1].split(",")[0])
        t2 = channel["power"]["input_k2"][0] / (4 * math.pi)
        traces = channel["diagnostics"]["traces"]
        n, s = traces["sigma_n_k2"]["value"] * channel["visibilities"] / visibilities_all, traces["sigma_s"]["value"]
        found.setdefault(thin, []).append((channel["diagnostics"]["epsilon"], n, s, math.log(n / (t2 * s)), t2 * s))
    for thin, points in found.items():
        crossing = None
        for (e, *_, above, _), (e2, *_, above2, _) in zip(points, points[1:]):
            if above > 0 > above2:
                crossing = e * (e2 / e) ** (above / (above - above2))
        data = "all" if thin == 1 else f"one in {thin}"
        for e, n, s, _, ts in points:
            rows.append([f"{nside}, {data}", f"{e:.0e}", show(n), f"{s:.4g}", show(ts), show(crossing, "{:.1e}")])
    return rows


def pixel_traces():
    rows = thinned("fig15-nside8", 8, 569_208) + thinned("fig15-pixels", 16, 2_034_350)
    return table(["nside, data", "epsilon", "Tr Sigma_n, K²", "Tr Sigma_s", "T² Tr Sigma_s, K²", "crossing"], rows)


# Ecliptic longitude and latitude of the paper's patches.
PATCHES = ("120,0", "120,30", "120,60")


def patch_command(k):
    folder = "out/data-10mhz/10.000MHz"
    return (f"lunarray cutout {folder}/input.fits {folder}/map.fits --frame ecliptic --centre {PATCHES[k]} --subtract-fwhm 5 "
            f"--out out/patch-10-{k + 1}.png --json > out/patch-10-{k + 1}.json")


def patches():
    rows, shown = [], ""
    for k, centre in enumerate(PATCHES):
        found = load(f"patch-10-{k + 1}.json")
        if found is None:
            return missing(patch_command(k))
        truth, ours = found["pieces"]
        rows.append([centre, show(truth["rms_k"]), show(ours["rms_k"]), f"{ours['correlation']:.3f}"])
        shown += picture(f"patch-10-{k + 1}.png", f"paper-patch-10-{k + 1}.png", centre)
    return table(["centre, ecliptic deg", "rms of the input, K", "of the map, K", "correlation"], rows) + shown


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
    return table(head, rows)


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
    return f"`{command}`\n\n" + table(head, rows)


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
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
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
    if study is None:
        return missing(f"lunarray study pipelines/paper/{name}.toml")
    rows = []
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        rows.append([case["figures"]["name"], f"{channel['visibilities']:,}", *[at(channel[key], l) for l in ls]])
    name = {"rho": "rho", "snr": "SNR"}[key]
    return table([head, "visibilities", *[f"{name}_{l}" for l in ls]], rows)


def rows_of_b(key, wanted):
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
    return table(["rows, limit", "visibilities", *[f"{name}_{l}" for l in ls]], rows)


def sensitivity():
    """Fig. 19: noise maps after post-processing, less scales above 10 degrees, of one visibility in `thin`."""
    study = load("fig19-sensitivity/study.json")
    if study is None:
        return missing("lunarray study pipelines/paper/fig19-sensitivity.toml")
    import healpy
    import numpy as np

    thin, rows = 16, []
    for case in study["cases"]:
        folder = OUT / "fig19-sensitivity" / case["folder"]
        channel = json.loads((folder / "summary.json").read_text())["channels"][0]
        mhz = channel["frequency_hz"] / 1e6
        noise = healpy.read_map(folder / f"{mhz:.3f}MHz/noise-smooth.fits", dtype=float)
        small = noise - healpy.smoothing(noise, fwhm=math.radians(10), iter=1)
        sine = healpy.pix2vec(healpy.get_nside(noise), np.arange(noise.size))[2]
        area = channel["beam"]["area_sr"]
        # Noise falls as the root of the number of visibilities.
        jansky = 5 * 2 * BOLTZMANN * (channel["frequency_hz"] / LIGHT) ** 2 / 1e-26 * area / math.sqrt(thin)
        rows.append([f"{mhz:g}", show(small.std() / math.sqrt(thin)), f"{channel['beam']['fwhm_deg']:.2f}", show(area),
                     *[f"{jansky * x.std():.0f}" for x in (small, small[np.abs(sine) < 0.5], noise)]])
    head = ["MHz", "noise, K rms", "beam, deg", "beam, sr", "5 sigma, Jy a beam", "within 30 deg of the ecliptic", "with large scales"]
    return table(head, rows)


def main():
    study = "`lunarray study pipelines/paper/{}.toml`"
    parts = [
        ("Fig. 1: a patch, and N(>S)", f"`{SKY}`, 3 and 30 MHz alike; `{DIFFUSE}`, `{CUTOUT}`", counts()),
        ("Fig. 2: the full sky", f"`{FULL_SKY}`", full_sky()),
        ("Fig. 3: q0 against R and R_2", f"`{FIGURE.format('spacing')}`", figure("spacing", spacing)),
        ("Fig. 4: time by baseline length", f"`{FIGURE.format('pair-time')}`", figure("pair-time", pair_time)),
        ("Time by direction (Sect. 4.4)", "", coverage()),
        ("Fig. 5: density of u, v, w", f"`{FIGURE.format('uvw')}`", figure("uvw", uvw)),
        ("Fig. 6: the sky reflected by the Moon", study.format("fig6-reflection"), powers() + latitudes("fig6-reflection")),
        ("Fig. 7: a row of B", f"`{FIGURE.format('rows')} --pair 5-6 --at 4.1736d`", figure("rows", beam_row)),
        ("Fig. 8: waterfalls of one pair",
         f"`{FIGURE.format('waterfall')} --pair 1-4 --at 6.65d`",
         figure("waterfall", waterfall)),
        ("Fig. 9 and 10: the maps at 10 and 3 MHz, full size",
         "`lunarray run pipelines/paper-10mhz.toml`, `lunarray run pipelines/paper-3mhz.toml`", maps()),
        ("By basis and R", study.format("fig9-basis"), latitudes("fig9-basis")),
        ("Is the noise uniform?", "", uniformity()),
        ("Fig. 11: a prior of 5 degrees", study.format("fig11-prior"),
         correlation("fig11-prior", (2, 4, 8, 12, 16, 32, 64, 128), "case")),
        ("Fig. 12: a wrong prior", study.format("fig12-wrong-prior"), latitudes("fig12-wrong-prior")),
        ("Fig. 13 and 14: patches of 20 x 20 degrees, large scales subtracted", f"`{patch_command(0)}` and so on", patches()),
        ("Fig. 15: traces against epsilon", study.format("fig15-pixels"),
         pixel_traces() + "\n" + traces()),
        ("Fig. 16: rows at centres and averaged, rho_l without noise", study.format("fig16-17-rows"), rows_of_b("rho", "no noise")),
        ("At nside 32", study.format("fig16-nside32"), correlation("fig16-nside32", (8, 16, 20, 24, 32, 48, 64), "limit, rows")),
        ("At nside 64", study.format("fig16-nside64"),
         correlation("fig16-nside64", (8, 16, 24, 32, 64, 80, 96, 128), "limit, rows")),
        ("Fig. 17: the same, SNR_l with thermal noise", study.format("fig16-17-rows"), rows_of_b("snr", "thermal noise")),
        ("Fig. 18: rho_l without noise, and SNR_l, for epsilon from 1e-9 to 1", study.format("fig18-epsilon"),
         correlation("fig18-epsilon", (8, 16, 32, 64, 96, 128), "epsilon")),
        ("Fig. 18: SNR_l", study.format("fig18-snr"), correlation("fig18-snr", (4, 8, 12, 16, 24, 32, 48, 64), "epsilon", "snr")),
        ("Fig. 19: sensitivity against frequency", study.format("fig19-sensitivity"), sensitivity()),
        ("FWHM after post-processing", study.format("beams"), point_beams("beams")),
        ("FWHM at nside 64", study.format("beams-nside64"), point_beams("beams-nside64")),
        ("Fig. 20 and the appendix: N_b and Sigma_b", f"`{FIGURE.format('sub-pixel')}`; the formulas: `sub_pixel.py`",
         figure("sub-pixel", sub_pixel) + picture("sub-pixel-matrix.png", "paper-sub-pixel-matrix.png", "N_b")),
    ]
    for title, command, text in parts:
        print(f"## {title}\n\n{command}\n\n{text}" if command else f"## {title}\n\n{text}")


if __name__ == "__main__":
    main()
