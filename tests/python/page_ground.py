"""The page of a listening ground: what it waits for, its stations, ages and problems, and the words for each.

page_ground.py LUNARRAY PIPELINE DOWNLINK FOLDER PICTURES, as page.py.
"""

import re
import socket
import struct
import sys
import threading
import time
from datetime import datetime
from pathlib import Path

from browser import Browser, wait_until
from page import WINDOW, Page, Served

TOKENS = {"malargue": "0123456789abcdef0123456789abcdef", "urumqi": "fedcba9876543210"}
SIZES = {"": 1, "k": 1e3, "M": 1e6}


class Station:
    """A connection of a station that sends pieces of a downlink at a steady pace."""

    def __init__(self, address, name):
        host, port = address.rsplit(":", 1)
        self.stream = socket.create_connection((host, int(port)), timeout=60)
        self.stream.sendall(f"token {TOKENS[name]}\n".encode())
        self.sent, self.since = 0, time.monotonic()

    def send(self, data):
        self.stream.sendall(data)
        self.sent += len(data)

    def rate(self):
        return self.sent / (time.monotonic() - self.since)

    def reset(self):
        """Breaks the connection."""
        self.stream.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.stream.close()


def cards(page):
    """Texts of the cards by their names."""
    script = "return [...document.querySelectorAll('#vitals li')].map((card) => [...card.children].map((part) => part.textContent))"
    return dict(page.browser.js(script))


def seconds(text):
    """An age as the page writes it."""
    found = re.search(r"(\S+)( s)? ago", text)
    parts = [float(part) for part in found.group(1).split(":")]
    return sum(part * 60**k for k, part in enumerate(reversed(parts)))


def waits(page, served, words):
    wait_until(words, lambda: words in page.text("#waiting"))


def watches_stations(page, served, downlink, pictures):
    """From nothing to a map, with a station that errs and one that is silent."""
    address = served.status()["listening"]["report"]["address"].removeprefix("tcp://")
    waits(page, served, f"Waits for the first packet at tcp://{address}; 0 senders are connected.")
    assert cards(page)["last packet"] == "none yet"
    # The cards come with the next status.
    wait_until("the station's card", lambda: cards(page).get("malargue") == "not heard yet · 0 B/s · no errors")
    page.browser.screenshot(pictures / "page-waiting.png")
    station = Station(address, "malargue")
    waits(page, served, "1 sender is connected.")
    # At a pace, until the page knows it. The rest comes at once.
    at, ends = 0, threading.Event()

    def send_steadily():
        nonlocal at
        while not ends.wait(0.05) and at < len(downlink) - 20_000:
            station.send(downlink[at : at + 1000])
            at += 1000

    sender = threading.Thread(target=send_steadily)
    sender.start()

    def says_the_rate():
        found = re.search(r"· (\S+) (.?)B/s", cards(page)["malargue"])
        # The page takes the bytes of two messages and the time between them, here the time since the station began.
        return found and station.sent and abs(float(found.group(1)) * SIZES[found.group(2)] / station.rate() - 1) < 0.25

    wait_until("the station's rate", says_the_rate)
    ends.set()
    sender.join()
    assert "· no errors" in cards(page)["malargue"], cards(page)
    # Bytes of no packet between two packets.
    end = at
    while downlink[:end] and not is_boundary(downlink, end):
        end += 1
    station.send(downlink[at:end] + bytes(range(7, 107)) + downlink[end:])
    wait_until("all is read", lambda: served.status()["listening"]["report"]["stations"]["malargue"]["bytes"] >= len(downlink) + 100)
    wait_until("a fault", lambda: "1 fault" in cards(page)["malargue"])
    station.reset()
    wait_until("a broken connection", lambda: "1 fault, 1 broken connection" in cards(page)["malargue"])
    of = served.status()["listening"]["report"]["stations"]
    assert [of["malargue"][key] for key in ("faults", "broken", "connections")] == [1, 1, 1], of
    assert "not heard yet" in cards(page)["urumqi"] and "no errors" in cards(page)["urumqi"]
    # Before there is a map: visibilities are in the sums, and when maps come.
    wait_until("sums", lambda: served.status()["ledger"]["accumulated"] > 0)
    accumulated = served.status()["ledger"]["accumulated"]
    waits(page, served, f"{accumulated:,} visibilities are in the sums. Maps are made at the end of the data.")
    # Ages grow, and are the interface's.
    before = seconds(cards(page)["last packet"])
    wait_until("ages grow", lambda: seconds(cards(page)["last packet"]) > before)

    def ages_are_equal():
        listening = served.status()["listening"]
        expected = [listening["silence_s"], listening["station_silence_s"]["malargue"]]
        found = [seconds(cards(page)[name]) for name in ("last packet", "malargue")]
        # Whole seconds, asked one after the other.
        return max(abs(a - b) for a, b in zip(expected, found, strict=True)) < 2

    wait_until("ages", ages_are_equal)
    now = re.match(r"(\S+ \S+) UTC", page.text("#utc")).group(1)
    page_s = datetime.strptime(now + "+0000", "%Y-%m-%d %H:%M:%S%z").timestamp()
    assert abs(page_s - served.status()["unix_s"]) < 5, (now, served.status()["unix_s"])
    wait_until("a checkpoint's age", lambda: "ago" in cards(page)["last checkpoint"] or "in this session" in cards(page)["last checkpoint"])
    page.browser.screenshot(pictures / "page-stations.png")


def is_boundary(data, place):
    """Whether a packet of the downlink begins here."""
    at = 0
    while at < place:
        at += 7 + int.from_bytes(data[at + 4 : at + 6], "big")
    return at == place


def says_what_is_so(page, status):
    """The words for what cannot be made to happen here, from a status changed by hand."""
    change = """
        const [status, change] = arguments, [path, value] = change;
        let at = status;
        for (const key of path.slice(0, -1)) at = at[key] ??= {};
        at[path.at(-1)] = value;
        return import("/vitals.js").then((vitals) => {
          vitals.showVitals(status, null, Date.now());
          return [vitals.waitingFor(status, { map: { snapshot_every_s: 172800 } }),
            [...document.querySelectorAll("#vitals li")].map((card) => `${card.className}|${card.textContent}`)];
        });"""

    def changed(path, value):
        return page.browser.js(change, status, [path, value])

    said, shown = changed(["listening", "archive"], {"unwritten": "no space", "bytes": 0})
    assert "bad|▲ no data are acknowledgedthe raw archive cannot be written: no space" in shown, shown
    said, shown = changed(["saving", "unsaved"], "no space")
    assert any(card.startswith("bad|▲ state not saved") for card in shown), shown
    _, shown = changed(["products"], {"unwritten": "no space"})
    assert "bad|▲ maps are not writtenno space" in shown, shown
    _, shown = changed(["reception", "visibilities", "missing"], 1234)
    assert "warn|packets1,234 missing · 0 damaged" in shown, shown
    assert "A map is made every 2.0 d of mission time." in said, said
    said, shown = changed(["phase"], "starting")
    assert said == "The run is being prepared."
    assert changed(["phase"], "ended")[0] == "The run ended without a map."
    assert changed(["reception", "instrument", "packets"], 0)[0].startswith("Waits for the description of the instrument")
    assert changed(["reception", "ephemeris", "packets"], 0)[0] == "Waits for the daughters' positions."
    solving = {"what": "map at 3 MHz", "iteration": 1234}
    assert changed(["solving"], solving)[0] == "The first map is being solved: map at 3 MHz, iteration 1,234."


def main():
    lunarray, pipeline, downlink, folder, pictures = sys.argv[1:]
    folder, pictures = Path(folder), Path(pictures)
    pictures.mkdir(parents=True, exist_ok=True)
    stations = folder / "stations"
    stations.write_text("".join(f"{name} {token}\n" for name, token in TOKENS.items()))
    stations.chmod(0o600)
    listen = [lunarray, "replay", "--map", pipeline, "--out", str(folder / "heard"), "--state", str(folder / "state")]
    listen += ["--listen", "tcp://127.0.0.1:0", "--stations", str(stations)]
    with Served(*listen) as served, Browser(WINDOW) as browser:
        page = Page(browser, served.json("/page.json"))
        browser.get(served.url)
        watches_stations(page, served, Path(downlink).read_bytes(), pictures)
        says_what_is_so(page, served.status())
        page.listen()
        assert not [entry for entry in page.console if entry["level"] == "SEVERE"], page.console


if __name__ == "__main__":
    main()
