"""A headless Chromium for tests, driven by its own protocol through websockets, which viser brings.

Tests of pages skip, with the reason, where there is no Chromium.
"""

import base64
import contextlib
import gc
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import warnings

import cv2
import numpy as np
import pytest

DESKTOP = (1280, 900)  # [px] width and height of a window
PHONE = (390, 844)
PATIENCE_S = 180.0  # [s] after which a browser that does not answer is a failure
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--no-first-run", "--disable-background-networking",
    "--remote-debugging-port=0",
)  # fmt: skip


def collect_sockets():
    """Collect the sockets of clients that had just gone when a server of viser stopped: it leaves
    them open, and a later test would fail for the warning.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def find_chromium():
    """Path of a Chromium; skips the test if there is none, or no websockets to drive it."""
    pytest.importorskip("websockets", reason="no websockets: pip install 'gftorf-warp[view]'")
    names = ("chromium", "chromium-browser", "google-chrome")
    found = next(filter(None, map(shutil.which, names)), None)
    return found or pytest.skip("no Chromium here: apt-get install chromium")


class Tab:
    """One page of a browser."""

    def __init__(self, connection):
        self._connection, self._numbers = connection, itertools.count(1)
        self.problems = []
        """Texts of errors that the page reported."""
        for domain in ("Page", "Runtime", "Log"):
            self.send(f"{domain}.enable")

    def send(self, method, **given):
        """Call a method of the protocol; its result."""
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": given}))
        while True:
            answer = json.loads(self._connection.recv(timeout=PATIENCE_S))
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
            self._note(answer)

    def _note(self, event):
        kind, given = event.get("method"), event.get("params", {})
        if kind == "Runtime.exceptionThrown":
            self.problems.append(str(given["exceptionDetails"].get("exception", given)))
        if kind == "Log.entryAdded" and given["entry"]["level"] == "error":
            self.problems.append(given["entry"]["text"])

    def resize(self, size, scale=1):
        """Make the window (width, height) [px] large."""
        width, height = size
        phone = width < 500
        given = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": phone}
        self.send("Emulation.setDeviceMetricsOverride", **given)

    def open(self, address):
        """Load a page."""
        self.send("Page.navigate", url=address)
        self.until("document.readyState === 'complete'")

    def value(self, expression):
        """The value of a JavaScript expression."""
        given = {"expression": expression, "returnByValue": True, "awaitPromise": True}
        result = self.send("Runtime.evaluate", **given)
        assert "exceptionDetails" not in result, result["exceptionDetails"]
        return result["result"].get("value")

    def until(self, expression):
        """Wait until an expression is true."""
        end = time.monotonic() + PATIENCE_S
        while not self.value(expression):
            assert time.monotonic() < end, f"never true: {expression}"
            time.sleep(0.05)

    def click(self, x, y):
        """Press and release the left button at (x, y) [px]."""
        for kind in ("mouseMoved", "mousePressed", "mouseReleased"):
            at = {"x": x, "y": y, "button": "left", "clickCount": 1}
            self.send("Input.dispatchMouseEvent", type=kind, **at)

    def press(self, key):
        """Press and release a key by its name, for example ArrowRight."""
        codes = {"ArrowRight": 39, "ArrowLeft": 37}
        given = {"key": key, "code": key, "windowsVirtualKeyCode": codes[key]}
        for kind in ("rawKeyDown", "keyUp"):
            self.send("Input.dispatchKeyEvent", type=kind, **given)

    def screenshot(self, path=None, *, whole=False):
        """RGB [H, W, 3] of the window, or of the whole page; also written to ``path``."""
        given = {"captureBeyondViewport": whole}
        if whole:
            size = self.send("Page.getLayoutMetrics")["cssContentSize"]
            given["clip"] = {**size, "scale": 1}
        data = base64.b64decode(self.send("Page.captureScreenshot", format="png", **given)["data"])
        if path is not None:
            with open(path, "wb") as file:
                file.write(data)
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


@contextlib.contextmanager
def browser():
    """A :class:`Tab` of a Chromium that ends with the block."""
    chromium = find_chromium()
    from websockets.sync.client import connect

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [chromium, *FLAGS, f"--user-data-dir={profile}", "about:blank"]
        silent = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(command, **silent)
        try:
            with connect(_address(process, profile), max_size=None) as connection:
                yield Tab(connection)
        finally:
            process.terminate()
            process.wait(timeout=PATIENCE_S)


def _address(process, profile):
    """Where the first tab of a browser listens."""
    import urllib.request
    from pathlib import Path

    told, end = Path(profile) / "DevToolsActivePort", time.monotonic() + PATIENCE_S
    while not (told.exists() and told.read_text().count("\n")):
        assert process.poll() is None, f"Chromium ended with {process.returncode}"
        assert time.monotonic() < end, "Chromium does not start"
        time.sleep(0.05)
    port = told.read_text().split()[0]
    while True:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list") as answer:
            tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
        if tabs:
            return tabs[0]["webSocketDebuggerUrl"]
        time.sleep(0.05)
