#!/usr/bin/env python3
"""Writes docs/paper.md from the results of the studies of this folder.

Run from the top of the checkout after the runs and studies that the page names; needs Python only:

    python3 pipelines/paper/report.py "2 cores of an Intel Xeon" > docs/paper.md
"""

import json
import math
import sys
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


def missing(command):
    return f"Not made here yet: `{command}`.\n"



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
        return "Their numbers are in the README, measured with earlier versions.\n"
    head = ["MHz", "visibilities", *[f"rho_{l}" for l in (8, 16, 32, 64, 96, 128)], "noise, K rms", "minutes"]
    return table(head, rows) + (
        "\nrho_l with the noise's power subtracted. The paper: near 1 for 18 < l < 130 at 10 MHz, falling below l = 18, and the "
        "poles too dark; at 3 MHz, epsilon 1e-6, not.\n"
    )


def traces():
    study = load("fig15-traces/study.json")
    if study is None:
        return missing("lunarray study pipelines/paper/fig15-traces.toml")
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
            f"T Tr Sigma_s {where[1]}. The paper: they cross at about 2e-3 for its data set.\n"
        )
    return text


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


def sensitivity():
    study = load("fig19-sensitivity/study.json")
    if study is None:
        return missing("lunarray study pipelines/paper/fig19-sensitivity.toml")
    rows = []
    # Pixels of nside 16 as beams: a lower limit of the effective beam.
    beam = 4 * math.pi / (12 * 16 * 16)
    for case in study["cases"]:
        channel = case["figures"]["channels"][0]
        frequency, noise = channel["frequency_hz"], channel["noise_rms_k"]
        jansky = 5 * 2 * BOLTZMANN * noise * (frequency / LIGHT) ** 2 * beam / 1e-26
        rows.append([f"{frequency / 1e6:g}", f"{channel['visibilities']:,}", show(noise), show(jansky)])
    return table(["MHz", "visibilities", "noise, K rms", "5 sigma, Jy a pixel"], rows) + (
        "\nThe paper: flat above 5 MHz, improving quickly below, as absorption suppresses the sky there. Here the beam is a pixel of "
        "nside 16 at every frequency, not that of the post-processed map.\n"
    )


def main():
    machine = sys.argv[1] if len(sys.argv) > 1 else "an unnamed machine"
    parts = [
        ("Fig. 9 and 10: the maps at 10 and 3 MHz, full size", "`lunarray run pipelines/paper-10mhz.toml`, "
         "`lunarray run pipelines/paper-3mhz.toml`", maps()),
        ("Fig. 11: a prior of 5 degrees", "`lunarray study pipelines/paper/fig11-prior.toml`",
         correlation("fig11-prior", "rho", (2, 4, 8, 12, 16, 32, 64, 128), "case",
                     "The paper: a prior cures the poles, which the shortest baseline leaves open below l = 18.")),
        ("Fig. 15: traces against epsilon", "`lunarray study pipelines/paper/fig15-traces.toml`",
         traces() + "\n![rho, SNR, power and traces against epsilon](paper-fig15.png)\n"),
        ("Fig. 16: rows at centres and averaged, rho_l without noise",
         "`lunarray study pipelines/paper/fig16-17-rows.toml`",
         rows_of_b("rho", "no noise", "The paper: rows at centres are well below 1 from b_p on; averaged rows are not, and "
                   "b < 2 b_p and b < 4 b_p are alike.")),
        ("Fig. 17: the same, SNR_l with thermal noise", "`lunarray study pipelines/paper/fig16-17-rows.toml`",
         rows_of_b("snr", "thermal noise", "")),
        ("Fig. 18: rho_l without noise for epsilon from 1e-9 to 1", "`lunarray study pipelines/paper/fig18-epsilon.toml`",
         correlation("fig18-epsilon", "rho", (8, 16, 32, 64, 96, 128), "epsilon",
                     "The paper: rho_l does not depend on epsilon below 1e-2.")),
        ("Fig. 19: sensitivity against frequency", "`lunarray study pipelines/paper/fig19-sensitivity.toml`", sensitivity()),
    ]
    print("# The paper, figure by figure\n")
    print("What arXiv:2511.18494 shows, from this program: the command, our numbers, the paper's words. Written by "
          f"`pipelines/paper/report.py` from results on {machine}; each study leaves its curves in `study.png`. Sizes are in "
          "the study files; where they are smaller than the paper's the file says so. The sky is generated, with the paper's "
          "small scales and sources; the paper's is ULSA.\n")
    print("Not here yet: figures 1 to 8, 12 to 14 and 20.\n")
    for title, command, text in parts:
        print(f"## {title}\n\n{command}\n\n{text}")


if __name__ == "__main__":
    main()
