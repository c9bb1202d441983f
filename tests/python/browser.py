"""A headless Chromium by way of chromedriver's own protocol (W3C WebDriver), with the standard library alone."""

import base64
import http.client
import json
import shutil
import subprocess
import tempfile
import time

ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
PATIENCE_S = 60.0  # On however busy a machine.
KEYS = {"ArrowLeft": "\ue012", "ArrowRight": "\ue014", "Escape": "\ue00c", "Shift": "\ue008"}
OPTIONS = [
    "--headless=new",
    "--no-sandbox",  # It refuses to run for root with one.
    "--disable-dev-shm-usage",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
    "--use-angle=swiftshader",  # WebGL without a graphics card.
    "--enable-unsafe-swiftshader",
    "--hide-scrollbars",
    "--force-device-scale-factor=1",
    "--force-dark-mode",
    "--lang=en",
]


def wait_until(what, is_so):
    """Waits until `is_so()` is true, and returns what it returned."""
    since = time.monotonic()
    while not (found := is_so()):
        assert time.monotonic() - since < PATIENCE_S, f"waited in vain: {what}"
        time.sleep(0.05)
    return found


class Browser:
    """A window of this size, CSS pixels; ends with its `with` block."""

    def __init__(self, size, more=()):
        self.folder = tempfile.TemporaryDirectory(prefix="lunarray-browser-", ignore_cleanup_errors=True)
        self.driver = subprocess.Popen(
            [shutil.which("chromedriver"), "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        try:
            self.port = self.port_of_driver()
            window = "--window-size={},{}".format(*size)
            arguments = [*OPTIONS, *more, window, f"--user-data-dir={self.folder.name}"]
            # Painting without a graphics card takes longer than the usual 30 s where all processors are busy.
            timeouts = {"script": int(1000 * PATIENCE_S)}
            capabilities = {
                "timeouts": timeouts,
                "goog:chromeOptions": {"args": arguments, "binary": shutil.which("chromium")},
                "goog:loggingPrefs": {"browser": "ALL", "performance": "ALL"},
            }
            self.session = ""
            answer = self.call("POST", "/session", {"capabilities": {"alwaysMatch": capabilities}})
            self.session = f"/session/{answer['sessionId']}"
        except BaseException:
            self.close()
            raise

    def port_of_driver(self):
        for line in self.driver.stdout:
            if "started successfully on port" in line:
                return int(line.strip().rstrip(".").rsplit(" ", 1)[1])
        raise AssertionError("chromedriver does not start")

    def call(self, method, path, body=None):
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request(method, path, None if body is None else json.dumps(body))
            value = json.loads(connection.getresponse().read())["value"]
        finally:
            connection.close()
        assert not (isinstance(value, dict) and "error" in value), f"{path}: {value}"
        return value

    def post(self, path, **body):
        return self.call("POST", f"{self.session}/{path}", body)

    def get(self, url):
        self.post("url", url=url)

    def js(self, script, *args):
        """Runs the body of a function of `arguments`."""
        return self.post("execute/sync", script=script, args=list(args))

    def element(self, selector):
        return self.post("element", using="css selector", value=selector)[ELEMENT]

    def click(self, selector):
        self.post(f"element/{self.element(selector)}/click")

    def act(self, *sources):
        self.post("actions", actions=list(sources))

    def press(self, *keys):
        """Presses all of these keys together."""
        keys = [KEYS.get(key, key) for key in keys]
        down = [{"type": "keyDown", "value": key} for key in keys]
        up = [{"type": "keyUp", "value": key} for key in reversed(keys)]
        self.act({"type": "key", "id": "keys", "actions": down + up})

    def pointer(self, *actions):
        self.act({"type": "pointer", "id": "mouse", "parameters": {"pointerType": "mouse"}, "actions": list(actions)})

    def move(self, x, y):
        """Moves the mouse to a place in the window, CSS pixels."""
        self.pointer({"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)})

    def click_at(self, x, y):
        move = {"type": "pointerMove", "duration": 0, "x": round(x), "y": round(y)}
        self.pointer(move, {"type": "pointerDown", "button": 0}, {"type": "pointerUp", "button": 0})

    def log(self, kind):
        """Entries since the last call."""
        return self.post("se/log", type=kind)

    def screenshot(self, path):
        path.write_bytes(base64.b64decode(self.call("GET", f"{self.session}/screenshot")))

    def close(self):
        try:
            if getattr(self, "session", ""):
                self.call("DELETE", self.session)
        finally:
            self.driver.terminate()
            self.driver.wait()
            self.driver.stdout.close()
            self.folder.cleanup()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
