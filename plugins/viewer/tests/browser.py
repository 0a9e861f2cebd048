"""Debian's chromium, driven through its debugging protocol."""

import base64
import io
import json
import shutil
import subprocess
import time
from contextlib import contextmanager
from urllib.request import urlopen

import numpy as np
from PIL import Image
from websockets.sync.client import connect

CHROMIUM = shutil.which("chromium")
_FLAGS = (
    "--headless --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic "
    "--no-first-run --disable-background-networking --remote-debugging-port=0 "
    "--remote-allow-origins=* --window-size=1280,800 about:blank"
)


class Page:
    """One page of the browser. requests: URLs that it asked for. errors: of its console.

    targets: kinds of what else it holds, frames and workers, whose requests and errors count too.
    """

    def __init__(self, socket):
        self._socket = socket
        self._number = 0
        self.requests = []
        self.errors = []
        self.targets = []
        self._listen()

    def _listen(self, **to):
        for domain in ("Page", "Runtime", "Network", "Log"):
            self._send(f"{domain}.enable", {}, to)
        follow = dict.fromkeys(("autoAttach", "waitForDebuggerOnStart", "flatten"), True)
        self._send("Target.setAutoAttach", follow, to)
        self._send("Runtime.runIfWaitingForDebugger", {}, to)

    def _send(self, method, params, to):
        self._number += 1
        message = {"id": self._number, "method": method, "params": params, **to}
        self._socket.send(json.dumps(message))
        return self._number

    def call(self, method, **params):
        number = self._send(method, params, {})
        while True:
            message = json.loads(self._socket.recv(timeout=120))
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._note(**message)

    def _note(self, method="", params=None, **_):
        match method:
            case "Target.attachedToTarget":
                self.targets.append(params["targetInfo"]["type"])
                self._listen(sessionId=params["sessionId"])
            case "Network.requestWillBeSent":
                self.requests.append(params["request"]["url"])
            case "Network.webSocketCreated":
                self.requests.append(params["url"])
            case "Runtime.exceptionThrown":
                self.errors.append(str(params["exceptionDetails"]))
            case "Log.entryAdded" if params["entry"]["level"] == "error":
                self.errors.append(params["entry"]["text"])

    def open(self, url):
        """Leave the page before, and forget what it noted."""
        self.call("Page.navigate", url="about:blank")
        time.sleep(1)
        self.evaluate("0")  # collects events
        self.requests = []
        self.errors = []
        self.targets = []
        self.call("Page.navigate", url=url)

    def evaluate(self, code):
        found = self.call("Runtime.evaluate", expression=code, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, what, code, seconds=90):
        """Wait for JavaScript or a function to give something true."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if value := (self.evaluate(code) if isinstance(code, str) else code()):
                return value
            time.sleep(0.3)
            self.evaluate("0")  # collects events
        raise AssertionError(f"{what} did not happen in {seconds} s; errors: {self.errors}")

    def drag(self, x, y, far=0):
        """Press the mouse, move it, let go: a click where it moves not `far`."""
        for kind, place in (("Pressed", x), ("Moved", x + far), ("Released", x + far)):
            where = {"x": place, "y": y, "button": "left", "buttons": 1, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", **where)

    def key(self, key, code):
        for kind in ("keyDown", "keyUp"):
            keys = {"key": key, "code": key, "windowsVirtualKeyCode": code}
            self.call("Input.dispatchKeyEvent", type=kind, **keys)

    def picture(self):
        """What the window shows, (H, W, 3)."""
        shot = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)


@contextmanager
def chromium(profile, *flags):
    """A page in a new browser with its profile in the folder `profile`, and further flags."""
    command = [CHROMIUM, f"--user-data-dir={profile}", *_FLAGS.split(), *flags]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        port_file = profile / "DevToolsActivePort"
        end = time.monotonic() + 60
        while not port_file.is_file() or not port_file.read_text().strip():
            assert time.monotonic() < end  # chromium did not start
            time.sleep(0.1)
        port = port_file.read_text().split()[0]
        pages = json.load(urlopen(f"http://127.0.0.1:{port}/json"))
        address = next(p["webSocketDebuggerUrl"] for p in pages if p["type"] == "page")
        with connect(address, max_size=None) as socket:
            yield Page(socket)
    finally:
        process.terminate()
        process.wait(20)
