"""The memory of a page that stays open while a mission goes by, and of the server behind it.

page_memory.py LUNARRAY PIPELINE DOWNLINK FOLDER SECONDS

A replay of DOWNLINK, paced to last SECONDS, is watched by a page in Chromium on which somebody goes through channels, projections,
snapshots and differences. Once a second the page's heap is measured after a forced collection of garbage (`JSHeapUsedSize` of the
DevTools protocol), with its nodes and listeners, and the server's resident memory. After the first third, in which both fill what
they keep anyway, none may grow by more than its bound.
"""

import re
import sys
import time
from pathlib import Path

import numpy as np
from browser import Browser
from page import Served

MISSION_S = 471 * 86400.0
SNAPSHOTS = 300
SAMPLES = 9

# What may come on top after the first third. A leak of the smallest kind that there could be, one status kept of the two in a second,
# is some 10 kB of heap: 1 MB in the shortest run, 15 MB in one of ten minutes. Figures of all snapshots, up to 512 a channel, are kept
# on purpose: about 1 kB each.
HEAP_BYTES = 1.0e6
# The log has its 256 lines by then, the tables their rows; time lines may still gain some.
NODES = 500
# Allocators of two threads keep what they were given; maps here are of 768 bytes, and 32 of them are held for each channel.
SERVER_BYTES = 8.0e6
# The ground keeps the positions of every pass for what is sent again: 47 nodes of 8 daughters with 24 bytes, and what holds them. There are
# 8,192 passes of it at most.
PASS_BYTES = 10.0e3


def cdp(browser, command, **params):
    return browser.post("goog/cdp/execute", cmd=command, params=params)


def resident_bytes(process):
    status = Path(f"/proc/{process.pid}/status").read_text()
    return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS:"))


def sample(browser, served):
    cdp(browser, "HeapProfiler.collectGarbage")
    found = {metric["name"]: metric["value"] for metric in cdp(browser, "Performance.getMetrics")["metrics"]}
    return [found["JSHeapUsedSize"], found["Nodes"], found["JSEventListeners"], resident_bytes(served.process)]


def main():
    lunarray, pipeline, downlink, folder, seconds = sys.argv[1:]
    seconds = float(seconds)
    pace = ["--speed", str(MISSION_S / seconds), "--set", f"map.snapshot_every_s={MISSION_S / SNAPSHOTS}"]
    replay = [lunarray, "replay", downlink, "--map", pipeline, "--out", str(Path(folder) / "year"), *pace, "--serve-after"]
    with Served(*replay) as served, Browser((1280, 1000)) as browser:
        cdp(browser, "Performance.enable")
        cdp(browser, "HeapProfiler.enable")
        browser.get(served.url)
        samples = []
        # On a very busy machine some are taken after the end, when all that was kept on the way is still there.
        while (status := served.status())["phase"] in ("starting", "running") or len(samples) < SAMPLES:
            # All views, so that each sample is of the same one.
            for key in [*"p2fd1sdf", "ArrowLeft"]:
                browser.press(key)
            samples.append(sample(browser, served))
            time.sleep(1)
        assert status["phase"] == "ended" and status["ledger"]["unaccounted"] == 0, status["error"]
        last = [channel["figures"]["number"] for channel in status["channels"]]
        log = browser.js("return document.querySelectorAll('#log li').length")
        errors = [entry["message"] for entry in browser.log("browser") if entry["level"] == "SEVERE"]
    assert min(last) > 0.5 * SNAPSHOTS and log == 256, f"{last} snapshots and {log} lines of the log are no long time"
    # A map may be thinned away between the status that names it and its request.
    errors = [error for error in errors if not re.search(r"/api/maps/\d+/\d+\.f32 .* 404 ", error)]
    assert not errors, errors
    samples = np.array(samples)
    third = len(samples) // 3
    # What is kept is in every sample; what is garbage, only in some.
    middle, end = (part.min(axis=0) for part in (samples[third : 2 * third], samples[2 * third :]))
    packets, passes = (status["reception"][kind]["packets"] for kind in ["visibilities", "ephemeris"])
    print(f"{seconds:.0f} s, {packets} packets of visibilities, {passes} of positions, {last} snapshots, {len(samples)} samples; least of the second and the last third:")
    for name, before, after, unit in zip(["heap", "nodes", "listeners", "server"], middle, end, ["MB", "", "", "MB"], strict=True):
        scale = 1e6 if unit else 1
        print(f"  {name}: {before / scale:.2f} {unit} and {after / scale:.2f} {unit}")
    heap, nodes, listeners, server = end - middle
    # From the middle of a third to that of the next is a third of the passes.
    server_most = SERVER_BYTES + PASS_BYTES * passes / 3
    grown = {"heap": heap > HEAP_BYTES, "nodes": nodes > NODES, "listeners": listeners > 10, "server": server > server_most}
    assert not any(grown.values()), f"{grown}\n{samples.tolist()}"


main()
