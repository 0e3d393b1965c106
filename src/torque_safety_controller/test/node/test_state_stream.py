# SPDX-License-Identifier: Apache-2.0
"""Joint states as they arrive: which are new, repeated, or of a robot that starts anew."""

import math

import numpy as np
import pytest

from torque_safety_controller.node.periodic import StateStream
from viability_bounds_pkg.ros.messages import Arrival
from viability_bounds_pkg.testing.ros_harness import joint_state

JOINTS = ("a", "b")
MS = 1_000_000
TIMEOUT = 0.5  # s
Q, MOVED = [0.1, 0.2], [0.1, 0.3]


@pytest.fixture
def stream():
    """A stream in which a state with the stamp 100 ms came at 10 s, and was answered."""
    made = StateStream(JOINTS, TIMEOUT)
    assert arrives(made, 100, 10.0) is Arrival.RESTARTED
    made.forget_answers()
    made.mark_answered()
    return made


def arrives(stream, stamp, now, q=Q):
    return stream.read(joint_state(JOINTS, stamp * MS, q, [0.0, 0.0]), now)


@pytest.mark.parametrize(
    ("stamp", "q", "now", "arrival"),
    [
        (102, Q, 10.01, Arrival.NEW),
        (100, Q, 10.01, Arrival.REPEATED),
        (100, Q, 10.6, Arrival.RESUMED),
        (100, MOVED, 10.6, Arrival.RESTARTED),  # another robot at the same time
        (100, MOVED, 10.01, Arrival.REFUSED),
        (102, Q, 10.6, Arrival.NEW),  # its time stood still, as of a halted simulation
        (700, Q, 10.6, Arrival.RESTARTED),
        (50, Q, 10.01, Arrival.REFUSED),
        (50, Q, 10.6, Arrival.RESTARTED),
        (1200, Q, 10.01, Arrival.NEW),  # the time alone has leapt
        (1200, MOVED, 10.01, Arrival.RESTARTED),
        (102, [math.nan, 0.2], 10.01, Arrival.REFUSED),
    ],
)
def test_what_a_state_is_after_one_that_was_answered(stream, stamp, q, now, arrival):
    assert arrives(stream, stamp, now, q) is arrival
    accepted = arrival in (Arrival.NEW, Arrival.RESTARTED)
    np.testing.assert_array_equal(stream.q, q if accepted else Q)
