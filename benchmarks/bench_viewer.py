# SPDX-License-Identifier: Apache-2.0
"""A process that shows a robot on a page, and one that takes all that a browser would get."""

from __future__ import annotations

import subprocess
import threading

import msgspec
import viser
from live_robot import ROOT
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (1.0, 1.0, 1.0),
    "fov": 0.8,
    "near": 0.01,
    "far": 100.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class Viewer:
    """`viewer_node` with an open page.

    Args:
        arguments: for ROS.
    """

    def __init__(self, arguments: list[str]) -> None:
        program = ROOT / "install" / "sim_bridge" / "lib" / "sim_bridge" / "viewer_node"
        self._process = subprocess.Popen(
            [program, "--ros-args", *arguments, "--log-level", "error"],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        address = self._process.stdout.readline().split()[-1]
        self._page = connect(
            address.replace("http", "ws"),
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None,
        )
        # Only who looks gets anything.
        self._page.send(msgspec.msgpack.encode(_CAMERA))
        self.received = 0
        self._reader = threading.Thread(target=self._receive, args=(self._page,))
        self._reader.start()

    def end(self) -> None:
        """Close the page, then end the process."""
        self._page.close()
        self._reader.join()
        self._process.terminate()
        self._process.wait()
        assert self.received > 10, "the page got nothing"

    def _receive(self, page: ClientConnection) -> None:
        try:
            for _ in page:
                self.received += 1
        except ConnectionClosed:
            pass
