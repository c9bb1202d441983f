"""Alerts as they are shipped, in a real Prometheus: every fault is caused, its alert is seen to fire, and to clear.

alerts.py PROMETHEUS LUNARRAY PIPELINE DOWNLINK ALERTS FOLDER

The rules are those of ALERTS, with other times: a day is seconds here. A full disk is a limit on the size of files of the running
process, which fails every write of it and can be lifted again. What needs a machine without memory or hours of load is tested by
promtool.
"""

import json
import re
import resource
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

PATIENCE_S = 120.0  # On however busy a machine.
TOKEN = "0123456789abcdef"
SILENCE_S = 8
WINDOW_S = 8
VISIBILITIES, POSITIONS = 0x103, 0x102


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def hurried(rules):
    """The rules, with times of seconds."""
    rules = re.sub(r"\bfor: \w+", "for: 1s", rules)
    rules = re.sub(r"\[(10m|5m|1h)\]", f"[{WINDOW_S}s]", rules)
    rules, silences = re.subn(r"> (86400|691200)\b", f"> {SILENCE_S}", rules)
    rules, ages = re.subn(r"(unsaved_age_seconds) > 600", r"\1 > 3", rules)
    assert (silences, ages) == (3, 1), "the rules have other times than this test knows"
    return rules


class Prometheus:
    def __init__(self, program, folder, targets, rules):
        self.port = free_port()
        (folder / "alerts.yml").write_text(hurried(rules))
        named = ", ".join(f"'127.0.0.1:{port}'" for port in targets)
        (folder / "prometheus.yml").write_text(
            "global: {scrape_interval: 1s, scrape_timeout: 1s, evaluation_interval: 1s}\n"
            "rule_files: [alerts.yml]\n"
            f"scrape_configs: [{{job_name: lunarray, static_configs: [{{targets: [{named}]}}]}}]\n"
        )
        words = [f"--config.file={folder}/prometheus.yml", f"--storage.tsdb.path={folder}/tsdb"]
        words += [f"--web.listen-address=127.0.0.1:{self.port}", "--log.level=error"]
        self.process = subprocess.Popen([program, *words])
        self.seen = set()

    def firing(self):
        with urllib.request.urlopen(f"http://127.0.0.1:{self.port}/api/v1/alerts", timeout=10) as answer:
            alerts = json.load(answer)["data"]["alerts"]
        found = {alert["labels"]["alertname"] for alert in alerts if alert["state"] == "firing"}
        self.seen |= found
        return found

    def wait(self, names, fires):
        names = set(names.split())
        since = time.monotonic()
        while True:
            try:
                firing = self.firing()
            except OSError:
                firing = None  # It has not started.
            if firing is not None and (names <= firing if fires else not names & firing):
                print(f"{time.monotonic() - BEGUN:5.1f} s: {'fire' if fires else 'clear'}: {' '.join(sorted(names))}", flush=True)
                return
            assert self.process.poll() is None, "Prometheus has ended"
            assert time.monotonic() - since < PATIENCE_S, f"expected {names} to {'fire' if fires else 'clear'}; firing: {firing}"
            time.sleep(0.2)

    def fire(self, names):
        self.wait(names, True)

    def clear(self, names):
        self.wait(names, False)


def start(words, folder, name):
    # Python ignores SIGXFSZ, and so do processes that it starts like this: a write beyond the limit is an error.
    log = open(folder / name, "ab")
    return subprocess.Popen(words, stdout=log, stderr=log, restore_signals=False)


def send(port, data, token=TOKEN):
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            connection = socket.create_connection(("127.0.0.1", port), timeout=30)
            break
        except OSError:
            assert time.monotonic() < deadline
            time.sleep(0.1)
    with connection:
        try:
            connection.sendall(f"token {token}\n".encode() + data)
            connection.shutdown(socket.SHUT_WR)
            return connection.recv(1000).decode()
        except OSError:
            return ""  # The ground may close before all is sent.


def packets_of(data):
    at = 0
    while at < len(data):
        end = at + 7 + int.from_bytes(data[at + 4 : at + 6], "big")
        yield int.from_bytes(data[at : at + 2], "big") & 0x7FF, data[at:end]
        at = end


def main(prometheus, lunarray, pipeline, downlink, rules, folder):
    folder = Path(folder)
    folder.mkdir(exist_ok=True)
    stations = folder / "stations"
    stations.write_text(f"malargue {TOKEN}\n")
    stations.chmod(0o600)
    page, port, follows = free_port(), free_port(), free_port()
    words = [lunarray, "replay", "--map", pipeline, "--state", str(folder / "state"), "--out", str(folder / "out")]
    words += ["--listen", f"tcp://127.0.0.1:{port}", "--serve", str(page), "--stations", str(stations), "--snapshot-every", "1h"]
    ground = start(words, folder, "ground.log")
    alerts = Prometheus(prometheus, folder, [page, follows], Path(rules).read_text())
    running = [ground, alerts.process]
    try:
        packets = list(packets_of(Path(downlink).read_bytes()))
        third = len(packets) // 3
        first, second, last = packets[:third], packets[third : 2 * third], packets[2 * third :]
        whole = lambda part: b"".join(data for _, data in part)
        # The second target has not begun.
        alerts.fire("GroundDown")
        follow = folder / "followed.ccsds"
        follow.write_bytes(whole(first))
        words = [lunarray, "replay", str(follow), "--follow", "--map", pipeline, "--out", str(folder / "followed")]
        follower = start([*words, "--serve", str(follows)], folder, "follower.log")
        running.append(follower)
        alerts.clear("GroundDown")

        # A packet that the station lost.
        lost = [at for at, (kind, _) in enumerate(first) if kind == VISIBILITIES][1]
        lacking = first[:lost] + first[lost + 1 :]
        print(send(port, whole(lacking)).strip())
        alerts.fire("PacketsMissing")
        # Positions that it lost. Meanwhile nothing comes, and the map grows old.
        print(send(port, whole([item for item in second if item[0] != POSITIONS])).strip())
        alerts.fire("PositionsMissing MapOld AllSilent StationSilent")
        print(send(port, whole(first + second)).strip())
        alerts.clear("PacketsMissing PositionsMissing MapOld AllSilent StationSilent")

        # Nobody's token.
        assert "token" in send(port, b"", "fedcba9876543210")
        alerts.fire("UnknownSenders")
        alerts.clear("UnknownSenders")

        # A disk that is full, and then is not.
        limits = resource.prlimit(ground.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(ground.pid, resource.RLIMIT_FSIZE, (0, limits[1]))
        print(send(port, whole(last)).strip())
        alerts.fire("ArchiveUnwritten StateUnsaved CheckpointOld ProductsUnwritten")
        resource.prlimit(ground.pid, resource.RLIMIT_FSIZE, limits)
        print(send(port, whole(last)).strip())
        alerts.clear("ArchiveUnwritten StateUnsaved CheckpointOld ProductsUnwritten")

        # A run that fails: the file that it follows is cut.
        follow.write_bytes(b"")
        alerts.fire("RunFailed")
        follower.wait(PATIENCE_S)
        alerts.clear("RunFailed")

        print(f"seen: {' '.join(sorted(alerts.seen))}; {time.monotonic() - BEGUN:.0f} s")
    finally:
        for process in running:
            if process.poll() is None:
                process.kill()
                process.wait()


BEGUN = time.monotonic()
main(*sys.argv[1:])
