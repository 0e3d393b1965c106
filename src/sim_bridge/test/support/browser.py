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
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--hide-scrollbars",
    # Draws without a graphics card.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "about:blank",
)


def find_browser():
    """Return the path of a browser, None if there is none."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One page in a browser; `close` ends it.

    Args:
        size: of the page, pixels.
    """

    def __init__(self, size=(1280, 800)):
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [
                find_browser(),
                f"--user-data-dir={self._profile.name}",
                f"--window-size={size[0]},{size[1]}",
                *_FLAGS,
            ],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for line in self._process.stderr:
            if found := re.search(r"ws://\S+", line):
                break
        else:
            raise RuntimeError("the browser did not start")
        self._socket = connect(found[0], max_size=None, ping_interval=None)
        self._number = 0
        self._session = None
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = attached["sessionId"]
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=size[0],
            height=size[1],
            deviceScaleFactor=1,
            mobile=False,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
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
        if self._session:
            message["sessionId"] = self._session
        self._socket.send(json.dumps(message))

    def open(self, address):
        self.call("Page.navigate", url=address)

    def value(self, script):
        """Return what an expression of JavaScript gives."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get(
            "value"
        )

    def wait(self, script, timeout=60.0):
        """Return the value of an expression as soon as it is true."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            if value := self.value(script):
                return value
            time.sleep(0.1)
        raise TimeoutError(f"after {timeout:g} s not true: {script}")

    def mouse(self, kind, x, y, held=False):
        # Without waiting for the answer, which may come only with the next picture of the page.
        event = {
            "type": f"mouse{kind}",
            "x": float(x),
            "y": float(y),
            "button": "left" if kind != "Moved" or held else "none",
            "buttons": 1 if held else 0,
            "clickCount": 0 if kind == "Moved" else 1,
        }
        self._send("Input.dispatchMouseEvent", event)

    def drag(self, start, end, meanwhile, steps=10):
        """Press at `start`, move to `end`, let go; call `meanwhile` between the events."""
        way = [np.add(start, k / steps * np.subtract(end, start)) for k in range(steps + 1)]
        events = [("Moved", start, False)] * 2 + [("Pressed", start, True)]
        events += [("Moved", at, True) for at in way] + [("Released", end, False)]
        for kind, at, held in events:
            self.mouse(kind, *at, held=held)
            meanwhile()

    def screenshot(self, path=None):
        """Return the page as PNG; write it to `path`, too, if that is given."""
        picture = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        if path is not None:
            Path(path).write_bytes(picture)
        return picture
