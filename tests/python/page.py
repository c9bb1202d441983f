"""The page in a real browser: its counts are those of /api/status, its pixels those of the FITS files, and its controls work.

page.py LUNARRAY PIPELINE DOWNLINK FOLDER PICTURES

LUNARRAY is the command, PIPELINE a pipeline file without pictures, DOWNLINK a file of its packets. Runs write below FOLDER,
pictures of the page go to PICTURES. Directions are healpy's: its pixel centres, its Mollweide projection, its rotations.
"""

import json
import re
import subprocess
import sys
import threading
import time
import urllib.request
from datetime import datetime, timedelta
from pathlib import Path

import healpy
import numpy as np
from browser import Browser, wait_until
from healpy.projector import MollweideProj

SNAPSHOTS = ["--set", "products.snapshot_maps=true", "--set", "map.snapshot_every_s=20e6"]
WINDOW = (1280, 1000)
MARGIN = 0.985  # Of the canvas; the rest is the rim.

# Published ends and middles of the colour maps, by which the server's are known to be what their names say.
KNOWN_COLOURS = {
    "inferno": [(0x00, 0x00, 0x04), (0xBC, 0x37, 0x54), (0xFC, 0xFF, 0xA4)],
    "viridis": [(0x44, 0x01, 0x54), (0x21, 0x91, 0x8C), (0xFD, 0xE7, 0x25)],
}


class Served:
    """A command that serves; is ended with its `with` block."""

    def __init__(self, *words, port="0"):
        self.process = subprocess.Popen(
            [*words, "--serve", port], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        said = []
        for line in self.process.stderr:
            said.append(line)
            if line.startswith("serving on "):
                self.url = line.split()[-1].rstrip("/")
                break
        else:
            raise AssertionError(f"it does not serve: {said}")
        # So that it never waits for a reader.
        threading.Thread(target=lambda: [None for _ in self.process.stderr], daemon=True).start()

    @property
    def port(self):
        return self.url.rsplit(":", 1)[1]

    def json(self, path):
        with urllib.request.urlopen(self.url + path, timeout=60) as answer:
            return json.load(answer)

    def status(self):
        return self.json("/api/status")

    def wait_for_phase(self, phase):
        wait_until(phase, lambda: self.status()["phase"] == phase)

    def end(self):
        self.process.terminate()
        self.process.wait()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()


class Colours:
    """The colour map of values on a scale between limits."""

    def __init__(self, palette, scale, low, high):
        self.palette, self.scale, self.low, self.high = palette, scale, low, high

    @classmethod
    def robust(cls, palette, values):
        """A logarithmic scale from 0.5 % to 99.5 % of the positive values."""
        rising = np.sort(values[values > 0])
        low, high = (rising[round(q * (len(rising) - 1))] for q in (0.005, 0.995))
        return cls(palette, "log", low, high)

    @classmethod
    def symmetric(cls, palette, values):
        sizes = np.sort(np.abs(values))
        high = sizes[round(0.99 * (len(sizes) - 1))]
        return cls(palette, "linear", -high, high)

    def index(self, values):
        if self.scale == "log":
            positive = np.where(values > 0, values, self.low)
            place = np.log(positive / self.low) / np.log(self.high / self.low)
        elif self.scale == "asinh":
            knee = 0.02 * max(abs(self.low), abs(self.high))
            low, high = np.arcsinh(self.low / knee), np.arcsinh(self.high / knee)
            place = (np.arcsinh(values / knee) - low) / (high - low)
        else:
            place = (values - self.low) / (self.high - self.low)
        return np.round(255 * np.clip(place, 0, 1)).astype(int)

    def distance(self, values, seen, shade):
        """Greatest difference of a component from the colour, or its neighbour in the palette: the page computes in 32 bits."""
        index = self.index(values)
        near = [self.palette[np.clip(index + by, 0, 255)] * shade[:, None] for by in (-1, 0, 1)]
        return np.min([np.abs(colour - seen).max(axis=1) for colour in near], axis=0)


def centres(nside, frame, projection):
    """Places of the pixel centres on the sky's disk (-1 to 1 to the right and up), those on the far side left out: numbers of
    pixels, x, y."""
    pixels = np.arange(healpy.nside2npix(nside))
    axes = {"galactic": "G", "ecliptic": "E", "equatorial": "C"}[frame]
    there = healpy.Rotator(coord=["E", axes])(np.array(healpy.pix2vec(nside, pixels)))
    if projection == "globe":
        x, y = -there[1], there[2]
        # At the rim a point of the canvas holds many degrees.
        keep = there[0] > 0.3
    else:
        x, y = MollweideProj().vec2xy(there)
        x = np.asarray(x) / 2
        keep = np.hypot(x, y) < 0.98
    return pixels[keep], np.asarray(x)[keep], np.asarray(y)[keep]


class Page:
    def __init__(self, browser, constants):
        self.browser, self.urls, self.console = browser, [], []
        self.palettes = {
            name: np.array([int(digits[k : k + 2], 16) for k in range(0, len(digits), 2)]).reshape(256, 3)
            for name, digits in constants["palettes"]
        }
        self.view = {"frame": "galactic", "projection": "mollweide"}

    def text(self, selector):
        return self.browser.js("return document.querySelector(arguments[0]).textContent", selector)

    def value(self, selector):
        return self.browser.js("return document.querySelector(arguments[0]).value", selector)

    def wait_for_text(self, selector, words):
        wait_until(f"{selector}: {words}", lambda: words in self.text(selector))

    def box(self, selector):
        script = "const b = document.querySelector(arguments[0]).getBoundingClientRect(); return [b.x, b.y, b.width, b.height]"
        return self.browser.js(script, selector)

    def on_canvas(self, x, y, size):
        """Places on the sky's disk in pixels of its canvas."""
        width, height = size
        if self.view["projection"] == "globe":
            half_x = half_y = MARGIN * min(width, height) / 2
        else:
            half_x = MARGIN * min(width / 2, height)
            half_y = half_x / 2
        return width / 2 + x * half_x, height / 2 - y * half_y

    def size(self):
        return self.browser.js("const c = document.getElementById('gl'); return [c.width, c.height]")

    def assert_sky(self, what, values, colours, is_marked=False):
        """The canvas has the colours of the values at all pixel centres in sight. With `is_marked`, negative ones are striped."""
        nside = healpy.npix2nside(len(values))
        pixels, x, y = centres(nside, **self.view)
        if is_marked:
            keep = values[pixels] > 0
            pixels, x, y = pixels[keep], x[keep], y[keep]
        shade = 0.72 + 0.28 * np.sqrt(1 - x**2 - y**2) if self.view["projection"] == "globe" else np.ones(len(x))
        px, py = (np.floor(place).astype(int).tolist() for place in self.on_canvas(x, y, self.size()))
        script = """
            const canvas = document.getElementById("gl"), { width, height } = canvas, gl = canvas.getContext("webgl2");
            const data = gl ? new Uint8Array(4 * width * height) : canvas.getContext("2d").getImageData(0, 0, width, height).data;
            if (gl) gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);
            // WebGL counts rows from below.
            const row = (y) => gl ? height - 1 - y : y;
            return arguments[0].map((x, k) => { const at = 4 * (row(arguments[1][k]) * width + x); return [...data.slice(at, at + 3)]; });"""
        used = len(set(colours.index(values[pixels]).tolist()))
        assert len(pixels) > 40 and used > 20, f"{what}: {len(pixels)} pixels of {used} colours say little"
        seen = []

        def is_right():
            found = np.array(self.browser.js(script, px, py))
            seen[:] = [colours.distance(values[pixels], found, shade), found]
            # One for the rounding of a component, on the globe of a shaded one too.
            return np.all(seen[0] <= (2 if self.view["projection"] == "globe" else 1))

        try:
            wait_until(what, is_right)
        except AssertionError as error:
            if not seen:
                raise
            wrong = np.flatnonzero(seen[0] > 2)[:9]
            what += f": pixels {pixels[wrong]} are {seen[1][wrong].tolist()}"
            raise AssertionError(f"{what}, expected {colours.palette[colours.index(values[pixels[wrong]])].tolist()}") from error

    def listen(self):
        """Collects the addresses of all requests, and what the console says."""
        for entry in self.browser.log("performance"):
            message = json.loads(entry["message"])["message"]
            if message["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated"):
                params = message["params"]
                self.urls.append(params["request"]["url"] if "request" in params else params["url"])
        self.console += self.browser.log("browser")

    def counts(self):
        """What the panels say: packets by kind, the ledger's entries, units by stage."""
        return self.browser.js("""
            const count = (text) => Number(text.replaceAll(",", ""));
            const rows = [...document.querySelectorAll("#packets tr")].slice(1).map((row) => [...row.cells].map((cell) => cell.textContent));
            const keys = [...document.querySelectorAll("#ledgerkeys li")].map((item) => [item.children[1].textContent, count(item.children[2].textContent)]);
            const stages = [...document.querySelectorAll("#stages .box")].map((box) => box.title.match(/^(\\S+): ([\\d,]+) /));
            return {
              packets: Object.fromEntries(rows.map(([kind, ...rest]) => [kind, rest.map(count)])),
              ledger: Object.fromEntries(keys),
              stages: Object.fromEntries(stages.map(([, name, units]) => [name, count(units)])),
            };""")

    def assert_counts(self, status):
        """All counts in the page are those of the interface, once what is on its way has arrived."""

        def of_interface():
            now = status()
            kinds = ["instrument", "ephemeris", "visibilities", "housekeeping"]
            fields = ["packets", "missing", "damaged", "duplicates"]
            ledger = now["ledger"]
            entries = {"accumulated": ledger["accumulated"]}
            entries |= {f"flagged: {reason}": count for reason, count in ledger["flagged"].items()}
            entries |= {f"lost in {lost['stage']}: {lost['reason']}": lost["count"] for lost in ledger["lost"]}
            return {
                "packets": {kind: [now["reception"][kind][field] for field in fields] for kind in kinds},
                "ledger": entries,
                "stages": {stage["name"]: stage["units"] for stage in now["stages"]},
            }

        def are_equal():
            expected, found = of_interface(), self.counts()
            # Without the rows that are no entry: a count before the end is a text, and what is on its way is a difference.
            found["ledger"] = {name: found["ledger"].get(name) for name in expected["ledger"]}
            last[:] = [expected, found]
            return expected == found

        last = []
        try:
            wait_until("equal counts", are_equal)
        except AssertionError as error:
            raise AssertionError(f"interface {last[0]}\npage {last[1]}") from error


class Panels:
    """Time line, orbit and baselines of the page."""

    LEFT, RIGHT, TOP, BARS = 72, 10, 6, 84  # Of the time line, CSS pixels.
    NAMES = {"visibilities": "visibilities", "ephemeris": "positions", "housekeeping": "reports", "instrument": "description"}

    def __init__(self, page, served):
        self.page, self.served, self.js = page, served, page.browser.js

    def colour(self, name):
        text = self.js("return getComputedStyle(document.documentElement).getPropertyValue(arguments[0]).trim()", name)
        return [int(text[k : k + 2], 16) for k in (1, 3, 5)]

    def pixels(self, canvas, places):
        """Colours of a canvas at places in CSS pixels; zero where nothing is drawn."""
        script = """
            const canvas = document.getElementById(arguments[0]), ratio = canvas.width / canvas.getBoundingClientRect().width;
            const { width, height } = canvas, data = canvas.getContext("2d").getImageData(0, 0, width, height).data;
            return arguments[1].map(([x, y]) => { const at = 4 * (Math.floor(y * ratio) * width + Math.floor(x * ratio)); return [...data.slice(at, at + 3)]; });"""
        return self.js(script, canvas, [[float(x), float(y)] for x, y in places])

    def assert_passes(self):
        """The sums of the time line are the counts of the status, and its bars stand where there are packets."""

        def as_told():
            status, text = self.served.status(), self.page.text("#passestext")
            expected = []
            for kind, name in self.NAMES.items():
                counts = status["reception"][kind]
                lost = f", {counts['missing']:,} missing" if counts["missing"] else ""
                expected.append(f"{name} {counts['packets']:,} received{lost}")
            last[:] = [text, "whole mission: " + " · ".join(expected)]
            return last[0] == last[1]

        last = []
        try:
            wait_until("the time line", as_told)
        except AssertionError as error:
            raise AssertionError(f"page {last[0]}, expected {last[1]}") from error
        line = self.served.json("/api/passes")
        received, missing = (
            np.array(next(kind[key] for kind in line["kinds"] if kind["kind"] == "visibilities")) for key in ("received", "missing")
        )
        width = self.page.box("#passes")[2] - self.LEFT - self.RIGHT
        middle = self.LEFT + (np.arange(len(received)) + 0.5) / len(received) * width
        # A bar covers whole pixels: its neighbours' middles may be in it.
        alone = (received + missing == 0) & (np.roll(received + missing, 1) == 0) & (np.roll(received + missing, -1) == 0)
        full = received > 0
        lost = (missing > 0) & (received == 0)
        base = self.TOP + self.BARS - 1
        for what, where, colour in [("received", full, "--cool"), ("missing", lost, "--bad"), ("nothing", alone[1:-1], None)]:
            expected = [0, 0, 0] if colour is None else self.colour(colour)
            places = middle[1:-1] if colour is None else middle
            found = self.pixels("passes", [(x, base) for x in places[where]])
            # Lines of the axis stand there, too, with soft edges.
            line_colour = np.array(self.colour("--line"))
            found = [seen for seen in found if colour is not None or np.abs(seen - line_colour).max() > 16]
            assert all(seen == expected for seen in found), (what, found, expected)
        assert full.sum() > 1, received
        return line

    def assert_orbit(self):
        """The Moon in the middle, its far side dark, the daughters at their places: seen from above the orbit, the Earth to the right."""
        geometry = self.served.json("/api/geometry")
        normal, earth = np.array(geometry["normal_hat"]), np.array(geometry["earth_hat"])
        right = earth - (earth @ normal) * normal
        right /= np.linalg.norm(right)
        axes = np.array([right, np.cross(normal, right)])
        width, height = self.page.box("#orbit")[2:]
        reach = max(np.linalg.norm(geometry["orbit_m"] + geometry["track_m"], axis=1))
        height -= 44  # For the ruler.
        per_m = 0.44 * min(width, height) / reach

        def put(place_m):
            x, y = per_m * (axes @ place_m)
            return width / 2 + x, height / 2 - y

        satellites = np.array([satellite["position_m"] for satellite in geometry["satellites"]])
        radius_m = geometry["moon_radius_m"]
        # The nearest of all is drawn above the others; all have one colour.
        assert self.pixels("orbit", [put(place) for place in satellites]) == [self.colour("--cool")] * len(satellites)
        sides = self.pixels("orbit", [put(0.9 * radius_m * right), put(-0.9 * radius_m * right)])
        assert sides == [self.colour("--moon"), self.colour("--far")], sides
        hidden = sum(satellite["earth_is_hidden"] for satellite in geometry["satellites"])
        assert f"day {geometry['time_s'] / 86400:.2f}" in self.page.text("#orbittext")
        of = f"all {hidden}" if hidden == len(satellites) else f"{hidden} of {len(satellites)}"
        assert f"Earth hidden from {of};" in self.page.text("#orbittext"), self.page.text("#orbittext")

    def assert_uvw(self, channel, palette):
        """Each cell has the colour of its count, at both signs."""
        density = self.served.json(f"/api/uvw/{channel}")
        wait_until("baselines", lambda: f"{density['visibilities']:,} visibilities" in self.page.text("#uvwtext"))
        cells = density["cells"]
        planes = np.array(density["planes"]).reshape(3, cells, cells)
        planes = planes + planes[:, ::-1, ::-1]
        width, height = self.page.box("#uvw")[2:]
        side = min((width - 16) / 3, height - 18)
        left = (width - 3 * side - 16) / 2
        place = (np.arange(cells) + 0.5) / cells * side
        places, expected = [], []
        for n, row, column in np.ndindex(planes.shape):
            if 0 < min(row, column) and max(row, column) < cells - 1 and (planes[n, row, column] > 0 or (row + column) % 7 == 0):
                places.append((left + n * (side + 8) + place[column], place[cells - 1 - row]))
                expected.append(planes[n, row, column])
        expected, found = np.array(expected), np.array(self.pixels("uvw", places))
        index = np.round(255 * (0.25 + 0.75 * np.log(np.maximum(expected, 1)) / np.log(planes.max()))).astype(int)
        colours = np.where((expected > 0)[:, None], palette[index], self.colour("--field"))
        wrong = np.abs(colours - found).max(axis=1) > 0
        assert (expected > 0).sum() > 50 and not wrong.any(), (wrong.sum(), len(wrong), colours[wrong][:5], found[wrong][:5])


def without_some(downlink, path):
    """Writes a downlink of packets but for some of visibilities; returns the ranges of their counts, the latest first."""
    data, at, count, packets = downlink.read_bytes(), 0, 0, []
    while at < len(data):
        end = at + 7 + int.from_bytes(data[at + 4 : at + 6], "big")
        is_visibilities = int.from_bytes(data[at : at + 2], "big") & 0x7FF == 0x103
        packets.append((count if is_visibilities else None, data[at:end]))
        count += is_visibilities
        at = end
    # Among the first, as the replay ends after some steps.
    lost = [(8, 10), (2, 2)]
    assert count > 40, count
    kept = [packet for n, packet in packets if n is None or not any(first <= n <= last for first, last in lost)]
    path.write_bytes(b"".join(kept))
    return lost


def read(path):
    """A map's pixels, as 32-bit numbers."""
    return healpy.read_map(path, dtype=np.float32).astype(float)


def shows_a_run(page, served, out, pictures):
    browser, palettes = page.browser, page.palettes
    page.wait_for_text("#link", "live")
    page.wait_for_text("#phase", "ended")
    page.wait_for_text("#verdict", "✔ balanced")
    page.assert_counts(served.status)
    status = served.status()
    held = status["channels"][0]["held"]
    assert len(held) > 1, held

    page.wait_for_text("#which", "final map")
    page.wait_for_text("#vitals", "newest data")
    shows_times_and_flags(page, served)
    # Final map, on all axes and as a globe.
    final, source = read(out / "3.000MHz/map.fits"), read(out / "3.000MHz/input.fits")
    first = read(out / f"3.000MHz/snapshot-{held[0]:03}.fits")
    inferno = palettes["inferno"]
    browser.click("#marks")
    page.wait_for_text("#which", "final map")
    browser.screenshot(pictures / "page-dark.png")
    for frame in ["galactic", "ecliptic", "equatorial"]:
        assert page.value("#frame") == frame
        page.view["frame"] = frame
        page.assert_sky(f"final map, {frame}", final, Colours.robust(inferno, final))
        browser.press("f")
    page.view["frame"] = "galactic"
    browser.press("p")
    page.view["projection"] = "globe"
    page.assert_sky("globe", final, Colours.robust(inferno, final))
    browser.press("t")
    browser.screenshot(pictures / "page-light-globe.png")
    browser.press("t")
    # A quarter turn to the left and back.
    for _ in range(9):
        browser.press("Shift", "ArrowLeft")
    browser.press("0")
    page.assert_sky("globe, turned and back", final, Colours.robust(inferno, final))
    browser.press("p")
    page.view["projection"] = "mollweide"

    # Scales, palettes, marks.
    browser.press("s")
    assert page.value("#scale") == "linear"
    low, high = (np.sort(final)[round(q * (len(final) - 1))] for q in (0.005, 0.995))
    page.assert_sky("linear", final, Colours(inferno, "linear", low, high))
    browser.press("s")
    page.assert_sky("asinh", final, Colours(inferno, "asinh", low, high))
    browser.press("s")
    browser.press("c")
    browser.press("c")
    assert page.value("#palette") == "viridis"
    page.assert_sky("viridis", final, Colours.robust(palettes["viridis"], final))
    browser.press("c")
    browser.click("#marks")
    page.assert_sky("with marks", final, Colours.robust(inferno, final), is_marked=True)
    browser.click("#marks")

    # Visibilities by direction, from the counts that the server tells.
    hits = np.array(served.json("/api/hits/0")["hits"], dtype=float)
    assert healpy.npix2nside(len(hits)) == 16 and hits.max() > hits.min() > 0
    show = "const s = document.getElementById('show'); s.value = arguments[0]; s.dispatchEvent(new Event('change'))"
    browser.js(show, "hits")
    page.wait_for_text("#high", "visibilities")
    low, high = (np.sort(hits)[round(q * (len(hits) - 1))] for q in (0.005, 0.995))
    page.assert_sky("visibilities by direction", hits, Colours(palettes["viridis"], "linear", low, high))
    browser.js(show, "map")
    page.wait_for_text("#high", "K, log")

    # Value and coordinates under the cursor.
    pixels, x, y = centres(healpy.npix2nside(len(final)), **page.view)
    left, top, *_ = page.box("#gl")
    k = int(np.argmax(final[pixels]))
    px, py = page.on_canvas(x[k], y[k], page.size())
    browser.move(left + px, top + py)
    page.wait_for_text("#cursor", f"pixel {pixels[k]}")
    said = re.sub(r" \(.*\)", "", page.text("#cursor")).split()
    assert abs(float(said[0]) / final[pixels[k]] - 1) < 1e-3, said
    lon, lat = healpy.Rotator(coord=["E", "G"])(*healpy.pix2ang(4, int(pixels[k]), lonlat=True), lonlat=True)
    across = (float(said[4].rstrip("°")) - lon + 180) % 360 - 180
    # The mouse is on whole points, of which some 3 make a degree.
    assert abs(across) < 2 and abs(float(said[6].rstrip("°")) - lat) < 1, (said, lon, lat)

    noise_k = status["channels"][0]["noise_rms_k"]
    assert abs(float(page.text("#cursor").split("whole map ")[1].split()[0]) / noise_k - 1) < 1e-3, page.text("#cursor")

    # Once the noise-only map is there: its rms about the cursor, here over half of the sky.
    def says_the_noise():
        browser.move(left + px + 1, top + py)
        browser.move(left + px, top + py)
        return "±" in page.text("#cursor")

    wait_until("noise near by", says_the_noise)
    noise = read(out / "3.000MHz/noise.fits")
    near = healpy.query_disc(4, healpy.pix2vec(4, int(pixels[k])), np.arccos(1 - 200 / 192))
    found = float(re.search(r"± (\S+) K", page.text("#cursor")).group(1))
    # The page takes the directions in the circle, this the pixels whose centres are in it.
    assert abs(found / np.sqrt(np.mean(noise[near] ** 2)) - 1) < 0.1, (found, page.text("#cursor"))

    # Time line, orbit, baselines.
    panels = Panels(page, served)
    panels.assert_passes()
    panels.assert_orbit()
    panels.assert_uvw(0, inferno)
    shows_parts_of_the_mission(page, served)

    # Slider, by mouse and by keys; difference; blink; channels.
    left, top, width, height = page.box("#slider")
    browser.click_at(left + 3, top + height / 2)
    page.wait_for_text("#which", f"snapshot {held[0]}")
    page.assert_sky("first snapshot", first, Colours.robust(inferno, first))
    browser.press("ArrowRight")
    page.wait_for_text("#which", f"snapshot {held[1]}" if len(held) > 2 else "final map")
    before = read(out / f"3.000MHz/snapshot-{held[-2]:03}.fits")
    while "final map" not in page.text("#which"):
        browser.press("ArrowRight")
    browser.press("d")
    page.assert_sky("difference", final - before, Colours.symmetric(palettes["difference"], final - before))
    browser.press("d")
    # Both frames have names, each with its own picture, and the input's scale.
    names = "window.names = {}; new MutationObserver(() => { const name = shown.textContent, low = document.getElementById('low').textContent; (names[name] ??= []).push(low); }).observe(shown, { childList: true })"
    browser.js(names)
    browser.press("b")
    of_input = Colours.robust(inferno, source)
    page.assert_sky("blink: input", source, of_input)
    page.assert_sky("blink: map", final, of_input)
    page.assert_sky("blink: input again", source, of_input)
    number = held[-1]
    expected = {f"map {number} · blinks with input sky, on one scale", f"input sky · blinks with map {number}, on one scale"}
    assert set(browser.js("return Object.keys(names)")) == expected, browser.js("return names")
    assert abs(float(page.text("#low").split()[0]) / of_input.low - 1) < 1e-3, page.text("#low")
    browser.press("b")
    page.assert_sky("no blink", final, Colours.robust(inferno, final))
    browser.press("2")
    other = read(out / "10.000MHz/map.fits")
    page.assert_sky("second channel", other, Colours.robust(inferno, other))
    browser.press("1")
    # It may have played to the end before anybody looks.
    note = "window.played = []; new MutationObserver(([r]) => played.push(r.target.getAttribute('aria-pressed'))).observe(document.getElementById('play'), { attributes: true, attributeFilter: ['aria-pressed'] })"
    browser.js(note)
    browser.press(" ")
    wait_until("playing", lambda: len(browser.js("return played")) > 0)
    wait_until("the last map played", lambda: browser.js("return document.getElementById('play').getAttribute('aria-pressed')") == "false")
    page.wait_for_text("#which", "final map")
    browser.press("?")
    assert browser.js("return document.getElementById('keys').open")
    browser.press("Escape")
    wait_until("the keys closed", lambda: not browser.js("return document.getElementById('keys').open"))


def utc(epoch_tai_s, time_s):
    """A mission time as a date: 1958 and TAI, less the 37 s by which UTC is behind."""
    return datetime(1958, 1, 1) + timedelta(seconds=epoch_tai_s + time_s - 37)


def shows_times_and_flags(page, served):
    """Dates and ages are the interface's, each flag has a colour of its own, and labels can be read on the brightest pixels."""
    status, geometry, browser = served.status(), served.json("/api/geometry"), page.browser
    channel = status["channels"][0]
    until = utc(channel["epoch_tai_s"], channel["figures"]["until_s"])
    assert f"until {until:%Y-%m-%d %H:%M} UTC (day {channel['figures']['until_s'] / 86400:.1f})" in page.text("#which"), page.text("#which")
    cards = dict(browser.js("return [...document.querySelectorAll('#vitals li')].map((card) => [...card.children].map((part) => part.textContent))"))
    assert cards["newest data"] == f"{utc(geometry['epoch_tai_s'], geometry['time_s']):%Y-%m-%d %H:%M} UTC", cards
    assert cards["packets"] == "0 missing · 0 damaged", cards
    # Asked for after the page was read, so that the age is at least the page's.
    newest = min(served.status()["channels"], key=lambda c: c["age_s"])
    age = re.fullmatch(r"(\d+) s ago · (\S+) MHz", cards["newest map"])
    assert float(age.group(2)) == newest["frequency_hz"] / 1e6 and 0 <= newest["age_s"] - float(age.group(1)) < 10, (cards, newest)
    # The last event, by the server's clock.
    event = datetime.strptime(browser.js("return document.querySelector('#log time').title"), "%Y-%m-%d %H:%M:%S UTC")
    ended_s = served.status()["unix_s"] - (status["up_s"] - status["elapsed_s"])
    assert abs((event - datetime(1970, 1, 1)).total_seconds() - ended_s) < 10, (event, ended_s)
    colours = browser.js("return [...document.querySelectorAll('#ledgerkeys .flagged')].map((key) => getComputedStyle(key).backgroundColor)")
    bar = browser.js("return [...document.querySelectorAll('#ledgerbar .flagged')].map((part) => getComputedStyle(part).backgroundColor)")
    assert len(colours) == len(status["ledger"]["flagged"]) == len(set(colours)) > 1 and bar == colours, (colours, bar)
    # The label at 0 degrees: its fill and its rim differ by more than the 7:1 that WCAG asks of small text (white on black has 21).
    width, height = page.size()
    box = browser.js("return [...document.getElementById('over').getContext('2d').getImageData(...arguments).data]", width // 2 - 12, height // 2 - 16, 24, 14)
    pixels = np.array(box).reshape(-1, 4)
    solid = pixels[pixels[:, 3] > 250][:, :3].max(axis=1)
    assert (solid > 250).sum() > 10 and (solid < 5).sum() > 20, np.bincount(solid)


def plays_in_a_kiosk(page, served, pictures):
    """The sky fills the window and plays from the first map to the newest, on the newest's scale."""
    browser, held = page.browser, served.status()["channels"][0]["held"]
    browser.js("window.kiosk = []; new MutationObserver(() => kiosk.push([shown.textContent, document.getElementById('low').textContent])).observe(shown, { childList: true })")
    before = page.text("#low")
    browser.press("k")
    wait_until("the last frame", lambda: any(f"map {held[-1]}" == name for name, _ in browser.js("return kiosk")[1:]))
    frames = browser.js("return kiosk")
    numbers = [name for name, _ in frames]
    assert [name for k, name in enumerate(numbers) if numbers.index(name) == k][: len(held)] == [f"map {number}" for number in held], numbers
    assert page.text("#low") == before and len({low for _, low in frames[1:]}) == 1, frames
    stage, window = page.box("#stage"), browser.js("return [innerWidth, innerHeight]")
    assert stage[2] > 0.95 * window[0] and stage[3] > 0.7 * window[1], (stage, window)
    caption = page.text("#caption")
    assert all(words in caption for words in ["small", "3 MHz", page.text("#which"), "ended", "UTC", "live"]), caption
    browser.screenshot(pictures / "page-kiosk.png")
    browser.press("k")
    page.wait_for_text("#which", "final map")
    assert page.box("#stage")[3] < 0.8 * window[1]


def shows_parts_of_the_mission(page, served):
    """The keys choose bins of the time line, one after the other; their texts tell of all packets."""
    browser, line = page.browser, served.json("/api/passes")
    received = next(kind["received"] for kind in line["kinds"] if kind["kind"] == "visibilities")
    browser.js("document.getElementById('passes').focus()")
    browser.press("\ue011")  # Home.
    assert f"visibilities {received[0]:,} received" in page.text("#passestext"), page.text("#passestext")
    browser.press("Shift", "ArrowRight")
    assert f"visibilities {sum(received[:2]):,} received" in page.text("#passestext"), page.text("#passestext")
    browser.press("\ue010")  # End.
    assert f"visibilities {received[-1]:,} received" in page.text("#passestext"), page.text("#passestext")
    assert "final map" in page.text("#which"), "the sky has its keys for itself"
    begin = utc(line["epoch_tai_s"], line["start_s"] + (len(received) - 1) * line["bin_s"])
    assert page.text("#passestext").startswith(f"{begin:%Y-%m-%d %H:%M} UTC to "), page.text("#passestext")
    browser.press("Escape")
    assert page.text("#passestext").startswith("whole mission: ")
    browser.js("document.activeElement.blur()")


def copies_what_is_missing(page, lost):
    """The ranges are listed, and copied as they are requested."""
    browser = page.browser
    permissions = {"permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"]}
    browser.post("goog/cdp/execute", cmd="Browser.grantPermissions", params=permissions)
    expected = "\n".join(f"0x103 {first} {last}" for first, last in lost)
    rows = "return [...document.querySelectorAll('#ranges tr')].slice(1).map((r) => [...r.cells].slice(0, 3).map((c) => c.textContent).join(' ')).join('\\n')"
    assert browser.js(rows) == expected, browser.js(rows)
    browser.click("#copypasses")
    page.wait_for_text("#copypasses", "copied")
    copied = browser.js("return navigator.clipboard.readText()")
    assert copied == expected, copied


def fits_a_phone(page, pictures):
    def metrics(**values):
        page.browser.post("goog/cdp/execute", cmd="Emulation.setDeviceMetricsOverride", params=values)

    metrics(width=390, height=844, deviceScaleFactor=1, mobile=True)
    wide = page.browser.js("return [document.documentElement.scrollWidth, innerWidth]")
    assert wide[0] <= wide[1], f"the page is {wide[0]} points wide on a phone of {wide[1]}"
    page.browser.screenshot(pictures / "page-phone.png")
    for name in ["passes", "orbit", "uvw"]:
        drawn = "const c = document.getElementById(arguments[0]); return c.width > 300 && c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some(Boolean)"
        wait_until(f"{name} on a phone", lambda name=name: page.browser.js(drawn, name))
    page.browser.js("document.querySelector('.passes').scrollIntoView()")
    page.browser.screenshot(pictures / "page-phone-passes.png")
    page.browser.js("scrollTo(0, 0)")
    page.browser.post("goog/cdp/execute", cmd="Emulation.clearDeviceMetricsOverride", params={})


def follows_a_replay(page, replay, out, lost, pictures):
    """Another run has taken the place; the page, which was not loaded again, shows it step by step."""
    page.wait_for_text("#link", "live")
    page.wait_for_text("#name", "ground")
    replay.wait_for_phase("running")

    def packets():
        return replay.status()["reception"]["visibilities"]["packets"]

    panels = Panels(page, replay)
    for _ in range(3):
        before = packets()
        print(file=replay.process.stdin, flush=True)
        wait_until("a step", lambda: packets() > before)
        page.assert_counts(replay.status)
    panels.assert_passes()
    replay.process.stdin.close()
    replay.wait_for_phase("ended")
    page.wait_for_text("#phase", "ended")
    page.wait_for_text("#verdict", "✔ balanced")
    page.assert_counts(replay.status)
    page.wait_for_text("#which", "final map")
    final = read(out / "3.000MHz/map.fits")
    page.assert_sky("map of the replay", final, Colours.robust(page.palettes["inferno"], final))
    page.wait_for_text("#log", "the run is complete")
    shows_errors_and_noise(page, replay, out)
    panels.assert_passes()
    panels.assert_orbit()
    panels.assert_uvw(0, page.palettes["inferno"])
    copies_what_is_missing(page, lost)
    page.browser.screenshot(pictures / "page-replay.png")


def shows_errors_and_noise(page, replay, out):
    """How well the map is known, and without a truth the noise floor and how far the map is above it."""
    browser, final = page.browser, read(out / "3.000MHz/map.fits")
    show = "const s = document.getElementById('show'); s.value = arguments[0]; s.dispatchEvent(new Event('change'))"
    assert page.text("#figures").count("from the data") == 1, page.text("#figures")
    options = browser.js("return [...document.getElementById('show').options].filter((o) => !o.disabled).map((o) => o.value)")
    assert options == ["map", "difference", "noise", "sigma", "mask", "resolution", "hits"], options
    browser.js(show, "sigma")
    page.wait_for_text("#shown", "standard deviation σ of map")
    sigma = read(out / "3.000MHz/sigma.fits")
    page.assert_sky("sigma", sigma, Colours.robust(page.palettes["inferno"], sigma))
    for name, unit in [("mask", ""), ("resolution", "°")]:
        browser.js(show, name)
        page.wait_for_text("#shown", name)
        page.wait_for_text("#high", f"{unit}, linear")
        served = np.frombuffer(urllib.request.urlopen(f"{replay.url}/api/maps/0/{name}.f32").read(), "<f4")
        assert np.array_equal(served, read(out / f"3.000MHz/{name}.fits").astype("<f4")), name
    browser.js(show, "map")
    spectra = replay.json("/api/figures/0")["spectra"]
    assert "rho" not in spectra and "snr" not in spectra, spectra.keys()
    noise = read(out / "3.000MHz/noise.fits")
    # healpy's with as many iterations of its quadrature; files have 32 bits.
    for cl, values in [("cl_noise", noise), ("cl_map", final)]:
        expected = healpy.anafast(values, lmax=11, iter=3, use_pixel_weights=False)
        assert np.allclose(spectra[cl][1:9], expected[1:9], rtol=0.02), (cl, spectra[cl], expected)
    # The curve: points where the ratio is.
    browser.js("document.querySelector('[data-curve=snr]').click()")
    ratio = np.log10(np.array(spectra["cl_map"][1:]) / np.array(spectra["cl_noise"][1:]))
    width, height = page.box("#curve")[2:]
    x = 52 + np.arange(len(ratio)) / (len(ratio) - 1) * (width - 62)
    y = height - 30 - (ratio - ratio.min()) / (ratio.max() - ratio.min()) * (height - 54)
    panels = Panels(page, replay)
    wait_until("the ratio's curve", lambda: panels.pixels("curve", zip(x[1:-1], y[1:-1], strict=True)) == [panels.colour("--cool")] * (len(ratio) - 2))
    browser.js("document.querySelector('[data-curve=growth]').click()")


def main():
    lunarray, pipeline, downlink, folder, pictures = sys.argv[1:]
    folder, pictures = Path(folder), Path(pictures)
    pictures.mkdir(parents=True, exist_ok=True)
    since = time.monotonic()
    run = [lunarray, "run", pipeline, *SNAPSHOTS, "--out", str(folder / "run"), "--serve-after"]
    with Served(*run) as served, Browser(WINDOW) as browser:
        page = Page(browser, served.json("/page.json"))
        # Its own first page is none of ours.
        browser.get("about:blank")
        browser.log("performance")
        for name, known in KNOWN_COLOURS.items():
            # A middle may be rounded to either of two.
            assert np.abs(page.palettes[name][[0, 128, 255]] - known).max() <= 3, name
        served.wait_for_phase("ended")
        browser.get(served.url)
        assert browser.js("return !!document.getElementById('gl').getContext('webgl2')"), "no WebGL2"
        shows_a_run(page, served, folder / "run", pictures)
        plays_in_a_kiosk(page, served, pictures)
        fits_a_phone(page, pictures)
        page.listen()
        assert not [entry for entry in page.console if entry["level"] == "SEVERE"], page.console

        # A cut: the page says so, and finds the next run by itself.
        served.end()
        page.wait_for_text("#link", "not connected")
        page.listen()
        lost = without_some(Path(downlink), folder / "cut.packets")
        # With R from the data, which tells how well the map is known.
        text = Path(pipeline).read_text()
        from_data = folder / "from-data.toml"
        from_data.write_text(text.replace("epsilon = 1e-4\n", ""))
        assert from_data.read_text() != text
        replay = [lunarray, "replay", str(folder / "cut.packets"), "--map", str(from_data), "--out", str(folder / "replay")]
        with Served(*replay, "--step", "pass", "--serve-after", port=served.port) as replay:
            follows_a_replay(page, replay, folder / "replay", lost, pictures)
            without_webgl(replay, folder / "replay", page.palettes)
        page.listen()
        # What the browser says itself of the cut.
        errors = [entry for entry in page.console if entry["level"] == "SEVERE"]
        assert all(e["source"] == "network" and f"{served.url}/events" in e["message"] for e in errors), errors
        own = [url for url in page.urls if url.startswith(f"{served.url}/")]
        foreign = [url for url in page.urls if url not in own and not url.startswith("data:")]
        assert len(own) > 10 and not foreign, foreign
    print(f"{len(own)} requests, none foreign; {time.monotonic() - since:.1f} s")


def without_webgl(served, out, palettes):
    """The page draws the same by itself."""
    with Browser(WINDOW, ["--disable-3d-apis"]) as browser:
        browser.get(served.url)
        page = Page(browser, served.json("/page.json"))
        page.wait_for_text("#which", "final map")
        assert browser.js("return !document.getElementById('gl').getContext('webgl2')"), "WebGL2 is there"
        browser.click("#marks")
        final = read(out / "3.000MHz/map.fits")
        page.assert_sky("without WebGL", final, Colours.robust(palettes["inferno"], final))


if __name__ == "__main__":
    main()
