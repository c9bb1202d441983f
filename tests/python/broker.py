"""Packets by way of a real broker, NATS JetStream, to a ground that is killed, as the broker is, again and again.

broker.py NATS_SERVER LUNARRAY PIPELINE DOWNLINK FOLDER

Publishes DOWNLINK in messages, each acknowledged by the broker once it is stored. Takes them from it in batches, sends each batch
to a ground with a state, FOLDER/state, and acknowledges it once the ground has answered `held`. Nothing is acknowledged
otherwise, and what is not comes again. Kills come where they hurt: the ground between `taken` and `held`, and right after `held`;
the broker between `held` and the acknowledgement. At the end every message is acknowledged, and the ground is killed.

The client is a page of the protocol (docs.nats.io/reference/reference-protocols), with the standard library alone.
"""

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

PATIENCE_S = 300.0  # On however busy a machine.
STREAM, CONSUMER, SUBJECT = "DOWNLINK", "ground", "downlink"
MESSAGES = 24
BATCH = 3
BROKER_KILLS = 3


class Gone(Exception):
    """The other end of a connection has gone."""


class Broker:
    """A nats-server with a store on disk, and a connection to it."""

    def __init__(self, program, folder):
        self.program, self.folder = program, folder
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.start()

    def start(self):
        words = [self.program, "-js", "-sd", str(self.folder), "-a", "127.0.0.1", "-p", str(self.port)]
        self.process = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        since = time.monotonic()
        while True:
            try:
                self.connect()
                self.request("$JS.API.INFO")
                return
            except (OSError, Gone, KeyError):
                assert time.monotonic() - since < PATIENCE_S, "the broker does not start"
                time.sleep(0.05)

    def kill_and_restart(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        self.start()

    def connect(self):
        self.stream = socket.create_connection(("127.0.0.1", self.port), timeout=10)
        self.lines = self.stream.makefile("rb")
        self.line()  # INFO
        options = {"verbose": False, "headers": True, "no_responders": True}
        self.send(f"CONNECT {json.dumps(options)}\r\n".encode())
        self.number = 0

    def send(self, data):
        try:
            self.stream.sendall(data)
        except OSError as error:
            raise Gone from error

    def line(self):
        try:
            line = self.lines.readline()
        except OSError as error:
            raise Gone from error
        if not line.endswith(b"\r\n"):
            raise Gone
        return line.decode().split()

    def ask(self, subject, payload=b""):
        # Each question has an inbox of its own: messages of a stream come to it under the subject of the stream.
        last, self.number = self.number, self.number + 1
        subscribe = f"UNSUB {last}\r\nSUB inbox.{self.number} {self.number}\r\n"
        self.send(f"{subscribe}PUB {subject} inbox.{self.number} {len(payload)}\r\n".encode() + payload + b"\r\n")

    def message(self):
        """The next answer to the last question: its status line or nothing, the subject to reply to, its payload."""
        while True:
            words = self.line()
            if words[0] == "PING":
                self.send(b"PONG\r\n")
            if words[0] not in ("MSG", "HMSG"):
                continue
            length = int(words[-1])
            body = self.lines.read(length + 2)
            if len(body) != length + 2:
                raise Gone
            numbers = 1 if words[0] == "MSG" else 2
            reply = words[3] if len(words) == 4 + numbers else None
            head = int(words[-2]) if words[0] == "HMSG" else 0
            if words[2] == str(self.number):
                return body[:head].split(b"\r\n")[0].decode(), reply, body[head:length]

    def request(self, subject, payload=b""):
        self.ask(subject, payload)
        status, _, answer = self.message()
        if status:
            raise Gone  # Nobody answers yet.
        return json.loads(answer) if answer else {}

    def api(self, subject, **fields):
        answer = self.request(f"$JS.API.{subject}", json.dumps(fields).encode() if fields else b"")
        assert "error" not in answer, answer
        return answer

    def fetch(self, count):
        """Up to so many messages that nobody has acknowledged: subject to acknowledge to, payload."""
        self.ask(f"$JS.API.CONSUMER.MSG.NEXT.{STREAM}.{CONSUMER}", json.dumps({"batch": count, "no_wait": True}).encode())
        found = []
        while len(found) < count:
            status, reply, payload = self.message()
            if status.startswith("NATS/1.0 4"):
                break
            found.append((reply, payload))
        return found

    def acknowledge(self, replies):
        for reply in replies:
            self.request(reply, b"+ACK")


class Ground:
    """A listening ground with a state."""

    def __init__(self, lunarray, pipeline, folder):
        self.words = [lunarray, "replay", "--map", pipeline, "--state", str(folder / "state"), "--out", str(folder / "out")]
        self.words += ["--set", "downlink.listen.held_every_s=0.1", "--listen"]
        self.start("tcp://127.0.0.1:0")

    def start(self, url):
        self.process = subprocess.Popen([*self.words, url], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for line in self.process.stderr:
            if line.startswith("listening on "):
                self.url = line.split()[-1]
                break
        else:
            raise AssertionError("the ground does not listen")
        threading.Thread(target=lambda lines: [None for _ in lines], args=(self.process.stderr,), daemon=True).start()

    def kill(self):
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def kill_and_restart(self):
        self.kill()
        self.start(self.url)

    def deliver(self, data, between=lambda: None):
        """Sends packets; returns whether the ground says that a checkpoint holds them. `between` is called when it has taken them."""
        host, port = self.url.removeprefix("tcp://").rsplit(":", 1)
        with socket.create_connection((host, int(port)), timeout=PATIENCE_S) as stream, stream.makefile("rb") as answer:
            try:
                stream.sendall(b"answer held\n" + data)
                stream.shutdown(socket.SHUT_WR)
                if answer.readline() != b"taken %d bytes\n" % len(data):
                    return False
                between()
                return answer.readline() == b"held %d bytes\n" % len(data)
            except OSError:
                return False


def packets_of(data):
    """The packets of a file, by their length fields."""
    found, at = [], 0
    while at < len(data):
        length = 7 + int.from_bytes(data[at + 4 : at + 6], "big")
        found.append(data[at : at + length])
        at += length
    return found


def publish(broker, data):
    packets = packets_of(data)
    each = -(-len(packets) // MESSAGES)
    for number, start in enumerate(range(0, len(packets), each)):
        stored = broker.request(SUBJECT, b"".join(packets[start : start + each]))
        assert stored["stream"] == STREAM, stored
        if number == MESSAGES // 2:
            broker.kill_and_restart()


def main():
    program, lunarray, pipeline, downlink, folder = sys.argv[1:]
    folder = Path(folder)
    broker = Broker(program, folder / "broker")
    ground = Ground(lunarray, pipeline, folder)
    try:
        broker.api(f"STREAM.CREATE.{STREAM}", name=STREAM, subjects=[SUBJECT], storage="file")
        config = {"durable_name": CONSUMER, "ack_policy": "explicit", "ack_wait": 2_000_000_000}
        broker.api(f"CONSUMER.DURABLE.CREATE.{STREAM}.{CONSUMER}", stream_name=STREAM, config=config)
        publish(broker, Path(downlink).read_bytes())
        since, deliveries, again, kills = time.monotonic(), 0, 0, 0
        while True:
            assert time.monotonic() - since < PATIENCE_S, "messages are left"
            left = broker.api(f"CONSUMER.INFO.{STREAM}.{CONSUMER}")
            if left["num_pending"] == left["num_ack_pending"] == 0:
                break
            messages = broker.fetch(BATCH)
            if not messages:
                time.sleep(0.2)
                continue
            deliveries += 1
            # Of four deliveries one as it should be, and three kills. A broker that is killed may forget acknowledgements, so that only
            # the first kills of it leave it a chance to come to the end.
            turn = deliveries % 4 if deliveries % 4 != 3 or kills < BROKER_KILLS else 0
            is_held = ground.deliver(
                b"".join(payload for _, payload in messages), ground.kill_and_restart if turn == 1 else lambda: None
            )
            if turn == 2:
                ground.kill_and_restart()
            if turn == 3:
                broker.kill_and_restart()
                kills += 1
            if is_held and turn != 3:
                broker.acknowledge(reply for reply, _ in messages)
            else:
                again += 1
        assert again > 0, "nothing came twice"
        print(f"{MESSAGES} messages in {deliveries} deliveries, {again} of them not acknowledged")
    finally:
        ground.kill()
        broker.process.kill()
        broker.process.wait()


main()
