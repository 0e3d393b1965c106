# SPDX-License-Identifier: Apache-2.0
import fcntl
import os
import struct
import termios
from contextlib import closing, redirect_stdout

from sim_bridge.nodes import progress
from sim_bridge.nodes.progress import Progress


def test_in_a_file_it_is_a_few_lines(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    with closing(Progress(8.0)) as shown:
        for _ in range(200):
            now[0] += 0.1
            shown.wait("getting ready: there is no paused robot")
        for k in range(1, 4001):
            shown.show(0.002 * k, f"TRACKING {k}")
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "waiting for the nodes",
        "getting ready: there is no paused robot",
        *(f"  {t}.00 of 8 s  TRACKING {500 * t}" for t in (2, 4, 6, 8)),
    ]


def test_on_a_terminal_it_is_one_line():
    reader, writer = os.openpty()
    fcntl.ioctl(writer, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    with open(writer, "w") as terminal, redirect_stdout(terminal):
        with closing(Progress(8.0)) as shown:
            for k in range(1, 9):
                shown.show(float(k), "TRACKING")
        terminal.flush()
        written = b""
        while b"\n" not in written:
            written += os.read(reader, 10_000)
    os.close(reader)
    text = written.decode()
    assert text.count("\n") == 1
    assert text.count("\r") > 8
    assert "100% |" in text
