"""The mission in a browser tab: its last map is that of `lunarray run` with the keys that the page names.

tab.py LUNARRAY BOOK FOLDER PICTURES

LUNARRAY is the command, BOOK the site with lunarray_tab.wasm. The run writes below FOLDER, pictures of the page go to PICTURES.
Correlations with the sky are healpy's.
"""

import functools
import http.server
import subprocess
import sys
import threading
import time
from pathlib import Path

import healpy
import numpy as np
from browser import Browser

PATIENCE_S = 600  # On however busy a machine.
# Sines and cosines of wasm32 and of the system differ in their last bits. Measured at 3 MHz: 9e-6.
TOLERANCE = 1e-4


MAPS = """const { error, maps } = window.lunarrayTab;
return [error ?? null, maps.map(map => ({ ...map, map_k: [...map.map_k], picture: map.picture.byteLength }))]"""
STATUS = "return document.getElementById('tab-status').textContent"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


def flown(browser):
    """The maps of a mission, once it has ended."""
    browser.click("#tab button")
    since = time.monotonic()
    while True:
        found = browser.js(MAPS)
        assert found[0] is None, found[0]
        if found[1] and found[1][-1]["state"] == 2:
            return found[1]
        assert time.monotonic() - since < PATIENCE_S, browser.js(STATUS)
        time.sleep(0.5)


def rho(a, b):
    """Correlation by degree."""
    return healpy.anafast(a, b) / np.sqrt(healpy.anafast(a) * healpy.anafast(b))


def check(maps, native, sky):
    """Maps of the tab against the last map and the sky of the native program."""
    last = np.array(maps[-1]["map_k"])
    apart = np.abs(last - native).max() / native.std()
    print(f"{len(maps)} maps; largest difference from the native map: {apart:.1e} of its standard deviation")
    assert len(maps) >= 4 and maps[-1]["map"]["is_final"]
    assert apart < TOLERANCE
    found = rho(last, sky)
    print("rho_2 .. rho_8:", np.round(found[2:9], 3))
    # The page compares with the sky at its own resolution, which has more than the map's degrees, at the degrees they share.
    assert found[2:9].min() > 0.9
    assert np.abs(found[2:9] - maps[-1]["map"]["rho"][2:9]).max() < 0.02


def main(lunarray, book, folder, pictures):
    pictures.mkdir(parents=True, exist_ok=True)
    handler = functools.partial(Quiet, directory=str(book))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with Browser((1280, 1700)) as browser:
        browser.get(f"http://127.0.0.1:{server.server_port}/tab.html")
        maps = flown(browser)
        print(f"first map after {maps[0]['seconds']:.1f} s, last after {maps[-1]['seconds']:.1f} s")
        for theme in ["light", "navy"]:
            browser.js("document.documentElement.className = arguments[0]", f"js sidebar-hidden {theme}")
            browser.screenshot(pictures / f"tab-{theme}.png")
        bad = [entry for entry in browser.log("browser") if entry["level"] == "SEVERE" and "favicon" not in entry["message"]]
        assert not bad, bad
    server.shutdown()
    keys = [word for key in maps[-1]["keys"] for word in ("--set", key)]
    subprocess.run([lunarray, "run", "--out", folder / "native", *keys], check=True, capture_output=True)
    [channel] = (folder / "native").glob("*MHz")
    native = healpy.read_map(channel / "map.fits", dtype=np.float64)
    sky = healpy.read_map(channel / "input.fits", dtype=np.float64)
    check(maps, native, sky)


if __name__ == "__main__":
    main(sys.argv[1], *map(Path, sys.argv[2:]))
