# SPDX-License-Identifier: Apache-2.0
"""Nodes as programs: what a signal does at any moment, and that one started again is heard."""

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from std_msgs.msg import String

from viability_bounds_pkg.ros import runtime
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.runtime import CONTROL_QOS, settle_dds
from viability_bounds_pkg.testing.executables import as_child, environment, started

SMALL_NODE = """
import os, signal, sys
from dataclasses import dataclass
from std_msgs.msg import String
from viability_bounds_pkg.ros.arm_node import ArmNode
from viability_bounds_pkg.ros.program import run
from viability_bounds_pkg.ros.runtime import CONTROL_QOS

@dataclass
class Nothing:
    pass

class SmallNode(ArmNode):
    NAME = "small_node"
    PARAMETERS = Nothing

    def __init__(self):
        super().__init__()
        self.out = self.create_publisher(String, "answer", CONTROL_QOS)
        self.begin()
"""
STOPPED_WHILE_IT_PUBLISHES = f"""{SMALL_NODE}
    def begin(self):
        self.create_timer(0.01, self.work)

    def work(self):
        os.kill(os.getpid(), signal.SIGTERM)
        for _ in range(1000):
            self.out.publish(String())

sys.exit(run(SmallNode, ["small_node"]))
"""
INTERRUPTED_AT_START = f"""{SMALL_NODE}
    def begin(self):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            signal.pause()
        except KeyboardInterrupt:
            pass  # as where compiled code calls back

sys.exit(run(SmallNode, ["small_node"]))
"""
ANSWERS = f"""{SMALL_NODE}
    def begin(self):
        self.create_subscription(String, "ask", self.answer, CONTROL_QOS)
        print("there", flush=True)

    def answer(self, _):
        self.out.publish(String(data=str(os.getpid())))

sys.exit(run(SmallNode, ["small_node"]))
"""


@pytest.mark.parametrize(
    "program", [STOPPED_WHILE_IT_PUBLISHES, INTERRUPTED_AT_START], ids=["at work", "at start"]
)
def test_a_signal_ends_a_node_cleanly(program):
    done = started("-c", program)
    assert done.returncode == 0, done.stderr
    assert not {word for word in ("Traceback", "Exception", "Error") if word in done.stderr}


@pytest.mark.parametrize(
    ("program", "code"),
    [
        ("{interrupt}\nmain = int\n", -signal.SIGINT),
        ("def main():\n    {interrupt}\n    return 0\n", 130),
        (
            "import atexit, os, signal\n"
            "atexit.register(os.kill, os.getpid(), signal.SIGINT)\n"
            "def main(): return 3\n",
            3,
        ),
    ],
    ids=["imports", "main", "end"],
)
def test_an_interrupt_leaves_no_traceback(tmp_path, monkeypatch, program, code):
    interrupt = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"
    (tmp_path / "slow_program.py").write_text(program.format(interrupt=interrupt))
    monkeypatch.syspath_prepend(tmp_path)
    called = (
        "import sys; from viability_bounds_pkg.cli.ros_program import run_program; "
        "sys.exit(run_program('slow_program'))"
    )
    done = started("-c", called)
    assert (done.returncode, done.stderr) == (code, "")


def test_a_program_that_was_killed_and_started_again_is_heard_and_obeyed(ros):
    watch = PublisherWatch(ros.probe)
    ask = ros.probe.create_publisher(String, "ask", CONTROL_QOS)
    obeyed = set()

    def on_answer(message):
        if watch.admits("/answer"):
            obeyed.add(int(message.data))

    ros.probe.create_subscription(String, "answer", on_answer, CONTROL_QOS)
    for _ in range(2):
        with subprocess.Popen(
            [sys.executable, "-c", ANSWERS],
            env=environment() | {"ROS_DOMAIN_ID": str(ros.domain)},
            stdout=subprocess.PIPE,
            text=True,
            preexec_fn=as_child,
        ) as program:
            try:
                assert program.stdout.readline() == "there\n"
                ros.wait_until(
                    lambda pid=program.pid: pid in obeyed,
                    "an answer that is obeyed",
                    each=lambda: ask.publish(String()),
                    timeout=15.0,  # by default the killed one counts as a publisher for 20 s
                )
            finally:
                program.kill()


def test_a_killed_program_counts_for_a_second_and_tells_of_itself_often_enough_else():
    text = Path(runtime.__file__).with_name("fastdds.xml").read_text()
    lease, told = (
        sum(
            int(part) * unit
            for part, unit in zip(re.findall(r">(\d+)<", row), (1.0, 1e-9), strict=False)
        )
        for name in ("leaseDuration", "leaseAnnouncement")
        for row in re.findall(f"<{name}>.*</{name}>", text)
    )
    assert lease <= 1.0
    assert told <= lease / 4


def test_settings_of_fast_dds_that_users_have_are_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = "FASTRTPS_DEFAULT_PROFILES_FILE"

    def settled(**given):
        settle_dds(given)
        return given

    assert Path(settled()[name]).samefile(Path(runtime.__file__).with_name("fastdds.xml"))
    assert settled(**{name: "mine.xml"}) == {name: "mine.xml"}
    # With shared memory alone a message could not come by UDP.
    assert name not in settled(FASTDDS_BUILTIN_TRANSPORTS="SHM")
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").touch()
    assert settled() == {}
