# SPDX-License-Identifier: Apache-2.0
"""Makes the picture of the viewer's page: a demo in a real browser, on its way along limits.

Needs a browser, such as Debian's chromium.

python reproduction/page_picture.py [ROBOT] [--out FILE]
"""

from __future__ import annotations

import argparse
import os
import pty
import signal
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "src" / "sim_bridge" / "test" / "support"))

from browser import Browser, find_browser  # noqa: E402

_NOTICE = "document.querySelector('.mantine-Notification-closeButton')?.click()"
SIZE = 1200, 780


def main() -> int:
    """Make the picture; return 1 when the demo or the browser failed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("robot", nargs="?", default="panda")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "page.png")
    parser.add_argument("--after", type=float, default=3.2, help="s after Enter (default: 3.2)")
    options = parser.parse_args()
    if find_browser() is None:
        print("error: there is no browser: apt install chromium", file=sys.stderr)
        return 1
    keyboard, terminal = pty.openpty()
    demo = subprocess.Popen(
        ["bash", ROOT / "scripts" / "demo.sh", options.robot, "--view"],
        stdin=terminal,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        assert demo.stdout is not None
        address = next(line.split()[-1] for line in demo.stdout if "the arm is at" in line)
        with Browser(SIZE) as browser:
            browser.open(address)
            browser.wait("document.querySelector('svg.joints') !== null")
            time.sleep(5.0)  # until all meshes are there, which nothing on the page tells
            browser.value(_NOTICE)
            os.write(keyboard, b"\n")
            time.sleep(options.after)
            browser.screenshot(options.out)
    finally:
        os.killpg(demo.pid, signal.SIGINT)
        demo.wait(30)
    print(f"{options.out} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
