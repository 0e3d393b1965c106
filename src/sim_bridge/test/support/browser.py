# SPDX-License-Identifier: Apache-2.0
"""A headless browser: opens a page, moves the mouse, takes screenshots, by DevTools' protocol."""

import base64
import json
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
from websockets.sync.client import connect

NAMES = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
_FLAGS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--hide-scrollbars"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),  # without a graphics card
    *("--remote-debugging-port=0", "about:blank"),
)


def find_browser():
    """Return the path of a browser, None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page in a browser, a context manager.

    Args:
        size: of the page, pixels.
    """

    def __init__(self, size=(1280, 800)):
        width, height = size
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        where = f"--user-data-dir={self._profile.name}", f"--window-size={width},{height}"
        self._process = subprocess.Popen(
            [find_browser(), *where, *_FLAGS],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        found = None
        while not found:
            line = self._process.stderr.readline()
            if not line:
                raise RuntimeError("the browser did not start")
            found = re.search(r"ws://\S+", line)
        self._socket = connect(found[0], max_size=None, ping_interval=None)
        self._number, self._session = 0, {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **metrics)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._socket.close()
        self._process.terminate()
        self._process.wait(10)
        self._process.stderr.close()
        self._profile.cleanup()

    def call(self, method, **parameters):
        """Return the result of a command of the protocol."""
        self._send(method, parameters)
        while True:
            answer = json.loads(self._socket.recv(timeout=120))
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]

    def _send(self, method, parameters):
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(message | self._session))

    def open(self, address):
        self.call("Page.navigate", url=address)

    def value(self, script):
        """Return what an expression of JavaScript gives."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    def wait(self, script, timeout=60.0):
        """Return the value of an expression as soon as it is true."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if value := self.value(script):
                return value
            time.sleep(0.1)
        raise TimeoutError(f"after {timeout:g} s not true: {script}")

    def drag(self, start, end, meanwhile, steps=10):
        """Press at `start`, move to `end`, let go; call `meanwhile` between the events."""
        way = [np.add(start, k / steps * np.subtract(end, start)) for k in range(steps + 1)]
        events = [("Moved", start, False)] * 2 + [("Pressed", start, True)]
        events += [("Moved", at, True) for at in way] + [("Released", end, False)]
        for kind, (x, y), held in events:
            event = {
                "type": f"mouse{kind}",
                "x": float(x),
                "y": float(y),
                "button": "left" if kind != "Moved" or held else "none",
                "buttons": int(held),
                "clickCount": int(kind != "Moved"),
            }
            # Without waiting for the answer, which may come only with the next picture.
            self._send("Input.dispatchMouseEvent", event)
            meanwhile()

    def screenshot(self, path):
        """Write the page as PNG, and return it."""
        picture = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        Path(path).write_bytes(picture)
        return picture
