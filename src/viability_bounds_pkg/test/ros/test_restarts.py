# SPDX-License-Identifier: Apache-2.0
"""Programs that are killed and started again are heard soon."""

import os
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from small_node import SMALL_NODE
from std_msgs.msg import String

from viability_bounds_pkg.ros import runtime
from viability_bounds_pkg.ros.publisher_watch import PublisherWatch
from viability_bounds_pkg.ros.runtime import CONTROL_QOS, settle_dds
from viability_bounds_pkg.testing.executables import as_child, environment

STARTS = 3
UNUSED = 30  # a place among those that nodes of one host are looked for at

ANSWERS = f"""{SMALL_NODE}
from std_msgs.msg import String
from viability_bounds_pkg.ros.runtime import CONTROL_QOS

class Answers(SmallNode):
    NAME = "answers"

    def __init__(self):
        super().__init__()
        publisher = self.create_publisher(String, "answer", CONTROL_QOS)
        answer = String(data=str(os.getpid()))
        self.create_subscription(String, "ask", lambda _: publisher.publish(answer), CONTROL_QOS)
        print("there", flush=True)

sys.exit(run(Answers, ["answers"]))
"""


@contextmanager
def answering(ros):
    """A program that answers each message, and is killed in the end."""
    with subprocess.Popen(
        [sys.executable, "-c", ANSWERS],
        env=environment() | {"ROS_DOMAIN_ID": str(ros.domain)},
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=as_child,
    ) as program:
        assert program.stdout.readline() == "there\n"
        yield program
        program.kill()


def test_one_that_was_killed_and_started_again_is_heard_and_obeyed(ros):
    watch = PublisherWatch(ros.probe)
    ask = ros.probe.create_publisher(String, "ask", CONTROL_QOS)
    obeyed = set()

    def on_answer(message):
        if watch.admits("/answer"):
            obeyed.add(int(message.data))

    ros.probe.create_subscription(String, "answer", on_answer, CONTROL_QOS)
    for _ in range(STARTS):
        with answering(ros) as program:
            ros.wait_until(
                lambda pid=program.pid: pid in obeyed,
                "an answer that is obeyed",
                each=lambda: ask.publish(String()),
                timeout=5.0,
            )
    assert len(obeyed) == STARTS


def test_programs_read_no_shared_memory_which_outlives_those_that_are_killed(ros):
    with answering(ros) as program:
        files = [os.path.realpath(each) for each in Path(f"/proc/{program.pid}/fd").iterdir()]
    assert any("/dev/shm/fastrtps_" in each for each in files), (
        "Fast DDS names its files otherwise"
    )
    assert not [each for each in files if "fastrtps_port" in each]


def test_programs_announce_themselves_oftener_than_by_default(ros):
    """By default they do so every 3 s, after a few times at the start."""
    with socket.socket(type=socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 7410 + 250 * ros.domain + 2 * UNUSED))
        peer.settimeout(30.0)
        with answering(ros):
            came = {}  # times by who announces itself: the probe does, too
            while len(times := max(came.values(), key=len, default=[])) < 8:
                came.setdefault(peer.recv(65536)[8:20], []).append(time.monotonic())
    assert min(np.diff(times)[-2:]) < 1.5


def test_settings_of_users_are_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def chosen(**given):
        settle_dds(given)
        return given

    name = "FASTRTPS_DEFAULT_PROFILES_FILE"
    assert Path(chosen()[name]).samefile(Path(runtime.__file__).with_name("fastdds.xml"))
    assert name in chosen(FASTDDS_BUILTIN_TRANSPORTS="UDPv4")
    assert chosen(**{name: "mine.xml"}) == {name: "mine.xml"}
    # There a message could not come by UDP.
    assert name not in chosen(FASTDDS_BUILTIN_TRANSPORTS="SHM")
    (tmp_path / "DEFAULT_FASTRTPS_PROFILES.xml").touch()
    assert chosen() == {}
