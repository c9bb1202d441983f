"""Alerts as they are shipped, in a real Prometheus: every fault is caused, its alert is seen to fire, and to clear (but ArchiveCut: what a
raw archive has deleted does not come back).

alerts.py PROMETHEUS LUNARRAY PIPELINE DOWNLINK ALERTS FOLDER

The rules are those of ALERTS, with other times and shares: a day is seconds here. A full disk is a limit on the size of files of the
running process, which fails every write of it and can be lifted again; little memory is a limit on its address space; a disk that fills
is a large file; load is a ground that is stopped nine tenths of the time.
"""

import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import threading
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


def space(folder):
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize, disk.f_blocks * disk.f_frsize


def hurried(rules, disk_share):
    """The rules, with times of seconds, that share of a disk, and half of the memory."""
    rules = re.sub(r"\bfor: \w+", "for: 1s", rules)
    rules = re.sub(r"\[(10m|1h)\]", f"[{WINDOW_S}s]", rules)
    # A slow packet may take longer than that on a busy machine.
    rules = rules.replace("[5m]", f"[{5 * WINDOW_S}s]")
    rules, silences = re.subn(r"> (86400|691200)\b", f"> {SILENCE_S}", rules)
    rules, ages = re.subn(r"(unsaved_age_seconds) > 600", r"\1 > 3", rules)
    rules, disks = re.subn(r"(disk_size_bytes) < 0.1\b", rf"\1 < {disk_share}", rules)
    rules, memories = re.subn(r"(memory_resident_bytes\)) < 0.1\b", r"\1 < 0.5", rules)
    assert (silences, ages, disks, memories) == (3, 1, 1, 1), "the rules have other limits than this test knows"
    return rules


class Prometheus:
    def __init__(self, program, folder, targets, rules, disk_share):
        self.port = free_port()
        folder.mkdir()
        (folder / "alerts.yml").write_text(hurried(rules, disk_share))
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


def end(processes):
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.wait()


def connect(port):
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port), timeout=30)
        except OSError:
            assert time.monotonic() < deadline, "the ground does not listen"
            time.sleep(0.1)


def send(port, data, token=TOKEN):
    with connect(port) as connection:
        try:
            connection.sendall(f"token {token}\n".encode() + data)
            connection.shutdown(socket.SHUT_WR)
            return connection.recv(1000).decode()
        except OSError:
            return ""  # The ground may close before all is sent.


def processor_s(process):
    times = Path(f"/proc/{process.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
    return sum(map(int, times)) / os.sysconf("SC_CLK_TCK")


def slowed(process, over):
    """Stops a process for a moment after every tenth of a second of processor time."""
    begun = processor_s(process)
    while not over.wait(0.01):
        if processor_s(process) - begun >= 0.1:
            process.send_signal(signal.SIGSTOP)
            over.wait(0.3)
            process.send_signal(signal.SIGCONT)
            begun = processor_s(process)


def trickle(port, packets):
    """Sends packets one by one; returns the connection, still open, when all are on their way."""
    connection = connect(port)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    for packet in packets:
        connection.sendall(packet)
        time.sleep(0.1)
    return connection


def keep_sending(connection, packets, stop):
    """Sends packets slowly until told to stop."""
    for _, data in packets:
        connection.sendall(data)
        if stop.wait(0.3):
            return


def memory(process, name):
    status = Path(f"/proc/{process}/status").read_text()
    return int(re.search(rf"{name}:\s+(\d+) kB", status)[1]) * 1024


def packets_of(data):
    at = 0
    while at < len(data):
        end = at + 7 + int.from_bytes(data[at + 4 : at + 6], "big")
        yield int.from_bytes(data[at : at + 2], "big") & 0x7FF, data[at:end]
        at = end


def whole(packets):
    return b"".join(data for _, data in packets)


def parts_of(packets):
    third = len(packets) // 3
    return packets[:third], packets[third : 2 * third], packets[2 * third :]


def faults_of_operation(prometheus, lunarray, pipeline, packets, rules, folder):
    """Silence, losses, intruders, a full disk, a failure; returns the alerts that were seen."""
    stations = folder / "stations"
    stations.write_text(f"malargue {TOKEN}\n")
    stations.chmod(0o600)
    page, port, follows = free_port(), free_port(), free_port()
    words = [lunarray, "replay", "--map", pipeline, "--state", str(folder / "state"), "--out", str(folder / "out")]
    words += ["--listen", f"tcp://127.0.0.1:{port}", "--serve", str(page), "--stations", str(stations), "--snapshot-every", "1h"]
    ground = start(words, folder, "ground.log")
    alerts = Prometheus(prometheus, folder / "rules", [page, follows], rules, 0.0)
    running = [ground, alerts.process]
    try:
        first, second, last = parts_of(packets)
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
    finally:
        end(running)
    return alerts.seen


def ground_with_too_little(prometheus, lunarray, pipeline, packets, rules, folder):
    """Too little processor time, places, archive and memory; returns the alerts that were seen."""
    page, port = free_port(), free_port()
    words = [lunarray, "replay", "--map", pipeline, "--state", str(folder / "loaded"), "--out", str(folder / "loaded.out")]
    words += ["--listen", f"tcp://127.0.0.1:{port}", "--serve", str(page), "--archive-max", "1kB", "--snapshot-every", "1h"]
    for setting in ["map.engine=pixel", "map.nside=16", "runtime.queue_capacity=1", "downlink.listen.connections_max=1"]:
        words += ["--set", setting]
    ground = start(words, folder, "loaded.log")
    alerts = Prometheus(prometheus, folder / "loaded.rules", [page], rules, 0.0)
    running = [ground, alerts.process]
    try:
        first, second, last = parts_of(packets)
        half = len(second) // 2
        # Packets come one by one, and wait.
        over = threading.Event()
        busy = threading.Thread(target=slowed, args=(ground, over), daemon=True)
        busy.start()
        arrived = []
        sender = threading.Thread(target=lambda: arrived.append(trickle(port, [data for _, data in first + last])), daemon=True)
        sender.start()
        alerts.fire("QueueFull SlowToSums")
        over.set()
        busy.join(PATIENCE_S)
        sender.join(PATIENCE_S)
        alerts.clear("QueueFull SlowToSums")
        # It has one place, which a sender has as long as it brings new packets.
        assert arrived, "not all packets could be sent"
        arrived[0].close()
        with trickle(port, [second[0][1]]) as holder:
            stop = threading.Event()
            keep = threading.Thread(target=keep_sending, args=(holder, second[1:half], stop), daemon=True)
            keep.start()
            while "busy" not in send(port, whole(last)):
                assert keep.is_alive(), "no sender was refused while another one delivered"
                time.sleep(0.2)
            alerts.fire("SendersRefused")
            stop.set()
            keep.join(PATIENCE_S)
        alerts.clear("SendersRefused")
        # Its archive has no room: after a restart checkpoints come, and the first segment goes.
        ground.terminate()
        ground.wait(PATIENCE_S)
        ground = start(words, folder, "loaded.log")
        running.append(ground)
        rest = second[half:]
        for part in parts_of(rest):
            # A checkpoint for each; a segment goes when two hold it.
            print(send(port, whole(part)).strip())
            time.sleep(5)
        alerts.fire("ArchiveCut")
        # Memory of its own, and then as before.
        limits = resource.prlimit(ground.pid, resource.RLIMIT_AS)
        room = max(64 << 20, memory(ground.pid, "VmRSS") // 2)
        resource.prlimit(ground.pid, resource.RLIMIT_AS, (memory(ground.pid, "VmSize") + room, limits[1]))
        alerts.fire("MemoryLow")
        resource.prlimit(ground.pid, resource.RLIMIT_AS, limits)
        alerts.clear("MemoryLow")
        assert ground.poll() is None, "the ground has ended"
    finally:
        end(running)
    return alerts.seen


def disk_that_fills(prometheus, lunarray, pipeline, packets, rules, folder):
    """Something else fills the disk; returns the alerts that were seen."""
    page, port = free_port(), free_port()
    words = [lunarray, "replay", "--map", pipeline, "--out", str(folder / "disk.out"), "--serve", str(page)]
    ground = start([*words, "--listen", f"tcp://127.0.0.1:{port}"], folder, "disk.log")
    # The limit lies in the middle of what the file takes, which is far more than others write or delete meanwhile.
    free, size = space(folder)
    large = min(8 << 30, free // 2)
    alerts = Prometheus(prometheus, folder / "disk.rules", [page], rules, (free - large // 2) / size)
    filler = folder / "filler"
    try:
        with filler.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, large)
        alerts.fire("DiskLow")
        filler.unlink()
        alerts.clear("DiskLow")
    finally:
        filler.unlink(missing_ok=True)
        end([ground, alerts.process])
    return alerts.seen


def main(prometheus, lunarray, pipeline, downlink, rules, folder):
    folder = Path(folder)
    folder.mkdir(exist_ok=True)
    packets = list(packets_of(Path(downlink).read_bytes()))
    rules = Path(rules).read_text()
    given = (prometheus, lunarray, pipeline, packets, rules, folder)
    seen = faults_of_operation(*given) | ground_with_too_little(*given) | disk_that_fills(*given)
    names = set(re.findall(r"- alert: (\w+)", rules))
    assert seen == names, f"not seen: {names - seen}; without a rule: {seen - names}"
    print(f"seen: {' '.join(sorted(seen))}; {time.monotonic() - BEGUN:.0f} s")


BEGUN = time.monotonic()
main(*sys.argv[1:])
